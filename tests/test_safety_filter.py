"""The predictive safety filter: what it keeps and leaves, and what it makes of a policy without an answer."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

import quad_envs  # noqa: F401  registers the ids
from baselines import PolicyError, check_policy, evaluate, make_policy, safe
from baselines.__main__ import main
from baselines.policies.registry import policy_options
from baselines.policies.tracking import ControllerPolicy
from baselines.sweeps.suite_files import suite_from_dict
from controllers import SafetyFilter, SafetyOptions
from quad_envs import formation_v0

CORRIDOR, HELIX = "quad/CorridorTracking-v0", "quad/HelixTracking-v0"


class Constant:
    """The same action for every row, whatever happens."""

    def __init__(self, action):
        self.action = action

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.full((len(observation), 4), self.action, dtype=np.float32), state


def fly(policy, steps, n=2, seed=10_000, **kwargs):
    """A vector of flights: share of violating steps, and the state of the policy at the end."""
    env = gymnasium.make_vec(CORRIDOR, num_envs=n, **kwargs)
    observations, _ = env.reset(seed=seed)
    state, violated = None, 0
    for _ in range(steps):
        actions, state = policy.predict(observations, state)
        observations, _, _, _, info = env.step(actions)
        violated += int((np.asarray(info["constraint_violation"]) > 0.0).sum())
    return violated / (n * steps), state


def test_random_commands_break_the_limits_and_behind_the_filter_do_not():
    bare, _ = fly(make_policy("random", CORRIDOR), 120)
    filtered, state = fly(make_policy("safe:random", CORRIDOR), 120)
    assert bare > 0.5
    assert filtered == 0.0
    assert (state.interventions.changed > 60).all()


@pytest.mark.parametrize(
    "name", ["ppo-corridor", "apg-corridor", "dagger-corridor", "ppo-lagrangian-corridor"]
)
def test_a_shipped_network_behind_the_filter_keeps_every_limit(name):
    violated, _ = fly(make_policy(f"safe:{name}", CORRIDOR), 150)
    assert violated == 0.0


def test_far_from_every_limit_the_command_is_the_policys_own():
    env = gymnasium.make(HELIX, tilt_limit=1.4)
    own, filtered = make_policy("lqr", env), make_policy("safe:lqr", env)
    observation, _ = env.reset(seed=3)
    state = None
    for _ in range(60):  # until no rotor is at its bound
        observation, *_ = env.step(own.predict(observation)[0])
    for _ in range(20):
        wanted, _ = own.predict(observation)
        action, state = filtered.predict(observation, state)
        np.testing.assert_allclose(action, wanted, rtol=0.0, atol=1e-6)  # through N and back in float32
        observation, *_ = env.step(action)
    assert state.interventions.changed[0] == 0


def test_where_a_policy_answers_with_nan_the_mpc_flies_and_it_is_counted():
    filtered = safe(Constant(np.nan), CORRIDOR)
    mpc = ControllerPolicy(SafetyFilter(filtered.task), filtered.task, "the MPC behind the filter")
    env = gymnasium.make(CORRIDOR)
    observation, _ = env.reset(seed=10_000)
    action, state = filtered.predict(observation)
    assert np.isfinite(action).all()
    assert state.interventions.unanswered.tolist() == [1]
    assert state.interventions.changed.tolist() == [1]
    np.testing.assert_array_equal(mpc.predict(observation)[0], action)
    violated, _ = fly(filtered, 60)
    assert violated == 0.0


def test_rows_together_are_decided_as_each_alone():
    policy = make_policy("safe:random", CORRIDOR)
    env = gymnasium.make_vec(CORRIDOR, num_envs=3)
    observations, _ = env.reset(seed=7)
    together, alone = None, [None] * 3
    for _ in range(30):
        actions, together = policy.predict(observations, together)
        for j in range(3):
            action, alone[j] = policy.predict(observations[j], alone[j])
            np.testing.assert_array_equal(action, actions[j])
        observations, *_ = env.step(actions)
    sizes = [one.interventions.total[0] for one in alone]
    np.testing.assert_array_equal(together.interventions.total, sizes)


@pytest.mark.parametrize("name", ["safe:nmpc", "safe:ppo-corridor"])
def test_a_filtered_policy_keeps_the_protocol(name):
    env = gymnasium.make(CORRIDOR)
    check_policy(make_policy(name, env), env)


def test_the_filter_plans_with_more_distance_the_farther_it_looks():
    task = gymnasium.make(CORRIDOR).unwrapped.task
    data = SafetyFilter(task, margin=0.04)._data
    tilt = (data.normals[data.normal] == np.eye(12)[6]).all(axis=1) & (data.weight == np.inf)
    kept = task.limits.tilt - data.upper[tilt]
    np.testing.assert_allclose(kept[:6], [0.01, 0.02, 0.03, 0.04, 0.04, 0.04], rtol=0.0, atol=1e-12)


def test_a_task_without_limits_has_nothing_to_keep():
    with pytest.raises(ValueError, match=r"has no limits.*tilt_limit=.*velocity_limit"):
        make_policy("safe:lqr", HELIX)


def test_a_filter_before_a_filter_is_refused():
    with pytest.raises(ValueError, match="one is enough"):
        make_policy("safe:safe:nmpc", CORRIDOR)
    with pytest.raises(ValueError, match="one is enough"):
        safe(make_policy("safe:nmpc", CORRIDOR), CORRIDOR)


def test_a_team_is_refused_with_policies_that_keep_its_limits():
    with pytest.raises(ValueError, match=r"one vehicle.*formation.*consensus-mpc"):
        make_policy("safe:consensus-mpc", formation_v0.parallel_env())


def test_options_are_those_of_the_filter():
    assert make_policy("safe:nmpc", CORRIDOR, margin=0.05, horizon=10).controller.options.margin == 0.05
    with pytest.raises(ValueError, match="margin"):
        make_policy("safe:nmpc", CORRIDOR, margn=0.05)
    with pytest.raises(ValueError, match="weight must be"):
        make_policy("safe:nmpc", CORRIDOR, weight=0.0)
    with pytest.raises(ValueError, match="one thread"):
        make_policy("safe:nmpc", CORRIDOR, threads=2)
    with pytest.raises(ValueError, match="objective"):
        make_policy("safe:nmpc", CORRIDOR, objective="score")
    with pytest.raises(ValueError, match="R_rate"):
        make_policy("safe:nmpc", CORRIDOR, R_rate=1.0)
    with pytest.raises(ValueError, match="preview=30"):
        make_policy("safe:nmpc", CORRIDOR, horizon=30)
    with pytest.raises(ValueError, match="at least 2"):
        SafetyOptions(horizon=1)
    assert policy_options("safe:nmpc")["weight"] == SafetyOptions().weight


def test_the_command_line_lists_the_options_of_the_filter_with_what_they_mean(capsys):
    assert main(["list", "safe:ppo-corridor"]) == 0
    line = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("  weight"))
    assert "50.0" in line and "of a change of the wanted command" in line


def test_an_evaluation_says_how_often_the_filter_intervened_and_only_where_there_is_one():
    filtered, bare = (evaluate(name, CORRIDOR, episodes=1, seed=10_000) for name in ("safe:hover", "hover"))
    (record,) = filtered.records
    assert 0.0 < record.intervention_share <= 1.0 and record.intervention_size > 0.0
    assert record.unanswered_share == 0.0
    assert "intervention_share" in str(filtered) and "intervention" not in str(bare)


def test_an_unknown_policy_behind_the_filter_is_named():
    with pytest.raises(ValueError, match=r"nmpx.*nmpc"):
        make_policy("safe:nmpx", CORRIDOR)


def test_a_policy_of_another_task_is_refused_behind_the_filter():
    with pytest.raises(ValueError, match="made for another task"):
        safe(make_policy("nmpc", HELIX), CORRIDOR)


def test_a_policy_that_answers_in_another_shape_is_named():
    class Broken(Constant):
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return np.zeros((1, 3)), state

    with pytest.raises(PolicyError, match=r"behind 'safe:.*shape \(1, 4\).*test_safety_filter"):
        safe(Broken(0.0), CORRIDOR).predict(gymnasium.make(CORRIDOR).reset(seed=0)[0])


def test_suites_take_filtered_policies():
    suite = {"envs": [CORRIDOR], "policies": ["nmpc", "safe:ppo-corridor", "safe:mymodule:make"]}
    assert [one.title for one in suite_from_dict(suite).policies][1:] == suite["policies"][1:]
    with pytest.raises(ValueError, match="nmpx"):
        suite_from_dict({"envs": [CORRIDOR], "policies": ["safe:nmpx"]})
