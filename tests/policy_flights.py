"""Closed loops of policies in the multi-agent environments, for tests."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from baselines import make_policy
from baselines.policies.estimate_wrapper import EstimateWrapper
from quad_envs import target_tracking_v0

CASE_START = tuple((0.0, y, 0.0) for y in np.linspace(-2.5, 2.5, 6))


class PolicyFlight(NamedTuple):
    observations: np.ndarray  # (T, N, d)
    actions: np.ndarray  # (T, N, a)
    rewards: np.ndarray  # (T, N)
    error: np.ndarray  # (T, N), m, to the slot
    gap: np.ndarray  # (T,), m, smallest distance
    estimate_error: np.ndarray  # (T, N, 3), m; empty without estimates
    infos: list  # of each step
    state: object  # of the policy, at the end
    truncated: bool

    def rms(self, seconds=5.0):
        """Tracking error over the last seconds, (N,)."""
        return np.sqrt((self.error[-round(seconds / 0.05) :] ** 2).mean(axis=0))

    def estimate_rms(self, seconds=5.0):
        return np.sqrt((self.estimate_error[-round(seconds / 0.05) :] ** 2).sum(axis=-1).mean(axis=0))


def fly(policy, env, seed=0, steps=None):
    """An episode, as long as all agents fly."""
    names, raw, state, k = env.possible_agents, env.unwrapped, None, 0
    seen, _ = env.reset(seed=seed)
    parts = [[] for _ in range(7)]
    truncated = False
    while env.agents == names and (steps is None or k < steps):
        rows = np.stack([seen[name] for name in names])
        actions, state = policy.predict(rows, state, np.full(len(names), k == 0))
        believed = np.zeros((0, 3))
        if state.estimates is not None:
            believed = state.estimates.r + raw.plants[:, :3] - raw.target[k, :3]
        seen, rewards, _, cut, infos = env.step(dict(zip(names, actions, strict=True)))
        told = [infos[name] for name in names]
        error = [info["formation_error"] for info in told]
        gap = min(info["min_separation"] for info in told)
        values = (rows, actions, [rewards[name] for name in names], error, gap, believed, infos)
        for part, value in zip(parts, values, strict=True):
            part.append(value)
        truncated = all(cut.values())
        k += 1
    return PolicyFlight(*map(np.array, parts[:6]), parts[6], state, truncated)


def chapter_7_env(graph, target, measuring, shared=False, **options):
    """The set-up of chapter 7, 25 s."""
    env = target_tracking_v0.parallel_env(
        graph=graph, target=target, measuring=measuring, start=CASE_START, time_limit=25.0, **options
    )
    return EstimateWrapper(env) if shared else env


def chapter_7_flight(graph, motion, measuring, shared=False, env_options=None, **options):
    env = chapter_7_env(graph, motion, measuring, shared, **(env_options or {}))
    return fly(make_policy("cooperative-mpc", env, **options), env)


DISSERTATION = {"neighbour": "frozen", "feed_forward": False, "target": "frozen"}
