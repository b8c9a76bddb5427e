"""Behaviour cloning from a Minari dataset, flown from starts that the dataset has not seen.

    python -m examples.behaviour_cloning --record 50
    python -m examples.behaviour_cloning [--dataset quad/corridor/expert-v0] [--epochs 40] [--seed 0]

The first line records flights of exact NMPC in the corridor first, as `quad-envs record` does.

Prints the score of the network on 20 held-out starts beside that of the dataset's own flights, and how much
either breaks the limits: a network that imitates keeps none by itself.
"""

import argparse

import gymnasium as gym
import minari
import numpy as np
import torch
from torch import nn

import quad_envs  # noqa: F401  registers the ids
from baselines import evaluate, record

HIDDEN, BATCH, RATE, HELD_OUT = 128, 256, 1e-3, 10_000


class Clone:
    """A network that imitates; `predict` makes it a policy like any other of the suite."""

    def __init__(self, observations, actions):
        self.mean, self.std = observations.mean(0), observations.std(0) + 0.1
        n, m = observations.shape[1], actions.shape[1]
        layers = [nn.Linear(n, HIDDEN), nn.Tanh(), nn.Linear(HIDDEN, HIDDEN), nn.Tanh(), nn.Linear(HIDDEN, m)]
        self.network = nn.Sequential(*layers)

    def seen(self, observations):
        return torch.as_tensor((observations - self.mean) / self.std, dtype=torch.float32)

    @torch.no_grad()
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.clip(self.network(self.seen(observation)).numpy(), -1.0, 1.0), state

    def fit(self, observations, actions, epochs):
        x, y = self.seen(observations), torch.as_tensor(actions)
        optimizer = torch.optim.Adam(self.network.parameters(), lr=RATE)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, epochs)
        for _ in range(epochs):
            for batch in torch.randperm(len(x)).split(BATCH):
                loss = (self.network(x[batch]) - y[batch]).square().mean()
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
            schedule.step()
        return float(loss.detach())


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--dataset", default="quad/corridor/expert-v0")
    parser.add_argument("--epochs", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--record", type=int, default=0, help="episodes of nmpc to record first")
    options = parser.parse_args()
    if options.record:
        record(gym.make("quad/CorridorTracking-v0"), "nmpc", options.dataset, episodes=options.record)
    torch.manual_seed(options.seed)
    dataset = minari.load_dataset(options.dataset)
    flights, env = list(dataset.iterate_episodes()), dataset.recover_environment()
    observations = np.concatenate([flight.observations[:-1] for flight in flights])
    actions = np.concatenate([flight.actions for flight in flights])
    steps = env.unwrapped.task.episode_steps
    returns = [flight.rewards.sum() / steps for flight in flights]
    costs = [flight.infos["cost"][1:].sum() for flight in flights]
    print(f"{dataset.id}: score {np.mean(returns):.3f}, constraint cost {np.mean(costs):.2f}")
    clone = Clone(observations, actions)
    print(f"{len(actions)} pairs, loss {clone.fit(observations, actions, options.epochs):.2e}")
    found = evaluate(clone, env, episodes=20, seed=HELD_OUT)
    score, violating = found.summary()["score"], found.summary()["violation_share"]
    print(
        f"clone: score {score.mean:.3f} +- {score.half_width:.3f}, steps that break a limit "
        f"{100 * violating.mean:.0f} %, crashes {sum(record.crashed for record in found.records)} of 20"
    )


if __name__ == "__main__":
    main()
