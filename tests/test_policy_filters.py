"""The target filters of policies: that of the estimation package, its start, and the answers on rails."""

from __future__ import annotations

import numpy as np
import pytest
from policy_flights import fly

from baselines import make_policy
from baselines.policies.registry import TEAM_POLICIES, serving
from controllers.estimation import Measurements, ekf
from quad_envs import cooperative_estimation_v0, formation_v0, target_tracking_v0
from quad_envs.sensors import sensor_rows

MODULES = {"target-tracking": target_tracking_v0, "estimation": cooperative_estimation_v0}
HONEST = [
    (name, mission) for mission in MODULES for name in serving(mission) if not TEAM_POLICIES[name].privileged
]


def rows_of(seen):
    return np.stack(list(seen.values()))


def twin_filter(env, flight, agent, q):
    """The filter of one agent by the functions of `controllers.estimation`, with the vehicle's true way."""
    task, states = env.task, []
    positions = flight_positions(env, len(flight.observations))
    for k, rows in enumerate(flight.observations):
        view = task.layout.decode(rows[agent])
        if k == 0:
            belief = ekf.initial_filter(-view.slot[None], task.prior_velocity, task.prior_sigma)
        else:
            way = positions[k, agent] - positions[k - 1, agent]
            belief = ekf.shift(ekf.predict(belief, task.dt, q), way[None])
        places = np.concatenate([np.zeros((1, 3)), view.comm[:, 2:5]])
        ages = np.concatenate([[0.0], view.comm[:, 1]])
        measured = view.measured
        z = np.stack([measured[:, 1], np.arctan2(measured[:, 2], measured[:, 3]), measured[:, 4]], axis=1)
        rows_used = sensor_rows(task.sensor)
        belief, _ = ekf.update(
            belief,
            Measurements(
                z[None], places[None], ages[None], measured[None, :, 0] > 0, task.sensor_sigma, rows_used
            ),
        )
        states.append(belief)
    return states


def flight_positions(env, steps):
    """True positions of vehicles on rails."""
    rails, v = env.unwrapped._batch.options.rail_positions(), env.unwrapped._batch.options.rail_velocity
    return rails + 0.05 * np.arange(steps)[:, None, None] * np.array(v)


@pytest.mark.parametrize(
    "options",
    [{}, {"sensor": "range"}, {"delay": 3}, {"drop_out": 0.3}, {"detection": 0.5, "delay": 1}],
    ids=str,
)
def test_the_filter_is_that_of_the_estimation_package(options):
    env = cooperative_estimation_v0.parallel_env(**options)
    policy = make_policy("ekf", env)
    # With two ranges the target slides on a circle: from step 40 on the filter amplifies float32's digits.
    flight = fly(policy, env, steps=35 if "sensor" in options else 60)
    for agent in range(4):
        belief = twin_filter(env, flight, agent, 0.02)[-1]
        estimates = flight.state.estimates
        x = np.concatenate([estimates.r[agent], estimates.v[agent]])
        # The way is integrated from float32 velocities.
        np.testing.assert_allclose(x, belief.x[0], rtol=0, atol=1e-5)
        np.testing.assert_allclose(estimates.P[agent], belief.P[0], rtol=1e-4, atol=1e-7)


def test_the_way_of_a_flying_vehicle_is_that_of_its_velocity():
    with pytest.warns(UserWarning, match="no spanning tree"):
        env = target_tracking_v0.parallel_env(detection=0.0, target="static", prior_velocity=(0.0, 0.0, 0.0))
    policy, state = make_policy("cooperative-mpc", env), None
    seen, _ = env.reset(seed=1)
    first = None
    rng = np.random.default_rng(0)
    for _ in range(12):
        _, state = policy.predict(rows_of(seen), state)
        expected = state.estimates.r + env.plants[:, :3]
        first = expected if first is None else first
        np.testing.assert_allclose(expected, first, rtol=0, atol=1e-3)
        actions = rng.uniform(-0.3, 0.3, (6, 4)).astype(np.float32)
        seen, *_ = env.step(dict(zip(env.agents, actions, strict=True)))
    assert np.linalg.norm(env.plants[:, 3:6], axis=1).min() > 0.1  # they did fly


def test_a_vague_filter_starts_where_the_first_measurement_says():
    env = target_tracking_v0.parallel_env(
        prior_sigma=(5.0, 1.0), formation=((-40.0, 0.0, 0.0), (-40.0, 2.0, 1.0)), vehicles=2, graph="chain",
        measuring=(0,), start=((0.0, 0.0, 0.0), (0.0, 2.0, 0.0)),
    )  # fmt: skip
    seen, _ = env.reset(seed=0)
    _, state = make_policy("cooperative-mpc", env).predict(rows_of(seen))
    error = state.estimates.r + env.plants[:, :3] - env.target[0, :3]
    # 3 m away, noise 0.1 m and 0.06 m; the prior was 37 m off.
    assert np.linalg.norm(error, axis=1).max() < 0.5


def test_a_sharp_prior_is_kept():
    env = cooperative_estimation_v0.parallel_env()
    policy = make_policy("ekf", env)
    seen, _ = env.reset(seed=0)
    _, state = policy.predict(rows_of(seen))
    np.testing.assert_array_less(state.estimates.P[:, 0, 0], 0.25)
    assert (np.linalg.norm(state.estimates.r + env.plants[:, :3] - env.target[0, :3], axis=1) < 0.6).all()


def test_without_detection_the_estimate_is_the_prior_and_the_formation_holds():
    with pytest.warns(UserWarning, match="no spanning tree"):
        env = target_tracking_v0.parallel_env(detection=0.0)
    flight = fly(make_policy("cooperative-mpc", env), env, steps=100)
    estimates = flight.state.estimates
    assert flight.gap.min() > 0.4 and (estimates.rows == 0).all() and np.isnan(estimates.nis).all()
    assert estimates.modes == ("EKF,0",) * 6
    assert (np.trace(estimates.P[:, :3, :3], axis1=1, axis2=2) > 27.0).all()  # grows from 3 x 3 m^2


def test_without_messages_followers_stay_where_they_are():
    with pytest.warns(UserWarning, match="no spanning tree"):
        env = formation_v0.parallel_env(drop_out=1.0, start="sorted")
    policy = make_policy("consensus-mpc", env)
    env.reset(seed=0)
    before = env.plants[1:, :3]
    flight = fly(policy, env, steps=200)
    assert flight.error[-1, 0] < 0.01
    assert np.abs(env.plants[1:, :3] - before).max() < 0.05


def test_without_messages_every_vehicle_follows_what_it_measures():
    env = target_tracking_v0.parallel_env(drop_out=1.0)
    flight = fly(make_policy("cooperative-mpc", env), env)
    assert flight.truncated and flight.gap.min() > 0.4
    assert flight.estimate_rms().max() < 0.15 and flight.rms().max() < 0.1


def test_trilateration_serves_while_four_ranges_are_held():
    env = cooperative_estimation_v0.parallel_env()
    policy, state, modes = make_policy("trilateration", env), None, []
    seen, _ = env.reset(seed=0)
    while env.agents:
        actions, state = policy.predict(rows_of(seen), state)
        modes.append(state.estimates.modes)
        seen, *_ = env.step(dict(zip(env.agents, actions, strict=True)))
    first = [mode[0] for mode in modes]
    assert first[:50].count("trilateration") >= 48 and first[60] == "EKF,3" and first[120] == "EKF,2"
    assert all("trilateration" not in mode[3] for mode in modes)
    np.testing.assert_array_equal(state.fallbacks, [[200, 0, 0, 0, 0]] * 4)  # no solver, no fallback


def test_where_nothing_is_trilaterated_the_two_estimators_agree():
    env = cooperative_estimation_v0.parallel_env(graph="chain")  # two measurements at most
    first, second = (fly(make_policy(name, env), env, steps=50) for name in ("ekf", "trilateration"))
    np.testing.assert_array_equal(first.actions, second.actions)


@pytest.mark.parametrize(("name", "mission"), HONEST)
def test_only_a_policy_that_trilaterates_says_whether_it_did(name, mission):
    env = MODULES[mission].parallel_env()
    estimates = fly(make_policy(name, env), env, steps=2).state.estimates
    said = estimates is not None and estimates.trilaterated is not None
    assert said == (name == "trilateration")


def test_on_rails_the_cooperative_policy_answers_with_its_estimate():
    env = cooperative_estimation_v0.parallel_env()
    flight = fly(make_policy("cooperative-mpc", env), env, steps=50)
    believed = 20.0 * flight.actions[-1, :, :3]
    np.testing.assert_allclose(believed, flight.state.estimates.r, rtol=0, atol=2e-6)
    np.testing.assert_allclose(5.0 * flight.actions[-1, :, 3:], flight.state.estimates.v, rtol=0, atol=1e-6)
    # The action is of the target at the time of the observation.
    np.testing.assert_allclose(flight.error[-1], np.linalg.norm(flight.estimate_error[-1], axis=1), atol=1e-5)
