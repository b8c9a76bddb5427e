"""The central MPC: alone it plans as the distributed one does; near others it passes them safely."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from formation_flights import (
    DT,
    LINE_START,
    SORTED_START,
    TRIANGLE,
    at_rest,
    decide,
    line,
    smallest_gap,
    still,
    team_task,
)

from controllers.fallback import Fallback
from controllers.team.central import CentralMpc
from controllers.team.cooperative import CooperativeMpc
from quad_envs.dynamics import simulate
from quad_envs.parameters import Limits

N = 5


def rows_of(path, k=0):
    p, v = path(DT * (k + np.arange(N + 1)))
    return np.c_[p, v, np.zeros(N + 1), np.ones(N + 1)]


def decide_centrally(mpc, plants, path=still, slots=TRIANGLE, memory=None, k=0, last=None):
    last = np.full((len(plants), 4), mpc.task.hover_force) if last is None else last
    memory = np.zeros(mpc.memory_size) if memory is None else memory
    return mpc.decide(plants, rows_of(path, k), slots, last, memory)


def fly_centrally(mpc, start, slots, path, seconds=10.0):
    """Largest error to the slots at the end, smallest distance, fallbacks."""
    plants, memory, last = at_rest(start, mpc.task), None, None
    gap, fallbacks = np.inf, []
    steps = round(seconds / DT)
    for k in range(steps):
        decision = decide_centrally(mpc, plants, path, slots, memory, k, last)
        memory, last = decision.memory, decision.command
        plants = simulate(plants, last, mpc.task.params)
        gap = min(gap, smallest_gap(plants))
        fallbacks.append(decision.fallback[0])
    target = path(np.array([DT * steps]))[0] + slots
    return np.linalg.norm(plants[:, :3] - target, axis=1).max(), gap, np.array(fallbacks)


@pytest.mark.parametrize(
    "limits", [Limits(tilt=1.2), Limits(kappa=0.3125, tilt=0.25, rate=8.0, velocity=0.7)]
)
def test_far_from_each_other_vehicles_decide_as_leaders_do(limits):
    """Each plans alone then, and that plan has another implementation: the compiled one of the team."""
    task = team_task(3, 0, 2, limits=limits)
    rng = np.random.default_rng(0)
    plants = at_rest([[0, 0, 0], [9, 0, 0], [0, 9, 0]], task)
    plants[:, 3:12] = 0.4 * rng.normal(size=(3, 9))
    plants[:, 6:8] *= 0.3
    plants[:, 8] = [0.2, -2.5, 3.1]
    slots = plants[:, :3] + 2.0 * rng.normal(size=(3, 3))
    free = CooperativeMpc(task, reach=np.inf, speed=np.inf, turning=False, plan_tilt=np.inf)
    preview = np.repeat(rows_of(line)[None], 3, axis=0)
    preview[..., :3] += (slots - plants[:, :3])[:, None]
    expected = decide(free, plants, np.eye(3), slots, preview=preview, leader=np.ones(3))
    found = decide_centrally(CentralMpc(task), plants, line, slots)
    assert found.fallback[0] == Fallback.NONE
    np.testing.assert_allclose(found.command, expected.command, atol=1e-4)  # N, OSQP's tolerance


@pytest.mark.parametrize("path", [still, line])
def test_a_line_becomes_a_triangle_with_the_separation_kept(path):
    error, gap, fallbacks = fly_centrally(CentralMpc(team_task()), LINE_START, TRIANGLE, path)
    assert error < 0.01
    assert gap >= 0.399
    assert not fallbacks.any()


def test_a_symmetric_pair_passes():
    start = np.array([[-2.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    error, gap, _ = fly_centrally(CentralMpc(team_task(2)), start, -start, still, seconds=8.0)
    assert error < 0.05
    assert gap >= 0.399


def test_without_separation_it_would_collide():
    """That the rows do it: the same flight with almost no penalty."""
    loose = CentralMpc(team_task(2), separation_weight=1e-6)
    start = np.array([[-2.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    assert fly_centrally(loose, start, -start, still, seconds=8.0)[1] < 0.1


def test_vehicles_at_one_place_have_no_rows_and_fly_on():
    mpc = CentralMpc(team_task())
    plants = at_rest(LINE_START, mpc.task)
    plants[1, :3] = plants[0, :3]
    decision = decide_centrally(mpc, plants)
    assert decision.fallback[0] == Fallback.NONE
    assert np.isfinite(decision.command).all()


def test_failures_are_counted_and_flyable():
    good, stopped = CentralMpc(team_task()), CentralMpc(team_task(), max_iter=1)
    plants = at_rest(0.5 * SORTED_START, good.task)
    first = decide_centrally(stopped, plants)
    assert (first.fallback == Fallback.CLIPPED_SDRE).all()
    kept = decide_centrally(good, plants)
    again = decide_centrally(stopped, plants, memory=kept.memory)
    assert (again.fallback == Fallback.PREVIOUS_PLAN).all()
    plan = kept.memory[1 : 1 + 6 * N * 4].reshape(6, N, 4)
    np.testing.assert_allclose(again.command, np.clip(plan[:, 1], 0.0, good.task.force_max), atol=1e-12)
    plants[2, 3:6] = plants[2, 9:12] = 1e308
    with np.errstate(all="ignore"):
        lost = decide_centrally(good, plants)
    assert (lost.fallback == Fallback.HOVER).all()
    np.testing.assert_array_equal(lost.command, good.task.hover_force)


@pytest.mark.parametrize(
    ("vehicles", "place", "numbers"),
    [(6, slice(3, 6), (1e10, -5e9, 3e9)), (3, 8, 1e24)],
    ids=["speeds that leave the free minimum singular", "an angle that leaves OSQP no convex cost"],
)
def test_numbers_beyond_what_can_be_factored_end_in_hover(vehicles, place, numbers):
    mpc = CentralMpc(team_task(vehicles))
    plants = at_rest(0.5 * SORTED_START[:vehicles], mpc.task)
    plants[2, place] = numbers
    with np.errstate(all="ignore"):
        lost = decide_centrally(mpc, plants, slots=TRIANGLE[:vehicles])
    assert (lost.fallback == Fallback.HOVER).all()
    np.testing.assert_array_equal(lost.command, mpc.task.hover_force)


def test_bad_arguments_are_named():
    mpc = CentralMpc(team_task())
    plants = at_rest(LINE_START, mpc.task)
    with pytest.raises(ValueError, match=r"slots must have shape \(6, 3\)"):
        decide_centrally(mpc, plants, slots=TRIANGLE[:4])
    plants[3, 5] = np.nan
    with pytest.raises(ValueError, match=r"plant is not finite at \(3, 5\)"):
        decide_centrally(mpc, plants)
    for options, message in (
        ({"horizon": 0}, "horizon must be"),
        ({"alpha": -1.0}, "alpha must lie"),
        ({"braking_time": -1.0}, "braking_time must be finite and >= 0 s"),
        ({"eps": 0.0}, "eps must be > 0"),
    ):
        with pytest.raises(ValueError, match=message):
            CentralMpc(team_task(), **options)


def test_a_decision_depends_on_its_arguments_alone():
    """Not on what the same controller decided before: OSQP starts cold."""
    fresh, used = CentralMpc(team_task()), CentralMpc(team_task())
    fly_centrally(used, LINE_START, TRIANGLE, line, seconds=0.5)
    plants = at_rest(SORTED_START, fresh.task)
    expected, found = decide_centrally(fresh, plants), decide_centrally(used, plants)
    np.testing.assert_array_equal(found.command, expected.command)
    np.testing.assert_array_equal(found.iterations, expected.iterations)


def test_large_teams_are_refused():
    with pytest.raises(ValueError, match="at most 15 vehicles, got 16: it fills dense matrices"):
        CentralMpc(team_task(16))


def test_it_pickles():
    mpc = CentralMpc(team_task())
    plants = at_rest(LINE_START, mpc.task)
    expected = decide_centrally(mpc, plants).command
    copied = pickle.loads(pickle.dumps(mpc))
    np.testing.assert_array_equal(decide_centrally(copied, plants).command, expected)
