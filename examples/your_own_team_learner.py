"""A multi-agent learner of one's own in one file, in the style of CleanRL: MAPPO on `vector_env`.

    python -m examples.your_own_team_learner [--vehicles 3] [--formation triangle] [--steps 2000000]

One actor for all vehicles sees each one's row, the critic sees that and the `state()` of the team. Prints the
score while training, then that of 20 held-out teams beside `consensus-mpc`.
"""

import argparse
import time

import numpy as np
import torch
from torch import nn

from baselines import evaluate, make_policy
from quad_envs import formation_v0

TEAMS, T, EPOCHS, BATCH, GAMMA, TRACE, CLIP, RATE = 128, 32, 5, 4096, 0.99, 0.98, 0.2, 1e-3
STEPS = 100  # of an episode in training: vehicles meet early, and short ones show more of that


def around_hover(action):
    """A third of the upward half: both halves of the outputs then mean rotor forces of hover +- mg/2."""
    return np.clip(np.where(action > 0, action / 3, action), -1, 1).astype(np.float32)


def f32(x):
    return torch.as_tensor(x, dtype=torch.float32)


def mlp(n, m):
    return nn.Sequential(nn.Linear(n, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, m))


class Scale:
    """Running mean and deviation of columns."""

    def __init__(self, n):
        self.mean, self.var, self.count = np.zeros(n), np.ones(n), 1e-4

    def see(self, x, learn=True):
        if learn:
            share, mean = len(x) / (self.count + len(x)), x.mean(axis=0)
            self.var += share * (x.var(axis=0) - self.var + (1 - share) * (mean - self.mean) ** 2)
            self.mean += share * (mean - self.mean)
            self.count += len(x)
        return f32(np.clip((x - self.mean) / np.sqrt(self.var + 1e-6), -10, 10))


class Agent(nn.Module):
    """Actor and critic. `predict` makes it a policy of a team like any other of the suite."""

    def __init__(self, rows, state, m):
        super().__init__()
        self.actor, self.critic = mlp(rows, m), mlp(rows + state, 1)
        self.log_std, self.rows, self.state = nn.Parameter(torch.full((m,), -2.0)), Scale(rows), Scale(state)
        self.actor[-1].weight.data *= 0.01

    def pi(self, x):
        return torch.distributions.Normal(self.actor(x), self.log_std.exp())

    @torch.no_grad()
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return around_hover(self.actor(self.rows.see(np.asarray(observation), learn=False)).numpy()), None


def update(agent, optimizer, x, z, a, logp, adv, returns):
    """PPO's epochs over the steps of one rollout."""
    for _ in range(EPOCHS):
        for b in torch.randperm(len(x)).split(BATCH):
            ratio = (agent.pi(x[b]).log_prob(a[b]).sum(-1) - logp[b]).exp()
            gain = (adv[b] - adv[b].mean()) / (adv[b].std() + 1e-8)
            actor_loss = -torch.min(gain * ratio, gain * ratio.clamp(1 - CLIP, 1 + CLIP)).mean()
            loss = actor_loss + 0.5 * (agent.critic(z[b])[:, 0] - returns[b]).square().mean()
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 10.0)
            optimizer.step()


def train(steps, seed, **team):
    torch.manual_seed(seed)
    envs = formation_v0.vector_env(num_teams=TEAMS, terminate="agent", max_cycles=STEPS, **team)
    size, rows = envs.task.vehicles, envs.num_envs
    n, m = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
    observations, start = envs.reset(seed=seed)[0], time.time()
    agent, updates = Agent(n, envs.state().shape[1], m), max(1, steps // (rows * T))
    optimizer = torch.optim.Adam(agent.parameters(), lr=RATE, eps=1e-5)
    X, A = torch.zeros(T, rows, n), torch.zeros(T, rows, m)
    Z = torch.zeros(T, rows, n + envs.state().shape[1])
    logp, R, V, gone, done, live = torch.zeros(6, T, rows)
    flies, over = np.ones(rows, bool), np.zeros(rows, bool)  # whose row is told of a vehicle; who is done

    def seen(observations):
        x, state = agent.rows.see(observations), agent.state.see(envs.state())
        return x, torch.cat([x, state.repeat_interleave(size, dim=0)], dim=1)

    x, z = seen(observations)
    for u in range(updates):
        optimizer.param_groups[0]["lr"] = RATE * (1 - 0.95 * u / updates)
        for t in range(T):
            begins = np.repeat(over.reshape(-1, size).all(axis=1), size)  # this step only resets these teams
            X[t], Z[t], live[t] = x, z, f32(flies & ~begins)
            with torch.no_grad():
                pi, V[t] = agent.pi(x), agent.critic(z)[:, 0]
                A[t] = pi.sample()
            logp[t] = pi.log_prob(A[t]).sum(-1)
            observations, reward, terminated, truncated, infos = envs.step(around_hover(A[t].numpy()))
            x, z = seen(observations)
            flies, over = infos["alive"], terminated | truncated
            R[t], gone[t], done[t] = f32(reward), f32(terminated), f32(over)
        with torch.no_grad():  # after a truncation V of the final state goes on, as NEXT_STEP shows it
            ahead, last, G = agent.critic(z)[:, 0], torch.zeros(rows), torch.zeros(T, rows)
            for t in reversed(range(T)):
                last = R[t] + GAMMA * ahead * (1 - gone[t]) - V[t] + GAMMA * TRACE * (1 - done[t]) * last
                G[t], ahead = last, V[t]
        kept = live == 1  # vehicles that crashed are no more until their team begins anew
        update(agent, optimizer, X[kept], Z[kept], A[kept], logp[kept], G[kept], (G + V)[kept])
        if u % 10 == 9 or u == updates - 1:
            said = f"{(u + 1) * rows * T:9d} steps, {time.time() - start:4.0f} s"
            print(f"{said}, reward {R[kept].mean():.3f}", flush=True)
    return agent


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--vehicles", type=int, default=3)
    parser.add_argument("--formation", default="triangle")
    parser.add_argument("--steps", type=int, default=2_000_000)
    parser.add_argument("--seed", type=int, default=0)
    o = parser.parse_args()
    team = {"vehicles": o.vehicles, "formation": o.formation}
    learned, env = train(o.steps, o.seed, **team), formation_v0.parallel_env(**team)
    for name, policy in (("mappo", learned), ("consensus-mpc", make_policy("consensus-mpc", env))):
        found = evaluate(policy, env, episodes=20, seed=10_000)
        score, crashed = found.summary()["score"], sum(record.crashed for record in found.records)
        print(f"{name}: score {score.mean:.3f} +- {score.half_width:.3f}, {crashed} vehicles crashed")
