"""The fallback order: each level provoked, and the command always finite, in the box and within the rate."""

from __future__ import annotations

import numpy as np
import pytest
from flights import FLAVOURS, HOVER, TASK, at_rest, decide_once, plan_of

from controllers import ExactNmpc, Fallback, LinearMPC, Lqr, Sdre
from controllers.fallback import limit_command
from quad_envs.parameters import Limits
from quad_envs.tasks import Task

N = 10
TIGHT = Task(limits=Limits(kappa=0.3125, rate=5.0, velocity=1.0))
FAST = at_rest()
FAST[3:6] = 3.0, -2.0, 1.0  # already beyond the velocity limit
LAST = np.array([1.5, 2.4, 1.0, 2.0])


@pytest.fixture(params=FLAVOURS)
def mpc(request):
    return FLAVOURS[request.param]


def assert_flyable(command, last, task):
    assert np.isfinite(command).all()
    assert (command >= 0.0).all() and (command <= task.force_max).all()
    assert np.abs(command - last).max() <= task.limits.rate * task.dt + 1e-9


@pytest.mark.parametrize("solver", ["structured", "osqp"])
def test_contradicting_hard_rows_are_relaxed(mpc, solver):
    hard = mpc(TIGHT, horizon=N, soft_weight=np.inf, solver=solver)
    soft = mpc(TIGHT, horizon=N, soft_weight=1e4, solver="structured")
    decision, expected = decide_once(hard, FAST, last=LAST), decide_once(soft, FAST, last=LAST)
    assert decision.fallback[0] == Fallback.RELAXED
    assert expected.fallback[0] == Fallback.NONE
    assert_flyable(decision.command[0], LAST, TIGHT)
    exact = solver == "structured"
    np.testing.assert_allclose(decision.command, expected.command, atol=1e-6 if exact else 2e-2)


def test_without_an_answer_the_previous_plan_is_flown_on(mpc):
    """Stiff rows: softer ones are solved in a single step from the working set of the decision before."""
    good = decide_once(mpc(TIGHT, horizon=N, soft_weight=1e3), FAST, last=LAST)
    plan = plan_of(good, N) + HOVER
    stopped = mpc(TIGHT, horizon=N, soft_weight=1e3, iteration_limit=1)
    once = decide_once(stopped, FAST, last=good.command[0], memory=good.memory[0])
    assert once.fallback[0] == Fallback.PREVIOUS_PLAN
    np.testing.assert_allclose(once.command[0], plan[1], atol=1e-9)
    np.testing.assert_allclose(plan_of(once, N) + HOVER, plan[[*range(1, N), N - 1]], atol=1e-12)
    twice = decide_once(stopped, FAST, last=once.command[0], memory=once.memory[0])
    assert twice.fallback[0] == Fallback.PREVIOUS_PLAN
    np.testing.assert_allclose(twice.command[0], plan[2], atol=1e-9)


def test_previous_plan_is_clipped_to_rate_and_box(mpc):
    controller = mpc(TIGHT, horizon=N, iteration_limit=1)
    memory = np.zeros(controller.memory_size)
    memory[0], memory[1 : 1 + 4 * N] = 1.0, 9.0
    decision = decide_once(controller, FAST, last=LAST, memory=memory)
    assert decision.fallback[0] == Fallback.PREVIOUS_PLAN
    np.testing.assert_allclose(decision.command[0], np.minimum(LAST + 0.25, TIGHT.force_max))


def test_without_a_plan_the_unconstrained_one_is_clipped():
    decision = decide_once(LinearMPC(TIGHT, horizon=N, iteration_limit=1), FAST, last=LAST)
    wanted = decide_once(Lqr(Task()), FAST).command[0]  # unlimited
    assert decision.fallback[0] == Fallback.CLIPPED_SDRE
    np.testing.assert_allclose(
        decision.command[0], np.clip(np.clip(wanted, LAST - 0.25, LAST + 0.25), 0, 2.45)
    )
    assert decision.memory[0, 0] == 0.0  # nothing to fly on


def test_clipped_sdre_is_flyable_for_every_flavour(mpc):
    decision = decide_once(mpc(TIGHT, horizon=N, iteration_limit=1), FAST, last=LAST)
    assert decision.fallback[0] == Fallback.CLIPPED_SDRE
    assert_flyable(decision.command[0], LAST, TIGHT)


def test_hover_is_the_last_resort(mpc):
    plant = at_rest()
    plant[3:6] = plant[9:12] = 1e308  # finite, but no number follows from it
    controller = mpc(TIGHT, horizon=N)
    decision = decide_once(controller, plant, last=LAST)
    assert decision.fallback[0] == Fallback.HOVER
    np.testing.assert_allclose(decision.command[0], np.clip(HOVER, LAST - 0.25, LAST + 0.25))
    recovered = decide_once(controller, at_rest(), memory=decision.memory[0])
    assert recovered.fallback[0] == Fallback.NONE


def test_a_failure_resets_the_guess_of_the_exact_nmpc():
    good = decide_once(ExactNmpc(TIGHT, horizon=N), FAST, last=LAST)
    failed = decide_once(
        ExactNmpc(TIGHT, horizon=N, iteration_limit=1), FAST, last=LAST, memory=good.memory[0]
    )
    assert failed.fallback[0] == Fallback.PREVIOUS_PLAN
    fresh = decide_once(ExactNmpc(TIGHT, horizon=N), FAST, last=LAST)
    after = decide_once(ExactNmpc(TIGHT, horizon=N), FAST, last=LAST, memory=failed.memory[0])
    np.testing.assert_array_equal(after.command, fresh.command)


def test_sdre_without_a_riccati_solution_takes_the_gain_at_hover():
    plant = at_rest()
    plant[3:6] = 1e180
    decision = decide_once(Sdre(TASK), plant)
    assert decision.fallback[0] in (Fallback.CLIPPED_SDRE, Fallback.HOVER)
    assert_flyable(decision.command[0], np.full(4, HOVER), TASK)


def test_limited_command_prefers_the_box_to_the_rate():
    out = np.empty(4)
    limit_command(
        np.array([9.0, -9.0, np.nan, 2.1]), np.array([3.0, 0.1, 2.0, 2.0]), 0.25, np.full(4, 2.45), out
    )
    np.testing.assert_allclose(out, [2.45, 0.0, 2.0, 2.1])
