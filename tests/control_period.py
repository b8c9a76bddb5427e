"""A control period in readable equations: RK4 with exact sines, rotors that lag in closed form."""

import numpy as np

from quad_envs.dynamics import derivative_reference, rotor_limits


def control_period(plants, commands, task, substeps, air):
    """Plants (n, 16) after each substep; `air`, (n or 1, 2 substeps + 1, 6), at the stage times."""
    h, found = task.dt / substeps, []
    x, F = plants[:, :12], plants[:, 12:]
    target = np.clip(commands, 0.0, rotor_limits(task.force_max, task.params))

    def slope(state, forces, node):
        torque, force = np.split(air[:, node], 2, axis=-1)
        return derivative_reference(state, forces, task.params, torque, force)

    for s in range(substeps):
        half, whole = (
            target + (F - target) * np.exp(-task.params.rotor_rate * time) for time in (0.5 * h, h)
        )
        k_1 = slope(x, F, 2 * s)
        k_2 = slope(x + 0.5 * h * k_1, half, 2 * s + 1)
        k_3 = slope(x + 0.5 * h * k_2, half, 2 * s + 1)
        k_4 = slope(x + h * k_3, whole, 2 * s + 2)
        x, F = x + h / 6.0 * (k_1 + 2.0 * k_2 + 2.0 * k_3 + k_4), whole
        found.append(np.concatenate([x, F], axis=1))
    return found
