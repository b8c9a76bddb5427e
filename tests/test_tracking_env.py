"""The single tracking environment: reward, limits, observation, disturbances, reset and bad input."""

import math
import pickle

import gymnasium as gym
import numpy as np
import pytest
from processes import printed_compiled_and_plain

import quad_envs
from quad_envs import formation_v0
from quad_envs.constraints import TOLERANCE, constraint_scales, constraint_values, forces_from_actions
from quad_envs.dynamics import derivative_reference, simulate
from quad_envs.reward import stage_cost

HELIX = "quad/HelixTracking-v0"
LIMITS = {
    "kappa": 0.3125,
    "rate_limit": 5.0,
    "tilt_limit": 0.2,
    "velocity_limit": 1.0,
    "position_limit": ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)),
}


def make(**kwargs):
    return gym.make(HELIX, **kwargs)


def flight(env, steps=60, seed=0, scale=0.3):
    """Observations, rewards, infos, states and actions of a flight with random actions."""
    rng = np.random.default_rng(seed)
    observation, info = env.reset(seed=seed)
    out = [(observation, None, info, env.unwrapped.state, None)]
    for _ in range(steps):
        action = rng.uniform(-scale, scale, 4).astype(np.float32)
        observation, reward, terminated, truncated, info = env.step(action)
        out.append((observation, reward, info, env.unwrapped.state, action))
        if terminated or truncated:
            break
    return out


def test_the_step_is_the_plant_held_over_the_control_period():
    env = make()
    before = None
    for _, _, _, state, action in flight(env, 20):
        if before is not None:
            command = forces_from_actions(
                action, env.unwrapped.task.hover_force, env.unwrapped.task.force_max
            )
            assert np.array_equal(state, simulate(before, command, env.unwrapped.task.params))
        before = state


def test_reward_and_stage_cost_are_the_readable_formulas():
    env = make(**LIMITS, Q=tuple(np.linspace(0.5, 2.0, 12)), R=(1.0, 2.0, 3.0, 4.0))
    task, reference = env.unwrapped.task, env.unwrapped.reference
    previous = np.full(4, 1.96)
    violated = 0
    for k, (_, reward, info, state, action) in enumerate(flight(env)):
        command = (
            previous if action is None else forces_from_actions(action, task.hover_force, task.force_max)
        )
        cost = stage_cost(state, reference[k], command, task.hover_force, task.weights)
        values = constraint_values(state, command, previous, task.limits, task.dt)
        hinge = np.where(values > TOLERANCE, values, 0.0) / constraint_scales(task.limits, task.dt)
        assert info["stage_cost"] == pytest.approx(cost, rel=1e-10)
        np.testing.assert_allclose(info["constraint_values"], values, atol=1e-9)
        assert info["cost"] == pytest.approx(hinge.sum(), abs=1e-7)
        if reward is not None and not info["crashed"]:
            assert reward == pytest.approx((1 - min(1.0, hinge.sum())) / (1 + cost), abs=1e-7)
        violated += info["constraint_violation"]
        previous = command
    assert violated > 5


def test_episode_cost_is_the_running_sum_of_cost():
    infos = [info for _, _, info, _, _ in flight(make(**LIMITS))]
    costs = [0.0, *(info["cost"] for info in infos[1:])]  # of the steps, not of the start
    np.testing.assert_allclose([info["episode_cost"] for info in infos], np.cumsum(costs))


def test_constraint_rows_are_named_and_present_only_where_limited():
    assert make().unwrapped.task.constraint_names == ()
    assert make(**LIMITS).unwrapped.task.constraint_names == ("tilt", "velocity", "position", "rate")
    assert make(rate_limit=5.0).unwrapped.task.constraint_names == ("rate",)


def test_info_has_the_same_keys_at_reset_and_at_every_step():
    keys = {frozenset(info) for _, _, info, _, _ in flight(make(**LIMITS))}
    assert len(keys) == 1


def test_observation_decodes_to_the_state_and_the_reference():
    env = make(position_limit=((-9.0,) * 3, (9.0,) * 3))
    layout, reference = env.unwrapped.task.layout, env.unwrapped.reference
    for k, (observation, _, _, state, action) in enumerate(flight(env, 30)):
        view = layout.decode(observation)
        own = np.concatenate([view.position, view.V_B, view.Theta, view.Omega, view.F])
        np.testing.assert_allclose(own, state, rtol=1e-6, atol=1e-6)
        window = reference[k : k + 26].copy()
        window[:, :3] -= state[:3]
        np.testing.assert_allclose(view.preview, window, rtol=1e-6, atol=1e-6)
        if action is not None:
            np.testing.assert_allclose(view.last_command, forces_from_actions(action, 1.96, 7.84), rtol=1e-6)


def test_slices_cover_the_observation_without_overlap():
    layout = make(position_limit=((-9.0,) * 3, (9.0,) * 3), reveal_disturbance=True).unwrapped.task.layout
    parts = [s for name, s in layout.slices.items() if name != "own"]
    covered = np.concatenate([np.arange(s.start, s.stop) for s in parts])
    assert np.array_equal(covered, np.arange(layout.size))


def test_revealed_disturbance_is_the_one_that_acts():
    env = make(
        disturbance=quad_envs.Steady(force=(0.5, 0.0, -0.2), torque=(0.01, 0.02, 0.0)),
        reveal_disturbance=True,
        start_box=0.0,
    )
    observation, _ = env.reset(seed=0)
    view = env.unwrapped.task.layout.decode(observation)
    np.testing.assert_allclose([*view.torque, *view.force], [0.01, 0.02, 0, 0.5, 0, -0.2], rtol=1e-6)
    before = env.unwrapped.state
    env.step(np.zeros(4, np.float32))
    rate = derivative_reference(before[:12], before[12:], env.unwrapped.task.params, view.torque, view.force)
    after = env.unwrapped.state
    # first order in dt = 0.05 s
    np.testing.assert_allclose((after - before)[3:6] / 0.05, rate[3:6], atol=0.05)
    np.testing.assert_allclose((after - before)[9:11] / 0.05, rate[9:11], atol=1e-6)


def test_a_disturbance_pulse_moves_the_vehicle_only_while_it_acts():
    env = make(disturbance="torque-pulse", reference="setpoint", start_box=0.0)
    env.reset(seed=0)
    hover = np.zeros(4, np.float32)
    for _ in range(100):
        env.step(hover)
    np.testing.assert_allclose(env.unwrapped.state[:12], 0.0, atol=1e-12)
    env.step(hover)
    assert np.abs(env.unwrapped.state[9:11]).max() > 0.1


def test_sensor_noise_has_its_deviations_and_leaves_the_plant_alone():
    deviations = (0.1, 0.2, 0.01, 0.02)
    noisy, clean = flight(make(sensor_noise=deviations), 199, scale=0.0), flight(make(), 199, scale=0.0)
    layout = make().unwrapped.task.layout
    assert all(np.array_equal(a[3], b[3]) for a, b in zip(noisy, clean, strict=True))
    error = [layout.decode(a[0]).V_B - layout.decode(b[0]).V_B for a, b in zip(noisy, clean, strict=True)]
    # 600 samples: the deviation is known to 3 %; five of those
    assert np.std(error) == pytest.approx(0.2, rel=0.15)
    error = [
        layout.decode(a[0]).preview[0, :3] - layout.decode(b[0]).preview[0, :3]
        for a, b in zip(noisy, clean, strict=True)
    ]
    assert np.std(error) == pytest.approx(0.1, rel=0.15)


def test_randomized_vehicles_differ_within_their_spread_and_the_task_keeps_the_nominal_one():
    env = make(randomize={"mass": 0.2}, start_box=0.0)
    falls = set()
    for seed in range(20):
        env.reset(seed=seed)
        env.step(np.full(4, -1.0, np.float32))
        env.reset(seed=seed)
        for _ in range(5):
            env.step(np.zeros(4, np.float32))
        velocity = env.unwrapped.state[5]
        falls.add(round(velocity, 9))
        # hover thrust of the nominal vehicle on another mass: g (1 - m / m_true) over 0.25 s
        assert 9.8 * (1 - 1 / 0.8) * 0.26 < velocity < 9.8 * (1 - 1 / 1.2) * 0.26
    assert len(falls) == 20 and env.unwrapped.task.params.mass == 0.8


def test_zero_thrust_falls_out_of_range_and_a_crash_gives_no_reward():
    env = make(start_box=0.0, time_limit=60.0, lost_distance=10.0)
    env.reset(seed=0)
    for _ in range(1200):
        _, reward, terminated, truncated, info = env.step(np.full(4, -1.0, np.float32))
        if terminated:
            break
    assert terminated and not truncated and info["crashed"] and reward == 0.0


def test_flipping_over_is_a_crash_and_the_observation_stays_finite():
    env = make(start_box=0.0)
    env.reset(seed=0)
    for _ in range(200):
        observation, reward, terminated, _, info = env.step(np.array([0, 1, 0, -1], np.float32))
        assert np.isfinite(observation).all() and math.isfinite(reward)
        if terminated:
            break
    assert terminated and info["crashed"]


def test_episode_is_truncated_at_the_time_limit():
    env = make(time_limit=1.0)
    env.reset(seed=0)
    ends = [env.step(np.zeros(4, np.float32))[2:4] for _ in range(20)]
    assert ends == [(False, False)] * 19 + [(False, True)]


def test_a_step_after_the_end_flies_on_and_judges_the_present_state_alone():
    env = make(time_limit=0.1)
    env.reset(seed=0)
    ends = [env.step(np.zeros(4, np.float32))[2:4] for _ in range(4)]
    assert ends == [(False, False), *[(False, True)] * 3]
    env = make(start_box=0.0, lost_distance=3.0, start="reference", reference=(0.0, 0.0, 0.0))
    env.reset(seed=0, options={"state": [0, 0, -2.9, 0, 0, -1, 0, 0, 0, 0, 0, 0]})
    steps = [env.step(np.full(4, -0.5, np.float32)) for _ in range(40)]
    crashed = [terminated for _, _, terminated, _, _ in steps]
    first = crashed.index(True)
    assert not all(crashed[first:])  # it comes back
    for _, reward, terminated, _, info in steps:
        assert (reward == 0.0) == terminated == info["crashed"]


def test_a_state_can_be_given_at_reset():
    env = make()
    state = np.arange(12) / 20
    env.reset(seed=0, options={"state": state})
    assert np.array_equal(env.unwrapped.state[:12], state)


@pytest.mark.parametrize(
    "options",
    [{"state": np.zeros(5)}, {"state": np.full(12, np.nan)}, {"start": 1}, {"state": np.full(12, 1.5)}],
)
def test_bad_reset_options_are_refused(options):
    with pytest.raises(ValueError, match="reset option"):
        make().reset(options=options)


def test_same_seed_and_actions_give_the_same_flight_also_after_pickling():
    env = make(randomize=0.1, sensor_noise=0.01, disturbance="gusts", reference="random")
    copy = pickle.loads(pickle.dumps(env.unwrapped))
    for one, other in zip(flight(env), flight(copy), strict=True):
        assert np.array_equal(one[0], other[0]) and one[1] == other[1]


def test_a_pickle_in_mid_flight_continues_the_same_flight():
    env = make().unwrapped
    flight(env, 10)
    copy = pickle.loads(pickle.dumps(env))
    action = np.array([0.1, 0.0, -0.1, 0.2], np.float32)
    for _ in range(10):
        assert np.array_equal(env.step(action)[0], copy.step(action)[0])


@pytest.mark.parametrize("index", range(4))
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_non_finite_action_is_named_and_moves_nothing(index, value):
    env = make().unwrapped
    env.reset(seed=0)
    before = env.state
    action = np.zeros(4, np.float32)
    action[index] = value
    with pytest.raises(ValueError, match=rf"action\[{index}\]"):
        env.step(action)
    assert np.array_equal(env.state, before)


@pytest.mark.parametrize("shape", [(3,), (1, 4), (), (4, 1)])
def test_an_action_of_another_shape_is_refused(shape):
    env = make().unwrapped
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"shape \(4,\)"):
        env.step(np.zeros(shape, np.float32))


def test_an_action_out_of_range_is_clipped_and_counted():
    env, clipped = make().unwrapped, make().unwrapped
    env.reset(seed=0)
    clipped.reset(seed=0)
    observation, *_, info = env.step(np.array([2.0, -3.0, 0.5, 1.0], np.float32))
    assert info["clipped_actions"] == 2
    assert np.array_equal(observation, clipped.step(np.array([1.0, -1.0, 0.5, 1.0], np.float32))[0])


def test_quadratic_reward_is_minus_cost_and_penalty():
    env = make(reward="quadratic", **LIMITS)
    for _, reward, info, _, _ in flight(env)[1:]:
        assert reward == pytest.approx(-info["stage_cost"] - min(1.0, info["cost"]))


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"kapa": 0.5}, TypeError, "unexpected keyword argument 'kapa' of .*did you mean 'kappa'"),
        ({"kappa": 0.2}, ValueError, "kappa"),
        ({"kappa": "abc"}, ValueError, "kappa must be a number or 4 of them, one per rotor, got 'abc'"),
        ({"dt": -1.0}, ValueError, "dt"),
        ({"substeps": 0}, ValueError, "substeps"),
        ({"preview": 2.5}, ValueError, "preview"),
        ({"time_limit": 0.01}, ValueError, "time_limit"),
        ({"time_limit": 0.07}, ValueError, "whole control periods"),
        ({"time_limit": 1e12}, ValueError, "time_limit"),
        ({"position_limit": 3}, ValueError, "position_limit must be None or"),
        ({"inertia": 5}, ValueError, "inertia must be three numbers"),
        ({"inertia": ("a", 1, 2)}, ValueError, "inertia must be three numbers"),
        ({"start": 1.0}, ValueError, "start must be 3"),
        ({"start_box": (0.0,) * 6 + (2.0,) + (0.0,) * 5}, ValueError, "start roll and pitch"),
        ({"reveal_disturbance": "no"}, ValueError, "reveal_disturbance"),
        ({"randomize": {"mass": 0.3}, "kappa": 0.3125}, ValueError, "too weak to hover"),
        ({"reward": "sparse"}, ValueError, "reward"),
        ({"start": (1.0, 2.0)}, ValueError, "start"),
        ({"start": (0.0,) * 6 + (1.5,) + (0.0,) * 5}, ValueError, "start roll"),
        ({"start_box": -1.0}, ValueError, "start_box"),
        ({"sensor_noise": -0.1}, ValueError, "sensor_noise"),
        ({"randomize": {"weight": 0.1}}, ValueError, "randomize"),
        ({"randomize": {"drag": 0.1}}, ValueError, "drag"),
        ({"randomize": 1.5}, ValueError, "spread"),
        ({"randomize": 0.5, "kappa": 0.3}, ValueError, "too weak to hover"),
        ({"position_limit": ((1.0,) * 3, (0.0,) * 3)}, ValueError, "position limit"),
        ({"reference": "circle"}, ValueError, "reference"),
        ({"disturbance": "wind"}, ValueError, "disturbance"),
        ({"Q": (1.0, 2.0)}, ValueError, "Q"),
        ({"R": 0.0}, ValueError, "R"),
        ({"render_mode": "ansi"}, ValueError, "render_mode"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*render_mode.*")
def test_a_bad_argument_is_refused_when_the_environment_is_made(kwargs, error, message):
    with pytest.raises(error, match=message):
        make(**kwargs)


GOLDEN_ACTION = np.array([0.01, -0.005, 0.008, -0.002], np.float32)


def test_golden_numbers_of_a_flight_of_a_random_vehicle():
    """Ids carry a version: it rises when a seed and an action sequence give other numbers than these."""
    env = gym.make("quad/RandomTracking-v0", randomize=0.1, tilt_limit=0.02)
    env.reset(seed=0)
    steps = [env.step(GOLDEN_ACTION) for _ in range(15)]
    state = [
        *(0.26419822633220014, -0.4548105269113845, -0.7627089555708026),
        *(-0.06299930977805779, 0.03626736706939997, 0.410645295629612),
        *(0.013626142497468026, 0.023639827549585737, -0.0015379844198486101),
    ]
    # Libraries differ by a few ulps in sine and exponential; 15 steps amplify that below 1e-9.
    np.testing.assert_allclose(env.unwrapped.state[:9], state, rtol=1e-9)
    np.testing.assert_allclose(steps[-1][0][:3], state[3:6], rtol=1e-6)
    assert sum(step[1] for step in steps) == pytest.approx(2.6886220208752913, rel=1e-8)
    assert steps[-1][4]["stage_cost"] == pytest.approx(4.8418344505037165, rel=1e-8)


def test_golden_numbers_of_a_flight_with_everything_random():
    """Gusts and noise follow from a key that the seed gives; logarithms and sines are exact to 1e-10."""
    gusts = quad_envs.Gusts(force=0.5, torque=0.02)  # more than the vehicle can hold
    with pytest.warns(UserWarning, match="force along x, 0.5 N .* exceeds"):
        env = gym.make(
            "quad/RandomTracking-v0", disturbance=gusts, randomize=0.1, sensor_noise=0.01, tilt_limit=0.02
        )
    env.reset(seed=0)
    steps = [env.step(GOLDEN_ACTION) for _ in range(15)]
    state = [
        *(0.29181716423791404, -0.45295829452437586, -0.6365557246495575),
        *(-0.33896883170976533, 0.027324552622890224, 0.7656247327086235),
        *(-0.04192088931349874, 0.1841885278047837, -0.1631531361417672),
    ]
    np.testing.assert_allclose(env.unwrapped.state[:9], state, rtol=1e-8)
    np.testing.assert_allclose(steps[-1][0][:3], [-0.32886496, 0.01553419, 0.79375792], rtol=1e-6)
    assert sum(step[1] for step in steps) == pytest.approx(1.6511983215844996, rel=1e-8)
    assert steps[-1][4]["stage_cost"] == pytest.approx(6.433420430983268, rel=1e-8)


def test_steps_past_the_time_limit_see_the_last_window_and_nothing_else():
    env = make(time_limit=0.5, preview=3, lost_distance=1e6).unwrapped
    env.reset(seed=0)
    rows = env.task.layout.slices["preview"]
    for _ in range(30):
        observation = env.step(np.zeros(4, np.float32))[0]
    window = observation[rows].reshape(4, 8)
    expected = env.reference[-4:].copy()
    expected[:, :3] -= env.state[:3]
    np.testing.assert_allclose(window, expected, rtol=1e-5, atol=1e-5)


def test_step_before_reset_is_refused():
    with pytest.raises(gym.error.ResetNeeded):
        make().unwrapped.step(np.zeros(4, np.float32))


def test_a_start_that_is_lost_already_is_refused():
    with pytest.raises(ValueError, match="beyond lost_distance"):
        make(start=(100.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="beyond lost_distance"):
        make().reset(seed=0, options={"state": [100.0] + [0.0] * 11})


class _Wrong:
    random = False

    def __init__(self, values):
        self.made = values

    def values(self, t, rng):
        return self.made(t)


@pytest.mark.parametrize(
    ("values", "message"),
    [(lambda t: np.zeros((1, 1, 6)), "shape"), (lambda t: np.full((*t.shape, 6), np.nan), "not finite")],
)
def test_a_disturbance_of_the_user_is_checked(values, message):
    with pytest.raises(ValueError, match=message):
        make(disturbance=_Wrong(values))


def test_kernels_run_as_plain_python_for_debugging():
    code = (
        "import gymnasium as gym, numpy as np, quad_envs\n"
        "env = gym.make('quad/HelixTracking-v0', preview=2, time_limit=0.1)\n"
        "print(env.reset(seed=0)[0].sum() + env.step(np.full(4, .1, 'f4'))[0].sum())"
    )
    compiled, plain = printed_compiled_and_plain(code)
    assert float(compiled) == pytest.approx(float(plain), rel=1e-6)


NO_NUMBERS = {
    "text": "abc",
    "texts": ["1"] * 4,
    "mapping": {"rotor": 1.0},
    "nothing": None,
    "complex": np.full(4, 1j),
    "objects": np.full(4, None),
    "ragged": [1.0, [2.0], 3.0, 4.0],
}


@pytest.mark.parametrize("action", NO_NUMBERS.values(), ids=NO_NUMBERS)
def test_an_action_that_is_no_number_is_refused_as_an_action(action):
    env = gym.make("quad/HelixTracking-v0").unwrapped
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action must be 4 numbers, one per rotor, got"):
        env.step(action)


@pytest.mark.parametrize("env_id", ["quad/HelixTracking-v0", "quad/Formation-v0"])
@pytest.mark.parametrize("action", NO_NUMBERS.values(), ids=NO_NUMBERS)
def test_a_vector_refuses_actions_that_are_no_numbers(env_id, action):
    envs = formation_v0.vector_env(num_teams=2) if "Formation" in env_id else gym.make_vec(env_id, num_envs=2)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=r"actions must be numbers of shape .* got"):
        envs.step(action if isinstance(action, str | dict | None) else [action] * envs.num_envs)


@pytest.mark.parametrize("action", NO_NUMBERS.values(), ids=NO_NUMBERS)
def test_a_team_refuses_an_action_that_is_no_number_and_names_the_agent(action):
    env = formation_v0.parallel_env()
    env.reset(seed=0)
    actions = {agent: np.zeros(4, np.float32) for agent in env.agents} | {"quad_1": action}
    with pytest.raises(ValueError, match="action of quad_1 must be 4 numbers, got"):
        env.step(actions)


@pytest.mark.parametrize("kind", [list, tuple, np.float64, np.int64, ">f4", "strided"])
def test_an_action_may_be_any_real_numbers(kind):
    rewards = []
    for given in (np.array([1, 0, 1, 0], np.float32), _like(kind)):
        env = gym.make("quad/HelixTracking-v0").unwrapped
        env.reset(seed=0)
        rewards.append(env.step(given)[1])
    assert rewards[0] == rewards[1]


def _like(kind):
    plain = np.array([1, 0, 1, 0], np.float32)
    if kind == "strided":
        return np.repeat(plain, 2)[::2]
    return kind([1, 0, 1, 0]) if kind in (list, tuple) else plain.astype(kind)


def test_reset_options_that_are_no_mapping_are_refused_by_name():
    with pytest.raises(ValueError, match=r"reset options must be a mapping, .* got 3"):
        gym.make("quad/HelixTracking-v0").unwrapped.reset(options=3)


def test_an_unknown_autoreset_mode_is_refused_with_those_that_there_are():
    with pytest.raises(ValueError, match="unknown autoreset_mode 'SameStp'; did you mean 'SameStep'"):
        gym.make_vec("quad/HelixTracking-v0", num_envs=2, autoreset_mode="SameStp")
