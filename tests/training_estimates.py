"""What flights of a training show, beside what an estimator in flight makes of the same observations."""

import numpy as np

from baselines.policies.disturbance_estimate import DisturbanceEstimator


def assert_seen_as_in_flight(flights):
    """Fly 15 steps at hover; whoever begins anew within them begins a new estimate."""
    n = flights.n
    estimator = DisturbanceEstimator(flights.task)
    memory, start = np.zeros((n, estimator.memory_size)), np.ones(n, dtype=np.bool_)
    columns, scale = flights.features.columns(estimator.task.layout), np.array(flights.features.scale)
    for _ in range(15):
        seen, memory = estimator.extend(flights._out, memory, start)
        wanted = (seen[:, columns] - np.array(flights.features.mean)) / scale
        np.testing.assert_allclose(flights.observe(), wanted, atol=1e-5)
        start = flights.advance(np.zeros((n, 4), dtype=np.float32)).done
