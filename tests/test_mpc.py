"""The MPCs on single problems and in batches: published numbers, invariances, options, memory."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
from flights import (
    DT,
    FLAVOURS,
    HOVER,
    TASK,
    at_rest,
    calm,
    decide_once,
    fly,
    held_under,
    helix,
    jumps,
    plan_of,
    rest,
    spiral,
    window,
)

from controllers import ExactNmpc, LinearMPC, LmpcOptions, Lqr, NmpcOptions, SdcNmpc, SdcOptions
from quad_envs.parameters import Limits, Weights
from quad_envs.tasks import Task

N = 25
AWAY = at_rest((3.0, 3.0, 3.0))
MOVING = np.r_[3, 3, 3, 1, 0.5, -0.5, 0.2, -0.3, 0.1, 0.5, 0.4, 0.1, np.full(4, HOVER)]
SLOW = Task(limits=Limits(kappa=0.3125, rate=5.0))
BOUNDED = Task(limits=Limits(0.3125, 5.0, 0.3, 2.0, (-20.0, -1.5, -20.0), (1.0, 20.0, 20.0)))


@pytest.fixture(params=FLAVOURS)
def flavour(request):
    return FLAVOURS[request.param]


def first_input(controller, plant):
    return decide_once(controller, plant).command[0] - HOVER


@pytest.mark.parametrize(
    ("mpc", "kind"), [(LinearMPC, LmpcOptions), (SdcNmpc, SdcOptions), (ExactNmpc, NmpcOptions)]
)
def test_options_are_a_value_whose_fields_keywords_replace(mpc, kind):
    chosen = kind(horizon=10, soft_weight=7.0)
    assert mpc(TASK, chosen, horizon=5).options == kind(horizon=5, soft_weight=7.0)
    assert mpc(TASK, horizon=10, soft_weight=7.0).options == mpc(TASK, chosen).options == chosen
    with pytest.raises(TypeError, match=r"field of \w+Options: 'horizn'; did you mean 'horizon'\?"):
        mpc(TASK, horizn=10)
    with pytest.raises(TypeError, match=r"options must be \w+Options, got 10; .* horizon="):
        mpc(TASK, 10)
    with pytest.raises(AttributeError):
        chosen.horizon = 20
    with pytest.raises(ValueError, match="soft_weight"):
        mpc(TASK, chosen, soft_weight=-1.0)
    assert pickle.loads(pickle.dumps(chosen)) == chosen


def test_options_of_one_mpc_are_refused_by_another():
    with pytest.raises(TypeError, match="must be SdcOptions, got LmpcOptions"):
        SdcNmpc(TASK, LmpcOptions())


def test_lmpc_plan_of_the_published_problem():
    plan = plan_of(decide_once(LinearMPC(TASK), AWAY), N)
    np.testing.assert_allclose(plan[0], [2.814907, 2.814907, -0.056077, -0.056077], atol=1e-6)
    np.testing.assert_allclose(plan[1], [1.635770, 1.635770, 0.681470, 0.681470], atol=1e-6)


def test_lmpc_plan_of_the_published_problem_with_tight_limits():
    decision = decide_once(LinearMPC(SLOW), AWAY)
    plan = plan_of(decision, N)
    np.testing.assert_allclose(plan[0], [0.25, 0.25, -0.25, -0.25], atol=1e-9)
    np.testing.assert_allclose(plan[1], [0.49, 0.49, -0.218067, -0.218067], atol=1e-6)
    moves = np.diff(np.vstack([np.zeros(4), plan]), axis=0)
    active = np.isclose(np.abs(moves), 0.25, atol=1e-9).sum() + np.isclose(plan, 0.49, atol=1e-9).sum()
    assert active == 48
    assert decision.iterations[0] >= 48


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"alpha": 0.5}, [4.784454, 3.119943, -1.96, -1.96]),
        ({"alpha": 0.5, "terminal_weight": "sdre"}, [4.742268, 3.081426, -1.96, -1.96]),
        ({"alpha": 1.0}, [4.957940, 3.397195, -1.96, -1.96]),
        ({"alpha": 0.5, "relinearisations": 1}, [3.188182, 2.490654, -1.391987, -1.752779]),
    ],
)
def test_sdc_first_input_of_the_published_problem(options, expected):
    np.testing.assert_allclose(
        first_input(SdcNmpc(TASK, frame="hover", **options), MOVING), expected, atol=2e-6
    )


@pytest.mark.parametrize("horizon", [1, 2, 7, 25, 40])
def test_unconstrained_lmpc_is_lqr_whatever_the_horizon(horizon):
    plant = at_rest((0.3, -0.2, 0.1), (0.05, -0.02, 0.03))
    expected = decide_once(Lqr(TASK), plant).command
    np.testing.assert_allclose(
        decide_once(LinearMPC(TASK, horizon=horizon), plant).command, expected, atol=1e-11
    )


def test_position_and_heading_of_vehicle_and_reference_do_not_matter(flavour):
    """In the heading frame; without a position box, which belongs to inertial axes."""
    controller = flavour(SLOW)
    plant, rows = MOVING * 0.3, window(helix, 20, N, psi=0.4)
    psi, shift = 2.9, np.array([0.2, -0.3, 5.0])
    c, s = np.cos(psi), np.sin(psi)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    turned, other = plant.copy(), rows.copy()
    turned[:3], turned[8] = turn @ plant[:3] + shift, plant[8] + psi
    other[:, :3], other[:, 3:6] = rows[:, :3] @ turn.T + shift, rows[:, 3:6] @ turn.T
    other[:, 6:] = rows[:, 6:] @ [[c, -s], [s, c]]
    here, there = decide_once(controller, plant, rows), decide_once(controller, turned, other)
    np.testing.assert_allclose(there.command, here.command, atol=1e-8)


def test_heading_that_crosses_pi_is_no_jump(flavour):
    controller = flavour(TASK)
    rows = window(rest, 0, N, psi=3.1)
    left, right = at_rest(Theta=(0, 0, 3.13)), at_rest(Theta=(0, 0, 3.13 - 2 * np.pi))
    a, b = decide_once(controller, left, rows), decide_once(controller, right, rows)
    np.testing.assert_allclose(a.command, b.command, atol=1e-9)
    assert np.abs(a.command - HOVER).max() < 0.2  # a wrap would ask for 6 rad of yaw


def test_batch_equals_single_rows_bit_for_bit(flavour):
    controller = flavour(BOUNDED)
    rng = np.random.default_rng(0)
    n = 6
    plant = np.stack([AWAY, MOVING, *(MOVING * rng.normal(size=16) for _ in range(n - 2))])
    plant[:, 12:] = HOVER
    rows = np.stack([window(path, k, N + 2) for k, path in enumerate([helix, spiral, jumps] * 2)])
    last, disturbance = rng.uniform(1.0, 2.4, (n, 4)), 0.05 * rng.normal(size=(n, 6))
    memory = np.zeros((n, controller.memory_size))
    for _ in range(2):  # the second time with a plan in memory
        batch = controller.decide(plant, rows, last, disturbance, memory)
        for j in range(n):
            one = controller.decide(*(a[j : j + 1] for a in (plant, rows, last, disturbance, memory)))
            for whole, part in zip(batch, one, strict=True):
                np.testing.assert_array_equal(whole[j], part[0])
        memory = batch.memory
    assert (batch.iterations > 0).any()


def test_decisions_leave_no_trace_but_memory(flavour):
    controller = flavour(BOUNDED, reject_disturbance=True)
    memory = decide_once(controller, AWAY).memory[0]
    before = memory.copy()
    first = decide_once(controller, MOVING, memory=memory)
    np.testing.assert_array_equal(memory, before)
    decide_once(controller, AWAY)
    again = decide_once(controller, MOVING, memory=memory)
    for twin in (pickle.loads(pickle.dumps(controller)), copy.deepcopy(controller)):
        for part, other, third in zip(first, again, decide_once(twin, MOVING, memory=memory), strict=True):
            np.testing.assert_array_equal(part, other)
            np.testing.assert_array_equal(part, third)
    assert len(pickle.dumps(controller)) < 100_000  # the workspace stays behind


def test_osqp_finds_the_same_command(flavour):
    """OSQP stops at residuals of 1e-5: 3e-4 N in the first input, more with relinearisation."""
    task = Task(limits=Limits(kappa=0.3125, rate=5.0, velocity=2.0))
    exact, approximate = flavour(task, horizon=10), flavour(task, horizon=10, solver="osqp")
    for plant in (at_rest((0.5, -0.3, 0.4)), MOVING):
        a, b = decide_once(exact, plant), decide_once(approximate, plant)
        np.testing.assert_allclose(b.command, a.command, atol=1e-2)
        assert a.fallback == b.fallback == 0


def test_first_move_keeps_to_the_last_command_in_closed_loop(flavour):
    flight = fly(flavour(SLOW), jumps, (3.0, 3.0, 3.0), seconds=1.5)
    moves = np.diff(np.vstack([np.full(4, HOVER), flight.commands]), axis=0)
    assert np.abs(moves).max() <= 5.0 * DT + 1e-9
    assert flight.commands.min() >= 0.0
    assert flight.commands.max() <= 2.45


def test_state_limits_are_kept(flavour):
    """Far set-point, rows active for long; the plan sees no rotor lag, hence the small excess."""
    limits = Limits(tilt=0.25, velocity=1.5)
    free, limited = (
        fly(flavour(Task(limits=each)), start=(4.0, 0.0, 0.0), seconds=3.0) for each in (Limits(), limits)
    )
    assert np.abs(free.plants[:, 3]).max() > 2.0
    assert np.abs(limited.plants[:, 3:6]).max() < 1.55
    assert np.abs(limited.plants[:, 6:8]).max() < 0.27


def test_position_box_is_kept_at_any_heading(flavour):
    limits = Limits(position_lower=(-0.5, -10.0, -10.0), position_upper=(10.0, 10.0, 10.0))
    controller = flavour(Task(limits=limits))
    plant, last, memory = at_rest((3.0, 0.0, 0.0), (0.0, 0.0, 2.0)), np.full(4, HOVER), None
    rows = window(rest, 0, N, psi=2.0)
    rows[:, 0] = -2.0  # behind the wall
    lowest = 9.0
    for k in range(120):
        decision = decide_once(controller, plant, rows, last, memory=memory)
        last, memory = decision.command[0], decision.memory[0]
        plant = held_under(plant, last, controller.task, calm, k)
        lowest = min(lowest, plant[0])
    assert -0.5 < lowest < -0.38  # it comes close and no further


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: LinearMPC(TASK, horizon=0), "horizon"),
        (lambda: LinearMPC(TASK, solver="qpoases"), "'structured', 'osqp'"),
        (lambda: LinearMPC(TASK, frame="body"), "'heading', 'hover'"),
        (lambda: LinearMPC(TASK, velocity_reference="x"), "'level', 'heading', 'attitude'"),
        (lambda: LinearMPC(TASK, soft_weight=-1.0), "soft_weight"),
        (lambda: LinearMPC(TASK, estimator_gain=0.0), "estimator_gain"),
        (lambda: LinearMPC(TASK, iteration_limit=-1), "iteration_limit"),
        (lambda: LinearMPC(Task(weights=Weights(Q=(1.0, 2.0, *(1.0,) * 10)))), "frame='hover'"),
        (lambda: SdcNmpc(TASK, alpha=1.5), "alpha"),
        (lambda: SdcNmpc(TASK, relinearisations=-1), "relinearisations"),
        (lambda: SdcNmpc(TASK, terminal_weight="zero"), "'hover', 'sdre'"),
        (lambda: ExactNmpc(TASK, passes=0), "passes"),
        (lambda: ExactNmpc(TASK, velocity_error="none"), "'inertial', 'body'"),
    ],
)
def test_bad_options_are_named(build, message):
    with pytest.raises(ValueError, match=message):
        build()


@pytest.mark.parametrize("argument", range(5))
def test_bad_arguments_are_named(argument):
    controller = LinearMPC(TASK)
    names = ("plant", "window", "last_command", "disturbance", "memory")
    good = [
        AWAY[None],
        window(rest, 0, N)[None],
        np.full((1, 4), HOVER),
        np.zeros((1, 6)),
        np.zeros((1, 126)),
    ]
    bad = [a.copy() for a in good]
    bad[argument][..., -1] = np.nan
    with pytest.raises(ValueError, match=f"{names[argument]} of vehicle 0 is not finite"):
        controller.decide(*bad)
    bad = [*good[:argument], good[argument][:, :-1], *good[argument + 1 :]]
    with pytest.raises(ValueError, match=names[argument]):
        controller.decide(*bad)


def test_arrays_of_any_kind_are_taken():
    controller, rows = LinearMPC(TASK), window(helix, 0, N)
    expected = decide_once(controller, AWAY, rows).command
    fixed = rows.copy()
    fixed.flags.writeable = False
    lists = (
        [AWAY.tolist()],
        [fixed],
        np.full((1, 8), HOVER)[:, ::2],
        np.zeros((1, 6), np.float32),
        np.zeros((1, 126)),
    )
    np.testing.assert_array_equal(controller.decide(*lists).command, expected)


def test_window_past_the_horizon_is_not_read():
    controller = LinearMPC(TASK)
    rows = window(helix, 0, N + 10)
    rows[N + 1 :] = np.nan
    a, b = decide_once(controller, AWAY, rows), decide_once(controller, AWAY, rows[: N + 1])
    np.testing.assert_array_equal(a.command, b.command)
