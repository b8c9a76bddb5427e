"""Suites that train networks, and the comparison of learned policies with controllers."""

import json
import math

import numpy as np
import pytest
from stub_training import stubs  # noqa: F401

from baselines import PolicyError, ResultsError, Suite, load_suite, run_benchmark
from baselines.policies.environments import make_env
from baselines.sweeps.contenders import ALL
from baselines.sweeps.finished import train_unit
from baselines.sweeps.suite_files import suite_from_dict
from baselines.sweeps.units import suite_units, training_units

SHORT = {"time_limit": 1.0}
LEARNED = {
    "name": "learned",
    "episodes": 3,
    "seed": 10_000,
    "compare_with": "lqr",
    "envs": [
        {"id": "quad/HelixTracking-v0", "label": "Helix", "kwargs": SHORT},
        {"id": "quad/RandomTracking-v0", "label": "Random", "kwargs": SHORT},
    ],
    "policies": ["lqr", {"name": "stub", "train": {"seeds": [0, 1], "steps": 300}}],
    "conditions": [
        {"label": "nominal"},
        {"label": "weak", "kwargs": {"kappa": 0.3125}, "envs": ["Helix"]},
    ],
}


def test_a_suite_trains_one_network_per_environment_and_seed_and_flies_it_under_every_condition():
    suite = load_suite(LEARNED)
    networks = [(unit.env.title, unit.policy.title) for unit in training_units(suite)]
    assert networks == [(env, f"stub, seed {k}") for k in (0, 1) for env in ("Helix", "Random")]
    flown = dict.fromkeys(unit.env.title for unit in suite_units(suite))
    assert list(flown) == ["Helix, nominal", "Helix, weak", "Random, nominal"]
    names = {(u.env.title, u.policy.title): u.policy_name for u in suite_units(suite)}
    assert names["Helix, nominal", "stub, seed 1"] == names["Helix, weak", "stub, seed 1"]
    assert names["Helix, nominal", "stub, seed 1"] != names["Random, nominal", "stub, seed 1"]


@pytest.mark.parametrize("others", [["lqr"], []])
def test_a_task_that_the_only_tuning_does_not_survive_leaves_the_other_policies(tmp_path, others):
    rolling = (0.0,) * 6 + (1.4, 0.0, 0.0, 30.0, 0.0, 0.0)  # past 85 degrees within a sample
    tuned = {"name": "lmpc", "tune": {"seeds": [0], "episodes": 32, "fields": ["terminal"]}}
    suite = {
        "name": "doomed",
        "episodes": 2,
        "envs": [{"id": "quad/HelixTracking-v0", "kwargs": {"start": rolling, "start_box": 0.0, **SHORT}}],
        "policies": [tuned, *others],
    }
    said = "it could not be tuned: no candidate for 'lmpc' stays in the air"
    if not others:
        with pytest.raises(PolicyError, match=said):
            run_benchmark(suite, tmp_path)
        return
    with pytest.warns(UserWarning, match=said):
        results = run_benchmark(suite, tmp_path)
    assert [(each.policy, each.message[: len(said)]) for each in results.failures] == [
        ("lmpc, tuned, seed 0", said)
    ]
    assert [evaluation.policy for evaluation in results.evaluations] == ["lqr"]
    assert (tmp_path / "report.html").exists()


def test_a_stored_suite_is_read_again():
    suite = load_suite(LEARNED)
    stored = json.loads(json.dumps(suite.to_dict()))
    assert suite_from_dict(stored) == suite and Suite.from_dict(stored) == suite


def test_training_seeds_are_one_contender_and_the_base_is_no_better_than_itself(tmp_path):
    results = run_benchmark(LEARNED, tmp_path)
    rows = results.contender_rows()
    found = {(row["env"], row["condition"], row["policy"]): row for row in rows}
    assert len(rows) == 3 * 2 + 2  # and over both environments in the nominal condition
    stub_row, lqr = found["Helix", "weak", "stub"], found["Helix", "weak", "lqr"]
    assert (stub_row["seeds"], stub_row["flights"], lqr["seeds"], lqr["flights"]) == (2, 6, 1, 3)
    assert stub_row["kind"] == "imitation" and stub_row["training_steps"] >= 300
    assert lqr["kind"] == "controller" and math.isnan(lqr["training_steps"])
    assert lqr["score_minus_base"] == 0.0 and lqr["improvement"] == 0.5
    evaluations = [results.get("Helix, weak", f"stub, seed {k}") for k in (0, 1)]
    scores = [[record.score for record in one.records] for one in evaluations]
    assert stub_row["score"] == pytest.approx(np.mean(scores))
    ours, base = np.mean(scores), results.get("Helix, weak", "lqr").summary()["score"].mean
    assert stub_row["score_minus_base"] == pytest.approx(ours - base)
    assert found[ALL, "nominal", "stub"]["environments"] == 2
    assert (tmp_path / "contenders.csv").exists() and "P(better)" in str(results)


def test_networks_are_trained_once_and_may_lie_elsewhere(tmp_path, monkeypatch):
    first = run_benchmark(LEARNED, tmp_path / "a", networks=tmp_path / "nets")
    monkeypatch.setattr("baselines.sweeps.finished.run_training", None)  # it would fail
    second = run_benchmark(LEARNED, tmp_path / "b", networks=tmp_path / "nets", jobs=1)
    scores = [[row["score"] for row in results.rows()] for results in (first, second)]
    assert scores[0] == scores[1] and not (tmp_path / "a" / "networks").exists()


def test_an_interrupted_training_goes_on(tmp_path, monkeypatch):
    whole = suite_from_dict(LEARNED)
    short = suite_from_dict({**LEARNED, "policies": ["lqr", {"name": "stub", "train": {"steps": 100}}]})
    unit = training_units(short, tmp_path)[0]
    assert train_unit(unit)["curve"][-1]["steps"] == 100
    longer = train_unit(training_units(whole, tmp_path)[0]._replace(folder=unit.folder))
    assert longer["curve"][-1]["steps"] >= 300
    assert longer["curve"][0]["steps"] == 100


def test_another_network_in_the_folder_is_not_taken(tmp_path):
    run_benchmark(LEARNED, tmp_path / "a", networks=tmp_path / "nets")
    other = {**LEARNED, "envs": [{**LEARNED["envs"][0], "kwargs": {"time_limit": 2.0}}], "conditions": []}
    with pytest.raises(ResultsError, match="holds another training: its env_kwargs"):
        run_benchmark(other, tmp_path / "b", networks=tmp_path / "nets")


def test_every_condition_of_the_shipped_suite_can_be_flown():
    suite = load_suite("rl-vs-mpc")
    for env in suite.envs:
        for flown in suite.flown(env).values():
            make_env(flown.id, **flown.kwargs).close()


def test_a_quick_suite_is_a_small_part():
    suite = load_suite("rl-vs-mpc").quick()
    assert [env.title for env in suite.envs] == ["Helix"] and suite.episodes == 5
    assert [one.label for one in suite.conditions] == ["nominal", "2.45 N, far starts"]
    trained = [policy for policy in suite.policies if policy.train is not None]
    assert {policy.train.seed for policy in trained} == {0, 1}
    assert {policy.train.steps for policy in trained} == {60_000, 2_000, 200_000}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"policies": [{"name": "pqo", "train": {}}]}, "did you mean 'ppo'"),
        ({"policies": [{"name": "stub", "train": {"step": 3}}]}, "did you mean 'steps'"),
        ({"policies": [{"name": "stub", "train": 3}]}, "train must be a table"),
        ({"policies": [{"name": "stub", "train": {"seeds": 3}}]}, "seeds of a training must be a list"),
        ({"policies": [{"name": "stub", "train": {"seed": -1}}]}, "seed of a training in a suite must be"),
        ({"policies": [{"name": "stub", "train": {"steps": 0}}]}, "steps of training must be a whole number"),
        ({"policies": [{"name": "stub", "shipped": "yes"}]}, "shipped of 'stub' must be true or false"),
        ({"policies": [{"name": "stub", "shipped": True}]}, "no policy of 'stub' is shipped for"),
        ({"conditions": [{"label": "a"}, {"label": "a"}]}, "'a' twice in conditions"),
        ({"conditions": [{"label": "a", "envs": ["Helix"]}]}, "has no condition for 'Random'"),
        ({"conditions": [{"label": "a", "envs": ["Helx"]}]}, "did you mean 'Helix'"),
        ({"conditions": [{"kwargs": {}}]}, "each table needs 'label'"),
    ],
)
def test_a_mistake_in_a_suite_with_training_is_refused_before_anything_is_done(tmp_path, change, message):
    change = {"compare_with": "", **change}
    with pytest.raises(ValueError, match=message):
        run_benchmark(LEARNED | change, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_training_needs_a_folder():
    with pytest.raises(ValueError, match="trains or tunes policies, which need a folder"):
        run_benchmark(LEARNED)
