"""Readable twins of what is drawn in flight: normal numbers, gusts, errors of sensors."""

import numpy as np

AT_FIRST, FROM_NODE_TO_NODE, ERRORS = 0, 1, 2
LOW = np.uint64(2**32 - 1)


def philox(counter, key):
    """Four words (..., 4) of counters (..., 4) and a key (2,), as in Salmon et al. 2011."""
    a, b, c, d = np.moveaxis(np.asarray(counter, dtype=np.uint64), -1, 0)
    k_0, k_1 = int(key[0]), int(key[1])
    for _ in range(10):
        first, second = a * np.uint64(0xD2511F53), c * np.uint64(0xCD9E8D57)
        a, c = (second >> np.uint64(32)) ^ b ^ np.uint64(k_0), (first >> np.uint64(32)) ^ d ^ np.uint64(k_1)
        b, d = second & LOW, first & LOW
        k_0, k_1 = (k_0 + 0x9E3779B9) % 2**32, (k_1 + 0xBB67AE85) % 2**32
    return np.stack([a, b, c, d], axis=-1)


def normal_numbers(key, step, what, count):
    """Standard normal numbers in the order of the kernel, a multiple of 16 and at least `count`."""
    blocks = -(-count // 16) * 4
    counter = np.zeros((blocks, 4), dtype=np.uint64)
    counter[:, 0], counter[:, 1], counter[:, 2] = np.arange(blocks), step, what
    words = philox(counter, divmod(key, 2**32)[::-1]).astype(np.float64)
    radius = np.sqrt(-2.0 * np.log((words[:, ::2] + 0.5) / 2.0**32))
    angle = 2.0 * np.pi * words[:, 1::2] / 2.0**32 - np.pi
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1).reshape(blocks, 4).T.ravel()


def gusts(key, steps, nodes, keep, size):
    """First-order Gauss-Markov processes at the nodes of all control periods, (steps, nodes, 6)."""
    values = [size * normal_numbers(key, 0, AT_FIRST, 6)[:6]]
    for k in range(steps):
        fresh = normal_numbers(key, k, FROM_NODE_TO_NODE, 6 * (nodes - 1))[: 6 * (nodes - 1)].reshape(-1, 6)
        for z in fresh:
            values.append(keep * values[-1] + np.sqrt(1.0 - keep**2) * size * z)
    at = np.arange(steps)[:, None] * (nodes - 1) + np.arange(nodes)
    return np.array(values)[at]


def errors(key, step, deviations):
    """Errors of the sensors at a step, (12,)."""
    return np.repeat(deviations, 3) * normal_numbers(key, step, ERRORS, 12)[:12]
