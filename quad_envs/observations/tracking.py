"""Layout of the tracking observation: named slices, decoding, and the compiled encoder.

| slice | size | content |
|---|---|---|
| own | 18 | V_B 3, phi, theta, sin psi, cos psi, Omega 3, rotor forces 4, last command 4 |
| position | 3 | p, only where the task limits the position |
| disturbance | 6 | torque (body, N m), force (inertial, N) in the middle of the period, where revealed |
| preview | 8 (preview + 1) | p_ref - p 3, v_ref 3, sin psi_ref, cos psi_ref for k..k+preview |
| disturbance_estimate | 6 | torque and force as they were estimated, where somebody appends them |
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..compilation.decorators import Int, inline_kernel, kernel
from ..compilation.intrinsics import write_stage
from ..compilation.packed import IntArray
from ..lanes import COMMAND, COS_PSI, FORCES, PLANT, SIN_PSI, STEP, four, plus, twelve
from ..plant import Array
from ..references.table_row import N_REFERENCE as N_REFERENCE
from ..references.table_row import SEEN
from ..rotations import sincos

N_OWN = 18
Previews = NDArray[np.float32]


class TrackingView(NamedTuple):
    """The parts of tracking observations, batch axes first, float64."""

    V_B: Array  # (..., 3), m/s
    Theta: Array  # (..., 3), rad, yaw in (-pi, pi]
    Omega: Array  # (..., 3), rad/s
    F: Array  # (..., 4), N
    last_command: Array  # (..., 4), N
    position: Array  # (..., 3), m; zero where the task does not observe it
    torque: Array  # (..., 3), N m; zero where not revealed
    force: Array  # (..., 3), N; zero where not revealed
    preview: Array  # (..., preview + 1, 8): p_ref - p, v_ref, sin psi_ref, cos psi_ref


@dataclass(frozen=True, slots=True)
class TrackingLayout:
    """Which parts a tracking observation has and where they stand.

    Raises:
        ValueError: If preview is negative.
    """

    preview: int = 25  # stages of the reference after the present one
    position: bool = False
    disturbance: bool = False
    disturbance_estimate: bool = False  # behind the rest, where somebody estimates

    def __post_init__(self) -> None:
        if self.preview < 0:
            raise ValueError(f"preview must be >= 0 control periods, got {self.preview}")

    @property
    def slices(self) -> dict[str, slice]:
        """Name -> slice of the flat observation; the parts of `own` are named, too."""
        parts = [
            ("V_B", 3),
            ("phi_theta", 2),
            ("sin_cos_psi", 2),
            ("Omega", 3),
            ("F", 4),
            ("last_command", 4),
        ]
        if self.position:
            parts.append(("position", 3))
        if self.disturbance:
            parts.append(("disturbance", 6))
        parts.append(("preview", N_REFERENCE * (self.preview + 1)))
        if self.disturbance_estimate:
            parts.append(("disturbance_estimate", 6))
        out, start = {"own": slice(0, N_OWN)}, 0
        for name, size in parts:
            out[name] = slice(start, start + size)
            start += size
        return out

    @property
    def preview_start(self) -> int:
        """Index at which the preview begins."""
        return N_OWN + 3 * self.position + 6 * self.disturbance

    @property
    def size(self) -> int:
        """Length of the observation."""
        return self.preview_start + N_REFERENCE * (self.preview + 1) + 6 * self.disturbance_estimate

    def decode(self, observation: NDArray[np.floating]) -> TrackingView:
        """Split observations into named parts.

        Args:
            observation: (..., size).

        Returns:
            The parts with yaw as an angle.

        Raises:
            ValueError: If the last axis has another length.
        """
        obs = as_observations(observation, self.size)
        part = {name: obs[..., where] for name, where in self.slices.items()}
        batch = obs.shape[:-1]
        return TrackingView(
            **vehicle_parts(part, batch),
            preview=part["preview"].reshape(*batch, self.preview + 1, N_REFERENCE),
        )


def as_observations(observation: NDArray[np.floating], size: int) -> Array:
    """Observations (..., size) as float64.

    Raises:
        ValueError: If the last axis has another length.
    """
    obs = np.asarray(observation, dtype=np.float64)
    if obs.shape[-1:] != (size,):
        raise ValueError(f"observation must have {size} entries on its last axis, got shape {obs.shape}")
    return obs


def vehicle_parts(part: Mapping[str, Array], batch: tuple[int, ...]) -> dict[str, Array]:
    """What every view begins with, from `V_B` to `force`: yaw as an angle, zero for what is not observed.

    Args:
        part: Name -> slice of the observations, (*batch, size of the part).
        batch: Leading axes.
    """
    psi = np.arctan2(part["sin_cos_psi"][..., :1], part["sin_cos_psi"][..., 1:])
    zero = np.zeros((*batch, 6))
    disturbance = part.get("disturbance", zero)
    return {
        "V_B": part["V_B"],
        "Theta": np.concatenate([part["phi_theta"], psi], axis=-1),
        "Omega": part["Omega"],
        "F": part["F"],
        "last_command": part["last_command"],
        "position": part.get("position", zero[..., :3]),
        "torque": disturbance[..., :3],
        "force": disturbance[..., 3:],
    }


@inline_kernel
def measured(w: Array, j: Int, noise: Array) -> tuple[tuple[float, ...], tuple[float, float]]:
    """What the sensors of the vehicle in lane j tell of its state, and sine and cosine of the yaw they tell.

    Args:
        w: Block.
        j: Lane.
        noise: Its measurement errors, (n_steps, 12); no steps for none.
    """
    x, yaw = twelve(w, PLANT + j), (w[SIN_PSI + j], w[COS_PSI + j])
    if noise.shape[0] > 0:
        x = plus(x, noise[min(int(w[STEP + j]), noise.shape[0] - 1)], 1.0)
        yaw = sincos(x[8])
    return x, yaw


@inline_kernel
def encode_own(
    out: NDArray[np.float32], w: Array, j: Int, x: tuple[float, ...], yaw: tuple[float, float]
) -> None:
    """Write the `own` block of the vehicle in lane j.

    Args:
        out: Observation, (>= 18,) float32.
        w: Block.
        j: Lane.
        x: Its state as it is measured.
        yaw: Sine and cosine of the measured yaw.
    """
    out[0], out[1], out[2] = x[3], x[4], x[5]
    out[3], out[4], out[5], out[6] = x[6], x[7], yaw[0], yaw[1]
    out[7], out[8], out[9] = x[9], x[10], x[11]
    out[10], out[11], out[12], out[13] = four(w, FORCES + j)
    out[14], out[15], out[16], out[17] = four(w, COMMAND + j)


@inline_kernel
def encode_disturbance(out: NDArray[np.float32], start: int, coming: int, disturbance: Array) -> None:
    """Write torque and force in the middle of the coming period from out[start] on; zero without any.

    Args:
        out: Observation, float32.
        start: Where they stand.
        coming: Control period, of which the table's last row holds on; -1 after the last one.
        disturbance: Table, (n_steps, n_nodes, 6); no steps for none.
    """
    for i in range(6):
        out[start + i] = 0.0
    if coming >= 0 and disturbance.shape[0] > 0:
        row = disturbance[min(coming, disturbance.shape[0] - 1)]
        for i in range(6):
            out[start + i] = row[disturbance.shape[1] // 2, i]


@inline_kernel
def decode_own(row: NDArray[np.float32], plant: Array, command: Array) -> None:
    """Read the `own` block; the position in the plant is left as it is.

    Args:
        row: Observation, (>= 18,) float32.
        plant: Result, [p, V_B, Theta, Omega, F], (16,).
        command: Result, last rotor commands, (4,), N.
    """
    for i in range(3):
        plant[3 + i] = row[i]
        plant[9 + i] = row[7 + i]
    plant[6] = row[3]
    plant[7] = row[4]
    plant[8] = np.arctan2(np.float64(row[5]), np.float64(row[6]))
    for i in range(4):
        plant[12 + i] = row[10 + i]
        command[i] = row[14 + i]


@kernel
def tabulate_previews(references: Array, index: IntArray, previews: Previews) -> None:
    """Write what observations preview of reference tables.

    Args:
        references: All tables, (M, n_steps, N_TABLE).
        index: Which of them, (m,).
        previews: Result, (M, n_steps, N_PREVIEW), of all.
    """
    for m in range(index.size):
        table, words = references[index[m]], previews[index[m]]
        positions = words.view(np.float64)
        for k in range(table.shape[0]):
            for c in range(3):
                positions[k, c] = table[k, c]
            for c in range(3, N_REFERENCE):
                words[k, SEEN - 3 + c] = table[k, c]


@inline_kernel
def encode_preview(
    out: NDArray[np.float32],
    start: int,
    previews: Previews,
    step: int,
    stages: int,
    p: Sequence[float] | Array,
) -> None:
    """Write the reference from a step on, positions relative to p; the table's last rows hold on.

    Args:
        out: Observation, float32.
        start: Where it stands.
        previews: What is previewed of the reference, (n_steps, N_PREVIEW).
        step: Control step.
        stages: How many rows are seen.
        p: Position of the vehicle, (>= 3,), m.
    """
    row = min(step, previews.shape[0] - stages)
    for q in range(stages):
        write_stage(out, start + N_REFERENCE * q, previews, row + q, (p[0], p[1], p[2]))
