"""Sensors of the target: h, H, their singular points."""

import numpy as np
import pytest

from quad_envs.compilation.decorators import kernel
from quad_envs.sensors import (
    MIN_HORIZONTAL_SQUARED,
    OVERHEAD,
    SENSORS,
    direction,
    direction_jacobian,
    direction_rows,
    direction_variances,
    is_overhead,
    jacobian,
    jacobian_rows,
    measure,
    range_azimuth_elevation,
    reads,
    sensor_rows,
)

DIRECTIONS = np.random.default_rng(0).normal(0.0, 4.0, (200, 3))


@kernel
def compiled(d, z, H):
    for i in range(len(d)):
        z[i, 0], z[i, 1], z[i, 2] = measure(d[i, 0], d[i, 1], d[i, 2])
        rows = jacobian_rows(d[i, 0], d[i, 1], d[i, 2])
        for a in range(3):
            H[i, a, 0], H[i, a, 1], H[i, a, 2] = rows[a]


@kernel
def compiled_direction(d, azimuth, h, H):
    for i in range(len(d)):
        h[i, 0], h[i, 1], along, across = direction_rows(d[i, 0], d[i, 1], d[i, 2], azimuth[i])
        for j in range(3):
            H[i, 0, j], H[i, 1, j] = along[j], across[j]


@kernel
def variances(d, elevation, sigma_azimuth, sigma_elevation):
    return direction_variances(d[0], d[1], d[2], elevation, sigma_azimuth, sigma_elevation)


@kernel
def overhead(d, sigma):
    return is_overhead(d[0], d[1], d[2], sigma)


def test_the_jacobian_agrees_with_central_differences():
    far = DIRECTIONS[np.hypot(DIRECTIONS[:, 0], DIRECTIONS[:, 1]) > 0.5]
    eps = 1e-5  # truncation 1e-10 / s^3, rounding 1e-11: both below the tolerance at s > 0.5 m
    for a, step in enumerate(eps * np.eye(3)):
        change = range_azimuth_elevation(far + step) - range_azimuth_elevation(far - step)
        change[:, 1] = (change[:, 1] + np.pi) % (2.0 * np.pi) - np.pi
        np.testing.assert_allclose(jacobian(far)[..., a], change / (2.0 * eps), atol=1e-8)


def test_compiled_and_readable_sensor_agree():
    singular = np.array(
        [[0.0, 0.0, 0.0], [0.0, 0.0, -3.0], [0.0, 0.0, 3.0], [1e-5, 0.0, 1.0], [-1.0, -0.0, 0.0]]
    )
    d = np.concatenate([DIRECTIONS, singular])
    z, H = np.empty((len(d), 3)), np.empty((len(d), 3, 3))
    compiled(d, z, H)
    np.testing.assert_allclose(z, range_azimuth_elevation(d), rtol=1e-15, atol=1e-15)
    np.testing.assert_allclose(H, jacobian(d), rtol=1e-14, atol=1e-14)


def test_range_and_angles_give_the_vector_back():
    rho, az, el = range_azimuth_elevation(DIRECTIONS).T
    back = rho * np.array([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), -np.sin(el)])
    np.testing.assert_allclose(back.T, DIRECTIONS, atol=1e-13)


def test_elevation_is_the_printed_arcsine():
    rho, _, el = range_azimuth_elevation(DIRECTIONS).T
    np.testing.assert_allclose(el, np.arcsin(-DIRECTIONS[:, 2] / rho), atol=1e-12)


def test_elevation_is_positive_for_a_target_above():
    assert range_azimuth_elevation([1.0, 0.0, -1.0])[2] == pytest.approx(np.pi / 4)


def test_azimuth_knows_four_quadrants():
    assert range_azimuth_elevation([-4.0, 3.0, 0.0])[1] == pytest.approx(2.50, abs=0.005)  # tan^-1 says -0.64


@pytest.mark.parametrize("d", [(0.0, 0.0, 0.0), (0.0, 0.0, -5.0), (0.0, 0.0, 5.0)])
def test_singular_points_have_finite_values(d):
    assert np.isfinite(range_azimuth_elevation(d)).all()
    assert np.abs(jacobian(d)).max() < 1.001 / np.sqrt(MIN_HORIZONTAL_SQUARED)


def test_overhead_is_where_the_horizontal_distance_is_small_against_the_angle_noise():
    limit = OVERHEAD * 0.02  # s / rho
    for ratio, expected in ((0.99 * limit, True), (1.01 * limit, False), (0.0, True)):
        d = 5.0 * np.array([0.6 * ratio, 0.8 * ratio, -np.sqrt(1.0 - ratio**2)])
        assert overhead(d, 0.02) == expected
    assert overhead(np.zeros(3), 0.0)


def test_the_jacobian_of_the_direction_agrees_with_central_differences_even_straight_overhead():
    rng = np.random.default_rng(1)
    above = np.array([[0.0, 0.0, -3.0], [0.0, 0.0, 4.0], [1e-9, -1e-9, -1.0]])
    d = np.concatenate([DIRECTIONS[np.linalg.norm(DIRECTIONS, axis=1) > 0.5], above])
    azimuth = rng.uniform(-np.pi, np.pi, len(d))
    eps = 1e-5  # truncation 1e-10 / rho^3, rounding 1e-11
    for a, step in enumerate(eps * np.eye(3)):
        change = (direction(d + step, azimuth) - direction(d - step, azimuth)) / (2.0 * eps)
        np.testing.assert_allclose(direction_jacobian(d, azimuth)[..., a], change, atol=1e-8)


def test_compiled_and_readable_direction_agree():
    d = np.concatenate([DIRECTIONS, [[0.0, 0.0, 0.0], [0.0, 0.0, -3.0], [0.0, 0.0, 3.0], [1e-5, 0.0, 1.0]]])
    azimuth = np.random.default_rng(2).uniform(-np.pi, np.pi, len(d))
    h, H = np.empty((len(d), 2)), np.empty((len(d), 2, 3))
    compiled_direction(d, azimuth, h, H)
    np.testing.assert_allclose(h, direction(d, azimuth), atol=1e-14)
    np.testing.assert_allclose(H, direction_jacobian(d, azimuth), rtol=1e-13, atol=1e-13)


def test_the_direction_of_a_reading_without_noise_is_the_cosine_of_its_elevation_and_zero():
    _, azimuth, elevation = range_azimuth_elevation(DIRECTIONS).T
    expected = np.stack([np.cos(elevation), np.zeros_like(elevation)], axis=-1)
    np.testing.assert_allclose(direction(DIRECTIONS, azimuth), expected, atol=1e-14)


@pytest.mark.parametrize("elevation", [-1.5, 0.0, 0.5, 1.2])
def test_variances_of_the_direction_are_those_of_its_noise(elevation):
    # Compared away from 90 degrees by more than the noise, where the reading of s / rho is itself a good one.
    rng, sigma = np.random.default_rng(3), np.array([0.03, 0.02])
    d = np.array([np.cos(elevation), 0.0, -np.sin(elevation)])
    azimuth, reading = (sigma * rng.normal(size=(200_000, 2)) + [0.0, elevation]).T
    u, w = direction(np.tile(d, (len(azimuth), 1)), azimuth).T
    found = np.array([(np.cos(reading) - u).var(), w.var()])
    np.testing.assert_allclose(variances(d, elevation, *sigma), found, rtol=0.1)  # (s/rho)^2 + sigma^2: 8 %


@pytest.mark.parametrize("elevation", [0.0, np.pi / 2, -np.pi / 2, np.pi / 2 + 0.05])
def test_variances_of_the_direction_never_vanish(elevation):
    for d in np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -3.0], [3.0, 0.0, 0.0]]):
        assert min(variances(d, elevation, 0.02, 0.02)) > 0.9 * 0.02**4


def test_sensors_are_named():
    assert sensor_rows("range") == 1 and sensor_rows("range-azimuth-elevation") == 3
    for sensor, read in SENSORS.items():
        rows = sensor_rows(sensor)
        assert [entry for entry in range(3) if reads(rows, entry)] == list(range(read.start, read.stop))
    with pytest.raises(ValueError, match="unknown sensor 'rnage'; did you mean 'range'"):
        sensor_rows("rnage")
