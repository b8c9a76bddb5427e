"""Protocols: versions of suites, tables, tuned controllers, training conditions and disjoint starts."""

import csv
import json
from dataclasses import replace

import pytest
from stub_training import stubs  # noqa: F401

import baselines.sweeps.crews
from baselines import ResultsError, load_suite, run_benchmark
from baselines.policies.environments import make_env
from baselines.sweeps.budget import budget_of
from baselines.sweeps.choices import PolicyChoice, Tuning
from baselines.sweeps.contenders import Contender, _kind, find_base, plans, rank_of
from baselines.sweeps.folder import read_run
from baselines.sweeps.protocol import refuse_taken_version, require_disjoint_starts
from baselines.sweeps.suite import BEST_MPC, Suite
from baselines.sweeps.units import suite_units, training_units
from baselines.training.held_out import CHOOSING, HELD_OUT

# A change of a definition is a new version: the numbers of two definitions do not compare.
FROZEN = {"quad-bench-2026.1": "ae8ab993eb96de0c"}
GENERALISTS = {"apg-generalist", "dagger-generalist"}
SHORT = {"time_limit": 1.0}
SMALL = {
    "name": "small-bench",
    "protocol": "small-bench-1",
    "episodes": 3,
    "seed": 10_000,
    "compare_with": BEST_MPC,
    "envs": [{"id": "quad/HelixTracking-v0", "label": "Helix", "kwargs": SHORT}],
    "tables": [{"label": "as derived"}, {"label": "levelled", "about": "the same budget"}],
    "policies": [
        {"name": "lmpc", "tables": ["as derived"]},
        {"name": "hover"},
        {"name": "stub", "tables": ["as derived"], "train": {"seeds": [0, 1], "steps": 200}},
        {
            "name": "lmpc",
            "tables": ["levelled"],
            "tune": {"seeds": [0, 1], "episodes": 32, "fields": ["R"]},
            "train_under": {"randomize": 0.1},
        },
        {"name": "lmpc", "label": "R 0.1", "kwargs": {"R": 0.1}, "conditions": ["nominal"], "trace": "R"},
    ],
    "conditions": [{"label": "nominal"}, {"label": "weak", "kwargs": {"kappa": 0.3125}}],
}


@pytest.fixture(scope="module")
def networks(tmp_path_factory):
    return tmp_path_factory.mktemp("networks")


@pytest.fixture
def finished(tmp_path, networks):
    """Results and folder of the small protocol; what is made is made once."""
    return run_benchmark(SMALL, tmp_path / "run", networks=networks), tmp_path / "run"


def test_the_definition_of_a_shipped_protocol_never_changes_under_its_version():
    for name, digest in FROZEN.items():
        suite = load_suite(name)
        assert (suite.protocol, suite.definition, suite.whole) == (name, digest, True)


def test_the_shipped_protocol_keeps_its_promises():
    suite = load_suite("quad-bench-2026.1")
    seeds = {}
    for policy in suite.policies:
        if policy.made is not None:
            seeds.setdefault((policy.contender, policy.envs), set()).add(policy.made.seed)
    assert set(map(frozenset, seeds.values())) == {frozenset(range(5))}
    levelled = [policy for policy in suite.policies if policy.tables == ("levelled",)]
    made = [policy for policy in levelled if policy.made is not None]
    assert {policy.made.seconds for policy in made} == {60}
    assert {policy.title for policy in levelled if policy not in made} == GENERALISTS
    tuned = [policy for policy in made if policy.tune is not None]
    assert tuned and {policy.tune.objective for policy in tuned} == {"score"}
    for policy in tuned:  # score-nmpc does by itself
        planned = "score" if policy.name in ("lmpc", "sdc-nmpc") else None
        assert policy.kwargs.get("objective") == planned and policy.kwargs["reject_disturbance"]
    for env in suite.envs:  # the same conditions for all of a table; teams have one of their own
        if env.tables:
            continue
        under = [policy.train_under for policy in suite.policies_in(env) if policy in made]
        assert under and all(each == under[0] for each in under)
    assert suite.episodes == 100 and suite.base == BEST_MPC
    whole, quick = budget_of(suite), budget_of(suite.quick())
    assert (whole.making + whole.flying) / 2 < 6 * 3600.0
    assert (quick.making + quick.flying) / 2 < 600.0


def test_teams_are_levelled_as_single_vehicles_are():
    suite = load_suite("quad-bench-2026.1").only(["teams"])
    assert [table.label for table in suite.tables] == ["teams, as derived", "teams, levelled"]
    levelled = [policy for policy in suite.policies if policy.tables == ("teams, levelled",)]
    assert {policy.name for policy in levelled} == {"consensus-mpc", "apg"}
    assert {(policy.made.seconds, policy.made.seed) for policy in levelled} == {(60, k) for k in range(5)}
    for policy in levelled:
        assert policy.train_under == {"disturbance": "varied-gusts"}
        sees = policy.kwargs if policy.train is None else policy.train.hyper
        assert sees.get("reject_disturbance", False) != sees.get("disturbance_estimate", False)


def test_networks_as_derived_have_the_budgets_of_the_results_that_are_committed():
    def budgets(suite, tables):
        return {
            (policy.name, policy.made.steps, policy.made.seconds)
            for policy in suite.policies
            if policy.train is not None and policy.tables == tables
        }

    committed = budgets(load_suite("rl-vs-mpc"), ())
    assert len(committed) == 4 and budgets(load_suite("quad-bench-2026.1"), ("as derived",)) == committed


def test_a_shipped_network_that_is_named_is_told_from_controllers():
    suite = load_suite("quad-bench-2026.1")
    named = [policy for policy in suite.policies if policy.name in GENERALISTS]
    assert [_kind(policy) for policy in named] == ["model-based", "imitation"]
    for policy in named:
        assert not plans(policy) and "Corridor" not in policy.envs and len(policy.envs) == 6


@pytest.mark.parametrize("name", FROZEN)
def test_every_condition_of_a_shipped_protocol_can_be_flown(name):
    suite = load_suite(name)
    for env in suite.envs:
        for flown in suite.flown(env).values():
            make_env(flown.id, **flown.kwargs).close()
        for policy in suite.policies_in(env):
            make_env(env.id, **{**env.kwargs, **policy.train_under}).close()


def test_ranges_of_starts_for_training_judging_and_choosing_are_disjoint():
    suite = load_suite("quad-bench-2026.1")
    require_disjoint_starts(suite)
    assert HELD_OUT <= suite.seed and suite.seed + suite.episodes <= CHOOSING


def test_a_suite_of_ones_own_under_the_version_of_a_shipped_protocol_is_refused(tmp_path):
    ours = load_suite("quad-bench-2026.1")
    refuse_taken_version(ours)
    refuse_taken_version(ours.only(["Helix"]).quick())
    with pytest.raises(ValueError, match=r"protocol 'quad-bench-2026.1', and has .*another version"):
        run_benchmark(SMALL | {"protocol": "quad-bench-2026.1"}, tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(("seed", "episodes"), [(9_999, 3), (0, 3), (19_998, 3), (20_000, 3)])
def test_a_protocol_that_judges_starts_of_training_is_refused(tmp_path, seed, episodes):
    with pytest.raises(ValueError, match=r"judges starts .* they must lie in 10000 to 19999"):
        run_benchmark(SMALL | {"seed": seed, "episodes": episodes}, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_contenders_are_compared_within_their_table_with_its_best_mpc(finished):
    rows = finished[0].contender_rows()
    found = {(row["table"], row["condition"], row["policy"]): row for row in rows}
    assert {key[2] for key in found if key[0] == "as derived"} == {"lmpc", "hover", "stub", "R 0.1"}
    assert {key[2] for key in found if key[0] == "levelled"} == {"hover", "lmpc, tuned", "R 0.1"}
    tuned = found["levelled", "weak", "lmpc, tuned"]
    assert (tuned["kind"], tuned["seeds"], tuned["flights"], tuned["mpc"]) == ("tuned", 2, 6, True)
    assert tuned["base"] == "lmpc, tuned" and tuned["score_minus_base"] == 0.0
    assert found["as derived", "weak", "hover"]["base"] == "lmpc"
    for table in ("as derived", "levelled"):
        here = [row for row in rows if (row["table"], row["condition"]) == (table, "nominal")]
        best = max((row for row in here if row["mpc"]), key=lambda row: row["score"])
        assert {row["base"] for row in here} == {best["policy"]}


def test_a_policy_flies_under_its_conditions_only(finished):
    flown = [unit.env.title for unit in suite_units(finished[0].suite) if unit.policy.title == "R 0.1"]
    assert flown == ["Helix, nominal"]


def test_crashes_come_before_violations_and_these_before_the_score(finished):
    one = finished[0].get("Helix, nominal", "lmpc")

    def evaluation(score, violating=0.0, crashed=False):
        record = one.records[0]._replace(score=score, violation_share=violating, crashed=crashed)
        return replace(one, records=(record,))

    order = [evaluation(0.5), evaluation(0.4, 0.01), evaluation(0.9, 0.02), evaluation(0.99, 0.0, True)]
    assert sorted(reversed(order), key=lambda each: rank_of([each])) == order
    group = [
        Contender("e", "c", name, "controller", mpc, "", (), (flown,), ())
        for name, mpc, flown in (
            ("net", False, evaluation(0.9)),
            ("a", True, order[0]),
            ("b", True, order[3]),
        )
    ]
    assert find_base(group, BEST_MPC).name == "a"
    assert find_base(group[:1], BEST_MPC).name == "net"


def test_what_is_tuned_or_trained_knows_the_conditions_of_training_and_flies_without(finished, networks):
    made = training_units(finished[0].suite, networks)
    folders = {unit.policy.title: unit.folder for unit in made}
    tuned = json.loads((folders["lmpc, tuned, seed 1"] / "config.json").read_text())
    assert tuned["env_kwargs"] == {**SHORT, "randomize": 0.1} and tuned["seed"] == 1
    trained = json.loads((folders["stub, seed 0"] / "config.json").read_text())
    assert trained["env_kwargs"] == SHORT
    assert "randomize" not in next(
        unit.env.kwargs for unit in suite_units(finished[0].suite) if unit.policy.tune is not None
    )


def test_results_and_their_folder_carry_the_digest(finished):
    results, folder = finished
    said = json.loads((folder / "config.json").read_text())["protocol"]
    assert said == results.to_dict()["protocol"]
    assert (said["version"], said["whole"]) == ("small-bench-1", True)
    assert said["definition"] == said["flown"] == load_suite(SMALL).digest
    assert said["starts"]["judging"] == "10000 to 10002"
    with open(folder / "contenders.csv", newline="") as file:
        assert {row["table"] for row in csv.DictReader(file)} == {"as derived", "levelled"}


def test_a_part_of_a_protocol_says_that_it_is_one():
    suite = load_suite(SMALL)
    for part in (suite.quick(), suite.only(["levelled"]), replace(suite, episodes=2)):
        assert part.definition == suite.digest != part.digest and not part.whole
    assert suite.only(["tracking"]) == suite


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"protocol": "small-bench-2"}, "of protocol 'small-bench-1', definition"),
        ({"conditions": [{"label": "nominal"}]}, "numbers of two protocols do not mix"),
        ({"protocol": ""}, "asked for is 'small-bench'"),
    ],
)
def test_a_folder_of_another_version_is_refused_with_the_remedy(finished, networks, change, message):
    before = (finished[1] / "results.csv").read_bytes()
    with pytest.raises(ResultsError, match=message) as error:
        run_benchmark(SMALL | change, finished[1], networks=networks)
    assert "--fresh" in str(error.value) and "which began it" in str(error.value)
    assert (finished[1] / "results.csv").read_bytes() == before


def test_a_changed_suite_in_a_folder_is_not_read_as_the_protocol(finished):
    config = finished[1] / "config.json"
    said = json.loads(config.read_text())
    said["suite"]["policies"][1]["label"] = "another"
    config.write_text(json.dumps(said))
    with pytest.raises(ResultsError, match="is not the one that was flown, of digest"):
        read_run(finished[1])


def test_what_is_made_is_made_once(tmp_path, networks, finished, monkeypatch):
    monkeypatch.setattr("baselines.sweeps.finished.run_training", None)  # it would fail
    before = {path: path.read_bytes() for path in networks.rglob("tuned.json")}
    again = run_benchmark(SMALL, tmp_path / "again", networks=networks)
    assert [row["score"] for row in again.rows()] == [row["score"] for row in finished[0].rows()]
    assert len(before) == 2 and before == {path: path.read_bytes() for path in networks.rglob("tuned.json")}


def test_an_interrupted_protocol_goes_on_with_what_it_made(tmp_path, finished, monkeypatch):
    def interrupt(count, total):
        if count == 3:  # two networks and a tuning
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_benchmark(SMALL, tmp_path / "cut", on_unit=interrupt)
    made = sorted(path.parent.name for path in (tmp_path / "cut").rglob("tuned.json"))
    assert len(made) == 1 and not (tmp_path / "cut" / "results.csv").exists()
    calls, real = [], baselines.sweeps.crews.train_unit
    monkeypatch.setattr(
        baselines.sweeps.crews, "train_unit", lambda unit: calls.append(unit.policy.title) or real(unit)
    )
    results = run_benchmark(SMALL, tmp_path / "cut")
    assert len(calls) == 4
    assert [row["score"] for row in results.rows()] == [row["score"] for row in finished[0].rows()]


def test_a_tuning_that_was_cut_off_before_it_judged_begins_again(tmp_path, networks, finished):
    unit = next(one for one in training_units(finished[0].suite, tmp_path / "n") if one.policy.tune)
    unit.folder.mkdir(parents=True)
    made = next(one for one in training_units(finished[0].suite, networks) if one.policy.tune).folder
    (unit.folder / "config.json").write_text((made / "config.json").read_text())
    results = run_benchmark(SMALL, tmp_path / "run2", networks=tmp_path / "n")
    assert [row["score"] for row in results.rows()] == [row["score"] for row in finished[0].rows()]


def test_only_keeps_the_parts_that_are_named():
    teams = {"id": "quad/Formation-v0", "label": "Formation"}
    both = load_suite(
        SMALL
        | {
            "envs": [*SMALL["envs"], teams],
            "policies": [
                *({**one, "envs": ["Helix"]} for one in SMALL["policies"]),
                {"name": "consensus-mpc", "envs": ["Formation"]},
            ],
        }
    )
    assert [env.title for env in both.only(["teams"]).envs] == ["Formation"]
    assert [one.title for one in both.only(["teams"]).policies] == ["consensus-mpc"]
    tracking = both.only(["tracking", "weak", "as derived"])
    assert [env.title for env in tracking.envs] == ["Helix"]
    assert [one.label for one in tracking.conditions] == ["weak"]
    assert {one.title for one in tracking.policies} == {"lmpc", "hover", "stub, seed 0", "stub, seed 1"}
    assert both.only(["Formation"]) != both and both.only(["tracking", "teams"]) == both
    with pytest.raises(ValueError, match="has no part 'teams' yet; it has tracking"):
        load_suite(SMALL).only(["teams"])
    with pytest.raises(ValueError, match="did you mean 'levelled'"):
        load_suite(SMALL).only(["leveled"])


def test_only_a_condition_keeps_the_environments_that_meet_it():
    whole = load_suite("quad-bench-2026.1")
    gusts = whole.only(["gusts"])
    assert [env.title for env in gusts.envs] == [e.title for e in whole.envs if "gusts" in whole.flown(e)]
    assert len(gusts.envs) < len(whole.envs)


def test_a_stored_protocol_is_read_again_and_one_of_before_had_no_tables():
    suite = load_suite(SMALL)
    stored = json.loads(json.dumps(suite.to_dict()))
    assert Suite.from_dict(stored) == suite and load_suite(stored) == suite
    for name in ("tables", "small", "protocol", "definition"):
        del stored[name]
    stored["policies"] = [one for one in stored["policies"] if one["tune"] is None]
    for policy in stored["policies"]:
        for name in ("tune", "train_under", "conditions", "tables", "trace"):
            del policy[name]
    assert Suite.from_dict(stored).tables == ()


def with_policy(**table):
    return SMALL | {"policies": [*SMALL["policies"], {"name": "nmpc", **table}]}


@pytest.mark.parametrize(
    ("suite", "message"),
    [
        (with_policy(tune={"second": 3}), "did you mean 'seconds'"),
        (with_policy(tune=60), "tune must be a table"),
        (with_policy(tune={"seeds": 3}), "seeds of a tuning must be a list"),
        (with_policy(tune={"seed": 100}), "seed of a tuning in a suite must be"),
        (with_policy(tune={"objective": "scor"}), "objective"),
        (with_policy(tune={"fields": ["Qq"]}), "did you mean 'Q'"),
        (with_policy(tune={"episodes": 1}), "a tuning of 1 episode cannot compare anything"),
        (with_policy(tune={"seconds": 0}), "seconds of a tuning must be a number > 0"),
        (with_policy(name="hover", label="h", tune={}), "has no option that can be tuned"),
        (with_policy(name="stub", train={}, tune={}), "train and tune: give one of them"),
        (with_policy(train_under={"randomize": 0.1}), "neither trained nor tuned"),
        (with_policy(tune={}, train_under={"randomise": 0.1}), "did you mean 'randomize'"),
        (with_policy(tune={}, train_under=3), "train_under of 'nmpc' must be a table"),
        (with_policy(tables=["leveled"]), "did you mean 'levelled'"),
        (with_policy(conditions=["week"]), "did you mean 'weak'"),
        (SMALL | {"small": {"seed": 1}}, "did you mean 'seeds'"),
        (SMALL | {"small": {"divisor": 0.5}}, "divisor of the small part"),
        (SMALL | {"tables": [{"label": "a"}, {"label": "a"}]}, "'a' twice in tables"),
    ],
)
def test_a_mistake_in_a_protocol_is_refused_before_anything_is_done(tmp_path, suite, message):
    with pytest.raises(ValueError, match=message):
        run_benchmark(suite, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_seeds_of_equal_contenders_may_be_made_under_other_conditions_elsewhere():
    envs = [*SMALL["envs"], {"id": "quad/CorridorTracking-v0", "label": "Corridor"}]
    tuned = [
        {"name": "nmpc", "tune": {"seeds": [0, 1]}, "train_under": {"randomize": share}, "envs": [env]}
        for env, share in (("Helix", 0.2), ("Corridor", 0.05))
    ]
    suite = load_suite(SMALL | {"envs": envs, "policies": [*SMALL["policies"], *tuned]})
    under = {unit.env.title: unit.env_kwargs for unit in training_units(suite) if unit.policy.name == "nmpc"}
    assert under == {"Helix": {**SHORT, "randomize": 0.2}, "Corridor": {"randomize": 0.05}}
    with pytest.raises(ValueError, match=r"'nmpc, tuned, seed 0' twice in policies"):
        load_suite(SMALL | {"policies": [*SMALL["policies"], tuned[0], tuned[0]]})


def test_a_tuned_choice_flies_with_the_options_that_were_found():
    choice = PolicyChoice("nmpc", {"reject_disturbance": True}, tune=Tuning(seed=3))
    assert choice.title == "nmpc, reject_disturbance=True, tuned, seed 3"
    suite = load_suite(SMALL)
    assert all(unit.options == {} for unit in suite_units(suite) if unit.policy.made is not None)
    assert [unit.options for unit in suite_units(suite) if unit.policy.title == "R 0.1"] == [{"R": 0.1}]


def test_a_budget_in_steps_is_estimated_by_what_steps_take():
    def making(**budget):
        policies = [{"name": "apg", "train": {"seeds": [0], **budget}}, "lmpc"]
        return budget_of(load_suite(SMALL | {"policies": policies, "tables": []})).making

    assert making(steps=450_000) == pytest.approx(making(seconds=10))


def test_the_budget_is_said_before_anything_is_made():
    said = budget_of(load_suite(SMALL)).said(2)
    assert said.startswith("budget: make 4 policies, about ") and "with 2 jobs about" in said
