"""The adjoints of the step and of the reward against central differences."""

import gymnasium as gym
import numpy as np
import pytest
from control_period import control_period

from baselines.training.flights import DifferentiableFlights
from quad_envs.dynamics import simulate
from quad_envs.envs.shared.adjoint import SCRATCH_ROWS, step_vjp
from quad_envs.envs.shared.task_vector import task_vector
from quad_envs.envs.tracking.adjoint import TrackingRecord, action_slopes, reward_vjp, tracking_vjp_rows
from quad_envs.lanes import COMMAND
from quad_envs.parameters import QuadrotorParams
from quad_envs.references import Heading, make_reference
from quad_envs.references.turning import with_turn_rates

STEP = 1e-6  # of the differences: their error is about 1e-9 for functions of order one
LIMITS = {
    "rate_limit": 12.0,
    "tilt_limit": 0.3,
    "velocity_limit": 0.6,
    "position_limit": ((-0.5, -1.0, -0.7), (1.0, 0.4, 0.8)),
}


def differences(function, x):
    """Gradient of a scalar per row of x (n, d), (n, d)."""
    return np.stack(
        [(function(x + STEP * e) - function(x - STEP * e)) / (2.0 * STEP) for e in np.eye(x.shape[1])], axis=1
    )


def random_plants(n=30, seed=0):
    rng = np.random.default_rng(seed)
    plants = 0.5 * rng.normal(size=(n, 16))
    plants[:, 12:] = 1.96 + 0.6 * rng.normal(size=(n, 4))
    return plants, 1.96 + 0.6 * rng.normal(size=(n, 4)), rng


@pytest.mark.parametrize("substeps", [1, 5])
@pytest.mark.parametrize("drag", [0.0, 0.3])
def test_the_adjoint_of_the_step_is_its_derivative(substeps, drag):
    plants, commands, rng = random_plants()
    bar, params = rng.normal(size=plants.shape), QuadrotorParams(drag=drag, inertia=(0.02, 0.024, 0.04))

    def value(x, u):
        return (simulate(x, u, params, substeps=substeps) * bar).sum(axis=1)

    bar_plant, bar_command = step_vjp(plants, commands, bar, params, substeps=substeps)
    assert np.allclose(bar_plant, differences(lambda x: value(x, commands), plants), atol=1e-7)
    assert np.allclose(bar_command, differences(lambda u: value(plants, u), commands), atol=1e-7)


@pytest.mark.parametrize("substeps", [1, 3])
def test_a_force_acts_through_the_attitude(substeps):
    plants, commands, rng = random_plants()
    task = gym.make("quad/HelixTracking-v0").unwrapped.task
    air = np.array([0.05, 0.05, 0.02, 2.0, 2.0, 2.0]) * rng.normal(size=(30, 2 * substeps + 1, 6))
    bar = rng.normal(size=plants.shape)

    def value(x, u):
        return (control_period(x, u, task, substeps, air)[-1] * bar).sum(axis=1)

    given = {"force_max": task.force_max, "duration": task.dt, "substeps": substeps}
    bar_plant, bar_command = step_vjp(plants, commands, bar, task.params, **given, disturbance=air)
    assert np.allclose(bar_plant, differences(lambda x: value(x, commands), plants), atol=1e-7)
    assert np.allclose(bar_command, differences(lambda u: value(plants, u), commands), atol=1e-7)
    calm, _ = step_vjp(plants, commands, bar, task.params, **given)
    assert np.abs(bar_plant - calm)[:, 6:9].max() > 1e-3  # what is left out without it
    assert not np.allclose(bar_plant, calm, atol=1e-5)


def test_a_vehicle_in_gusts_is_taken_back_as_it_flew():
    """Along its flight, the plants of the environment are those of the readable equations."""
    env = gym.make("quad/HelixTracking-v0", disturbance="varied-gusts", substeps=2)
    flights = DifferentiableFlights(env.unwrapped.options, 6, 0)
    rng = np.random.default_rng(0)
    for _ in range(20):
        record = flights.advance((0.1 * rng.normal(size=(6, 4))).astype(np.float32)).record
        flown = control_period(record.plants, record.commands, flights.task, 2, record.disturbances)[-1]
        assert np.allclose(flown, record.after, atol=1e-9)
    assert np.abs(record.disturbances).max() > 0.05


def test_a_saturated_command_has_no_influence():
    plants, commands, rng = random_plants(3)
    commands[0, 1], commands[1, 2] = -0.5, 9.0
    _, bar_command = step_vjp(plants, commands, rng.normal(size=plants.shape), QuadrotorParams())
    assert bar_command[0, 1] == 0.0 == bar_command[1, 2]
    assert np.count_nonzero(bar_command) == 10


def test_too_many_substeps_are_refused():
    with pytest.raises(ValueError, match="substeps must be 1 to 64"):
        step_vjp(np.zeros(16), np.zeros(4), np.zeros(16), QuadrotorParams(), substeps=65)


@pytest.mark.parametrize("limits", [{}, LIMITS])
def test_the_gradient_of_the_reward_is_its_derivative(limits):
    env = gym.make(
        "quad/HelixTracking-v0", Q=tuple(np.linspace(0.5, 2.0, 12)), R=(1.0, 2.0, 3.0, 4.0), **limits
    )
    task = task_vector(env.unwrapped.task, 5, 50.0)
    plants, commands, rng = random_plants(60)
    plants[:, :12] *= 0.7
    previous = commands + 0.8 * rng.normal(size=commands.shape)
    references, work = 0.5 * rng.normal(size=(60, 9)), np.zeros(20)
    bar_x, bar_u, bar_p = np.zeros((60, 12)), np.zeros((60, 4)), np.zeros((60, 4))

    def rewards(x, u, p):
        out, scrap = np.empty(len(x)), (np.zeros(12), np.zeros(4), np.zeros(4), work)
        for j in range(len(x)):
            out[j] = reward_vjp(x[j], references[j], u[j], p[j], task, 0.0, 0.0, *scrap)
        return out

    for j in range(60):
        arguments = plants[j], references[j], commands[j], previous[j], task, 1.0, 0.0
        reward_vjp(*arguments, bar_x[j], bar_u[j], bar_p[j], work)
    x = plants[:, :12]
    assert np.allclose(bar_x, differences(lambda y: rewards(y, commands, previous), x), atol=1e-7)
    assert np.allclose(bar_u, differences(lambda u: rewards(x, u, previous), commands), atol=1e-7)
    assert np.allclose(bar_p, differences(lambda p: rewards(x, commands, p), previous), atol=1e-7)
    assert bool(bar_p.any()) == bool(limits)


def test_the_reward_of_the_adjoint_is_that_of_the_environment():
    turning = Heading(make_reference("racetrack"), rate=0.6)
    env = gym.make_vec("quad/CorridorTracking-v0", num_envs=40, reference=turning)
    env.reset(seed=0)
    table = with_turn_rates(env.unwrapped.reference[0], env.unwrapped.task.dt)
    task, rng = task_vector(env.unwrapped.task, 5, 50.0), np.random.default_rng(0)
    scrap = np.zeros(12), np.zeros(4), np.zeros(4), np.zeros(20)
    previous = np.full((40, 4), env.unwrapped.task.hover_force)
    for k in range(1, 15):
        _, rewards, terminated, _, _ = env.step(rng.uniform(-0.2, 0.2, (40, 4)).astype(np.float32))
        commands, plants = env.unwrapped._batch.vehicles.read(COMMAND, 4), env.unwrapped.state
        for j in np.flatnonzero(~terminated):
            found = reward_vjp(plants[j], table[k], commands[j], previous[j], task, 0.0, 0.0, *scrap)
            # the environment rounds a product and its sum at once
            assert found == pytest.approx(rewards[j], rel=1e-12, abs=1e-14)
        previous = commands


def test_the_adjoint_of_a_step_with_its_reward_is_the_derivative_of_both():
    env = gym.make("quad/CorridorTracking-v0")
    task, params = task_vector(env.unwrapped.task, 5, 50.0), env.unwrapped.task.params
    force_max = env.unwrapped.task.force_max
    plants, commands, rng = random_plants(20)
    commands = np.clip(commands, 0.1, force_max - 0.1)
    previous, references = commands + 0.2 * rng.normal(size=(20, 4)), rng.normal(size=(20, 9))
    bars, bar_rewards = rng.normal(size=(20, 16)), rng.normal(size=20)
    scrap = np.zeros(12), np.zeros(4), np.zeros(4), np.zeros(20)

    def value(x, u, p):
        after = simulate(x, u, params, force_max=force_max)
        rewards = [reward_vjp(after[j], references[j], u[j], p[j], task, 0.0, 0.0, *scrap) for j in range(20)]
        return (after * bars).sum(axis=1) + bar_rewards * np.array(rewards)

    found = np.zeros((20, 16)), np.zeros((20, 4)), np.zeros((20, 4))
    record = TrackingRecord(
        plants, commands, previous, simulate(plants, commands, params, force_max=force_max), references,
        np.zeros(20, dtype=np.bool_), np.tile(force_max, (20, 1)), np.tile(params.coefficients(), (20, 1)),
        np.zeros((20, 11, 6)),
    )  # fmt: skip
    tracking_vjp_rows(record, task, bars, bar_rewards, 0.0, *found, np.zeros((SCRATCH_ROWS + 4, 16)))
    assert np.allclose(found[0], differences(lambda x: value(x, commands, previous), plants), atol=1e-6)
    assert np.allclose(found[1], differences(lambda u: value(plants, u, previous), commands), atol=1e-6)
    assert np.allclose(found[2], differences(lambda p: value(plants, commands, p), previous), atol=1e-6)


def test_the_gradient_of_the_cost_does_not_stop_where_the_reward_does():
    env = gym.make("quad/CorridorTracking-v0")
    task, row = task_vector(env.unwrapped.task, 5, 50.0), np.zeros(9)
    x, command, work = np.zeros(16), np.full(4, 1.96), np.zeros(20)
    x[0] = 2.5  # half a metre outside, five times the scale
    for bar, bar_cost, expected in ((1.0, 0.0, 0.0), (0.0, 1.0, 10.0)):
        bar_x = np.zeros(12)
        assert (
            reward_vjp(x, row, command, command, task, bar, bar_cost, bar_x, *np.zeros((2, 4)), work) == 0.0
        )
        assert np.allclose(bar_x, [expected, *[0.0] * 11])


def test_slopes_of_the_action_map_are_its_derivative():
    task = task_vector(gym.make("quad/HelixTracking-v0").unwrapped.task, 5, 50.0)
    slopes = np.zeros((1, 4))
    action_slopes(np.array([[-0.5, 0.5, 1.5, -1.5]], dtype=np.float32), task, slopes)
    assert np.allclose(slopes, [[1.96, 5.88, 0.0, 0.0]])
