"""What stands between a policy and its task: wrappers, names, and the models of Stable-Baselines3."""

import gymnasium as gym
import numpy as np
import pytest
from sources import ROOT, reads_sources

from baselines import EstimateWrapper, PolicyCheckError, check_policy, evaluate, make_policy, run_benchmark
from baselines.policies.pairing import JUDGED_ONLY
from quad_envs import formation_v0, target_tracking_v0

HELIX, FORMATION = "quad/HelixTracking-v0", "quad/Formation-v0"


@pytest.mark.parametrize(
    "wrap",
    [
        gym.wrappers.NormalizeObservation,
        lambda env: gym.wrappers.TransformObservation(env, lambda obs: 2.0 * obs, env.observation_space),
        lambda env: gym.wrappers.RescaleAction(env, np.float32(-2.0), np.float32(2.0)),
        lambda env: gym.wrappers.RecordEpisodeStatistics(gym.wrappers.NormalizeObservation(env)),
    ],
)
def test_a_wrapper_that_changes_the_numbers_above_a_controller_is_refused_by_name(wrap):
    env = gym.make("quad/HelixTracking-v0")
    with pytest.raises(ValueError, match=r"the wrapper \w+ changes .*policy 'lmpc'.*env\.unwrapped"):
        evaluate(make_policy("lmpc", env), wrap(env), episodes=1)


def test_the_same_holds_for_vector_environments():
    env = gym.make_vec("quad/HelixTracking-v0", num_envs=2)
    with pytest.raises(ValueError, match="the wrapper NormalizeObservation changes"):
        evaluate(make_policy("lqr", env), gym.wrappers.vector.NormalizeObservation(env), episodes=2)


@pytest.mark.parametrize(
    "wrap",
    [
        gym.wrappers.RecordEpisodeStatistics,
        gym.wrappers.NormalizeReward,
        gym.wrappers.FlattenObservation,
    ],
)
def test_wrappers_that_leave_the_numbers_alone_change_no_score(wrap):
    env = gym.make("quad/HelixTracking-v0")
    plain = evaluate("lqr", env, episodes=1).records[0]
    wrapped = evaluate(make_policy("lqr", env), wrap(env), episodes=1).records[0]
    assert wrapped.position_rms == plain.position_rms


@pytest.mark.parametrize("env_id", [HELIX, FORMATION])
def test_whole_numbers_of_numpy_are_as_good_as_pythons(env_id, tmp_path):
    def told(found):
        return type(found.seed), [(record.seed, record.score) for record in found.records]

    plain = told(evaluate("hover", env_id, episodes=2, seed=3))
    for number in (np.int64, np.uint8):
        assert told(evaluate("hover", env_id, episodes=number(2), seed=number(3))) == plain
    suite = {"envs": [{"id": env_id}], "policies": ["hover"], "episodes": np.int64(2), "seed": np.int64(3)}
    assert told(run_benchmark(suite, tmp_path / "run").evaluations[0])[1] == plain[1]


def test_evaluate_takes_the_name_of_a_policy():
    by_name = evaluate("lqr", "quad/HelixTracking-v0", episodes=2)
    env = gym.make("quad/HelixTracking-v0")
    made = evaluate(make_policy("lqr", env), env, episodes=2)
    assert [r.score for r in by_name.records] == [r.score for r in made.records]
    with pytest.raises(ValueError, match="lqr"):
        evaluate("lqrr", "quad/HelixTracking-v0")


@pytest.mark.parametrize("algorithm", ["PPO", "SAC"])
def test_models_of_stable_baselines3_pass_the_check_and_fly_deterministically(algorithm):
    """They draw by default: two evaluations agree only if `deterministic=True` is passed."""
    sb3 = pytest.importorskip("stable_baselines3")
    env = gym.make("quad/RandomTracking-v0")
    model = getattr(sb3, algorithm)("MlpPolicy", env, seed=0, device="cpu")
    check_policy(model, env)
    first, second = (evaluate(model, env, episodes=1).records[0] for _ in range(2))
    assert first.score == second.score


def test_a_model_under_the_wrapper_it_was_trained_with_flies():
    sb3 = pytest.importorskip("stable_baselines3")
    env = gym.wrappers.NormalizeObservation(gym.make("quad/RandomTracking-v0"))
    model = sb3.PPO("MlpPolicy", env, seed=0, device="cpu")
    assert evaluate(model, env, episodes=1).flights == 1


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({"mass": 1.2}, r"task\.params\.mass is 0\.8 for the policy and 1\.2 in the environment"),
        ({"kappa": 0.3125}, r"task\.limits\.kappa is 1\.0 .* and 0\.3125"),
        ({"kappa": (1.0, 1.0, 1.0, 0.5)}, r"task\.limits\.kappa is 1\.0 .* and \(1\.0, 1\.0, 1\.0, 0\.5\)"),
        ({"dt": 0.1}, r"task\.dt is 0\.05 .* and 0\.1"),
        ({"Q": 2.0}, r"task\.weights\.Q is \(1\.0, .* and \(2\.0, "),
        ({"preview": 30}, r"task\.layout\.preview is 25 .* and 30"),
        ({"sensor_noise": 0.01}, r"task\.sensor_noise is "),
        ({"vehicle": "crazyflie"}, r"params\.mass .*; .*; .*\(and \d+ more differ\)"),
    ],
)
def test_a_policy_of_another_task_is_refused_with_both_values_and_the_remedy(other, said):
    policy = make_policy("lqr", HELIX)
    for env in (gym.make(HELIX, **other), gym.make_vec(HELIX, num_envs=2, **other)):
        with pytest.raises(ValueError, match=rf"{said}.*make_policy\('lqr', env\)"):
            evaluate(policy, env, episodes=1)


@pytest.mark.parametrize(
    "other",
    [
        {"reference": "lines"},
        {"time_limit": 5.0},
        {"reward": "quadratic"},
        {"kappa": (1.0,) * 4},
        {"randomize": 0.2},
        {"disturbance": "gusts"},
        {"lost_distance": 20.0},
    ],
)
def test_what_no_decision_depends_on_may_differ(other):
    """A randomised vehicle differs from the nominal one that the task knows: that is the condition."""
    assert evaluate(make_policy("lqr", HELIX), gym.make(HELIX, **other), episodes=1).flights == 1


def test_a_mismatch_is_flown_on_purpose_where_the_observations_are_the_same():
    policy = make_policy("lqr", HELIX)
    assert evaluate(policy, gym.make(HELIX, mass=0.9), episodes=1, mismatch=True).flights == 1
    with pytest.raises(ValueError, match=r"layout\.preview"):
        evaluate(policy, gym.make(HELIX, preview=30), episodes=1, mismatch=True)


@reads_sources
def test_no_controller_reads_a_field_of_the_task_that_need_not_agree():
    """What may differ between a policy's task and the flown one must not be read by any policy."""
    texts = [path.read_text(encoding="utf-8") for path in (ROOT / "controllers").rglob("*.py")]
    modules = [path.read_text(encoding="utf-8") for path in (ROOT / "baselines/policies").glob("*.py")]
    texts += [text for text in modules if "    def predict(" in text or "def _decide(" in text]
    assert len(texts) > 30
    read = {name for name in JUDGED_ONLY for text in texts if f"task.{name}" in text}
    assert read == {"env_id"}  # in messages


def test_a_network_needs_the_layout_and_the_rotors_only():
    """It was made for observations and the scale of its outputs; other vehicles are what it is tried on."""
    policy = make_policy("apg-helix", HELIX)
    assert evaluate(policy, gym.make(HELIX, mass=0.9, sensor_noise=0.01), episodes=1).flights == 1
    for other, said in (({"kappa": 0.5}, r"limits\.kappa"), ({"preview": 30}, r"layout\.preview")):
        with pytest.raises(ValueError, match=said):
            evaluate(policy, gym.make(HELIX, **other), episodes=1)


def test_a_team_is_compared_too():
    policy = make_policy("consensus-mpc", FORMATION)
    for other, said in (({"separation": 0.6}, r"task\.separation"), ({"mass": 1.0}, r"params\.mass")):
        team = formation_v0.parallel_env(time_limit=0.5, **other)
        vector = formation_v0.vector_env(num_teams=1, time_limit=0.5, **other)
        for env in (team, vector):
            with pytest.raises(ValueError, match=said):
                evaluate(policy, env, episodes=1)
    team = formation_v0.parallel_env(time_limit=0.5)
    assert evaluate(policy, team, episodes=1).vehicles == 6
    with pytest.raises(ValueError, match="task is 'Task' for the policy and 'TeamTask' in"):
        evaluate(make_policy("hover", HELIX), team, episodes=1)


def test_a_wrapper_that_brings_estimates_is_another_task():
    plain = target_tracking_v0.parallel_env(time_limit=0.5)
    with pytest.raises(ValueError, match=r"layout\.estimate is False .* and True"):
        evaluate(make_policy("cooperative-mpc", plain), EstimateWrapper(plain), episodes=1)
    privileged = make_policy("central-mpc", plain)  # reads the state, which has no estimates
    assert evaluate(privileged, EstimateWrapper(plain), episodes=1).privileged


def test_check_policy_refuses_the_wrong_task_too():
    with pytest.raises(PolicyCheckError, match=r"params\.mass is 0\.8 for the policy and 1\.0"):
        check_policy(make_policy("lqr", HELIX), gym.make(HELIX, mass=1.0))
