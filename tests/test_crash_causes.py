"""Why a flight ended: told in infos and counted in tables, the same in single and vector environments."""

import gymnasium as gym
import numpy as np
import pytest

from baselines import evaluate, make_policy, measure, run_episodes
from baselines.evaluation.columns import Record
from baselines.evaluation.metrics import crash_causes
from quad_envs import formation_v0

HOVER = np.zeros(4, np.float32)
# What a first step at these states ends in: (place of the number in the state, number) -> cause.
ENDS = {
    "": (0, 0.0),
    "tilt": (9, 40.0),  # rad/s of roll: two radians in a step
    "lost": (3, 1500.0),  # m/s: 75 m in a step
    "not finite": (9, 1e6),  # rad/s: the Euler rates explode within a substep
}


def state_of(cause):
    state = np.zeros(12)
    place, number = ENDS[cause]
    state[place] = number
    return state


@pytest.mark.parametrize("cause", ENDS)
def test_the_info_of_one_vehicle_says_why_it_crashed(cause):
    env = gym.make("quad/Regulation-v0")
    _, info = env.reset(seed=0, options={"state": state_of(cause)})
    causes = env.unwrapped.task.crash_causes
    assert causes[info["crash_cause"]] == "", "no flight begins with a crash"
    *_, terminated, _, info = env.step(HOVER)
    assert causes[info["crash_cause"]] == cause
    assert terminated == info["crashed"] == bool(cause)


def test_each_row_of_a_vector_says_its_own_cause_and_forgets_it_at_the_next_start():
    env = gym.make_vec("quad/Regulation-v0", num_envs=len(ENDS))
    env.reset(seed=0, options={"state": np.stack([state_of(cause) for cause in ENDS])})
    *_, info = env.step(np.tile(HOVER, (len(ENDS), 1)))
    names = env.unwrapped.task.crash_causes
    assert [names[i] for i in info["crash_cause"]] == list(ENDS)
    assert info["crash_cause"].dtype == np.int64 and info["_crash_cause"].all()
    *_, info = env.step(np.tile(HOVER, (len(ENDS), 1)))
    assert not info["crash_cause"].any()


def test_infos_of_all_environments_have_the_golden_keys_and_kinds():
    """Python numbers, and arrays where there are several: what TorchRL, Gymnasium and a debugger read."""
    kinds = {
        "cost": float,
        "episode_cost": float,
        "constraint_violation": bool,
        "constraint_values": np.ndarray,
        "stage_cost": float,
        "crashed": bool,
        "crash_cause": int,
        "clipped_actions": int,
    }
    env = gym.make("quad/CorridorTracking-v0")
    _, first = env.reset(seed=0)
    *_, later = env.step(HOVER)
    for info in (first, later):
        assert {key: type(value) for key, value in info.items()} == kinds
    vector = gym.make_vec("quad/CorridorTracking-v0", num_envs=2)
    _, info = vector.reset(seed=0)
    assert {key for key in info if not key.startswith("_")} == set(kinds)
    team = formation_v0.parallel_env(vehicles=2, graph="chain")
    _, infos = team.reset(seed=0)
    of_one = {key: type(value) for key, value in infos["quad_0"].items()}
    assert {key: of_one[key] for key in kinds} == kinds


def test_a_flight_and_its_table_name_the_cause():
    env = gym.make("quad/Regulation-v0", lost_distance=6.0, time_limit=20.0)
    episode = next(run_episodes(make_policy("random", env), env, 1))
    assert episode.crashed and episode.crash_cause in ("tilt", "lost")
    assert measure(episode).crash_cause == episode.crash_cause
    found = evaluate("random", env, episodes=2)
    assert sum(found.to_dict()["crash_causes"].values()) == found.to_dict()["crashed"] == 2
    assert "crashes by: " in str(found)
    assert "crashes by" not in str(evaluate("lqr", "quad/Regulation-v0", episodes=1))


def test_a_flight_of_a_team_counts_once_for_each_of_its_causes():
    one = measure(
        next(run_episodes(make_policy("hover", "quad/Regulation-v0"), gym.make("quad/Regulation-v0"), 1))
    )
    records: list[Record] = [
        one._replace(seed=seed, agent=f"quad_{i}", crashed=True, crash_cause=cause)
        for seed, causes in enumerate(
            (("distance", "distance", ""), ("tilt", "", ""), ("distance", "tilt", ""))
        )
        for i, cause in enumerate(causes)
    ]
    assert crash_causes(records) == {"distance": 2, "tilt": 2}


@pytest.mark.parametrize("vector", [False, True])
@pytest.mark.parametrize(
    "state",
    [
        [0, 0, 0, 1e39, *[0] * 8],  # float32 has no such number
        [*[0] * 9, 1e200, 0, 0],
        [*[0] * 9, np.nan, 0, 0],
        [0.0] * 11,
        [[0.0], [0.0, 0.0]],
        "state",
        [10**400] * 12,
    ],
)
def test_a_reset_state_that_is_no_plant_is_refused_by_name_and_in_a_line(state, vector):
    env = (
        gym.make_vec("quad/HelixTracking-v0", num_envs=2, lost_distance=1e6)
        if vector
        else gym.make("quad/HelixTracking-v0", lost_distance=1e6)
    )
    with pytest.raises(ValueError, match="reset option 'state' must be") as said:
        env.reset(seed=0, options={"state": state})
    assert len(str(said.value)) < 300


def test_the_same_holds_for_teams():
    env = formation_v0.parallel_env(vehicles=2, graph="chain")
    for state in (np.zeros((2, 11)), np.full((2, 12), 1e7), "state", [[0.0], [0.0, 0.0]]):
        with pytest.raises(ValueError, match="reset option 'state' must be finite plants"):
            env.reset(seed=0, options={"state": state})


@pytest.mark.parametrize("entry", range(12))
def test_observations_stay_finite_whatever_a_state_becomes(entry):
    """At the largest state that a reset takes, one number at a time, over steps that explode."""
    env = gym.make("quad/HelixTracking-v0", lost_distance=1e6, drag=0.5, disturbance="gusts")
    state = np.zeros(12)
    state[entry] = 1.4 if entry in (6, 7) else 0.9e6 if entry < 3 else 1e6
    seen, _ = env.reset(seed=0, options={"state": state})
    for _ in range(5):
        assert np.isfinite(seen).all()
        seen, reward, terminated, _, info = env.step(HOVER)
        assert np.isfinite([reward, info["stage_cost"], info["episode_cost"]]).all()
        if terminated:
            break
    assert np.isfinite(seen).all()
