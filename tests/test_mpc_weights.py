"""Weights of one's own in every MPC: the same as the task's, checked, and in the problem that is solved."""

import gymnasium as gym
import numpy as np
import pytest

import quad_envs  # noqa: F401
from baselines import evaluate, make_policy
from controllers import ExactNmpc, LinearMPC, SdcNmpc
from quad_envs.parameters import Weights
from quad_envs.tasks import Task

FLAVOURS = [LinearMPC, SdcNmpc, ExactNmpc]
Q = (10.0, 10.0, 10.0, 1.0, 1.0, 1.0, 0.5, 0.5, 0.5, 0.1, 0.1, 0.1)
PLANT = np.array([0.4, -0.3, 0.2, 0.5, 0.1, -0.2, 0.1, -0.15, 0.7, 0.2, 0.1, -0.3, 1.9, 2.0, 2.1, 1.95])


def decide(controller):
    window = np.zeros((1, controller.horizon + 1, 8))
    window[..., 7] = 1.0
    memory = np.zeros((1, controller.memory_size))
    return controller.decide(PLANT[None], window, np.full((1, 4), 1.96), np.zeros((1, 6)), memory)


def problem_of(controller):
    window = np.zeros((controller.horizon + 1, 8))
    window[:, 7] = 1.0
    return controller.problem(PLANT, window, np.full(4, 1.96), np.zeros(6), np.zeros(controller.memory_size))


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_weights_given_to_a_controller_act_as_those_of_its_task(flavour):
    own = decide(flavour(Task(), horizon=10, Q=Q, R=2.0)).command
    of_task = decide(flavour(Task(weights=Weights(Q=Q, R=(2.0,) * 4)), horizon=10)).command
    np.testing.assert_array_equal(own, of_task)
    assert np.abs(own - decide(flavour(Task(), horizon=10)).command).max() > 1e-3


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_a_number_a_diagonal_and_a_matrix_are_the_same_weight(flavour):
    forms = [dict(Q=3.0, R=0.5), dict(Q=[3.0] * 12, R=[0.5] * 4), dict(Q=3.0 * np.eye(12), R=0.5 * np.eye(4))]
    commands = [decide(flavour(Task(), horizon=10, **form)).command for form in forms]
    np.testing.assert_array_equal(commands[0], commands[1])
    np.testing.assert_array_equal(commands[0], commands[2])


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_coupled_weights_and_a_terminal_weight_of_ones_own_find_the_command_that_osqp_finds(flavour):
    """OSQP stops at residuals of 1e-5, which is some 1e-3 N in the first input."""
    coupled = np.diag(Q)
    coupled[2, 5] = coupled[5, 2] = 1.5
    options = dict(horizon=8, Q=coupled, R=np.eye(4) + 0.2, terminal=3.0)
    exact = decide(flavour(Task(), **options)).command
    np.testing.assert_allclose(
        decide(flavour(Task(), solver="osqp", **options)).command, exact, rtol=0.0, atol=1e-2
    )
    plain = decide(flavour(Task(), **{**options, "terminal": 1.0})).command
    assert np.abs(plain - exact).max() > 1e-3


@pytest.mark.parametrize("flavour", [LinearMPC, SdcNmpc])
def test_terminal_scales_p_or_stands_in_its_place(flavour):
    P = problem_of(flavour(Task(), horizon=5)).Q_f
    twice = problem_of(flavour(Task(), horizon=5, terminal=2.0))
    np.testing.assert_allclose(twice.Q_f, 2.0 * P, rtol=1e-14)
    assert not twice.stationary
    np.testing.assert_array_equal(problem_of(flavour(Task(), horizon=5, terminal=np.eye(12))).Q_f, np.eye(12))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"Q": (1.0, 2.0)}, r"Q must be a finite number, 12 of them"),
        ({"Q": np.nan}, r"Q must be a finite number"),
        ({"Q": "much"}, r"Q must be a finite number"),
        ({"Q": -1.0}, r"Q must be positive semidefinite, its smallest eigenvalue is -1"),
        ({"R": 0.0}, r"R must be positive definite, its smallest eigenvalue is 0"),
        ({"R": np.triu(np.ones((4, 4)))}, r"R must be symmetric"),
        ({"Q": np.diag([1.0, 2.0, *[1.0] * 10])}, r"equal weights on x and y.*use frame='hover'"),
        ({"terminal": -1.0}, r"terminal must be a finite factor >= 0 of P or a matrix"),
        ({"terminal": (1.0, 2.0)}, r"terminal must be a factor of P or a \(12, 12\) matrix"),
    ],
)
@pytest.mark.parametrize("flavour", FLAVOURS)
def test_a_weight_that_is_none_is_refused_by_name(flavour, options, said):
    with pytest.raises(ValueError, match=said):
        flavour(Task(), horizon=5, **options)


def test_another_terminal_weight_beside_the_one_of_the_present_pair_is_refused():
    with pytest.raises(ValueError, match="leave terminal out, or choose terminal_weight='hover'"):
        SdcNmpc(Task(), terminal_weight="sdre", terminal=2.0)


@pytest.mark.parametrize("name", ["lmpc", "sdc-nmpc", "nmpc"])
def test_policies_take_weights_by_name(name):
    env = gym.make("quad/RandomTracking-v0")
    close = evaluate(make_policy(name, env, Q=[10.0] * 3 + [1.0] * 9), env, episodes=2).records
    plain = evaluate(make_policy(name, env), env, episodes=2).records
    assert sum(r.position_rms for r in close) < sum(r.position_rms for r in plain)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lmpc", "sdc-nmpc", "nmpc"])
@pytest.mark.parametrize("tilt", [np.inf, 0.5])
def test_a_vehicle_outside_its_walls_comes_back(name, tilt):
    for outside in (0.5, 1.0, 2.0, 3.0):
        env = gym.make(
            "quad/Regulation-v0",
            position_limit=((-1.0,) * 3, (1.0,) * 3),
            start=(1.0 + outside, 0.0, 0.0),
            start_box=0.0,
            tilt_limit=tilt,
        )
        (record,) = evaluate(make_policy(name, env), env, episodes=1).records
        assert not record.crashed, outside
