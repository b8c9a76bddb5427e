"""Flights side by side in the rows of a vector environment, against the same flown one at a time."""

import math
import tracemalloc

import gymnasium as gym
import numpy as np
import pytest

from baselines import PolicyError, evaluate, make_policy, measure, run_episodes
from baselines.evaluation.amounts import _EPISODE_BYTES
from baselines.evaluation.evaluate import fly_and_measure
from baselines.evaluation.rollout import TIMED_STARTS, TIMED_STEPS, time_decisions
from baselines.evaluation.row_forms import has_row_form, row_form
from baselines.evaluation.rows import row_episodes
from baselines.policies.independence import has_independent_rows
from baselines.policies.protocol import PolicyState
from baselines.policies.tracking import ControllerPolicy
from baselines.sweeps.unit_flights import flight_arrays
from quad_envs import cooperative_estimation_v0, formation_v0, target_tracking_v0
from quad_envs.envs.tracking.env import TrackingEnv

HELIX, RANDOM = "quad/HelixTracking-v0", "quad/RandomTracking-v0"
TIMES = ("decision_p50_ms", "decision_p99_ms", "decision_max_ms")
SHORT = {"time_limit": 1.5}


def random_task(rng):
    """Arguments of a task in which something binds, blows, is noisy or crashes."""
    given = {"time_limit": float(rng.choice([1.0, 2.5])), "preview": int(rng.choice([25, 30]))}
    choices = {
        "kappa": float(rng.uniform(0.3, 0.6)),
        "tilt_limit": float(rng.uniform(0.1, 0.5)),
        "velocity_limit": float(rng.uniform(0.5, 2.0)),
        "rate_limit": float(rng.uniform(2.0, 30.0)),
        "position_limit": ((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0)),
        "disturbance": "gusts",
        "sensor_noise": 0.02,
        "randomize": 0.1,
        "start_box": (2.0, 2.0, 2.0, 2.0, 2.0, 2.0, 1.2, 1.2, 1.0, 3.0, 3.0, 3.0),
        "lost_distance": 4.0,
        "reward": "quadratic",
    }
    return given | {name: value for name, value in choices.items() if rng.random() < 0.4}


def assert_same(singles, together):
    """Every field of two flights, but for the times of decisions."""
    assert [(one.seed, one.agent) for one in singles] == [(one.seed, one.agent) for one in together]
    for one, other in zip(singles, together, strict=True):
        assert one.task == other.task
        for name, value in one._asdict().items():
            if name == "signals":
                assert value.keys() == other.signals.keys()
                for key, entries in value.items():
                    np.testing.assert_array_equal(entries, other.signals[key], err_msg=key)
            elif name not in ("task", "decision_times"):
                np.testing.assert_array_equal(value, getattr(other, name), err_msg=name)


def both(policy, env, episodes, seed=0):
    rows = row_form(env, episodes)
    return list(run_episodes(policy, env, episodes, seed)), list(
        row_episodes(policy, rows, episodes, seed, refill=True)
    )


@pytest.mark.parametrize("number", range(8))
def test_rows_fly_the_flights_of_single_environments_in_random_tasks(number):
    rng = np.random.default_rng(number)
    env = gym.make(str(rng.choice([HELIX, RANDOM])), **random_task(rng))
    policy = make_policy(str(rng.choice(["lmpc", "lqr", "sdc-nmpc", "random"])), env)
    singles, together = both(policy, env, 9, seed=int(rng.integers(1000)))
    assert_same(singles, together)


@pytest.mark.parametrize("name", ["apg-random", "nmpc", "feedback-linearization", "sdre"])
def test_every_kind_of_policy_flies_in_rows_as_alone(name):
    env = gym.make(RANDOM, **SHORT)
    singles, together = both(make_policy(name, env), env, 6)
    assert_same(singles, together)


def test_the_numbers_of_a_network_are_those_of_single_flights():
    env = gym.make(RANDOM)
    policy = make_policy("apg-random", env)
    alone = [measure(episode) for episode in run_episodes(policy, env, 6)]
    for one, other in zip(alone, evaluate(policy, env, 6).records, strict=True):
        for name, value in one._asdict().items():
            if name not in TIMES:
                np.testing.assert_array_equal(value, getattr(other, name), err_msg=name)


def test_rows_that_end_early_fly_the_next_starts_and_the_order_stays():
    env = gym.make(HELIX, kappa=0.5, tilt_limit=0.4, sensor_noise=0.01)
    policy = make_policy("random", env)
    singles, together = both(policy, env, 150, seed=3)
    lengths = {len(episode.rewards) for episode in singles}
    assert len(lengths) > 5 and row_form(env, 150).num_envs < 150
    assert_same(singles, together)


TEAMS = [
    (formation_v0, "consensus-mpc", {"terminate": "agent"}),
    (formation_v0, "random", {"terminate": "agent", "vehicles": 3}),
    (formation_v0, "random", {"terminate": "team", "vehicles": 3}),
    (target_tracking_v0, "random", {"vehicles": 3, "formation": "lattice"}),
    (cooperative_estimation_v0, "ekf", {}),
    pytest.param(target_tracking_v0, "cooperative-mpc", {}, marks=pytest.mark.slow),  # it compiles for long
]


@pytest.mark.parametrize(("module", "name", "kwargs"), TEAMS)
def test_teams_fly_in_rows_as_alone(module, name, kwargs):
    env = module.parallel_env(**SHORT, **kwargs)
    policy = make_policy(name, env)
    assert has_row_form(policy, env)
    singles, together = both(policy, env, 5)
    assert_same(singles, together)
    size = singles[0].team_size
    for t in range(5):
        one, other = (flight_arrays(flights[t * size : (t + 1) * size]) for flights in (singles, together))
        del one["decision_times"], other["decision_times"]
        assert one.keys() == other.keys()
        for key, value in one.items():
            np.testing.assert_array_equal(value, other[key], err_msg=key)


@pytest.mark.parametrize(("module", "name", "kwargs"), TEAMS[1:3])
def test_evaluations_of_teams_are_those_of_single_flights(module, name, kwargs):
    env = module.parallel_env(**SHORT, **kwargs)
    policy = make_policy(name, env)
    found = evaluate(policy, env, 4, seed=2)
    alone = [measure(episode) for episode in run_episodes(policy, env, 4, seed=2)]
    for one, other in zip(alone, found.records, strict=True):
        nothing = dict.fromkeys(TIMES, 0.0)
        assert repr(one._replace(**nothing)) == repr(other._replace(**nothing))
    assert found.vehicles == kwargs["vehicles"] and found.team_ms[0] > found.decision_ms[0] > 0.0


class Theirs:
    """A policy of somebody else, which counts its decisions in an attribute and its rows."""

    def __init__(self):
        self.rows, self.calls = set(), 0

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        self.rows.add(len(observation))
        self.calls += 1
        return np.full((len(observation), 4), 1e-3 * (self.calls % 7), dtype=np.float32), None


class TheirRows(Theirs):
    independent_rows = True

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        self.rows.add(len(observation))
        return np.full((len(observation), 4), 1e-3, dtype=np.float32), None


class Counting(ControllerPolicy):
    """One of ours, changed by somebody else."""


def test_a_policy_from_outside_is_shown_one_flight_unless_it_says_that_its_rows_are_independent():
    env = gym.make(HELIX, **SHORT)
    one, many = Theirs(), TheirRows()
    alone = evaluate(one, env, 4)
    assert one.rows == {1} and all(record.decision_p50_ms > 0.0 for record in alone.records)
    evaluate(many, env, 4)
    assert many.rows == {1, 4}  # one at a time to time them


def test_what_may_remember_in_its_own_way_is_flown_alone():
    env = gym.make(HELIX, **SHORT)
    ours = make_policy("lqr", env)
    assert has_independent_rows(ours)
    assert not has_independent_rows(Counting(ours.controller, ours.task, "counting"))

    class Law:
        horizon, memory_size = 0, 0

    assert not has_independent_rows(ControllerPolicy(Law(), ours.task, "law"))
    changed = make_policy("lqr", env)
    changed.predict = lambda *given, **more: ours.predict(*given, **more)
    assert not has_independent_rows(changed)
    refusing = make_policy("lqr", env)
    refusing.independent_rows = False
    assert not has_independent_rows(refusing)
    formation = formation_v0.parallel_env(vehicles=3)
    assert not has_independent_rows(make_policy("central-mpc", formation))


class Mine(TrackingEnv):
    """An environment of somebody else."""


@pytest.mark.parametrize(
    "wrap",
    [
        lambda: gym.wrappers.RecordEpisodeStatistics(gym.make(HELIX)),
        lambda: gym.wrappers.TimeLimit(gym.make(HELIX), 50),
        lambda: gym.make(HELIX, render_mode="rgb_array"),
        lambda: Mine(),
        lambda: gym.make_vec(HELIX, num_envs=2),
    ],
)
def test_an_environment_without_a_vector_form_is_flown_itself(wrap):
    env = wrap()
    assert not has_row_form(make_policy("lqr", env), env)


@pytest.mark.parametrize("kwargs", [{}, {"max_episode_steps": 30}, {"vehicle": "crazyflie"}, SHORT])
def test_rows_are_of_the_task_of_their_environment(kwargs):
    env = gym.make(HELIX, **kwargs)
    assert row_form(env, 3).task == env.unwrapped.task


def test_decisions_are_timed_one_at_a_time_in_short_flights():
    env = gym.make(HELIX)
    policy = make_policy("lqr", env)
    timed = time_decisions(policy, env, 5)
    assert [len(times) for times in timed] == [TIMED_STEPS] * TIMED_STARTS
    flights = []
    found = fly_and_measure(policy, env, 22, 5, flights.append, timed=timed)
    assert found.decision_ms[2] == pytest.approx(1e3 * np.max(timed))
    for k, (flight, record) in enumerate(zip(flights, found.records, strict=True)):
        if k < TIMED_STARTS:
            assert np.array_equal(flight.decision_times[:TIMED_STEPS], timed[k])
            assert record.decision_max_ms == pytest.approx(1e3 * timed[k].max())
        else:
            assert math.isnan(record.decision_p50_ms)
        assert np.isnan(flight.decision_times[TIMED_STEPS:]).all()


class Breaks(TheirRows):
    """Breaks off in the middle of a flight."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        self.calls += 1
        if len(observation) > 1 and self.calls > 420:
            raise RuntimeError("no more")
        return super().predict(observation, state, episode_start, deterministic)


def test_a_policy_that_breaks_off_in_rows_is_named_with_its_line_and_where_it_was():
    env = gym.make(HELIX)
    with pytest.raises(
        PolicyError, match=r"from seeds 3 to 6, step \d+: RuntimeError: no more; .*, line \d+"
    ):
        evaluate(Breaks(), env, 4, seed=3)


def test_an_action_that_is_not_finite_is_named_with_its_row_its_start_and_its_step():
    class Bad(TheirRows):
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            actions, state = super().predict(observation)
            if len(observation) > 1:
                self.calls += 1
                actions[2, 1] = np.nan if self.calls == 8 else 0.0
            return actions, state

    with pytest.raises(ValueError, match="row 2 from seed 12, step 7: the action is not finite"):
        evaluate(Bad(), gym.make(HELIX), 4, seed=10)


def test_rows_that_wait_do_not_change_what_is_kept():
    env = gym.make(HELIX, kappa=0.5, tilt_limit=0.4, sensor_noise=0.01)
    policy = make_policy("random", env)
    flights, copies = [], []
    for flight in row_episodes(policy, row_form(env, 40), 40, 0, refill=True):
        flights.append(flight)
        copies.append((flight.states.copy(), flight.rewards.copy(), flight.references.copy()))
    for flight, (states, rewards, references) in zip(flights, copies, strict=True):
        assert np.array_equal(flight.states, states) and np.array_equal(flight.rewards, rewards)
        assert np.array_equal(flight.references, references)


def test_of_flights_that_ended_only_numbers_are_kept():
    env = gym.make(HELIX)
    policy = make_policy("hover", env)
    timed, peaks = time_decisions(policy, env), []
    for flights in (192, 448):  # of rows that fly several times
        fly_and_measure(policy, env, flights, timed=timed)
        tracemalloc.start()
        fly_and_measure(policy, env, flights, timed=timed)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] - peaks[0] < 256 * _EPISODE_BYTES  # a flight as arrays has 70 kB


class Remembers(TheirRows):
    """Counts the steps of each row in its state."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        n = len(observation)
        steps = np.zeros(n) if state is None else state
        steps = np.where(np.zeros(n, bool) if episode_start is None else episode_start, 0.0, steps)
        action = np.repeat(np.where(steps[:, None] % 3 == 0, 0.5, -0.4), 4, axis=1).astype(np.float32)
        return action, steps + 1.0


def test_the_state_of_a_row_begins_anew_with_each_of_its_flights():
    env = gym.make(HELIX, start_box=(1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.3, 1.3, 1.0, 4.0, 4.0, 4.0))
    singles, together = both(Remembers(), env, 100)
    assert len({len(flight.rewards) for flight in singles}) > 3
    assert_same(singles, together)
    assert not isinstance(Remembers().predict(np.zeros((1, 3)))[1], PolicyState)
