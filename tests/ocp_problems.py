"""Random OCP-QPs for the solver tests: perturbed hover models, boxes, rates, hard and soft state rows."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from controllers.qp.ocp import OcpQp, StateRows, concatenate_rows, no_rows, output_rows
from controllers.qp.riccati import dare
from quad_envs.parameters import ATTITUDE, POSITION, RATES, VELOCITY, QuadrotorParams

DT = 0.05
MODELS = ("stationary", "lti", "ltv")
LIMITS = ("none", "soft", "hard", "mixed")
VEHICLE = QuadrotorParams()
START_SCALE = np.repeat([3.0, 1.0, 0.3, 0.5], 3)


def model_pair(rng, spread):
    """Zero-order hold of the hover model plus a random sparse perturbation."""
    g = VEHICLE.gravity
    A = np.zeros((16, 16))
    A[POSITION, VELOCITY] = A[ATTITUDE, RATES] = np.eye(3)
    A[3, 7], A[4, 6] = -g, g
    A[:12, 12:] = VEHICLE.input_matrix()
    A[:12, :12] += spread * rng.normal(size=(12, 12)) * (rng.random((12, 12)) < 0.3)
    E = scipy.linalg.expm(A * DT)
    return E[:12, :12].copy(), E[:12, 12:].copy()


HOVER = model_pair(np.random.default_rng(0), 0.0)
HOVER_P = dare(*HOVER, np.eye(12), np.eye(4))


def hover_qp(N, x_0, upper=5.88, rate_step=np.inf, rows=None):
    """LMPC: the hover model with its own Riccati weight, regulation to the origin."""
    return OcpQp(
        A=HOVER[0][None],
        B=HOVER[1][None],
        c=np.zeros((N, 12)),
        Q=np.eye(12)[None],
        R=np.eye(4)[None],
        Q_f=HOVER_P,
        stationary=True,
        x_0=np.asarray(x_0, dtype=float),
        r=np.zeros((N + 1, 12)),
        lower=np.full(4, -1.96),
        upper=np.full(4, upper),
        rate_step=rate_step,
        u_last=np.zeros(4),
        rows=no_rows() if rows is None else rows,
    )


def velocity_rows(N, limit, weight):
    """|V_B| <= limit, component by component."""
    normals = np.zeros((3, 12))
    normals[:, VELOCITY] = np.eye(3)
    return output_rows(normals, np.full(3, -limit), np.full(3, limit), weight, N)


def tilt_rows(N, limit, weight):
    """|roll|, |pitch| <= limit."""
    normals = np.zeros((2, 12))
    normals[0, 6] = normals[1, 7] = 1.0
    return output_rows(normals, np.full(2, -limit), np.full(2, limit), weight, N)


def _random_rows(rng, N, x_0, limits) -> StateRows:
    parts = []
    if limits in ("soft", "mixed"):
        parts += [velocity_rows(N, 1.5, rng.choice([0.0, 2.0, 50.0, 1e3])), tilt_rows(N, 0.2, 1e3)]
    if limits in ("hard", "mixed"):
        normal = rng.normal(size=(1, 12))
        value = (normal @ x_0)[0]
        parts.append(
            output_rows(normal, np.array([min(value, 0) - 1.5]), np.array([max(0, value) + 1.5]), np.inf, N)
        )
    return concatenate_rows(*parts)


def random_qp(rng, N, model, limits):
    """One problem; `model` in MODELS, `limits` in LIMITS. Hard rows may be infeasible."""
    n_models = N if model == "ltv" else 1
    pairs = [model_pair(rng, 0.3) for _ in range(n_models)]
    A, B = (np.array([pair[k] for pair in pairs]) for k in range(2))
    Q, R = np.eye(12)[None], np.eye(4)[None]
    c = np.zeros((N, 12))
    if model == "ltv":
        root = 0.3 * rng.normal(size=(N, 12, 12))
        Q = root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(12)
        R = np.random.default_rng(N).uniform(0.05, 2.0, (N, 1, 1)) * R
        c = 0.02 * rng.normal(size=(N, 12))
    x_0 = START_SCALE * rng.normal(size=12)
    r = np.zeros((N + 1, 12))
    r[:, POSITION] = 2.0 * rng.normal(size=3)
    upper = float(rng.choice([5.88, 0.49]))
    return OcpQp(
        A=A,
        B=B,
        c=c,
        Q=Q,
        R=R,
        Q_f=dare(A[0], B[0], Q[0], np.eye(4)) if model == "stationary" else HOVER_P,
        stationary=model == "stationary",
        x_0=x_0,
        r=r,
        lower=np.full(4, -1.96),
        upper=np.full(4, upper),
        rate_step=float(rng.choice([np.inf, 0.25, 1.0])),
        u_last=rng.uniform(-2.2, upper + 0.1, 4),  # sometimes outside the box, as after a rotor fault
        rows=_random_rows(rng, N, x_0, limits),
    )
