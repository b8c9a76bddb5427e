"""What is drawn while vehicles fly: gusts of the coming control period, and errors of sensors."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from ...compilation.decorators import inline_kernel
from ...compilation.normals import draw, drawn_size
from ...compilation.packed import IntArray
from ...disturbances import Disturbance, Gusts, blow, gust_numbers
from ...plant import N_STATE, Array
from ...tasks import BaseTask

_ERRORS = 2  # what normal numbers are for, beside those of gusts
_ERROR_NUMBERS = drawn_size(N_STATE)


class Draws(NamedTuple):
    """What n vehicles draw, packed for the kernels."""

    keys: Annotated[IntArray, "n"]  # of their episodes
    drawn: Annotated[Array, "B, S"]  # scratch of each block
    gusty: bool
    keep: float  # of gusts from node to node
    sizes: Annotated[Array, "6"]  # of gusts, N m and N
    noisy: bool
    deviations: Annotated[Array, "12"]  # of the sensors' errors


def gusts_in_flight(disturbance: Disturbance | None) -> Gusts | None:
    """A disturbance that is drawn while vehicles fly; others are tables of whole episodes."""
    return (
        disturbance if type(disturbance) is Gusts else None
    )  # other kinds of gusts draw what they are first


def make_draws(disturbance: Disturbance | None, task: BaseTask, substeps: int, n: int, blocks: int) -> Draws:
    """What is drawn of a task by n vehicles in so many blocks."""
    deviations, h = np.repeat(np.asarray(task.sensor_noise), 3), 0.5 * task.dt / substeps
    gusts = gusts_in_flight(disturbance)
    numbers = max(_ERROR_NUMBERS, gust_numbers(2 * substeps + 1) if gusts else 0)
    return Draws(
        keys=np.zeros(n, dtype=np.int64),
        drawn=np.zeros((blocks, numbers)),
        gusty=gusts is not None,
        keep=gusts.keep(h) if gusts else 1.0,
        sizes=gusts.size() if gusts else np.zeros(6),
        noisy=bool(deviations.any()),
        deviations=deviations,
    )


@inline_kernel
def draw_ahead(
    draws: Draws, i: int, block: int, step: int, disturbances: Array, noises: Array, which: IntArray
) -> None:
    """What vehicle i meets after the present step, and what its sensors tell now.

    Args:
        draws: The draws.
        i: Vehicle.
        block: Its block.
        step: Control steps since the reset.
        disturbances: Tables, (n, 1, 2 substeps + 1, 6): the coming period where there are gusts.
        noises: Tables, (n, 1, 12): the present errors where there are some.
        which: Its tables of both.
    """
    if draws.gusty:
        blow(disturbances[which[0], 0], draws.keys[i], step, draws.keep, draws.sizes, draws.drawn[block])
    if draws.noisy:
        errors, drawn = noises[which[1], 0], draws.drawn[block]
        draw(draws.keys[i], step, _ERRORS, drawn[:_ERROR_NUMBERS])
        for c in range(N_STATE):
            errors[c] = draws.deviations[c] * drawn[c]


def coming(draws: Draws, disturbances: Array, which: IntArray, steps: IntArray) -> Array:
    """Disturbances at the stage times of the control period that begins now, (n, 2 substeps + 1, 6).

    Args:
        draws: The draws.
        disturbances: Tables, (m, T, 2 substeps + 1, 6); the coming period alone where there are gusts.
        which: Table of each vehicle, (n,).
        steps: Control steps since its reset, (n,).
    """
    if disturbances.shape[1] == 0:
        return np.zeros((len(which), *disturbances.shape[2:]))
    return np.asarray(disturbances[which, 0 if draws.gusty else steps])
