"""RLlib's PPO on a local Ray: one network for all vehicles of `quad/Formation-v0`.

    make rllib

makes `.venv-rllib` and runs `python -m examples.rllib_formation` there: RLlib pins gymnasium 1.2.2, so
it needs an environment of its own. For a cluster give `ray.init` its address.
"""

import argparse

import ray
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.tune.registry import register_env

from quad_envs import formation_v0

TEAM = {"vehicles": 3, "formation": "triangle", "max_cycles": 100}


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--iterations", type=int, default=5)
    parser.add_argument("--batch", type=int, default=2000, help="steps of the team in each iteration")
    parser.add_argument("--runners", type=int, default=1, help="processes that fly")
    options = parser.parse_args()

    ray.init(num_cpus=options.runners + 1, include_dashboard=False, log_to_driver=False)
    register_env("formation", lambda config: ParallelPettingZooEnv(formation_v0.parallel_env(**config)))
    config = (
        PPOConfig()
        .environment("formation", env_config=TEAM)
        # The first flight compiles the kernels, which takes longer than RLlib's patience of a minute.
        .env_runners(num_env_runners=options.runners, sample_timeout_s=600.0)
        .multi_agent(policies={"shared"}, policy_mapping_fn=lambda agent, episode, **_: "shared")
        .training(
            lr=5e-4,
            gamma=0.99,
            lambda_=0.98,
            num_epochs=5,
            minibatch_size=500,
            train_batch_size_per_learner=options.batch,
        )
    )
    algorithm = config.build_algo()
    for _ in range(options.iterations):
        found = algorithm.train()["env_runners"]
        steps, score = found["num_env_steps_sampled_lifetime"], found["episode_return_mean"]
        score /= TEAM["vehicles"] * TEAM["max_cycles"]
        print(f"{steps:.0f} steps, score {score:.4f}, length {found['episode_len_mean']:.1f}", flush=True)
    algorithm.stop()
    ray.shutdown()


if __name__ == "__main__":
    main()
