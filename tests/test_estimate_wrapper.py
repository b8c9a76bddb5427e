"""The wrapper that shares estimates: what agents are told, how it is fused, and PettingZoo's conformance."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test, parallel_seed_test
from policy_flights import fly

from baselines import check_policy, make_policy
from baselines.policies.estimate_wrapper import EstimateWrapper
from controllers.estimation import covariance_intersection
from controllers.estimation.ekf import constant_velocity_model
from quad_envs import cooperative_estimation_v0, formation_v0, target_tracking_v0


def wrapped(fusion="trace", q=None, module=target_tracking_v0, **options):
    return EstimateWrapper(module.parallel_env(**options), fusion, q)


def rows_of(seen):
    return np.stack(list(seen.values()))


def hover(env):
    return {name: np.zeros(env.action_space(name).shape, np.float32) for name in env.agents}


def covariances(blocks):
    return blocks[..., 7:][..., np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])]


@pytest.mark.parametrize("module", [target_tracking_v0, cooperative_estimation_v0])
def test_the_wrapped_environment_passes_the_checks_of_pettingzoo(module):
    parallel_api_test(wrapped(module=module, max_cycles=40), num_cycles=60)


def test_the_wrapped_environment_is_a_function_of_its_seed():
    parallel_seed_test(lambda: wrapped(max_cycles=20), num_cycles=30)


def test_the_observation_gains_the_block_and_keeps_the_rest():
    plain, env = target_tracking_v0.parallel_env(), wrapped()
    first, _ = plain.reset(seed=4)
    second, _ = env.reset(seed=4)
    size = plain.task.layout.size
    assert env.task.layout.size == size + 6 * 13 and not env.unwrapped.task.layout.estimate
    for name in env.agents:
        np.testing.assert_array_equal(second[name][:size], first[name])
        assert second[name].dtype == np.float32 and env.observation_space(name).contains(second[name])
        assert env.observation_space(name) is env.observation_space(name)


def test_without_fusion_every_agent_has_the_estimate_of_its_own_filter():
    env = wrapped("none", drop_out=0.2)
    policy, state = make_policy("cooperative-mpc", env.unwrapped), None
    seen, _ = env.reset(seed=0)
    layout = env.task.layout
    for _ in range(30):
        rows = rows_of(seen)
        _, state = policy.predict(rows[:, : env.unwrapped.task.layout.size], state)
        block = layout.decode(rows).estimate
        np.testing.assert_allclose(block[:, 0, 1:4], state.estimates.r, rtol=0, atol=1e-5)  # float32
        np.testing.assert_allclose(block[:, 0, 4:7], state.estimates.v, rtol=0, atol=1e-6)
        P = covariances(block[:, 0])
        np.testing.assert_allclose(P, state.estimates.P[:, :3, :3], rtol=1e-5, atol=1e-8)
        assert (block[:, 0, 0] == 1.0).all() and not block[:, 1:].any()
        seen, *_ = env.step(hover(env))


@pytest.mark.parametrize("delay", [0, 2])
def test_a_slot_tells_the_senders_estimate_of_before_fusion(delay):
    """Against filters run beside: the message's sender, moved on by its age, seen from the receiver."""
    env = wrapped("trace", delay=delay, measuring=(0, 1), graph="case-2", module=target_tracking_v0)
    dt, q = 0.05, env.estimator.q
    seen, _ = env.reset(seed=0)
    believed, places = [], []
    for k in range(6):
        places.append(env.plants[:, :3])
        x, _ = env._shared.sent(k)
        believed.append(x + np.pad(places[k], ((0, 0), (0, 3))))
        block = env.task.layout.decode(rows_of(seen)).estimate
        for i in range(6):
            for s, j in enumerate(env.senders[i]):
                told = block[i, 1 + s]
                if j < 0 or k < delay:
                    assert not told.any()
                    continue
                F, _ = constant_velocity_model(delay * dt, q)
                wanted = F @ believed[k - delay][j] - np.pad(places[k][i], (0, 3))
                np.testing.assert_allclose(told[1:7], wanted, rtol=0, atol=1e-5)  # float32
        seen, *_ = env.step(hover(env))


@pytest.mark.parametrize("fusion", ["trace", "equal", "determinant"])
def test_the_own_estimate_is_the_intersection_of_all(fusion):
    env = wrapped(fusion)
    env.reset(seed=0)
    for _ in range(5):
        seen, *_ = env.step(hover(env))
    x, P = env._shared.sent(5)
    p = env.plants[:, :3]
    block = env.task.layout.decode(rows_of(seen)).estimate
    for i in range(6):
        known = [i, *(j for j in env.senders[i] if j >= 0)]
        moved = x[known] + np.pad(p[known] - p[i], ((0, 0), (0, 3)))
        fused = covariance_intersection(moved[None], P[known][None], None, fusion)
        np.testing.assert_allclose(block[i, 0, 1:7], fused.x[0], rtol=0, atol=1e-5)
        np.testing.assert_allclose(covariances(block[i, 0]), fused.P[0, :3, :3], rtol=1e-5, atol=1e-9)


def test_a_message_is_fused_once():
    env = wrapped("equal", drop_out=0.6)
    env.reset(seed=0)
    for _ in range(20):
        seen, _, _, _, infos = env.step(hover(env))
        block = env.task.layout.decode(rows_of(seen)).estimate
        arrived = [info["messages"] for info in infos.values()]
        np.testing.assert_array_equal((block[:, 1:, 0] > 0).sum(axis=1), arrived)


def test_infos_tell_consistency():
    env = wrapped("none", measuring=(0, 1), graph="case-2")
    _, infos = env.reset(seed=0)
    _, _, _, _, infos = env.step(hover(env))
    assert infos["quad_0"]["nis_rows"] == 6 and infos["quad_0"]["nis"] > 0.0
    assert infos["quad_5"]["nis_rows"] == 0 and np.isnan(infos["quad_5"]["nis"])
    assert all(np.isfinite(info["nees"]) for info in infos.values())


def test_agents_that_crash_vanish():
    env = wrapped(terminate="agent")
    env.reset(seed=0)
    actions = hover(env)
    actions["quad_2"] = np.array([0.0, 1.0, 0.0, -1.0], np.float32)
    told = []
    for _ in range(60):
        alive = env.agents
        seen, _, _, _, infos = env.step({name: actions[name] for name in alive})
        assert set(seen) == set(infos) == set(alive)
        told.append(env.task.layout.decode(rows_of(seen)).estimate[:, 1:, 0].sum())
    assert "quad_2" not in env.agents and len(env.agents) == 5
    assert told[-1] == told[0] - 4  # two neighbours on the ring, both ways


def test_a_policy_reads_the_shared_estimates_by_default():
    env = wrapped()
    shared, own = make_policy("cooperative-mpc", env), make_policy("cooperative-mpc", env, estimates="own")
    assert shared.estimator is None and own.estimator is not None
    check_policy(shared, env)
    flight = fly(shared, env, steps=60)
    assert flight.estimate_rms(1.0).max() < 0.1
    assert np.isnan(flight.state.estimates.P[:, 3:, 3:]).all()


def test_on_rails_the_shared_estimate_is_the_answer():
    env = wrapped(module=cooperative_estimation_v0)
    policy = make_policy("cooperative-mpc", env)
    check_policy(policy, env)
    seen, _ = env.reset(seed=0)
    actions, _ = policy.predict(rows_of(seen))
    block = env.task.layout.decode(rows_of(seen)).estimate
    np.testing.assert_allclose(20.0 * actions[:, :3], block[:, 0, 1:4], rtol=0, atol=2e-6)


def test_the_own_filter_of_a_policy_does_not_see_the_block():
    env = wrapped()
    own = fly(make_policy("cooperative-mpc", env, estimates="own"), env, steps=30)
    plain = target_tracking_v0.parallel_env()
    np.testing.assert_array_equal(
        fly(make_policy("cooperative-mpc", plain), plain, steps=30).actions, own.actions
    )


def test_a_wrapped_environment_pickles_in_the_middle_of_an_episode():
    env = wrapped()
    env.reset(seed=0)
    twin = pickle.loads(pickle.dumps(env))
    first, second = env.step(hover(env)), twin.step(hover(twin))
    np.testing.assert_array_equal(rows_of(first[0]), rows_of(second[0]))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: EstimateWrapper(formation_v0.parallel_env()),
            "no target to estimate in 'quad/For",
        ),
        (lambda: EstimateWrapper(wrapped()), "without estimates"),
        (lambda: EstimateWrapper(object()), "needs a ParallelEnv of this suite"),
        (lambda: wrapped("majority"), "unknown fusion 'majority'"),
        (lambda: wrapped(q=-1.0), "q must be finite and >= 0"),
        (lambda: make_policy("cooperative-mpc", wrapped(), q=0.1), "give it to the EstimateWrapper"),
    ],
)
def test_what_is_not_allowed_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.slow
def test_intersection_by_trace_is_consistent_and_better_than_the_own_measurements():
    """4-ring, own range-azimuth-elevation fused with two neighbours at every step, with feedback (8.4)."""
    error, normalised = {}, {}
    for fusion in ("none", "trace"):
        env = wrapped(fusion, module=cooperative_estimation_v0, graph="ring", message_lifetime=2.0)
        flights = [fly(make_policy("cooperative-mpc", env), env, seed=seed) for seed in range(10)]
        tail = [flight.estimate_error[40:] for flight in flights]
        error[fusion] = np.sqrt(np.mean([(e**2).sum(axis=-1).mean() for e in tail]))
        told = [infos.values() for flight in flights for infos in flight.infos[40:]]
        normalised[fusion] = np.mean([[info["nees"] for info in infos] for infos in told]) / 3.0
    assert error["trace"] < error["none"] and normalised["trace"] < 1.2
