"""What a team promises in crowds, in gusts and behind an aircraft, and what of its model that takes."""

from __future__ import annotations

import numpy as np
import pytest

from baselines import make_policy
from baselines.reproduction.meetings import meet
from controllers.team.collision import AvoidanceOptions, time_to_stop
from controllers.team.cooperative import CooperativeMpc
from controllers.team.cooperative_kernels import turning_velocity
from controllers.team.situation import TeamSituation
from quad_envs import formation_v0, target_tracking_v0
from quad_envs.rotations import rotation_body_from_inertial


def fly(env, policy, steps=None):
    """Smallest distances and crashes of all teams until each crashes, and positions, (steps, teams, n, 3)."""
    n = env.task.vehicles
    teams = env.num_envs // n
    observations, _ = env.reset(seed=0)
    state, gap, crashed, history = None, np.full(teams, np.inf), np.zeros(teams, dtype=bool), []
    i, j = np.triu_indices(n, 1)
    for _ in range(steps or env.task.episode_steps):
        actions, state = policy.predict(observations, state)
        p = env.plants[:, :3].reshape(teams, n, 3).copy()
        history.append(p)
        near = np.linalg.norm(p[:, i] - p[:, j], axis=-1).min(axis=1)
        gap = np.where(crashed, gap, np.minimum(gap, near))
        observations, _, terminated, _, _ = env.step(actions)
        crashed |= terminated.reshape(teams, n).any(axis=1)
    return gap, crashed, np.array(history)


def test_the_turned_velocity_is_the_derivative():
    rng = np.random.default_rng(0)
    for _ in range(20):
        x, D = rng.normal(size=12), np.empty((3, 3))
        x[6:9] *= [0.5, 0.5, 0.0]

        def inertial(Theta, V_B=x[3:6]):
            return rotation_body_from_inertial(Theta).T @ V_B

        h = 1e-6
        expected = [(inertial(x[6:9] + e) - inertial(x[6:9] - e)) / (2 * h) for e in h * np.eye(3)]
        for share in (1.0, 0.5):
            turning_velocity(x, share, D)
            np.testing.assert_allclose(D, share * np.transpose(expected), atol=1e-8)  # central differences


def plan_of_a_roll(turning, V_z=-1.8):
    """How far to the right a level vehicle that climbs at V_z expects to be, 0.2 s after it began to roll."""
    env = formation_v0.parallel_env(vehicles=2, start="sorted", reference="setpoint")
    controller = CooperativeMpc(env.task, turning=turning, avoidance="none", speed=3.0)
    layout, hover = env.task.layout, env.task.hover_force
    plant = np.zeros((1, 16))
    plant[0, 5], plant[0, 12:] = V_z, hover
    preview = np.zeros((1, layout.preview + 1, 8))
    preview[..., 1], preview[..., 5], preview[..., 7] = 1.0, V_z, 1.0
    comm = np.zeros((1, layout.neighbours, layout.comm_size))
    memory, sensed = np.zeros((1, controller.memory_size)), np.zeros((1, layout.sensed, 7))
    situation = TeamSituation(plant, np.full((1, 4), hover), comm, sensed, np.ones(1, bool), preview)
    qp = controller.problems(situation, memory)[0]
    roll = np.array([-1.0, -1.0, 1.0, 1.0]) * 0.3
    roll *= np.sign(qp.B[0][9] @ roll)  # a torque that rolls to the right
    x = np.zeros(12)
    x[5] = V_z
    for _ in range(4):
        x = qp.A[0] @ x + qp.B[0] @ roll + qp.c[0]
    return x[1]


def test_a_climbing_vehicle_that_rolls_plans_to_go_where_its_thrust_pushes_it():
    assert plan_of_a_roll(turning=True) > 0.0
    assert plan_of_a_roll(turning=False) < 0.0  # as the state-dependent model alone says


def test_the_braking_row_reaches_as_far_as_it_takes_to_stop():
    assert time_to_stop(2.0) == AvoidanceOptions().braking == 0.5
    assert time_to_stop(np.inf) == 0.5 and time_to_stop(4.0) == 1.0
    env = target_tracking_v0.parallel_env()
    assert make_policy("cooperative-mpc", env, speed=4.0).controller.options.braking == 1.0


@pytest.mark.parametrize(
    ("option", "value", "says"),
    [
        ("separation_margin", -0.1, "separation_margin must be finite and >= 0"),
        ("plan_tilt", 0.0, "plan_tilt"),
    ],
)
def test_what_a_plan_cannot_keep_is_refused(option, value, says):
    with pytest.raises(ValueError, match=says):
        make_policy("consensus-mpc", "quad/Formation-v0", **{option: value})


@pytest.mark.parametrize("alpha", [0.5, 1.0])
def test_twenty_vehicles_through_one_centre_keep_the_separation(alpha):
    assert meet({"alpha": alpha}, 1.0, vehicles=20, runs=8).gap.min() >= 0.40


def test_no_formation_crashes_in_gusts():
    env = formation_v0.vector_env(num_teams=50, formation="hexagon", disturbance="gusts")
    gap, crashed, _ = fly(env, make_policy("consensus-mpc", env), steps=200)  # they meet early
    assert not crashed.any() and gap.min() >= 0.39  # nobody knows of the gusts


def test_the_estimator_of_disturbances_brings_a_formation_to_its_slots_in_gusts():
    env = formation_v0.vector_env(num_teams=10, formation="hexagon", disturbance="gusts")
    errors = []
    for reject in (False, True):
        _, _, flown = fly(env, make_policy("consensus-mpc", env, reject_disturbance=reject))
        end = flown[-100:]
        slots = np.array(env.task.slots)
        errors.append(np.linalg.norm(end - end[:, :, :1] - slots, axis=-1)[:, :, 1:].mean())
    assert errors[1] < 0.6 * errors[0]


@pytest.mark.parametrize("speed", [2.0, 4.0])
def test_an_aircraft_is_followed_without_a_crash(speed):
    env = target_tracking_v0.vector_env(num_teams=20, target="aircraft")
    gap, crashed, flown = fly(env, make_policy("cooperative-mpc", env, q=0.4, speed=speed))
    assert not crashed.any() and gap.min() >= 0.40
    away = flown - env.targets[:, : len(flown), :3].transpose(1, 0, 2)[:, :, None] - np.array(env.task.slots)
    assert np.sqrt((away[-100:] ** 2).sum(axis=-1).mean()) < 1.0
