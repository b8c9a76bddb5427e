"""The trained networks that come with the suite."""

import json

import gymnasium
import pytest

from baselines import evaluate, make_policy, shipped_policies
from baselines.policies.trained import SHIPPED, shipped_name
from baselines.training.held_out import CHOOSING
from baselines.training.shipping import judged
from quad_envs import formation_v0
from quad_envs.registration import TEAMS, TRACKING

NAMES = sorted(shipped_policies())
VEHICLES = 6  # of the hexagon


def test_every_tracking_task_has_a_policy_of_each_class():
    for env_id in TRACKING:
        for algorithm in ("apg", "dagger", "ppo"):
            assert shipped_name(algorithm, env_id) in NAMES


@pytest.mark.parametrize("name", NAMES)
def test_a_shipped_policy_is_small_and_says_what_made_it(name):
    assert sum(path.stat().st_size for path in (SHIPPED / name).iterdir()) < 200_000
    said = json.loads((SHIPPED / name / "policy.json").read_text())
    assert said["made_by"].startswith(f"quad-envs train {said['env_id']} {said['algorithm']} --seed ")
    assert {"python", "numpy", "torch"} <= set(said["versions"]) and said["git_revision"]
    assert "/" not in json.dumps({**said, "env_id": "", "made_by": ""})  # no path of the machine that made it
    assert (SHIPPED / name / "curve.csv").read_text().startswith("cpu_seconds,steps,updates,score")


def test_a_policy_for_several_tasks_stands_for_none_of_them():
    assert shipped_name("apg", "quad/RandomTracking-v0") == "apg-random"
    assert shipped_name("dagger", "quad/RandomTracking-v0") == "dagger-random"


def test_scores_of_teams_are_of_many_independent_teams_and_say_their_interval():
    told = [json.loads((SHIPPED / name / "policy.json").read_text()) for name in NAMES]
    teams = [said for said in told if said["env_id"] in TEAMS]
    assert {said["algorithm"] for said in teams} == {"apg", "dagger"}
    for said in teams:
        assert said["starts"]["teams"] >= 100 and 0.0 < said["score_half_width"] < 0.05
        assert said["min_separation"] > 0.4
        # Stronger gusts than those of the environments, about a steady force, may carry a team off.
        beyond = said["env_kwargs"].get("disturbance") == "varied-gusts"
        assert said["crashes"] <= beyond * 0.03 * said["starts"]["teams"] * VEHICLES


@pytest.mark.slow
@pytest.mark.parametrize("air", [{}, {"disturbance": "gusts"}], ids=["still", "gusts"])
def test_the_team_that_estimates_the_disturbance_stays_whole_in_gusts_and_ahead_of_the_mpc(air):
    env = formation_v0.parallel_env(formation="hexagon", **air)
    team = evaluate(make_policy("apg-formation", env), env, episodes=20, seed=10_000)
    mpc = evaluate(make_policy("consensus-mpc", env, reject_disturbance=True), env, episodes=20, seed=10_000)
    assert not any(record.crashed for record in team.records)
    assert team.summary()["score"].mean > mpc.summary()["score"].mean + 0.04


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_shipped_policy_has_its_recorded_score(name):
    said = json.loads((SHIPPED / name / "policy.json").read_text())
    found = judged(SHIPPED / name)
    # Rounding differs between processors, and a flight of 200 steps may carry it on.
    assert found.score == pytest.approx(said["score"], abs=1e-4)
    assert found.violation_share == pytest.approx(said["violation_share"], abs=1e-3)
    assert found.crashes == said["crashes"]


@pytest.mark.parametrize("name", ["apg-generalist", "dagger-generalist"])
def test_a_generalist_flies_all_tracking_ids_other_references_and_under_a_filter(name):
    ids = [env_id for env_id in TRACKING if env_id != "quad/CorridorTracking-v0"]
    for env_id in ids:
        assert evaluate(name, env_id, 3, CHOOSING).summary()["score"].mean > 0.7, env_id
    racetrack = gymnasium.make(ids[0], reference="racetrack", disturbance="gusts")
    assert not any(record.crashed for record in evaluate(name, racetrack, 3, CHOOSING).records)
    kept = evaluate(f"safe:{name}", "quad/CorridorTracking-v0", 1, CHOOSING)
    assert kept.records[0].violation_share == 0.0


def test_a_shipped_policy_flies_by_its_name_without_torch(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "torch", None)  # an import of it would fail
    assert make_policy("apg-helix", "quad/HelixTracking-v0").kind == "model-based"
