"""Tuning of controllers: what is searched, what the folder holds, how a search ends and goes on."""

import csv
import json
import re

import gymnasium as gym
import numpy as np
import pytest

import baselines.training.tuning as tuning
from baselines import CheckpointError, ResultsError, TrainingError, evaluate, make_policy, tune
from baselines.__main__ import main
from baselines.training.held_out import HELD_OUT
from baselines.training.tuned_options import KNOBS, make_search
from controllers import NmpcOptions

HELIX = "quad/HelixTracking-v0"
SHORT = {"time_limit": 1.0}  # 20 steps
FEW = {"fields": ("R",), "env_kwargs": SHORT}  # 4 candidates a generation
GENERATION = 4 * tuning.FLIGHTS


def task_of(env_id, **kwargs):
    return gym.make(env_id, **kwargs).unwrapped.task


def test_a_tuned_folder_flies_better_than_the_default_it_began_with(tmp_path):
    found = tune(HELIX, "nmpc", episodes=3 * GENERATION, out=tmp_path / "t", seed=1, **FEW)
    env = gym.make_vec(HELIX, num_envs=20, **SHORT)
    tuned, default = (
        evaluate(policy, env, 20, 20_000).summary()["score"].mean
        for policy in (make_policy(found.folder, env), make_policy("nmpc", env))
    )
    assert tuned == pytest.approx(found.best.score, abs=1e-12)
    assert tuned > default == pytest.approx(found.curve[0].score, abs=1e-12)


def test_a_tuned_folder_says_what_it_is_and_what_made_it(tmp_path):
    found = tune(HELIX, "nmpc", episodes=GENERATION, out=tmp_path / "t", **FEW)
    said = json.loads((tmp_path / "t" / "tuned.json").read_text())
    assert (said["policy"], said["env_id"], said["objective"]) == ("nmpc", HELIX, "score")
    assert said["options"] == found.options and set(found.options) == {"R"}
    assert {"versions", "git_revision", "command"} <= set(
        json.loads((tmp_path / "t" / "config.json").read_text())
    )
    rows = list(csv.DictReader((tmp_path / "t" / "curve.csv").read_text().splitlines()))
    assert [float(row["score"]) for row in rows] == [point.score for point in found.curve]
    assert len(rows) == 2  # the default, and the best of a generation


def test_equal_seeds_and_a_budget_in_episodes_tune_alike(tmp_path):
    a, b, c = (
        tune(HELIX, "nmpc", episodes=2 * GENERATION, out=tmp_path / name, seed=seed, **FEW)
        for name, seed in (("a", 3), ("b", 3), ("c", 4))
    )
    assert a.options == b.options != c.options
    assert [point.score for point in a.curve] == [point.score for point in b.curve]


def test_a_search_goes_on_where_it_ended(tmp_path):
    first = tune(HELIX, "nmpc", episodes=GENERATION, out=tmp_path, **FEW)
    with pytest.raises(ResultsError, match="--resume"):
        tune(HELIX, "nmpc", episodes=2 * GENERATION, out=tmp_path, **FEW)
    second = tune(HELIX, "nmpc", episodes=2 * GENERATION, out=tmp_path, resume=True, **FEW)
    assert [point.score for point in second.curve[:-1]] == [point.score for point in first.curve]
    assert len(second.curve) == len(first.curve) + 1 and second.best.score >= first.best.score
    with pytest.raises(ResultsError, match='its objective is "score", asked for is "quadratic_cost"'):
        tune(HELIX, "nmpc", objective="quadratic_cost", out=tmp_path, resume=True, **FEW)


def test_an_interrupted_search_keeps_what_is_finished(tmp_path, monkeypatch):
    class Impatient:
        def updated(self, share, progress):
            raise KeyboardInterrupt

        def judged(self, point, best):
            pass

        def noted(self, text):
            pass

        def close(self):
            pass

    with pytest.raises(KeyboardInterrupt):
        tune(HELIX, "nmpc", episodes=9 * GENERATION, out=tmp_path, watcher=Impatient(), **FEW)
    assert make_policy(tmp_path, gym.make(HELIX, **SHORT)).name == tmp_path.name
    assert len(tune(HELIX, "nmpc", episodes=GENERATION, out=tmp_path, resume=True, **FEW).curve) == 2


def test_training_starts_are_never_those_of_tables(tmp_path, monkeypatch):
    seeds, fly = [], tuning.fly_and_measure

    def watched(policy, env, episodes, seed):
        seeds.append(seed + episodes - 1)
        return fly(policy, env, episodes, seed)

    monkeypatch.setattr(tuning, "fly_and_measure", watched)
    tune(HELIX, "nmpc", episodes=2 * GENERATION, out=tmp_path, seed=99, **FEW)
    assert len(seeds) == 8 and max(seeds) < HELD_OUT


def test_what_is_tuned_follows_from_the_options_and_the_task():
    helix, corridor = task_of(HELIX), task_of("quad/CorridorTracking-v0")
    assert make_search("nmpc", helix, {}).names == ("Q", "R", "R_rate", "terminal")
    assert make_search("nmpc", corridor, {}).names == ("Q", "R", "R_rate", "terminal", "margin")
    assert make_search("score-nmpc", helix, {}).names[-1] == "floor"
    rejects = {"reject_disturbance": True}
    assert make_search("sdc-nmpc", helix, rejects).names[-1] == "estimator_gain_scale"
    assert make_search("sdc-nmpc", helix, {**rejects, "estimator_gain": 0.3}).names[-1] == "estimator_gain"
    assert make_search("nmpc", helix, {}, ["horizon"]).options(np.array([-1.0])) == {"horizon": 2}


@pytest.mark.parametrize("env_id", [HELIX, "quad/CorridorTracking-v0"])
@pytest.mark.parametrize("name", KNOBS)
def test_every_point_of_a_search_is_an_option_that_is_allowed(name, env_id):
    limits = {"tilt_limit": 0.5} if env_id == HELIX else {}
    task, rng = task_of(env_id, **limits), np.random.default_rng(0)
    acting = {"objective": "score", "reject_disturbance": True, "disturbance_correlation_time": 1.0}
    search = make_search("nmpc", task, acting, [name])
    for z in rng.uniform(-3.0, 3.0, (20, search.size)):
        NmpcOptions(**search.options(z))
        make_policy("nmpc", task, **search.options(z))


@pytest.mark.parametrize(
    ("name", "begin"),
    [
        ("Q", np.diag(np.arange(1.0, 13.0)).tolist()),
        ("R", (2.0 * np.eye(4)).tolist()),
        ("R_rate", [1.0, 2.0, 3.0, 4.0]),
        ("R_rate", (2.0 * np.eye(4)).tolist()),
        ("terminal", (3.0 * np.eye(12)).tolist()),
        ("Q", 1e15),
        ("R", [1e15] * 4),
    ],
)
def test_a_search_begins_with_weights_of_every_form(name, begin):
    task, rng = task_of(HELIX), np.random.default_rng(0)
    given = {name: begin, "frame": "hover"} if name == "Q" else {name: begin}
    search = make_search("nmpc", task, given, [name])
    first = np.asarray(search.options(np.zeros(search.size))[name])
    np.testing.assert_array_equal(first, begin * np.ones(first.shape))
    for z in rng.uniform(-3.0, 3.0, (20, search.size)):
        make_policy("nmpc", task, **search.options(z))


def test_a_matrix_and_its_diagonal_are_searched_alike():
    diagonal, z = [2.0, 2.0, *range(3, 13)], np.linspace(-1.0, 1.0, 8)
    found, whole = (
        np.array(make_search("nmpc", task_of(HELIX), {"Q": begin}, ["Q"]).options(z)["Q"])
        for begin in (diagonal, np.diag(diagonal).tolist())
    )
    np.testing.assert_allclose(whole, np.diag(found), rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("margin", {}, "margin changes nothing here.*it needs a limit of the state, as --set tilt_limit"),
        ("floor", {}, "floor changes nothing here.*objective=score"),
        ("estimator_gain", {}, "estimator_gain changes nothing here.*reject_disturbance=true"),
        (
            "estimator_gain_scale",
            {"reject_disturbance": True, "estimator_gain": 0.3},
            'estimator_gain_scale changes nothing here.*"auto"',
        ),
        (
            "terminal",
            {"terminal": 0.0},
            "terminal is searched by factors, and 0 stays 0: begin with a number",
        ),
        ("Q", {"Q": 0.0}, "0 stays 0"),
    ],
)
def test_an_option_whose_search_changes_nothing_is_refused(name, options, message):
    with pytest.raises(ValueError, match=message):
        make_search("nmpc", task_of(HELIX), options, [name])
    assert name not in make_search("nmpc", task_of(HELIX), options).names


def test_a_violation_or_a_crash_costs_more_than_any_score():
    env = gym.make_vec("quad/CorridorTracking-v0", num_envs=4, time_limit=2.0)
    for objective in ("score", "quadratic_cost"):
        good, bad = (
            tuning.loss_of(found.summary(), sum(bool(record.crashed) for record in found.records), objective)
            for found in (evaluate(make_policy(name, env), env, 4, 0) for name in ("nmpc", "random"))
        )
        assert good + 1.0 < bad


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"episodes": 1}, r"a tuning of 1 episode cannot compare anything: .* --episodes 32 or more"),
        ({"episodes": np.int64(2)}, r"a tuning of 2 episodes cannot compare anything"),
        ({"objective": "reward"}, "objective must be .*'score'.*'quadratic_cost'.*'reward'"),
        ({"fields": ("Qq",)}, "did you mean 'Q'"),
        ({"seconds": 0.0}, "seconds of a tuning must be a number > 0, got 0.0"),
        ({"seconds": 5.0, "episodes": 100}, "not both"),
        ({"seed": 100}, "seed of a tuning"),
        ({"options": {"horizn": 10}}, "horizn"),
        ({"options": {"terminal": "x"}}, "terminal .*must be numbers, got 'x'"),
        ({"fields": ("R", "R")}, "named twice: R, R"),
    ],
)
def test_a_tuning_that_cannot_be_done_is_refused_before_anything_is_written(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        tune(HELIX, "nmpc", **{"out": tmp_path / "t", **FEW, **changes})
    assert not (tmp_path / "t" / "config.json").exists()


@pytest.mark.parametrize("name", ["hover", "apg-helix"])
def test_a_policy_without_weights_has_nothing_to_tune(tmp_path, name):
    with pytest.raises(ValueError, match=f"policy '{name}' has no option that can be tuned.*some: lmpc, sdc"):
        tune(HELIX, name, out=tmp_path, env_kwargs=SHORT)


def test_where_a_team_has_nothing_to_tune_the_mpc_of_its_task_is_named():
    import quad_envs

    env = quad_envs.cooperative_estimation_v0.parallel_env()
    with pytest.raises(ValueError, match=r"the MPCs have some: cooperative-mpc$"):
        make_search("ekf", env.unwrapped.task, {})


@pytest.mark.parametrize("name", ["code_of_a_stranger:make", "safe:nmpc", "apg-helix", "nix", "SELF"])
def test_a_tuned_folder_names_a_controller_and_never_code(tmp_path, monkeypatch, name):
    folder = tmp_path / "t"
    tune(HELIX, "nmpc", episodes=GENERATION, out=folder, **FEW)
    said = json.loads((folder / "tuned.json").read_text())
    said["policy"], said["options"] = (str(folder) if name == "SELF" else name), {}
    (folder / "tuned.json").write_text(json.dumps(said))
    (tmp_path / "code_of_a_stranger.py").write_text("raise SystemExit('it ran')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(CheckpointError, match="is none that can be tuned; tune again"):
        make_policy(folder, HELIX)


def test_a_tuned_folder_is_refused_by_another_task_or_vehicle(tmp_path):
    tune(HELIX, "nmpc", episodes=GENERATION, out=tmp_path, **FEW)
    with pytest.raises(CheckpointError, match="not for quad/LineTracking-v0; tune one"):
        make_policy(tmp_path, "quad/LineTracking-v0")
    with pytest.raises(CheckpointError, match=r"another vehicle: its mass is 0\.8, here"):
        make_policy(tmp_path, gym.make(HELIX, vehicle="crazyflie"))
    with pytest.raises(ValueError, match="has the options that were found"):
        make_policy(tmp_path, HELIX, horizon=10)
    (tmp_path / "tuned.json").write_text("{}")
    with pytest.raises(CheckpointError, match=r"cannot read tuned\.json"):
        make_policy(tmp_path, HELIX)


def test_a_task_that_no_candidate_survives_is_said_to_be_one_and_what_was_tried_is_kept(tmp_path, capsys):
    rolling = (0.0,) * 6 + (1.4, 0.0, 0.0, 30.0, 0.0, 0.0)  # past 85 degrees within a sample
    doomed = {"start": rolling, "start_box": 0.0, **SHORT}
    said = (
        r"no candidate for 'nmpc' stays in the air on quad/HelixTracking-v0: all 20 flights of the best "
        r"one crash; begin from options that fly \(--policy-set\), or make the task easier\. What was tried"
    )
    with pytest.raises(TrainingError, match=said):
        tune(HELIX, "nmpc", episodes=GENERATION, out=tmp_path / "a", fields=("R",), env_kwargs=doomed)
    rows = list(csv.DictReader((tmp_path / "a" / "curve.csv").read_text().splitlines()))
    assert [row["crashes"] for row in rows] == ["20", "20"]
    words = [
        "tune",
        HELIX,
        "nmpc",
        "--episodes",
        str(GENERATION),
        "--tuned",
        "R",
        "--out",
        str(tmp_path / "b"),
    ]
    settings = [word for name, value in doomed.items() for word in ("--set", f"{name}={json.dumps(value)}")]
    assert main([*words, *settings]) == 1
    assert re.search(said, capsys.readouterr().err)


def test_the_command_tunes_and_evaluate_takes_its_folder(tmp_path, capsys):
    words = ["tune", HELIX, "nmpc", "--episodes", str(GENERATION), "--tuned", "R", "--set", "time_limit=1.0"]
    assert main([*words, "--out", str(tmp_path / "t"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["policy"] == "nmpc"
    flown = ["evaluate", HELIX, str(tmp_path / "t"), "--episodes", "2", "--set", "time_limit=1.0", "--json"]
    assert main(flown) == 0
    assert main([*words, "--out", str(tmp_path / "t")]) == 2
    assert "--resume" in capsys.readouterr().err
