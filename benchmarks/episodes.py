"""Speed of evaluations: `python -m benchmarks.episodes [--flights 256] [--memory 10000] [--json]`.

CPU-milliseconds of a flight of 200 steps on RandomTracking, one core: in a single environment, as outsiders'
policies and wrapped environments fly; by `evaluate` and in a unit of a benchmark, where flights go side by
side; and in a loop that only decides and steps. The flights in which decisions are timed take the same time
however many others there are: they stand in a column of their own. `--memory N` evaluates N flights and says
how far the memory of the process has grown.
"""

from __future__ import annotations

import argparse
import json
import resource
from collections.abc import Callable
from time import process_time
from typing import Any

from .timing import machine, one_thread

one_thread()

import gymnasium  # noqa: E402
import numpy as np  # noqa: E402

from baselines import make_policy, measure, run_episodes  # noqa: E402
from baselines.evaluation.evaluate import fly_and_measure  # noqa: E402
from baselines.evaluation.rollout import time_decisions  # noqa: E402
from baselines.evaluation.table import format_table  # noqa: E402
from baselines.sweeps.choices import EnvChoice, PolicyChoice  # noqa: E402
from baselines.sweeps.suite import Suite  # noqa: E402
from baselines.sweeps.unit_flights import fly_unit  # noqa: E402
from baselines.sweeps.units import suite_units  # noqa: E402

ENV = "quad/RandomTracking-v0"
POLICIES = ("apg-random", "lqr", "lmpc", "sdc-nmpc", "nmpc")
_GOALS = {"apg-random": 1.2, "lmpc": 4.5}  # CPU-ms of a flight in `evaluate` and `benchmark`
_SINGLE, _ROWS = 4, 64  # flights of a call in a single environment, rows of the bare loop
_REPETITIONS = 3
COLUMNS = ("single", "evaluate", "benchmark", "bare loop", "timing")


def _bare(policy: Any, env: Any) -> None:
    """Nothing but decisions and steps."""
    observations, _ = env.reset(seed=0)
    state, start = None, np.ones(env.num_envs, dtype=np.bool_)
    for _ in range(env.unwrapped.task.episode_steps):
        actions, state = policy.predict(observations, state, start)
        observations, *_ = env.step(actions)
        start = np.zeros_like(start)


def _candidates(name: str, flights: int) -> dict[str, tuple[Callable[[], object], int]]:
    """Column -> a call, and the flights that its time is divided by."""
    env, rows = gymnasium.make(ENV), gymnasium.make_vec(ENV, num_envs=_ROWS)
    policy = make_policy(name, env)
    timed = time_decisions(policy, env)
    suite = Suite("episodes", (EnvChoice(ENV),), (PolicyChoice(name),), flights)
    (unit,) = (unit._replace(timed=timed) for unit in suite_units(suite))
    return {
        "single": (lambda: [measure(one) for one in run_episodes(policy, env, _SINGLE)], _SINGLE),
        "evaluate": (lambda: fly_and_measure(policy, env, flights, timed=timed), flights),
        "benchmark": (lambda: fly_unit(unit), flights),
        "bare loop": (lambda: _bare(policy, rows), _ROWS),
        "timing": (lambda: time_decisions(policy, env), 1),
    }


def measured(name: str, flights: int) -> dict[str, float]:
    """CPU-ms of a flight in each way, and of all timed flights of an evaluation; the best of several."""
    candidates, best = _candidates(name, flights), dict.fromkeys(COLUMNS, float("inf"))
    for _ in range(_REPETITIONS):
        for column, (call, share) in candidates.items():
            begin = process_time()
            call()
            best[column] = min(best[column], 1e3 * (process_time() - begin) / share)
    return best


def grown(flights: int) -> float:
    """MiB by which the most memory of this process grows in an evaluation of so many flights."""
    env = gymnasium.make(ENV)
    policy = make_policy(POLICIES[0], env)
    fly_and_measure(policy, env, _ROWS)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    fly_and_measure(policy, env, flights)
    return (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024.0


def main() -> None:
    """Print what was measured beside what is asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--flights", type=int, default=256)
    parser.add_argument("--memory", type=int, default=0, metavar="FLIGHTS")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    found: dict[str, Any] = {name: measured(name, options.flights) for name in POLICIES}
    memory = grown(options.memory) if options.memory else None
    if options.json:
        print(json.dumps({"cpu_ms": found, "memory_mib": memory, "machine": machine()}, indent=1))
        return
    rows = [
        [name, *(f"{found[name][column]:.2f}" for column in COLUMNS), f"{_GOALS.get(name, '-')}"]
        for name in POLICIES
    ]
    print(f"CPU-ms of a flight on {ENV}, {options.flights} of them; {machine()}")
    print(format_table(["policy", *COLUMNS, "asked"], rows))
    print("timing: the 20 short flights in which decisions are timed, once for an evaluation")
    if memory is not None:
        print(f"an evaluation of {options.memory} flights takes {memory:.0f} MiB more than one of {_ROWS}")


if __name__ == "__main__":
    main()
