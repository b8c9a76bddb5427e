"""Decision times in closed loop: `python -m benchmarks.decide [--quick] [--beside CHECKOUT] [--json]`.

Every controller decides through `predict` in two flights: "nominal" (a climbing helix, no constraint active)
and "tight" (set-point jumps with 2.45 N rotors and 5 N/s, many active). All fly in turns, flight by flight,
in one run. The time of a decision is the smallest over the repetitions of its flight, which repeat exactly;
p50, p99 and max are over the decisions. With `--beside CHECKOUT` single and batched decisions of another
checkout fly in turns with ours. The quadratic cost is that of the closed loop. DAQP and CasADi-IPOPT
fly along when they are installed.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from .beside import Pair, decisions_beside
from .timing import machine, one_thread, quantiles

one_thread()

from time import perf_counter  # noqa: E402

import gymnasium as gym  # noqa: E402
import numpy as np  # noqa: E402

import quad_envs  # noqa: E402
from baselines import make_policy  # noqa: E402
from baselines.evaluation.table import format_table  # noqa: E402

_JUMPS = np.array([(0.0, 0.0, 0.0), (3.0, 3.0, 3.0), (3.0, -3.0, 1.0), (-2.0, 1.0, -3.0)])


def set_point_jumps(t: float) -> list[float]:
    """Another set-point every 2 s; (p, v) with v = 0."""
    return [*_JUMPS[int((t + 1e-9) // 2.0) % len(_JUMPS)], 0.0, 0.0, 0.0]


SCENES: dict[str, dict[str, Any]] = {
    "nominal": {
        "reference": quad_envs.Helix(radius=2.0, rate=0.5, vertical_speed=-0.2),
        "rate_limit": 20.0,
        "start": (0.0, 0.0, 0.0),
        "time_limit": 4.0,
    },
    "tight": {
        "reference": quad_envs.from_function(set_point_jumps),
        "kappa": 0.3125,
        "rate_limit": 5.0,
        "start": (3.0, 3.0, 3.0),
        "time_limit": 4.0,
    },
}


class Entry(NamedTuple):
    """A controller in the comparison."""

    name: str
    make: Callable[[Any, int], Any]  # environment, horizon -> policy
    slow: bool = False  # flown once only


def entries(horizon: int) -> list[Entry]:
    """Our controllers, and the peers that are installed."""

    def ours(name: str, **options: Any) -> Callable[[Any, int], Any]:
        return lambda env, N: make_policy(name, env, horizon=N, **options)

    def daqp(env: Any, N: int) -> Any:
        from .peers import DaqpSolver

        policy: Any = make_policy("sdc-nmpc", env, horizon=N, solver="osqp")
        policy.controller._backend = DaqpSolver()
        return policy

    def ipopt(env: Any, N: int) -> Any:
        from .peers import IpoptPolicy

        return IpoptPolicy(env.unwrapped.task, N)

    def do_mpc(env: Any, N: int) -> Any:
        from .peers import DoMpcPolicy

        return DoMpcPolicy(env.unwrapped.task, N)

    exact = {"velocity_error": "body", "frame": "hover"}
    found = [
        Entry("lmpc", ours("lmpc")),
        Entry("sdc-nmpc", ours("sdc-nmpc")),
        Entry("sdc-nmpc, P(x)", ours("sdc-nmpc", terminal_weight="sdre")),
        Entry("sdc-nmpc, 1 relinearisation", ours("sdc-nmpc", relinearisations=1)),
        Entry("nmpc, RTI", ours("nmpc", **exact)),
        Entry("nmpc, SQP", ours("nmpc", passes=30, **exact)),
        Entry("sdc-nmpc, OSQP set up anew", ours("sdc-nmpc", solver="osqp")),
    ]
    if importlib.util.find_spec("daqp"):
        found.append(Entry("sdc-nmpc, DAQP condensed", daqp))
    if importlib.util.find_spec("casadi"):
        found.append(Entry("nmpc, CasADi IPOPT", ipopt, slow=True))
    if importlib.util.find_spec("do_mpc"):
        found.append(Entry("nmpc, do-mpc (no rate limit)", do_mpc, slow=True))
    return found


class Result(NamedTuple):
    """One controller in one scene."""

    p50: float  # ms
    p99: float
    max: float
    quadratic_cost: float
    fallbacks: int


def fly(env: Any, policy: Any) -> tuple[list[float], float, int]:
    """One flight: seconds of each decision, summed stage cost, fallbacks."""
    observation, _ = env.reset(seed=0)
    state, start, seconds, cost = None, np.ones(1, dtype=np.bool_), [], 0.0
    for _ in range(env.unwrapped.task.episode_steps):
        begin = perf_counter()
        action, state = policy.predict(observation[None], state, start)
        seconds.append(perf_counter() - begin)
        observation, _, _, _, info = env.step(action[0])
        cost += info["stage_cost"]
        start = np.zeros(1, dtype=np.bool_)
    return seconds, cost, int(getattr(state, "fallbacks", np.zeros((1, 5)))[0, 1:].sum())


def fly_in_turns(scene: str, horizon: int, repetitions: int) -> dict[str, Result]:
    """Fly all controllers one after the other, and all of them again and again."""
    found = entries(horizon)
    env = gym.make("quad/Regulation-v0", start_box=0.0, preview=max(25, horizon), **SCENES[scene])
    policies = {entry.name: entry.make(env, horizon) for entry in found}
    times: dict[str, list[list[float]]] = {entry.name: [] for entry in found}
    outcome: dict[str, tuple[float, int]] = {}
    for repetition in range(repetitions + 1):  # the first compiles
        for entry in found:
            if not (entry.slow and repetition > 1):
                seconds, *rest = fly(env, policies[entry.name])
                times[entry.name].append(seconds)
                outcome[entry.name] = rest[0], rest[1]
    return {
        name: Result(*quantiles(list(np.min(rows[1:], axis=0))), *outcome[name])
        for name, rows in times.items()
    }


def batch_rate(n: int = 256, steps: int = 40) -> dict[str, float]:
    """Decisions per second of one batched `predict` over many vehicles, constraints active; N = 25."""
    env = gym.make_vec(
        "quad/Regulation-v0", num_envs=n, **{**SCENES["tight"], "start_box": 3.0, "start": (0.0,) * 3}
    )
    out = {}
    for name in ("lmpc", "sdc-nmpc", "nmpc"):
        policy = make_policy(name, env)
        best = 0.0
        for _ in range(3):
            observations, _ = env.reset(seed=0)
            state, start, seconds = None, np.ones(n, dtype=np.bool_), 0.0
            for _ in range(steps):
                begin = perf_counter()
                actions, state = policy.predict(observations, state, start)
                seconds += perf_counter() - begin
                observations, *_ = env.step(actions)
                start = np.zeros(n, dtype=np.bool_)
            best = max(best, n * steps / seconds)
        out[name] = best
    return out


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.decide", description=__doc__.splitlines()[0])
    parser.add_argument("--horizons", type=int, nargs="+", default=[5, 10, 15, 25, 35, 45])
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="N = 25 only, two repetitions")
    parser.add_argument("--json", action="store_true", help="machine-readable")
    parser.add_argument("--beside", type=Path, help="another checkout: only this", metavar="CHECKOUT")
    arguments = parser.parse_args()
    if arguments.beside is not None:
        _print_beside(decisions_beside(arguments.beside, 64, 40, arguments.repetitions))
        return
    horizons, repetitions = ([25], 2) if arguments.quick else (arguments.horizons, arguments.repetitions)
    results: dict[str, dict[str, Any]] = {}
    if not arguments.json:
        print(machine())
    for horizon in horizons:
        for scene in SCENES:
            found = fly_in_turns(scene, horizon, repetitions)
            results[f"N = {horizon}, {scene}"] = {name: row._asdict() for name, row in found.items()}
            if not arguments.json:
                _print(f"N = {horizon}, {scene}", found)
    rate = batch_rate()
    if arguments.json:
        json.dump({"machine": machine(), "results": results, "decisions/s": rate}, sys.stdout, indent=2)
        print()
        return
    print("\none batched predict over 256 vehicles, N = 25, tight:")
    for name, value in rate.items():
        print(f"  {name}: {value:,.0f} decisions/s")


def _print_beside(found: dict[str, Pair]) -> None:
    rows = [
        [name, f"{here:.1f}", f"{there:.1f}", f"{there / here:.2f}"] for name, (here, there) in found.items()
    ]
    print(format_table(["policy, scene, rows at once; N = 25", "us a row", "there", "there / here"], rows))


def _print(title: str, found: dict[str, Result]) -> None:
    base = found["sdc-nmpc"].p50
    rows = [
        [
            name,
            *(f"{value:.3f}" for value in row[:3]),
            f"{row.p50 / base:.1f}",
            f"{row.quadratic_cost:.2f}",
            str(row.fallbacks),
        ]
        for name, row in found.items()
    ]
    header = [title, "p50 ms", "p99 ms", "max ms", "p50 / sdc-nmpc", "quadratic cost", "fallbacks"]
    print("\n" + format_table(header, rows), flush=True)


if __name__ == "__main__":
    main()
