"""Closed loops in the dissertation's mode: its tables 4.1 and 4.2, and published sums."""

from __future__ import annotations

import numpy as np
import pytest
from flights import (
    TASK,
    WEAK,
    at_rest,
    calm,
    decide_once,
    fly,
    held_under,
    helix,
    jumps,
    lines,
    rest,
    spiral,
    window,
)

from controllers import ExactNmpc, LinearMPC, Lqr, SdcNmpc
from quad_envs.parameters import Limits
from quad_envs.tasks import Task

PATHS = (helix, spiral, lines)
RATE = Task(limits=Limits(rate=5.0))
SLOW = Task(limits=Limits(kappa=0.3125, rate=5.0))


def lmpc(task=TASK, horizon=25):
    return LinearMPC(task, horizon=horizon, frame="hover")


def sdc(task=TASK, horizon=25, alpha=1.0, passes=0, weight="hover"):
    chosen = {"alpha": alpha, "relinearisations": passes, "terminal_weight": weight}
    return SdcNmpc(task, horizon=horizon, frame="hover", **chosen)


def half(task=TASK, horizon=25):
    return sdc(task, horizon, 0.5)


def one_pass(task=TASK, horizon=25):
    return sdc(task, horizon, 0.5, 1)


def rti(task=TASK):
    return ExactNmpc(task, velocity_error="body", frame="hover")


def exact(task=TASK):
    return ExactNmpc(task, passes=30, velocity_error="body", frame="hover")


def metrics(build, path=rest, task=TASK, **options):
    flight = fly(build(task), path, **options)
    assert not flight.fallbacks.any()
    return flight.rms, flight.effort


@pytest.mark.parametrize(
    ("build", "expected"),
    [
        (lmpc, ((0.8200, 0.3911), (1.5502, 0.1869), (0.3601, 0.1439))),
        (half, ((0.5601, 0.3476), (1.4823, 0.1708), (0.3080, 0.1457))),
        (sdc, ((0.5228, 0.2814), (1.4688, 0.1514), (0.2967, 0.1253))),
        (one_pass, ((0.5426, 0.3199), (1.4782, 0.1351), (0.2962, 0.1286))),
        (rti, ((0.5530, 0.3239), (1.4711, 0.1548), (0.2958, 0.1335))),
        (exact, ((0.5541, 0.3197), (1.4684, 0.1615), (0.2940, 0.1365))),
    ],
    ids=["lmpc", "half", "one", "pass", "rti", "exact"],
)
def test_tasks_at_the_control_horizon(build, expected):
    """Four digits are published."""
    for path, pair in zip(PATHS, expected, strict=True):
        np.testing.assert_allclose(metrics(build, path), pair, rtol=1e-3)


# Horizon: (RMS, effort) of LMPC, alpha 1/2, alpha 1, alpha 1/2 with one pass; sections 9 of the chapter.
TABLES = {
    "helix": {
        10: ((0.8608, 0.3933), (0.6318, 0.3686), (0.5605, 0.3294), (0.5842, 0.3265)),
        15: ((0.8273, 0.3917), (0.5768, 0.3597), (0.5206, 0.3051), (0.5417, 0.3147)),
        35: ((0.8231, 0.3919), (0.5593, 0.3451), (0.5333, 0.2759), (0.5463, 0.3288)),
        45: ((0.8238, 0.3923), (0.5624, 0.3454), (0.5420, 0.2762), (0.5488, 0.3325)),
    },
    "spiral": {
        10: ((1.5399, 0.1938), (1.4814, 0.1655), (1.4652, 0.1455), (1.4661, 0.1350)),
        15: ((1.5475, 0.1886), (1.4836, 0.1661), (1.4674, 0.1488), (1.4672, 0.1371)),
        35: ((1.5487, 0.1881), (1.4788, 0.1743), (1.4665, 0.1504), (1.4817, 0.1329)),
        45: ((1.5485, 0.1887), (1.4783, 0.1752), (1.4654, 0.1491), (1.4829, 0.1315)),
    },
    "lines": {
        10: ((0.3516, 0.2189), (0.3023, 0.2121), (0.2884, 0.1957), (0.2932, 0.1979)),
        15: ((0.3558, 0.1574), (0.3024, 0.1592), (0.2876, 0.1420), (0.2891, 0.1431)),
        35: ((0.3560, 0.1436), (0.3082, 0.1445), (0.3013, 0.1241), (0.2956, 0.1277)),
        45: ((0.3548, 0.1423), (0.3093, 0.1427), (0.3047, 0.1235), (0.2956, 0.1266)),
    },
}


@pytest.mark.slow
@pytest.mark.parametrize("path", PATHS, ids=list(TABLES))
@pytest.mark.parametrize("horizon", [10, 15, 35, 45])
def test_tables_4_1_and_4_2(path, horizon):
    for build, pair in zip((lmpc, half, sdc, one_pass), TABLES[path.__name__][horizon], strict=True):
        flight = fly(build(TASK, horizon), path)
        np.testing.assert_allclose((flight.rms, flight.effort), pair, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("build", "expected"),
    [
        (lmpc, ((1.2373, 1.0195), (1.4548, 0.2239), (0.2863, 0.1366))),
        (sdc, ((0.5207, 0.4659), (1.4861, 0.2542), (0.2827, 0.1334))),
        (one_pass, ((0.4682, 0.4063), (1.4622, 0.2096), (0.2717, 0.1191))),
    ],
    ids=["lmpc", "one", "pass"],
)
def test_climbing_tasks(build, expected):
    for path, pair in zip(PATHS, expected, strict=True):
        np.testing.assert_allclose(metrics(build, path, climb=True), pair, rtol=1e-3)


@pytest.mark.slow
def test_the_dissertations_factorisation_loses_the_climbing_helix():
    assert metrics(half, helix, climb=True)[0] > 2.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("build", "expected"),
    [
        (lmpc, ((0.9843, 0.4071), (1.6109, 0.1572), (0.4046, 0.1329))),
        (sdc, ((0.6888, 0.2700), (1.5367, 0.1094), (0.3434, 0.1095))),
    ],
    ids=["lmpc", "one"],
)
def test_tasks_with_a_rate_limit(build, expected):
    for path, pair in zip(PATHS, expected, strict=True):
        np.testing.assert_allclose(metrics(build, path, RATE), pair, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("build", "start", "expected"),
    [
        (lmpc, (1, 1, 1), (0.5400, 0.0250)),
        (lmpc, (2, 2, 2), (1.0764, 0.1027)),
        (half, (2, 2, 2), (1.0796, 0.1491)),
        (sdc, (2, 2, 2), (1.0886, 0.1318)),
        (one_pass, (2, 2, 2), (1.0803, 0.1154)),
        (rti, (2, 2, 2), (1.0712, 0.1171)),
        (lmpc, (2, 2, -2), (1.1200, 0.1173)),
        (half, (2, 2, -2), (1.1047, 0.1061)),
        (sdc, (2, 2, -2), (1.0996, 0.0911)),
        (one_pass, (2, 2, -2), (1.1029, 0.0920)),
        (lambda task: sdc(task, alpha=0.5, passes=3), (2, 2, -2), (1.1010, 0.0929)),
        (lmpc, (8, 0, 0), (2.7785, 0.5853)),
        (half, (8, 0, 0), (2.6435, 1.4822)),
        (sdc, (8, 0, 0), (2.6205, 0.7445)),
        (one_pass, (8, 0, 0), (2.6106, 0.4129)),
    ],
)
def test_regulation(build, start, expected):
    np.testing.assert_allclose(metrics(build, start=start), expected, rtol=1e-3, atol=5e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("side", "rms", "effort", "settles"), [(1, 1.8047, 0.1364, 3.90), (-1, 1.7274, 0.2485, 3.70)]
)
def test_regulation_with_weak_rotors(side, rms, effort, settles):
    flight = fly(lmpc(WEAK), start=(3, 3, 3 * side))
    np.testing.assert_allclose((flight.rms, flight.effort), (rms, effort), rtol=1e-3)
    error = np.linalg.norm(flight.plants[:-1, :3], axis=1)
    assert 0.05 * (1 + np.flatnonzero(error > 0.05 * error[0])[-1]) == pytest.approx(settles)


def slow_helix(t):
    """R 2 m, 0.5 rad/s, climbing at 0.2 m/s; starts 2 m off, without velocity reference."""
    return np.stack([2 * np.cos(0.5 * t), 2 * np.sin(0.5 * t), -0.2 * t], axis=-1), np.zeros((*t.shape, 3))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("build", "expected"),
    [
        (lmpc, (846.51, 924.67, 158.39, 1127.87)),
        (lambda task: sdc(task, alpha=0.5, weight="sdre"), (931.79, 930.07, 157.92, 1094.32)),
        (half, (923.95, 928.43, 157.92, 1093.06)),
        (sdc, (823.33, 906.66, 157.30, 1063.48)),
        (one_pass, (804.75, 892.70, 157.44, 1050.79)),
        (rti, (803.40, 893.56, 157.62, 1058.50)),
        (exact, (804.24, 893.34, 157.67, 1058.51)),
    ],
    ids=["lmpc", "half-sdre", "half", "one", "pass", "rti", "exact"],
)
def test_summed_costs_of_four_seconds(build, expected):
    cases = [(TASK, rest, 3.0), (SLOW, rest, 3.0), (TASK, slow_helix, 0.0), (SLOW, jumps, 3.0)]
    costs = [fly(build(task), path, (start,) * 3, seconds=4.0).cost for task, path, start in cases]
    np.testing.assert_allclose(costs, expected, rtol=1e-4)


@pytest.mark.parametrize("controller", [LinearMPC, Lqr])
def test_constant_models_want_the_velocity_reference_in_body_axes(controller):
    """On the climbing helix it costs a third."""
    for path, climb in [(helix, False), (helix, True), (spiral, True), (lines, False)]:
        attitude = fly(controller(TASK, velocity_reference="attitude"), path, climb=climb)
        heading = fly(controller(TASK, velocity_reference="heading"), path, climb=climb)
        assert attitude.exact_cost < heading.exact_cost


def circle(t):
    w = 0.8
    p = np.stack([2 * np.sin(w * t), 2 - 2 * np.cos(w * t), 0 * t], axis=-1)
    return p, np.stack([2 * w * np.cos(w * t), 2 * w * np.sin(w * t), 0 * t], axis=-1)


@pytest.mark.slow
@pytest.mark.parametrize("psi", [0.0, np.pi / 4, np.pi / 2, np.pi])
def test_heading_frame_makes_the_heading_irrelevant(psi):
    """Section 6: a level circle at a constant heading, 0.215 m for LMPC whatever it is."""
    controller = LinearMPC(TASK, velocity_reference="heading")
    p, _ = circle(0.05 * np.arange(301))
    plant, last, squares = at_rest(Theta=(0, 0, psi)), np.full(4, TASK.hover_force), 0.0
    for k in range(300):
        last = decide_once(controller, plant, window(circle, k, 25, psi=psi), last).command[0]
        squares += np.sum((plant[:3] - p[k]) ** 2)
        plant = held_under(plant, last, TASK, calm, k)
    assert np.sqrt(squares / 300) == pytest.approx(0.2155, abs=1e-3)
