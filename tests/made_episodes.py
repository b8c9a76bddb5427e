"""Episodes made by hand, whose numbers a test knows without a flight."""

import numpy as np

from baselines.evaluation.episode import Episode


def hovering(task, steps, **changes):
    """Of full length: at the reference, hovering, within limits."""
    values = {
        "task": task,
        "seed": 0,
        "states": np.zeros((steps + 1, 16)),
        "references": np.zeros((steps + 1, 8)),
        "commands": np.full((steps, 4), task.hover_force),
        "rewards": np.ones(steps),
        "stage_costs": np.zeros(steps),
        "costs": np.zeros(steps),
        "violations": np.zeros(steps, dtype=bool),
        "constraint_values": np.zeros((steps, len(task.constraint_names))),
        "decision_times": np.full(steps, 1e-4),
        "fallbacks": np.array([steps, 0, 0, 0, 0]),
        "worst_iterations": 0,
        "crashed": False,
        "terminated": False,
        "truncated": True,
    }
    return Episode(**(values | changes))
