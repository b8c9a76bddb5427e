"""Stable-Baselines3's own tools on an unmodified id: a short PPO, and an MPC in `evaluate_policy`.

    python -m examples.sb3_tools [--env quad/HelixTracking-v0] [--steps 20000]

So few steps teach nothing yet; this shows the tools. `quad-envs train` has a batched VecEnv and
settings that learn.
"""

import argparse

import gymnasium as gym
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

import quad_envs  # noqa: F401  registers the ids
from baselines import make_policy


def report(name, policy, envs, steps):
    """Mean return of an episode over its full length: the score."""
    envs.seed(1000)
    mean, spread = evaluate_policy(policy, envs, n_eval_episodes=20)
    print(f"{name}: score {mean / steps:.3f}, standard deviation {spread / steps:.3f}")


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--env", default="quad/HelixTracking-v0")
    parser.add_argument("--steps", type=int, default=20_000)
    options = parser.parse_args()
    torch.set_num_threads(1)

    env = gym.make(options.env)
    check_env(env)
    steps = env.unwrapped.task.episode_steps
    envs = make_vec_env(options.env, n_envs=10, seed=0)

    model = PPO("MlpPolicy", envs, n_steps=200, batch_size=500, gae_lambda=0.98, seed=0, device="cpu")
    report("ppo before training", model, envs, steps)
    model.learn(options.steps)
    report(f"ppo after {options.steps} steps", model, envs, steps)
    report("lmpc", make_policy("lmpc", env), envs, steps)


if __name__ == "__main__":
    main()
