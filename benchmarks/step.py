"""Environment speed: `python -m benchmarks.step [--seconds 1] [--beside CHECKOUT] [--json]`.

Control steps, physics substeps and simulated seconds per second, for one environment through `gymnasium.make`
with its default wrappers, for the bare compiled step, and for vector environments; l2f beside them in the
same run when it is installed. Rewards, limits, observations with preview and autoreset are included
everywhere but in "bare" and in l2f. With `--beside` CPU time of steps here and in another checkout, in turns.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .timing import machine, one_thread, rates

one_thread()

import gymnasium as gym  # noqa: E402
import numpy as np  # noqa: E402

import quad_envs  # noqa: E402, F401
from baselines.evaluation.table import format_table  # noqa: E402

from .steps_beside import steps_beside  # noqa: E402

_ID = "quad/HelixTracking-v0"
_STEPS = 1000  # control steps of a single environment in one call
_DT = 0.05  # s
_EPISODE = 201  # control steps of an episode and its reset
_ROWS = 1024  # flights with which options are measured
_L2F_SINGLE = {"l2f: one, step + observe": False, "l2f: one, and read it, and go on": True}
_L2F_ROWS = (64, 1024)  # its sizes are compiled one by one
_LIMITS: dict[str, Any] = {
    "kappa": 0.3125,
    "rate_limit": 5.0,
    "tilt_limit": 0.35,
    "velocity_limit": 1.8,
    "position_limit": ((-9.0, -9.0, -40.0), (9.0, 9.0, 40.0)),
}
_NOISY: dict[str, Any] = {"disturbance": "gusts", "sensor_noise": 0.01, "randomize": 0.1}
# What can be chosen about a task, and costs time.
_OPTIONS: dict[str, dict[str, Any]] = {
    "nothing": {},
    "random reference": {"env_id": "quad/RandomTracking-v0"},
    "steady wind": {"disturbance": (0.1, 0.0, 0.0), "reveal_disturbance": True},
    "gusts": {"disturbance": "gusts"},
    "sensor noise": {"sensor_noise": 0.01},
    "random vehicles": {"randomize": 0.1},
    "all limits": _LIMITS,
    "reset in the same step": {"autoreset_mode": gym.vector.AutoresetMode.SAME_STEP.value},
    "everything": {
        "env_id": "quad/RandomTracking-v0",
        "reveal_disturbance": True,
        **_LIMITS,
        **_NOISY,
        "kappa": 0.5,
    },
}


def _single(substeps: int) -> Callable[[], object]:
    env = gym.make(_ID, substeps=substeps)
    env.reset(seed=0)
    action = np.zeros(4, dtype=np.float32)

    def call() -> None:
        for _ in range(_STEPS):
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()

    return call


def _bare(substeps: int) -> Callable[[], object]:
    """The compiled step of one environment, called from Python on arrays that are there already."""
    env: Any = gym.make(
        _ID, substeps=substeps, time_limit=1e6 * _DT, preview=25, reference="setpoint"
    ).unwrapped
    env.reset(seed=0)
    batch, told = env._batch, env._batch.fresh_scores()
    action, out = np.zeros(4, dtype=np.float32), np.empty(env.task.layout.size, dtype=np.float32)
    start = np.zeros((1, 16))
    start[0, 12:] = env.task.hover_force

    def call() -> None:
        for _ in range(_STEPS):
            batch.step(action, out, told)
        batch.begin(np.zeros(1, dtype=np.int64), [env.np_random], out, told, start)

    return call


def _vector(n: int, env_id: str = _ID, **options: Any) -> tuple[Callable[[], object], int]:
    env = gym.make_vec(env_id, num_envs=n, **options)
    env.reset(seed=0)
    actions = np.zeros((n, 4), dtype=np.float32)
    steps = max(1, 4096 // n) if not options and env_id == _ID else _EPISODE  # with its share of resets

    def call() -> None:
        for _ in range(steps):
            env.step(actions)

    return call, n * steps


def _l2f_single(whole: bool) -> Callable[[], object]:
    """Bare calls, or all that a loop needs: the observation in Python, and the state to go on from."""
    import l2f  # type: ignore[import-not-found]

    device = l2f.Device()
    rng, env = l2f.Rng(), l2f.Environment()
    parameters, state, following = l2f.Parameters(), l2f.State(), l2f.State()
    observation = l2f.Observation()
    l2f.initialize_environment(device, env)
    l2f.initialize_rng(device, rng, 0)
    l2f.initial_parameters(device, env, parameters)
    l2f.initial_state(device, env, parameters, state)
    action = [0.0] * 4

    def call() -> None:
        for _ in range(_STEPS):
            l2f.step(device, env, parameters, state, action, following, rng)
            l2f.observe(device, env, parameters, following, observation, rng)
            if whole:
                state.assign(following)
                list(observation.observation)

    return call


def _l2f_vector(n: int) -> tuple[Callable[[], object], int]:
    device = importlib.import_module("l2f").Device()
    vector = getattr(importlib.import_module("l2f"), f"vector{n}")
    rng, env = vector.VectorRng(), vector.VectorEnvironment()
    parameters, state, following = vector.VectorParameters(), vector.VectorState(), vector.VectorState()
    vector.initialize_rng(device, rng, 0)
    vector.initialize_environment(device, env)
    vector.sample_initial_parameters(device, env, parameters, rng)
    vector.sample_initial_state(device, env, parameters, state, rng)
    actions = np.zeros((n, 4), dtype=np.float32)
    observations = np.zeros((n, env.OBSERVATION_DIM), dtype=np.float32)
    steps = max(1, 4096 // n)

    def call() -> None:
        for _ in range(steps):
            vector.step(device, env, parameters, state, actions, following, rng)
            vector.observe(device, env, parameters, following, observations, rng)

    return call, n * steps


def measure(seconds: float) -> dict[str, dict[str, float]]:
    """Name -> control steps, substeps and simulated seconds per second."""
    candidates: dict[str, tuple[Callable[[], object], int]] = {}
    physics: dict[str, tuple[int, float]] = {}
    for substeps in (1, 2, 5, 10):
        candidates[f"one env, {substeps} substeps"] = _single(substeps), _STEPS
        physics[f"one env, {substeps} substeps"] = substeps, _DT
    candidates["bare step, 5 substeps"] = _bare(5), _STEPS
    physics["bare step, 5 substeps"] = 5, _DT
    for n in (8, 64, 1024, 4096):
        candidates[f"vector of {n}, 5 substeps"] = _vector(n)
        physics[f"vector of {n}, 5 substeps"] = 5, _DT
    for name, options in _OPTIONS.items():
        candidates[f"{_ROWS} with {name}"] = _vector(_ROWS, **{"env_id": _ID, "substeps": 5, **options})
        physics[f"{_ROWS} with {name}"] = 5, _DT
    if importlib.util.find_spec("l2f"):
        for name, whole in _L2F_SINGLE.items():
            candidates[name], physics[name] = (_l2f_single(whole), _STEPS), (1, 0.01)
        for n in _L2F_ROWS:
            candidates[f"l2f: vector of {n}"] = _l2f_vector(n)
            physics[f"l2f: vector of {n}"] = 1, 0.01
    found = rates(candidates, seconds)
    return {
        name: {
            "control steps/s": rate,
            "substeps/s": rate * physics[name][0],
            "simulated s/s": rate * physics[name][1],
        }
        for name, rate in found.items()
    }


def ratios(found: dict[str, dict[str, float]]) -> dict[str, float]:
    """The comparisons that docs/results/speed.md quotes."""
    rate = {name: row["control steps/s"] for name, row in found.items()}
    out = {"bare step / one env": rate["bare step, 5 substeps"] / rate["one env, 5 substeps"]}
    for name in _OPTIONS:
        out[f"{_ROWS} with {name} / with nothing"] = (
            rate[f"{_ROWS} with {name}"] / rate[f"{_ROWS} with nothing"]
        )
    pairs = {f"l2f: vector of {n}": f"vector of {n}, 5 substeps" for n in _L2F_ROWS}
    for theirs, ours in {**dict.fromkeys(_L2F_SINGLE, "one env, 5 substeps"), **pairs}.items():
        if theirs in rate:
            out[f"{ours} / {theirs}"] = rate[ours] / rate[theirs]
    return out


def _compare(other: Path, repetitions: int, as_json: bool) -> None:
    """Print steps of this checkout beside those of another one."""
    found = steps_beside(other, _OPTIONS, _ROWS, _EPISODE, repetitions)
    if as_json:
        json.dump({name: pair._asdict() for name, pair in found.items()}, sys.stdout, indent=2)
        print()
        return
    plain = found[f"{_ROWS} with nothing"]
    rows = [
        [
            name,
            f"{here:.0f}",
            f"{there:.0f}",
            f"{there / here:.2f}",
            f"{plain.here / here:.2f}",
            f"{plain.there / there:.2f}",
        ]
        for name, (here, there) in found.items()
    ]
    heads = ["CPU-ns of a row's step", "here", "there", "times faster", "plain / here", "plain / there"]
    print(format_table(heads, rows))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.step", description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=1.0, help="time for each measurement (default 1)")
    parser.add_argument("--json", action="store_true", help="machine-readable")
    parser.add_argument(
        "--beside", type=Path, help="another checkout, whose steps are flown in turns with ours"
    )
    parser.add_argument("--repetitions", type=int, default=5, help="of these turns (default 5)")
    arguments = parser.parse_args()
    if arguments.beside:
        _compare(arguments.beside, arguments.repetitions, arguments.json)
        return
    found = measure(arguments.seconds)
    if arguments.json:
        json.dump({"machine": machine(), "rates": found, "ratios": ratios(found)}, sys.stdout, indent=2)
        print()
        return
    columns = ["control steps/s", "substeps/s", "simulated s/s"]
    rows = [[name, *(f"{row[column]:,.0f}" for column in columns)] for name, row in found.items()]
    print(machine(), end="\n\n")
    print(format_table(["", *columns], rows), end="\n\n")
    for name, ratio in ratios(found).items():
        print(f"{name}: {ratio:.2f}")


if __name__ == "__main__":
    main()
