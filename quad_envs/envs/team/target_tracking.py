"""Several quadrotors track a moving target (chapter 7), or estimate it from rails (chapter 6)."""

from __future__ import annotations

from .env import TeamEnv
from .options import EstimationOptions, TargetTrackingOptions


class TargetTrackingEnv(TeamEnv):
    """N quadrotors keep their slots beside a moving target that some of them measure.

    Description, actions, rewards, termination and infos are those of `FormationEnv`, with x* the own slot
    beside the true target and no leader.

    ## Observation Space
    As in `FormationEnv`, and the measurements of the target, the own one and those that arrive with the
    messages, and the own slot. Who measures nothing and hears nobody knows nothing of the target but the
    prior: at the start it is expected at -slot from the vehicle, with `prior_velocity`, both as uncertain as
    `prior_sigma` says (`task.prior_sigma`).

    ## Arguments
    Those of `FormationEnv` but `reference`, with `formation` "chapter-7" (6 slots) and `graph` "ring"; a
    named formation stands 1 m behind the target and is staggered in height, because a plane of vehicles
    cannot tell the target from its mirror image.
    Target: `target` "cv", "static", "turn", "aircraft" or a Target, `target_spread` (0, 0): standard
        deviations of its start and of its velocity, m and m/s.
    Sensor: `sensor` "range-azimuth-elevation" or another of `quad_envs.sensors.SENSORS`,
        `sensor_sigma` (0.1 m, 0.02 rad, 0.02 rad), `detection` probability 1, `measuring` "all" or vehicle
        numbers, `prior_velocity` (0, 0, 0) m/s, `prior_sigma` (3 m, 1 m/s).

    ## References
    G. Ru, Nonlinear Model Predictive Control for Cooperative Control and Estimation, 2017, chapter 7.
    """

    options_type = TargetTrackingOptions


class CooperativeEstimationEnv(TeamEnv):
    """N vehicles on rails estimate the position and the velocity of a target.

    ## Description
    `TargetTrackingEnv` with vehicles that fly straight on, whatever the actions: an action is an estimate.

    ## Action Space
    Of each agent `Box(-1, 1, (6,), float32)`: r^ = p_i + 20 m a[0:3] and v^ = 5 m/s a[3:6], of the target at
    the time of the observation.

    ## Rewards
    `1 / (1 + l)` with l = |r^ - r_t|^2 + |v^ - v_t|^2, which are the first two of `reward_terms`;
    `formation_error` is |r^ - r_t|.

    ## Arguments
    Those of `TargetTrackingEnv`, and `rails` (N, 3) first positions, `rail_velocity` (0.8, 0.3, -0.1) m/s.
    Defaults are the scenario of chapter 6: four vehicles, `graph` "chapter-6", and a target that starts
    `target_spread` (0.5 m, 0.5 m/s) from where it is expected.

    ## References
    G. Ru, Nonlinear Model Predictive Control for Cooperative Control and Estimation, 2017, chapter 6.
    """

    options_type = EstimationOptions
