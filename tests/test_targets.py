"""Targets move as other integrators and closed forms say, and broken ones are refused."""

import math
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from quad_envs import target_tracking_v0
from quad_envs.references import Helix, RandomSmooth
from quad_envs.targets import (
    Aircraft,
    ConstantVelocity,
    PathTarget,
    StaticTarget,
    TurningTarget,
    make_target,
    target_from_function,
)

T = 0.05 * np.arange(401)  # s


def rows_of(target, t=T, seed=0):
    return target.rows(np.asarray(t, dtype=float), np.random.default_rng(seed))


def circle(t):
    return [2 * math.cos(t), 2 * math.sin(t), -0.1 * t]


def dive(t):
    """Commands that push the aircraft into both of its bounds."""
    return (-3.0 if t < 4.0 else 3.0), -2.0, 0.3


DETERMINISTIC = [
    StaticTarget((1.0, 2.0, -3.0)),
    ConstantVelocity(),
    TurningTarget(),
    TurningTarget(speed=1.5, rate=-0.7, heading=2.0, vertical_speed=0.3),
    TurningTarget(rate=0.0),
    Aircraft(),
    PathTarget(Helix()),
    target_from_function(circle),
]


@pytest.mark.parametrize("target", DETERMINISTIC, ids=lambda target: type(target).__name__)
def test_velocity_is_the_derivative_of_position(target):
    middle, h = np.array([0.3, 2.1, 4.4, 7.3]), 1e-4
    t = np.stack([middle - h, middle, middle + h], axis=1)
    rows = rows_of(target, t.ravel()).reshape(4, 3, 6)
    slope = (rows[:, 2, :3] - rows[:, 0, :3]) / (2 * h)
    np.testing.assert_allclose(rows[:, 1, 3:], slope, atol=1e-6)  # third derivatives times h^2, and h itself
    assert not target.random


@pytest.mark.parametrize("target", DETERMINISTIC, ids=lambda target: type(target).__name__)
def test_rows_do_not_depend_on_the_other_times_asked_for(target):
    few = rows_of(target, T[::40])
    np.testing.assert_allclose(few, rows_of(target)[::40], atol=1e-7)  # RK4 with other steps
    assert few.shape == (11, 6)


def test_cv_and_turn_are_the_targets_of_chapter_7():
    cv, turn = rows_of(make_target("cv")), rows_of(make_target("turn"))
    line = np.stack([3 + 0.6 * T, 0.2 * T, -0.1 * T], axis=1)
    radius = 0.8 / 0.25
    arc = np.stack([3 + radius * np.sin(0.25 * T), radius * (1 - np.cos(0.25 * T)), -0.1 * T], axis=1)
    np.testing.assert_allclose(cv[:, :3], line, atol=1e-13)
    np.testing.assert_allclose(turn[:, :3], arc, atol=1e-13)


def test_turn_without_a_rate_is_a_straight_line():
    line = ConstantVelocity((3.0, 0.0, 0.0), (0.8, 0.0, -0.1))
    np.testing.assert_allclose(rows_of(TurningTarget(rate=0.0)), rows_of(line), atol=1e-13)
    np.testing.assert_allclose(rows_of(TurningTarget(rate=1e-12)), rows_of(line), atol=1e-9)


def test_aircraft_flies_as_another_integrator_says():
    def derivative(t, x):
        V, gamma, chi = x[3:]
        return [
            V * math.cos(chi) * math.cos(gamma),
            V * math.sin(chi) * math.cos(gamma),
            -V * math.sin(gamma),
            2 + 0.5 * math.sin(0.4 * t) - V,
            0.5 * math.cos(0.5 * t) / V,
            math.sin(0.3 * t) / (V * math.cos(gamma)),
        ]

    start = [6, -2, -5, 2, 0.05, 0.6]
    exact = solve_ivp(derivative, (0, 20), start, method="DOP853", t_eval=T, rtol=1e-12, atol=1e-12)
    rows = rows_of(make_target("aircraft"))
    np.testing.assert_allclose(rows[:, :3], exact.y[:3].T, atol=1e-8)  # RK4 at 0.02 s
    np.testing.assert_allclose(np.linalg.norm(rows[:, 3:], axis=1), exact.y[3], atol=1e-8)


def test_aircraft_stays_within_its_bounds():
    rows = rows_of(Aircraft(manoeuvre=dive))
    speed = np.linalg.norm(rows[:, 3:], axis=1)
    descent = np.arcsin(rows[:, 5] / speed)
    assert np.isfinite(rows).all()
    np.testing.assert_allclose(speed.min(), 0.2)
    np.testing.assert_allclose(descent.max(), math.radians(80.0))


def test_climbing_aircraft_goes_up():
    assert rows_of(Aircraft(climb=0.3), [0.0])[0, 5] < 0.0


def test_undisturbed_velocity_is_not_random_and_a_disturbed_one_repeats_by_seed():
    target = ConstantVelocity(q=0.02)
    assert target.random and not ConstantVelocity().random
    assert np.array_equal(rows_of(target, seed=1), rows_of(target, seed=1))
    assert not np.array_equal(rows_of(target, seed=1), rows_of(target, seed=2))
    np.testing.assert_array_equal(rows_of(target)[0], rows_of(ConstantVelocity())[0])


@pytest.mark.parametrize("times", [[2.0], np.linspace(0, 2, 41), [0.1, 0.2, 0.9, 1.0, 2.0]])
def test_disturbed_velocity_has_the_closed_form_covariance_for_any_sampling(times):
    target, t, q, runs = ConstantVelocity((1.0, 2.0, 3.0), (0.8, 0.3, -0.1), 0.5), 2.0, 0.5, 20_000
    rng = np.random.default_rng(7)
    last = np.array([target.rows(np.asarray(times, dtype=float), rng)[-1] for _ in range(runs // 3 + 1)])
    error = last - rows_of(ConstantVelocity((1.0, 2.0, 3.0), (0.8, 0.3, -0.1)), [t])
    # the axes are independent and alike: three samples of (position, velocity) a run
    samples = error.reshape(-1, 2, 3).transpose(0, 2, 1).reshape(-1, 2)
    Q = q * np.array([[t**3 / 3, t**2 / 2], [t**2 / 2, t]])
    whitened = np.linalg.solve(np.linalg.cholesky(Q), samples.T)
    # entries of a sample covariance of unit variables have deviation sqrt(2/n) = 0.01: four of them
    np.testing.assert_allclose(np.cov(whitened), np.eye(2), atol=0.04)
    np.testing.assert_allclose(whitened.mean(axis=1), 0.0, atol=0.03)
    axes = np.corrcoef(error.T)
    assert np.abs(axes[:3, :3] - np.eye(3)).max() < 0.05  # deviation 1 / sqrt(6667) = 0.012


def test_steps_of_the_disturbance_are_white_with_the_covariance_of_the_filter():
    dt, q = 0.05, 0.3
    rows = rows_of(ConstantVelocity(q=q), dt * np.arange(20_001), seed=3)
    F = np.eye(6) + dt * np.eye(6, k=3)
    w = rows[1:] - rows[:-1] @ F.T
    Q = q * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(3))
    whitened = np.linalg.solve(np.linalg.cholesky(Q), w.T)
    np.testing.assert_allclose(np.cov(whitened), np.eye(6), atol=0.04)  # four deviations sqrt(2/20000)
    lagged = whitened[:, 1:] @ whitened[:, :-1].T / (w.shape[0] - 1)
    np.testing.assert_allclose(lagged, 0.0, atol=0.03)  # four deviations 1/sqrt(20000)


def test_chapter_6_target_is_the_one_of_the_scenario():
    assert make_target("chapter-6") == ConstantVelocity((3.0, 3.0, -6.0), (0.8, 0.3, -0.1), 0.02)


@given(t=st.lists(st.floats(0, 50), min_size=1, max_size=8))
def test_a_reference_is_followed_in_position_and_velocity(t):
    path = make_target(Helix())
    assert np.array_equal(rows_of(path, t), Helix().rows(np.array(t), None)[:, :6])


def test_a_random_reference_stays_random():
    assert make_target(RandomSmooth()).random


def test_a_table_is_a_target(tmp_path):
    path = tmp_path / "target.csv"
    path.write_text("t,x,y,z\n" + "".join(f"{t:.1f},{2 * t:.1f},0,-1\n" for t in 0.1 * np.arange(11)))
    rows = rows_of(make_target(str(path)), [0.25, 0.5])
    np.testing.assert_allclose(rows, [[0.5, 0, -1, 2, 0, 0], [1, 0, -1, 2, 0, 0]], atol=1e-12)


@pytest.mark.parametrize("target", [*DETERMINISTIC, ConstantVelocity(q=0.1)], ids=lambda t: type(t).__name__)
def test_targets_pickle(target):
    assert np.array_equal(rows_of(pickle.loads(pickle.dumps(target))), rows_of(target))


def test_make_target_returns_a_target_as_it_is():
    target = TurningTarget()
    assert make_target(target) is target


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: make_target("turm"), "did you mean 'turn'"),
        (lambda: make_target(3), "a name, the path of a table, .* or a Target, got 3"),
        (lambda: StaticTarget((0.0, 1.0)), "position of StaticTarget must be three finite numbers"),
        (lambda: ConstantVelocity(velocity=(0.0, math.nan, 0.0)), "velocity of ConstantVelocity"),
        (lambda: ConstantVelocity(q=-1.0), "q of ConstantVelocity must be >= 0"),
        (lambda: TurningTarget(rate=math.inf), "rate of TurningTarget must be a finite number"),
        (lambda: Aircraft(speed=0.1), "speed >= 0.2"),
        (lambda: Aircraft(climb=1.5), "climb"),
        (lambda: Aircraft(manoeuvre=2.0), "manoeuvre must be a function of time"),
        (lambda: Aircraft(manoeuvre=lambda t: (1.0, 2.0)), "three finite numbers"),
        (lambda: rows_of(Aircraft(), [1.0, 0.5]), "increase"),
        (lambda: rows_of(ConstantVelocity(q=1.0), [-1.0]), "at or after 0 s"),
        (lambda: rows_of(target_from_function(lambda t: [t, 0])), "3 \\(p\\)"),
    ],
)
def test_a_broken_target_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_target_that_jumps_is_refused():
    columns = {"t": [0.0, 0.5, 1.0], "x": [0.0, 1e9, 0.0], "y": [0.0] * 3, "z": [0.0] * 3}
    with pytest.raises(ValueError, match=r"moves at 2e\+09 m/s at t = 0 s; no target moves faster"):
        target_tracking_v0.parallel_env(target=columns, time_limit=1.0)
