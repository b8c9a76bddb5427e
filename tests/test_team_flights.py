"""Closed loops of the cooperative MPC: the claims of chapters 5 and 7, and what each correction is for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from formation_flights import (
    DT,
    HEXAGON,
    LINE_START,
    RNG,
    SORTED_START,
    STRONG_TRIANGLE,
    TRIANGLE,
    WEAK_HEXAGON,
    WEAK_TRIANGLE,
    at_rest,
    fly_team,
    helix,
    line,
    messages,
    sensed_rows,
    still,
    swap_antipodes,
    team_task,
)

from baselines import make_policy
from controllers.team.cooperative import CooperativeMpc
from controllers.team.situation import TargetEstimate, TeamSituation
from quad_envs import formation_v0
from quad_envs.dynamics import simulate
from quad_envs.formations import make_formation, start_positions
from quad_envs.graphs import make_graph

FREE = {"reach": np.inf, "speed": np.inf}
ALONE = {"avoidance": "none", **FREE}
PAIR = team_task(2, neighbours=0, sensed=1)
PLANS = team_task(plan=5)


@pytest.mark.parametrize(("weight", "low", "high"), [("hover", 0.0, 1e-4), ("stage", 0.4, 0.6)])
def test_a_short_horizon_needs_the_riccati_weight(weight, low, high):
    """From (1, 1, -1) m at rest; 0.51 m are left after 15 s with Q_f = Q."""
    controller = CooperativeMpc(team_task(1, 0, 0), terminal_weight=weight, **FREE)
    start = np.array([[1.0, 1.0, -1.0]])
    flight = fly_team(controller, start, np.zeros((1, 3)), np.eye(1), still, seconds=15.0)
    assert low <= np.linalg.norm(flight.plants[-1, 0, :3]) < high


@pytest.mark.parametrize(
    ("options", "path", "lag", "tolerance"),
    [
        ({"neighbour": "frozen", "feed_forward": False}, line, 0.277, 0.01),
        ({"feed_forward": False}, line, 0.054, 0.002),
        ({}, line, 0.0, 0.003),
        ({"neighbour": "plan"}, line, 0.0, 0.003),
        ({}, helix, 0.278, 0.01),
        ({"neighbour": "plan"}, helix, 0.181, 0.01),
        ({"neighbour": "ca"}, helix, 0.141, 0.01),
        ({"neighbour": "ca", "attitude": True}, helix, 0.019, 0.011),
    ],
)
def test_lag_behind_a_moving_leader(options, path, lag, tolerance):
    """Two hops, after 20 s; the numbers were measured with another implementation."""
    task = PLANS if options.get("neighbour") == "plan" else team_task()
    controller = CooperativeMpc(task, **ALONE, **options)
    flight = fly_team(controller, SORTED_START, TRIANGLE, WEAK_TRIANGLE, path)
    assert flight.error[-1] == pytest.approx(lag, abs=tolerance)


@pytest.mark.parametrize(
    ("slots", "G", "path", "settling"),
    [
        (TRIANGLE, WEAK_TRIANGLE, still, 7.0),
        (TRIANGLE, WEAK_TRIANGLE, line, 7.0),
        (HEXAGON, WEAK_HEXAGON, still, 14.0),
        (TRIANGLE, STRONG_TRIANGLE, line, 14.0),
    ],
    ids=["triangle", "triangle-line", "hexagon", "strong-triangle-line"],
)
def test_a_formation_closes_from_a_line_with_crossing_paths(slots, G, path, settling):
    flight = fly_team(CooperativeMpc(team_task()), LINE_START, slots, G, path)
    assert flight.error[-1] < 0.01
    assert flight.settling < settling
    assert flight.gap >= 0.399
    assert not flight.fallbacks.any()


@pytest.mark.parametrize("alpha", [0.5, 1.0])
@pytest.mark.parametrize("speed", [0.5, 1.0, 2.0])
def test_vehicles_that_meet_head_on_keep_the_separation_and_arrive(speed, alpha):
    # With alpha = 1/2 the model sees half of what a tilt does, and needs more of it at 2 m/s each.
    controller = CooperativeMpc(PAIR, alpha=alpha, plan_tilt=0.7 if alpha == 0.5 else 0.5, **FREE)
    meetings = [swap_antipodes(controller, speed, seed=seed) for seed in range(8)]
    assert min(meeting.gap for meeting in meetings) >= 0.399
    assert max(meeting.end for meeting in meetings) < 0.4  # 3 s after the end of the reference


@pytest.mark.parametrize(("rule", "highest"), [("none", 0.33), ("frozen", 0.399)])
@pytest.mark.parametrize("speed", [0.5, 1.0, 2.0])
def test_without_the_corrected_rule_they_do_not(rule, highest, speed):
    controller = CooperativeMpc(PAIR, avoidance=rule, **FREE)
    assert max(swap_antipodes(controller, speed, seed=seed).gap for seed in range(8)) < highest


def test_plans_keep_a_slow_pair_apart():
    controller = CooperativeMpc(team_task(2, 1, 1, plan=5), avoidance="plan", **FREE)
    assert min(swap_antipodes(controller, 0.5, seed=seed).gap for seed in range(4)) >= 0.399


def test_the_swirl_frees_an_exactly_symmetric_meeting():
    assert swap_antipodes(CooperativeMpc(PAIR, **FREE), 1.0, jitter=0.0).end < 0.1
    locked = swap_antipodes(CooperativeMpc(PAIR, swirl=0.0, **FREE), 1.0, jitter=0.0)
    assert locked.gap > 0.399
    assert locked.end > 1.0


def test_six_vehicles_swap_places():
    controller = CooperativeMpc(team_task(6, 0, 5), **FREE)
    assert min(swap_antipodes(controller, 1.0, 6, seed).gap for seed in range(4)) >= 0.399


@pytest.mark.parametrize(("moving", "low", "high"), [(True, 0.0, 0.01), (False, 0.5, np.inf)])
def test_a_fast_convoy_needs_the_moving_centre(moving, low, high):
    controller = CooperativeMpc(team_task(), moving_centre=moving, **FREE)
    flight = fly_team(controller, SORTED_START, TRIANGLE, WEAK_TRIANGLE, lambda t: line(t, (3.0, 0.0, 0.0)))
    assert low <= flight.error[-1] < high


@pytest.mark.parametrize(("who", "low", "high"), [("edges", 0.0, 0.35), ("sensed", 0.399, 1.0)])
def test_graph_neighbours_are_the_wrong_ones_to_avoid(who, low, high):
    controller = CooperativeMpc(team_task(), avoidance_set=who)
    flight = fly_team(controller, 0.7 * LINE_START, TRIANGLE, WEAK_TRIANGLE, still)
    assert low <= flight.gap < high


@pytest.mark.parametrize("seed", [0, 1])
def test_twenty_vehicles_sort_themselves(seed):
    slots = make_formation("lattice", 20)
    start = start_positions("random", slots, np.random.default_rng(seed))
    controller = CooperativeMpc(team_task(20, 8, 8))
    flight = fly_team(controller, start, slots, make_graph("weak", "lattice", 20), still, seconds=15.0)
    assert flight.gap >= 0.399
    assert not flight.fallbacks.any()


def turn(t):
    """Chapter 7's turning target."""
    radius, w = 0.8 / 0.25, 0.25
    r = np.array([3.0 + radius * np.sin(w * t), radius * (1 - np.cos(w * t)), -0.1 * t])
    return r, np.array([0.8 * np.cos(w * t), 0.8 * np.sin(w * t), -0.1])


def fly_to_target(controller, variance, blind=()):
    """Tracking errors of vehicles, RMS over the last 5 of 25 s; the blind ones are 5 m wrong and know it."""
    slots = np.array([[-1, 0, -0.8], [-1, 1.2, 0.4], [-1, -1.2, 0.4], [-2.2, 0.7, -0.3], [-2.2, -0.7, -0.3],
                      [-2.2, 0, 0.8]])  # fmt: skip
    task, G = controller.task, make_graph("case-1", None, 6)
    start = np.array([[0.0, y, 0.0] for y in np.arange(6) - 2.5])
    plants, last, memory = at_rest(start, task), np.full((6, 4), 1.96), np.zeros((6, controller.memory_size))
    error, P = [], np.tile(variance * np.eye(3), (6, 1, 1))
    for k in range(500):
        r, v = turn(DT * k)
        estimate = np.tile(r, (6, 1))
        for i in blind:
            estimate[i], P[i] = r + 5.0, 1e4 * np.eye(3)
        target = TargetEstimate(estimate - plants[:, :3], np.tile(v, (6, 1)), P, slots)
        comm, sensed = messages(plants, G, slots, task), sensed_rows(plants, task)
        decision = controller.decide(TeamSituation(plants, last, comm, sensed, target=target), memory)
        last, memory = decision.command, decision.memory
        plants = simulate(plants, last, task.params)
        error.append(np.linalg.norm(plants[:, :3] - turn(DT * (k + 1))[0] - slots, axis=1))
    return np.sqrt(np.mean(np.square(error[-100:]), axis=0))


def test_a_known_target_on_a_turn_is_followed_with_the_lag_of_its_acceleration():
    errors = fly_to_target(CooperativeMpc(team_task(neighbours=5), reach=2.0), 1e-9)
    np.testing.assert_allclose(errors, 0.142, atol=0.01)


def test_vehicles_with_a_useless_estimate_stay_with_their_neighbours():
    errors = fly_to_target(CooperativeMpc(team_task(neighbours=5), reach=2.0), 1e-3, blind=(4, 5))
    assert (errors < 0.5).all()


@pytest.mark.slow
def test_a_spanning_tree_is_sufficient_and_necessary():
    """40 random digraphs, static leader, the dissertation's frozen neighbours."""
    rng, outcomes = np.random.default_rng(0), []
    controller = CooperativeMpc(team_task(), neighbour="frozen", feed_forward=False, **ALONE)
    for trial in range(40):
        G = np.eye(6) + (rng.random((6, 6)) < (0.12, 0.2, 0.3)[trial % 3]) * ~np.eye(6, dtype=bool)
        G[0, 1:] = 0.0
        reached = np.linalg.matrix_power(G, 6)[:, 0] > 0.0
        flight = fly_team(controller, SORTED_START, TRIANGLE, G, still)
        assert (flight.error[-1] < 0.1) == reached.all(), trial
        outcomes.append(reached.all())
    assert 3 <= sum(outcomes) <= 37  # both happen


@pytest.mark.slow
def test_a_hundred_vehicles_keep_apart():
    slots = make_formation("lattice", 100)
    start = start_positions("random", slots, RNG)
    controller = CooperativeMpc(team_task(100, 8, 8))
    flight = fly_team(controller, start, slots, make_graph("weak", "lattice", 100), still, seconds=10.0)
    assert flight.gap >= 0.38
    assert not flight.fallbacks.any()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3, 4])  # 1 and 3 tumbled with a penalty of 1e4 per metre, 4 tilts most
def test_nobody_in_a_crowd_of_a_hundred_tumbles(seed):
    env = formation_v0.parallel_env(vehicles=100)
    policy, names = make_policy("consensus-mpc", env), env.possible_agents
    rows, state, tilt, gap = env.reset(seed=seed)[0], None, 0.0, np.inf
    while env.agents == names:
        actions, state = policy.predict(np.stack([rows[name] for name in names]), state)
        rows, _, crashed, _, infos = env.step(dict(zip(names, actions, strict=True)))
        tilt = max(tilt, np.abs(env.unwrapped.plants[:, 6:8]).max())
        gap = min(gap, *(info["min_separation"] for info in infos.values()))
    assert not any(crashed.values())
    assert tilt < np.radians(40.0)  # measured 23 to 35 degrees: the flight is chaotic
    assert gap >= 0.38  # soft rows; measured 0.398 to 0.408 m
    assert not state.fallbacks[:, 1:].any()


@pytest.mark.slow
def test_an_estimated_disturbance_is_rejected():
    """A vehicle 5 % too heavy: 0.39 N that nobody revealed."""
    task = team_task(1, 0, 0)
    heavy = replace(task.params, mass=1.05 * task.params.mass)
    sags = []
    for reject in (False, True):
        controller = CooperativeMpc(task, reject_disturbance=reject)
        plants, last = at_rest(np.zeros((1, 3)), task), np.full((1, 4), task.hover_force)
        memory = np.zeros((1, controller.memory_size))
        for _ in range(200):
            preview = np.zeros((1, 6, 8))
            preview[..., :3], preview[..., 7] = -plants[:, None, :3], 1.0
            situation = TeamSituation(
                plants, last, np.zeros((1, 0, 15)), np.zeros((1, 0, 7)), np.ones(1), preview
            )
            decision = controller.decide(situation, memory)
            last, memory = decision.command, decision.memory
            plants = simulate(plants, last, heavy, force_max=task.force_max)
        sags.append(abs(plants[0, 2]))
    assert sags[0] > 0.05
    assert sags[1] < 1e-3
