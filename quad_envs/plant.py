"""The row of a plant, [p, V_B, Theta, Omega, F]: what stands where."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

N_STATE = 12  # [p, V_B, Theta, Omega]
N_INPUT = 4  # rotor forces
POSITION = slice(0, 3)
VELOCITY = slice(3, 6)  # body axes
ATTITUDE = slice(6, 9)  # roll, pitch, yaw
RATES = slice(9, 12)
FORCES = slice(12, 16)  # rotor forces, appended to the state in plant rows
