"""The sensor of azimuth and elevation: its rows in the filter, and teams that find the target by them."""

import numpy as np
import pytest

from baselines import make_policy
from controllers.estimation import Measurements, ekf
from controllers.estimation.consistency import information
from quad_envs import cooperative_estimation_v0, target_tracking_v0
from quad_envs.sensors import jacobian, range_azimuth_elevation, sensor_rows

BEARINGS = "azimuth-elevation"
SIGMA = (0.1, 0.02, 0.02)  # the first, of the range, is not read


def differences(d, eps=1e-6):
    """Derivatives of azimuth and elevation by the target's position, (2, 3)."""
    change = [range_azimuth_elevation(d + e) - range_azimuth_elevation(d - e) for e in eps * np.eye(3)]
    change = (np.stack(change, axis=-1)[1:] + np.pi) % (2.0 * np.pi) - np.pi
    return change / (2.0 * eps)


def test_the_jacobian_is_that_of_the_angles_alone():
    for d in np.random.default_rng(0).normal((5.0, 0.0, 0.0), 4.0, (50, 3)):
        H = differences(d)
        np.testing.assert_allclose(jacobian(d)[1:], H, atol=1e-7)
        found = information(d[None], SIGMA, sensor_rows(BEARINGS))
        np.testing.assert_allclose(found[:3, :3], H.T @ H / 0.02**2, rtol=1e-5, atol=1e-5)


def test_an_update_is_the_formula_of_kalman_with_a_wrapped_azimuth_and_reads_no_range():
    x, P = np.array([-4.0, 0.02, -1.0, 0.5, 0.0, 0.0]), np.diag([0.04, 0.04, 0.04, 0.1, 0.1, 0.1])
    z = np.array([np.nan, -np.pi + 0.01, 0.26])  # the prediction is on the other side of pi
    expected = range_azimuth_elevation(x[:3])
    nu = z[1:] - expected[1:] + [2.0 * np.pi, 0.0]
    H = np.hstack([differences(x[:3]), np.zeros((2, 3))])
    S = H @ P @ H.T + 0.02**2 * np.eye(2)
    K = P @ H.T @ np.linalg.inv(S)
    new, said = ekf.update(
        ekf.TargetFilter(x[None], P[None]),
        Measurements(z[None, None], np.zeros((1, 1, 3)), None, None, SIGMA, sensor_rows(BEARINGS)),
        restart=None,
    )
    np.testing.assert_allclose(new.x[0], x + K @ nu, atol=1e-7)
    np.testing.assert_allclose(new.P[0], P - K @ S @ K.T, atol=1e-7)
    assert (said.nis[0], said.rows[0]) == (pytest.approx(nu @ np.linalg.solve(S, nu), rel=1e-5), 2)


def test_a_lost_filter_begins_anew_where_lines_of_sight_meet():
    target = np.array([5.0, 3.0, -2.0])
    places = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, -1.0], [0.0, 4.0, 1.0]])
    z = range_azimuth_elevation(target - places)
    lost = ekf.TargetFilter(np.array([[-9.0, 2.0, 4.0, 0.0, 0.0, 0.0]]), 0.01 * np.eye(6)[None])
    new, said = ekf.update(
        lost, Measurements(z[None], places[None], None, None, SIGMA, sensor_rows(BEARINGS))
    )
    assert said.restarted[0]
    np.testing.assert_allclose(new.x[0, :3], target, atol=1e-6)


def test_the_observation_has_the_angles_and_no_range():
    env = target_tracking_v0.parallel_env(sensor=BEARINGS, sensor_sigma=(0.1, 1e-7, 1e-7))
    seen, _ = env.reset(seed=0)
    view = env.task.layout.decode(seen["quad_0"])
    z = range_azimuth_elevation(env.unwrapped.target[0, :3] - env.unwrapped.plants[0, :3])
    expected = [1.0, 0.0, np.sin(z[1]), np.cos(z[1]), z[2]]
    np.testing.assert_allclose(view.measured[0], expected, atol=1e-5)


def estimates(env, policy, seed):
    """Errors of position and velocity (T, N, 6) and their covariances along a flight."""
    raw, names, state, errors, covariances = env.unwrapped, env.possible_agents, None, [], []
    seen, _ = env.reset(seed=seed)
    for k in range(150):
        rows = np.stack([seen[name] for name in names])
        actions, state = policy.predict(rows, state, np.full(len(names), k == 0))
        r, v = state.estimates.r + raw.plants[:, :3], state.estimates.v
        errors.append(np.concatenate([r - raw.target[k, :3], v - raw.target[k, 3:6]], axis=1))
        covariances.append(state.estimates.P.copy())
        seen, _, terminated, _, _ = env.step(dict(zip(names, actions, strict=True)))
        assert not any(terminated.values())
    return np.array(errors), np.array(covariances)


@pytest.mark.parametrize(
    ("module", "name", "options"),
    [(cooperative_estimation_v0, "ekf", {"graph": "complete"}), (target_tracking_v0, "cooperative-mpc", {})],
    ids=["on rails", "in flight"],
)
def test_vehicles_that_share_bearings_find_the_target_and_know_how_well(module, name, options):
    env = module.parallel_env(sensor=BEARINGS, **options)
    nees = []
    for seed in range(3):
        error, P = estimates(env, make_policy(name, env), seed)
        assert np.linalg.norm(error[40:, :, :3], axis=2).mean() < 0.15, "m"
        nees.append(np.einsum("tni,tnij,tnj->tn", error, np.linalg.inv(P), error))
    # 6 on average for an honest filter; vehicles share measurements, hence wide bounds.
    assert 0.3 < np.mean(nees) / 6.0 < 1.7
    assert np.max(nees) < 60.0, "never lost"


def test_one_vehicle_alone_does_not_see_the_distance():
    alone = np.zeros((1, 3))
    z = range_azimuth_elevation(np.array([[6.0, 0.0, 0.0]]))
    state = ekf.initial_filter(np.array([[4.0, 0.0, 0.0]]), (0.0, 0.0, 0.0), (3.0, 1.0))
    for _ in range(50):
        state, _ = ekf.update(
            state, Measurements(z[None], alone[None], None, None, SIGMA, sensor_rows(BEARINGS))
        )
    assert state.P[0, 0, 0] > 8.9 and max(state.P[0, 1, 1], state.P[0, 2, 2]) < 0.01


def test_trilateration_is_refused_without_ranges():
    env = cooperative_estimation_v0.parallel_env(sensor=BEARINGS)
    with pytest.raises(ValueError, match="trilateration needs ranges"):
        make_policy("trilateration", env)
