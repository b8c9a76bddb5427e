"""TorchRL's `GymEnv`, `GymWrapper` and `PettingZooWrapper`: checks, rollouts, a few updates of PPO.

    python -m examples.torchrl_ppo [--updates 20]

TorchRL prefers vector environments that reset nothing themselves: `autoreset_mode="Disabled"`;
"SameStep" works, too, Gymnasium's default "NextStep" it refuses. Its reader of infos takes arrays, which
vector environments have and `quad_envs.ArrayInfo` makes of a single one's numbers.
"""

import argparse

import gymnasium as gym
import torch
from tensordict.nn import TensorDictModule
from tensordict.nn.distributions import NormalParamExtractor
from torch import nn
from torchrl.envs import GymEnv, GymWrapper, PettingZooWrapper, check_env_specs
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import quad_envs  # noqa: F401  registers the ids
from quad_envs import ArrayInfo, formation_v0

HELIX = "quad/HelixTracking-v0"


def check():
    """One vehicle, many vehicles with their constraint signal, and a team."""
    single = GymEnv(HELIX)
    check_env_specs(single)
    print("GymEnv:", single.rollout(200)["next", "reward"].shape)

    told = GymWrapper(ArrayInfo(gym.make(HELIX))).auto_register_info_dict()
    check_env_specs(told)
    print("ArrayInfo: stage cost", float(told.rollout(200)["next", "stage_cost"].mean()))

    many = GymWrapper(gym.make_vec(HELIX, num_envs=64, autoreset_mode="Disabled")).auto_register_info_dict()
    check_env_specs(many)
    flown = many.rollout(50, break_when_any_done=False)
    print("GymWrapper:", flown["next", "observation"].shape, "cost", float(flown["next", "cost"].mean()))

    team = PettingZooWrapper(formation_v0.parallel_env(vehicles=3, formation="triangle"))
    check_env_specs(team)
    print("PettingZooWrapper:", team.rollout(50)["next", "quad", "reward"].shape)


def train(updates):
    """PPO of TorchRL's parts on 256 flights; prints the mean reward of each rollout."""
    envs = GymWrapper(gym.make_vec(HELIX, num_envs=256, autoreset_mode="Disabled"))
    n, m = envs.observation_spec["observation"].shape[-1], envs.action_spec.shape[-1]
    body = nn.Sequential(MLP(n, 2 * m, num_cells=[64, 64], activation_class=nn.Tanh), NormalParamExtractor())
    head = TensorDictModule(body, in_keys=["observation"], out_keys=["loc", "scale"])
    actor = ProbabilisticActor(
        head, in_keys=["loc", "scale"], distribution_class=TanhNormal, return_log_prob=True
    )
    critic = ValueOperator(MLP(n, 1, num_cells=[64, 64], activation_class=nn.Tanh))
    loss = ClipPPOLoss(actor, critic, entropy_bonus=False)
    advantage = GAE(gamma=0.99, lmbda=0.98, value_network=critic)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    for update in range(updates):
        with torch.no_grad():
            data = advantage(envs.rollout(64, actor, break_when_any_done=False))
        reward, rows = data["next", "reward"].mean(), data.reshape(-1)
        for batch in (b for _ in range(4) for b in torch.randperm(len(rows)).split(4096)):
            parts = loss(rows[batch])
            optimizer.zero_grad()
            (parts["loss_objective"] + parts["loss_critic"]).backward()
            optimizer.step()
        print(f"update {update + 1}: mean reward {float(reward):.4f}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--updates", type=int, default=20)
    torch.set_num_threads(1)
    check()
    train(parser.parse_args().updates)
