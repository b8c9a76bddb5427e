"""A task in the form that kernels read: one vector of numbers, and what stands where."""

from __future__ import annotations

import numpy as np

from ...limits import LIMITS, N_OUTPUT
from ...plant import Array
from ...tasks import Task, TeamTask
from .vehicle_options import CRASH_TILT

DT, SUBSTEPS, HOVER, EPISODE_STEPS, PREVIEW, QUADRATIC, LOST = range(7)
SEES_POSITION, SEES_DISTURBANCE, TILT_OF_CRASH, N_LIMITS = range(7, 11)  # the last: how many are set
ACTION_MAX = slice(11, 15)  # force of action +1, N
WEIGHT_Q = slice(15, 27)
WEIGHT_R = slice(27, 31)
# The limits: the box of every output y = [x, u - u_previous], then of each limit that is set its entries.
LOWER = 31
UPPER = LOWER + N_OUTPUT
FIRST = UPPER + N_OUTPUT  # first output of each
STOP = FIRST + len(LIMITS)  # behind its last output
SCALE = STOP + len(LIMITS)  # violation that costs the whole reward of a step
TASK_SIZE = SCALE + len(LIMITS)


def task_vector(task: Task | TeamTask, substeps: int, lost_distance: float) -> Array:
    """The task as kernels read it, (TASK_SIZE,).

    Args:
        task: What is flown.
        substeps: RK4 steps in a control period.
        lost_distance: Distance from the reference at which a flight is lost, m.
    """
    limits = task.limits
    chosen = limits.chosen()
    vector = np.zeros(TASK_SIZE)
    vector[:LOWER] = np.array(
        [
            task.dt,
            substeps,
            task.hover_force,
            task.episode_steps,
            task.layout.preview,
            task.reward == "quadratic",
            lost_distance,
            task.layout.position,
            task.layout.disturbance,
            CRASH_TILT,
            len(chosen),
            *task.force_max,
            *task.weights.Q,
            *task.weights.R,
        ],
        dtype=np.float64,
    )
    vector[LOWER:UPPER], vector[UPPER:FIRST] = limits.output_box(task.dt)
    for k, limit in enumerate(chosen):
        vector[FIRST + k], vector[STOP + k] = limit.outputs.start, limit.outputs.stop
        vector[SCALE + k] = limits.scale(limit, task.dt)
    return vector
