"""Speed with several vehicles: `python -m benchmarks.agents [--seconds 1] [--repetitions 3] [--json]`.

Agent-steps per second of the formation task through PettingZoo's API, of the bare compiled step, and of the
batched form, for teams of 6, 20 and 100; MuJoCo-drones-gym and PyFlyt beside them in the same run where they
are installed. Then decision times of `consensus-mpc` through `predict`, for the whole team and per vehicle,
with avoidance active (random starts, so that paths cross), flight by flight in turn.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import sys
from collections.abc import Callable
from time import perf_counter
from typing import Any

from .timing import machine, one_thread, quantiles, rates

one_thread()

import numpy as np  # noqa: E402

from baselines import make_policy  # noqa: E402
from baselines.evaluation.table import format_table  # noqa: E402
from quad_envs import formation_v0  # noqa: E402

TEAMS = (6, 20, 100)
_ENDLESS = 1e4  # s; the vehicles hover, so that no episode ends
_GOALS = {6: 120_000.0, 100: 400_000.0}  # agent-steps/s through the PettingZoo API
_DECISION_GOAL = 0.08  # ms per vehicle, p50
_Candidate = tuple[Callable[[], object], int]


def _parallel(n: int) -> _Candidate:
    env = formation_v0.parallel_env(vehicles=n, time_limit=_ENDLESS)
    env.reset(seed=0)
    actions = {name: np.zeros(4, dtype=np.float32) for name in env.agents}
    steps = max(1, 600 // n)

    def call() -> None:
        for _ in range(steps):
            env.step(actions)
        if len(env.agents) < n:
            env.reset()

    return call, n * steps


def _bare(n: int) -> _Candidate:
    """The compiled step alone, called from Python on arrays that are there already."""
    env = formation_v0.parallel_env(vehicles=n, time_limit=_ENDLESS)
    env.reset(seed=0)
    batch, actions = env._batch, np.zeros((n, 4), dtype=np.float32)
    out, told = np.empty((n, env.task.layout.size), dtype=np.float32), batch.fresh_scores()
    steps = max(1, 600 // n)

    def call() -> None:
        for _ in range(steps):
            batch.step(actions.reshape(-1), out.reshape(-1), told)

    return call, n * steps


def _batched(n: int, teams: int) -> _Candidate:
    env = formation_v0.vector_env(teams, vehicles=n)
    env.reset(seed=0)
    actions = np.zeros((n * teams, 4), dtype=np.float32)
    return lambda: env.step(actions), n * teams


def _peer(make: Callable[[], Any]) -> _Candidate:
    """Any ParallelEnv, with the actions in the middle of its box, begun anew when it ends."""
    env = make()
    env.reset(seed=0)
    middle = {
        name: ((env.action_space(name).low + env.action_space(name).high) / 2.0).astype(np.float32)
        for name in env.possible_agents
    }

    def call() -> None:
        if not env.agents:
            env.reset()
        env.step({name: middle[name] for name in env.agents})

    return call, len(env.possible_agents)


def _peers() -> dict[str, _Candidate]:
    out: dict[str, _Candidate] = {}
    if importlib.util.find_spec("multi_drone_mujoco"):
        module = importlib.import_module("multi_drone_mujoco.envs.multi_agent_aviary")
        for n in TEAMS:
            out[f"MuJoCo-drones-gym, {n}"] = _peer(lambda n=n: module.MultiAgentAviary(num_drones=n))
    if importlib.util.find_spec("PyFlyt"):
        module = importlib.import_module("PyFlyt.pz_envs")
        name = sorted(entry for entry in dir(module) if entry.startswith("MAQuadXHoverEnv"))[-1]
        for n in TEAMS:
            start = np.array([[float(i % 10), float(i // 10), 1.0] for i in range(n)])
            orientation = np.zeros((n, 3))
            out[f"PyFlyt, {n}"] = _peer(
                lambda start=start, orientation=orientation: getattr(module, name)(
                    start_pos=start, start_orn=orientation
                )
            )
    return out


def measure_steps(seconds: float) -> dict[str, float]:
    """Name -> agent-steps per second."""
    candidates: dict[str, _Candidate] = {}
    for n in TEAMS:
        candidates[f"PettingZoo API, {n}"] = _parallel(n)
        candidates[f"bare step, {n}"] = _bare(n)
    candidates["batch of 170 teams, 6"] = _batched(6, 170)
    candidates["batch of 10 teams, 100"] = _batched(100, 10)
    return rates(candidates | _peers(), seconds)


def step_ratios(found: dict[str, float]) -> dict[str, float]:
    """Ours over each peer, and over the goal."""
    out = {}
    for n in TEAMS:
        ours = found[f"PettingZoo API, {n}"]
        if n in _GOALS:
            out[f"PettingZoo API, {n} / goal {_GOALS[n]:,.0f}"] = ours / _GOALS[n]
        for peer in ("MuJoCo-drones-gym", "PyFlyt"):
            if f"{peer}, {n}" in found:
                out[f"PettingZoo API, {n} / {peer}, {n}"] = ours / found[f"{peer}, {n}"]
    return out


def measure_decisions(repetitions: int) -> dict[str, dict[str, float]]:
    """Team -> decision times of consensus-mpc over whole flights, ms."""
    envs = {n: formation_v0.parallel_env(vehicles=n, time_limit=10.0) for n in TEAMS}
    policies = {n: make_policy("consensus-mpc", env) for n, env in envs.items()}
    times: dict[int, list[float]] = {n: [] for n in TEAMS}
    for flight in range(repetitions):
        for n, env in envs.items():
            seen, _ = env.reset(seed=flight)
            state: Any = None
            while env.agents:
                observations = np.stack([seen[name] for name in env.agents])
                begin = perf_counter()
                actions, state = policies[n].predict(observations, state)
                times[n].append(perf_counter() - begin)
                seen, *_ = env.step(dict(zip(env.agents, actions, strict=True)))
    out = {}
    for n, seconds in times.items():
        warm = seconds[2:] if len(seconds) > 2 else seconds  # the first compiles, the second has a state
        p50, p99, slowest = quantiles(warm)
        out[f"consensus-mpc, {n}"] = {
            "team p50": p50,
            "team p99": p99,
            "team max": slowest,
            "per vehicle p50": p50 / n,
        }
    return out


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.agents", description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=1.0, help="time for each rate (default 1)")
    parser.add_argument("--repetitions", type=int, default=3, help="flights of each team (default 3)")
    parser.add_argument("--json", action="store_true", help="machine-readable")
    arguments = parser.parse_args()
    found, decisions = measure_steps(arguments.seconds), measure_decisions(arguments.repetitions)
    ratios = step_ratios(found)
    for name, row in decisions.items():
        ratios[f"{name}: per vehicle p50 / goal {_DECISION_GOAL} ms"] = (
            row["per vehicle p50"] / _DECISION_GOAL
        )
    if arguments.json:
        said = {"machine": machine(), "agent_steps_per_s": found, "decisions_ms": decisions, "ratios": ratios}
        json.dump(said, sys.stdout, indent=2)
        print()
        return
    print(machine(), end="\n\n")
    rows = [[name, f"{rate:,.0f}", f"{rate * 5:,.0f}"] for name, rate in found.items() if "-gym" not in name]
    rows += [[name, f"{rate:,.0f}", ""] for name, rate in found.items() if "-gym" in name]
    print(format_table(["", "agent-steps/s", "substeps/s"], rows), end="\n\n")
    columns = list(next(iter(decisions.values())))
    table = [[name, *(f"{row[column]:.3f}" for column in columns)] for name, row in decisions.items()]
    print(format_table(["decision, ms", *columns], table), end="\n\n")
    for name, ratio in ratios.items():
        print(f"{name}: {ratio:.2f}")


if __name__ == "__main__":
    main()
