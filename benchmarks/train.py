"""Speed of training: `python -m benchmarks.train [--rows 512] [--beside CHECKOUT] [--json]`.

Environment steps per CPU-second on one thread, best of the repetitions: PPO as it trains on the helix, which
is rollouts and optimiser; its rollouts alone; and the same over stable-baselines3's DummyVecEnv of as many
single environments, which scale nothing and are wrapped in nothing. The three take turns. Then the hyperbolic
tangent of the layers beside torch's and numpy's, in place, which cost more where there is no AVX-512.
With `--beside`, PPO of this checkout and of another one take turns, and learn the helix with the same seeds.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from time import process_time
from typing import Any

from .timing import machine, one_thread

one_thread()

import gymnasium  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
from stable_baselines3 import PPO  # noqa: E402
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv  # noqa: E402

from baselines.evaluation.table import format_table  # noqa: E402
from baselines.policies.tanh import tanh_in_place  # noqa: E402
from baselines.training.sb3 import PpoOptions, make_flights, make_ppo  # noqa: E402
from quad_envs.envs.tracking.options import TrackingOptions  # noqa: E402
from quad_envs.registration import TRACKING  # noqa: E402

from .checkouts import ENV_ID, SHARES, curve, update_rates  # noqa: E402
from .turns import HERE  # noqa: E402

PPO_GOAL = 55_000.0  # steps per CPU-second
ROLLOUT_GOAL = 2.5  # times DummyVecEnv
BESIDE_GOAL = 1.15  # times PPO of the checkout before


def _flights(options: PpoOptions) -> VecEnv:
    task = TrackingOptions.from_kwargs({"env_id": ENV_ID, **TRACKING[ENV_ID]})
    return make_flights(task, options, 0)


def _learner(env: VecEnv, options: PpoOptions, optimise: bool) -> Callable[[], object]:
    """One update, with or without its optimisation."""
    model: PPO = make_ppo(env, options, 0, lambda: 0.0)
    if not optimise:
        model.train = lambda: None  # type: ignore[method-assign]
    return lambda: model.learn(
        env.num_envs * options.n_steps, reset_num_timesteps=False, log_interval=1_000_000
    )


def best_rates(
    candidates: Mapping[str, Callable[[], object]], steps: int, repetitions: int
) -> dict[str, float]:
    """Steps per CPU-second of each, best of so many turns."""
    best = dict.fromkeys(candidates, 0.0)
    for call in candidates.values():
        call()  # compile and warm up
    for _ in range(repetitions):
        for name, call in candidates.items():
            begin = process_time()
            call()
            best[name] = max(best[name], steps / (process_time() - begin))
    return best


def measure(rows: int, repetitions: int) -> dict[str, float]:
    """Steps per CPU-second, and the ratio of the rollouts."""
    options = PpoOptions(n_envs=rows)
    single = DummyVecEnv([lambda: gymnasium.make(ENV_ID) for _ in range(rows)])
    found = best_rates(
        {
            "PPO": _learner(_flights(options), options, True),
            "rollouts": _learner(_flights(options), options, False),
            "rollouts, DummyVecEnv": _learner(single, options, False),
        },
        rows * options.n_steps,
        repetitions,
    )
    return {**found, "ratio of rollouts": found["rollouts"] / found["rollouts, DummyVecEnv"]}


def _said(value: Any) -> str:
    if isinstance(value, list):
        return f"{np.mean(value):.3f}  ({', '.join(f'{one:.3f}' for one in value)})"
    return f"{value:,.0f}" if value > 100 else f"{value:.2f}"


def tangents(repetitions: int) -> dict[str, float]:
    """Nanoseconds per element of the layers of a minibatch, in place, best of the repetitions."""
    x = np.random.default_rng(0).normal(size=4096 * 64).astype(np.float32)
    copies = [x.copy() for _ in range(3)]
    calls: dict[str, Callable[[], object]] = {
        "tanh, ns": lambda: tanh_in_place(copies[0]),
        "tanh of torch, ns": lambda: torch.from_numpy(copies[1]).tanh_(),
        "tanh of numpy, ns": lambda: np.tanh(copies[2], out=copies[2]),
    }
    found = best_rates(calls, x.size, 10 * repetitions)
    return {name: 1e9 / rate for name, rate in found.items()}


def beside(other: Path, chosen: argparse.Namespace) -> dict[str, Any]:
    """PPO here and in another checkout: steps per CPU-second, and mean scores of the same seeds."""
    here, there = update_rates(other, chosen.rows, 2 * chosen.repetitions)
    found: dict[str, Any] = {"PPO here": here, "PPO there": there, "ratio of PPO": here / there}
    scores = {
        name: [curve(checkout, seed, chosen.steps) for seed in range(chosen.seeds)]
        for name, checkout in (("here", HERE), ("there", other))
        if chosen.seeds
    }
    for name, curves in scores.items():
        for k, share in enumerate(SHARES):
            found[f"score {name} after {share:g}"] = [one[k] for one in curves]
    return found


def main(arguments: list[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rows", type=int, default=512, help="flights at once")
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--beside", type=Path, help="another checkout of this suite", metavar="CHECKOUT")
    parser.add_argument("--seeds", type=int, default=3, help="trainings of each checkout, with --beside")
    parser.add_argument("--steps", type=int, default=1_500_000, help="of each of them")
    parser.add_argument("--json", action="store_true", help="print machine-readable results")
    chosen = parser.parse_args(arguments)
    torch.set_num_threads(1)
    found: dict[str, Any] = {**measure(chosen.rows, chosen.repetitions), **tangents(chosen.repetitions)}
    if chosen.beside is not None:
        found |= beside(chosen.beside.resolve(), chosen)
    if chosen.json:
        print(json.dumps({"machine": machine(), "rows": chosen.rows, **found}))
        return 0
    goals = {
        "PPO": f"{PPO_GOAL:,.0f}",
        "ratio of rollouts": f"{ROLLOUT_GOAL:g}",
        "ratio of PPO": f"{BESIDE_GOAL:g}",
    }
    lines = [[name, _said(value), goals.get(name, "")] for name, value in found.items()]
    print(f"{machine()}; {chosen.rows} flights, steps per CPU-second")
    print(format_table(["what", "value", "goal"], lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
