"""What the command `train` does."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from typing import TYPE_CHECKING

from ..errors import TrainingError
from ..files import plain_json
from ..interruptions import exit_code
from .commands import plain_warnings, say
from .options import TrainOptions, read_assignments

if TYPE_CHECKING:
    from ..training.request import TrainingRequest

_DIVERGED = 1


def train_one(options: TrainOptions) -> int:
    """Train, print what came out, and leave a checkpoint."""
    from ..training.algorithms import resumable
    from ..training.runs import run_training
    from ..training.watching import Display, describe

    request = requested(options)
    display, out = Display(f"{options.algorithm} on {options.env}"), request.folder
    with plain_warnings():
        try:
            result = run_training(replace(request, watcher=display))
        except TrainingError as error:
            say(f"quad-envs: {error}")
            return _DIVERGED
        except KeyboardInterrupt as interruption:
            display.close()
            if not (out / "policy.json").exists():
                say("interrupted before the first policy, nothing is saved: the same command begins anew")
            elif resumable(options.algorithm):
                go_on = replace(request, out=out, resume=True, fresh=False)
                say(f"interrupted; the policy is saved. Resume with: {go_on.command}")
            else:
                say(f"interrupted; the best policy is in {out}. {options.algorithm} cannot be resumed")
            return exit_code(interruption)
        finally:
            display.close()
    if options.json:
        print(json.dumps(plain_json(result.to_dict()), indent=1, allow_nan=False))
    else:
        print(f"best of {len(result.curve)} evaluations: {describe(result.best)}")
    say(f"policy in {out}; fly it with: quad-envs evaluate {options.env} {shlex.quote(str(out))}")
    return 0


def requested(options: TrainOptions) -> TrainingRequest:
    """What the command line asks for."""
    from ..training.request import TrainingRequest

    return TrainingRequest(
        options.env,
        options.algorithm,
        seed=options.seed,
        seconds=options.seconds,
        steps=options.steps,
        out=options.out,
        env_kwargs=read_assignments("--set", options.set),
        hyper=read_assignments("--hyper", options.hyper),
        start_from=options.from_ or None,
        resume=options.resume,
        fresh=options.fresh,
    )
