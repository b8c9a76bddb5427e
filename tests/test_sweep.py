"""What nobody tunes for: weights, horizons, vehicles and headings together, every policy beside LMPC."""

import gymnasium as gym
import numpy as np
import pytest

import quad_envs  # noqa: F401
from baselines import make_policy
from quad_envs import Heading, Helix

PATH = Helix(2.0, 0.5, -0.2)
HEADINGS = {
    "still": PATH,
    "turning": Heading(PATH, yaw=0.5, rate=-0.4),
    "tangent": Heading(PATH, tangent=True),
}
MPCS = ("lmpc", "sdc-nmpc", "nmpc")
MANY = 0.05  # share of decisions that fall back: a storm
VEHICLES = ("crazyflie", "iris", "hummingbird")


def fly(name, env, **options):
    """Whether the vehicle is lost, share of fallbacks, return; every command is checked on the way."""
    policy = make_policy(name, env, **options)
    observation, _ = env.reset(seed=3)
    state, start, total, steps = None, np.ones(1, dtype=bool), 0.0, 0
    lost = ended = False
    while not (lost or ended):
        action, state = policy.predict(observation[None], state, start, deterministic=True)
        assert np.isfinite(action).all() and env.action_space.contains(action[0])
        observation, reward, lost, ended, _ = env.step(action[0])
        start, total, steps = np.zeros(1, dtype=bool), total + reward, steps + 1
    fallbacks = getattr(state, "fallbacks", np.zeros((1, 5)))
    return lost, fallbacks[0, 1:].sum() / steps, total


def environment(vehicle, heading, horizon, position, others):
    return gym.make(
        "quad/HelixTracking-v0",
        vehicle=vehicle,
        reference=HEADINGS[heading],
        Q=(position,) * 3 + (others,) * 9,
        preview=max(horizon, 25),
    )


def check(vehicle, heading, horizon, position, others):
    env = environment(vehicle, heading, horizon, position, others)
    found = {name: fly(name, env, horizon=horizon) for name in MPCS}
    case = vehicle, heading, horizon, position, others
    for name, (lost, fallbacks, _) in found.items():
        assert found["lmpc"][0] or not lost, (name, *case)
        assert fallbacks < MANY, (name, *case)


@pytest.mark.parametrize("vehicle", VEHICLES)
@pytest.mark.parametrize("others", [1.0, 0.01])
def test_far_weights_lose_no_vehicle_that_lmpc_keeps(vehicle, others):
    check(vehicle, "turning", 25, 100.0, others)


@pytest.mark.slow
@pytest.mark.parametrize("horizon", [10, 25, 40, 60])
@pytest.mark.parametrize("heading", HEADINGS)
@pytest.mark.parametrize("vehicle", VEHICLES)
def test_no_weights_horizon_or_heading_lose_a_vehicle_that_lmpc_keeps(vehicle, heading, horizon):
    for position in (1.0, 10.0, 100.0):
        for others in (1.0, 0.1, 0.01):
            check(vehicle, heading, horizon, position, others)


@pytest.mark.parametrize("heading", HEADINGS)
@pytest.mark.parametrize("vehicle", VEHICLES)
def test_no_policy_loses_a_named_vehicle_on_the_helix(vehicle, heading):
    env = environment(vehicle, heading, 25, 1.0, 1.0)
    for name in ("lqr", "sdre", "feedback-linearization", *MPCS):
        assert not fly(name, env)[0], name
