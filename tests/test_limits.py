"""Limits as values: what environments, MPCs, tables and docs make of each."""

import importlib.util
import pathlib

import gymnasium as gym
import numpy as np
import pytest

from baselines import make_policy, measure, run_episodes
from controllers.mpc.mpc import limit_rows
from quad_envs import Limits, formation_v0
from quad_envs.constraints import constraint_names, constraint_scales, constraint_values, forces_from_actions
from quad_envs.envs.shared.task_vector import task_vector
from quad_envs.envs.tracking.adjoint import reward_vjp
from quad_envs.limits import LIMITS, LimitOptions
from quad_envs.plant import N_STATE, POSITION

BOXES = {"position_limit": ((-0.5, -0.4, -0.3), (0.5, 0.4, 0.3))}
ALL = {limit.option: BOXES.get(limit.option, 0.2) for limit in LIMITS}
by_name = pytest.mark.parametrize("limit", LIMITS, ids=lambda limit: limit.name)


def test_no_limit_is_set_by_default():
    assert Limits().chosen() == () == constraint_names(LimitOptions().make_limits())
    assert np.isinf(np.concatenate(Limits().output_box(0.05))).all()


@by_name
def test_the_argument_of_a_limit_bounds_its_outputs_and_no_other(limit):
    limits = LimitOptions(**{limit.option: ALL[limit.option]}).make_limits()
    assert constraint_names(limits) == (limit.name,)
    bounded = np.isfinite(limits.output_box(0.05))
    assert bounded[:, limit.outputs].all()
    assert bounded.sum() == 2 * bounded[0, limit.outputs].size


@by_name
def test_a_violation_that_is_as_large_as_the_scale_costs_the_whole_reward(limit):
    limits, y = LimitOptions(**{limit.option: ALL[limit.option]}).make_limits(), np.zeros(16)
    scale = constraint_scales(limits, 0.05)
    y[limit.outputs.start] = limits.output_box(0.05)[1][limit.outputs.start] + scale[0]
    value = constraint_values(y[:N_STATE], y[N_STATE:], np.zeros(4), limits, 0.05)
    np.testing.assert_allclose(value, scale, rtol=1e-12)


@pytest.mark.parametrize("chosen", [*([limit.option] for limit in LIMITS), list(ALL)], ids=str)
def test_values_and_costs_of_random_flights_are_those_of_the_readable_twin(chosen):
    env = gym.make_vec("quad/RandomTracking-v0", num_envs=20, **{name: ALL[name] for name in chosen})
    _, infos = env.reset(seed=0)
    task, rng = env.unwrapped.task, np.random.default_rng(0)
    previous = np.full((20, 4), task.hover_force)
    ended, violated = np.zeros(20, bool), np.zeros(len(chosen), bool)
    for _ in range(60):
        actions = rng.uniform(-1.0, 1.0, (20, 4)).astype(np.float32)
        _, _, terminated, _, infos = env.step(actions)
        command = forces_from_actions(actions, task.hover_force, task.force_max)
        values = constraint_values(env.unwrapped.state, command, previous, task.limits, task.dt)
        cost = (np.where(values > 1e-3, values, 0.0) / constraint_scales(task.limits, task.dt)).sum(axis=1)
        flown = ~ended  # the step after an end begins a new flight
        np.testing.assert_allclose(infos["constraint_values"][flown], values[flown], atol=1e-12)
        np.testing.assert_allclose(infos["cost"][flown], cost[flown], atol=1e-11)
        violated |= (values[flown] > 0.0).any(axis=0)
        previous, ended = np.where(ended[:, None], task.hover_force, command), terminated
    assert violated.all()


def test_a_team_with_every_limit_still_crashes_and_says_why():
    env, state = formation_v0.parallel_env(vehicles=2, graph="chain", **ALL), np.zeros((2, 12))
    state[1, 1] = 0.4
    state[0, 4], state[1, 4] = 2.0, -2.0
    env.reset(options={"state": state})
    *_, infos = env.step({name: np.zeros(4, np.float32) for name in env.agents})
    causes = [env.task.crash_causes[info["crash_cause"]] for info in infos.values()]
    assert causes == ["distance", "distance"]
    assert env.task.constraint_names == (*(limit.name for limit in LIMITS), "separation")
    assert all(info["constraint_values"][-1] > 0.0 for info in infos.values())


def test_the_rows_of_an_mpc_are_the_bounds_of_the_state_less_the_margin():
    limits = LimitOptions(**ALL).make_limits()
    rows, axis = limit_rows(limits, 0.02, np.inf, 1)
    lower, upper = limits.state_box()
    outputs = np.argmax(rows.normals, axis=1)
    assert sorted(outputs) == np.flatnonzero(np.isfinite(upper)).tolist()
    np.testing.assert_array_equal(rows.upper, upper[outputs] - 0.02)
    np.testing.assert_array_equal(rows.lower, lower[outputs] + 0.02)
    assert (axis[outputs < POSITION.stop] >= 0).all() and (axis[outputs >= POSITION.stop] == -1).all()


@by_name
def test_the_docs_say_what_a_limit_bounds(limit):
    path = pathlib.Path(__file__).parent.parent / "docs" / "hooks.py"
    spec = importlib.util.spec_from_file_location("hooks", path)
    hooks = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hooks)
    assert f"| `{limit.option}` | {limit.about}" in hooks.limits_table()


@by_name
def test_the_adjoint_of_the_cost_is_its_derivative(limit):
    task = gym.make("quad/HelixTracking-v0", **{limit.option: ALL[limit.option]}).unwrapped.task
    vector, rng, moved = task_vector(task, 5, 50.0), np.random.default_rng(0), 0

    def cost(y):
        values = constraint_values(y[:N_STATE], y[N_STATE:], np.zeros(4), task.limits, task.dt)
        return float((np.maximum(values, 0.0) / constraint_scales(task.limits, task.dt)).sum())

    for y in rng.normal(size=(30, 16)):
        bar_x, bar_u, bar_previous = np.zeros(12), np.zeros(4), np.zeros(4)
        reward_vjp(
            y[:N_STATE], np.zeros(9), y[N_STATE:], np.zeros(4), vector, 0.0, 1.0, bar_x, bar_u, bar_previous,
            np.zeros(20),
        )  # fmt: skip
        slopes = [(cost(y + 1e-6 * e) - cost(y - 1e-6 * e)) / 2e-6 for e in np.eye(16)]
        np.testing.assert_allclose(np.r_[bar_x, bar_u], slopes, atol=1e-6)
        np.testing.assert_array_equal(bar_previous, -bar_u)
        moved += bool(np.any(slopes))
    assert moved > 10


@pytest.mark.parametrize("options", [{}, {"soft_weight": np.inf}], ids=["soft", "hard"])
@pytest.mark.parametrize("name", ["lmpc", "sdc-nmpc", "nmpc"])
def test_an_mpc_that_knows_the_limit_on_body_rates_keeps_it(name, options):
    env = gym.make("quad/RandomTracking-v0", body_rate_limit=0.6)
    blind = [measure(e) for e in run_episodes(make_policy(name, env, soft_weight=0.0), env, 2)]
    assert min(record.worst_violation["body_rate"] for record in blind) > 0.4
    flown = [measure(e) for e in run_episodes(make_policy(name, env, margin=0.12, **options), env, 2)]
    assert [record.violation_share for record in flown] == [0.0, 0.0]
    assert not any(record.crashed for record in flown)
