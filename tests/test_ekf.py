"""The target filter: against filterpy, a readable twin, exact computations; wrap, delay, faults."""

import numpy as np
import pytest
from estimation_runs import (
    DT,
    RAILS,
    SIGMA,
    START,
    curved,
    cv_truth,
    fly,
    readable_update,
    rows_of,
    start_filters,
    sweep,
)
from filterpy.kalman import ExtendedKalmanFilter

from controllers.estimation import Measurements, ekf
from controllers.estimation.ekf_kernels import ekf_scratch, ekf_step_kernel
from controllers.estimation.kalman import kalman_update
from quad_envs.rotations import wrap_angle
from quad_envs.sensors import OVERHEAD, jacobian, range_azimuth_elevation


def some_filters(n, rng, spread=0.3):
    A = rng.normal(size=(n, 6, 6))
    P = 0.05 * A @ A.transpose(0, 2, 1) + 0.01 * np.eye(6)
    return ekf.TargetFilter(START + spread * rng.normal(size=(n, 6)), P)


def some_measurements(n, m, rng):
    position = RAILS[rng.integers(0, 4, (n, m))] + rng.normal(size=(n, m, 3))
    z = range_azimuth_elevation(START[:3] - position) + SIGMA * rng.normal(size=(n, m, 3))
    return z, position, rng.uniform(0.0, 0.5, (n, m)), rng.random((n, m)) < 0.7


@pytest.mark.parametrize("rows", [1, 3])
def test_the_update_agrees_with_its_readable_twin(rows):
    rng = np.random.default_rng(0)
    state, (z, position, age, valid) = some_filters(30, rng), some_measurements(30, 4, rng)
    new, innovation = ekf.update(state, Measurements(z, position, age, valid, SIGMA, rows))
    for i in range(30):
        j = valid[i]
        if not j.any():
            continue
        parts = rows_of(state.x[i], z[i, j], position[i, j], age[i, j], rows)
        if rows == 1:
            parts = curved(state.x[i], state.P[i], position[i, j], age[i, j], *parts)
        x, P, nis = readable_update(state.x[i], state.P[i], *parts)
        np.testing.assert_allclose(new.x[i], x, atol=1e-10)
        np.testing.assert_allclose(new.P[i], P, atol=1e-12)
        np.testing.assert_allclose(innovation.nis[i], nis, rtol=1e-9)
        assert innovation.rows[i] == len(parts[0])
    assert not innovation.rejected.any()


def test_predict_is_the_discrete_model():
    state = some_filters(5, np.random.default_rng(1))
    new = ekf.predict(state, 0.3, 0.4)
    F, Q = ekf.constant_velocity_model(0.3, 0.4)
    np.testing.assert_allclose(new.x, state.x @ F.T, atol=1e-14)
    np.testing.assert_allclose(new.P, F @ state.P @ F.T + Q, atol=1e-14)


def test_two_predictions_are_one_over_the_whole_time():
    state = some_filters(5, np.random.default_rng(2))
    twice, once = ekf.predict(ekf.predict(state, 0.1, 0.4), 0.2, 0.4), ekf.predict(state, 0.3, 0.4)
    np.testing.assert_allclose(twice.P, once.P, atol=1e-14)


def test_two_hundred_steps_agree_with_filterpy():
    rng = np.random.default_rng(4)  # here the target stays clear of overhead, as asserted below
    truth = cv_truth(1, rng)
    state = start_filters(START[None], 0.25 * np.eye(6), rng)
    mine = fly(truth, state, lambda s: ekf.predict(s, DT, 0.02), 3, lambda k: np.ones((4, 4), dtype=bool))
    oracle = ExtendedKalmanFilter(dim_x=6, dim_z=12)
    oracle.x, oracle.P = state.x[0].copy(), state.P[0].copy()
    oracle.F, oracle.Q = ekf.constant_velocity_model(DT, 0.02)
    oracle.R = np.diag(np.tile(SIGMA**2, 4))

    def residual(a, b):
        error = (a - b).reshape(4, 3)
        error[:, 1] = wrap_angle(error[:, 1])
        return error.ravel()

    for k in range(200):
        p = truth.vehicles[k]
        oracle.predict()
        oracle.update(
            truth.z[k, 0].ravel(),
            lambda x, p=p: np.hstack([jacobian(x[:3] - p).reshape(12, 3), np.zeros((12, 3))]),
            lambda x, p=p: range_azimuth_elevation(x[:3] - p).ravel(),
            residual=residual,
        )
        d = mine.x[k, 0, 0, :3] - p
        assert (np.hypot(d[:, 0], d[:, 1]) > OVERHEAD * SIGMA[2] * np.linalg.norm(d, axis=1)).all()
        np.testing.assert_allclose(mine.x[k, 0, 0], oracle.x, atol=1e-10)
        np.testing.assert_allclose(mine.P[k, 0, 0], oracle.P, atol=1e-10)


def test_a_delayed_measurement_agrees_with_the_augmented_filter():
    # Without noise of the motion the state then and the state now are one another's linear image: exact.
    rng = np.random.default_rng(4)
    age, position = 0.4, np.array([1.0, -2.0, 0.5])
    F, _ = ekf.constant_velocity_model(age, 0.0)
    then = some_filters(1, rng)
    now = ekf.predict(then, age, 0.0)
    both = np.concatenate([now.x, then.x], axis=1)
    joint = np.block([[F @ then.P @ F.T, F @ then.P], [then.P @ F.T, then.P]])
    d = then.x[:, :3] - position
    z = range_azimuth_elevation(START[:3] - position)[None]
    H = np.concatenate([np.zeros((1, 3, 6)), jacobian(d), np.zeros((1, 3, 3))], axis=2)
    exact = kalman_update(both, joint, z - range_azimuth_elevation(d), H, np.diag(SIGMA**2)[None])
    mine, _ = ekf.update(now, Measurements(z[:, None], position[None, None], [[age]], None, SIGMA, 3))
    np.testing.assert_allclose(mine.x, exact.x[:, :6], atol=1e-12)
    np.testing.assert_allclose(mine.P, exact.P[:, :6, :6], atol=1e-12)


def test_a_moving_origin_changes_nothing():
    rng = np.random.default_rng(5)
    fixed = some_filters(8, rng)
    origin = rng.normal(size=(8, 3))
    moving = ekf.shift(fixed, origin)
    for _ in range(5):
        z, position, age, valid = some_measurements(8, 3, rng)
        step = rng.normal(size=(8, 3))
        origin = origin + step
        fixed, _ = ekf.update(ekf.predict(fixed, DT, 0.1), Measurements(z, position, age, valid, SIGMA, 3))
        moving = ekf.shift(ekf.predict(moving, DT, 0.1), step)
        moving, _ = ekf.update(moving, Measurements(z, position - origin[:, None], age, valid, SIGMA, 3))
    np.testing.assert_allclose(moving.x[:, :3] + origin, fixed.x[:, :3], atol=1e-9)
    np.testing.assert_allclose(moving.P, fixed.P, atol=1e-9)


def test_the_compiled_step_is_predict_shift_update():
    rng = np.random.default_rng(6)
    state, (z, position, age, valid) = some_filters(4, rng), some_measurements(4, 3, rng)
    displacement = rng.normal(size=(4, 3))
    new, innovation = ekf.update(
        ekf.shift(ekf.predict(state, DT, 0.1), displacement), Measurements(z, position, age, valid, SIGMA, 3)
    )
    restart = ekf.Restart().data()
    for i in range(4):
        x, P, scratch = state.x[i].copy(), state.P[i].copy(), np.full(ekf_scratch(3, 3), np.nan)
        nis, rows, rejected, lost = ekf_step_kernel(
            x, P, DT, 0.1, displacement[i], z[i], position[i], age[i], valid[i], SIGMA, 3, restart, True,
            scratch,
        )  # fmt: skip
        np.testing.assert_array_equal(x, new.x[i])
        np.testing.assert_array_equal(P, new.P[i])
        assert (nis, rows, rejected) == (innovation.nis[i], innovation.rows[i], innovation.rejected[i])
        assert not lost and not innovation.restarted[i]


def test_an_azimuth_across_pi_is_wrapped():
    t = DT * np.arange(200)
    path = np.stack([np.full(200, -5.0), np.sin(1.2 * t), np.full(200, -2.0)], axis=1)
    errors, _, unwrapped, _ = sweep(path, 10, np.random.default_rng(7), wrap=False)
    assert np.sqrt((unwrapped**2).sum(-1).mean()) > 10.0 * np.sqrt((errors**2).sum(-1).mean())


def test_without_measurement_the_prediction_stays():
    state = ekf.predict(some_filters(3, np.random.default_rng(9)), DT, 0.1)
    z, position, age, _ = some_measurements(3, 2, np.random.default_rng(9))
    for arguments in (
        (z, position, age, np.zeros((3, 2))),
        (z[:, :0], position[:, :0], age[:, :0], np.zeros((3, 0))),
    ):
        new, innovation = ekf.update(state, Measurements(*arguments, SIGMA, 3))
        np.testing.assert_array_equal(new.x, state.x)
        np.testing.assert_array_equal(new.P, state.P)
        assert not innovation.rows.any() and not innovation.nis.any() and not innovation.rejected.any()


def test_uncertainty_grows_while_all_measurements_are_lost():
    state = some_filters(1, np.random.default_rng(10))
    trace = [np.trace(state.P[0, :3, :3])]
    for _ in range(100):
        state = ekf.predict(state, DT, 0.02)
        trace.append(np.trace(state.P[0, :3, :3]))
    assert trace[-1] > 10.0 * trace[0] and np.isfinite(state.x).all()


@pytest.mark.parametrize("fault", [np.nan, np.inf, -np.inf, 1e300])
@pytest.mark.parametrize("where", ["z", "position", "age"])
def test_a_measurement_that_is_not_finite_is_left_out_and_counted(fault, where):
    rng = np.random.default_rng(11)
    state, (z, position, age, _) = some_filters(2, rng), some_measurements(2, 3, rng)
    broken = {"z": z.copy(), "position": position.copy(), "age": age.copy()}
    broken[where][1, 1] = fault
    new, innovation = ekf.update(
        state, Measurements(broken["z"], broken["position"], broken["age"], None, SIGMA, 3)
    )
    valid = np.array([[True, True, True], [True, False, True]])
    expected, _ = ekf.update(state, Measurements(z, position, age, valid, SIGMA, 3))
    np.testing.assert_array_equal(new.x, expected.x)
    np.testing.assert_array_equal(innovation.rejected, [0, 1])


def test_angles_of_a_range_sensor_are_not_read():
    rng = np.random.default_rng(12)
    state, (z, position, age, _) = some_filters(2, rng), some_measurements(2, 3, rng)
    z[..., 1:] = np.nan
    _, innovation = ekf.update(state, Measurements(z, position, age, None, SIGMA, 1))
    np.testing.assert_array_equal(innovation.rows, 3)


def test_an_indefinite_covariance_rejects_the_measurement_instead_of_the_state():
    rng = np.random.default_rng(13)
    state, (z, position, age, _) = some_filters(1, rng), some_measurements(1, 3, rng)
    state.P[0] = -np.eye(6)
    new, innovation = ekf.update(state, Measurements(z, position, age, None, SIGMA, 3))
    np.testing.assert_array_equal(new.x, state.x)
    assert innovation.rejected[0] == 3 and innovation.rows[0] == 0


def test_the_covariance_stays_symmetric_and_positive():
    rng = np.random.default_rng(14)
    state = ekf.initial_filter(START[None, :3], START[3:], (100.0, 10.0))
    place = np.zeros((1, 1, 3))
    for _ in range(1000):
        z = range_azimuth_elevation(START[:3]) + 1e-6 * rng.normal(size=(1, 1, 3))
        state, _ = ekf.update(
            ekf.predict(state, DT, 0.0), Measurements(z, place, None, None, np.full(3, 1e-6), 3)
        )
        state.x[0, 3:] = 0.0
    np.testing.assert_array_equal(state.P, state.P.transpose(0, 2, 1))
    assert np.linalg.eigvalsh(state.P[0])[0] > 0.0


def test_filters_are_independent_rows():
    rng = np.random.default_rng(15)
    state, arguments = some_filters(6, rng), some_measurements(6, 3, rng)
    all_rows, _ = ekf.update(state, Measurements(*arguments, SIGMA, 3))
    order = np.array([3, 1, 5])
    some, _ = ekf.update(
        ekf.TargetFilter(state.x[order], state.P[order]),
        Measurements(*(part[order] for part in arguments), SIGMA, 3),
    )
    np.testing.assert_array_equal(some.x, all_rows.x[order])


def test_the_arguments_are_left_alone():
    rng = np.random.default_rng(16)
    state, arguments = some_filters(2, rng), some_measurements(2, 3, rng)
    before = [part.copy() for part in (*state, *arguments)]
    ekf.update(ekf.shift(ekf.predict(state, DT, 0.1), np.ones((2, 3))), Measurements(*arguments, SIGMA, 3))
    for part, copy in zip((*state, *arguments), before, strict=True):
        np.testing.assert_array_equal(part, copy)


def test_a_dense_update_agrees_with_the_textbook():
    rng = np.random.default_rng(17)
    x, nu, H = rng.normal(size=(5, 4)), rng.normal(size=(5, 2)), rng.normal(size=(5, 2, 4))
    A, B = rng.normal(size=(5, 4, 4)), rng.normal(size=(5, 2, 2))
    P, R = A @ A.transpose(0, 2, 1), B @ B.transpose(0, 2, 1)
    new = kalman_update(x, P, nu, H, R)
    for i in range(5):
        information = np.linalg.inv(P[i]) + H[i].T @ np.linalg.solve(R[i], H[i])
        covariance = np.linalg.inv(information)
        np.testing.assert_allclose(new.P[i], covariance, atol=1e-9)
        np.testing.assert_allclose(
            new.x[i], x[i] + covariance @ H[i].T @ np.linalg.solve(R[i], nu[i]), atol=1e-9
        )
    assert new.accepted.all()


def test_a_dense_update_with_an_indefinite_s_is_refused_row_by_row():
    P = np.stack([np.eye(2), -np.eye(2)])
    new = kalman_update(np.zeros((2, 2)), P, np.ones((2, 1)), np.ones((2, 1, 2)), np.ones((2, 1, 1)))
    np.testing.assert_array_equal(new.accepted, [True, False])
    np.testing.assert_array_equal(new.x[1], 0.0)


def test_bad_arguments_are_named():
    rng = np.random.default_rng(18)
    state, (z, position, age, valid) = some_filters(2, rng), some_measurements(2, 3, rng)
    with pytest.raises(ValueError, match=r"position must have shape \(2, 3, 3\), got \(2, 2, 3\)"):
        ekf.update(state, Measurements(z, position[:, :2], age, valid, SIGMA, 3))
    with pytest.raises(ValueError, match="rows must be 1"):
        ekf.update(state, Measurements(z, position, age, valid, SIGMA, 2))
    with pytest.raises(ValueError, match="sigma must be three standard deviations > 0"):
        ekf.update(state, Measurements(z, position, age, valid, np.zeros(3), 3))
    with pytest.raises(ValueError, match="dt must be a finite number >= 0 s, got -1"):
        ekf.predict(state, -1.0, 0.1)
    state.x[1, 2] = np.nan
    with pytest.raises(ValueError, match=r"x must be finite, got nan at \(1, 2\)"):
        ekf.predict(state, DT, 0.1)


def test_the_parts_of_the_measurements_one_by_one_are_refused_with_the_form_of_today():
    rng = np.random.default_rng(0)
    with pytest.raises(TypeError, match=r"update takes \(state, Measurements\(z, position, age, valid"):
        ekf.update(some_filters(2, rng), *some_measurements(2, 3, rng), SIGMA, 3)
