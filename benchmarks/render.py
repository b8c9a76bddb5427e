"""Speed of pictures: `python -m benchmarks.render [--seconds 1] [--json]`.

Pictures per second of `render()` alone, of flights that have gone on for a second, so that trails and links
are there.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from typing import Any

from .timing import machine, one_thread, rates

one_thread()

import gymnasium as gym  # noqa: E402
import numpy as np  # noqa: E402

from baselines.evaluation.table import format_table  # noqa: E402
from quad_envs import formation_v0, target_tracking_v0  # noqa: E402

_STEPS = 20  # control steps before the picture
_FRAMES = 10  # pictures in one call
_GOALS = {"frames/s, 640x480, six vehicles": 200.0}


def _team(module: Any, size: tuple[int, int], vehicles: int) -> Callable[[], object]:
    env = module.parallel_env(render_mode="rgb_array", render_size=size, vehicles=vehicles, terminate="agent")
    env.reset(seed=0)
    for _ in range(_STEPS):
        env.step({name: np.zeros(4, dtype=np.float32) for name in env.agents})
    return lambda: [env.render() for _ in range(_FRAMES)]


def _single(size: tuple[int, int]) -> Callable[[], object]:
    env = gym.make("quad/CorridorTracking-v0", render_mode="rgb_array", render_size=size).unwrapped
    env.reset(seed=0)
    for _ in range(_STEPS):
        env.step(np.zeros(4, dtype=np.float32))
    return lambda: [env.render() for _ in range(_FRAMES)]


def measure(seconds: float) -> dict[str, float]:
    """Name -> pictures per second."""
    small, large = (640, 480), (1280, 720)
    calls = {
        "frames/s, 640x480, six vehicles": _team(formation_v0, small, 6),
        "frames/s, 640x480, six vehicles and a target": _team(target_tracking_v0, small, 6),
        "frames/s, 640x480, one vehicle in a corridor": _single(small),
        "frames/s, 640x480, 100 vehicles": _team(formation_v0, small, 100),
        "frames/s, 1280x720, six vehicles": _team(formation_v0, large, 6),
    }
    return rates({name: (call, _FRAMES) for name, call in calls.items()}, seconds)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.render", description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=1.0, help="time for each measurement (default 1)")
    parser.add_argument("--json", action="store_true", help="machine-readable")
    arguments = parser.parse_args()
    found = measure(arguments.seconds)
    ratios = {name: found[name] / goal for name, goal in _GOALS.items()}
    if arguments.json:
        json.dump({"machine": machine(), "rates": found, "ratios": ratios}, sys.stdout, indent=2)
        print()
        return
    goals = {name: f"{goal:g}" for name, goal in _GOALS.items()}
    rows = [[name, f"{rate:,.0f}", goals.get(name, "")] for name, rate in found.items()]
    print(machine(), end="\n\n")
    print(format_table(["", "measured", "goal"], rows), end="\n\n")
    for name, ratio in ratios.items():
        print(f"{name} / goal: {ratio:.2f}")


if __name__ == "__main__":
    main()
