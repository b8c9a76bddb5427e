"""Your own trajectory, your own limits, your own policy: no subclass anywhere.

    python -m examples.your_own_task [--episodes 10]

The policy is written by hand; `check_policy` says whether it keeps the protocol, `evaluate` judges it
as it judges all others.
"""

import argparse

import gymnasium as gym
import numpy as np

import quad_envs
from baselines import check_policy, evaluate, make_policy
from quad_envs.constraints import actions_from_forces
from quad_envs.rotations import rotation_body_from_inertial


def clover(t):
    """Three leaves of 1 m in 20 s, with its own height; t in s -> p in m, z points down."""
    angle = 2.0 * np.pi * t / 20.0
    r = np.sin(3.0 * angle)
    return r * np.cos(angle), r * np.sin(angle), -0.3 * np.sin(angle)


class ByHand:
    """The position asks for a tilt, the attitude for torques. Rows are independent and nothing is kept."""

    name = "by-hand"

    def __init__(self, env):
        self.task = env.unwrapped.task
        self.unmix = np.linalg.inv(self.task.params.mixer())  # rotor forces from thrust and torques

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        seen, params = self.task.layout.decode(observation), self.task.params
        ahead = seen.preview[..., 0, :]
        v = np.einsum("...ji,...j->...i", rotation_body_from_inertial(seen.Theta), seen.V_B)
        curve = (seen.preview[..., 1, 3:6] - ahead[..., 3:6]) / self.task.dt
        wanted = curve + 1.0 * ahead[..., :3] + 1.8 * (ahead[..., 3:6] - v)  # m/s^2, the heading is north
        wanted = np.clip(wanted, -1.5, 1.5)
        tilt = np.stack([wanted[..., 1], -wanted[..., 0], 0.0 * v[..., 0]], -1) / params.gravity
        torques = 20.0 * (tilt - seen.Theta) - 8.0 * seen.Omega
        thrust = params.mass * (params.gravity - wanted[..., 2:])
        forces = np.concatenate([thrust, torques * params.inertia], -1) @ self.unmix.T
        return actions_from_forces(forces, self.task.hover_force, self.task.force_max), state


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--episodes", type=int, default=10)
    options = parser.parse_args()
    env = gym.make(
        "quad/HelixTracking-v0",
        reference=quad_envs.from_function(clover),
        kappa=0.3125,  # rotors of 2.45 N
        tilt_limit=0.35,  # rad
        velocity_limit=1.2,  # m/s
        time_limit=20.0,
    )
    policy = ByHand(env)
    check_policy(policy, env)
    for entry in (policy, make_policy("lmpc", env), make_policy("sdc-nmpc", env)):
        print(evaluate(entry, env, episodes=options.episodes, seed=0))


if __name__ == "__main__":
    main()
