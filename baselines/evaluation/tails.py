"""How bad rare flights are: an error that one flight in a thousand exceeds, and how probable a crash is.

Both need many flights, and are told from TAILS_LEAST on. Intervals are of 95 % and assume no distribution.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from quad_envs.parameters import Array

from .amounts import TAILS_LEAST
from .column import TAILED
from .columns import COLUMNS, Record
from .statistics import Interval
from .team_metrics import by_flight, flight_values

QUANTILE = 0.999
_OUTSIDE = 0.025  # probability beyond each end of an interval


def tails(records: Sequence[Record]) -> dict[str, Interval]:
    """Column -> number with its interval, "crash_probability" and the quantile of each error; nothing of few.

    A crashed flight has no error: it counts as larger than any, so that a quantile is infinite where more
    than one flight in a thousand crashed.
    """
    flights = by_flight(records)
    if len(flights) < TAILS_LEAST:
        return {}
    crashed = {seed for seed, team in flights.items() if any(record.crashed for record in team)}
    found = {}
    for column in COLUMNS.values():
        if column.has(TAILED):
            values = flight_values(records, column.name)
            worst = np.array([math.inf if seed in crashed else x for seed, x in values.items()])
            if np.isfinite(worst).any() and not np.isnan(worst).any():
                found[column.tail().name] = quantile_interval(worst)
    return found | {"crash_probability": share_interval(len(crashed), len(flights))}


def quantile_interval(values: Array, quantile: float = QUANTILE) -> Interval:
    """The least of the values that this share stays below or at, with an interval of order statistics.

    Args:
        values: (n,), infinity among them.
        quantile: The share.

    Returns:
        Its upper end is infinite where there are too few values to bound it.
    """
    from scipy.special import bdtr

    ordered, n = np.sort(values), len(values)
    below = bdtr(np.arange(n + 1.0), n, quantile)  # probability that so many values or fewer lie below it
    low = int(np.searchsorted(below, _OUTSIDE, side="right"))
    high = int(np.searchsorted(below, 1.0 - _OUTSIDE, side="left"))
    at = math.ceil(quantile * n * (1.0 - 1e-12)) - 1
    ends = (float(ordered[max(low - 1, 0)]), float(ordered[high]) if high < n else math.inf)
    return Interval(float(ordered[at]), *ends)


def share_interval(count: int, n: int) -> Interval:
    """A share with its exact interval of Clopper and Pearson; none in n has an upper bound, too."""
    from scipy.special import betaincinv

    low = float(betaincinv(count, n - count + 1, _OUTSIDE)) if count > 0 else 0.0
    high = float(betaincinv(count + 1, n - count, 1.0 - _OUTSIDE)) if count < n else 1.0
    return Interval(count / n, low, high)
