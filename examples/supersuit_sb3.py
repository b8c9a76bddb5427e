"""SuperSuit makes one SB3 VecEnv of several teams: PPO with one network for all vehicles.

    python -m examples.supersuit_sb3 [--steps 50000] [--terminate agent]

SuperSuit wants every agent to stay until the episode ends. With `terminate="team"` (the default here)
that holds. With `terminate="agent"` a crashed vehicle leaves alone, and `black_death_v3` fills its row
with zeros. SuperSuit's VecEnv cannot be seeded: SB3's `seed=` fails with it.
"""

import argparse

import supersuit
import torch
from stable_baselines3 import PPO

from baselines import evaluate, make_policy
from quad_envs import formation_v0

TEAM = {"vehicles": 3, "formation": "triangle"}


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=50_000, help="of agents")
    parser.add_argument("--terminate", choices=["team", "agent"], default="team")
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)

    team = formation_v0.parallel_env(**TEAM, terminate=options.terminate)
    if options.terminate == "agent":
        team = supersuit.black_death_v3(team)
    rows = supersuit.pettingzoo_env_to_vec_env_v1(team)
    envs = supersuit.concat_vec_envs_v1(rows, 4, num_cpus=1, base_class="stable_baselines3")
    print(f"{envs.num_envs} rows, observations {envs.observation_space.shape}")

    model = PPO("MlpPolicy", envs, n_steps=128, batch_size=512, gae_lambda=0.98, device="cpu")
    model.learn(options.steps)

    # The network is a policy of the suite as it is: one row for each agent.
    flown = formation_v0.parallel_env(**TEAM)
    for name, policy in {"ppo": model, "consensus-mpc": make_policy("consensus-mpc", flown)}.items():
        found = evaluate(policy, flown, episodes=5, seed=1000)
        print(f"{name}: score {found.summary()['score'].mean:.3f}")


if __name__ == "__main__":
    main()
