"""Validation of what a person chooses."""

import math

import numpy as np
import pytest

from quad_envs.parameters import Limits, QuadrotorParams, Weights


@pytest.mark.parametrize("kappa", [0.25, 0.0, -1.0, 20.1, math.nan, math.inf])
def test_kappa_outside_a_quarter_to_twenty_is_refused(kappa):
    with pytest.raises(ValueError, match=r"kappa, .* must lie in \(1/4, 20\]"):
        Limits(kappa=kappa)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"mass": 0.0}, "mass"),
        ({"gravity": math.nan}, "gravity"),
        ({"arm": -1.0}, "arm"),
        ({"inertia": (0.1, 0.0, 0.1)}, "Jy"),
        ({"inertia": (0.1, 0.1)}, "three"),
        ({"drag": -0.1}, "drag"),
    ],
)
def test_a_bad_physical_parameter_is_named(change, name):
    with pytest.raises(ValueError, match=name):
        QuadrotorParams(**change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rate": 0.0}, "rate limit must be > 0"),
        ({"tilt": 2.0}, "below pi/2"),
        ({"velocity": -1.0}, "velocity limit"),
        ({"position_lower": (1.0, 0.0, 0.0), "position_upper": (0.5, 1.0, 1.0)}, "position limit on x"),
    ],
)
def test_an_inconsistent_limit_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        Limits(**change)


def test_weights_need_positive_R():
    with pytest.raises(ValueError, match="weights R"):
        Weights(R=(1.0, 1.0, 0.0, 1.0))


def test_mixer_gives_thrust_and_torques_and_input_matrix_divides_by_inertia():
    params = QuadrotorParams()
    F = np.array([2.5, 1.5, 2.2, 1.8])
    T, roll, pitch, yaw = params.mixer() @ F
    assert T == pytest.approx(8.0)
    assert roll == pytest.approx(params.arm * (F[3] - F[1]))
    assert pitch == pytest.approx(params.arm * (F[0] - F[2]))
    assert yaw == pytest.approx(params.yaw_moment * (-F[0] + F[1] - F[2] + F[3]))
    B = params.input_matrix()
    np.testing.assert_allclose(B[9:] @ F, np.array([roll, pitch, yaw]) / params.inertia)
    np.testing.assert_allclose(B[5], -1.0 / params.mass)
    assert not B[[0, 1, 2, 3, 4, 6, 7, 8]].any()


def test_hover_force_is_a_quarter_of_the_weight():
    assert QuadrotorParams().hover_force == pytest.approx(1.96)
