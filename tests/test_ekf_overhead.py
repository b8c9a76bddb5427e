"""The target filter straight below and above its target: passes of any speed, hovering, a mirrored guess."""

import numpy as np
import pytest
from estimation_runs import DT, SIGMA, START, cv_truth, fly, readable_update, rows_of, start_filters, sweep

from controllers.estimation import Measurements, ekf
from controllers.estimation.consistency import anees, nees
from quad_envs.rotations import wrap_angle
from quad_envs.sensors import OVERHEAD, range_azimuth_elevation

# The largest of the normalised errors of 40 runs of 200 to 400 steps would be about 25 were they independent
# and chi^2 with 3 degrees of freedom; the limit leaves room for the linearisation. It is 37 in 8 such sets.
LARGEST = 60.0


def line(speed, steps, beside=0.0, down=-4.0):
    """A target on a line whose middle is straight above the origin, or `beside` that, (steps, 3)."""
    along = speed * DT * (np.arange(steps) - 0.5 * steps)
    return np.stack([along, np.full(steps, beside), np.full(steps, down)], axis=1)


def watch(path, seed, runs=40):
    """Errors (steps, runs, 3) and their covariances of one vehicle at the origin, alone with its sensor."""
    rng = np.random.default_rng(seed)
    truth_0 = np.concatenate([path[0], (path[1] - path[0]) / DT])
    x = truth_0 + 0.1 * rng.normal(size=(runs, 6))
    state, place = ekf.TargetFilter(x, np.tile(0.01 * np.eye(6), (runs, 1, 1))), np.zeros((runs, 1, 3))
    errors, covariances = [], []
    for r in path:
        z = range_azimuth_elevation(r) + SIGMA * rng.normal(size=(runs, 1, 3))
        z[..., 1] = wrap_angle(z[..., 1])
        state, innovation = ekf.update(
            ekf.predict(state, DT, 0.2), Measurements(z, place, None, None, SIGMA, 3)
        )
        assert (innovation.rows == 3).all()  # nothing is dropped
        errors.append(state.x[:, :3] - r)
        covariances.append(state.P[:, :3, :3])
    return np.array(errors), np.array(covariances)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("down", "first"), [(-4.0, 0), (4.0, 0), (-15.0, 0), (-1.0, 20)])
@pytest.mark.parametrize(("speed", "steps"), [(2.0, 100), (0.8, 200), (0.2, 400), (0.05, 400)])
def test_a_pass_at_any_speed_stays_consistent(speed, steps, down, first, seed):
    # 1 m above, a guess of the start that is 0.1 m off is beyond what the linearised angles can follow, far
    # from overhead: the first update, at s = 0.45 rho, gives 130. Its first second is left out.
    errors, P = watch(line(speed, steps, down=down), seed)
    assert nees(errors, P)[first:].max() < LARGEST
    assert anees(errors, P) < 1.1  # below 1: this target is calmer than the filter's q


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("beside", [0.0, 0.1, 0.3, 0.5, 0.6, 0.7])
def test_a_target_that_hovers_overhead_or_at_the_edge_of_it_stays_known(beside, seed):
    errors, P = watch(line(0.0, 400, beside), seed)
    assert nees(errors, P).max() < LARGEST
    assert np.sqrt((errors[100:] ** 2).sum(-1).mean()) < 0.08  # without angles it would drift by metres


def test_a_pass_straight_overhead_stays_consistent_where_the_angles_alone_are_not():
    errors, P, _, with_angles = sweep(line(0.8, 200), 40, np.random.default_rng(8), overhead=False)
    assert nees(errors, P).max() < LARGEST
    assert with_angles.max() > 500.0


@pytest.mark.parametrize("seed", [0, 2, 3, 9])
def test_a_vehicle_alone_is_consistent_where_targets_pass_it_slowly(seed):
    # Dropping the azimuth gave ANEES/3 = 1.17, 1.73, 1.22 for the first three.
    rng = np.random.default_rng(seed)
    truth = cv_truth(40, rng)
    state = start_filters(np.tile(START, (40, 1)), 0.25 * np.eye(6), rng)
    runs = fly(truth, state, lambda s: ekf.predict(s, DT, 0.02), 3, lambda k: np.eye(4, dtype=bool))
    errors, P = runs.error[40:], runs.P[40:][..., :3, :3]
    assert 0.95 < anees(errors, P) < 1.05
    assert nees(errors, P).max() < LARGEST
    assert 0.97 < runs.nis.sum() / runs.rows.sum() < 1.03


@pytest.mark.parametrize("down", [-4.0, -0.8, 2.0])
def test_a_prediction_mirrored_from_above_to_below_is_led_back(down):
    # The direction alone would keep it there: its horizontal part is the same.
    rng = np.random.default_rng(0)
    truth = np.array([0.1, 0.0, down])
    x = np.concatenate([truth * [1.0, 1.0, -1.0], np.zeros(3)]) + 0.03 * rng.normal(size=(100, 6))
    state = ekf.TargetFilter(x, np.tile(np.diag([9.0] * 3 + [1.0] * 3), (100, 1, 1)))
    for _ in range(100):
        z = range_azimuth_elevation(truth) + SIGMA * rng.normal(size=(100, 1, 3))
        state, _ = ekf.update(
            ekf.predict(state, DT, 0.05), Measurements(z, np.zeros((100, 1, 3)), None, None, SIGMA, 3)
        )
    assert np.linalg.norm(state.x[:, :3] - truth, axis=1).max() < 0.5


def test_the_update_overhead_agrees_with_its_readable_twin():
    rng = np.random.default_rng(1)
    n, m = 60, 3
    A = rng.normal(size=(n, 6, 6))
    state = ekf.TargetFilter(
        START + 0.1 * rng.normal(size=(n, 6)), 0.05 * A @ A.transpose(0, 2, 1) + 0.01 * np.eye(6)
    )
    # Half of them straight below or above, and some read from the wrong side.
    below = (
        START[:3] + [0.0, 0.0, 4.0] * rng.choice([-1.0, 1.0], (n, m, 1)) + 0.5 * rng.normal(size=(n, m, 3))
    )
    z = range_azimuth_elevation(START[:3] - below) + SIGMA * rng.normal(size=(n, m, 3))
    z[..., 2] *= rng.choice([1.0, -1.0], (n, m), p=[0.8, 0.2])
    age = rng.uniform(0.0, 0.5, (n, m))
    new, innovation = ekf.update(
        state, Measurements(z, below, age, None, SIGMA, 3), restart=None
    )  # whatever the innovation
    replaced = 0
    for i in range(n):
        nu, H, variance = rows_of(state.x[i], z[i], below[i], age[i], 3)
        replaced += (variance.reshape(m, 3)[:, 1] != SIGMA[1] ** 2).sum()
        x, P, nis = readable_update(state.x[i], state.P[i], nu, H, variance)
        np.testing.assert_allclose(new.x[i], x, atol=1e-9)
        np.testing.assert_allclose(new.P[i], P, atol=1e-10)
        np.testing.assert_allclose(innovation.nis[i], nis, rtol=1e-8)
    assert 0.2 * n * m < replaced < 0.8 * n * m  # both kinds of rows were compared


def test_the_rows_change_at_the_edge_of_overhead_without_a_jump_of_the_estimate():
    edge = OVERHEAD * SIGMA[2]
    states = []
    for ratio in (0.999 * edge, 1.001 * edge):
        d = 4.0 * np.array([ratio, 0.0, -np.sqrt(1.0 - ratio**2)])
        state = ekf.initial_filter(d[None], np.zeros(3), (0.05, 0.1))
        z = range_azimuth_elevation(d)[None, None] + SIGMA
        new, _ = ekf.update(state, Measurements(z, np.zeros((1, 1, 3)), None, None, SIGMA, 3))
        states.append(new.x[0] - state.x[0])
    np.testing.assert_allclose(*states, atol=2e-3)  # a twenty-fifth of a standard deviation of the prediction
