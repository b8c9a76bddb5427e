"""What the command `train` does."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

from ..errors import TrainingError
from ..files import plain_json
from ..interruptions import exit_code
from .commands import plain_warnings, say
from .options import TrainOptions, read_assignments

_DIVERGED = 1


def train_one(options: TrainOptions) -> int:
    """Train, print what came out, and leave a checkpoint."""
    from ..training.algorithms import resumable
    from ..training.runs import default_folder, train
    from ..training.watching import Display, describe

    env_kwargs, hyper = read_assignments("--set", options.set), read_assignments("--hyper", options.hyper)
    out = options.out or default_folder(options.env, options.algorithm, options.seed)
    display = Display(f"{options.algorithm} on {options.env}")
    with plain_warnings():
        try:
            result = train(
                options.env,
                options.algorithm,
                seed=options.seed,
                seconds=options.seconds,
                steps=options.steps,
                out=out,
                env_kwargs=env_kwargs,
                hyper=hyper,
                start_from=options.from_ or None,
                resume=options.resume,
                fresh=options.fresh,
                watcher=display,
            )
        except TrainingError as error:
            say(f"quad-envs: {error}")
            return _DIVERGED
        except KeyboardInterrupt as interruption:
            display.close()
            if not (out / "policy.json").exists():
                say("interrupted before the first policy, nothing is saved: the same command begins anew")
            elif resumable(options.algorithm):
                say(f"interrupted; the policy is saved. Resume with: {resume_command(options, out)}")
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


def resume_command(options: TrainOptions, out: Path) -> str:
    """The command line that goes on with a run."""
    from ..training.command_line import training_command

    return (
        training_command(
            options.env,
            options.algorithm,
            options.seed,
            options.seconds,
            options.steps,
            str(out),
            options.set,
            options.hyper,
            options.from_,
        )
        + " --resume"
    )
