"""Sizes, parameters and starts beyond what anything can hold or fly are refused when a thing is made."""

from __future__ import annotations

import math

import gymnasium as gym
import numpy as np
import pytest

from baselines import evaluate, make_policy, run_benchmark
from baselines.certify import certify
from baselines.sweeps.choices import EnvChoice, PolicyChoice
from baselines.sweeps.suite import Suite
from baselines.training.plans import make_plan
from baselines.training.request import TrainingRequest
from quad_envs import cooperative_estimation_v0, formation_v0, target_tracking_v0
from quad_envs.arguments import checks
from quad_envs.arguments.checks import Bound, require_memory, require_number, require_whole
from quad_envs.arguments.kinds import is_number
from quad_envs.arguments.names import shown
from quad_envs.disturbances import Gusts, Steady
from quad_envs.envs.shared.random_vehicles import drawn_vehicles
from quad_envs.envs.shared.vehicle_options import RANDOMIZABLE
from quad_envs.envs.team.options import EstimationOptions, FormationOptions
from quad_envs.envs.tracking.options import TrackingOptions
from quad_envs.formations import tried_starts
from quad_envs.parameters import QuadrotorParams, require_inertia
from quad_envs.references import Heading, Helix, from_function
from quad_envs.targets import ConstantVelocity, StaticTarget
from quad_envs.vehicles import VEHICLES

HELIX, REGULATION = "quad/HelixTracking-v0", "quad/Regulation-v0"
HUGE = (10**6, 10**9, 10**60, 10**5000)
SIZES = [(TrackingOptions, name) for name in ("preview", "substeps", "max_episode_steps")] + [
    (FormationOptions, name)
    for name in ("preview", "neighbours", "sensed", "substeps", "delay", "vehicles", "max_cycles")
]


@pytest.mark.parametrize(("kind", "name"), SIZES)
@pytest.mark.parametrize("value", HUGE, ids=["1e6", "1e9", "1e60", "1e5000"])
def test_a_size_that_nothing_can_hold_is_refused_in_a_short_line(kind, name, value):
    if value == 10**6 and name in ("max_episode_steps", "max_cycles"):
        assert kind(**{name: value}).episode_steps == 10**6  # a million steps are a limit, not beyond it
        return
    with pytest.raises(ValueError, match=f"{name} must be a whole number from .* got") as said:
        kind(**{name: value})
    assert len(str(said.value)) < 250


@pytest.mark.parametrize(("kind", "name"), SIZES)
@pytest.mark.parametrize("value", [True, np.True_, 2.0, "2", [2], float("nan")])
def test_a_size_is_a_whole_number_and_true_is_none(kind, name, value):
    with pytest.raises(ValueError, match=f"{name} must be a whole number"):
        kind.from_kwargs({name: value})


@pytest.mark.parametrize("name", ["preview", "neighbours", "sensed", "substeps", "delay"])
def test_a_refused_size_says_the_memory_that_it_would_take(name):
    with pytest.raises(ValueError, match=r"which would take about [0-9.e+]+ GiB of memory"):
        FormationOptions(**{name: 10**12})


@pytest.mark.parametrize("value", [10**9, 10**60])
def test_more_flights_than_the_memory_holds_are_refused_before_it_is_taken(value):
    for make in (
        lambda: gym.make_vec(HELIX, num_envs=value),
        lambda: gym.make_vec("quad/RandomTracking-v0", num_envs=value),
        lambda: formation_v0.vector_env(num_teams=value),
    ):
        with pytest.raises(ValueError, match=r"would take .* GiB of memory, more than 75% of this machine's"):
            make()


@pytest.mark.parametrize("value", [True, 2.5, "2", None, 0, -1])
def test_a_number_of_flights_is_a_whole_number(value):
    with pytest.raises(ValueError, match="num_envs must be a whole number >= 1"):
        gym.make_vec(HELIX, num_envs=value)
    with pytest.raises(ValueError, match="num_teams must be a whole number >= 1"):
        formation_v0.vector_env(num_teams=value)


def test_memory_is_compared_with_that_of_the_machine():
    require_memory("a little", 1e6, "")
    with pytest.raises(ValueError, match=r"all of it would take 9.31e.* GiB of memory.*: take less"):
        require_memory("all of it", 1e18, "take less")


def test_the_bounds_of_a_number_belong_to_it():
    for open_end in (True, False):
        bound = Bound(0.0, 2.0, "m", "why", open_end)
        require_number("x", 2, bound)
        with pytest.raises(ValueError, match=r"x must be .* 0 .* 2 m, got 2.1; why"):
            require_number("x", 2.1, bound)
    require_number("x", 0.0, Bound(0.0, 1.0))
    with pytest.raises(ValueError, match="x must be a finite number > 0 m, got inf"):
        require_number("x", math.inf, Bound(unit="m", open=True))
    gym.make(HELIX, lost_distance=1e308)  # never lost
    with pytest.raises(ValueError, match="got 0"):
        require_number("x", 0.0, Bound(0.0, 1.0, open=True))
    require_whole("n", np.int32(3), 3, 3)
    for value in (2, 4):
        with pytest.raises(ValueError, match="n must be a whole number"):
            require_whole("n", value, 3, 3)


# ---- Physical parameters.


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("mass", value) for value in (0.0, -1.0, 1e-9, 1e9, 1e300)),
        *(("gravity", value) for value in (0.0, 1e-9, 1e9)),
        *(("arm", value) for value in (0.0, 1e-9, 1e9)),
        *(("yaw_moment", value) for value in (0.0, 1e-12, 1e9)),
        *(("rotor_rate", value) for value in (0.0, 1e-9, 1e30)),
        *(("drag", value) for value in (-1.0, 1e6, 1e300)),
        *(("sensor_noise", value) for value in (-1.0, 1e39, (0.0, 0.0, 0.0, 1e39))),
        *(("dt", value) for value in (0.0, 1e-9, 100.0)),
        *(("rate_limit", value) for value in (0.0, 1e-300)),
        *(("Q", value) for value in (-1.0, 1e30)),
        *(("R", value) for value in (0.0, 1e-30, 1e30)),
        ("lost_distance", math.inf),
    ],
)
def test_parameters_that_no_vehicle_has_are_refused_by_name(name, value):
    with pytest.raises(ValueError, match=name.split("_")[0]):
        gym.make(HELIX, **{name: value})


@pytest.mark.parametrize(
    "name",
    [
        *("mass", "gravity", "arm", "yaw_moment", "rotor_rate", "drag", "kappa", "rate_limit", "tilt_limit"),
        *("velocity_limit", "Q", "R", "sensor_noise", "randomize", "dt", "time_limit", "lost_distance"),
        "start_box",
    ],
)
def test_true_is_no_number(name):
    with pytest.raises(ValueError, match=r"got True|time_limit"):
        gym.make(HELIX, **{name: True})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("inertia", (True, True, True)),
        ("position_limit", ((-1.0, -1.0, True), (1.0, 1.0, 2.0))),
        ("start", (True, 0.0, 0.0)),
        ("start_box", (0.5, True, 0.5)),
        ("kappa", (1.0, True, 1.0, 1.0)),
        ("sensor_noise", (0.0, 0.0, True, 0.0)),
        ("disturbance", (True, 0.0, 0.0)),
        ("disturbance", {"kind": "gusts", "force": True}),
        ("disturbance", Gusts(force=True)),
        ("disturbance", Steady((0.0, True, 0.0))),
        ("reference", {"kind": "helix", "radius": True}),
        ("reference", Helix(radius=True)),
        ("reference", Heading(Helix(), yaw=True)),
    ],
)
def test_true_is_no_number_among_others_either(name, value):
    with pytest.raises(ValueError, match=r"[Tt]rue"):
        gym.make(HELIX, **{name: value})


@pytest.mark.parametrize(
    ("module", "kwargs"),
    [
        *((formation_v0, {name: True}) for name in ("spacing", "separation", "crash_distance", "arena")),
        *((formation_v0, {name: True}) for name in ("sensing_radius", "drop_out", "message_lifetime")),
        *((formation_v0, {name: True}) for name in ("leader_weight", "formation_weight")),
        (formation_v0, {"vehicles": 3, "start": ((True, 0, 0), (2, 0, 0), (4, 0, 0))}),
        (formation_v0, {"vehicles": 3, "formation": ((True, 0, 0), (2, 0, 0), (4, 0, 0))}),
        *((target_tracking_v0, {name: True}) for name in ("detection", "prior_sigma", "target_spread")),
        (target_tracking_v0, {"sensor_sigma": (0.1, True, 0.1)}),
        (target_tracking_v0, {"measuring": (True,)}),
        (cooperative_estimation_v0, {"rails": [[True, 0, 0], [1, 1, 1], [2, 2, 2], [3, 3, 3]]}),
        (cooperative_estimation_v0, {"rail_velocity": True}),
        (target_tracking_v0, {"target": StaticTarget((True, 0.0, 0.0))}),
        (target_tracking_v0, {"target": ConstantVelocity(q=True)}),
    ],
)
def test_true_is_no_number_of_a_team_either(module, kwargs):
    with pytest.raises(ValueError, match="True"):
        module.parallel_env(**kwargs)


def test_states_and_starts_of_booleans_are_refused():
    env = gym.make(HELIX)
    for state in (np.zeros(12, dtype=bool), [0.0] * 11 + [True]):
        with pytest.raises(ValueError, match="'state' must be 12 or 16 finite numbers"):
            env.reset(seed=0, options={"state": state})


def test_drag_is_refused_where_the_integrator_cannot_follow_and_flown_just_below():
    with pytest.raises(ValueError, match=r"drag must be at most 200 kg/s, got 201.0: it brakes 0.8 kg"):
        gym.make(HELIX, drag=201.0)
    # RK4 follows -h lambda = 2.5; what remains of a velocity stays below it.
    env = gym.make(REGULATION, drag=199.0, start_box=0.0)
    env.reset(seed=0, options={"state": [0.0, 0.0, 0.0, 1.0] + [0.0] * 8})
    for _ in range(20):
        env.step(np.zeros(4, np.float32))
    assert np.abs(env.unwrapped.state[3:6]).max() < 1e-3
    gym.make(HELIX, drag=201.0, substeps=6)


# ---- Inertia.


@pytest.mark.parametrize("axis", range(3))
def test_an_inertia_that_no_body_has_is_refused_at_every_axis(axis):
    J = np.roll([2.1, 1.0, 1.0], axis)
    with pytest.raises(ValueError, match=f"that of no body: J{'xyz'[axis]} = 2.1 exceeds"):
        gym.make(HELIX, inertia=J)
    J[axis] = 2.0  # a flat plate
    gym.make(HELIX, inertia=J)


def test_named_vehicles_have_inertias_of_bodies():
    for vehicle in VEHICLES.values():
        require_inertia(vehicle.params.inertia)


@pytest.mark.parametrize("spread", [0.2, 0.9])
def test_drawn_inertias_are_those_of_bodies(spread):
    options = TrackingOptions(randomize={"inertia": spread, "mass": 0.1})
    rng, capped = np.random.default_rng(0), 0
    for _ in range(300):
        (coefficients,), _ = drawn_vehicles(options.task, options.randomization(), rng.random((1, 4)))
        J = 1.0 / coefficients[9:12]
        assert J.max() <= (J.sum() - J.max()) * (1.0 + 1e-12)  # rounding of the inverse
        capped += J.max() > (J.sum() - J.max()) * (1.0 - 1e-12)
        within = np.abs(J / np.array(QuadrotorParams().inertia) - 1.0) <= spread + 1e-12
        assert within.sum() >= 2  # the largest may be less than the spread allows
    assert 0 < capped < 300


def test_randomized_parameters_stay_within_their_bounds():
    with pytest.raises(ValueError, match="mass must be a number from 1e-05"):
        gym.make(HELIX, mass=1.1e-5, randomize={"mass": 0.5})
    with pytest.raises(ValueError, match="drag must be at most"):
        gym.make(HELIX, drag=150.0, randomize={"drag": 0.5})
    for name in RANDOMIZABLE:
        with pytest.raises(ValueError, match=r"relative spread in \[0, 1\)"):
            gym.make(HELIX, drag=0.1, randomize={name: True})


# ---- Starts.


@pytest.mark.parametrize("make", [gym.make, lambda *a, **k: gym.make_vec(*a, num_envs=2, **k)])
@pytest.mark.parametrize(
    "kwargs",
    [
        {"start_box": 29.4},  # its corner is 50.9 m away
        {"start_box": (0.0, 50.1, 0.0)},
        {"start": (49.0, 0.0, 0.0), "start_box": 8.0},
        {"start": (49.0, 0.0, 0.0), "start_box": (1.5, 0.0, 0.0)},
        {"start": "reference", "start_box": 29.4},
        {"reference": from_function(lambda t: (49.0, 0.0, 0.0)), "start_box": 8.0},
        {"reference": "random", "start_box": 29.4},
        {"lost_distance": 5.0, "start_box": 3.0},
    ],
)
def test_a_start_box_with_a_corner_that_is_lost_is_refused_when_it_is_made(make, kwargs):
    with pytest.raises(ValueError, match=r"starts are up to .* m from the reference .* beyond lost_distance"):
        make(REGULATION, **kwargs)


def test_the_largest_start_box_is_flown_from_its_corner():
    side = 50.0 / np.sqrt(3.0) - 1e-9
    env = gym.make(REGULATION, start_box=side)
    corner = np.zeros(12)
    corner[:3] = side
    env.reset(seed=0, options={"state": corner})
    env.step(np.zeros(4, np.float32))


def test_boxes_of_attitudes_on_the_reference_are_checked_like_others():
    box = (0.0,) * 6 + (1.5,) + (0.0,) * 5
    with pytest.raises(ValueError, match="start roll and pitch with their box must stay below"):
        gym.make(HELIX, start="reference", start_box=box)
    with pytest.raises(ValueError, match="start with its box must stay within"):
        gym.make(HELIX, start=(0.0,) * 9 + (1e30, 0.0, 0.0))


def test_random_references_that_may_be_too_fast_are_refused_when_they_are_made():
    with pytest.raises(ValueError, match=r"may move at .* no quadrotor flies faster than 100 m/s"):
        gym.make(HELIX, reference={"kind": "random", "rate_max": 30.0})
    with pytest.raises(ValueError, match="harmonics must be a whole number"):
        gym.make(HELIX, reference={"kind": "random", "harmonics": 10**9})


class _Wrong:
    random = True

    def rows(self, t, rng):
        return np.zeros((t.size, 3))


def test_a_random_reference_of_the_wrong_shape_is_refused_when_it_is_made():
    with pytest.raises(ValueError, match="must give rows of shape"):
        gym.make(HELIX, reference=_Wrong())
    with pytest.raises(ValueError, match="must give rows of shape"):
        formation_v0.parallel_env(reference=_Wrong())


@pytest.mark.parametrize("start", ["line", "sorted", "random", "box"])
def test_teams_whose_starts_may_be_crashes_are_refused_when_they_are_made(start):
    with pytest.raises(ValueError, match="which is a crash"):
        formation_v0.parallel_env(start=start, crash_distance=1.001, separation=1.2, spacing=2.0)


def test_a_box_that_was_accepted_can_be_filled_from_any_seed():
    slots = np.zeros((6, 3))
    for separation in (0.4, 0.8, 1.0):
        tried_starts("box", slots, separation)
    with pytest.raises(ValueError, match="no room for 6 vehicles"):
        tried_starts("box", slots, 1.6)
    env = formation_v0.parallel_env(start="box", separation=0.95, spacing=2.0)
    for seed in range(50):
        env.reset(seed=seed)


def test_rails_and_slots_stay_where_observations_can_tell_them():
    for rails in ([[1e30, 0, 0], [1, 1, 1], [2, 2, 2], [3, 3, 3]], "abcd"):
        with pytest.raises(ValueError, match="rails must be 4 positions"):
            EstimationOptions(rails=rails)
    with pytest.raises(ValueError, match="formation must be finite and within"):
        formation_v0.parallel_env(vehicles=2, formation=[[0, 0, 0], [1e30, 0, 0]])


# ---- Rendering.


@pytest.mark.parametrize("mode", [0, True, 2.5, [], ["rgb_array"], b"rgb_array", "ansi", "human2", ""])
@pytest.mark.filterwarnings("ignore:.*not in the possible render_modes")
def test_a_render_mode_that_is_none_is_refused_with_those_there_are(mode):
    for make in (
        lambda: gym.make(HELIX, render_mode=mode),
        lambda: gym.make_vec(HELIX, num_envs=1, render_mode=mode),
        lambda: formation_v0.parallel_env(render_mode=mode),
    ):
        with pytest.raises(ValueError, match=r"render_mode must be None or .*'rgb_array', got"):
            make()


# ---- Messages.


class _Silent:
    def __repr__(self):
        raise RuntimeError


def _nested(depth):
    out = []
    for _ in range(depth):
        out = [out]
    return out


@pytest.mark.parametrize(
    "value",
    ["x" * 10**6, 10**5000, list(range(10**6)), _nested(5000), {"a": _nested(5000)}, _Silent(), b"x" * 10**6],
    ids=["text", "integer", "list", "nested", "mapping", "silent", "bytes"],
)
def test_values_are_shown_short_and_on_one_line(value):
    assert len(shown(value)) <= 80 and "\n" not in shown(value)
    assert not is_number(value) or isinstance(value, int)


def test_lists_in_lists_without_end_are_refused():
    for name in ("start", "Q", "inertia", "position_limit"):
        with pytest.raises(ValueError, match="more than 20 deep"):
            gym.make(HELIX, **{name: _nested(5000)})


# ---- Controllers, evaluations, trainings.


@pytest.mark.parametrize("policy", ["lmpc", "sdc-nmpc", "nmpc"])
@pytest.mark.parametrize("horizon", [1001, 10**6, 10**60])
def test_horizons_that_no_solver_holds_are_refused_with_their_memory(policy, horizon):
    task = TrackingOptions(preview=2000).task
    with pytest.raises(ValueError, match=r"horizon must be .* from 1 to 1000, got .* GiB of memory"):
        make_policy(policy, task, horizon=horizon)


@pytest.mark.parametrize(
    ("policy", "option", "value"),
    [
        ("nmpc", "passes", 10**9),
        ("sdc-nmpc", "relinearisations", 10**9),
        ("lmpc", "iteration_limit", 10**60),
        ("lmpc", "Q", 1e300),
        ("lmpc", "Q", True),
        ("lmpc", "R", [1.0, 1.0, True, 1.0]),
        ("lmpc", "terminal", True),
        ("lmpc", "plan_tilt", True),
        ("lmpc", "horizon", True),
        ("lmpc", "soft_weight", True),
        ("sdc-nmpc", "relinearisations", True),
    ],
)
def test_options_of_controllers_are_bounded_numbers_too(policy, option, value):
    with pytest.raises(ValueError, match=option):
        make_policy(policy, HELIX, **{option: value})


def test_a_terminal_weight_may_be_a_matrix_in_make_policy_too():
    terminal = 3.0 * np.eye(12)
    assert (make_policy("lmpc", HELIX, terminal=terminal).controller._data.P == terminal).all()


def test_a_central_mpc_says_the_memory_of_its_dense_matrices(monkeypatch):
    monkeypatch.setattr(checks, "_machine_memory", lambda: 2.0**30)
    team = formation_v0.parallel_env(preview=600)
    with pytest.raises(ValueError, match=r"horizon 600 would take 1\.54 GiB .* shorter horizon"):
        make_policy("central-mpc", team, horizon=600)


@pytest.mark.parametrize("value", [0, True, 2.5, 10**6, 10**60])
def test_numbers_of_flights_processes_and_starts_are_bounded(value):
    with pytest.raises(ValueError, match="episodes must be a whole number"):
        evaluate("hover", HELIX, episodes=value)
    with pytest.raises(ValueError, match=r"episodes of suite .* must be a whole number"):
        Suite("mine", (EnvChoice(HELIX),), (PolicyChoice("hover"),), episodes=value)
    with pytest.raises(ValueError, match="jobs must be a whole number"):
        run_benchmark("quick", jobs=value)
    with pytest.raises(ValueError, match="starts must be a whole number"):
        certify(REGULATION, "lqr", starts=value)


def test_processes_that_the_memory_does_not_hold_are_refused(monkeypatch):
    monkeypatch.setattr(checks, "_machine_memory", lambda: 4.0 * 2.0**30)
    with pytest.raises(ValueError, match=r"1000 processes would take 186 GiB .*: choose fewer jobs"):
        run_benchmark("quick", jobs=1000)


@pytest.mark.parametrize(
    ("algorithm", "hyper"),
    [
        ("ppo", {"n_envs": 10**9}),
        ("ppo", {"n_steps": 10**60}),
        ("ppo", {"batch_size": 10**60}),
        ("ppo", {"net_arch": [10**9]}),
        ("ppo", {"net_arch": [64] * 1000}),
        ("ppo-lagrangian", {"probes": 10**9}),
        ("sac", {"buffer_size": 10**12}),
        ("apg", {"n_envs": 10**9}),
        ("apg", {"substeps": 10**9}),
        ("dagger", {"n_steps": 10**9}),
        ("dagger", {"gradient_steps": 10**60}),
        ("ppo", {"n_envs": 100_000, "n_steps": 10_000}),
    ],
)
def test_hyperparameters_that_no_machine_holds_are_refused(algorithm, hyper):
    pytest.importorskip("stable_baselines3", reason="without it the training is refused for that")
    with pytest.raises(ValueError, match=f"{next(iter(hyper))}|observations of"):
        make_plan(TrainingRequest(HELIX, algorithm, steps=1000, hyper=hyper))
