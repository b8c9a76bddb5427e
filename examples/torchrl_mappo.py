"""TorchRL's MAPPO on `quad/Formation-v0` as PettingZoo has it: one actor, and a critic that sees the team.

    python -m examples.torchrl_mappo [--seconds 60] [--vehicles 3] [--formation triangle]

`PettingZooWrapper(..., return_state=True)` makes tensordicts of a team: rows of its vehicles under "quad",
its `state()` beside them. The actor decides from a vehicle's own row, the critic from all rows and the state.
Prints the reward while training, then the score of 10 held-out teams beside that of `consensus-mpc`.
"""

import argparse
import time

import numpy as np
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs import PettingZooWrapper
from torchrl.modules import MLP, MultiAgentMLP, ProbabilisticActor, TanhNormal
from torchrl.objectives import ClipPPOLoss, ValueEstimators

from baselines import evaluate, make_policy
from quad_envs import formation_v0

STEPS, EPOCHS, BATCH, GAMMA, TRACE, RATE = 1000, 5, 250, 0.99, 0.98, 3e-4
ROWS, ACTION, VALUE = ("quad", "observation"), ("quad", "action"), ("quad", "state_value")
LAYERS = {"num_cells": [64, 64], "activation_class": nn.Tanh}


class Scale(nn.Module):
    """Running mean and deviation of the last axis."""

    def __init__(self, n):
        super().__init__()
        self.register_buffer("mean", torch.zeros(n))
        self.register_buffer("var", torch.ones(n))
        self.count = 1e-4

    def learn(self, x):
        x = x.reshape(-1, x.shape[-1]).float()
        share, mean = len(x) / (self.count + len(x)), x.mean(0)
        self.var += share * (x.var(0, unbiased=False) - self.var + (1 - share) * (mean - self.mean) ** 2)
        self.mean += share * (mean - self.mean)
        self.count += len(x)

    def forward(self, x):
        return ((x.float() - self.mean) / (self.var + 1e-6).sqrt()).clamp(-10, 10)


class Actor(nn.Module):
    """Of every vehicle the same: from its row to a normal distribution. `predict` makes it a policy."""

    def __init__(self, row, action):
        super().__init__()
        self.scale, self.net = Scale(row), MLP(row, action, **LAYERS)
        self.net[-1].weight.data *= 0.01  # begins at hover
        self.net[-1].bias.data.zero_()
        self.log_std = nn.Parameter(torch.full((action,), -2.0))

    def forward(self, rows):
        loc = self.net(self.scale(rows))
        return loc, self.log_std.exp().expand_as(loc)

    @torch.no_grad()
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return torch.tanh(self(torch.as_tensor(np.asarray(observation)))[0]).numpy(), None


class Critic(nn.Module):
    """A value for each vehicle from the rows of all and the state of the team."""

    def __init__(self, row, state, vehicles):
        super().__init__()
        self.rows, self.state = Scale(row), Scale(state)
        self.net = MultiAgentMLP(row + state, 1, vehicles, centralized=True, share_params=True, **LAYERS)

    def forward(self, rows, state):
        state = self.state(state).unsqueeze(-2).expand(*rows.shape[:-1], -1)
        return self.net(torch.cat([self.rows(rows), state], dim=-1))


def make_loss(actor, critic, env):
    """The parts, as TorchRL wants them."""
    policy = ProbabilisticActor(
        TensorDictModule(actor, in_keys=[ROWS], out_keys=[("quad", "loc"), ("quad", "scale")]),
        spec=env.full_action_spec[ACTION],
        in_keys=[("quad", "loc"), ("quad", "scale")],
        out_keys=[ACTION],
        distribution_class=TanhNormal,
        return_log_prob=True,
        log_prob_key=("quad", "log_prob"),
    )
    value = TensorDictModule(critic, in_keys=[ROWS, "state"], out_keys=[VALUE])
    normal = {"normalize_advantage": True, "normalize_advantage_exclude_dims": (-1,)}
    loss = ClipPPOLoss(policy, value, clip_epsilon=0.2, entropy_bonus=False, **normal)
    loss.set_keys(
        action=ACTION,
        value=VALUE,
        sample_log_prob=("quad", "log_prob"),
        **{name: ("quad", name) for name in ("reward", "done", "terminated", "advantage", "value_target")},
    )
    loss.make_value_estimator(ValueEstimators.GAE, gamma=GAMMA, lmbda=TRACE)
    return policy, loss


def train(seconds, seed, **team):
    """MAPPO for some CPU-seconds; the actor."""
    torch.manual_seed(seed)
    env = PettingZooWrapper(formation_v0.parallel_env(max_cycles=100, **team), return_state=True, seed=seed)
    first = env.reset()
    vehicles, row = first[ROWS].shape
    actor = Actor(row, env.full_action_spec[ACTION].shape[-1])
    critic = Critic(row, first["state"].shape[-1], vehicles)
    policy, loss = make_loss(actor, critic, env)
    optimizer = torch.optim.Adam(loss.parameters(), lr=RATE)
    begin, steps = time.process_time(), 0
    while (spent := time.process_time() - begin) < seconds:
        for group in optimizer.param_groups:
            group["lr"] = RATE * (1 - 0.95 * spent / seconds)
        with torch.no_grad():
            data = env.rollout(STEPS, policy, break_when_any_done=False)
            loss.value_estimator(
                data, params=loss.critic_network_params, target_params=loss.target_critic_network_params
            )
        for batch in (b for _ in range(EPOCHS) for b in torch.randperm(STEPS).split(BATCH)):
            parts = loss(data[batch])
            optimizer.zero_grad()
            (parts["loss_objective"] + parts["loss_critic"]).backward()
            nn.utils.clip_grad_norm_(loss.parameters(), 10.0)
            optimizer.step()
        for scale, seen in ((actor.scale, ROWS), (critic.rows, ROWS), (critic.state, "state")):
            scale.learn(data[seen])
        steps += STEPS * vehicles
        reward = float(data["next", "quad", "reward"].mean())
        print(f"{steps} steps, {time.process_time() - begin:.0f} CPU-s, reward {reward:.4f}", flush=True)
    return actor


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=60.0, help="of CPU time")
    parser.add_argument("--vehicles", type=int, default=3)
    parser.add_argument("--formation", default="triangle")
    parser.add_argument("--seed", type=int, default=0)
    o = parser.parse_args()
    torch.set_num_threads(1)
    team = {"vehicles": o.vehicles, "formation": o.formation}
    learned, flown = train(o.seconds, o.seed, **team), formation_v0.parallel_env(**team)
    for name, policy in (("mappo", learned), ("consensus-mpc", make_policy("consensus-mpc", flown))):
        found = evaluate(policy, flown, episodes=10, seed=10_000)
        score, crashed = found.summary()["score"], sum(record.crashed for record in found.records)
        print(f"{name}: score {score.mean:.3f} +- {score.half_width:.3f}, {crashed} vehicles crashed")
