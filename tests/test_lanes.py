"""Four vehicles side by side: lanes against readable equations, in vector instructions, on threads."""

import copy
import re

import gymnasium as gym
import llvmlite.binding as llvm
import numba
import numpy as np
import pytest
from control_period import control_period
from drawn import errors, gusts
from gymnasium.utils import seeding

from quad_envs import Gusts, Steady
from quad_envs.compilation.decorators import kernel
from quad_envs.compilation.intrinsics import _take_nearest, take_nearest
from quad_envs.compilation.normals import draw
from quad_envs.constraints import (
    TOLERANCE,
    constraint_scales,
    constraint_values,
    forces_from_actions,
)
from quad_envs.dynamics import (
    LARGEST,
    arrive,
    calm_substep,
    disturbed_substep,
)
from quad_envs.envs.shared.random_vehicles import drawn_vehicles, random_vehicles
from quad_envs.envs.shared.task_vector import task_vector
from quad_envs.envs.shared.vehicle_options import CRASH_TILT
from quad_envs.envs.tracking.kernel import command, judge
from quad_envs.lanes import COEFFICIENTS, DECAY, FORCE_MAX, LANES, N_FLIGHT, N_TRACKING, Blocks
from quad_envs.parameters import N_COEFFICIENTS, ROTOR_RATE
from quad_envs.references import Heading, Racetrack, RandomSmooth
from quad_envs.references.table_row import N_TABLE
from quad_envs.references.turning import tabulate, with_turn_rates
from quad_envs.reward import stage_cost

HELIX = "quad/HelixTracking-v0"
LIMITS = {
    "kappa": (0.5, 0.6, 0.7, 0.8),
    "frame": "x",
    "rate_limit": 20.0,
    "tilt_limit": 0.4,
    "velocity_limit": 2.0,
    "position_limit": ((-3.0, -3.0, -3.0), (3.0, 3.0, 3.0)),
}
AVX = llvm.get_host_cpu_features().get("avx2", False)
FORCE, TORQUE = (0.4, -0.3, 0.2), (0.002, -0.001, 0.001)


class Twin:
    """n flights of a task in readable equations."""

    def __init__(self, task, substeps, plants, force=(0.0, 0.0, 0.0), torque=(0.0, 0.0, 0.0)):
        self.task, self.substeps = task, substeps
        self.air = np.broadcast_to([*torque, *force], (1, 2 * substeps + 1, 6))  # at the stage times
        self.plants, self.command = plants.copy(), np.full((len(plants), 4), task.hover_force)

    def fly(self, commands):
        """Plants after a control period."""
        return control_period(self.plants, commands, self.task, self.substeps, self.air)[-1]

    def step(self, actions, row, lost):
        """Move, and judge against a row of the reference: reward, stage cost, cost, crashed."""
        task, previous = self.task, self.command
        self.command = forces_from_actions(actions, task.hover_force, task.force_max)
        with np.errstate(all="ignore"):
            moved = self.fly(self.command)
        finite = np.abs(moved).sum(axis=1) < LARGEST
        self.plants = np.where(finite[:, None], moved, self.plants)
        loss = stage_cost(self.plants, row, self.command, task.hover_force, task.weights)
        values = constraint_values(self.plants, self.command, previous, task.limits, task.dt)
        scales = constraint_scales(task.limits, task.dt)
        cost = np.where(values > TOLERANCE, values / scales, 0.0).sum(axis=1)
        off = np.linalg.norm(self.plants[:, :3] - row[:3], axis=1)
        crashed = ~finite | (np.abs(self.plants[:, 6:8]).max(axis=1) >= CRASH_TILT) | (off > lost)
        reward = np.where(crashed, 0.0, (1.0 - np.minimum(cost, 1.0)) / (1.0 + loss))
        return reward, loss, cost, crashed


@pytest.mark.parametrize("substeps", [1, 5])
@pytest.mark.parametrize("air", [None, Steady(force=FORCE, torque=TORQUE)], ids=["calm", "disturbed"])
def test_lanes_fly_as_the_readable_equations_over_random_episodes_with_crashes(air, substeps):
    n, lost = 4 * LANES + 3, 6.0
    env = gym.make_vec(
        HELIX,
        num_envs=n,
        autoreset_mode="Disabled",
        disturbance=air,
        substeps=substeps,
        lost_distance=lost,
        **LIMITS,
    )
    env.reset(seed=1)
    rng, crashes = np.random.default_rng(0), 0
    table = with_turn_rates(env.unwrapped.reference[0], env.unwrapped.task.dt)
    known = {} if air is None else {"force": FORCE, "torque": TORQUE}
    twin = Twin(env.unwrapped.task, substeps, env.unwrapped.state, **known)
    flying = np.ones(n, dtype=bool)
    for k in range(1, 120):
        actions = (rng.normal(size=(n, 4)) * (0.2 if k % 3 else 0.8)).astype(np.float32)
        expected = twin.step(actions, table[k], lost)
        _, reward, crashed, _, info = env.step(actions)
        found = reward, info["stage_cost"], info["cost"], crashed
        # sines turned by series: 1e-13 a step, which a tumbling vehicle amplifies
        for ours, theirs in zip(found, expected, strict=True):
            np.testing.assert_allclose(ours[flying], theirs[flying], rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(env.unwrapped.state[flying], twin.plants[flying], rtol=1e-8, atol=1e-9)
        crashes += int((crashed & flying).sum())
        flying &= ~crashed
    assert crashes > n // 3


def test_gusts_and_noise_in_lanes_are_the_readable_ones_over_random_episodes_with_crashes():
    n, steps, substeps, noise = LANES + 1, 40, 3, (0.01, 0.02, 0.005, 0.03)
    wind = Gusts(force=(0.3, 0.2, 0.4), torque=(0.01, 0.02, 0.001), correlation_time=0.4)
    options = {"disturbance": wind, "sensor_noise": noise, "substeps": substeps, "lost_distance": 6.0}
    options |= {"reveal_disturbance": True, "time_limit": steps * 0.05, **LIMITS}
    env = gym.make_vec(HELIX, num_envs=n, **options)
    observations, _ = env.reset(seed=1)
    task, keep = env.unwrapped.task, np.exp(-0.05 / (2 * substeps) / 0.4)
    layout, table = task.layout, with_turn_rates(env.unwrapped.reference[0], task.dt)
    generators = [seeding.np_random(1 + i)[0] for i in range(n)]
    air, keys, twins = [None] * n, [0] * n, [None] * n
    rng, since, crashes, begins = np.random.default_rng(0), np.zeros(n, int), 0, np.ones(n, bool)
    (down, late), rewards, actions = np.zeros((2, n), bool), np.zeros(n), np.zeros((n, 4))
    for _ in range(90):
        for i in range(n):
            if begins[i]:
                generators[i].random(12)
                keys[i] = int(generators[i].random() * 2.0**53)
                air[i] = gusts(keys[i], steps, 2 * substeps + 1, keep, wind.size())
                twins[i], since[i] = Twin(task, substeps, env.unwrapped.state[i : i + 1]), 0
            else:
                twins[i].air = air[i][since[i]][None]
                since[i] += 1
                reward, _, _, crashed = twins[i].step(actions[i : i + 1], table[since[i]], 6.0)
                assert reward[0] == pytest.approx(rewards[i], rel=1e-8, abs=1e-10) and crashed[0] == down[i]
                crashes += int(crashed[0])
            seen = layout.decode(observations[i])
            told = twins[i].plants[0, :12] + errors(keys[i], since[i], noise)
            np.testing.assert_allclose(seen.V_B, told[3:6], rtol=1e-6, atol=1e-6)
            np.testing.assert_allclose(seen.Omega, told[9:], rtol=1e-6, atol=1e-6)
            np.testing.assert_allclose(seen.position, told[:3], rtol=1e-6, atol=1e-6)
            ahead = air[i][since[i], substeps] if since[i] < steps else np.zeros(6)
            np.testing.assert_allclose([*seen.torque, *seen.force], ahead, rtol=1e-6, atol=1e-9)
        actions = rng.uniform(-0.6, 0.6, (n, 4)).astype(np.float32)
        begins = down | late
        observations, rewards, down, late, _ = env.step(actions)
    assert crashes > n


def instructions(compiled, *arguments):
    """Packed and scalar arithmetic on doubles in the machine code of a kernel, compiled anew."""
    anew = numba.jit(**compiled.entry.targetoptions)(compiled.py_func)
    anew(*arguments)
    (code,) = anew.inspect_asm().values()
    operations = r"\bv(?:fn?m(?:add|sub)\w*|add|sub|mul|div|min|max|round|rndscale)"
    return len(re.findall(operations + r"pd\b", code)), len(re.findall(operations + r"sd\b", code))


@pytest.mark.skipif(not AVX, reason="the count is of x86-64 with AVX2")
@pytest.mark.parametrize(
    ("compiled", "rest", "packed"),
    [
        (calm_substep, (0.01,), 400),
        (disturbed_substep, (0.01,), 450),
        (arrive, (), 15),
        (command, "task", 20),
        (judge, "task", 100),
        (draw, "numbers", 80),
    ],
)
def test_loops_over_lanes_are_vector_instructions(compiled, rest, packed):
    task = task_vector(gym.make(HELIX).unwrapped.task, 5, 50.0)
    w = np.zeros(N_FLIGHT if rest != "task" else N_TRACKING)
    given = {"task": (w, task), "numbers": (1, 2, 3, np.zeros(64))}.get(rest, (w, *rest))
    vector, scalar = instructions(compiled, *given)
    assert vector >= packed
    assert scalar <= (vector if rest == "numbers" else vector // 2)  # numbers: of a rest below four


@pytest.mark.parametrize("threads", [2, 3, 64])
def test_rows_do_not_depend_on_the_number_of_threads(threads):
    n = 6 * LANES + 1
    options = {
        "num_envs": n,
        "randomize": 0.1,
        "sensor_noise": 0.01,
        "disturbance": "gusts",
        "time_limit": 1.0,
    }
    one, many = (gym.make_vec(HELIX, **options, threads=count) for count in (1, threads))
    many = copy.deepcopy(many)
    rng = np.random.default_rng(0)
    for first, second in zip(one.reset(seed=3), many.reset(seed=3), strict=True):
        np.testing.assert_equal(first, second)
    for _ in range(45):
        actions = rng.uniform(-0.5, 0.5, (n, 4)).astype(np.float32)
        for first, second in zip(one.step(actions), many.step(actions), strict=True):
            np.testing.assert_equal(first, second)


def test_an_action_that_is_no_number_moves_no_row_on_any_thread():
    env = gym.make_vec(HELIX, num_envs=4 * LANES, threads=2)
    env.reset(seed=0)
    before, actions = env.unwrapped.state, np.zeros((4 * LANES, 4), np.float32)
    actions[-1, 2] = np.nan
    with pytest.raises(ValueError, match=r"action\[15, 2\] is nan"):
        env.step(actions)
    assert np.array_equal(env.unwrapped.state, before)


@pytest.mark.parametrize("threads", [0, 1.5, True])
def test_a_number_of_threads_that_is_none_is_refused(threads):
    with pytest.raises(ValueError, match="threads"):
        gym.make_vec(HELIX, num_envs=2, threads=threads)


def test_one_flight_has_no_threads_to_choose():
    with pytest.raises(TypeError, match=r"threads.*make_vec"):
        gym.make(HELIX, threads=2)


def test_blocks_read_what_was_written():
    vehicles = Blocks(LANES + 2, N_FLIGHT)
    vehicles.write(3 * LANES, np.array([1.0, 2.0]))
    vehicles.write(3 * LANES, np.array([5.0, 6.0]), LANES + 1)
    assert vehicles.read(3 * LANES, 2).tolist() == [[1.0, 2.0]] * (LANES + 1) + [[5.0, 6.0]]
    assert vehicles.read(4 * LANES).tolist() == [2.0] * (LANES + 1) + [6.0]


@kernel
def _nearest(places, n):
    for at in range(0, places.size, 4 * LANES):
        take_nearest(places, at, min(LANES, n - at // 4))


@pytest.mark.parametrize("n", [1, 3, 4, 6, 13])
def test_places_take_the_squared_distance_of_the_nearest_other_one(n):
    count = -(-n // LANES) * LANES
    points = np.full((count, 4), 1e9)  # behind the last one nobody is near
    points[:n, :3] = np.random.default_rng(0).normal(size=(n, 3))
    points[n // 2, 1] = np.nan if n > 4 else points[n // 2, 1]  # who is nowhere is near nobody
    points[:, 3] = np.inf
    squares = ((points[:n, None, :3] - points[:n, :3]) ** 2).sum(axis=2)
    squares[np.arange(n), np.arange(n)] = np.inf
    expected = np.fmin.reduce(squares, axis=1)
    places = np.ascontiguousarray(points.reshape(-1, LANES, 4).transpose(0, 2, 1)).ravel()
    before = places.copy()
    _nearest(places, n)
    after = places.reshape(-1, 4, LANES)
    assert np.array_equal(after[:, :3], before.reshape(-1, 4, LANES)[:, :3], equal_nan=True)
    found = after[:, 3].ravel()[:n]
    known = np.isfinite(points[:n, :3]).all(axis=1) & np.isfinite(expected)
    np.testing.assert_allclose(found[known], expected[known], rtol=1e-15)
    assert (found[~known] > 1e17).all()
    twin = before.copy()
    for at in range(0, twin.size, 4 * LANES):
        _take_nearest(twin, at, min(LANES, n - at // 4))
    np.testing.assert_allclose(places, twin, rtol=1e-15)


@pytest.mark.parametrize("group", [11, 3])
@pytest.mark.parametrize("randomize", [0.2, {"inertia": 0.9, "kappa": 0.1}, {"drag": 0.3, "mass": 0.2}])
def test_random_vehicles_in_lanes_are_those_of_the_readable_twin(group, randomize):
    options = gym.make(HELIX, randomize=randomize, drag=0.1, kappa=(0.5, 0.6, 0.7, 0.8), frame="x").unwrapped
    task, spreads = options.task, options.options.randomization()
    vehicles, chosen = Blocks(4 * group, N_FLIGHT, group), np.array([0, 7, 2, 4 * group - 1])
    drawn = random_vehicles(task, spreads)
    uniform = np.random.default_rng(0).random((4, drawn.columns.size))
    drawn.place(uniform, chosen, vehicles, 0.01)
    coefficients, most = drawn_vehicles(task, spreads, uniform)
    np.testing.assert_allclose(vehicles.read(COEFFICIENTS, N_COEFFICIENTS)[chosen], coefficients, rtol=1e-14)
    np.testing.assert_allclose(vehicles.read(FORCE_MAX, 4)[chosen], most, rtol=1e-15)
    decay = np.exp(-0.005 * coefficients[:, ROTOR_RATE])
    np.testing.assert_allclose(vehicles.read(DECAY)[chosen], decay, rtol=1e-15)
    others = np.setdiff1d(np.arange(4 * group), chosen)
    assert not vehicles.read(COEFFICIENTS, N_COEFFICIENTS)[others].any()


@pytest.mark.parametrize(
    "times", [np.linspace(0.0, 12.0, 241), np.geomspace(0.1, 9.0, 50), np.arange(3.0), np.zeros(1)]
)
def test_a_random_reference_is_the_sum_of_its_sines(times):
    reference = RandomSmooth(harmonics=4)
    rows = reference.rows(times, np.random.default_rng(5))
    draws = np.random.default_rng(5).random((3, 3, 4))
    amplitude = draws[0] / draws[0].sum(axis=1, keepdims=True) * np.array(reference.amplitude)[:, None]
    rate = reference.rate_min + (reference.rate_max - reference.rate_min) * draws[1]
    phase = 2.0 * np.pi * draws[2]
    angle = times[:, None, None] * rate + phase
    position = (amplitude * (np.sin(angle) - np.sin(phase))).sum(axis=2)
    # where steps are equal angles are doubled, here six times, each with a rounding or two
    np.testing.assert_allclose(rows[:, :3], position, atol=2e-14)
    np.testing.assert_allclose(rows[:, 3:6], (amplitude * rate * np.cos(angle)).sum(axis=2), atol=2e-14)
    assert (rows[:, 6:] == [0.0, 1.0]).all()


def test_tables_of_flights_that_begin_are_those_of_their_reference():
    env = gym.make_vec("quad/RandomTracking-v0", num_envs=LANES + 2, randomize=0.1)
    observations, _ = env.reset(seed=3)
    unwrapped, start = env.unwrapped, env.unwrapped.task.layout.preview_start
    times = 0.05 * np.arange(unwrapped.reference.shape[1])
    for i, reference in enumerate(unwrapped.reference):
        rng = seeding.np_random(3 + i)[0]
        rng.random(12 + 7)  # start, and mass, inertia, arm, kappa and rotor rate
        expected = RandomSmooth().rows(times, rng)
        np.testing.assert_array_equal(reference, expected)
        expected[:, :3] -= unwrapped.state[i, :3]
        window = expected[:26].astype(np.float32)
        np.testing.assert_array_equal(observations[i, start:].reshape(26, 8), window)


def test_a_table_of_references_is_that_of_the_readable_twin():
    times = np.linspace(0.0, 10.0, 201)
    for reference in (Heading(Racetrack(), tangent=True), Heading(Racetrack(), rate=3.0), RandomSmooth()):
        rows = reference.rows(times, np.random.default_rng(0))
        table = np.empty((201, N_TABLE))
        assert tabulate(rows, 0.05, 100.0, table)
        np.testing.assert_allclose(table, with_turn_rates(rows, 0.05), rtol=1e-12, atol=1e-12)
        rows[7, 3] = np.inf
        assert not tabulate(rows, 0.05, 100.0, table)
