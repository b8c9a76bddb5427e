"""The readable formula of a team's rewards, flown over random episodes in which vehicles crash one by one."""

import numpy as np
import pytest

from quad_envs import Helix, formation_v0, target_tracking_v0
from quad_envs.constraints import TOLERANCE, forces_from_actions
from quad_envs.envs.shared.vehicle_options import CRASH_TILT
from quad_envs.reward import stage_cost

TILT = 0.4
SCALE = np.array([0.1, 0.4 - 0.33])  # of a tilt, and of a separation of 0.4 m before a crash at 0.33 m


def readable_scores(env, k, plants, command, nearest, flying, graph):
    """Rewards, costs and crashes of step k, each (n,); only of the vehicles that fly.

    Args:
        env: The team.
        k: Control step, of the state after it.
        plants: (n, 16).
        command: (n, 4), N.
        nearest: Distance of each to the nearest vehicle, smallest within the step, (n,), m.
        flying: Who flew into the step, (n,).
        graph: Weights G, (n, n).
    """
    n, p, slots = len(plants), plants[:, :3], np.array(env.task.slots)
    crashed = flying & (
        (np.abs(plants[:, 6:8]).max(axis=1) >= CRASH_TILT)
        | (nearest < env.task.crash_distance)
        | (np.linalg.norm(p, axis=1) > 100.0)
    )
    loss = stage_cost(plants, env.references[:, k], command, env.task.hover_force, env.task.weights)
    for i in range(n):
        heard = [j for j in range(n) if graph[i, j] and flying[j] and j != i]
        errors = [np.sum((p[i] - p[j] - slots[i] + slots[j]) ** 2) for j in heard]
        loss[i] += env.task.formation_weight * (np.mean(errors) if errors else 0.0)
    values = np.stack([np.abs(plants[:, 6:8]).max(axis=1) - TILT, env.task.separation - nearest], axis=1)
    cost = (np.where(values > TOLERANCE, values, 0.0) / SCALE).sum(axis=1)
    rewards = (1.0 - np.minimum(cost, 1.0)) / (1.0 + loss)
    return np.where(crashed, 0.0, rewards), cost, crashed


def fly_and_compare(env, seed):
    """Fly random actions to the end of an episode; the crashes of each step, and steps survived by others."""
    n, rng = env.task.vehicles, np.random.default_rng(seed)
    strength = rng.uniform(0.05, 0.6, (n, 1))  # who acts wildly crashes first
    env.reset(seed=seed)
    found, survived = [], 0
    for k in range(1, env.task.episode_steps + 1):
        flying = np.isin(env.possible_agents, env.agents)
        actions = (strength * rng.uniform(-1.0, 1.0, (n, 4))).astype(np.float32)
        given = {name: actions[i] for i, name in enumerate(env.possible_agents) if flying[i]}
        _, rewards, terminated, _, infos = env.step(given)
        nearest = np.array(
            [infos[a]["min_separation"] if a in infos else np.inf for a in env.possible_agents]
        )
        command = forces_from_actions(actions, env.task.hover_force, env.task.force_max)
        wanted, cost, crashed = readable_scores(
            env, k, env.plants, command, nearest, flying, env.unwrapped._batch.graph(k)
        )
        whole = env.unwrapped._batch.options.terminate == "team" and crashed.any()
        for i, name in enumerate(env.possible_agents):
            assert (name in rewards) == flying[i]
            if flying[i]:
                # one formula in two orders of summation
                assert rewards[name] == pytest.approx(0.0 if whole else wanted[i], abs=1e-12)
                assert infos[name]["cost"] == pytest.approx(cost[i], abs=1e-10)
                assert terminated[name] == (whole or crashed[i])
        survived += int((~flying).any() and flying.any())
        found.append(int(crashed.sum()))
        if not env.agents:
            break
    return found, survived


@pytest.mark.parametrize("terminate", ["agent", "team"])
@pytest.mark.parametrize("module", [formation_v0, target_tracking_v0], ids=["formation", "target"])
def test_rewards_of_teams_that_lose_vehicles_are_the_readable_formula(module, terminate):
    task = {"reference": Helix(2.0, 0.5, -0.3), "graph": "strong"} if module is formation_v0 else {}
    env = module.parallel_env(terminate=terminate, tilt_limit=TILT, time_limit=5.0, start="box", **task)
    crashes, survived = 0, 0
    for seed in range(6):
        found, flown = fly_and_compare(env, seed)
        crashes, survived = crashes + sum(found), survived + flown
    assert crashes >= 6
    assert (survived > 100) == (terminate == "agent"), "steps in which some fly on without those who crashed"
