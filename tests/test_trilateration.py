"""Position from ranges: exactness, geometry, honest covariance, mirror twins, refusals."""

import numpy as np
import pytest
from estimation_runs import RAILS
from scipy.optimize import least_squares

from controllers.estimation.consistency import nees
from controllers.estimation.trilateration import MAX_RATIO, Reason, trilaterate
from controllers.estimation.trilateration_kernels import ACCEPTED, GEOMETRY, RESIDUAL, SINGULAR, TOO_FEW

TARGET = np.array([3.0, 2.0, -6.0])
ABOVE = np.array([0.3, 0.0, -1.0]) / np.linalg.norm([0.3, 0.0, 1.0])


def ranges(target, positions=RAILS):
    return np.linalg.norm(target - positions, axis=-1)


def noisy_fixes(target, sigma, runs=4000, positions=RAILS, **options):
    rng = np.random.default_rng(0)
    z = ranges(target, positions) + sigma * rng.normal(size=(runs, len(positions)))
    return trilaterate(np.tile(positions, (runs, 1, 1)), z, sigma, **options)


def square_with_a_raised_vehicle(h):
    return np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [2.0, 2.0, -h]])


@pytest.mark.parametrize("offset", [0.0, 1e4], ids=["origin", "far from the origin"])
def test_exact_ranges_give_the_position(offset):
    fix = trilaterate(RAILS[None] + offset, ranges(TARGET)[None], 0.1)
    assert fix.accepted[0]
    np.testing.assert_allclose(fix.r[0], TARGET + offset, atol=1e-8)


def test_noisy_ranges_give_the_least_squares_solution():
    rng = np.random.default_rng(1)
    positions = 5.0 * rng.normal(size=(30, 6, 3))
    targets = 8.0 * rng.normal(size=(30, 3))
    z = ranges(targets[:, None], positions) + 0.1 * rng.normal(size=(30, 6))
    fix = trilaterate(positions, z, 0.1, start=targets, max_ratio=np.inf)
    for i in range(30):
        oracle = least_squares(
            lambda r, i=i: ranges(r, positions[i]) - z[i], targets[i], xtol=1e-15, ftol=1e-15, gtol=1e-15
        )
        np.testing.assert_allclose(fix.r[i], oracle.x, atol=1e-6)  # where the oracle's steps end
        np.testing.assert_allclose(fix.P[i], 0.01 * np.linalg.inv(oracle.jac.T @ oracle.jac), rtol=1e-5)
        np.testing.assert_allclose(fix.residual[i], 2.0 * oracle.cost / 0.01, rtol=1e-9)
        np.testing.assert_allclose(fix.pdop[i], 10.0 * np.sqrt(np.trace(fix.P[i])))


def test_coplanar_vehicles_are_refused():
    flat = RAILS * [1.0, 1.0, 0.0]
    fix = trilaterate(flat[None], ranges(TARGET, flat)[None], 0.1)
    assert not fix.accepted[0] and fix.reason[0] == Reason.GEOMETRY
    assert np.isinf(fix.pdop[0]) and np.isfinite(fix.r).all()


@pytest.mark.parametrize("tilt", [0.0, 1e-9, 1e-4])
def test_vehicles_in_any_nearly_singular_arrangement_are_a_value(tilt):
    rng = np.random.default_rng(2)
    line = np.outer(np.arange(4.0), [1.0, 2.0, 3.0]) + tilt * rng.normal(size=(4, 3))
    for positions in (line, np.ones((4, 3)) + tilt * rng.normal(size=(4, 3)), line * [1.0, 1.0, 0.0]):
        fix = trilaterate(positions[None], ranges(TARGET, positions)[None], 0.1)
        ratio = np.linalg.cond(positions - positions.mean(axis=0))
        assert fix.accepted[0] == (ratio <= MAX_RATIO)


def test_the_geometry_test_is_the_ratio_of_singular_values():
    rng = np.random.default_rng(3)
    positions = rng.normal(size=(500, 5, 3)) * [1.0, 1.0, 0.25]
    values = np.linalg.svd(positions - positions.mean(axis=1, keepdims=True), compute_uv=False)
    ratio = values[:, 0] / values[:, 2]
    fix = trilaterate(positions, ranges(TARGET, positions), 0.1)
    np.testing.assert_array_equal(fix.reason == Reason.GEOMETRY, ratio > MAX_RATIO)
    assert 50 < (ratio > MAX_RATIO).sum() < 450


@pytest.mark.parametrize(("h", "accepted"), [(0.3, False), (0.6, True), (1.0, True)])
def test_a_square_needs_its_fourth_vehicle_raised(h, accepted):
    positions = square_with_a_raised_vehicle(h)
    fix = trilaterate(positions[None], ranges(np.array([1.0, 1.0, -3.0]), positions)[None], 0.1)
    assert fix.accepted[0] == accepted


@pytest.mark.parametrize("m", [4, 6])
def test_the_order_of_the_vehicles_does_not_matter(m):
    rng = np.random.default_rng(4)
    positions = np.concatenate([RAILS, [[1.0, 6.0, -3.0], [6.0, 1.0, 2.0]]])[:m]
    z = ranges(TARGET, positions) + 0.1 * rng.normal(size=m)
    orders = np.array([rng.permutation(m) for _ in range(20)])
    fix = trilaterate(positions[orders], z[orders], 0.1)
    np.testing.assert_allclose(fix.r, fix.r[:1].repeat(20, axis=0), atol=1e-8)
    np.testing.assert_allclose(fix.P, fix.P[:1].repeat(20, axis=0), rtol=1e-6)


@pytest.mark.parametrize("distance", [3.0, 6.0, 20.0])
def test_the_covariance_is_honest(distance):
    target = RAILS.mean(axis=0) + distance * ABOVE
    fix = noisy_fixes(target, 0.05)
    mean = nees(fix.r - target, fix.P).mean() / 3.0  # one sigma of the mean: 0.013
    assert 0.9 < mean < 1.1


@pytest.mark.parametrize(("distance", "too_sure"), [(3.0, False), (20.0, True)])
def test_the_printed_covariance_is_off_by_more_than_two(distance, too_sure):
    target = RAILS.mean(axis=0) + distance * ABOVE
    H = 2.0 * (target - RAILS)
    error = noisy_fixes(target, 0.05).r - target
    mean = nees(error, np.broadcast_to(np.linalg.inv(H.T @ H), (len(error), 3, 3))).mean() / 3.0
    assert mean > 2.0 if too_sure else mean < 0.5


def test_honest_fixes_pass_the_residual_test_at_its_level():
    fix = noisy_fixes(TARGET, 0.05, level=0.9)
    assert abs(fix.accepted.mean() - 0.9) < 0.02  # 4 sigma of 4000 draws
    assert noisy_fixes(TARGET, 0.05).accepted.mean() > 0.997


def test_a_wrong_range_is_refused_with_its_residual():
    positions = np.concatenate([RAILS, [[8.0, 1.0, -3.0]]])
    z = ranges(TARGET, positions)
    z[1] += 3.0
    fix = trilaterate(positions[None], z[None], 0.1)
    assert fix.reason[0] == Reason.RESIDUAL and fix.residual[0] > 50.0


def test_coplanar_vehicles_have_an_exact_mirror_twin():
    flat = square_with_a_raised_vehicle(0.0)
    above, below = np.array([1.0, 1.0, -3.0]), np.array([1.0, 1.0, 3.0])
    np.testing.assert_allclose(ranges(above, flat), ranges(below, flat), atol=1e-15)


def test_a_start_from_a_prediction_keeps_away_from_the_mirror_twin():
    positions, target = square_with_a_raised_vehicle(0.3), np.array([1.0, 1.0, -3.0])
    start = target + 0.3 * np.random.default_rng(5).normal(size=(4000, 3))
    guided = noisy_fixes(target, 0.1, positions=positions, start=start, max_ratio=np.inf)
    linear = noisy_fixes(target, 0.1, positions=positions, max_ratio=np.inf)
    rms = [np.sqrt(((fix.r - target)[:, 2] ** 2).mean()) for fix in (guided, linear)]
    assert rms[0] < 0.065 and rms[1] > 1.0
    assert 0.05 < (linear.r[:, 2] > 0.0).mean() < 0.15


def test_the_search_stays_near_the_target_in_heavy_noise():
    target = RAILS.mean(axis=0) + 6.0 * ABOVE  # Gauss-Newton has runaways of 100 m here
    error = noisy_fixes(target, 0.5, start=np.tile(target, (4000, 1))).r - target
    assert np.sqrt((error**2).sum(axis=1).mean()) < 2.0


def test_ranges_that_are_missing_or_not_finite_do_not_count():
    rng = np.random.default_rng(6)
    positions = np.concatenate([RAILS, [[8.0, 1.0, -3.0], [1.0, 9.0, 2.0]]])
    z = ranges(TARGET, positions)
    broken, valid = z.copy(), np.ones(6, dtype=bool)
    broken[4], valid[5] = np.nan, False
    broken[5] = 100.0 * rng.random()
    fix = trilaterate(positions[None], broken[None], 0.1, valid[None])
    np.testing.assert_allclose(fix.r[0], TARGET, atol=1e-8)
    valid[0] = False
    assert trilaterate(positions[None], broken[None], 0.1, valid[None]).reason[0] == Reason.TOO_FEW


def test_three_ranges_are_too_few():
    assert trilaterate(RAILS[None, :3], ranges(TARGET)[None, :3], 0.1).reason[0] == Reason.TOO_FEW


def test_a_target_at_a_vehicle_is_found():
    distance = np.maximum(ranges(RAILS[1]), 1e-9)  # a range of 0 is none
    fix = trilaterate(RAILS[None], distance[None], 0.1)
    np.testing.assert_allclose(fix.r[0], RAILS[1], atol=1e-6)


def test_compiled_code_knows_the_reasons_by_the_same_numbers():
    assert (ACCEPTED, TOO_FEW, GEOMETRY, SINGULAR, RESIDUAL) == tuple(Reason)


def test_wrong_shapes_and_noise_are_named():
    with pytest.raises(ValueError, match=r"distance must have shape \(1, 4\), got \(1, 3\)"):
        trilaterate(RAILS[None], ranges(TARGET)[None, :3], 0.1)
    with pytest.raises(ValueError, match="sigma must be a finite number > 0 m, got 0"):
        trilaterate(RAILS[None], ranges(TARGET)[None], 0.0)
