"""Flights of teams with random actions, for the tests of the multi-agent environments."""

import numpy as np

from quad_envs.rotations import rotation_body_from_inertial

DT = 0.05


def fly(env, steps=40, seed=0, scale=0.15):
    """Per step: decoded observations, rewards, infos, plants (stacked over the agents), and actions."""
    rng = np.random.default_rng(seed)
    seen, infos = env.reset(seed=seed)
    out = [(env.task.layout.decode(np.stack(list(seen.values()))), None, infos, env.plants, None)]
    for _ in range(steps):
        actions = rng.uniform(-scale, scale, (env.task.vehicles, env.task.action_size)).astype(np.float32)
        seen, rewards, _, _, infos = env.step(dict(zip(env.possible_agents, actions, strict=True)))
        view = env.task.layout.decode(np.stack(list(seen.values())))
        out.append((view, np.array(list(rewards.values())), infos, env.plants, actions))
        if not env.agents:
            break
    return out


def column(infos, key):
    return np.array([info[key] for info in infos.values()])


def inertial_velocity(plants):
    return np.einsum("nji,nj->ni", rotation_body_from_inertial(plants[:, 6:9]), plants[:, 3:6])
