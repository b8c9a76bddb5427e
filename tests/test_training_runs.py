"""Training runs: budgets, curves, what the folder holds, how they end and go on. The algorithms are stubs."""

import csv
import inspect
import io
import json
import shlex
import signal
import time
from dataclasses import fields, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from processes import start_command
from stub_training import stubs  # noqa: F401

from baselines import CheckpointError, ResultsError, TrainingError, evaluate, make_policy, train
from baselines.__main__ import main, make_parser
from baselines.cli.options import TrainOptions, read_options
from baselines.cli.train import requested
from baselines.errors import MissingPackageError
from baselines.files import locked
from baselines.policies.checkpoints import load_checkpoint
from baselines.training.algorithms import ALGORITHMS, options_of
from baselines.training.clock import Budget
from baselines.training.held_out import CHOOSING, Point, better, training_options
from baselines.training.hyperparameters import hyperparameter_file, hyperparameters
from baselines.training.plans import make_plan
from baselines.training.request import TrainingRequest
from baselines.training.runs import limit_of
from baselines.training.watching import Display
from quad_envs.registration import TEAMS, TRACKING

HELIX = "quad/HelixTracking-v0"
SHORT = {"time_limit": 1.0}  # 20 steps


def run(out, steps=1000, **changes):
    return train(
        HELIX,
        changes.pop("algorithm", "stub"),
        **{"steps": steps, "env_kwargs": SHORT, "out": out, **changes},
    )


def test_a_run_leaves_a_checkpoint_a_curve_and_what_made_them(tmp_path):
    result = run(tmp_path / "run", seed=3)
    folder = result.folder
    _, said = load_checkpoint(folder)
    assert (said["algorithm"], said["env_id"], said["seed"], said["mission"]) == (
        "stub",
        HELIX,
        3,
        "tracking",
    )
    assert said["score"] == result.best.score == max(point.score for point in result.curve)
    rows = list(csv.DictReader((folder / "curve.csv").read_text().splitlines()))
    assert [float(row["score"]) for row in rows] == [point.score for point in result.curve]
    assert set(rows[0]) == set(Point._fields)
    config = json.loads((folder / "config.json").read_text())
    assert {"command", "versions", "git_revision", "hyperparameters", "env_kwargs"} <= set(config)
    assert load_checkpoint(folder / "last")[1]["steps"] == 1000 == result.curve[-1].steps


def test_the_recorded_score_is_that_of_its_starts(tmp_path):
    result = run(tmp_path / "run")
    policy = make_policy(result.folder, HELIX)
    starts = load_checkpoint(result.folder)[1]["starts"]
    import gymnasium

    env = gymnasium.make_vec(HELIX, num_envs=starts["flights"], **SHORT)
    found = evaluate(policy, env, starts["flights"], starts["seed"])
    assert found.summary()["score"].mean == pytest.approx(
        result.best.score, rel=1e-12
    )  # another sum of scores
    assert starts["seed"] == CHOOSING


def test_equal_seeds_and_steps_give_equal_runs(tmp_path):
    first, second, other = (run(tmp_path / name, seed=seed) for name, seed in (("a", 1), ("b", 1), ("c", 2)))
    plain = [[point._replace(cpu_seconds=0.0) for point in result.curve] for result in (first, second, other)]
    assert str(plain[0]) == str(plain[1]) != str(plain[2])
    assert np.array_equal(
        load_checkpoint(tmp_path / "a")[0].biases[0], load_checkpoint(tmp_path / "b")[0].biases[0]
    )


def test_a_budget_in_seconds_ends_and_evaluation_is_not_in_it(tmp_path):
    begin = time.process_time()
    result = run(tmp_path / "run", steps=None, seconds=0.3)
    total, spent = time.process_time() - begin, result.curve[-1].cpu_seconds
    assert 0.3 <= spent < 0.4
    assert total > spent + 0.02  # evaluations take about 0.1 s


def test_a_team_trains_with_agents_as_rows(tmp_path):
    result = train("quad/Formation-v0", "stub", steps=200, env_kwargs=SHORT, out=tmp_path / "run")
    assert result.best.flights == 30 and load_checkpoint(tmp_path / "run")[1]["mission"] == "formation"


def test_an_interrupted_run_saves_and_goes_on(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, hyper={"fails_at": 6, "how": "interrupt"})
    assert load_checkpoint(tmp_path / "last")[1]["updates"] == 5
    result = run(tmp_path, hyper={"fails_at": 6, "how": "interrupt"}, resume=True, steps=900)
    assert [point.updates for point in result.curve][-1] == 9 and result.curve[-1].steps == 900
    assert [point.steps for point in result.curve] == sorted({point.steps for point in result.curve})
    config = json.loads((tmp_path / "config.json").read_text())
    assert len(config["commands"]) == 1 and load_checkpoint(tmp_path / "last")[1]["resumed"] == 1


def test_a_run_may_begin_with_the_network_of_another_and_says_with_which(tmp_path, capsys):
    first, begun = run(tmp_path / "a", steps=200).folder, str(tmp_path / "b")
    arguments = ["train", HELIX, "stub", "--steps", "200", "--set", "time_limit=1.0", "--out", begun]
    assert main([*arguments, "--from", str(first), "--hyper", "follows=true"]) == 0
    (network, said), (start, origin) = load_checkpoint(tmp_path / "b" / "last"), load_checkpoint(first)
    assert np.array_equal(network.biases[0], start.biases[0]), "the stub hands out what it was given"
    assert said["updates"] == 2 and said["start_from"]["digest"] == origin["digest"]
    assert said["made_by"].endswith(f"--from {first}")
    capsys.readouterr()
    again = [*arguments, "--hyper", "follows=true", "--resume", "--steps", "300"]
    assert main(again) == 2 and "its start_from is" in capsys.readouterr().err
    assert main([*again, "--from", str(first)]) == 0


def test_a_finished_run_goes_on_with_a_larger_budget_only(tmp_path):
    first = run(tmp_path)
    with pytest.raises(ResultsError, match=r"has used .* all of 1000 steps: give more"):
        run(tmp_path, resume=True)
    second = run(tmp_path, resume=True, steps=1500)
    assert str(second.curve[: len(first.curve)]) == str(first.curve) and second.curve[-1].steps == 1500
    assert second.best.score >= first.best.score


@pytest.mark.parametrize("how", ["training", "nan", "infinite"])
def test_a_training_that_diverges_keeps_the_last_good_policy_and_says_when(tmp_path, how):
    with pytest.raises(TrainingError, match=r"stopped at update \d+: .* kept in"):
        run(tmp_path, hyper={"fails_at": 4, "how": how})
    network, said = load_checkpoint(tmp_path / "last")
    assert np.isfinite(network.biases[0]).all() and said["updates"] in (3, 4)
    assert make_policy(tmp_path, HELIX)


def test_a_full_disk_keeps_what_was_saved_and_is_said_at_the_end(tmp_path, monkeypatch):
    run(tmp_path)
    before = (tmp_path / "last" / "network.safetensors").read_bytes()
    notes = []

    class Watch(Display):
        def noted(self, text):
            notes.append(text)

    def full(path, data):
        raise ResultsError("No space left on device")

    monkeypatch.setattr("baselines.policies.checkpoints.write_atomic", full)
    with pytest.raises(CheckpointError, match="No space left"):
        run(tmp_path, steps=1500, resume=True, watcher=Watch("x", io.StringIO()))
    assert (tmp_path / "last" / "network.safetensors").read_bytes() == before
    assert notes and "training goes on" in notes[0]


def test_one_run_at_a_time_in_a_folder(tmp_path):
    with locked(tmp_path), pytest.raises(ResultsError, match="is in use by process"):
        run(tmp_path)


def test_a_folder_with_a_run_is_not_overwritten_unasked(tmp_path):
    run(tmp_path)
    with pytest.raises(ResultsError, match=r"--resume.*--fresh"):
        run(tmp_path)
    assert run(tmp_path, seed=1, fresh=True).seed == 1
    with pytest.raises(ResultsError, match="its seed is 1, asked for is 2"):
        run(tmp_path, seed=2, resume=True)
    with pytest.raises(ResultsError, match="its hyperparameters is"):
        run(tmp_path, seed=1, hyper={"gain": 2.0}, resume=True)


def test_a_training_takes_whole_numbers_of_numpy(tmp_path):
    hyper = {"gain": np.float32(0.5)}
    train(HELIX, "stub", seed=np.int64(4), steps=np.int64(200), hyper=hyper, out=tmp_path / "run")
    said = json.loads((tmp_path / "run" / "policy.json").read_text())
    assert said["seed"] == 4 and said["hyperparameters"]["gain"] == 0.5


def test_files_of_others_are_left_alone(tmp_path):
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(ResultsError, match="no training has written"):
        run(tmp_path, fresh=True)
    with pytest.raises(ResultsError, match="holds no training"):
        run(tmp_path / "new", resume=True)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seed": -1}, "seed of a training must be"),
        ({"seed": 20_000}, "held out for evaluation"),
        ({"seconds": 3.0}, "either seconds .* or steps"),
        ({"steps": 0}, "steps of training must be a whole number > 0"),
        ({"steps": None, "seconds": float("nan")}, "seconds of training must be a number > 0"),
        ({"resume": True, "fresh": True}, "either resume or fresh"),
        ({"algorithm": "stubb"}, "did you mean 'stub'"),
        ({"hyper": {"gian": 1.0}}, "hyperparameter of 'stub' 'gian'; did you mean 'gain'"),
        ({"hyper": {"gain": "big"}}, "gain of 'stub' must be a number, got 'big'"),
        ({"hyper": {"n_envs": 1.5}}, "n_envs of 'stub' must be a whole number"),
        ({"hyper": {"net_arch": 3}}, "net_arch of 'stub' must be a list"),
        ({"env_kwargs": {"kapa": 1.0}}, "did you mean 'kappa'"),
        ({"algorithm": "once", "resume": True}, "'once' cannot go on from a saved network"),
        ({"algorithm": "once", "start_from": "apg-helix"}, "'once' cannot go on from a saved network"),
        ({"start_from": "apg-helx"}, "there is no folder 'apg-helx'"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(tmp_path, arguments, message):
    with pytest.raises((ValueError, ResultsError, CheckpointError), match=message):
        run(tmp_path / "run", **arguments)
    assert not (tmp_path / "run" / "config.json").exists()


@pytest.mark.parametrize(
    ("env_id", "algorithm", "message"),
    [
        ("quad/Formation-v0", "sac", "those that can act there: apg, dagger, mappo, ppo, ppo-lagrangian"),
        ("quad/TargetTracking-v0", "sac", "trains on tracking tasks, not on target-tracking"),
        ("quad/CooperativeEstimation-v0", "apg", "not on estimation; .* none, its agents estimate"),
        ("quad/CooperativeEstimation-v0", "ppo", "its agents estimate and do not fly"),
        ("quad/Helix-v0", "apg", "did you mean 'quad/HelixTracking-v0'"),
    ],
)
def test_an_algorithm_that_cannot_act_there_is_refused(tmp_path, env_id, algorithm, message):
    with pytest.raises(ValueError, match=message):
        train(env_id, algorithm, steps=100, out=tmp_path)


def test_a_missing_package_is_named_with_its_extra(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(ALGORITHMS, "stub", ALGORITHMS["stub"]._replace(packages=("no_such_torch",)))
    with pytest.raises(
        MissingPackageError, match=r'no_such_torch, which is not installed: pip install .* -e "\.\[rl\]"'
    ):
        run(tmp_path)
    assert main(["train", HELIX, "stub", "--out", str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_the_best_policy_is_under_the_limit_if_there_is_one():
    point = Point(1.0, 1, 1, 0.5, 1.0, 0.2, 0, 20, 0.5)
    safe, bold = point._replace(score=0.4, violation_share=0.01), point._replace(score=0.6)
    assert better(bold, point) and not better(safe, point)
    assert better(safe, point, 0.05) and not better(bold, safe, 0.05) and better(bold, point, 0.05)
    crashed = point._replace(score=0.6, violation_share=0.0, crashes=5)
    assert better(point, crashed, 0.01) and better(safe, crashed, 0.01)


def test_a_vehicle_with_limits_keeps_them_first_and_one_without_scores(tmp_path):
    def limit(env_id, algorithm, **request):
        return limit_of(make_plan(TrainingRequest(env_id, algorithm, **request)))

    corridor, lagrangian = "quad/CorridorTracking-v0", {"hyper": {"limit": 0.03}}
    assert limit(HELIX, "stub") is None and limit("quad/Formation-v0", "stub") is None
    assert limit(corridor, "stub") == 0.01
    assert limit(HELIX, "stub", env_kwargs={"tilt_limit": 0.3}) == 0.01
    if find_spec("stable_baselines3"):
        assert limit(corridor, "ppo-lagrangian", **lagrangian) == 0.03


def test_hyperparameters_come_from_the_committed_files():
    for algorithm in set(ALGORITHMS) - {"stub", "once"}:
        known = {*TRACKING, *TEAMS, "default"}
        assert set(hyperparameter_file(algorithm)) <= known
        for env_id in known - {"default"}:
            assert isinstance(hyperparameters(algorithm, env_id), options_of(algorithm))


def test_a_task_is_the_one_of_its_id():
    for env_id in (*TRACKING, *TEAMS):
        assert training_options(env_id, {}).task.env_id == env_id


def test_the_command_prints_the_best_and_a_line_per_evaluation(tmp_path, capsys):
    arguments = [
        "train",
        HELIX,
        "stub",
        "--steps",
        "500",
        "--out",
        str(tmp_path / "a"),
        "--set",
        "time_limit=1.0",
    ]
    assert main(arguments) == 0
    out, err = capsys.readouterr()
    assert out.startswith("best of ") and out.count("\n") == 1 and "score" in out
    assert err.count("CPU-s") == 5 and f"quad-envs evaluate {HELIX}" in err and "%|" not in err
    assert main([*arguments, "--fresh", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["best"]["flights"] == 20
    assert main(["evaluate", HELIX, str(tmp_path / "a"), "--episodes", "1", "--set", "time_limit=1.0"]) == 0


def test_a_terminal_gets_a_bar():
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    stream = Terminal()
    display = Display("apg", stream)
    display.judged(Point(1.0, 100, 1, 0.5, 1.0, 0.2, 0, 20, 0.5), True)
    display.updated(0.5, None)
    display._bar.refresh()
    display.close()
    assert "score 0.500, violations 20.0 %" in stream.getvalue() and "left" in stream.getvalue()


def test_a_diverged_training_ends_with_code_1(tmp_path, capsys):
    arguments = ["--hyper", "fails_at=3", "--hyper", "how=training", "--steps", "500"]
    assert main(["train", HELIX, "stub", "--out", str(tmp_path), *arguments]) == 1
    assert "stopped at update 3: the loss is nan" in capsys.readouterr().err


def test_ctrl_c_says_how_to_go_on(tmp_path, capsys):
    out = tmp_path / "my run"
    arguments = [
        "train",
        HELIX,
        "stub",
        "--steps",
        "500",
        "--hyper",
        "fails_at=3",
        "--hyper",
        "how=interrupt",
    ]
    assert main([*arguments, "--out", str(out)]) == 130
    said = capsys.readouterr().err.splitlines()[-1]
    asked = TrainingRequest(
        *(HELIX, "stub"), steps=500, out=out, hyper={"fails_at": 3, "how": "interrupt"}, resume=True
    )
    assert said.endswith(asked.command) and asked.command.endswith("--resume") and f"'{out}'" in said


def test_the_command_of_a_training_asks_for_the_same_training():
    request = TrainingRequest(
        HELIX,
        "apg",
        seed=3,
        seconds=2.5,
        out="runs/a b",
        env_kwargs={"kappa": 0.3125, "limits": {"tilt": 0.35}},
        hyper={"net_arch": [8, 8], "squash": "clip"},
        start_from="o'clock",
        resume=True,
    )
    words = shlex.split(request.command)
    assert words[:2] == ["quad-envs", "train"]
    found = read_options(TrainOptions, make_parser().parse_args(words[1:]))
    assert requested(found) == replace(request, out=Path("runs/a b"))


def test_train_takes_the_fields_of_a_request():
    parameters = inspect.signature(train).parameters
    assert list(parameters) == [entry.name for entry in fields(TrainingRequest)]
    assert parameters["hyper"].kind is inspect.Parameter.KEYWORD_ONLY
    assert "    hyper: hyperparameters that differ from the committed ones" in train.__doc__
    with pytest.raises(TypeError, match="unexpected keyword argument 'hypre'"):
        train(HELIX, "stub", hypre={})


@pytest.mark.slow
def test_ctrl_c_ends_a_training_of_the_command_line_and_the_run_goes_on(tmp_path):
    pytest.importorskip("torch")
    arguments = ["train", HELIX, "apg", "--seconds", "60", "--out", tmp_path / "run"]
    with start_command(*arguments) as process:
        while "score" not in process.stderr.readline():
            assert process.poll() is None
        process.send_signal(signal.SIGINT)
        printed, said = process.communicate(timeout=60)
    assert process.returncode == 130 and printed == "" and "Traceback" not in said
    assert said.splitlines()[-1].endswith("--resume")
    load_checkpoint(tmp_path / "run")
    with start_command(*arguments[:4], "3", *arguments[5:], "--resume") as process:
        printed, said = process.communicate(timeout=60)
    assert process.returncode == 0 and printed.startswith("best of") and "policy in" in said


def test_a_budget_counts_one_thing():
    assert Budget(seconds=10.0).share(5.0, 10**9) == 0.5 and Budget(steps=10).share(99.0, 5) == 0.5
