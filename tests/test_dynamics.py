"""The rigid body and its integrator against independent derivations."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from quad_envs.compilation.decorators import kernel
from quad_envs.dynamics import (
    derivative_reference,
    rigid_body,
    simulate,
)
from quad_envs.lanes import LANES
from quad_envs.parameters import FRAMES, QuadrotorParams
from quad_envs.rotations import (
    euler_rate_matrix,
    rotation_body_from_inertial,
    sincos,
    wrap_angle,
    wrap_angle_scalar,
)

PARAMS = QuadrotorParams()
ANCHOR_X = np.array([0, 0, 0, 1, -0.5, 0.2, 0.1, -0.2, 0.3, 0.4, -0.3, 0.2])
ANCHOR_F = np.array([2.5, 1.5, 2.2, 1.8])


@kernel
def _derivative(x, F, d, c, out):
    rates = rigid_body(x, F, d, c)
    for i in range(12):
        out[i] = rates[i]


@kernel
def _sincos(angles, out):
    for i in range(angles.size):
        out[i, 0], out[i, 1] = sincos(angles[i])


@kernel
def _wrap(angles, out):
    for i in range(angles.size):
        out[i] = wrap_angle_scalar(angles[i])


def random_states(rng, n):
    x = rng.normal(size=(n, 12))
    x[:, 6:9] = rng.uniform([-3.0, -1.4, -3.0], [3.0, 1.4, 3.0], (n, 3))
    return x


def test_derivative_at_the_published_point():
    expected = [
        *(1.06092026, -0.21348016, 0.3447817, 1.90695944, 0.83886527, -0.54333079),
        *(0.3657317, -0.31846793, 0.17248911, 2.26660714, 2.28553571, -0.06958257),
    ]
    np.testing.assert_allclose(derivative_reference(ANCHOR_X, ANCHOR_F, PARAMS), expected, atol=1e-8)


@pytest.mark.parametrize("frame", FRAMES)
def test_compiled_derivative_equals_the_readable_one(frame):
    rng = np.random.default_rng(0)
    params = QuadrotorParams(mass=1.1, inertia=(0.02, 0.03, 0.05), drag=0.3, frame=frame)
    for x in random_states(rng, 200):
        F, d, out = rng.uniform(0, 8, 4), rng.normal(size=6), np.empty(12)
        _derivative(x, F, d, params.coefficients(), out)
        np.testing.assert_allclose(
            out, derivative_reference(x, F, params, d[:3], d[3:]), rtol=1e-12, atol=1e-12
        )


def test_sine_and_cosine_are_exact_to_the_last_bits():
    angles = np.concatenate([np.linspace(-50, 50, 20001), np.arange(-40, 41) * np.pi / 4])
    out = np.empty((angles.size, 2))
    _sincos(angles, out)
    # three ulps of 1: two of range reduction and one of the polynomial
    np.testing.assert_allclose(out, np.stack([np.sin(angles), np.cos(angles)], axis=1), atol=7e-16)


def test_wrapped_angles_agree_and_lie_in_the_half_open_interval():
    angles = np.concatenate([np.linspace(-20, 20, 4001), [np.pi, -np.pi, 3 * np.pi]])
    out = np.empty_like(angles)
    _wrap(angles, out)
    assert np.array_equal(out, wrap_angle(angles))
    assert (out >= -np.pi).all() and (out < np.pi + 1e-12).all()
    np.testing.assert_allclose(np.exp(1j * out), np.exp(1j * angles), atol=1e-13)


def test_rotation_is_orthonormal_and_its_rate_follows_from_the_euler_rates():
    rng = np.random.default_rng(1)
    Theta = random_states(rng, 50)[:, 6:9]
    Omega = rng.normal(size=(50, 3))
    R = rotation_body_from_inertial(Theta)
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=1e-14)
    rates = np.einsum("nij,nj->ni", euler_rate_matrix(Theta), Omega)
    h = 1e-6
    dR = (rotation_body_from_inertial(Theta + h * rates) - rotation_body_from_inertial(Theta - h * rates)) / (
        2 * h
    )
    cross = np.zeros_like(R)
    for (i, j), (sign, k) in {(0, 1): (-1, 2), (0, 2): (1, 1), (1, 2): (-1, 0)}.items():
        cross[:, i, j], cross[:, j, i] = sign * Omega[:, k], -sign * Omega[:, k]
    np.testing.assert_allclose(dR, -cross @ R, atol=1e-8)


def test_one_sample_at_the_published_point():
    x = [
        *(0.0550468, -0.00867354, 0.0174437, 1.09879152, -0.45399971, 0.17632362),
        *(0.11965654, -0.21454551, 0.30860875, 0.47247473, -0.22603914, 0.19779829),
    ]
    F = [2.4556741, 1.5377591, 2.1802996, 1.8131336]
    plant = np.concatenate([ANCHOR_X, np.full(4, 1.96)])
    np.testing.assert_allclose(simulate(plant, ANCHOR_F, PARAMS, substeps=10), [*x, *F], atol=1e-7)


def test_flight_agrees_with_an_adaptive_eighth_order_integrator():
    def rhs(t, y):
        return np.concatenate([derivative_reference(y[:12], y[12:], PARAMS), 50.0 * (command - y[12:])])

    plant = np.concatenate([ANCHOR_X, np.full(4, 1.96)])
    command = ANCHOR_F
    exact = solve_ivp(rhs, (0, 0.05), plant, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    error = {n: np.abs(simulate(plant, command, PARAMS, substeps=n) - exact).max() for n in (1, 2, 5, 10)}
    assert error[1] < 6e-4 and error[2] < 4e-5 and error[5] < 1e-6 and error[10] < 8e-8


def test_integrator_is_of_fourth_order():
    plant = np.concatenate([ANCHOR_X, ANCHOR_F])
    exact = simulate(plant, ANCHOR_F, PARAMS, substeps=256)
    error = [np.abs(simulate(plant, ANCHOR_F, PARAMS, substeps=n) - exact).max() for n in (2, 4, 8)]
    order = np.log2(np.array(error[:-1]) / error[1:])
    assert (order > 3.7).all() and (order < 4.5).all()


def test_rotors_follow_their_closed_form():
    plant = np.concatenate([np.zeros(12), np.full(4, 1.96)])
    after = simulate(plant, ANCHOR_F, PARAMS, duration=0.03, substeps=3)
    np.testing.assert_allclose(after[12:], ANCHOR_F + (1.96 - ANCHOR_F) * np.exp(-50 * 0.03), rtol=1e-14)


def test_hover_is_an_equilibrium_at_any_position_and_heading():
    plant = np.concatenate([[3, -2, 5, 0, 0, 0, 0, 0, 1.1, 0, 0, 0], np.full(4, 1.96)])
    np.testing.assert_allclose(simulate(plant, np.full(4, 1.96), PARAMS, duration=1.0), plant, atol=1e-13)


def test_free_fall_conserves_energy_and_angular_momentum():
    rng = np.random.default_rng(2)
    x = random_states(rng, 1)[0]
    x[6:8] = [0.2, -0.3]
    J = np.array(PARAMS.inertia)

    def invariants(state):
        V_B, Omega, R = state[3:6], state[9:12], rotation_body_from_inertial(state[6:9])
        energy = 0.5 * 0.8 * V_B @ V_B + 0.5 * Omega @ (J * Omega) - 0.8 * 9.8 * state[2]
        return np.concatenate([[energy], R.T @ (J * Omega), (R.T @ V_B)[:2]])

    plant = np.concatenate([x, np.zeros(4)])
    after = simulate(plant, np.zeros(4), PARAMS, duration=0.3, substeps=300)
    np.testing.assert_allclose(invariants(after), invariants(plant), rtol=1e-9, atol=1e-10)


def test_commands_beyond_the_rotor_limits_saturate():
    plant = np.concatenate([np.zeros(12), np.full(4, 1.96)])
    low_high = [-3.0, 9.0, 2.45, 2.46]
    after = simulate(plant, low_high, PARAMS, force_max=2.45)
    same = simulate(plant, [0.0, 2.45, 2.45, 2.45], PARAMS, force_max=2.45)
    assert np.array_equal(after, same)


def test_vehicles_side_by_side_equal_one_at_a_time_bit_for_bit():
    rng = np.random.default_rng(3)
    n = 4 * LANES + 1
    plants = np.concatenate([random_states(rng, n), rng.uniform(0, 7, (n, 4))], axis=1)
    commands = rng.uniform(0, 7, (n, 4))
    one_by_one = [simulate(plant, command, PARAMS) for plant, command in zip(plants, commands, strict=True)]
    assert np.array_equal(simulate(plants, commands, PARAMS), one_by_one)


def test_a_state_that_would_not_stay_finite_is_left_as_it_was():
    plant = np.concatenate([np.zeros(12), np.full(4, 1.96)])
    plant[9] = 1e200
    assert np.array_equal(simulate(plant, np.full(4, 1.96), PARAMS), plant)


@pytest.mark.parametrize("angle", [0.0, 1e-9, np.pi / 2 - 0.02])
def test_derivative_is_finite_up_to_the_crash_attitude(angle):
    x = np.zeros(12)
    x[6:8], x[9:12] = angle, 1.0
    assert np.isfinite(derivative_reference(x, ANCHOR_F, PARAMS)).all()
