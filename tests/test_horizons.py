"""A longer horizon does not cost: positions are predicted from velocities that are their rates."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from flights import TASK, at_rest, decide_once, rest, window

from baselines import make_policy
from baselines.evaluation.metrics import measure
from baselines.evaluation.rollout import run_episodes
from controllers import LinearMPC, SdcNmpc
from controllers.model import sdc_matrix
from controllers.mpc.present_axes import body_outputs, pair_in_present_axes
from quad_envs.dynamics import derivative_reference
from quad_envs.parameters import QuadrotorParams
from quad_envs.rotations import rotation_body_from_inertial

TASKS = ("HelixTracking", "LineTracking", "LemniscateTracking", "RandomTracking")


def mean_score(task, name, horizon):
    """Over three starts."""
    env = gymnasium.make_vec(f"quad/{task}-v0", num_envs=3, preview=horizon)
    flown = run_episodes(make_policy(name, env, horizon=horizon), env, 3, 0)
    return np.mean([measure(episode).score for episode in flown])


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("name", ["lmpc", "sdc-nmpc", "nmpc"])
def test_a_horizon_of_sixty_costs_at_most_two_percent_of_the_score_at_25_and_10(task, name):
    """The spec's 2 %; predicting positions from V_B, LMPC lost 13 % on the helix, SDC-NMPC 3 %."""
    far, default, near = (mean_score(task, name, horizon) for horizon in (60, 25, 10))
    assert far > 0.98 * max(default, near) and default > 0.98 * near


@pytest.mark.parametrize("roll", [0.0, 0.3])
@pytest.mark.parametrize("psi", [0.0, 1.0])
def test_the_hover_model_predicts_the_position_of_a_tilted_vehicle_from_its_inertial_velocity(roll, psi):
    """Climbing straight at 3 m/s, rolled or not: the first step is straight but for what the roll pushes."""
    plant = at_rest(Theta=(roll, 0.0, psi))
    plant[3:6] = rotation_body_from_inertial(plant[6:9]) @ [0.0, 0.0, -3.0]
    mpc = LinearMPC(TASK, horizon=10)
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
        mpc = LinearMPC(TASK, horizon=5, **options)
        arguments = plant, window(rest, 0, 5), np.full(4, TASK.hover_force), np.zeros(6)
        qp = mpc.problem(*arguments, np.zeros(mpc.memory_size))
        np.testing.assert_array_equal(qp.x_0[3:6], plant[3:6])


def test_the_pair_in_present_axes_is_exact_wherever_it_is_taken():
    """As A_c(x) x + B_c du = f: w' is that of R_0 R_BI(Theta)' V_B along the exact motion, here by 1e-12."""
    rng, params = np.random.default_rng(0), QuadrotorParams(drag=0.1)
    for _ in range(50):
        x, now = rng.normal(size=12), 0.5 * rng.normal(size=3)
        F = rng.uniform(0.0, 4.0, 4)
        R_0, R = (rotation_body_from_inertial(angles) for angles in (now, x[6:9]))
        rate = derivative_reference(x, F, params)
        A_c, B_w, transposed = np.empty((12, 12)), np.empty((12, 4)), np.zeros((3, 12))
        transposed[:, :3] = R_0.T
        sdc_matrix(x, 1.0, params.coefficients(), A_c)
        pair_in_present_axes(transposed, params.input_matrix(), A_c, B_w, np.zeros((6, 12)))
        z, expected = x.copy(), rate.copy()
        z[3:6] = R_0 @ R.T @ x[3:6]
        expected[3:6] = R_0 @ R.T @ (rate[3:6] + np.cross(x[9:12], x[3:6]))
        np.testing.assert_allclose(A_c @ z + B_w @ (F - params.hover_force), expected, atol=1e-12)


@pytest.mark.parametrize("level", [False, True])
def test_rows_on_the_body_velocity_are_right_to_the_first_order(level):
    """Attitudes some 1e-4 rad from there: the second order leaves up to 1e-7 times 3 m/s times the rows."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        plant = np.concatenate([rng.normal(size=12), np.ones(4)])
        plant[6:9] = 0.0 if level else 0.3 * rng.normal(size=3)
        plant[8] = 0.0
        normals, lower = np.zeros((3, 12)), np.zeros(3)
        normals[:, 3:6] = rng.normal(size=(3, 3))
        wanted, upper, which = normals[:, 3:6].copy(), np.ones(3), np.arange(3)
        body_outputs(plant, level, which, normals, lower, upper)
        later = plant[:12].copy()
        later[6:9] += 1e-4 * rng.normal(size=3)
        R_0, R = (rotation_body_from_inertial(x[6:9]) for x in (plant, later))
        V_B = (
            R @ R_0.T @ plant[3:6]
        )  # the same velocity; at hover level axes are those of the present attitude
        np.testing.assert_allclose(normals @ later - lower, wanted @ V_B, atol=1e-6)
        np.testing.assert_allclose(upper - lower, 1.0, atol=1e-12)


@pytest.mark.parametrize("name", ["lmpc", "sdc-nmpc"])
def test_a_limit_on_the_velocity_just_above_what_the_helix_needs_is_kept(name):
    """It needs 3 m/s downwards; level components alone as rows were exceeded in 7 and 9 % of the steps."""
    env = gymnasium.make_vec("quad/HelixTracking-v0", num_envs=3, velocity_limit=3.5)
    flown = [measure(episode) for episode in run_episodes(make_policy(name, env), env, 3, 0)]
    assert max(record.violation_share for record in flown) <= 0.01
    assert np.mean([record.score for record in flown]) > 0.77


def test_present_axes_have_no_other_factorisation():
    assert SdcNmpc(TASK, horizon=5).options.axes() == "present"
    assert SdcNmpc(TASK, horizon=5, alpha=0.5).options.axes() == "heading"
    assert SdcNmpc(TASK, horizon=5, frame="hover").options.axes() == "heading"
    with pytest.raises(ValueError, match="'present' leaves out"):
        SdcNmpc(TASK, horizon=5, alpha=0.5, velocity_reference="present")


def test_at_a_level_attitude_the_axes_are_one():
    plant, rows = at_rest(p=(1.0, -0.5, 0.3)), window(rest, 0, 10)
    plant[3:6] = 0.5, -0.2, 0.1
    level, body = (
        decide_once(LinearMPC(TASK, horizon=10, velocity_reference=axes), plant, rows).command
        for axes in ("level", "attitude")
    )
    np.testing.assert_array_equal(level, body)
