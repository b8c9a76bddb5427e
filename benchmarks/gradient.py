"""Speed of the gradient through a team: `python -m benchmarks.gradient [--teams 32] [--steps 40] [--json]`.

Agent-steps per CPU-second of windows of the hexagon, forward and backward, with constant actions and without
a network: the best of several windows.
"""

from __future__ import annotations

import argparse
import json
from time import process_time

from .timing import machine, one_thread

one_thread()

import numpy as np  # noqa: E402

from baselines.evaluation.table import format_table  # noqa: E402
from baselines.training.features import training_features  # noqa: E402
from baselines.training.team_flights import DifferentiableTeams  # noqa: E402
from quad_envs.envs.team.options import FormationOptions  # noqa: E402

_WINDOWS = 8
_SUBSTEPS, _STAGES, _CYCLES = 2, (0, 2, 5), 240  # as `apg` trains


def window(flights: DifferentiableTeams, steps: int) -> tuple[float, float, float]:
    """CPU-seconds of a window: its steps, their adjoints, those of observations."""
    n, cost = flights.n, 0.1
    plants, commands = np.zeros((n, 16)), np.zeros((n, 4))
    rewards, seen = np.ones(n), np.ones((n, len(flights.features.names)), dtype=np.float32)
    still = np.zeros((n, 4), dtype=np.float32)
    flights.begin_window(steps)
    begin = process_time()
    records = [flights.advance(still) for _ in range(steps)]
    forward, advancing, observing = process_time() - begin, 0.0, 0.0
    for record in reversed(records):
        begin = process_time()
        _, plants, commands = flights.advance_vjp(record, plants, commands, rewards, cost)
        between = process_time()
        own, last = flights.observe_vjp(record, seen)
        plants, commands = plants + own, commands + last
        advancing, observing = advancing + between - begin, observing + process_time() - between
    return forward, advancing, observing


def measure(teams: int, steps: int) -> dict[str, float]:
    """Agent-steps per CPU-second, of each part and of all."""
    options = FormationOptions(formation="hexagon", substeps=_SUBSTEPS, max_cycles=_CYCLES)
    features = training_features(options, _STAGES)
    flights = DifferentiableTeams(options, teams * options.vehicles, 0, features, 0.55)
    window(flights, 2)  # compiles
    parts = np.min([window(flights, steps) for _ in range(_WINDOWS)], axis=0)
    per_step = parts / (steps * flights.n)
    names = ("forward", "backward: steps and rewards", "backward: observations")
    found = {name: 1.0 / seconds for name, seconds in zip(names, per_step.tolist(), strict=True)}
    return found | {"forward and backward": float(1.0 / per_step.sum())}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--teams", type=int, default=32)
    parser.add_argument("--steps", type=int, default=40, help="of a window")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    found = measure(options.teams, options.steps)
    if options.json:
        print(json.dumps({"agent_steps_per_cpu_second": found, "machine": machine()}))
        return
    print(format_table(["hexagon", "agent-steps per CPU-s"], [[k, f"{v:,.0f}"] for k, v in found.items()]))


if __name__ == "__main__":
    main()
