"""What the command `tune` does."""

from __future__ import annotations

import json
import shlex

from ..errors import TrainingError
from ..files import plain_json
from ..interruptions import exit_code
from .commands import plain_warnings, say
from .options import TuneOptions, read_assignments

_FAILED = 1


def tune_one(options: TuneOptions) -> int:
    """Tune, print what came out, and leave a folder that `make_policy` takes."""
    from ..training.tuning import TuningRequest, run_tuning
    from ..training.watching import Display, describe

    display = Display(f"{options.policy} on {options.env}")
    request = TuningRequest(
        options.env,
        options.policy,
        objective=options.objective,  # type: ignore[arg-type]
        seed=options.seed,
        seconds=options.seconds,
        episodes=options.episodes,
        fields=options.tuned,
        out=options.out,
        env_kwargs=read_assignments("--set", options.set),
        options=read_assignments("--policy-set", options.policy_set),
        resume=options.resume,
        fresh=options.fresh,
        watcher=display,
    )
    out = shlex.quote(str(request.folder))
    with plain_warnings():
        try:
            result = run_tuning(request)
        except TrainingError as error:
            say(f"quad-envs: {error}")
            return _FAILED
        except KeyboardInterrupt as interruption:
            display.close()
            kept = (request.folder / "last.json").exists()
            say(f"interrupted; what is finished is in {out}: --resume goes on" if kept else "interrupted")
            return exit_code(interruption)
        finally:
            display.close()
    if options.json:
        print(json.dumps(plain_json(result.to_dict()), indent=1, allow_nan=False))
    else:
        print(f"default: {describe(result.curve[0])}")
        print(f"best of {len(result.curve)} judged: {describe(result.best)}")
    say(f"policy in {out}; fly it with: quad-envs evaluate {options.env} {out}")
    return 0
