"""A target filter that is lost comes back, one that is right is left alone; false measurements are shed."""

import numpy as np
import pytest
from estimation_runs import DT, RAILS, SIGMA, START, cv_truth, fly, readable_restart, start_filters

from baselines import EstimateWrapper, make_policy
from controllers.estimation import Measurements, ekf
from controllers.estimation.ekf_kernels import ALONE_LIMIT
from controllers.estimation.trilateration import Reason, trilaterate
from quad_envs import cooperative_estimation_v0, target_tracking_v0
from quad_envs.sensors import range_azimuth_elevation

RESTART = ekf.Restart((0.2, -0.1, 0.0), (0.5, 0.5, 0.5, 1.0, 1.0, 1.0))


def wrong_filter(n, sigmas, rng, sigma=0.5):
    """Filters whose mean is that many standard deviations off, in all directions."""
    way = rng.normal(size=(n, 3))
    way *= sigmas * sigma / np.linalg.norm(way, axis=1, keepdims=True)
    return ekf.initial_filter(START[:3] + way, START[3:], (sigma, 0.5))


def readings(n, m, rng):
    """Measurements of the first m vehicles, of the target at its start."""
    place = np.tile(RAILS[:m], (n, 1, 1))
    z = range_azimuth_elevation(START[:3] - place)
    return z + SIGMA * rng.normal(size=z.shape), place


def errors(state):
    return np.linalg.norm(state.x[:, :3] - START[:3], axis=1)


@pytest.mark.parametrize("m", [1, 2, 4])
@pytest.mark.parametrize("sigmas", [16.0, 40.0])
def test_one_measurement_of_range_and_angles_brings_a_lost_filter_back(m, sigmas):
    rng = np.random.default_rng(0)
    z, place = readings(200, m, rng)
    new, said = ekf.update(wrong_filter(200, sigmas, rng), Measurements(z, place, None, None, SIGMA, 3))
    assert said.restarted.all() and (said.nis > ALONE_LIMIT * said.rows).all()
    # From the origin the target is 7.3 m away: 0.1 m and 0.15 m of noise; 1 m is five of its deviations.
    assert errors(new).max() < 1.0
    e = new.x[:, :3] - START[:3]
    anees = (e * np.linalg.solve(new.P[:, :3, :3], e[..., None])[..., 0]).sum(axis=1).mean() / 3.0
    assert 0.85 < anees < 1.15  # 200 runs of 3 degrees of freedom: 1 +- 3 x 0.058 at most


def test_the_restart_agrees_with_its_readable_twin():
    rng = np.random.default_rng(1)
    for _ in range(40):
        m = int(rng.integers(1, 5))
        z, place = readings(1, m, rng)
        age = rng.uniform(0.0, 0.3, (1, m))
        new, said = ekf.update(
            wrong_filter(1, 60.0, rng), Measurements(z, place, age, None, SIGMA, 3), restart=RESTART
        )
        x, P = readable_restart(z[0], place[0], age[0], RESTART)
        assert said.restarted[0]
        np.testing.assert_allclose(new.x[0], x, atol=1e-9)
        np.testing.assert_allclose(new.P[0], P, atol=1e-8)  # derivatives of the twin: central differences


def test_a_filter_that_is_right_never_restarts():
    truth = cv_truth(20, np.random.default_rng(2))
    state = start_filters(truth.target[0], 0.25 * np.eye(6), np.random.default_rng(3))

    def never(state, measured):
        return ekf.update(state, measured, restart=None)

    def predict(state):
        return ekf.predict(state, DT, 0.02)

    with_restart, without = (fly(truth, state, predict, 3, update=how) for how in (ekf.update, never))
    np.testing.assert_array_equal(with_restart.x, without.x)
    np.testing.assert_array_equal(with_restart.P, without.P)


def test_a_lost_filter_believes_no_absurd_velocity_on_its_way_back():
    truth = cv_truth(20, np.random.default_rng(4))
    far = np.concatenate([truth.target[0, :, :3] + [8.0, -4.0, 3.0], truth.target[0, :, 3:]], axis=1)
    state = start_filters(far, 0.25 * np.eye(6), np.random.default_rng(5))
    runs = fly(truth, state, lambda state: ekf.predict(state, DT, 0.02), 3)
    assert np.linalg.norm(runs.x[..., 3:], axis=-1).max() < 6.0  # its prior is 1 m/s per axis
    # After 2.5 s one cannot tell how it began.
    assert all(runs.rmse(i, slice(50, 200)) < 0.25 for i in range(4))
    assert all(runs.anees(i, slice(50, 200)) < 1.5 for i in range(4))


def test_a_false_measurement_among_good_ones_is_left_out():
    rng = np.random.default_rng(6)
    z, place = readings(50, 4, rng)
    false = z.copy()
    false[:, 2, 0] += 6.0
    good = np.tile([True, True, False, True], (50, 1))
    state = wrong_filter(50, 0.5, rng)
    new, said = ekf.update(state, Measurements(false, place, None, None, SIGMA, 3))
    expected, _ = ekf.update(state, Measurements(z, place, None, good, SIGMA, 3))
    np.testing.assert_array_equal(new.x, expected.x)
    assert (said.rejected == 1).all() and not said.restarted.any()


def test_a_lost_filter_does_not_restart_at_the_false_one_of_three():
    rng = np.random.default_rng(7)
    z, place = readings(50, 3, rng)
    z[:, 0, 1] += 1.0
    new, said = ekf.update(wrong_filter(50, 40.0, rng), Measurements(z, place, None, None, SIGMA, 3))
    assert said.restarted.all() and errors(new).max() < 1.0


def test_a_vehicle_alone_is_misled_by_a_false_measurement_for_one_step():
    rng = np.random.default_rng(8)
    z, place = readings(50, 1, rng)
    false = z + np.array([12.0, 0.0, 0.0])
    misled, _ = ekf.update(wrong_filter(50, 0.5, rng), Measurements(false, place, None, None, SIGMA, 3))
    back, said = ekf.update(ekf.predict(misled, DT, 0.02), Measurements(z, place, None, None, SIGMA, 3))
    assert errors(misled).min() > 10.0 and said.restarted.all() and errors(back).max() < 1.0


@pytest.mark.parametrize("rows", [1, 3])
@pytest.mark.parametrize("reading", [0.0, -0.5])
def test_a_range_that_is_not_positive_is_refused(rows, reading):
    rng = np.random.default_rng(9)
    z, place = readings(3, 2, rng)
    broken = z.copy()
    broken[:, 1, 0] = reading
    state = wrong_filter(3, 0.5, rng)
    new, said = ekf.update(state, Measurements(broken, place, None, None, SIGMA, rows))
    expected, _ = ekf.update(state, Measurements(z, place, None, np.tile([True, False], (3, 1)), SIGMA, rows))
    np.testing.assert_array_equal(new.x, expected.x)
    assert (said.rejected == 1).all()


def test_trilateration_refuses_ranges_that_are_not_positive():
    distance = np.linalg.norm(START[:3] - RAILS, axis=1)
    distance[3] = -distance[3]
    assert trilaterate(RAILS[None], distance[None], 0.1).reason[0] == Reason.TOO_FEW


def test_ranges_bring_a_lost_filter_to_where_they_allow():
    rng = np.random.default_rng(10)
    for m in (1, 2, 3, 4):
        z, place = readings(50, m, rng)
        new, said = ekf.update(wrong_filter(50, 40.0, rng), Measurements(z, place, None, None, SIGMA, 1))
        assert said.restarted.all()
        fits = np.linalg.norm(new.x[:, None, :3] - place, axis=-1) - z[..., 0]
        assert np.abs(fits).max() < 0.6  # ranges of 0.1 m, of which four cannot all be met
        # What the ranges leave open stays open; with four of them the filter is back.
        assert (np.linalg.eigvalsh(new.P[:, :3, :3])[:, -1] > 1.0).all() == (m < 3)
    assert np.median(errors(new)) < 0.6


def test_a_restart_says_which_deviation_is_wrong():
    z, place = readings(1, 1, np.random.default_rng(11))
    state = ekf.initial_filter(START[None, :3], START[3:], (0.5, 0.5))
    with pytest.raises(ValueError, match="six standard deviations > 0"):
        ekf.update(
            state,
            Measurements(z, place, None, None, SIGMA, 3),
            restart=ekf.Restart(sigma=(1.0, 1.0, 0.0, 1, 1, 1)),
        )


# ------------------------------------------------------------------------------- policies and the wrapper


def far_target(module, **options):
    """A scene whose target is 16 standard deviations from where the prior says."""
    with pytest.warns(UserWarning, match=r"position spreads by .* \(target_spread\).*\(prior_sigma\)"):
        return module.parallel_env(target_spread=(8.0, 0.5), prior_sigma=(0.5, 0.5), **options)


def first_errors(policy, env, seeds=8):
    out = []
    for seed in range(seeds):
        observations, _ = env.reset(seed=seed)
        rows = np.stack([observations[agent] for agent in env.agents])
        _, state = policy.predict(rows)
        where = state.estimates.r + env.unwrapped.plants[:, :3]
        out.append(np.linalg.norm(where - env.unwrapped.target[0, :3], axis=1))
    return np.array(out)


@pytest.mark.parametrize("name", ["ekf", "cooperative-mpc"])
def test_on_rails_a_policy_comes_back_within_one_observation(name):
    env = far_target(cooperative_estimation_v0)
    found = first_errors(make_policy(name, env), env)
    far = np.array([np.linalg.norm(env.reset(seed=s) and env.target[0, :3] - START[:3]) for s in range(8)])
    assert found[far > 8.0].max() < 1.0 and (far > 8.0).sum() >= 4


def test_in_flight_and_through_the_wrapper_estimates_come_back():
    env = far_target(target_tracking_v0)
    assert np.median(first_errors(make_policy("cooperative-mpc", env), env)) < 0.3
    shared = EstimateWrapper(env)
    assert np.median(first_errors(make_policy("cooperative-mpc", shared), shared)) < 0.3


def test_a_prior_as_wide_as_the_target_spreads_is_no_warning(recwarn):
    target_tracking_v0.parallel_env(target_spread=(3.0, 1.0))
    cooperative_estimation_v0.parallel_env()
    assert not recwarn
