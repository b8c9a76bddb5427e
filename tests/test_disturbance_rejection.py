"""Disturbances: every controller cancels what is revealed, the estimator the rest (offset-free MPC)."""

from __future__ import annotations

import numpy as np
import pytest
from flights import HOVER, TASK, at_rest, decide_once, fly, held_under, helix, lines, spiral

from controllers import ExactNmpc, FeedbackLinearization, LinearMPC, Lqr, SdcNmpc, Sdre
from controllers.disturbance import feed_forward
from quad_envs.dynamics import derivative_reference

MPCS = {"lmpc": LinearMPC, "sdc": SdcNmpc, "rti": ExactNmpc}
ALL = {**MPCS, "sdre": Sdre, "lqr": Lqr, "fbl": FeedbackLinearization}
SIDEWAYS = np.array([0, 0, 0, 0, 0.5, 0.0])
ROLLING = np.array([0.05, 0, 0, 0, 0, 0.0])
MIXED = np.array([0.05, -0.03, 0.004, 0.4, 0.3, -0.5])


def constant(d):
    return lambda t: d


def pulse(t):
    """The dissertation's, in absolute time."""
    torque = np.exp(-0.1 * t) * np.array([np.sin(10 * t), np.cos(10 * t), 0.0])
    return np.r_[torque if 5.0 < t < 10.0 else np.zeros(3), np.zeros(3)]


def final_error(flight):
    return np.linalg.norm(flight.plants[-1, :3])


@pytest.mark.parametrize("psi", [0.0, 1.3])
def test_feed_forward_is_the_exact_equilibrium(psi):
    offset, trim, d = np.empty(4), np.empty(12), MIXED.copy()
    feed_forward(d, psi, TASK.params.coefficients(), TASK.force_max, offset, trim)
    trim[8] = psi
    derivative = derivative_reference(trim, offset, TASK.params, d[:3], d[3:])
    np.testing.assert_allclose(derivative, 0.0, atol=1e-13)


def test_feed_forward_is_the_dissertations_for_torques():
    offset, trim, L = np.empty(4), np.empty(12), TASK.params.arm
    feed_forward(
        np.array([0.2, -0.1, 0, 0, 0, 0.0]), 0.0, TASK.params.coefficients(), TASK.force_max, offset, trim
    )
    np.testing.assert_allclose(offset - HOVER, np.array([0.1, 0.2, -0.1, -0.2]) / (2 * L), atol=1e-15)
    assert not trim.any()


def test_yaw_torque_beyond_the_rotors_is_not_chased():
    offset, trim = np.empty(4), np.empty(12)
    feed_forward(
        np.array([0, 0, 1.0, 0, 0, 0]), 0.0, TASK.params.coefficients(), TASK.force_max, offset, trim
    )
    assert offset.min() >= HOVER / 2


@pytest.mark.parametrize("name", ALL)
def test_revealed_disturbance_leaves_no_offset(name):
    controller = ALL[name](TASK)
    assert final_error(fly(controller, disturbance=constant(MIXED), reveal=True, seconds=12.0)) < 1e-3
    assert final_error(fly(controller, disturbance=constant(MIXED), seconds=12.0)) > 0.1


@pytest.mark.parametrize("solver", ["structured", "osqp"])
def test_revealed_disturbance_moves_the_box_and_not_the_command_limits(solver):
    decision = decide_once(
        LinearMPC(TASK, horizon=10, solver=solver), at_rest(), disturbance=np.array([0.5, 0.5, 0, 0, 0, 6.0])
    )
    assert (decision.command >= 0.0).all() and (decision.command <= TASK.force_max).all()
    assert decision.fallback[0] == 0


@pytest.mark.parametrize("name", MPCS)
@pytest.mark.parametrize("d", [SIDEWAYS, ROLLING, MIXED], ids=["force", "torque", "mixed"])
def test_estimator_makes_the_mpc_offset_free(name, d):
    with_it, without = MPCS[name](TASK, reject_disturbance=True), MPCS[name](TASK)
    assert final_error(fly(with_it, disturbance=constant(d), seconds=12.0)) < 1e-3
    assert final_error(fly(without, disturbance=constant(d), seconds=12.0)) > 0.1


def test_estimator_finds_a_constant_disturbance_beside_a_revealed_one():
    controller = LinearMPC(TASK, reject_disturbance=True)
    memory, plant, last = None, at_rest(), np.full(4, HOVER)
    for k in range(100):
        decision = decide_once(controller, plant, last=last, disturbance=MIXED / 2, memory=memory)
        memory, last = decision.memory[0], decision.command[0]
        plant = held_under(plant, last, TASK, constant(MIXED), k)
    found = memory[1 + 5 * 25 :][1:7]
    np.testing.assert_allclose(found, MIXED / 2, atol=1e-3)


def test_estimator_changes_nothing_where_nothing_disturbs():
    """The prediction takes two substeps where the plant takes five: 3e-5 m/s a sample."""
    a, b = (fly(LinearMPC(TASK, reject_disturbance=on), helix, seconds=4.0) for on in (False, True))
    assert b.cost == pytest.approx(a.cost, rel=2e-3)


def test_a_jump_of_the_measurement_does_not_tumble_the_vehicle():
    controller = LinearMPC(TASK, reject_disturbance=True)
    first = decide_once(controller, at_rest())
    plant = at_rest()
    plant[9:12] = 50.0
    estimate = decide_once(controller, plant, memory=first.memory[0]).memory[0, 1 + 5 * 25 :][1:7]
    assert np.abs(estimate[:3]).max() < 0.2
    assert np.abs(estimate[3:]).max() <= 0.5 * TASK.params.weight


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lmpc", "sdc"])
@pytest.mark.parametrize("path", [helix, spiral, lines], ids=["helix", "spiral", "lines"])
def test_torque_pulse_is_survived_with_the_estimator(name, path):
    flight = fly(MPCS[name](TASK, reject_disturbance=True), path, disturbance=pulse, seconds=15.0)
    assert np.abs(flight.plants[:, 6:8]).max() < 0.7
    start = 4.5 if path is spiral else 0.0
    assert np.linalg.norm(flight.plants[-1, :3] - path(np.array([15.0]))[0][0]) < max(0.5, 0.1 * start)
    assert flight.rms < 1.4


@pytest.mark.slow
@pytest.mark.parametrize(
    ("build", "expected"),
    [
        (lambda: LinearMPC(TASK, frame="hover"), (0.852, 1.549, 0.362)),
        (lambda: SdcNmpc(TASK, alpha=0.5, frame="hover"), (0.561, 1.482, 0.311)),
    ],
    ids=["lmpc", "sdc"],
)
def test_torque_pulse_with_feed_forward_has_the_published_errors(build, expected):
    """Section 11 of the chapter; there feed-forward came after the MPC, here it is in the QP."""
    for path, rms in zip((helix, spiral, lines), expected, strict=True):
        assert fly(build(), path, disturbance=pulse, reveal=True).rms == pytest.approx(rms, rel=0.02)
