"""A turning heading: its rate from the rows of a reference, in the reward, followed by every controller."""

import gymnasium as gym
import numpy as np
import pytest

import quad_envs
from baselines import make_policy, run_episodes
from quad_envs import Heading, Helix, SetPoint, formation_v0, from_function
from quad_envs.constraints import forces_from_actions
from quad_envs.references.trajectories import pack_rows
from quad_envs.references.turning import LARGEST_TURN, TURN_RATE, turn_rate, turning_rates, with_turn_rates
from quad_envs.reward import stage_cost
from quad_envs.rotations import euler_rate_matrix

DT = 0.05
CIRCLE = Heading(Helix(2.0, 0.8, 0.0), tangent=True)
# Yaw torque in plenty, so that the heading of the circle can be followed from the start.
AGILE = {
    "mass": 1.5,
    "inertia": (0.029125, 0.029125, 0.055225),
    "arm": 0.255,
    "yaw_moment": 0.06,
    "rotor_rate": 40.0,
    "kappa": 0.48,
}


def rows_with(psi):
    zero = np.zeros((len(psi), 3))
    return pack_rows(zero, zero, psi)


def rates_of(psi, dt=DT):
    return with_turn_rates(rows_with(np.asarray(psi, dtype=float)), dt)[:, TURN_RATE]


def yaw_error(episode):
    """Of the last state, rad."""
    rows = episode.references[-1]
    error = episode.states[-1, 8] - np.arctan2(rows[6], rows[7])
    return float((error + np.pi) % (2.0 * np.pi) - np.pi)


def score(episode):
    return episode.rewards.sum() / episode.task.episode_steps


# ------------ the rate of a heading
def test_a_steady_turn_has_its_rate_at_every_row_through_the_wrap():
    for rate in (0.3, -2.0, 6.0):
        np.testing.assert_allclose(rates_of(rate * DT * np.arange(200)), rate, atol=1e-12)


def test_the_rate_of_a_smooth_heading_is_its_derivative():
    """Central differences: h^2/6 of the third derivative, 2e-4 here; one-sided at the ends."""
    t = DT * np.arange(100)
    found = rates_of(0.8 * np.sin(0.9 * t))
    np.testing.assert_allclose(found[1:-1], 0.72 * np.cos(0.9 * t[1:-1]), atol=3e-4)
    np.testing.assert_allclose(found[[0, -1]], 0.72 * np.cos(0.9 * t[[0, -1]]), atol=0.02)


@pytest.mark.parametrize("angle", np.radians([5.0, 17.0, 60.0, 90.0, 179.0, 180.0]))
def test_a_jump_of_the_heading_is_no_rate(angle):
    """Neither where the heading rests, nor where it turns before and after; also beside the ends."""
    for rate in (0.0, 0.4):
        for k in (1, 2, 20, 38, 39):
            psi = rate * DT * np.arange(40)
            psi[k:] += angle
            np.testing.assert_allclose(rates_of(psi), rate, atol=1e-9)


def test_no_heading_has_a_rate_above_the_largest_turn():
    rng = np.random.default_rng(0)
    assert np.abs(rates_of(rng.uniform(-np.pi, np.pi, 5000))).max() <= LARGEST_TURN
    assert not rates_of(np.pi / 2 * np.arange(40)).any(), "a quarter turn per sample"


def test_a_heading_that_stays_has_exactly_no_rate():
    """Numbers of tasks without a turning heading rest on that."""
    for psi in np.random.default_rng(1).uniform(-9.0, 9.0, 50):
        assert not rates_of(np.full(30, psi)).any()


def test_the_compiled_rate_is_the_readable_one():
    rng = np.random.default_rng(2)
    for n in (1, 2, 3, 4, 30):
        for _ in range(40):
            psi = np.cumsum(rng.choice([0.0, 0.02, 0.05, -0.3, 1.5], n) * rng.uniform(0.5, 1.0, n))
            rows = rows_with(psi)
            found = [turn_rate(rows, n, i, DT) for i in range(n)]
            np.testing.assert_allclose(found, with_turn_rates(rows, DT)[:, TURN_RATE], atol=1e-10)


def test_wanted_rates_turn_the_heading_alone():
    rng = np.random.default_rng(3)
    Theta, psi_dot = rng.uniform(-1.3, 1.3, (50, 3)), rng.normal(size=50)
    Theta_dot = np.einsum("nij,nj->ni", euler_rate_matrix(Theta), turning_rates(Theta, psi_dot))
    np.testing.assert_allclose(Theta_dot, psi_dot[:, None] * [0.0, 0.0, 1.0], atol=1e-14)


# ------------ tangent headings
def out_wait_on(t):
    """Out along x for 2 s, a rest of 3 s, on along y."""
    return [min(t, 2.0), max(t - 5.0, 0.0), 0.0]


def test_a_tangent_heading_stays_where_the_path_rests():
    t = DT * np.arange(160)
    rows = Heading(from_function(out_wait_on), tangent=True).rows(t, np.random.default_rng(0))
    psi = np.arctan2(rows[:, 6], rows[:, 7])
    np.testing.assert_allclose(psi[t < 4.9], 0.0, atol=1e-9)
    np.testing.assert_allclose(psi[t > 5.1], np.pi / 2, atol=1e-9)


def test_a_tangent_heading_looks_ahead_before_the_path_sets_out():
    rows = Heading(from_function(lambda t: [0.0, max(t - 1.0, 0.0), 0.0]), tangent=True).rows(
        DT * np.arange(60), np.random.default_rng(0)
    )
    np.testing.assert_allclose(np.arctan2(rows[:, 6], rows[:, 7]), np.pi / 2, atol=1e-9)
    straight_down = Heading(Helix(0.0, 0.0, 1.0), yaw=0.3, tangent=True).rows(
        DT * np.arange(9), np.random.default_rng(0)
    )
    np.testing.assert_allclose(np.arctan2(straight_down[:, 6], straight_down[:, 7]), 0.3)


# ------------ the reward
def test_a_perfect_turn_loses_nothing():
    """At hover the rates of a steady turn are an equilibrium; round-off of the integrator is left."""
    reference = Heading(SetPoint(), yaw=0.2, rate=1.0)
    env = gym.make("quad/HelixTracking-v0", reference=reference, start_box=0.0)
    state = np.zeros(12)
    state[8], state[11] = 0.2, 1.0
    env.reset(seed=0, options={"state": state})
    for _ in range(60):
        _, reward, *_ = env.step(np.zeros(4, np.float32))
        assert reward == pytest.approx(1.0, abs=1e-9)


def test_rewards_of_a_turning_heading_are_the_readable_formula():
    """Single environment, vector environment and team on random actions."""
    single = gym.make("quad/HelixTracking-v0", reference=CIRCLE)
    many = gym.make_vec("quad/HelixTracking-v0", num_envs=9, reference=CIRCLE)
    single.reset(seed=0)
    many.reset(seed=0)
    task = single.unwrapped.task
    table = with_turn_rates(single.unwrapped.reference, task.dt)
    assert np.abs(table[:, TURN_RATE] - 0.8).max() < 1e-9
    rng = np.random.default_rng(0)
    for k in range(1, 20):
        actions = rng.uniform(-0.1, 0.1, (9, 4)).astype(np.float32)
        rewards = many.step(actions)[1]
        assert single.step(actions[0])[1] == rewards[0]
        commands = forces_from_actions(actions, task.hover_force, task.force_max)
        wanted = 1.0 / (
            1.0 + stage_cost(many.unwrapped.state, table[k], commands, task.hover_force, task.weights)
        )
        np.testing.assert_allclose(rewards, wanted, rtol=1e-12)


def test_teams_are_judged_by_the_rates_of_their_leaders_heading():
    env = formation_v0.parallel_env(vehicles=3, formation="triangle", reference=CIRCLE)
    rng, task = np.random.default_rng(0), env.task
    env.reset(seed=0)
    tables = [with_turn_rates(rows, task.dt) for rows in env.references]
    for k in range(1, 20):
        actions = rng.uniform(-0.05, 0.05, (3, 4)).astype(np.float32)
        *_, infos = env.step(dict(zip(env.possible_agents, actions, strict=True)))
        commands = forces_from_actions(actions, task.hover_force, task.force_max)
        for i, info in enumerate(infos.values()):
            loss = stage_cost(env.plants[i], tables[i][k], commands[i], task.hover_force, task.weights)
            assert info["reward_terms"][:5].sum() == pytest.approx(loss, rel=1e-12)


# ------------ controllers
@pytest.mark.parametrize("name", ["lmpc", "sdc-nmpc", "nmpc", "lqr", "sdre"])
@pytest.mark.parametrize("frame", ["heading", "hover"])
def test_a_vehicle_that_turns_with_the_heading_is_left_alone(name, frame):
    """The equilibrium of turning at hover: every law commands hover."""
    env = gym.make("quad/HelixTracking-v0", reference=Heading(SetPoint(), yaw=0.4, rate=0.7), start_box=0.0)
    state = np.zeros(12)
    state[8], state[11] = 0.4, 0.7
    observation, _ = env.reset(seed=0, options={"state": state})
    action, _ = make_policy(name, env, frame=frame).predict(observation[None])
    assert (
        np.abs(action).max() < 1e-5
    )  # observations are float32: 1e-7 over DT in the rate, times a gain of 3


@pytest.mark.parametrize("rate", [0.1, 0.3, 0.5])
@pytest.mark.parametrize("name", ["lmpc", "sdc-nmpc", "nmpc"])
def test_mpcs_follow_a_turning_heading_without_a_lasting_lag(name, rate):
    reference = Heading(SetPoint(), rate=rate)
    env = gym.make("quad/HelixTracking-v0", reference=reference, start_box=0.0, time_limit=20.0)
    episode = next(iter(run_episodes(make_policy(name, env), env, 1, seed=0)))
    assert abs(yaw_error(episode)) < 0.03  # what is left after 20 s of catching up with little yaw torque
    assert score(episode) > 0.75  # 0.27 to 0.89 while the rates were held at zero


@pytest.mark.parametrize("name", ["lqr", "sdre", "feedback-linearization"])
def test_feedback_laws_follow_a_turning_heading_without_a_lasting_lag(name):
    reference = Heading(SetPoint(), rate=0.3)
    env = gym.make("quad/HelixTracking-v0", reference=reference, start_box=0.0, time_limit=20.0)
    assert abs(yaw_error(next(iter(run_episodes(make_policy(name, env), env, 1, seed=0))))) < 0.03
    if name != "feedback-linearization":
        blind = gym.make(
            "quad/HelixTracking-v0", reference=reference, start_box=0.0, time_limit=20.0, preview=0
        )
        episode = next(iter(run_episodes(make_policy(name, blind), blind, 1, seed=0)))
        assert abs(yaw_error(episode)) > 1.0, "a window of one row does not show the rate"


@pytest.mark.parametrize("name", ["lmpc", "sdc-nmpc", "nmpc", "feedback-linearization"])
def test_a_circle_is_flown_nose_first(name):
    env = gym.make("quad/HelixTracking-v0", reference=CIRCLE, **AGILE)
    episode = next(iter(run_episodes(make_policy(name, env), env, 1, seed=0)))
    assert abs(yaw_error(episode)) < 0.05
    assert score(episode) > 0.8  # 0.25 to 0.53 before


def test_a_heading_that_turns_costs_the_frozen_model_little_of_its_position():
    """SDC-NMPC beside exact NMPC: while velocities turned with the plan it was 0.70 m beside 0.29."""
    env = gym.make("quad/HelixTracking-v0", reference=CIRCLE, **AGILE)
    rms = {}
    for name in ("sdc-nmpc", "nmpc"):
        episode = next(iter(run_episodes(make_policy(name, env), env, 1, seed=0)))
        error = episode.states[:, :3] - episode.references[: len(episode.states), :3]
        rms[name] = np.sqrt((error**2).sum(axis=1).mean())
    assert rms["sdc-nmpc"] < 1.5 * rms["nmpc"]


def test_a_leader_turns_with_its_heading():
    reference = Heading(quad_envs.Line((0.3, 0.0, 0.0)), rate=0.2)
    for name in ("consensus-mpc", "central-mpc"):
        env = formation_v0.parallel_env(vehicles=2, graph="chain", reference=reference, time_limit=12.0)
        leader = next(iter(run_episodes(make_policy(name, env), env, 1, seed=0)))
        assert not leader.crashed and abs(yaw_error(leader)) < 0.1
