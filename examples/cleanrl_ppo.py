"""PPO in one file, in the style of CleanRL, on `gym.make_vec` and Gymnasium's own vector wrappers.

    python -m examples.cleanrl_ppo [--env quad/HelixTracking-v0] [--steps 4000000] [--seed 0]

Prints the score while training, then that of 20 held-out starts beside LMPC's.
"""

import argparse
import time

import gymnasium as gym
import numpy as np
import torch
from gymnasium.wrappers.vector import NormalizeObservation, RecordEpisodeStatistics, TransformAction
from torch import nn

import quad_envs  # noqa: F401  registers the ids
from baselines import evaluate, make_policy

N, T, EPOCHS, BATCH, GAMMA, TRACE, CLIP, RATE = 256, 64, 5, 4096, 0.99, 0.98, 0.2, 1e-3
PREVIEW = 5  # stages of the reference that the network sees; LMPC sees 25


def around_hover(action):
    """A third of the upward half: both halves of the outputs then mean rotor forces of hover +- mg/4."""
    return np.clip(np.where(action > 0, action / 3, action), -1, 1).astype(np.float32)


def f32(x):
    return torch.as_tensor(x, dtype=torch.float32)


def mlp(n, m):
    return nn.Sequential(nn.Linear(n, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, m))


class Agent(nn.Module):
    """Actor and critic. `predict` makes it a policy like any other of the suite."""

    def __init__(self, n, m):
        super().__init__()
        self.actor, self.critic, self.log_std = mlp(n, m), mlp(n, 1), nn.Parameter(torch.full((m,), -1.2))
        self.actor[-1].weight.data *= 0.01

    def pi(self, x):
        return torch.distributions.Normal(self.actor(x), self.log_std.exp())

    @torch.no_grad()
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        x = f32((observation - self.mean) / self.std)
        return around_hover(self.actor(x).numpy()), None


def update(agent, optimizer, x, a, logp, adv, returns):
    """PPO's epochs over the steps of one rollout."""
    for _ in range(EPOCHS):
        for b in torch.randperm(len(x)).split(BATCH):
            ratio = (agent.pi(x[b]).log_prob(a[b]).sum(-1) - logp[b]).exp()
            gain = (adv[b] - adv[b].mean()) / (adv[b].std() + 1e-8)
            actor_loss = -torch.min(gain * ratio, gain * ratio.clamp(1 - CLIP, 1 + CLIP)).mean()
            loss = actor_loss + 0.5 * (agent.critic(x[b])[:, 0] - returns[b]).square().mean()
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
            optimizer.step()


def train(env_id, steps, seed):
    torch.manual_seed(seed)
    envs = RecordEpisodeStatistics(gym.make_vec(env_id, num_envs=N, preview=PREVIEW))
    assert envs.metadata["autoreset_mode"] is gym.vector.AutoresetMode.NEXT_STEP
    envs = normalized = NormalizeObservation(TransformAction(envs, around_hover))
    n, m = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
    agent, updates, scores = Agent(n, m), max(1, steps // (N * T)), []
    optimizer = torch.optim.Adam(agent.parameters(), lr=RATE, eps=1e-5)
    X, A = torch.zeros(T, N, n), torch.zeros(T, N, m)
    logp, R, V, gone, done, resets = torch.zeros(6, T, N)
    x, ended, start = f32(envs.reset(seed=seed)[0]), torch.zeros(N), time.time()
    for u in range(updates):
        optimizer.param_groups[0]["lr"] = RATE * (1 - 0.95 * u / updates)
        for t in range(T):
            X[t], resets[t] = x, ended  # a step after an episode's end only resets it: nothing to learn there
            with torch.no_grad():
                pi, V[t] = agent.pi(x), agent.critic(x)[:, 0]
                A[t] = pi.sample()
            logp[t] = pi.log_prob(A[t]).sum(-1)
            x, reward, terminated, truncated, infos = envs.step(A[t].numpy())
            x, ended = f32(x), f32(terminated | truncated)
            R[t], gone[t], done[t] = f32(reward), f32(terminated), ended
            if "episode" in infos:
                scores.extend(infos["episode"]["r"][infos["_episode"]] / envs.unwrapped.task.episode_steps)
        with torch.no_grad():  # after a truncation V of the final observation goes on, as NEXT_STEP shows it
            ahead, last, G = agent.critic(x)[:, 0], torch.zeros(N), torch.zeros(T, N)
            for t in reversed(range(T)):
                last = R[t] + GAMMA * ahead * (1 - gone[t]) - V[t] + GAMMA * TRACE * (1 - done[t]) * last
                G[t], ahead = last, V[t]
        kept = resets == 0
        update(agent, optimizer, X[kept], A[kept], logp[kept], G[kept], (G + V)[kept])
        if u % 10 == 9:
            seconds, score = time.time() - start, np.mean(scores[-N:])
            print(f"{(u + 1) * N * T:9d} steps, {seconds:4.0f} s, score {score:.3f}", flush=True)
    agent.mean, agent.std = normalized.obs_rms.mean, np.sqrt(normalized.obs_rms.var + normalized.epsilon)
    return agent


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--env", default="quad/HelixTracking-v0")
    parser.add_argument("--steps", type=int, default=4_000_000)
    parser.add_argument("--seed", type=int, default=0)
    o = parser.parse_args()
    near, far = gym.make(o.env, preview=PREVIEW), gym.make(o.env)  # the same flights, seen differently far
    ppo = train(o.env, o.steps, o.seed)
    for name, policy, env in (("ppo", ppo, near), ("lmpc", make_policy("lmpc", far), far)):
        score = evaluate(policy, env, episodes=20, seed=1000).summary()["score"]
        print(f"{name}: score {score.mean:.3f} +- {score.half_width:.3f}")
