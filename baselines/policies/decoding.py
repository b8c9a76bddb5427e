"""Rows of agents' observations to the arguments of team controllers and filters, and back to actions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_envs.compilation.decorators import kernel
from quad_envs.envs.team.kernel import PLAN_SCALE
from quad_envs.observations.team import N_PLAN_STAGE, AgentLayout
from quad_envs.observations.tracking import decode_own
from quad_envs.parameters import Array

from .protocol import Actions, Counts
from .rows import first_not_finite
from .tracking import encode_commands

PLANT_SIZE = 16
_N_DISTURBANCE = 6
# Where the parts of a row begin, in this order; -1 for one that the layout lacks. `own` begins at 0.
_PARTS = (
    "position", "disturbance", "role", "preview", "comm", "sensed", "measured", "slot", "estimate",
)  # fmt: skip
_POSITION, _DISTURBANCE, _ROLE, _PREVIEW, _COMM, _SENSED, _MEASURED, _SLOT, _ESTIMATE = range(len(_PARTS))


class Decoded(NamedTuple):
    """The parts of n rows, float64 and flat; those that the layout lacks are zero or empty."""

    plant: Array  # (n, 16), [p, V_B, Theta, Omega, F]; p is zero unless observed
    last_command: Array  # (n, 4)
    leader: Array  # (n, 1), 1 for the leader
    preview: Array  # (n, 8 (preview + 1))
    comm: Array  # (n, K (15 + 6 plan))
    sensed: Array  # (n, 7 K_s)
    disturbance: Array  # (n, 6), torque, force
    measured: Array  # (n, 5 (1 + K)), or (n, 0)
    slot: Array  # (n, 3), or (n, 0)
    estimate: Array  # (n, 13 (1 + K)), or (n, 0)


def part_starts(layout: AgentLayout) -> Counts:
    """Where the parts begin, as `decode_rows` reads them."""
    slices = layout.slices
    return np.array([slices[name].start if name in slices else -1 for name in _PARTS], dtype=np.int64)


def empty_parts(layout: AgentLayout, n: int) -> Decoded:
    """Room for the parts of n rows."""
    sizes = {name: part.stop - part.start for name, part in layout.slices.items()}
    names = ("preview", "comm", "sensed", "measured", "slot", "estimate")
    preview, comm, sensed, *target = (np.empty((n, sizes.get(name, 0))) for name in names)
    own = (np.empty((n, PLANT_SIZE)), np.empty((n, 4)), np.empty((n, 1)))
    return Decoded(*own, preview, comm, sensed, np.empty((n, _N_DISTURBANCE)), *target)


@kernel
def _copy_part(row: Actions, start: int, out: Array) -> None:
    """Part of a row from `start` on as float64; zero where the layout lacks it."""
    for i in range(out.shape[0]):
        out[i] = row[start + i] if start >= 0 else 0.0


@kernel
def decode_rows(
    obs: Actions,
    starts: Counts,
    plants: Array,
    last_commands: Array,
    leaders: Array,
    previews: Array,
    comms: Array,
    sensed: Array,
    disturbances: Array,
    measured: Array,
    slots: Array,
    estimates: Array,
) -> int:
    """Split observations of agents; compiled twin of `AgentLayout.decode`.

    Args:
        obs: (n, layout.size) float32.
        starts: Of the parts, see `part_starts`.
        plants: Output, as the rest, see `Decoded`.
        last_commands: Output.
        leaders: Output.
        previews: Output.
        comms: Output.
        sensed: Output.
        disturbances: Output.
        measured: Output.
        slots: Output.
        estimates: Output.

    Returns:
        Flat index of the first entry that is not finite, or -1.
    """
    n, size = obs.shape
    for j in range(n):
        row, plant = obs[j], plants[j]
        bad = first_not_finite(row)
        if bad >= 0:
            return int(j * size + bad)
        decode_own(row, plant, last_commands[j])
        _copy_part(row, starts[_POSITION], plant[:3])
        leaders[j, 0] = 1.0 if row[starts[_ROLE]] > 0.5 else 0.0
        _copy_part(row, starts[_PREVIEW], previews[j])
        _copy_part(row, starts[_COMM], comms[j])
        _copy_part(row, starts[_SENSED], sensed[j])
        _copy_part(row, starts[_DISTURBANCE], disturbances[j])
        _copy_part(row, starts[_MEASURED], measured[j])
        _copy_part(row, starts[_SLOT], slots[j])
        _copy_part(row, starts[_ESTIMATE], estimates[j])
    return -1


@kernel
def split_memory(memory: Array, start: NDArray[np.bool_], first: Array, second: Array) -> None:
    """Memory (n, a + b) into its two parts (n, a) and (n, b), zero in rows that begin an episode."""
    m = first.shape[1]
    for j in range(memory.shape[0]):
        for i in range(m):
            first[j, i] = 0.0 if start[j] else memory[j, i]
        for i in range(second.shape[1]):
            second[j, i] = 0.0 if start[j] else memory[j, m + i]


@kernel
def join_memory(first: Array, second: Array, memory: Array) -> None:
    """Two parts of a memory, (n, a) and (n, b), into one (n, a + b)."""
    m = first.shape[1]
    for j in range(memory.shape[0]):
        for i in range(m):
            memory[j, i] = first[j, i]
        for i in range(second.shape[1]):
            memory[j, m + i] = second[j, i]


@kernel
def encode_plans(plans: Array, dt: float, actions: Actions) -> None:
    """Plans as the part of the actions that is sent.

    Args:
        plans: p relative to the present position and v for k+1..k+N, (n, 6 N); past its end it moves on.
        dt: Control period, s.
        actions: Output, (n, 6 N_p) float32, in units of PLAN_SCALE.
    """
    last = plans.shape[1] // N_PLAN_STAGE - 1
    for j in range(plans.shape[0]):
        for c in range(actions.shape[1]):
            q, part = c // N_PLAN_STAGE, c % N_PLAN_STAGE
            stage = N_PLAN_STAGE * min(q, last)
            value = plans[j, stage + part]
            if part < 3 and q > last:
                value += (q - last) * dt * plans[j, stage + 3 + part]
            actions[j, c] = min(max(value / PLAN_SCALE, -1.0), 1.0)


@kernel
def encode_decisions(
    commands: Array,
    plans: Array,
    fallback: Counts,
    iterations: Counts,
    left: Counts,
    start: NDArray[np.bool_],
    counts: Counts,
    worst: Counts,
    times_left: Counts,
    hover: float,
    force_max: Array,
    dt: float,
    first: Array,
    second: Array,
    actions: Actions,
    new_counts: Counts,
    new_worst: Counts,
    new_left: Counts,
    memory: Array,
) -> None:
    """Commands and plans to actions, the episode's statistics brought up to date, the memory joined.

    Args:
        commands: (n, 4), N.
        plans: (n, 6 N), see `encode_plans`.
        fallback: (n,), how each was found.
        iterations: (n,).
        left: (n,), 1 where it left the validity of its model.
        start: (n,) bool, rows whose statistics begin anew.
        counts: Statistics so far, (n, 5).
        worst: Statistics so far, (n,).
        times_left: Statistics so far, (n,).
        hover: Force of action 0, N.
        force_max: Force of action 1 of each rotor, (4,), N.
        dt: Control period, s.
        first: Part of the memory, (n, a).
        second: The other one, (n, b).
        actions: Output, (n, 4 + 6 N_p) float32.
        new_counts: Output, (n, 5).
        new_worst: Output, (n,).
        new_left: Output, (n,).
        memory: Output, (n, a + b).
    """
    encode_commands(
        commands, fallback, iterations, left, start, counts, worst, times_left, hover, force_max,
        actions[:, :4], new_counts, new_worst, new_left,
    )  # fmt: skip
    encode_plans(plans, dt, actions[:, 4:])
    join_memory(first, second, memory)
