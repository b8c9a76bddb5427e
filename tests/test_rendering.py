"""Pictures: every environment gives them, they show what they should, and nobody pays who wants none."""

import copy
import pickle
import subprocess
import sys
import types

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.wrappers import RenderCollection
from pettingzoo.test import render_test
from pettingzoo.utils import parallel_to_aec

from quad_envs import cooperative_estimation_v0, formation_v0, target_tracking_v0
from quad_envs.envs.tracking.vector import TrackingVectorEnv
from quad_envs.pictures.canvas import PURPLE, RED, halve
from quad_envs.pictures.scenes import CAMERA, Framing, depth, project
from quad_envs.registration import TRACKING

TEAMS = [formation_v0, target_tracking_v0, cooperative_estimation_v0]
HOVER = np.zeros(4, dtype=np.float32)


def names(module):
    return module.__name__.rsplit(".", 1)[-1]


def hover(env):
    return {name: np.zeros(env.action_space(name).shape, dtype=np.float32) for name in env.agents}


def count(frame, colour):
    return int((frame == np.array(colour, dtype=np.uint8)).all(axis=2).sum())


def vehicle(x=0.0, y=0.0, z=0.0, **angles):
    state = np.zeros(12)
    state[:3] = x, y, z
    for name, value in angles.items():
        state[{"roll": 6, "pitch": 7, "yaw": 8}[name]] = value
    return state


def one(**kwargs):
    return gym.make("quad/Regulation-v0", render_mode="rgb_array", **kwargs).unwrapped


def picture(env, state):
    env.reset(seed=0, options={"state": state})
    return env.render()


@pytest.mark.parametrize("size", [(640, 480), (1280, 720), (333, 200)], ids=str)
@pytest.mark.parametrize("env_id", TRACKING)
def test_tracking_gives_pictures_of_the_size_asked_for(env_id, size):
    env = gym.make(env_id, render_mode="rgb_array", render_size=size)
    env.reset(seed=0)
    first = env.render()
    for _ in range(4):
        env.step(HOVER)
    second = env.render()
    assert first.shape == second.shape == (size[1], size[0], 3)
    assert first.dtype == np.uint8
    assert (first != second).any()


@pytest.mark.parametrize("size", [(640, 480), (1280, 720)], ids=str)
@pytest.mark.parametrize("module", TEAMS, ids=names)
def test_teams_give_pictures_of_the_size_asked_for(module, size):
    env = module.parallel_env(render_mode="rgb_array", render_size=size)
    env.reset(seed=0)
    first = env.render()
    for _ in range(4):
        env.step(hover(env))
    second = env.render()
    assert first.shape == second.shape == (size[1], size[0], 3)
    assert first.dtype == np.uint8
    assert (first != second).any()


@pytest.mark.parametrize("module", TEAMS, ids=names)
def test_the_whole_episode_of_a_team_can_be_shown(module):
    env = module.parallel_env(render_mode="rgb_array", max_cycles=5, terminate="agent")
    env.reset(seed=0)
    while env.agents:
        env.step(hover(env))
        assert env.render().any()


def test_a_picture_is_the_same_when_it_is_asked_for_twice():
    env = one()
    env.reset(seed=3)
    for _ in range(10):
        env.step(np.array([0.1, 0.0, -0.1, 0.0], dtype=np.float32))
    assert np.array_equal(env.render(), env.render())


def test_rendering_does_not_change_the_flight():
    plain, shown = (gym.make("quad/RandomTracking-v0", render_mode=mode) for mode in (None, "rgb_array"))
    assert np.array_equal(plain.reset(seed=1)[0], shown.reset(seed=1)[0])
    for _ in range(10):
        a, b = plain.step(HOVER), shown.step(HOVER)
        shown.render()
        assert np.array_equal(a[0], b[0])
        assert a[1] == b[1]


def test_nothing_is_recorded_and_pillow_stays_away_without_a_render_mode():
    code = (
        "import sys, gymnasium as gym, quad_envs\n"
        "from quad_envs import formation_v0\n"
        "for env in (gym.make('quad/HelixTracking-v0').unwrapped, formation_v0.parallel_env()):\n"
        "    env.reset(seed=0); assert env._pictures is None\n"
        "shown = gym.make('quad/HelixTracking-v0', render_mode='rgb_array'); shown.reset(seed=0)\n"
        "print(any(name.split('.')[0] in ('PIL', 'pygame') for name in sys.modules))\n"
        "shown.render(); print('PIL' in sys.modules, 'pygame' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "True", "False"]


def test_one_vehicle_without_pictures_loads_neither_pictures_nor_teams():
    code = (
        "import sys, gymnasium as gym, quad_envs\n"
        "env = gym.make('quad/HelixTracking-v0'); gym.make_vec('quad/HelixTracking-v0', num_envs=2)\n"
        "print([name for name in sys.modules if name.startswith(('quad_envs.pict', 'quad_envs.envs.pict', "
        "'quad_envs.envs.team', 'scipy.linalg'))])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_up_in_the_world_is_up_on_the_screen():
    low, high = project([[2.0, 1.0, -1.0], [2.0, 1.0, -2.0]])
    assert high[1] > low[1]
    assert high[0] == pytest.approx(low[0], abs=1e-12)  # rounding


def test_a_vehicle_that_climbs_moves_up_on_the_screen():
    def row(z):
        frame = picture(one(), vehicle(z=z)).astype(int)
        body = (frame.max(axis=2) < 70) & (np.arange(640) > 200) & (np.arange(640) < 440)  # dark, not text
        return np.nonzero(body)[0].mean()

    rows = [row(z) for z in (0.6, 0.3, 0.0, -0.3, -0.6)]
    assert (np.diff(rows) < 0.0).all()


def test_the_projection_keeps_lengths_across_the_line_of_sight_and_drops_them_along_it():
    assert np.allclose(CAMERA @ CAMERA.T, np.eye(3), atol=1e-15)  # rounding
    assert np.allclose(project(CAMERA[:2]), np.eye(2), atol=1e-15)
    assert np.allclose(project(CAMERA[2]), 0.0, atol=1e-15)
    assert depth(CAMERA[2]) == pytest.approx(1.0)
    assert CAMERA[2, 2] > 0.0  # the camera looks down


def test_the_camera_stands_still_where_all_of_a_reference_fits():
    angle = np.linspace(0.0, 6.0, 121)
    wanted = np.stack([2.0 * np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)[None]
    framing = Framing(wanted, np.zeros((0, 3)), 0.05)
    views = [framing.view(k, wanted[:, k]) for k in range(121)]
    assert not framing.follows
    assert np.ptp(views, axis=0).max() == 0.0


def test_the_camera_follows_smoothly_and_keeps_strays_in_view():
    t = 0.05 * np.arange(401)
    wanted = np.stack([2.0 * t, 0.0 * t, -0.5 * t], axis=1)[None]
    framing = Framing(wanted, np.zeros((0, 3)), 0.05)
    rng = np.random.default_rng(0)
    stray = np.cumsum(rng.normal(0.0, 0.05, (401, 3)), axis=0) + wanted[0]  # at most 0.2 m further a step
    last = None
    for k in range(401):
        left, bottom, right, top = view = framing.view(k, stray[k : k + 1])
        u, v = project(stray[k])
        assert left - 1e-9 <= u <= right + 1e-9
        assert bottom - 1e-9 <= v <= top + 1e-9
        if last is not None:  # 0.1 m of the flight, the stray's own step, 7 % of how far it was away
            assert np.abs(view - last).max() < 0.1 + 0.35 + 0.07 * np.abs(stray[k] - wanted[0, k]).max()
        last = view
    assert framing.follows


def test_a_violated_limit_is_red():
    env = one(tilt_limit=0.2, position_limit=((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)))
    fine = picture(env, vehicle(roll=0.1))
    tilted = picture(env, vehicle(roll=0.5))
    outside = picture(env, vehicle(x=1.3))
    assert count(fine, RED) == 0
    assert count(tilted, RED) > 50  # the vehicle's outline and the name of the limit
    assert count(outside, RED) > 2 * count(tilted, RED)  # and a face of the box


def test_vehicles_too_near_each_other_are_red():
    env = formation_v0.parallel_env(render_mode="rgb_array", vehicles=2)
    states = np.stack([vehicle(), vehicle(y=1.0)])
    fine = picture(env, states)
    states[1, 1] = 0.38
    near = picture(env, states)
    assert count(fine, RED) == 0
    assert count(near, RED) > 100


def test_crashed_agents_vanish():
    env = formation_v0.parallel_env(render_mode="rgb_array", vehicles=3, terminate="agent", start="line")
    states = np.stack([vehicle(), vehicle(y=1.5), vehicle(y=3.0, roll=1.45)])
    env.reset(seed=0, options={"state": states})
    tumble = np.array([0.0, -1.0, 0.0, 1.0], dtype=np.float32)
    assert len(env._pictures.scene().plants) == 3
    while len(env.agents) == 3:
        env.step({**hover(env), "quad_2": tumble})
    scene = env._pictures.scene()
    assert scene.numbers == (0, 1)
    assert len(scene.wrecks) == 1
    assert scene.links.max(initial=0) < 2
    assert count(env.render(), RED) > 10  # a cross where it crashed


def test_links_are_those_that_were_heard():
    env = formation_v0.parallel_env(render_mode="rgb_array", vehicles=3, graph="chain", formation="lattice")
    env.reset(seed=0)
    env.step(hover(env))
    scene = env._pictures.scene()
    assert scene.links.tolist() == [[1, 0], [2, 1]]
    assert (scene.strength[:, 1] > 0.9).all()  # heard just now


def test_the_target_is_shown_and_who_measures_it():
    env = target_tracking_v0.parallel_env(render_mode="rgb_array", measuring=(0, 2))
    env.reset(seed=0)
    scene = env._pictures.scene()
    assert np.flatnonzero(scene.sights).tolist() == [0, 2]
    assert np.allclose(scene.target[-1], env.target[0, :3])
    assert count(env.render(), PURPLE) > 50
    assert count(formation_picture(), PURPLE) == 0


def formation_picture():
    env = formation_v0.parallel_env(render_mode="rgb_array")
    env.reset(seed=0)
    return env.render()


def test_estimates_are_shown_where_they_say_the_target_is():
    env = cooperative_estimation_v0.parallel_env(render_mode="rgb_array")
    env.reset(seed=0)
    truth = env.target[0]
    actions = {
        name: np.concatenate([(truth[:3] - p) / 20.0, truth[3:] / 5.0]).astype(np.float32)
        for name, p in zip(env.agents, env.plants[:, :3], strict=True)
    }
    env.step(actions)
    estimates = env._pictures.scene().estimates
    carried = truth[:3] + 0.05 * truth[3:]
    assert np.abs(estimates - carried).max() < 1e-5  # float32 actions of 20 m


def test_halving_is_the_rounded_mean_of_four_pixels():
    rng = np.random.default_rng(0)
    big = rng.integers(0, 256, (12, 20, 4), dtype=np.uint8)
    big[:4, :4] = 77
    out = np.empty((6, 10, 3), dtype=np.uint8)
    halve(big.view(np.uint32)[..., 0], np.empty(out.shape[1], dtype=np.uint32), out)
    blocks = big[..., :3].astype(int).reshape(6, 2, 10, 2, 3).sum(axis=(1, 3))
    assert np.array_equal(out, (blocks + 2) // 4)


def test_a_vector_of_flights_gives_one_picture_each_as_single_flights_do():
    kwargs = {"render_mode": "rgb_array", "time_limit": 0.2}
    env = gym.make_vec("quad/LemniscateTracking-v0", num_envs=2, **kwargs)
    singles = [gym.make("quad/LemniscateTracking-v0", **kwargs) for _ in range(2)]
    env.reset(seed=5)
    for i, single in enumerate(singles):
        single.reset(seed=5 + i)
    for _ in range(3):
        env.step(np.zeros((2, 4), dtype=np.float32))
        for single in singles:
            single.step(HOVER)
    frames = env.render()
    assert isinstance(frames, tuple)
    for frame, single in zip(frames, singles, strict=True):
        assert np.array_equal(frame, single.render())


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_trails_of_a_vector_begin_anew_with_the_episode(mode):
    env = TrackingVectorEnv(1, autoreset_mode=mode, render_mode="rgb_array", time_limit=0.2)
    env.reset(seed=0)
    for _ in range(7):
        env.step(np.zeros((1, 4), dtype=np.float32))
    assert len(env._pictures[0].scene().trails) == {"NextStep": 3, "SameStep": 4}[mode]


def test_gymnasium_collects_pictures_as_for_a_video():
    env = RenderCollection(gym.make("quad/HelixTracking-v0", render_mode="rgb_array"))
    env.reset(seed=0)
    for _ in range(3):
        env.step(HOVER)
    assert len(env.render()) == 4
    assert env.metadata["render_fps"] == 20


def test_gymnasium_puts_its_own_window_around_tracking():
    with pytest.warns(UserWarning, match="HumanRendering wrapper is being applied"):
        env = gym.make("quad/HelixTracking-v0", render_mode="human")
    assert isinstance(env, gym.wrappers.HumanRendering)
    assert env.unwrapped.render_mode == "rgb_array"


@pytest.fixture
def screen(monkeypatch):
    """A stand-in for pygame that notes what it shows."""
    shown = []
    fake = types.ModuleType("pygame")
    display = types.SimpleNamespace(init=lambda: None, set_caption=lambda title: None, flip=lambda: None)
    display.set_mode = lambda size: types.SimpleNamespace(size=size)
    display.quit = lambda: shown.append("closed")
    fake.display = display
    fake.event = types.SimpleNamespace(pump=lambda: None)
    fake.time = types.SimpleNamespace(Clock=lambda: types.SimpleNamespace(tick=lambda rate: None))
    fake.surfarray = types.SimpleNamespace(blit_array=lambda surface, array: shown.append(array.shape))
    monkeypatch.setitem(sys.modules, "pygame", fake)
    return shown


@pytest.mark.parametrize("module", TEAMS, ids=names)
def test_pettingzoo_render_test_passes(module, screen):
    render_test(lambda **kwargs: parallel_to_aec(module.parallel_env(**kwargs)))


def test_the_window_shows_every_moment_and_closes(screen):
    env = formation_v0.parallel_env(render_mode="human")
    assert screen == []
    env.reset(seed=0)
    env.step(hover(env))
    assert env.render() is None
    env.close()
    env.close()
    assert screen == [(640, 480, 3), (640, 480, 3), "closed"]


def test_a_missing_pygame_is_named_with_its_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    env = formation_v0.parallel_env(render_mode="human")
    with pytest.raises(ImportError, match=r"-e \"\.\[human\]\""):
        env.reset(seed=0)


@pytest.mark.parametrize(
    "size",
    [640, (640,), (640, 480, 3), (640.0, 480), (100, 480), (640, 5000), (True, 480), "640x480"],
    ids=str,
)
def test_a_wrong_size_is_refused(size):
    with pytest.raises(ValueError, match="render_size must be"):
        formation_v0.parallel_env(render_mode="rgb_array", render_size=size)
    with pytest.raises(ValueError, match="render_size must be"):
        gym.make("quad/HelixTracking-v0", render_mode="rgb_array", render_size=size)


@pytest.mark.filterwarnings("ignore:.*render_mode.*")
def test_a_wrong_mode_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match="'human' or 'rgb_array', got 'ansi'"):
        formation_v0.parallel_env(render_mode="ansi")
    with pytest.raises(ValueError, match="'rgb_array', got 'ansi'"):
        gym.make("quad/HelixTracking-v0", render_mode="ansi")
    with pytest.raises(ValueError, match=r"gymnasium\.make"):
        type(one())(render_mode="human")


def test_pictures_need_a_render_mode_and_an_episode():
    with pytest.warns(UserWarning, match="without a render_mode"):
        assert formation_v0.parallel_env().render() is None
    with pytest.raises(ResetNeeded):
        formation_v0.parallel_env(render_mode="rgb_array").render()
    with pytest.raises(ResetNeeded):
        one().render()


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_goes_on_with_the_same_pictures(clone):
    env = one()
    env.reset(seed=0)
    env.step(HOVER)
    env.render()
    twin = clone(env)
    for each in (env, twin):
        each.step(HOVER)
    assert np.array_equal(env.render(), twin.render())
