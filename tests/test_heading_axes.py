"""Observations in axes turned to the heading of the reference: a world that is turned looks the same."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

import quad_envs
from baselines import check_policy, make_policy
from baselines.policies.checkpoints import load_checkpoint, save_checkpoint
from baselines.policies.disturbance_estimate import with_estimate
from baselines.policies.environments import task_of
from baselines.policies.network import Network
from baselines.policies.network_policies import network_policy
from quad_envs.observations.features import default_features
from quad_envs.observations.heading import HeadingAxes
from quad_envs.wrappers.encoding import Encoder, Encoding

RANDOM = "quad/RandomTracking-v0"
ANGLE = 2.2  # rad


class Turned:
    """A trajectory turned about the vertical, with a heading that turns as well."""

    random = False

    def __init__(self, angle):
        self.angle = angle

    def rows(self, t, rng):
        rows = quad_envs.Heading(quad_envs.Lemniscate(), yaw=0.4, rate=0.5).rows(t, rng)
        c, s = np.cos(self.angle), np.sin(self.angle)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        psi = np.arctan2(rows[:, 6], rows[:, 7]) + self.angle
        return quad_envs.references.pack_rows(rows[:, :3] @ turn.T, rows[:, 3:6] @ turn.T, psi)


def world(angle):
    """An environment in which everything is turned: reference, force, start."""
    c, s = np.cos(angle), np.sin(angle)
    turned = (0.3 * c + 0.1 * s, 0.3 * s - 0.1 * c, 0.2)
    env = gym.make(RANDOM, reference=Turned(angle), disturbance=turned, reveal_disturbance=True)
    state = np.array([c * 0.5, s * 0.5, 0.3, 0.2, -0.1, 0.0, 0.1, -0.2, angle + 0.3, 0.1, 0.2, -0.3])
    return env, env.reset(seed=0, options={"state": state})[0]


def network_for(task, seed=0, estimate=False):
    layout = with_estimate(task).layout if estimate else task.layout
    features, rng = replace(default_features(layout), heading_axes=True), np.random.default_rng(seed)
    W = (0.05 * rng.normal(size=(len(features.names), 4))).astype(np.float32)
    return Network(features, (W,), (np.zeros(4, np.float32),))


@pytest.mark.parametrize("estimate", [False, True])
def test_a_network_flies_a_turned_world_alike(estimate):
    flights = []
    for angle in (0.0, ANGLE):
        env, obs = world(angle)
        task = env.unwrapped.task
        policy, state, actions = network_policy(network_for(task, estimate=estimate), task, "net"), None, []
        for _ in range(20):
            action, state = policy.predict(obs, state)
            actions.append(action)
            obs = env.step(action)[0]
        flights.append(actions)
    # observations in float32, and 20 steps of feedback
    np.testing.assert_allclose(flights[0], flights[1], atol=1e-4)


def test_axes_turn_positions_velocities_forces_and_yaw_by_the_present_heading():
    env, obs = world(ANGLE)
    for _ in range(5):
        obs = env.step(np.zeros(4, dtype=np.float32))[0]
    layout = env.unwrapped.task.layout
    view, seen = layout.decode(obs), layout.decode(HeadingAxes(layout).turn(obs))
    psi = np.arctan2(view.preview[0, 6], view.preview[0, 7])
    turn = np.array([[np.cos(psi), np.sin(psi), 0], [-np.sin(psi), np.cos(psi), 0], [0, 0, 1]])
    close = {"atol": 1e-6}
    np.testing.assert_allclose(seen.preview[:, :3], view.preview[:, :3] @ turn.T, **close)
    np.testing.assert_allclose(seen.preview[:, 3:6], view.preview[:, 3:6] @ turn.T, **close)
    np.testing.assert_allclose(seen.force, turn @ view.force, **close)
    np.testing.assert_allclose(np.sin(seen.Theta[2]), np.sin(view.Theta[2] - psi), **close)
    np.testing.assert_allclose(np.cos(seen.Theta[2]), np.cos(view.Theta[2] - psi), **close)
    np.testing.assert_allclose(seen.preview[0, 6:], [0.0, 1.0], **close)
    for part in ("V_B", "Omega", "F", "last_command", "torque"):
        np.testing.assert_array_equal(getattr(seen, part), getattr(view, part))


def test_where_the_reference_heads_north_nothing_is_turned():
    env = gym.make_vec(RANDOM, num_envs=3)
    obs, _ = env.reset(seed=0)
    task = env.unwrapped.task
    plain, turned = (
        Encoder(Encoding(replace(default_features(task.layout), heading_axes=axes)), task)
        for axes in (False, True)
    )
    np.testing.assert_array_equal(plain.see(obs), turned.see(obs))
    np.testing.assert_array_equal(turned.see(obs)[0], turned.see(obs[0]))


def test_a_checkpoint_says_so(tmp_path):
    task = task_of(RANDOM)
    save_checkpoint(tmp_path / "net", network_for(task), {"env_id": RANDOM, "mission": "tracking"})
    network, said = load_checkpoint(tmp_path / "net")
    assert network.features.heading_axes and said["format"] == 4
    assert Encoding.from_plain(Encoding(network.features).to_plain()).features == network.features
    check_policy(make_policy(tmp_path / "net", RANDOM), RANDOM)


def test_a_number_that_is_not_finite_is_named_before_anything_is_turned():
    policy = network_policy(network_for(task_of(RANDOM)), task_of(RANDOM), "net")
    _, obs = world(0.0)
    obs = gym.make(RANDOM).reset(seed=0)[0]
    obs[24] = np.nan
    with pytest.raises(ValueError, match="entry 6 of 'preview'"):
        policy.predict(obs)


def test_a_team_has_no_heading_axes():
    with pytest.raises(ValueError, match="heading_axes are for observations of one vehicle"):
        HeadingAxes(task_of("quad/Formation-v0").layout)
