"""Decisions outside the validity of their model: what counts, and how the count travels to the tables."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from flights import DT, HOVER, TASK, at_rest, decide_once, helix, window

from baselines import evaluate, make_policy
from baselines.evaluation.metrics import totals
from controllers import ExactNmpc, Fallback, LinearMPC, SdcNmpc
from controllers.mpc.kernels import FROZEN_SPAN, left_model
from controllers.mpc.options import EXACT_TILT, PLAN_TILT

N = 15
HELIX = "quad/HelixTracking-v0"
MPCS = (LinearMPC, SdcNmpc, ExactNmpc)


def outside(level, x_0, x, points, tilt, first):
    """`left_model` as one reads it."""
    planned = level not in (Fallback.PREVIOUS_PLAN, Fallback.HOVER)
    tilts = np.abs(np.vstack([x_0[None], x[1:] if planned else x[:0]])[:, 6:8])
    taken = np.vstack([points, np.repeat(points[-1:], len(x) - len(points), axis=0)])
    span = np.abs(x - taken)[1:, first:9] if planned else np.zeros(1)
    return tilts.max() > tilt + 1e-3 or span.max() > FROZEN_SPAN + 1e-3


def test_the_kernel_agrees_with_its_definition_over_random_plans():
    rng, found = np.random.default_rng(0), []
    for _ in range(400):
        scale, pairs = rng.choice([0.1, 0.25, 0.5]), rng.choice([1, N])
        x = scale * rng.normal(size=(N + 1, 12))
        points = x[:pairs] + 0.7 * scale * rng.normal(size=(pairs, 12))
        level, first = int(rng.integers(5)), int(rng.choice([6, 8]))
        tilt = rng.choice([PLAN_TILT, EXACT_TILT])
        x_0 = scale * rng.normal(size=12)
        found.append(bool(left_model(level, x_0, x, points, float(tilt), first)))
        assert found[-1] == outside(level, x_0, x, points, tilt, first)
    assert 50 < sum(found) < 350  # the plans show both


@pytest.mark.parametrize("solver", ["structured", "osqp"])
@pytest.mark.parametrize("mpc", MPCS)
def test_a_state_tilted_beyond_the_model_counts_and_hover_does_not(mpc, solver):
    for tilt, expected in ((0.0, 0), (1.1, 1)):
        decision = decide_once(mpc(TASK, horizon=N, solver=solver), at_rest(Theta=(tilt, 0.0, 0.0)))
        assert decision.left_model.tolist() == [expected]


@pytest.mark.parametrize("solver", ["structured", "osqp"])
def test_a_frozen_pair_that_a_plan_turns_away_from_counts_until_the_model_is_taken_again(solver):
    """A position weight of 30 asks for plans beyond half a radian from rest, and no farther than 0.8."""
    plant, Q = at_rest(p=(-2.5, 0.0, 0.0)), np.r_[np.full(3, 30.0), np.ones(9)]
    counts = []
    for passes in (0, 4):
        mpc = SdcNmpc(TASK, horizon=N, relinearisations=passes, Q=Q, solver=solver)
        counts.append(decide_once(mpc, plant).left_model[0])
    assert counts == [1, 0]


def test_the_hover_model_counts_a_heading_far_from_its_own_in_the_frame_of_the_dissertation():
    rows = window(helix, 0, N, psi=2.0)
    plant = at_rest(Theta=(0.0, 0.0, 2.0))
    for frame, expected in (("hover", 1), ("heading", 0)):
        assert decide_once(LinearMPC(TASK, horizon=N, frame=frame), plant, rows).left_model[0] == expected


def test_without_a_plan_of_its_own_a_decision_has_its_state_alone():
    mpc = LinearMPC(TASK, horizon=N, soft_weight=np.inf, iteration_limit=1, plan_tilt=0.3)
    far = at_rest(p=(-5.0, 4.0, 1.0))
    kept = decide_once(LinearMPC(TASK, horizon=N), at_rest())
    decision = decide_once(mpc, far, last=np.full(4, HOVER), memory=kept.memory[0])
    assert decision.fallback[0] == Fallback.PREVIOUS_PLAN
    assert decision.left_model[0] == 0


def test_the_count_is_per_row_and_begins_anew_with_an_episode():
    env = gymnasium.make(HELIX)
    policy, task = make_policy("lmpc", env, horizon=N), env.unwrapped.task
    level = np.stack([env.reset(seed=seed)[0] for seed in range(2)])
    tilted = level.copy()
    part = task.layout.slices["phi_theta"]
    tilted[1, part] = 1.2, 0.0
    _, state = policy.predict(tilted)
    assert state.left_model.tolist() == [0, 1]
    _, state = policy.predict(tilted, state)
    assert state.left_model.tolist() == [0, 2]
    one = policy.predict(tilted[1], policy.predict(tilted[1])[1])[1]
    assert one.left_model.tolist() == [2]  # a batch is its rows
    _, state = policy.predict(level, state, [False, True])
    assert state.left_model.tolist() == [0, 0]


def test_the_count_stands_beside_the_fallbacks_of_an_evaluation():
    """Starts at a roll of 1.1 rad: the first decisions of every flight are outside, those of hover never."""
    start = np.zeros(12)
    start[6] = 1.1
    env = gymnasium.make("quad/Regulation-v0", time_limit=20 * DT, start=start, start_box=0.5)
    flown = evaluate("lmpc", env, episodes=4, seed=0)
    counts = [record.left_model for record in flown.records]
    assert min(counts) > 0 and totals(flown.records)["left_model"] == sum(counts)
    assert f"left model {sum(counts)}" in str(flown)
    assert flown.to_dict()["left_model"] == sum(counts)
    assert not any(record.left_model for record in evaluate("hover", env, episodes=1).records)
