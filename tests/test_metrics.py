"""Metrics: each number against its definition."""

from __future__ import annotations

import math

import gymnasium
import numpy as np
import pytest
from made_episodes import hovering

import quad_envs  # noqa: F401  registers the ids
from baselines import estimate, make_policy, measure, paired_difference, run_episodes
from baselines.evaluation.column import CUT_SHORT
from baselines.evaluation.columns import averaged
from baselines.evaluation.evaluate import Evaluation
from baselines.evaluation.metrics import decision_quantiles, summarize, totals
from quad_envs import Limits, Task

STEPS = 200


def flight(task=None, **changes):
    """A flight of full length: at the reference, hovering, within limits."""
    return hovering(task or Task(), STEPS, **changes)


def test_a_perfect_flight_scores_one():
    record = measure(flight())
    assert (record.score, record.quadratic_cost, record.position_rms, record.effort) == (1.0, 0.0, 0.0, 0.0)


def test_position_rms_is_over_the_samples_before_the_last():
    states = np.zeros((STEPS + 1, 16))
    states[:, 0] = np.arange(STEPS + 1.0)
    expected = math.sqrt(np.mean(np.arange(STEPS) ** 2.0))
    assert measure(flight(states=states)).position_rms == pytest.approx(expected, rel=1e-12)


def test_steady_rms_is_over_the_second_half():
    states = np.zeros((STEPS + 1, 16))
    states[: STEPS // 2, 1] = 5.0
    states[STEPS // 2 :, 1] = 0.5
    assert measure(flight(states=states)).steady_rms == pytest.approx(0.5, rel=1e-12)


def test_effort_is_the_mean_square_of_the_command_change_from_hover():
    commands = np.full((STEPS, 4), Task().hover_force)
    commands[:, 2] += 0.5
    assert measure(flight(commands=commands)).effort == pytest.approx(0.25, rel=1e-12)


def test_settling_time_is_the_last_sample_above_five_percent():
    states = np.zeros((STEPS + 1, 16))
    states[:, 2] = 2.0 * np.exp(-0.05 * np.arange(STEPS + 1))
    last = math.floor(-math.log(0.05) / 0.05)
    assert measure(flight(states=states)).settling_time == pytest.approx(0.05 * last)


def test_settling_time_is_nan_for_a_flight_that_begins_at_the_reference_or_never_settles():
    far = np.full((STEPS + 1, 16), 1.0)
    assert math.isnan(measure(flight()).settling_time)
    assert math.isnan(measure(flight(states=far)).settling_time)


def test_the_score_divides_by_the_full_time_limit_after_a_crash():
    short = {name: getattr(flight(), name)[:50] for name in ("rewards", "stage_costs", "costs", "violations")}
    short |= {
        name: getattr(flight(), name)[:50] for name in ("commands", "constraint_values", "decision_times")
    }
    short |= {name: getattr(flight(), name)[:51] for name in ("states", "references")}
    record = measure(flight(**short, crashed=True, terminated=True, truncated=False))
    assert record.score == pytest.approx(49 / STEPS)  # the step of the crash earns nothing
    assert record.steps == 50 and record.crashed


def test_what_a_crash_cuts_short_is_nan():
    record = measure(flight(crashed=True, terminated=True))
    lost = ("quadratic_cost", "constraint_cost", "position_rms", "steady_rms", "settling_time")
    assert all(math.isnan(getattr(record, name)) for name in lost)


def test_saturation_is_the_share_of_rotor_commands_at_a_face_of_the_box():
    task = Task(limits=Limits(kappa=0.5))
    commands = np.full((STEPS, 4), task.hover_force)
    commands[:50, 0], commands[:, 1] = 0.0, task.force_max[1]
    assert measure(flight(task, commands=commands)).saturation_share == pytest.approx(
        (50 + STEPS) / (4 * STEPS)
    )


def test_the_worst_violation_of_each_constraint_is_its_largest_excess():
    task = Task(limits=Limits(tilt=0.3, rate=10.0))
    values = np.full((STEPS, 2), -0.1)
    values[7, 1] = 0.25
    values[8, 0] = 1e-7  # less than what the environments call a violation
    record = measure(flight(task, constraint_values=values))
    assert record.worst_violation == {"tilt": 0.0, "rate": 0.25}
    assert record.row()["worst_rate"] == 0.25


def test_fallbacks_are_counted_by_kind():
    record = measure(flight(fallbacks=np.array([190, 4, 3, 2, 1]), worst_iterations=17))
    assert (record.relaxed, record.previous_plan, record.clipped_sdre, record.hover) == (4, 3, 2, 1)
    assert record.iterations_max == 17
    assert totals([record, record])["previous_plan"] == 6


def test_decision_quantiles_leave_out_what_was_not_timed():
    p50, p99, slowest = decision_quantiles(np.array([np.nan, *np.linspace(0.0, 1e-3, 101)]))
    assert (p50, p99, slowest) == pytest.approx((0.5, 0.99, 1.0))
    assert all(map(math.isnan, decision_quantiles(np.full(3, np.nan))))


@pytest.mark.parametrize("kind", ["bounded", "quadratic"])
def test_the_score_is_the_mean_bounded_reward_whatever_the_reward(kind):
    tasks = {
        name: gymnasium.make("quad/HelixTracking-v0", tilt_limit=0.3, reward=name)
        for name in ("bounded", kind)
    }
    policy = make_policy("hover", tasks["bounded"])
    bounded = next(run_episodes(policy, tasks["bounded"], 1))
    record = measure(next(run_episodes(policy, tasks[kind], 1)))
    assert record.score == pytest.approx(float(bounded.rewards.sum()) / STEPS, rel=1e-12)


def test_the_interval_is_that_of_students_t():
    stats = pytest.importorskip("scipy.stats")
    x = np.random.default_rng(0).normal(size=9)
    low, high = stats.t.interval(0.95, len(x) - 1, x.mean(), stats.sem(x))
    found = estimate(x)
    assert (found.mean - found.half_width, found.mean + found.half_width) == pytest.approx(
        (low, high), rel=1e-10
    )


def test_estimates_leave_out_nan_and_say_how_many_values_are_left():
    assert estimate([1.0, math.nan, 3.0])[0::2] == (2.0, 2)
    assert estimate([math.nan]).n == 0
    assert math.isnan(estimate([1.0]).half_width)


def test_a_paired_difference_is_free_of_the_spread_between_starts():
    rng = np.random.default_rng(1)
    level = 10.0 * rng.random(20)
    theirs = [measure(flight(seed=i))._replace(quadratic_cost=float(level[i])) for i in range(20)]
    ours = [record._replace(quadratic_cost=record.quadratic_cost - 0.5) for record in reversed(theirs)]
    difference = paired_difference(ours, theirs, "quadratic_cost")
    assert difference.mean == pytest.approx(-0.5) and difference.half_width < 1e-12 and difference.n == 20


def test_a_paired_difference_needs_common_seeds():
    with pytest.raises(ValueError, match="none in common"):
        paired_difference([measure(flight(seed=1))], [measure(flight(seed=2))], "score")
    with pytest.raises(ValueError, match="column must be one of"):
        paired_difference([measure(flight())], [measure(flight())], "crashed")
    with pytest.raises(ValueError, match="got 'cost'; it is called 'quadratic_cost' now"):
        paired_difference([measure(flight())], [measure(flight())], "cost")


def test_costs_are_the_sums_of_what_each_step_tells():
    stage, limits = np.linspace(0.0, 2.0, STEPS), np.linspace(0.0, 1.0, STEPS)
    record = measure(flight(stage_costs=stage, costs=limits))
    # Rounding of a sum of 200 numbers.
    assert record.quadratic_cost == pytest.approx(STEPS, rel=1e-12)
    assert record.constraint_cost == pytest.approx(0.5 * STEPS, rel=1e-12)


def test_a_policy_that_crashes_on_the_hard_start_has_no_mean_cost():
    easy, hard = measure(flight(seed=0)), measure(flight(seed=1))._replace(quadratic_cost=100.0)
    lost = measure(flight(seed=1, crashed=True, terminated=True))
    for column in (one.name for one in averaged(team=False) if one.has(CUT_SHORT)):
        assert math.isnan(summarize([easy, lost])[column].mean)
        assert math.isnan(paired_difference([easy, lost], [easy, hard], column).mean)
        assert math.isnan(paired_difference([easy, hard], [easy, lost], column).mean)
    assert summarize([easy, hard])["quadratic_cost"].mean == 50.0
    assert summarize([easy, lost])["score"].n == paired_difference([easy, lost], [easy, hard], "score").n == 2


def test_a_table_shows_no_cost_where_a_flight_crashed():
    easy, lost = measure(flight(seed=0)), measure(flight(seed=1, crashed=True, terminated=True))
    text = str(Evaluation("env", "policy", 0, (easy._replace(quadratic_cost=7.0), lost), (math.nan,) * 3))
    for name in ("quadratic_cost", "constraint_cost"):
        cost = next(line for line in text.splitlines() if line.startswith(name))
        assert cost.split() == [name, "-", "-", "-", "-", "-", "0"]
