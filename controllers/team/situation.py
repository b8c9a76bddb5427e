"""What the vehicles of a team measure, hear and believe when they decide; one row per vehicle."""

from __future__ import annotations

from typing import NamedTuple

from numpy.typing import ArrayLike


class TargetEstimate(NamedTuple):
    """What each vehicle believes of the target, and where it wants to be."""

    r: ArrayLike  # (n, 3), r^ - p_i, m
    v: ArrayLike  # (n, 3), inertial, m/s
    P: ArrayLike  # (n, 3, 3), covariance of r^, m^2
    slot: ArrayLike  # (n, 3), delta_it = wanted p_i - r_t, m


class TeamSituation(NamedTuple):
    """What a decision of a team is made from, laid out as in `quad_envs.observations.team`."""

    plant: ArrayLike  # measured [p, V_B, Theta, Omega, F], (n, 16); p matters only where the task limits it
    last_command: ArrayLike  # last applied rotor commands, (n, 4), N
    comm: ArrayLike  # messages, (n, K, 15 + 6 N_p)
    sensed: ArrayLike  # vehicles nearby, (n, K_s, 7)
    leader: ArrayLike | None = None  # which vehicles follow their preview, (n,) bool; None: none
    preview: ArrayLike | None = None  # a leader's reference relative to its own position, (n, >= N+1, 8)
    target: TargetEstimate | None = None  # None: there is no target
    disturbance: ArrayLike | None = None  # as far as revealed: body torque, N m, inertial force, N; (n, 6)
