"""Speed of training: `python -m benchmarks.train [--rows 512] [--repetitions 5] [--json]`.

Environment steps per CPU-second on one thread, best of the repetitions: PPO as it trains on the helix, which
is rollouts and optimiser; its rollouts alone; and the same over stable-baselines3's DummyVecEnv of as many
single environments, which scale nothing and are wrapped in nothing. The three take turns.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping
from time import process_time

from .timing import machine, one_thread

one_thread()

import gymnasium  # noqa: E402
import torch  # noqa: E402
from stable_baselines3 import PPO  # noqa: E402
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv  # noqa: E402

from baselines.evaluation.table import format_table  # noqa: E402
from baselines.training.sb3 import PpoOptions, make_flights, make_ppo  # noqa: E402
from quad_envs.envs.tracking.options import TrackingOptions  # noqa: E402
from quad_envs.registration import TRACKING  # noqa: E402

ENV_ID = "quad/HelixTracking-v0"
PPO_GOAL = 55_000.0  # steps per CPU-second
ROLLOUT_GOAL = 2.5  # times DummyVecEnv


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


def main(arguments: list[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rows", type=int, default=512, help="flights at once")
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--json", action="store_true", help="print machine-readable results")
    chosen = parser.parse_args(arguments)
    torch.set_num_threads(1)
    found = measure(chosen.rows, chosen.repetitions)
    if chosen.json:
        print(json.dumps({"machine": machine(), "rows": chosen.rows, **found}))
        return 0
    goals = {"PPO": f"{PPO_GOAL:,.0f}", "ratio of rollouts": f"{ROLLOUT_GOAL:g}"}
    lines = [
        [name, f"{value:,.0f}" if value > 100 else f"{value:.2f}", goals.get(name, "")]
        for name, value in found.items()
    ]
    print(f"{machine()}; {chosen.rows} flights, steps per CPU-second")
    print(format_table(["what", "value", "goal"], lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
