"""Equilibria along a plan whose estimated disturbance fades: gusts pass, and a plan may count on it.

At stage i of the plan act d_i = revealed + fade^i estimate. `feed_forward` has the forces u_e(d_i) and the
trim x_e(d_i) that stand still under them, so that for a model about hover the disturbance is worth
x_e - A x_e - B (u_e - u_hover) a sample. What the plan returns to is the equilibrium of what is left at its
end, d_N; with fade = 1, which is offset-free MPC, that is the equilibrium of every stage.
"""

from __future__ import annotations

from quad_envs.compilation.decorators import kernel
from quad_envs.parameters import N_INPUT, N_STATE, Array

from ..disturbance import N_DISTURBANCE, feed_forward
from ..qp.linalg import fill

EQUILIBRIUM = 2 + N_INPUT  # numbers of one stage: roll, pitch, and forces less those of the plan's end


@kernel
def spread_equilibrium(
    revealed: Array,
    estimate: Array,
    fade: float,
    psi: float,
    c: Array,
    force_max: Array,
    offset: Array,
    trim: Array,
    stages: Array,
    scratch: Array,
) -> None:
    """The equilibrium of each stage, and that of the plan's end.

    Args:
        revealed: What is known of the disturbance, (6,), which stays.
        estimate: Of the rest, (6,), which fades.
        fade: Its factor from stage to stage, in (0, 1].
        psi: Yaw, rad.
        c: QuadrotorParams.coefficients().
        force_max: Largest force of each rotor, (4,), N.
        offset: Rotor forces in equilibrium, (4,), N: now, on return at the end.
        trim: State in equilibrium, (12,), likewise.
        stages: Result, (N, EQUILIBRIUM).
        scratch: Changed, (3, 12).
    """
    N = stages.shape[0]
    if fade == 1.0:
        fill(stages, 0.0)
        for i in range(N):
            stages[i, 0], stages[i, 1] = trim[6], trim[7]
        return
    d, forces, state = scratch[0, :N_DISTURBANCE], scratch[1, :N_INPUT], scratch[2]
    share = 1.0
    for i in range(N):
        for a in range(N_DISTURBANCE):
            d[a] = revealed[a] + share * estimate[a]
        feed_forward(d, psi, c, force_max, forces, state)
        stages[i, 0], stages[i, 1] = state[6], state[7]
        for a in range(N_INPUT):
            stages[i, 2 + a] = forces[a]
        share *= fade
    for a in range(N_DISTURBANCE):
        d[a] = revealed[a] + share * estimate[a]
    feed_forward(d, psi, c, force_max, offset, trim)
    for i in range(N):
        for a in range(N_INPUT):
            stages[i, 2 + a] -= offset[a]


@kernel
def hold_equilibrium(A: Array, B: Array, fades: bool, stages: Array, c: Array) -> None:
    """c_i, so that each stage has its equilibrium in the model; zero without a lateral force that stays.

    Args:
        A: (1 or N, 12, 12).
        B: (1 or N, 12, 4).
        fades: Whether the forces of equilibrium differ along the plan.
        stages: Of `spread_equilibrium`, (N, EQUILIBRIUM).
        c: Result, (N, 12).
    """
    for i in range(c.shape[0]):
        j = i if A.shape[0] > 1 else 0
        roll, pitch = stages[i, 0], stages[i, 1]
        for a in range(N_STATE):
            own = roll if a == 6 else (pitch if a == 7 else 0.0)
            c[i, a] = own - A[j, a, 6] * roll - A[j, a, 7] * pitch
        if fades:
            for a in range(N_STATE):
                for b in range(N_INPUT):
                    c[i, a] -= B[j, a, b] * stages[i, 2 + b]
