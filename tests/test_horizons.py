"""A longer horizon does not cost: positions are predicted from velocities that are their rates."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from flights import TASK, at_rest, decide_once, rest, window

from baselines import make_policy
from baselines.metrics import measure
from baselines.rollout import run_episodes
from controllers import LinearMPC
from quad_envs.rotations import rotation_body_from_inertial

TASKS = ("HelixTracking", "LineTracking", "LemniscateTracking", "RandomTracking")


def mean_score(task, name, horizon):
    """Over three starts."""
    env = gymnasium.make_vec(f"quad/{task}-v0", num_envs=3, preview=horizon)
    flown = run_episodes(make_policy(name, env, horizon=horizon), env, 3, 0)
    return np.mean([measure(episode).score for episode in flown])


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("name", ["lmpc", "nmpc"])
def test_a_horizon_of_sixty_costs_at_most_two_percent_of_the_score_at_25_and_10(task, name):
    """The spec's 2 %; LMPC lost 13 % on the helix while it predicted positions from V_B."""
    far, default, near = (mean_score(task, name, horizon) for horizon in (60, 25, 10))
    assert far > 0.98 * max(default, near) and default > 0.98 * near


@pytest.mark.parametrize("roll", [0.0, 0.3])
@pytest.mark.parametrize("psi", [0.0, 1.0])
def test_the_hover_model_predicts_the_position_of_a_tilted_vehicle_from_its_inertial_velocity(roll, psi):
    """Climbing straight at 3 m/s, rolled or not: the first step is straight but for what the roll pushes."""
    plant = at_rest(Theta=(roll, 0.0, psi))
    plant[3:6] = rotation_body_from_inertial(plant[6:9]) @ [0.0, 0.0, -3.0]
    mpc = LinearMPC(TASK, 10)
    arguments = plant, window(rest, 0, 10), np.full(4, TASK.hover_force), np.zeros(6)
    qp = mpc.problem(*arguments, np.zeros(mpc.memory_size))
    np.testing.assert_allclose(qp.x_0[3:6], [0.0, 0.0, -3.0], atol=1e-12)
    drift = (qp.A[0] @ qp.x_0)[:3] - 0.05 * np.array([0.0, 0.0, -3.0])
    lateral = 0.5 * 0.05**2 * TASK.params.gravity * roll  # what the roll accelerates, and nothing else
    np.testing.assert_allclose(drift, [0.0, lateral, 0.0], atol=1e-9)


def test_the_dissertations_frame_and_the_other_references_keep_the_body_velocity():
    plant = at_rest(Theta=(0.3, -0.2, 0.0))
    plant[3:6] = 1.0, 2.0, -3.0
    for options in (
        {"frame": "hover"},
        {"velocity_reference": "attitude"},
        {"velocity_reference": "heading"},
    ):
        mpc = LinearMPC(TASK, 5, **options)
        arguments = plant, window(rest, 0, 5), np.full(4, TASK.hover_force), np.zeros(6)
        qp = mpc.problem(*arguments, np.zeros(mpc.memory_size))
        np.testing.assert_array_equal(qp.x_0[3:6], plant[3:6])


def test_at_a_level_attitude_the_axes_are_one():
    plant, rows = at_rest(p=(1.0, -0.5, 0.3)), window(rest, 0, 10)
    plant[3:6] = 0.5, -0.2, 0.1
    level, body = (
        decide_once(LinearMPC(TASK, 10, velocity_reference=axes), plant, rows).command
        for axes in ("level", "attitude")
    )
    np.testing.assert_array_equal(level, body)
