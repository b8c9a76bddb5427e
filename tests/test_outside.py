"""Policies and environments of other people: by `module:factory`, as objects, from installed packages."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib import metadata

import gymnasium as gym
import numpy as np
import pytest

from baselines import (
    PolicyError,
    ResultsError,
    evaluate,
    load_suite,
    make_policy,
    policy_options,
    run_benchmark,
    run_episodes,
)
from baselines.__main__ import main
from baselines.policies.environments import make_env
from baselines.policies.outside import installed_policies, name_of, names_factory
from baselines.training.held_out import HeldOutFlights, training_options
from quad_envs import formation_v0

HELIX = "quad/HelixTracking-v0"
SMALL = {"name": "small", "envs": [HELIX], "policies": ["lqr", "hover"], "episodes": 2}
# One page, as a user would write it. Numbers of lines are asked for below.
MODULE = """\
import numpy as np


class Even:
    def __init__(self, task, force=1.0):
        self.task, self.force = task, force

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        rows = np.shape(observation)[:-1]
        return np.full((*rows, 4), self.force - 1.0, np.float32), state


def make(task, force=1.0):
    return Even(task, force)


def from_env(env):
    assert env.unwrapped.task.dt > 0.0
    return Even(env.unwrapped.task)


def without_task():
    return Even(None)


def returns_a_number(task):
    return 3


def raises(task):
    return 1 / 0


class Late(Even):
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        steps = 0 if state is None else state
        if steps == 7:
            raise RuntimeError("lost")
        return super().predict(observation)[0], steps + 1


class Flat(Even):
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros(4, np.float32), state


class Bare(Even):
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros((1, 4), np.float32)


class Ragged(Even):
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return [[0.0], [0.0, 0.0]], state


class Narrow(Even):
    def predict(self, observation):
        return np.zeros((1, 4), np.float32), None


number = 3
ready = Even(None)
"""
ENVIRONMENT = """\
import gymnasium

gymnasium.register(
    "lab/Eight-v0",
    entry_point="quad_envs.envs.tracking.env:TrackingEnv",
    vector_entry_point="quad_envs.envs.tracking.vector:TrackingVectorEnv",
    kwargs={"env_id": "lab/Eight-v0", "reference": "lemniscate", "time_limit": 2.0},
)
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The user's folder, which is the current one, with `their_policy.py` and `their_env.py`."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path not in ("", str(tmp_path))])
    (tmp_path / "their_policy.py").write_text(MODULE)
    (tmp_path / "their_env.py").write_text(ENVIRONMENT)
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if name.startswith(("their_", "broken_")):
            del sys.modules[name]
    gym.registry.pop("lab/Eight-v0", None)


@pytest.fixture
def theirs(folder, monkeypatch):
    """The user's module."""
    monkeypatch.syspath_prepend(folder)
    return __import__("their_policy")


def line_of(text):
    """Where a line stands in the user's file."""
    return MODULE.splitlines().index(text) + 1


def test_a_policy_flies_from_the_command_line_by_module_and_factory(folder, capsys):
    assert main(["evaluate", HELIX, "their_policy:make", "--episodes", "2", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["policy"] == "their_policy:make" and found["episodes"] == 2
    hover = evaluate("hover", HELIX, episodes=2)
    assert found["summary"]["score"]["mean"] == pytest.approx(hover.summary()["score"].mean, abs=1e-12)


def test_the_installed_command_finds_the_current_folder_as_python_m_does(folder):
    """The script's own folder stands first in its sys.path, not the current one."""
    code = "import sys; sys.path.pop(0); from baselines.__main__ import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "list", "their_policy:make"]
    found = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert found.returncode == 0 and "force" in found.stdout, found.stderr


def test_the_current_folder_is_importable_during_a_command_only(folder, capsys):
    main(["list", "their_policy:make"])
    assert str(folder) not in sys.path and "force" in capsys.readouterr().out


def test_options_of_a_factory_are_its_other_parameters(theirs, capsys):
    assert policy_options("their_policy:make") == {"force": 1.0}
    assert make_policy("their_policy:make", HELIX, force=0.5).force == 0.5
    with pytest.raises(
        ValueError, match="option of policy 'their_policy:make': 'forze'; did you mean 'force'"
    ):
        make_policy("their_policy:make", HELIX, forze=1.0)
    assert main(["evaluate", HELIX, "their_policy:make", "--policy-set", "force=0.9", "--episodes", "1"]) == 0


@pytest.mark.parametrize("source", ["make", "Even", "from_env", "without_task", "ready"])
def test_a_factory_takes_the_task_or_the_environment_or_nothing(theirs, source):
    policy = make_policy(f"their_policy:{source}", gym.make(HELIX))
    assert policy.predict(np.zeros((2, 226)))[0].shape == (2, 4)


def test_a_factory_that_wants_the_environment_says_so_when_there_is_only_a_task(theirs):
    assert make_policy("their_policy:from_env", HELIX).task.env_id == HELIX
    with pytest.raises(ValueError, match="is made from an environment, got the task of quad/Helix"):
        make_policy("their_policy:from_env", gym.make(HELIX).unwrapped.task)


def test_objects_and_factories_are_policies_wherever_a_name_is(theirs):
    env = gym.make(HELIX)
    ready = theirs.Even(env.unwrapped.task)
    assert make_policy(ready, env) is ready
    scores = {
        evaluate(policy, env, 1).records[0].score for policy in (ready, theirs.make, "their_policy:make")
    }
    assert len(scores) == 1
    with pytest.raises(ValueError, match="takes no options, got force"):
        make_policy(ready, env, force=2.0)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("nowhere:make", r"there is no module 'nowhere', neither in '.*' nor installed"),
        ("nowhere.py:make", r"there is no module .*; a module is named without \.py: nowhere$"),
        ("their_policy:mak", "no 'mak'; did you mean 'make'"),
        ("their_policy:number", "is int 3: a policy has predict, and a factory makes one"),
        ("their_policy:returns_a_number", "returned int, which has no predict"),
        ("their_policy:raises", "ZeroDivisionError: division by zero, at .*line "),
        ("broken_import:make", "No module named 'nothing_of_this', at .*broken_import.py, line 2"),
        ("broken_syntax:make", "SyntaxError: .*, at .*broken_syntax.py, line 1"),
        ("broken_exit:make", "SystemExit: 4, at .*broken_exit.py, line 1"),
    ],
)
def test_a_factory_that_cannot_be_used_is_named_with_the_line_of_its_file(theirs, folder, name, said):
    (folder / "broken_import.py").write_text("import sys\nimport nothing_of_this\n")
    (folder / "broken_syntax.py").write_text("def make(:\n")
    (folder / "broken_exit.py").write_text("raise SystemExit(4)\n")
    with pytest.raises(PolicyError, match=f"policy '{name}'.*{said}"):
        make_policy(name, HELIX)


@pytest.mark.parametrize("command", [("evaluate", HELIX), ("list",)])
def test_a_file_that_is_named_as_a_policy_gets_told_how_its_policies_are_named(theirs, capsys, command):
    assert main([*command, "their_policy"]) == 2
    assert "'their_policy'; their_policy.py is here: what it has is named their_policy:NAME" in (
        capsys.readouterr().err
    )
    assert main([*command, "their_polici"]) == 2
    assert "is here" not in capsys.readouterr().err


def test_names_that_a_file_has_are_told_without_the_modules_that_it_imports(theirs):
    with pytest.raises(PolicyError) as refused:
        make_policy("their_policy:nothing_like_it", HELIX)
    known = str(refused.value).partition("known: ")[2].split(", ")
    assert "make" in known and "np" in vars(theirs) and "np" not in known


def test_the_line_is_where_it_happened(theirs):
    with pytest.raises(PolicyError, match=rf"their_policy\.py, line {line_of('    return 1 / 0')}$"):
        make_policy("their_policy:raises", HELIX)
    with pytest.raises(PolicyError, match=rf"line {line_of('def returns_a_number(task):')}$"):
        make_policy("their_policy:returns_a_number", HELIX)


@pytest.mark.parametrize(
    ("policy", "said"),
    [
        ("Late", r"from seed 3, step 7: RuntimeError: lost; their_policy\.py, line {line}$"),
        (
            "Flat",
            r"actions must have shape \(1, 4\) for .* \(1, 226\), got ndarray of shape \(4,\).*, line \d+$",
        ),
        ("Bare", r"must return \(actions, state\), got ndarray of shape \(1, 4\)"),
        ("Ragged", r"actions must be an array: ValueError: .*, line \d+$"),
        ("Narrow", "TypeError: .*unexpected keyword argument 'deterministic'"),
    ],
)
def test_what_goes_wrong_in_flight_is_named(theirs, policy, said):
    where = line_of('            raise RuntimeError("lost")')
    with pytest.raises(PolicyError, match=f"policy {policy!r}, .*" + said.replace("{line}", str(where))):
        evaluate(f"their_policy:{policy}", HELIX, episodes=2, seed=3)


def test_the_same_holds_in_vector_environments_and_in_teams(theirs):
    envs = gym.make_vec(HELIX, num_envs=2)
    with pytest.raises(PolicyError, match=r"from seeds 0 to 1, step 7: RuntimeError: lost"):
        list(run_episodes(theirs.Late(None), envs, 2))
    team = formation_v0.parallel_env(vehicles=3)
    with pytest.raises(PolicyError, match=r"actions must have shape \(3, 4\) for .* \(3, \d+\)"):
        list(run_episodes(theirs.Flat(None), team, 1))
    assert evaluate("their_policy:make", team, episodes=1).vehicles == 3


def test_errors_of_the_suites_own_policies_keep_their_words():
    class Blind(gym.Wrapper):
        def step(self, action):
            observation, *rest = super().step(action)
            return np.full_like(observation, np.nan), *rest

    env = gym.make(HELIX)
    with pytest.raises(ValueError, match="observation 0 is not finite") as caught:
        evaluate(make_policy("lqr", env), Blind(env), episodes=1)
    assert not isinstance(caught.value, PolicyError)


def test_on_the_command_line_it_is_one_line(folder, capsys):
    for name in ("their_policy:raises", "their_policy:Late", "nowhere:make", "their_policy:Flat"):
        assert main(["evaluate", HELIX, name, "--episodes", "1"]) == 2
        out, err = capsys.readouterr()
        assert out == "" and err.count("\n") == 1 and "Traceback" not in err


def test_a_sweep_flies_policies_beside_those_of_its_suite_and_goes_on_without_the_broken_ones(
    theirs, folder, capsys
):
    policies = {
        "mine": theirs.make,
        "object": theirs.Even(gym.make(HELIX).unwrapped.task),
        "by name": "their_policy:make",
        "late": theirs.Late,
        "no policy": lambda task: 3,
        "nowhere": "nowhere:make",
    }
    with pytest.warns(UserWarning, match="does not fly in") as said:
        results = run_benchmark(SMALL, folder / "out", policies=policies)
    assert {str(warning.message).split("'")[1] for warning in said} == {"late", "no policy", "nowhere"}
    flown = [row["policy"] for row in results.summary()]
    assert flown == ["lqr", "hover", "mine", "object", "by name"]
    assert results.get(HELIX, "mine").records[0].score == results.get(HELIX, "hover").records[0].score
    assert [one.policy for one in results.failures] == ["late", "no policy", "nowhere"]
    assert "step 7" in results.failures[0].message and "their_policy.py, line" in str(results)
    with pytest.raises(KeyError, match="RuntimeError: lost"):
        results.get(HELIX, "late")
    page = (folder / "out" / "report.html").read_text()
    assert "late did not fly in" in page and '"mine"' in page
    stored = json.loads((folder / "out" / "failures.json").read_text())
    assert [one["policy"] for one in stored] == ["late", "no policy", "nowhere"]
    assert json.loads(json.dumps(results.to_dict()))["failures"] == stored


def test_the_command_benchmark_takes_policies_and_ends_with_one_if_some_broke_off(folder, capsys):
    (folder / "small.toml").write_text(
        'name = "s"\nepisodes = 1\nenvs = ["their_env:lab/Eight-v0"]\n'
        'policies = ["lqr", "their_policy:make"]\n'
    )
    run = ["benchmark", "small.toml", "--out", "out"]
    assert main(run) == 0
    out, _ = capsys.readouterr()
    assert "their_policy:make" in out and "their_env:lab/Eight-v0" in out
    again = ["benchmark", "small.toml", "--out", "other", "--policy", "their_policy:Late", "--json"]
    assert main(again) == 1
    out, err = capsys.readouterr()
    assert [one["policy"] for one in json.loads(out)["failures"]] == ["their_policy:Late"]
    assert "quad-envs: warning: 'their_policy:Late' does not fly in" in err


def test_policies_from_outside_fly_again_since_their_code_may_have_changed(theirs, folder, monkeypatch):
    import baselines.sweeps.crews

    run_benchmark(SMALL, folder / "out", policies={"mine": "their_policy:make"})
    flown, real = [], baselines.sweeps.crews.fly_unit
    monkeypatch.setattr(baselines.sweeps.crews, "fly_unit", lambda unit: flown.append(unit) or real(unit))
    run_benchmark(SMALL, folder / "out", policies={"mine": "their_policy:make"})
    assert [unit.policy.title for unit in flown] == ["mine"]


def test_a_sweep_of_nothing_but_broken_policies_is_refused(theirs, folder):
    with pytest.warns(UserWarning), pytest.raises(PolicyError, match="division by zero"):
        run_benchmark({**SMALL, "policies": ["their_policy:raises", "nowhere:make"]}, folder / "out")


def test_policies_travel_to_other_processes(theirs, folder):
    """To those too that began before the user's folder was importable: joblib keeps them for a while."""
    from joblib import Parallel, delayed

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "path", [place for place in sys.path if place not in ("", str(folder))])
        Parallel(n_jobs=2)(delayed(abs)(number) for number in range(4))
    results = run_benchmark(
        {**SMALL, "episodes": 1}, policies={"mine": theirs.Even, "by name": "their_policy:make"}, jobs=2
    )
    assert results.get(HELIX, "mine").records[0].score == results.get(HELIX, "by name").records[0].score


def test_evaluate_leaves_flights_tables_and_a_page(theirs, folder):
    env, seen = gym.make(HELIX, kappa=0.4), []
    policy = theirs.Even(env.unwrapped.task)
    found = evaluate(policy, env, episodes=3, on_episode=seen.append, out=folder / "out")
    assert [one.score for one in found.records] == [one.score for one in evaluate(policy, env, 3).records]
    assert len(seen) == 3 and len(list((folder / "out/episodes").glob("*.npz"))) == 3
    assert "Even" in (folder / "out/report.html").read_text()
    config = json.loads((folder / "out/config.json").read_text())
    assert config["suite"]["envs"][0]["kwargs"]["kappa"] == 0.4
    assert config["suite"]["policies"][0]["name"] == "their_policy:Even"
    evaluate(policy, env, episodes=3, on_episode=seen.append, out=folder / "out")
    assert len(seen) == 6  # an object flies again
    with pytest.raises(ResultsError, match="holds another suite"):
        evaluate(policy, env, episodes=3, seed=1, out=folder / "out")
    evaluate(policy, env, episodes=2, out=folder / "out")
    assert len(list((folder / "out/episodes").glob("*.npz"))) == 2


def test_evaluate_leaves_a_folder_of_teams_and_of_names_too(theirs, folder):
    team = formation_v0.parallel_env(vehicles=3, time_limit=1.0)
    assert evaluate("hover", team, episodes=1, out=folder / "team").vehicles == 3
    assert evaluate("hover", HELIX, episodes=1, out=folder / "name").policy == "hover"
    assert evaluate("their_policy:make", HELIX, 1, out=folder / "theirs").policy == "their_policy:make"
    for name in ("team", "name"):
        assert (folder / name / "report.html").exists()
    vector = formation_v0.vector_env(num_teams=2)
    with pytest.raises(ValueError, match="one team at a time"):
        evaluate("hover", vector, episodes=1, out=folder / "vector")


def test_an_environment_is_named_by_module_and_id(folder, capsys):
    assert main(["evaluate", "their_env:lab/Eight-v0", "lqr", "--episodes", "1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["env"] == "lab/Eight-v0"
    for wrong, said in (
        ("nowhere:lab/Eight-v0", "there is no module 'nowhere'"),
        ("their_env:lab/Ate-v0", "did you mean 'lab/Eight-v0'"),
    ):
        assert main(["evaluate", wrong, "lqr"]) == 2
        assert said in capsys.readouterr().err


def test_list_shows_the_options_of_an_environment_named_by_module_and_id(folder, capsys):
    assert main(["list", "their_env:lab/Eight-v0", "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    registered = gym.spec("lab/Eight-v0").kwargs
    assert values["preview"] == 25 and registered["env_id"] == "lab/Eight-v0" and "env_id" not in values
    assert values["reference"] == registered["reference"] != "helix"
    assert main(["list", f"quad_envs:{HELIX}", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["reference"] == "helix"
    assert main(["list", "their_env:lab/Ate-v0"]) == 2
    assert "did you mean 'lab/Eight-v0'" in capsys.readouterr().err


def test_the_options_of_an_environment_named_by_module_and_id_are_those_it_is_registered_with(theirs):
    options = training_options("their_env:lab/Eight-v0", {"kappa": 0.4})
    task = make_env("their_env:lab/Eight-v0", kappa=0.4).unwrapped.task
    assert options.task == task and task.env_id == "lab/Eight-v0"
    flights = HeldOutFlights("their_env:lab/Eight-v0", {"kappa": 0.4})
    assert flights.task == task
    gym.register("lab/Other-v0", entry_point="quad_envs.envs.tracking.env:TrackingEnv")
    try:
        with pytest.raises(
            ValueError, match="cannot be trained in: it must be registered with the entry_point"
        ):
            training_options("their_env:lab/Other-v0", {})
    finally:
        gym.registry.pop("lab/Other-v0")
    with pytest.raises(ValueError, match="unknown environment id 'their_env:lab/Ate-v0'"):
        training_options("their_env:lab/Ate-v0", {})


def test_installed_packages_offer_policies_by_entry_points(theirs, monkeypatch, capsys):
    entry = metadata.EntryPoint("their-own", "their_policy:make", "quad_envs.policies")
    hidden = metadata.EntryPoint("lqr", "their_policy:make", "quad_envs.policies")
    monkeypatch.setattr(metadata, "entry_points", lambda group: [entry, hidden])
    installed_policies.cache_clear()
    try:
        assert type(make_policy("their-own", HELIX)).__name__ == "Even"
        assert policy_options("their-own") == {"force": 1.0}
        assert make_policy("lqr", HELIX).name == "lqr"  # the suite's own names go first
        assert load_suite({**SMALL, "policies": ["their-own"]}).policies[0].name == "their-own"
        with pytest.raises(ValueError, match="did you mean 'their-own'"):
            make_policy("their-onw", HELIX)
        assert main(["list"]) == 0
        assert "their-own" in capsys.readouterr().out
    finally:
        installed_policies.cache_clear()


@pytest.mark.parametrize(
    ("name", "is_one"),
    [("a:b", True), ("a.b:C.d", True), ("lqr", False), ("C:/runs/net", False), ("a:", False), (":b", False)],
)
def test_names_of_factories_are_told_from_paths(name, is_one):
    assert names_factory(name) == is_one


def test_objects_have_the_name_of_their_class_and_functions_their_own(theirs):
    assert name_of(theirs.ready) == "their_policy:Even" and name_of(theirs.make) == "their_policy:make"
