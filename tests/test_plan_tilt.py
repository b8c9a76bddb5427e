"""Plans keep to the tilt for which their model holds; SDC-NMPC takes its model again where they turn far."""

import gymnasium as gym
import numpy as np
import pytest
from flights import at_rest, decide_once, plan_of

import quad_envs  # noqa: F401  registers the ids
from baselines import evaluate, make_policy
from controllers import ExactNmpc, LinearMPC, SdcNmpc
from controllers.mpc.kernels import leaves_bound
from quad_envs.parameters import Limits
from quad_envs.tasks import Task

HEAVY = [100.0] * 3 + [0.01] * 9
FLAVOURS = [LinearMPC, SdcNmpc, ExactNmpc]
FAR = at_rest((5.0, 0.0, 0.0))


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_a_plan_that_would_tilt_too_far_is_made_again_within_the_tilt(flavour):
    """The plan is that of an MPC whose task has the same limit."""
    chosen = 0.5
    free = decide_once(flavour(Task(), horizon=15, Q=HEAVY, plan_tilt=np.inf), FAR)
    kept = decide_once(flavour(Task(), horizon=15, Q=HEAVY, plan_tilt=chosen), FAR)
    bounded = Task(limits=Limits(tilt=chosen))
    own = decide_once(
        flavour(bounded, horizon=15, Q=HEAVY, soft_weight=1e4, margin=0.0, plan_tilt=np.inf), FAR
    )
    free, kept, own = (plan_of(decision, 15) for decision in (free, kept, own))
    assert np.abs(free - kept).max() > 1e-3
    np.testing.assert_allclose(kept, own, atol=1e-6)  # the same optimum of two active sets


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_a_plan_that_stays_level_is_the_one_without_the_rows(flavour):
    free, kept = (
        decide_once(flavour(Task(), horizon=15, plan_tilt=tilt), at_rest((0.3, -0.2, 0.1)))
        for tilt in (np.inf, 0.8)
    )
    np.testing.assert_array_equal(free.command, kept.command)


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_both_solvers_keep_to_the_tilt(flavour):
    """OSQP stops at residuals of 1e-5."""
    exact, approximate = (
        decide_once(flavour(Task(), horizon=10, Q=[10.0] * 3 + [0.1] * 9, solver=solver), FAR).command
        for solver in ("structured", "osqp")
    )
    np.testing.assert_allclose(approximate, exact, atol=1e-2)


def test_leaves_bound_looks_at_what_is_planned_and_has_a_bound():
    x, tilt, none = np.zeros((4, 12)), np.full(12, np.inf), np.full(12, np.inf)
    tilt[6:8] = 0.8
    x[0, 6] = x[3, 8] = 2.0  # the present roll and a yaw do not count
    assert not leaves_bound(x, tilt)
    x[2, 7] = -0.9
    assert leaves_bound(x, tilt) and not leaves_bound(x, none)
    x[2, 7], tilt[11] = 0.0, 3.0
    assert not leaves_bound(x, tilt)
    x[1, 11] = 3.1  # a body rate
    assert leaves_bound(x, tilt)


@pytest.mark.parametrize("tilt", [0.0, -1.0, np.nan])
def test_a_tilt_that_is_none_is_refused(tilt):
    with pytest.raises(ValueError, match="plan_tilt must be > 0 rad"):
        LinearMPC(Task(), plan_tilt=tilt)


@pytest.mark.parametrize("passes", ["always", -1, 1.5])
def test_relinearisations_are_auto_or_a_whole_number(passes):
    with pytest.raises(ValueError, match=r"'auto'.*a whole number >= 0"):
        SdcNmpc(Task(), relinearisations=passes)


def test_by_itself_sdc_nmpc_relinearises_where_the_plan_turns_far_and_only_there():
    for plant, passes in ((at_rest((0.01, 0.0, 0.0)), 0), (FAR, 1)):
        auto, fixed = (
            decide_once(SdcNmpc(Task(), horizon=15, Q=HEAVY, relinearisations=number), plant).command
            for number in ("auto", passes)
        )
        np.testing.assert_array_equal(auto, fixed)
    assert SdcNmpc(Task(), frame="hover").relinearisations == 0


@pytest.mark.slow
@pytest.mark.parametrize("horizon", [10, 25, 60])
@pytest.mark.parametrize("reference", ["helix", "spiral", "lemniscate"])
def test_whatever_the_weights_nobody_loses_a_vehicle_and_sdc_nmpc_is_no_worse_than_lmpc(reference, horizon):
    """1.02 of the cost: seen is 1.00, and less with heavy positions."""
    for position in (1.0, 10.0, 100.0):
        for rest in (1.0, 0.1, 0.01):
            env = gym.make(
                "quad/HelixTracking-v0",
                Q=(position,) * 3 + (rest * position if position < 100.0 else rest,) * 9,
                reference=reference,
                preview=max(horizon, 25),
            )
            found = {
                name: evaluate(make_policy(name, env, horizon=horizon), env, episodes=1).records[0]
                for name in ("lmpc", "sdc-nmpc", "nmpc")
            }
            assert not any(record.crashed for record in found.values()), (position, rest)
            assert found["sdc-nmpc"].quadratic_cost <= 1.02 * found["lmpc"].quadratic_cost, (position, rest)
