"""Stable-Baselines3's own tools on an unmodified id: PPO at its defaults, and an MPC in `evaluate_policy`.

    python -m examples.sb3_tools [--env quad/HelixTracking-v0] [--steps 100000]

PPO learns under `FilterAndRescale`; `sb3(model)` flies what it learned in the id as it is, beside the MPC.
"""

import argparse

import gymnasium as gym
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

import quad_envs  # noqa: F401  registers the ids
from baselines import make_policy, sb3
from quad_envs.wrappers import FilterAndRescale


def report(name, policy, envs, steps):
    """Mean return of an episode over its full length: the score."""
    envs.seed(1000)
    mean, spread = evaluate_policy(policy, envs, n_eval_episodes=20)
    print(f"{name}: score {mean / steps:.3f}, standard deviation {spread / steps:.3f}")


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--env", default="quad/HelixTracking-v0")
    parser.add_argument("--steps", type=int, default=100_000)
    options = parser.parse_args()
    torch.set_num_threads(1)

    env = gym.make(options.env)
    check_env(env)
    check_env(FilterAndRescale(env))
    steps = env.unwrapped.task.episode_steps
    envs = make_vec_env(options.env, n_envs=10)
    learning = make_vec_env(options.env, seed=0, wrapper_class=FilterAndRescale)

    model = PPO("MlpPolicy", learning, seed=0, device="cpu").learn(options.steps)
    report(f"ppo after {options.steps} steps", model, learning, steps)
    report("the same, from the id's own observations", sb3(model), envs, steps)
    report("lmpc", make_policy("lmpc", env), envs, steps)


if __name__ == "__main__":
    main()
