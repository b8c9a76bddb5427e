"""Evaluation of teams: ParallelEnvs and vectors of teams, their numbers, suites and command line."""

from __future__ import annotations

import json
import math
import pickle

import numpy as np
import pytest
from made_episodes import hovering

from baselines import evaluate, load_suite, make_policy, measure, run_benchmark, run_episodes
from baselines.__main__ import main
from baselines.evaluation.columns import Record
from baselines.evaluation.evaluate import Evaluation
from baselines.evaluation.metrics import estimate, paired_difference, summarize, totals
from baselines.evaluation.team_metrics import flight_values
from baselines.policies.environments import make_env, task_of
from baselines.policies.estimate_wrapper import EstimateWrapper
from baselines.policies.protocol import Estimates, PolicyState
from baselines.sweeps.comparison import Results
from baselines.sweeps.suite_files import suite_from_dict
from baselines.sweeps.unit_flights import flight_arrays
from baselines.sweeps.units import suite_units
from quad_envs import cooperative_estimation_v0, formation_v0, target_tracking_v0
from quad_envs.registration import TEAMS
from quad_envs.tasks import TeamTask

FORMATION, TARGET, ESTIMATION = TEAMS
SHORT = {"time_limit": 1.0}
STEPS = 100


class Nudge:
    """Rotor commands, or estimates, that depend on the own observation."""

    name = "nudge"

    def __init__(self, task, gain=0.02):
        self.size, self.gain = task.action_size, gain

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        actions = np.zeros((len(observation), self.size), dtype=np.float32)
        actions[:, :3] = self.gain * np.tanh(observation[:, :3] + observation[:, 19:22])
        return actions, state


class Omniscient:
    """Hover for a whole team, from the truth."""

    name, privileged = "omniscient", True

    def __init__(self, task):
        self.task, self.seen = task, []

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        self.seen.append(observation)
        return np.zeros((1, self.task.vehicles, self.task.action_size), dtype=np.float32), state


def flight(task=None, agent="quad_0", **changes):
    """A flight of one of a team's vehicles: in its slot, hovering, 1 m from the others."""
    task = task or TeamTask(env_id=FORMATION, episode_steps=STEPS)
    n = len(task.constraint_names)
    signals = {
        "formation_error": np.zeros(STEPS),
        "min_separation": np.ones(STEPS),
        "messages": np.full(STEPS, 2),
        "reward_terms": np.zeros((STEPS, 6 + n)),
    }
    signals |= changes.pop("signals", {})
    return hovering(task, STEPS, **({"agent": agent, "team_size": 2, "signals": signals} | changes))


def team(columns, seed=0):
    """Records of a team that differ in one column."""
    (name, values), *_ = columns.items()
    base = measure(flight(seed=seed))
    return [base._replace(**{name: value, "agent": f"quad_{i}"}) for i, value in enumerate(values)]


def same(one, other):
    for name, value in one._asdict().items():
        if name == "signals":
            assert set(value) == set(other.signals)
            for key in value:
                np.testing.assert_array_equal(value[key], other.signals[key], err_msg=key)
        elif name not in ("task", "decision_times"):
            np.testing.assert_array_equal(value, getattr(other, name), err_msg=name)


@pytest.mark.parametrize("env_id", TEAMS)
def test_make_env_makes_a_parallel_env_of_each_id_and_task_of_finds_its_task(env_id):
    env = make_env(env_id, vehicles=4, formation="lattice") if env_id != ESTIMATION else make_env(env_id)
    assert task_of(env) is env.task and task_of(env_id).env_id == env_id
    assert env.possible_agents == [f"quad_{i}" for i in range(4)]


def test_make_env_says_what_is_wrong_as_for_single_vehicles():
    with pytest.raises(ValueError, match="did you mean 'graph'"):
        make_env(FORMATION, grph="weak")
    with pytest.raises(ValueError, match="did you mean 'quad/Formation-v0'"):
        make_env("quad/Formations-v0")
    with pytest.raises(ValueError, match="vehicles must be a whole number"):
        make_env(FORMATION, vehicles=0)


def test_an_aec_environment_is_refused_with_a_remedy():
    env = formation_v0.env()
    with pytest.raises(ValueError, match="use parallel_env"):
        run_episodes(Nudge(env.unwrapped.task), env, 1)


def test_a_team_gives_one_flight_per_vehicle_with_what_the_environment_told():
    env = make_env(FORMATION, **SHORT)
    policy = Nudge(env.task)
    episodes = list(run_episodes(policy, env, 2, seed=3))
    assert [(e.seed, e.agent) for e in episodes[5:7]] == [(3, "quad_5"), (4, "quad_0")]
    seen, _ = env.reset(seed=3)
    for k in range(20):
        actions, _ = policy.predict(np.stack(list(seen.values())))
        seen, rewards, _, _, infos = env.step(dict(zip(seen, actions, strict=True)))
        for episode in episodes[:6]:
            info, agent = infos[episode.agent], episode.agent
            assert episode.rewards[k] == rewards[agent]
            for name in ("formation_error", "min_separation", "messages", "reward_terms"):
                np.testing.assert_array_equal(episode.signals[name][k], info[name])
            np.testing.assert_array_equal(episode.states[k + 1], env.plants[int(agent[-1])])
            np.testing.assert_array_equal(episode.references[k], env.references[int(agent[-1]), k])


@pytest.mark.parametrize(
    ("module", "kwargs"),
    [
        (formation_v0, {**SHORT, "start": "line"}),
        (formation_v0, {"time_limit": 4.0, "terminate": "agent", "arena": 3.5}),  # vehicles leave by turns
        (target_tracking_v0, {**SHORT, "target_spread": (0.5, 0.5)}),
        (cooperative_estimation_v0, SHORT),
    ],
)
def test_a_vector_of_teams_gives_the_flights_of_single_teams(module, kwargs):
    env, vector = module.parallel_env(**kwargs), module.vector_env(2, **kwargs)
    policy = Nudge(env.task)
    singles = list(run_episodes(policy, env, 3, seed=2))
    together = list(run_episodes(policy, vector, 3, seed=2))
    assert len(singles) == len(together) == 3 * env.task.vehicles
    if kwargs.get("terminate") == "agent":
        assert len({len(episode.rewards) for episode in singles[:6]}) > 1
    for one, other in zip(singles, together, strict=True):
        same(one, other)


def test_decisions_are_timed_for_the_team_and_shared_among_its_vehicles():
    env = make_env(FORMATION, **SHORT)
    found = evaluate(Nudge(env.task), env, 2)
    assert found.vehicles == 6 and found.team_ms[0] == pytest.approx(6.0 * found.decision_ms[0])
    assert all(map(math.isnan, evaluate(Nudge(env.task), formation_v0.vector_env(2, **SHORT), 2).team_ms))


def test_a_privileged_policy_gets_the_truth_as_one_row_and_is_marked():
    env = make_env(FORMATION, **SHORT)
    policy = Omniscient(env.task)
    found = evaluate(policy, env, 1)
    assert all(row.shape == (1, env.state().size) for row in policy.seen)
    np.testing.assert_array_equal(policy.seen[-1][0, :16][6:9], 0.0)  # hover keeps the leader level
    assert str(found).startswith("omniscient (privileged) on quad/Formation-v0, 1 flight of 6 vehicles")
    told = found.to_dict()
    assert told["policy"] == "omniscient (privileged)" and told["privileged"] is True
    with pytest.raises(ValueError, match="fly it in a ParallelEnv"):
        run_episodes(policy, formation_v0.vector_env(2, **SHORT), 1)


def test_an_estimate_is_compared_with_the_target_at_the_time_of_the_observation():
    env = make_env(TARGET, **SHORT)

    class Exact:
        def __init__(self):
            self.k = 0

        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            self.k = 0 if episode_start is not None and episode_start[0] else self.k + 1
            target, plants, n = env.target[self.k], env.plants, len(observation)
            believed = Estimates(
                target[:3] + np.array([0.3, 0.0, 0.0]) - plants[:, :3],
                np.tile(target[3:], (n, 1)),
                np.tile(0.03 * np.eye(6), (n, 1, 1)),
                np.full(n, 6.0),
                np.full(n, 3),
            )
            counts = np.zeros((n, 5), dtype=np.int64)
            return np.zeros((n, 4), np.float32), PolicyState(
                plants, counts, counts[:, 0], counts[:, 0], believed
            )

    episode = next(run_episodes(Exact(), env, 1, seed=1))
    np.testing.assert_allclose(
        episode.signals["estimate_error"], np.tile([0.3, 0, 0, 0, 0, 0], (20, 1)), atol=1e-12
    )
    record = measure(episode)
    assert record.estimate_rmse == pytest.approx(0.3) and record.estimate_sigma == pytest.approx(0.3)
    assert (record.anees, record.nis_ratio) == (pytest.approx(0.09 / 0.03 / 3.0), pytest.approx(2.0))


def test_on_rails_the_action_is_the_estimate_and_commands_no_rotor():
    env = make_env(ESTIMATION, **SHORT)
    episode = next(run_episodes(Nudge(env.task, gain=0.1), env, 1))
    error = np.linalg.norm(episode.signals["estimate_error"][:, :3], axis=1)
    np.testing.assert_allclose(error, episode.signals["formation_error"], rtol=1e-12)
    record = measure(episode)
    nothing = (
        "effort",
        "saturation_share",
        "position_rms",
        "formation_rms",
        "min_separation",
        "z_error_rms",
        "anees",
    )
    assert np.isnan(episode.commands).all() and record.estimate_rmse > 0.0
    assert all(math.isnan(getattr(record, name)) for name in nothing)


def test_formation_columns_are_what_they_say():
    error = np.exp(-0.05 * np.arange(1, STEPS + 1))
    states = np.zeros((STEPS + 1, 16))
    states[1, 2] = -0.4
    near = np.ones(STEPS)
    near[7] = 0.45
    record = measure(flight(states=states, signals={"formation_error": error, "min_separation": near}))
    assert record.formation_rms == pytest.approx(math.sqrt(np.mean(error**2)))
    assert record.formation_final == pytest.approx(error[-20:].mean())  # 1 s is 20 steps
    assert record.formation_settling == pytest.approx(0.05 * math.floor(math.log(10.0) / 0.05))
    assert (record.min_separation, record.z_error_max, record.messages) == (0.45, 0.4, 2.0)
    assert record.z_error_rms == pytest.approx(0.04)
    assert measure(flight()).formation_settling == 0.0
    assert math.isnan(measure(flight(signals={"formation_error": np.ones(STEPS)})).formation_settling)


def test_a_crash_leaves_no_formation_column_but_the_distance():
    record = measure(flight(crashed=True, terminated=True, truncated=False))
    assert math.isnan(record.formation_rms) and math.isnan(record.formation_settling)
    assert record.min_separation == 1.0


def test_single_vehicles_have_no_team_columns():
    record = measure(
        next(
            run_episodes(make_policy("hover", "quad/HelixTracking-v0"), make_env("quad/HelixTracking-v0"), 1)
        )
    )
    for name in ("formation_rms", "min_separation", "estimate_rmse", "anees", "messages"):
        assert name not in record.row() and name not in summarize([record])


def test_vehicles_are_averaged_within_a_flight_before_the_interval():
    records = [
        record for seed in range(5) for record in team({"score": [0.5 + 0.1 * seed, 0.1 * seed]}, seed)
    ]
    assert summarize(records)["score"] == pytest.approx(estimate([0.25, 0.35, 0.45, 0.55, 0.65]))
    assert summarize(records)["score"].n == 5


def test_of_distances_the_least_of_settling_times_the_largest_vehicle_counts():
    assert flight_values(team({"min_separation": [0.5, 0.4, 0.6]}), "min_separation") == {0: 0.4}
    assert flight_values(team({"formation_settling": [1.0, 3.0]}), "formation_settling") == {0: 3.0}
    assert math.isnan(flight_values(team({"formation_settling": [math.nan, 3.0]}), "formation_settling")[0])
    assert flight_values(team({"formation_rms": [1.0, 3.0]}), "formation_rms_worst") == {0: 3.0}
    assert flight_values(team({"settling_time": [math.nan, 3.0]}), "settling_time") == {0: 3.0}


def test_differences_between_policies_are_over_flights():
    ours = [record for seed in range(5) for record in team({"formation_rms": [1.0, 2.0]}, seed)]
    theirs = [record for seed in range(5) for record in team({"formation_rms": [1.0, 1.0]}, seed)]
    assert paired_difference(ours, theirs, "formation_rms") == (0.5, 0.0, 5)
    assert paired_difference(ours, theirs, "formation_rms_worst") == (1.0, 0.0, 5)


def test_a_flight_in_which_all_crash_is_one_crash():
    lost = [measure(flight(agent=f"quad_{i}", crashed=True, terminated=True)) for i in range(6)]
    assert totals([*lost, *team({"score": [1.0]}, seed=1)])["crashed"] == 1


def test_an_evaluation_prints_no_column_that_means_nothing():
    estimation = str(evaluate(make_policy("hover", ESTIMATION), make_env(ESTIMATION, **SHORT), 2))
    formation = str(evaluate(make_policy("hover", FORMATION), make_env(FORMATION, **SHORT), 2))
    assert "estimate_rmse" in estimation and "effort" not in estimation and "formation" not in estimation
    assert "min_separation" in formation and "estimate" not in formation and "effort" in formation


def test_an_evaluation_of_a_team_survives_storage():
    found = evaluate(make_policy("hover", FORMATION), make_env(FORMATION, **SHORT), 2)
    again = Evaluation.from_plain(json.loads(json.dumps(found.to_plain())))
    assert str(again) == str(found) and again.to_dict() == found.to_dict()


def test_the_result_says_that_no_spanning_tree_exists():
    with pytest.warns(UserWarning, match="no spanning tree"):
        env = make_env(FORMATION, drop_out=1.0, **SHORT)
    found = evaluate(make_policy("hover", env), env, 1)
    assert found.to_dict()["spanning_tree"] is False and "note: no spanning tree" in str(found)
    assert evaluate(make_policy("hover", FORMATION), FORMATION, 1).to_dict()["notes"] == []


SUITE = {
    "name": "both",
    "episodes": 2,
    "compare_with": "hover",
    "envs": [
        {"id": FORMATION, "label": "weak", "kwargs": SHORT},
        {"id": FORMATION, "label": "loose", "kwargs": {**SHORT, "terminate": "agent", "arena": 3.5}},
        {"id": ESTIMATION, "kwargs": SHORT, "label": "rails"},
        {"id": "quad/HelixTracking-v0", "kwargs": {"time_limit": 1.0}, "label": "helix"},
    ],
    "policies": [
        {"name": "hover"},
        {"name": "random", "envs": [FORMATION, "rails"]},
        {"name": "lmpc", "envs": ["helix"]},
    ],
}


def test_a_suite_of_both_kinds_of_ids_leaves_its_folder(tmp_path):
    results = run_benchmark(SUITE, tmp_path, save_episodes=True)
    assert [unit.policy.title for unit in suite_units(results.suite)] == [
        *3 * ["hover", "random"],
        "hover",
        "lmpc",
    ]
    text = str(results)
    assert "separation m" in text.split("\n\n")[0] and "separation m" not in text.split("\n\n")[3]
    assert "effort" not in text.split("\n\n")[2] and "estimate m" in text.split("\n\n")[2]
    header, *rows = (tmp_path / "results.csv").read_text().splitlines()
    assert "agent" in header.split(",") and len(rows) == 2 * (2 * 6 + 2 * 6 + 2 * 4 + 2)
    assert len(list((tmp_path / "episodes").iterdir())) == 16
    with np.load(tmp_path / "episodes" / suite_units(results.suite)[0].episode_name(0)) as arrays:
        assert arrays["states"].shape == (6, 21, 16) and arrays["agent"].tolist()[5] == "quad_5"
        assert arrays["min_separation"].shape == (6, 20) and arrays["lengths"].tolist() == 6 * [20]
    again = run_benchmark(SUITE, tmp_path, save_episodes=True)
    assert again.to_dict() == results.to_dict()


def test_flights_of_different_length_are_stacked_with_nan_behind_the_shorter():
    short = {name: getattr(flight(), name)[:60] for name in ("commands", "rewards", "violations")}
    arrays = flight_arrays([flight(), flight(agent="quad_1", **short)])
    assert arrays["lengths"].tolist() == [STEPS, 60] and np.isnan(arrays["commands"][1, 60:]).all()
    assert np.isfinite(arrays["commands"][1, :60]).all() and not arrays["violations"][1, 60:].any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"policies": ["consensus-mpc"]}, "not for target-tracking.*envs = "),
        ({"policies": [{"name": "hover", "envs": ["quad/Formaton-v0"]}]}, "did you mean 'quad/Formation-v0'"),
        ({"policies": [{"name": "hover", "envs": FORMATION}]}, "must be a list of ids or labels"),
        (
            {"policies": [{"name": "hover", "envs": [FORMATION]}]},
            "has no policy for 'quad/TargetTracking-v0'",
        ),
        ({"envs": ["quad/Formaton-v0"]}, "did you mean 'quad/Formation-v0'"),
    ],
)
def test_a_policy_for_other_tasks_is_refused_before_anything_is_flown(change, message):
    suite = {"name": "bad", "envs": [FORMATION, TARGET], "policies": ["hover"], "episodes": 10_000}
    with pytest.raises(ValueError, match=message):
        run_benchmark(suite | change)


def test_all_in_a_suite_goes_on_to_mean_tracking():
    suite = suite_from_dict({"envs": "all", "policies": "all"})
    assert not {env.id for env in suite.envs} & set(TEAMS)
    assert "consensus-mpc" not in {policy.name for policy in suite.policies}


def test_the_shipped_suite_of_teams_can_be_flown():
    suite = load_suite("cooperative")
    for unit in suite_units(suite):
        make_policy(unit.policy.name, make_env(unit.env.id, **unit.env.kwargs), **unit.policy.kwargs)
        assert pickle.loads(pickle.dumps(unit)) == unit
    assert {env.id for env in suite.envs} == set(TEAMS)


@pytest.mark.slow  # two processes load and link everything anew
def test_units_of_teams_fly_in_other_processes_with_the_same_numbers():
    alone, spread = run_benchmark(SUITE), run_benchmark(SUITE, jobs=2)
    timed = ("decision_p50_ms", "decision_p99_ms", "decision_max_ms")
    for one, other in zip(alone.rows(), spread.rows(), strict=True):
        assert repr({**one, **dict.fromkeys(timed)}) == repr({**other, **dict.fromkeys(timed)})


def test_the_table_marks_privileged_policies():
    suite = suite_from_dict({"envs": [FORMATION], "policies": ["hover", "central-mpc"], "episodes": 1})
    record: Record = measure(flight())
    evaluations = tuple(
        Evaluation(FORMATION, name, 0, (record,), 3 * (1.0,), 3 * (2.0,), 6, True, name == "central-mpc")
        for name in ("hover", "central-mpc")
    )
    lines = str(Results(suite, evaluations)).splitlines()
    assert lines[-1].startswith("central-mpc (privileged)") and not lines[-2].startswith("hover (privileged)")


def test_evaluate_on_the_command_line_says_what_the_environment_warns_of_in_one_line(capsys):
    arguments = [
        "evaluate",
        FORMATION,
        "hover",
        "--episodes",
        "1",
        "--set",
        "drop_out=1",
        "--set",
        "time_limit=1.0",
    ]
    assert main([*arguments, "--json"]) == 0
    out, err = capsys.readouterr()
    found = json.loads(out)
    assert found["spanning_tree"] is False and found["vehicles"] == 6 and len(found["records"]) == 6
    assert err.count("warning:") == 1 and err.count("no spanning tree") == 1 and "UserWarning" not in err


def test_evaluate_takes_formation_and_graph(capsys):
    arguments = ["--set", "formation=hexagon", "--set", "graph=strong", "--set", "time_limit=1.0"]
    assert main(["evaluate", FORMATION, "hover", "--episodes", "1", *arguments]) == 0
    assert "6 vehicles" in capsys.readouterr().out


@pytest.mark.parametrize("env_id", TEAMS)
def test_list_shows_the_ids_of_teams_and_their_options(capsys, env_id):
    assert main(["list", "--json"]) == 0
    assert env_id in json.loads(capsys.readouterr().out)["team_environments"]
    assert main(["list", env_id, "--json"]) == 0
    options = json.loads(capsys.readouterr().out)
    assert options["graph"] and ("sensor" in options) == (env_id != FORMATION) and "env_id" not in options


def test_the_task_of_the_estimate_wrapper_is_its_own_and_its_filter_is_measured():
    env = EstimateWrapper(make_env(TARGET, **SHORT))
    assert task_of(env).layout.estimate and not task_of(env.unwrapped).layout.estimate
    record = evaluate(make_policy("hover", env), env, 1).records[0]
    assert 0.0 < record.estimate_rmse < 1.0 and record.anees > 0.0 and record.nis_ratio > 0.0
