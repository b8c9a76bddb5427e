"""Where the rotors are, how they turn, how strong each is: plus and X frames, a limit per rotor."""

import gymnasium as gym
import numpy as np
import pytest

from baselines import evaluate, make_policy
from controllers import ExactNmpc, FeedbackLinearization, LinearMPC, Lqr, SdcNmpc, Sdre
from controllers.team.central import CentralMpc
from quad_envs.compilation.decorators import kernel
from quad_envs.dynamics import rotor_shares, simulate
from quad_envs.envs.shared.adjoint import step_vjp
from quad_envs.lanes import FORCE_MAX
from quad_envs.parameters import FRAMES, RATES, Limits, QuadrotorParams
from quad_envs.tasks import Task, TeamTask

UNEVEN = (0.5, 0.3, 1.5, 0.8)  # of the weight


@kernel
def _shares(alpha, c, out):
    shares = rotor_shares(alpha[0], alpha[1], alpha[2], c)
    for i in range(4):
        out[i] = shares[i]


@pytest.mark.parametrize("frame", FRAMES)
def test_torques_are_the_moments_of_forces_along_minus_z_at_the_rotors(frame):
    params, F = QuadrotorParams(frame=frame), np.array([2.5, 1.5, 2.2, 1.8])
    arms = np.pad(params.rotor_positions(), ((0, 0), (0, 1)))
    assert np.linalg.norm(arms, axis=1) == pytest.approx(np.full(4, params.arm))
    moment = np.cross(arms, np.stack([0 * F, 0 * F, -F], axis=1)).sum(axis=0)
    np.testing.assert_allclose(params.mixer()[1:3] @ F, moment[:2], atol=1e-15)
    # clockwise from above: seen along +z (down), from x (forward) to y (right)
    angles = np.unwrap(np.arctan2(arms[:, 1], arms[:, 0]))
    np.testing.assert_allclose(np.diff(angles), np.pi / 2)
    assert angles[0] == pytest.approx({"plus": 0.0, "x": np.pi / 4}[frame])


@pytest.mark.parametrize("frame", FRAMES)
def test_the_compiled_split_among_rotors_knows_the_frame(frame):
    rng = np.random.default_rng(0)
    params = QuadrotorParams(frame=frame, inertia=(0.02, 0.025, 0.04), drag=0.1)
    shares = np.empty(4)
    for _ in range(50):
        alpha = rng.normal(size=3)
        _shares(alpha, params.coefficients(), shares)
        wanted = np.linalg.solve(params.mixer(), np.r_[0.0, alpha * params.inertia])
        np.testing.assert_allclose(shares, wanted, atol=1e-12)


def test_the_adjoint_knows_the_frame_and_the_limit_of_each_rotor():
    rng, step = np.random.default_rng(1), 1e-6
    params = QuadrotorParams(frame="x", inertia=(0.02, 0.025, 0.04))
    force_max = np.array([2.5, 3.0, 3.5, 9.0])
    plant, bar = np.r_[0.4 * rng.normal(size=12), np.full(4, 2.0)], rng.normal(size=16)
    command = np.array([2.6, 2.9, 3.6, 8.0])  # rotors 1 and 3 beyond their own limits

    def value(u):
        return simulate(plant, u, params, force_max=force_max) @ bar

    found = step_vjp(plant, command, bar, params, force_max=force_max)[1]
    expected = [(value(command + h) - value(command - h)) / (2 * step) for h in step * np.eye(4)]
    np.testing.assert_allclose(found, expected, atol=1e-7)  # central differences are good to 1e-9
    assert found[0] == 0.0 == found[2] and found[1] != 0.0 != found[3]


def test_action_plus_one_is_each_rotors_own_maximum_and_the_plant_saturates_there():
    env = gym.make("quad/HelixTracking-v0", kappa=UNEVEN, rotor_rate=400.0, time_limit=0.1)
    env.reset(seed=0)
    for _ in range(2):
        observation, *_ = env.step(np.ones(4, np.float32))
    task = env.unwrapped.task
    np.testing.assert_allclose(task.force_max, np.array(UNEVEN) * 7.84)
    np.testing.assert_allclose(env.unwrapped.state[12:], task.force_max, rtol=1e-6)
    np.testing.assert_allclose(task.layout.decode(observation).last_command, task.force_max, rtol=1e-6)


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("make", [Lqr, Sdre, FeedbackLinearization, LinearMPC, SdcNmpc, ExactNmpc])
def test_every_law_keeps_to_the_limit_of_each_rotor_and_reaches_it(make, frame):
    params = QuadrotorParams(frame=frame)
    task = Task(params=params, limits=Limits(kappa=UNEVEN))
    law = make(task)
    n, rng = 40, np.random.default_rng(2)
    plants = np.zeros((n, 16))
    plants[:, :3], plants[:, 3:6] = rng.normal(0, 3, (n, 3)), rng.normal(0, 2, (n, 3))
    plants[:, 6:9], plants[:, 12:] = rng.normal(0, 0.5, (n, 3)), params.hover_force
    window = np.zeros((n, law.horizon + 1, 8))
    window[..., 7] = 1.0
    memory, last = np.zeros((n, law.memory_size)), np.full((n, 4), params.hover_force)
    command = law.decide(plants, window, last, np.zeros((n, 6)), memory).command
    assert (command >= 0.0).all() and (command <= task.force_max).all()
    reached = np.isclose(command, task.force_max, atol=1e-9).any(axis=0)
    assert reached[:2].all()  # the two weak ones are at their limits somewhere


@pytest.mark.parametrize("solver", ["structured", "osqp"])
def test_both_solvers_have_the_box_of_each_rotor(solver):
    task = Task(params=QuadrotorParams(frame="x"), limits=Limits(kappa=UNEVEN))
    law, plant, window = LinearMPC(task, horizon=10, solver=solver), np.zeros((1, 16)), np.zeros((1, 11, 8))
    plant[0, :3], plant[0, 12:], window[..., 7] = (2.0, -1.0, 4.0), 1.96, 1.0
    memory = np.zeros((1, law.memory_size))
    decision = law.decide(plant, window, np.full((1, 4), 1.96), np.zeros((1, 6)), memory)
    assert np.isclose(decision.command[0], task.force_max, atol=1e-2).sum() >= 2
    assert (decision.command <= task.force_max).all() and decision.fallback[0] == 0


def test_the_central_mpc_of_a_team_keeps_to_the_limit_of_each_rotor():
    task = TeamTask(vehicles=2, slots=((0.0, 0.0, 0.0), (2.0, 0.0, 0.0)), limits=Limits(kappa=UNEVEN))
    mpc = CentralMpc(task, horizon=5)
    plants = np.zeros((2, 16))
    plants[:, :3], plants[:, 12:] = [[0, 0, 6.0], [2, 0, 6.0]], 1.96
    rows = np.zeros((6, 8))
    rows[:, 7] = 1.0
    memory = np.zeros(mpc.memory_size)
    found = mpc.decide(plants, rows, np.array(task.slots), np.full((2, 4), 1.96), memory)
    assert (found.command <= task.force_max).all()
    assert np.isclose(found.command[:, 1], task.force_max[1], atol=1e-3).all()  # OSQP's accuracy


@pytest.mark.parametrize("policy", ["lmpc", "nmpc", "sdc-nmpc", "lqr", "sdre"])
def test_frames_fly_alike_and_a_weak_rotor_is_borne(policy):
    scores = {}
    for frame in FRAMES:
        env = gym.make("quad/Regulation-v0", frame=frame, kappa=UNEVEN, time_limit=5.0)
        found = evaluate(make_policy(policy, env), env, episodes=2, seed=0)
        assert not any(record.crashed for record in found.records)
        scores[frame] = np.mean([record.score for record in found.records])
    # The two frames differ in direction only: with the same four rotors, by the axis along which one is weak.
    assert scores["plus"] == pytest.approx(scores["x"], abs=0.05)


def test_a_turn_by_45_degrees_makes_an_x_frame_of_a_plus_frame():
    # Equal moments about x and y, so that the body has no preferred direction: the motion of the plus frame
    # seen in axes turned by -45 degrees is that of the x frame.
    turn = np.array([[1.0, 1.0, 0.0], [-1.0, 1.0, 0.0], [0.0, 0.0, np.sqrt(2.0)]]) / np.sqrt(2.0)
    F, plus, x = np.array([2.5, 1.5, 2.2, 1.8]), QuadrotorParams(), QuadrotorParams(frame="x")
    one, other = (params.input_matrix() @ F for params in (plus, x))
    np.testing.assert_allclose(other[RATES], turn.T @ one[RATES], atol=1e-12)


def test_randomized_rotors_keep_their_proportions():
    env = gym.make("quad/HelixTracking-v0", kappa=UNEVEN, randomize={"kappa": 0.15})
    env.reset(seed=0)
    found = env.unwrapped._batch.vehicles.read(FORCE_MAX, 4)[0] / env.unwrapped.task.force_max
    assert np.ptp(found) < 1e-15 and 0.85 < found[0] < 1.15 and found[0] != 1.0


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"kappa": (0.5, 0.2, 0.5, 0.5)}, r"got 0\.2 for rotor 2; hover needs m g / 4 of every rotor"),
        ({"kappa": (0.5, 0.6)}, "a number or 4 of them, one per rotor"),
        ({"kappa": 25.0}, r"in \(1/4, 20\], got 25"),
        ({"frame": "h"}, "frame must be one of 'plus', 'x', got 'h'"),
        ({"kappa": UNEVEN, "randomize": {"kappa": 0.3}}, "too weak to hover"),
    ],
)
def test_an_airframe_that_cannot_hover_is_refused_with_its_reason(kwargs, words):
    with pytest.raises(ValueError, match=words):
        gym.make("quad/HelixTracking-v0", **kwargs)
