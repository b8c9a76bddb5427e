"""Weights of an MPC's cost: a number, a diagonal or a matrix, checked and made a matrix."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from quad_envs.arguments.kinds import holds_booleans, is_number
from quad_envs.arguments.names import shown
from quad_envs.parameters import MOST_WEIGHT, N_INPUT, Array
from quad_envs.rotations import sincos

_SYMMETRY = 1e-9  # relative, what two ways of summing the same matrix may differ by


def weight_matrix(name: str, value: ArrayLike, size: int, *, definite: bool) -> Array:
    """The weight as a symmetric matrix.

    Args:
        name: For messages.
        value: A number for all entries of the diagonal, the diagonal (size,), or the matrix (size, size).
        size: Number of entries.
        definite: Whether the matrix must be positive definite, else semidefinite.

    Returns:
        (size, size).

    Raises:
        ValueError: If the shape is another, an entry is not finite, or the matrix is not symmetric or not
            positive (semi)definite.
    """
    try:
        given = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        given = np.full(1, math.nan)
    fits = given.shape in ((), (size,), (size, size)) and not holds_booleans(value)
    if not (fits and (np.abs(given) <= MOST_WEIGHT).all()):
        raise ValueError(
            f"{name} must be a finite number, {size} of them (the diagonal) or a ({size}, {size}) matrix, "
            f"at most {MOST_WEIGHT:g}, got shape {given.shape}: {shown(value)}"
        )
    matrix = given.copy() if given.ndim == 2 else np.diag(np.broadcast_to(given, (size,)))
    scale = float(np.abs(matrix).max())
    if np.abs(matrix - matrix.T).max() > _SYMMETRY * scale:
        raise ValueError(f"{name} must be symmetric; take ({name} + {name}.T) / 2, which costs the same")
    matrix = 0.5 * (matrix + matrix.T)
    smallest = float(np.linalg.eigvalsh(matrix)[0])
    if smallest < -_SYMMETRY * scale or (definite and smallest <= 0.0):
        kind = "positive definite" if definite else "positive semidefinite"
        raise ValueError(f"{name} must be {kind}, its smallest eigenvalue is {smallest:.6g}")
    return np.ascontiguousarray(matrix)


def change_weight(value: ArrayLike | None) -> Array:
    """The weight of changes of the rotor forces, (4, 4), or (0, 4) for none: None, or zeros.

    Raises:
        ValueError: As `weight_matrix`.
    """
    if value is None:
        return np.zeros((0, N_INPUT))
    matrix = weight_matrix("R_rate", value, N_INPUT, definite=False)
    return matrix if matrix.any() else matrix[:0]


def terminal_weight(value: ArrayLike, P: Array) -> Array:
    """The weight of x_N: P of the Riccati equation by a factor, or another matrix.

    Args:
        value: A factor >= 0, or a positive semidefinite matrix of the shape of P.
        P: Solution of the Riccati equation, (n, n).

    Raises:
        ValueError: If it is neither.
    """
    if np.ndim(value) == 0:
        if not (is_number(value) and value >= 0.0):
            raise ValueError(f"terminal must be a finite factor >= 0 of P or a matrix, got {shown(value)}")
        return P * float(value)
    if np.ndim(value) != 2:
        raise ValueError(f"terminal must be a factor of P or a {P.shape} matrix, got shape {np.shape(value)}")
    return weight_matrix("terminal", value, len(P), definite=False)


def require_turnable(Q: Array) -> None:
    """Check that the weight of the state reads the same in every heading, as frame "heading" needs.

    Raises:
        ValueError: If it weighs x and y differently or couples one of them.
    """
    turn = np.eye(len(Q))
    sine, cosine = sincos(1.0)  # any angle that is no symmetry of the axes
    turn[:2, :2] = (cosine, sine), (-sine, cosine)
    if not np.allclose(turn @ Q @ turn.T, Q, rtol=0.0, atol=_SYMMETRY * np.abs(Q).max()):
        raise ValueError(
            "frame 'heading' poses the problem in the vehicle's axes and needs equal weights on x and y, not "
            f"coupled to others; got Q[:2, :2] = {Q[:2, :2].tolist()}: use frame='hover'"
        )
