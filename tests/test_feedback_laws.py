"""SDRE, LQR and feedback linearisation: published flights and identities."""

from __future__ import annotations

import numpy as np
import pytest
from flights import HOVER, TASK, WEAK, at_rest, decide_once, fly, helix, lines, rest, window

from controllers import FeedbackLinearization, Lqr, Sdre, hover_pair, lqr_gain
from controllers.feedback.options import FeedbackLinearizationOptions, SdreOptions

AGGRESSIVE = {"kp": 1.76, "kd": 1.91, "ka": 36.58, "kad": 6.87}


def settling_time(flight):
    error = np.linalg.norm(flight.plants[:-1, :3], axis=1)
    return 0.05 * (1 + np.flatnonzero(error > 0.05 * error[0])[-1])


def test_lqr_is_its_gain():
    plant = at_rest((0.3, -0.2, 0.1), (0.05, -0.02, 0.03))
    K, _ = lqr_gain(*hover_pair(TASK.params, TASK.dt), np.eye(12), np.eye(4))
    command = decide_once(Lqr(TASK, frame="hover"), plant).command[0]
    np.testing.assert_allclose(command - HOVER, -K @ plant[:12], atol=1e-12)


def test_the_options_of_a_law_are_a_value_whose_fields_keywords_replace():
    assert Sdre(TASK, SdreOptions(alpha=0.5), frame="hover").options == SdreOptions(alpha=0.5, frame="hover")
    assert FeedbackLinearization(TASK, kp=3.0).options == FeedbackLinearizationOptions(kp=3.0)
    with pytest.raises(TypeError, match="must be LqrOptions, got SdreOptions"):
        Lqr(TASK, SdreOptions())
    with pytest.raises(TypeError, match=r"options must be SdreOptions, got 0\.5; .* frame="):
        Sdre(TASK, 0.5)


def test_sdre_is_lqr_at_hover():
    plant = at_rest((0.3, -0.2, 0.1))
    a, b = decide_once(Lqr(TASK), plant), decide_once(Sdre(TASK), plant)
    np.testing.assert_allclose(a.command, b.command, atol=1e-9)


def test_sdre_flies_the_published_helix():
    flight = fly(Sdre(TASK, alpha=0.5, frame="hover"), helix)
    assert flight.rms == pytest.approx(0.9572, rel=1e-3)
    assert flight.effort == pytest.approx(0.3569, rel=1e-3)


def test_feedback_laws_do_not_mind_the_heading():
    """Rz(-psi) commutes with the laws in the heading frame: the same rotor forces at any yaw."""
    for controller in (Lqr(TASK), Sdre(TASK), FeedbackLinearization(TASK)):
        plant, rows = at_rest((1.0, 0.5, -0.3), (0.1, -0.05, 0.0)), window(lines, 3, 1)
        psi = 2.5
        c, s = np.cos(psi), np.sin(psi)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        turned, other = plant.copy(), rows.copy()
        turned[:3], turned[8] = turn @ plant[:3], psi
        other[:, :3], other[:, 3:6], other[:, 6:] = rows[:, :3] @ turn.T, rows[:, 3:6] @ turn.T, [s, c]
        a, b = decide_once(controller, plant, rows), decide_once(controller, turned, other)
        np.testing.assert_allclose(a.command, b.command, atol=1e-9)


def test_feedback_linearization_regulates_as_published():
    flight = fly(FeedbackLinearization(TASK, **AGGRESSIVE, frame="hover"), start=(1, 1, -1))
    assert flight.rms == pytest.approx(0.5029, rel=1e-3)
    assert flight.effort == pytest.approx(0.0353, rel=5e-3)
    assert settling_time(flight) == pytest.approx(2.05)


@pytest.mark.parametrize(
    ("side", "rms", "effort", "settles"), [(1, 1.9075, 0.1070, 3.35), (-1, 1.9166, 0.4719, 6.0)]
)
def test_default_gains_hold_with_weak_rotors(side, rms, effort, settles):
    flight = fly(FeedbackLinearization(WEAK, frame="hover"), start=(3, 3, 3 * side))
    assert flight.rms == pytest.approx(rms, rel=1e-3)
    assert flight.effort == pytest.approx(effort, rel=1e-3)
    assert settling_time(flight) == pytest.approx(settles)


def test_aggressive_gains_lose_the_vehicle_with_weak_rotors():
    flight = fly(FeedbackLinearization(WEAK, **AGGRESSIVE, frame="hover"), start=(3, 3, -3))
    tilt = np.abs(flight.plants[:, 6:8]).max(axis=1)
    assert 0.05 * np.flatnonzero(tilt > np.pi / 2)[0] == pytest.approx(3.7, abs=0.1)


def test_acceleration_of_the_reference_is_fed_forward_where_the_window_shows_it():
    with_it, without = (
        FeedbackLinearization(TASK),
        FeedbackLinearization(TASK, acceleration_feed_forward=False),
    )
    assert fly(with_it, helix).rms < fly(without, helix).rms
    rows = window(helix, 10, 1)
    one_row = decide_once(with_it, at_rest(), rows[:1])
    np.testing.assert_array_equal(one_row.command, decide_once(without, at_rest(), rows).command)


def test_fast_descent_does_not_turn_the_attitude_law_round():
    rows = window(rest, 0, 1)
    rows[:, :3] = 5.0, 0.0, 50.0  # wants u_3 far above g
    plant = at_rest()
    command = decide_once(FeedbackLinearization(TASK), plant, rows).command[0]
    assert np.isfinite(command).all()
    assert command[0] < command[2]  # pitches down, forward


@pytest.mark.parametrize("gain", ["kp", "kd", "ka", "kad"])
def test_gains_must_be_positive(gain):
    with pytest.raises(ValueError, match=gain):
        FeedbackLinearization(TASK, **{gain: 0.0})


def test_bad_options_are_named():
    for build in (
        lambda: Sdre(TASK, alpha=2.0),
        lambda: Sdre(TASK, frame="x"),
        lambda: Lqr(TASK, velocity_reference="x"),
    ):
        with pytest.raises(ValueError, match=r"alpha|frame|velocity_reference"):
            build()
    with pytest.raises(ValueError, match="plant of vehicle 0"):
        decide_once(Lqr(TASK), np.full(16, np.nan))
