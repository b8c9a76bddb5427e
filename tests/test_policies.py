"""Policies: the registry, the protocol, and the way from observations to controllers and back."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import RescaleAction, TransformObservation

import quad_envs  # noqa: F401  registers the ids
from baselines import PolicyCheckError, PolicyState, check_policy, make_policy, policy_options
from baselines.policies.registry import TRACKING_POLICIES
from baselines.policies.tracking import ControllerPolicy, Hover
from controllers import LmpcOptions, NmpcOptions, SdcOptions
from controllers.controller import Decision
from quad_envs.constraints import actions_from_forces

HELIX = "quad/HelixTracking-v0"
RICH = {
    "kappa": 0.3125,
    "rate_limit": 10.0,
    "position_limit": ((-20.0,) * 3, (20.0,) * 3),
    "reveal_disturbance": True,
}


class Recording:
    """A controller that keeps what it was given; hover otherwise."""

    memory_size = 3

    def __init__(self, task, horizon=5):
        self.horizon, self.given = horizon, None
        self.force = task.hover_force

    def decide(self, plant, window, last_command, disturbance, memory):
        self.given = (plant, window, last_command, disturbance, memory)
        n = len(plant)
        command = self.force + np.linspace(-9.0, 9.0, 4 * n).reshape(n, 4)
        return Decision(command, np.asarray(memory) + 1.0, np.full(n, 2), np.arange(n) + 1)


@pytest.mark.parametrize("name", TRACKING_POLICIES)
def test_every_policy_keeps_the_protocol(name):
    env = gymnasium.make(HELIX, kappa=0.3125, rate_limit=10.0)
    check_policy(make_policy(name, env), env)


@pytest.mark.parametrize("name", ["lmpc", "random"])
def test_a_policy_keeps_the_protocol_where_position_and_disturbance_are_observed(name):
    env = gymnasium.make(HELIX, disturbance="gusts", **RICH)
    check_policy(make_policy(name, env), env)


def test_sources_of_the_task_give_the_same_policy():
    env = gymnasium.make(HELIX)
    observation, _ = env.reset(seed=3)
    sources = [env, env.unwrapped, HELIX, env.unwrapped.task, gymnasium.make_vec(HELIX, num_envs=2)]
    sources.append(gymnasium.make_vec(HELIX, num_envs=2, vectorization_mode="sync"))
    actions = [make_policy("random", source).predict(observation)[0] for source in sources]
    assert all(np.array_equal(action, actions[0]) for action in actions)


def test_an_unknown_policy_is_refused_with_a_suggestion():
    with pytest.raises(ValueError, match="unknown policy 'lmcp'; did you mean 'lmpc'"):
        make_policy("lmcp", HELIX)


def test_an_unknown_option_is_refused_with_a_suggestion():
    with pytest.raises(ValueError, match="'horzon'; did you mean 'horizon'"):
        make_policy("lmpc", HELIX, horzon=10)


@pytest.mark.parametrize(
    ("option", "value", "kind"),
    [("horizon", "x", "a number"), ("reject_disturbance", 1, "True or False"), ("solver", 3, "a name")],
)
def test_an_option_of_another_kind_is_refused(option, value, kind):
    with pytest.raises(ValueError, match=f"{option} of policy 'lmpc' must be {kind}, got {value!r}"):
        make_policy("lmpc", HELIX, **{option: value})


def test_an_unknown_id_is_refused_with_a_suggestion():
    with pytest.raises(ValueError, match="did you mean 'quad/HelixTracking-v0'"):
        make_policy("hover", "quad/HelixTraking-v0")


def test_something_without_a_task_is_refused():
    with pytest.raises(ValueError, match="cannot find the task"):
        make_policy("hover", gymnasium.make("CartPole-v1"))


@pytest.mark.parametrize("horizon", [0, -1])
def test_a_horizon_below_one_is_refused(horizon):
    with pytest.raises(ValueError, match="horizon"):
        make_policy("lmpc", HELIX, horizon=horizon)


def test_a_horizon_beyond_the_preview_is_refused_with_the_remedy():
    with pytest.raises(ValueError, match=r"looks 30 steps ahead, the observation 10.*preview=30"):
        make_policy("lmpc", gymnasium.make(HELIX, preview=10), horizon=30)


@pytest.mark.parametrize("name", ["lmpc", "safe:lmpc", "safe:hover"])
def test_without_a_preview_no_horizon_helps_and_the_remedy_says_so(name):
    env = gymnasium.make("quad/CorridorTracking-v0", preview=0)
    with pytest.raises(ValueError, match=r"the observation (has )?0: gym\.make\(.*preview=\d+\)$"):
        make_policy(name, env)


def test_a_horizon_that_is_not_asked_for_shrinks_to_the_preview():
    assert make_policy("lmpc", gymnasium.make(HELIX, preview=10)).controller.horizon == 10


def test_the_horizon_is_25_by_default():
    assert policy_options("lmpc")["horizon"] == 25
    assert make_policy("lmpc", gymnasium.make(HELIX, preview=40)).controller.horizon == 25


def test_a_wrapper_that_changes_the_observation_is_refused():
    env = gymnasium.make(HELIX)
    space = gymnasium.spaces.Box(-np.inf, np.inf, (18,), np.float32)
    with pytest.raises(ValueError, match=r"changed the observation to shape \(18,\)"):
        make_policy("hover", TransformObservation(env, lambda obs: obs[:18], space))


def test_a_wrapper_that_changes_the_action_box_is_refused():
    with pytest.raises(ValueError, match="changed the action box"):
        make_policy("hover", RescaleAction(gymnasium.make(HELIX), np.float32(0.0), np.float32(1.0)))


def test_the_options_of_an_mpc_reach_it_as_the_value_of_their_class():
    for name, kind in (("lmpc", LmpcOptions), ("sdc-nmpc", SdcOptions), ("nmpc", NmpcOptions)):
        made = make_policy(name, HELIX, horizon=7, soft_weight=3.0).controller
        assert made.options == kind(horizon=7, soft_weight=3.0)
        assert kind(**policy_options(name)) == kind()


@pytest.mark.parametrize("kwargs", [{}, RICH], ids=["plain", "rich"])
def test_the_controller_is_given_what_the_layout_decodes(kwargs):
    task = gymnasium.make(HELIX, **kwargs).unwrapped.task
    controller = Recording(task)
    obs = np.random.default_rng(0).normal(size=(3, task.layout.size)).astype(np.float32)
    ControllerPolicy(controller, task, "recording").predict(obs)
    plant, window, last, disturbance, _ = controller.given
    view = task.layout.decode(obs)
    expected = np.concatenate([view.position, view.V_B, view.Theta, view.Omega, view.F], axis=1)
    np.testing.assert_allclose(plant, expected, rtol=0, atol=1e-15)  # arctan2 of two libraries
    stages = view.preview[:, : controller.horizon + 1].copy()
    stages[..., :3] += view.position[:, None]
    np.testing.assert_array_equal(window, stages)
    np.testing.assert_array_equal(last, view.last_command)
    np.testing.assert_array_equal(disturbance, np.concatenate([view.torque, view.force], axis=1))


def test_commands_become_the_actions_that_command_them():
    task = gymnasium.make(HELIX, kappa=0.3125).unwrapped.task
    controller = Recording(task)
    policy = ControllerPolicy(controller, task, "recording")
    action, _ = policy.predict(np.zeros((2, task.layout.size), np.float32))
    command = task.hover_force + np.linspace(-9.0, 9.0, 8).reshape(2, 4)
    np.testing.assert_array_equal(action, actions_from_forces(command, task.hover_force, task.force_max))


def test_statistics_are_counted_per_row_and_begin_anew_with_an_episode():
    task = gymnasium.make(HELIX).unwrapped.task
    policy = ControllerPolicy(Recording(task), task, "recording")
    obs = np.zeros((2, task.layout.size), np.float32)
    state = None
    for _ in range(3):
        _, state = policy.predict(obs, state)
    _, state = policy.predict(obs, state, [True, False])
    assert isinstance(state, PolicyState)
    assert state.fallbacks.tolist() == [[0, 0, 1, 0, 0], [0, 0, 4, 0, 0]]
    assert state.memory[:, 0].tolist() == [1.0, 4.0]
    assert state.worst_iterations.tolist() == [1, 2]


@pytest.mark.parametrize(
    "name", ["V_B", "phi_theta", "sin_cos_psi", "F", "position", "disturbance", "preview"]
)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_observation_that_is_not_finite_is_refused_by_name(name, value):
    task = gymnasium.make(HELIX, **RICH).unwrapped.task
    obs = np.zeros((2, task.layout.size), np.float32)
    obs[1, task.layout.slices[name].start + 1] = value
    with pytest.raises(ValueError, match=f"observation 1 is not finite: entry 1 of '{name}'"):
        make_policy("hover", task).predict(obs)


def test_shapes_that_do_not_fit_are_refused():
    policy = make_policy("hover", HELIX)
    obs = np.zeros((2, 226), np.float32)
    _, state = policy.predict(obs)
    with pytest.raises(ValueError, match="observation must have shape"):
        policy.predict(obs[:, :100])
    with pytest.raises(ValueError, match="state has 2 rows, the observation 1"):
        policy.predict(obs[:1], state)
    with pytest.raises(ValueError, match="episode_start must have shape"):
        policy.predict(obs, state, [True])


def test_one_observation_gets_one_action():
    env = gymnasium.make(HELIX)
    observation, _ = env.reset(seed=0)
    policy = make_policy("random", env)
    action, state = policy.predict(observation)
    assert action.shape == (4,)
    again, _ = policy.predict(observation[None])
    np.testing.assert_array_equal(action, again[0])
    assert policy.predict(observation, state)[0].shape == (4,)


def test_random_draws_anew_at_each_step_start_and_seed():
    env = gymnasium.make("quad/Regulation-v0")
    policy = make_policy("random", env)
    obs = np.stack([env.reset(seed=seed)[0] for seed in range(50)])
    first, state = policy.predict(obs)
    second, _ = policy.predict(obs, state)
    other, _ = make_policy("random", env, seed=1).predict(obs)
    assert len(np.unique(np.concatenate([first, second, other]).ravel())) == 3 * 50 * 4
    assert abs(float(first.mean())) < 0.15 and float(np.abs(first).max()) > 0.9  # 4 sigma of the mean of 200


def test_random_refuses_a_seed_below_zero():
    with pytest.raises(ValueError, match="seed must be a whole number >= 0, got -1"):
        make_policy("random", HELIX, seed=-1)


# ---------------------------------------------------------------- what check_policy finds


class Honest:
    """Keeps the protocol; the broken ones below change one thing."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        obs = np.atleast_2d(observation)
        count = np.zeros(len(obs)) if state is None else state
        if episode_start is not None:
            count = np.where(episode_start, 0.0, count)
        action = np.tanh(obs[:, 18:22] + 0.1 * count[:, None]).astype(np.float32)
        return action if np.ndim(observation) == 2 else action[0], count + 1.0


class RemembersInAttributes(Honest):
    calls = 0

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        self.calls += 1
        action, state = super().predict(observation, state, episode_start)
        return (action * np.float32(1.0 / self.calls)).astype(np.float32), state


class ChangesTheState(Honest):
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        action, new = super().predict(observation, state, episode_start)
        if state is not None:
            state += 1.0
        return action, new


class ChangesTheObservation(Honest):
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        result = super().predict(observation, state, episode_start)
        observation[..., 0] += 1.0
        return result


class MixesRows(Honest):
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        action, state = super().predict(observation, state, episode_start)
        return action - 0.1 * np.atleast_2d(action).mean(axis=0), state


class IgnoresEpisodeStart(Honest):
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return super().predict(observation, state, None)


class LeavesTheBox(Honest):
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        action, state = super().predict(observation, state, episode_start)
        return action + np.float32(2.0), state


class WrongType(Honest):
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        action, state = super().predict(observation, state, episode_start)
        return action.astype(np.float64), state


class ForgetsTheState(Honest):
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return super().predict(observation, state, episode_start)[0]


class DoesNotPickle(Honest):
    def __init__(self):
        self.function = lambda: None


def test_a_policy_that_keeps_the_protocol_passes():
    check_policy(Honest(), HELIX)


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (RemembersInAttributes, "keeps something in attributes"),
        (ChangesTheState, "must not change the state"),
        (ChangesTheObservation, "must not change the observation|the same observations"),
        (MixesRows, "must get the action that it gets alone"),
        (IgnoresEpisodeStart, "episode_start = True must make a row forget"),
        (LeavesTheBox, "must lie in"),
        (WrongType, "must be float32, got float64"),
        (ForgetsTheState, r"must return \(actions, state\)"),
        (DoesNotPickle, "must pickle"),
        (object, "has no predict"),
    ],
)
def test_a_policy_that_breaks_the_protocol_is_told_where(broken, message):
    with pytest.raises(PolicyCheckError, match=message):
        check_policy(broken(), HELIX)


def test_feedback_linearization_does_without_a_preview():
    env = gymnasium.make(HELIX, preview=0)
    check_policy(make_policy("feedback-linearization", env), env)
    with pytest.raises(ValueError, match="choose acceleration_feed_forward=False, or gym"):
        make_policy("feedback-linearization", env, acceleration_feed_forward=True)
    assert make_policy("feedback-linearization", gymnasium.make(HELIX)).controller.horizon == 1


def test_hover_needs_no_preview():
    env = gymnasium.make(HELIX, preview=0)
    check_policy(ControllerPolicy(Hover(env.unwrapped.task), env.unwrapped.task, "hover"), env)


@pytest.mark.slow  # importing Stable-Baselines3 takes seconds
@pytest.mark.filterwarnings("ignore")  # of the library's own dependencies, and that the env has no Monitor
def test_stable_baselines3_evaluates_a_policy():
    evaluation = pytest.importorskip("stable_baselines3.common.evaluation")
    env = gymnasium.make(HELIX)
    mean, spread = evaluation.evaluate_policy(make_policy("lmpc", env), env, n_eval_episodes=2)
    assert mean > 100.0 and spread >= 0.0
