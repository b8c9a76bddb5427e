"""A number that is not finite in flight: who had it, from which start, at which step."""

import gymnasium as gym
import numpy as np
import pytest

from baselines import evaluate, make_policy, run_episodes
from quad_envs import formation_v0

HELIX = "quad/HelixTracking-v0"


class Breaking:
    """Hover, until some rows are shown or answered with NaN."""

    name = "breaking"

    def __init__(self, task, step, row, what):
        self.task, self.step, self.row, self.what = task, step, row, what
        self.hover = make_policy("hover", task)

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        k, inner = (0, None) if state is None else state
        if k == self.step and self.what == "observation":
            observation[self.row, 1] = np.nan  # as a sensor would: the runner's own array
        actions, inner = self.hover.predict(observation, inner, episode_start)
        if k == self.step and self.what == "action":
            actions[self.row, 2] = np.inf
        return actions, (k + 1, inner)


SAYS = {
    "observation": r"observation \d is not finite: entry 1 of 'V_B' .* is nan",
    "action": r"not finite, .*inf",
}


@pytest.mark.parametrize("what", SAYS)
def test_a_single_flight_names_seed_and_step(what):
    env = gym.make(HELIX)
    with pytest.raises(ValueError, match=rf"policy 'breaking', row 0 from seed 7, step 3: .*{SAYS[what]}"):
        evaluate(Breaking(env.unwrapped.task, 3, 0, what), env, 1, seed=7)


@pytest.mark.parametrize("what", SAYS)
def test_a_vector_names_the_row_and_the_seed_of_its_start(what):
    env = gym.make_vec(HELIX, num_envs=4)
    with pytest.raises(ValueError, match=rf"row 2 from seed 12, step 5: .*{SAYS[what]}"):
        list(run_episodes(Breaking(env.unwrapped.task, 5, 2, what), env, 4, 10))


@pytest.mark.parametrize("what", SAYS)
def test_a_team_names_the_agent(what):
    for env in (formation_v0.parallel_env(), formation_v0.vector_env(num_teams=1)):
        with pytest.raises(ValueError, match=rf"row 4 \(quad_4\) from seed 0, step 2: .*{SAYS[what]}"):
            list(run_episodes(Breaking(env.unwrapped.task, 2, 4, what), env, 1))


def test_a_row_that_flies_no_more_may_answer_with_anything():
    """A vehicle that lost its flight is not commanded; what the policy says for it is nobody's trouble."""
    env = gym.make_vec(HELIX, num_envs=2, time_limit=1.0)

    class Rolling(Breaking):
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            k = 0 if state is None else state
            actions = np.zeros((len(observation), 4), np.float32)
            actions[1] = np.nan if k > 15 else (0.0, 0.9, 0.0, -0.9)
            return actions, k + 1

    flights = list(run_episodes(Rolling(env.unwrapped.task, 0, 0, ""), env, 2))
    assert [flight.crashed for flight in flights] == [False, True]
    assert len(flights[1].rewards) < 16


def test_other_errors_of_the_suites_policies_pass_as_they_are(monkeypatch):
    env = gym.make(HELIX)
    policy = make_policy("hover", env)

    def predict(self, *arguments, **more):
        raise ValueError("out of fuel")

    monkeypatch.setattr(type(policy), "predict", predict)
    with pytest.raises(ValueError, match=r"^out of fuel$"):
        evaluate(policy, env, 1)


@pytest.mark.parametrize("name", ["lmpc", "random", "apg-helix"])
def test_one_bad_row_keeps_the_whole_batch_from_being_decided(name):
    policy = make_policy(name, HELIX)
    rows = np.zeros((3, policy.task.layout.size), np.float32)
    rows[1, 3] = np.inf
    with pytest.raises(ValueError, match="observation 1 is not finite"):
        policy.predict(rows)
