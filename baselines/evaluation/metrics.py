"""From a flight to the numbers by which policies are compared, and from flights to means with intervals.

The columns stand side by side and are never merged into one. RMS and effort are the dissertation's "average
RMS" and input effort: means over the samples k = 0..T-1 that were flown. What a crash cuts short, so that it
would look cheap, is nan, and so are the mean and the paired difference of these columns (CUT_SHORT) as soon
as one flight crashed: the mean over the survivors would favour a policy that crashes on the hard starts.

A team gives one record per vehicle. Its vehicles are averaged within a flight before anything else.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from quad_envs.constraints import TOLERANCE
from quad_envs.parameters import POSITION, Array
from quad_envs.tasks import TeamTask

from .amounts import INTERVAL_LEAST
from .column import COUNTED, CUT_SHORT, FALLBACK, REPORTED
from .columns import COLUMNS, Record, averaged, renamed, without_cut_short
from .episode import Episode
from .team_metrics import by_flight, flight_values, has_team, measure_team

SETTLED = 0.05  # share of the initial position error below which the vehicle has settled
SETTLING_LEAST = 0.1  # m, initial position error from which settling means anything
SATURATED = 1e-6  # N, distance from a face of the rotor box that counts as on it


def measure(episode: Episode) -> Record:
    """Reduce a flight to its numbers."""
    task, steps = episode.task, len(episode.rewards)
    v = np.minimum(1.0, episode.costs)
    bounded = (1.0 - v) / (1.0 + episode.stage_costs)
    if episode.crashed:
        bounded[-1] = 0.0  # as in the reward, which a wrapper or reward="quadratic" may have replaced
    error = _position_error(episode)
    du = episode.commands - task.hover_force
    excess = np.maximum(episode.constraint_values, 0.0).max(axis=0, initial=0.0)
    excess[excess <= TOLERANCE] = 0.0  # as the environments count violations
    p50, p99, slowest = decision_quantiles(episode.decision_times)
    record = Record(
        seed=episode.seed,
        steps=steps,
        score=float(bounded.sum()) / task.episode_steps,
        quadratic_cost=float(episode.stage_costs.sum()),
        constraint_cost=float(episode.costs.sum()),
        position_rms=_rms(error),
        steady_rms=_rms(error[task.episode_steps // 2 :]),
        effort=float((du * du).sum(axis=1).mean()),
        settling_time=_settling_time(error, task.dt),
        violation_share=float(episode.violations.mean()),
        crashed=episode.crashed,
        saturation_share=_saturation_share(episode.commands, task.force_max),
        decision_p50_ms=p50,
        decision_p99_ms=p99,
        decision_max_ms=slowest,
        relaxed=int(episode.fallbacks[1]),
        previous_plan=int(episode.fallbacks[2]),
        clipped_sdre=int(episode.fallbacks[3]),
        hover=int(episode.fallbacks[4]),
        iterations_max=episode.worst_iterations,
        worst_violation=dict(zip(task.constraint_names, excess.tolist(), strict=True)),
        agent=episode.agent,
        crash_cause=episode.crash_cause,
        left_model=episode.left_model,
        **_interventions(episode),
        **measure_team(episode),
    )
    return without_cut_short(record) if episode.crashed else record


def _interventions(episode: Episode) -> dict[str, float]:
    """What a safety filter did, nan without one."""
    if episode.interventions is None:
        return {column.name: math.nan for column in COLUMNS.values() if column.has(REPORTED)}
    changed, total, unanswered = (float(part[0]) for part in episode.interventions)
    steps, answered = len(episode.rewards), changed - unanswered
    return {
        "intervention_share": changed / steps,
        "intervention_size": total / answered if answered else math.nan,
        "unanswered_share": unanswered / steps,
    }


def _position_error(episode: Episode) -> Array:
    """|p_k - p_ref,k| for k = 0..T-1, (T,); nan where plants are not shown or are not commanded."""
    steps = len(episode.rewards)
    if isinstance(episode.task, TeamTask) and episode.task.mission == "estimation":
        return np.full(steps, np.nan)
    if episode.states.shape[1] == 0 or len(episode.references) < steps:
        return np.full(steps, np.nan)
    error = episode.states[:steps, POSITION] - episode.references[:steps, POSITION]
    return np.asarray(np.linalg.norm(error, axis=1))


def _rms(error: Array) -> float:
    return float(np.sqrt(np.mean(error * error))) if error.size else float("nan")


def _settling_time(error: Array, dt: float) -> float:
    """Last sample above 5 % of the initial error, s; nan if it begins small or stays above to the end."""
    if not error[0] >= SETTLING_LEAST:
        return float("nan")
    last = int(np.flatnonzero(error > SETTLED * error[0])[-1])
    return last * dt if last < len(error) - 1 else float("nan")


def _saturation_share(commands: Array, force_max: Array) -> float:
    if np.isnan(commands).any():  # actions that command no rotors
        return float("nan")
    return float(((commands <= SATURATED) | (commands >= force_max - SATURATED)).mean())


def decision_quantiles(seconds: Array) -> tuple[float, float, float]:
    """Median, 99th percentile and maximum of decision times, ms; nan if none was measured."""
    timed = seconds[np.isfinite(seconds)]
    if timed.size == 0:
        return float("nan"), float("nan"), float("nan")
    p50, p99 = np.percentile(timed, [50.0, 99.0])
    return 1e3 * float(p50), 1e3 * float(p99), 1e3 * float(timed.max())


class Estimate(NamedTuple):
    """A mean with its 95 % interval mean +- half_width (Student's t); nan below INTERVAL_LEAST values."""

    mean: float
    half_width: float
    n: int  # values behind it; those that are nan are left out


_NO_ESTIMATE = Estimate(float("nan"), float("nan"), 0)


def estimate(values: Iterable[float]) -> Estimate:
    """Mean and 95 % interval over flights."""
    from scipy.special import stdtrit

    x = np.array([value for value in values if np.isfinite(value)], dtype=np.float64)
    if x.size == 0:
        return _NO_ESTIMATE
    if x.size < INTERVAL_LEAST:
        return Estimate(float(x.mean()), float("nan"), x.size)
    t = float(stdtrit(x.size - 1, 0.975))
    return Estimate(float(x.mean()), t * float(x.std(ddof=1)) / float(np.sqrt(x.size)), x.size)


def paired_difference(ours: Sequence[Record], theirs: Sequence[Record], column: str) -> Estimate:
    """Mean of ours - theirs over flights from the same start, of teams over whole teams.

    The spread between starts is far larger than that between policies on one start. A column of CUT_SHORT has
    no difference, nan, where one of the paired flights crashed.

    Args:
        ours: Records of one policy.
        theirs: Records of another in the same environment.
        column: One that `summarize` averages.

    Raises:
        ValueError: If the column is not averaged, or no seed is in both.
    """
    names = [entry.name for entry in averaged(team=True)]
    if column not in names:
        (now,) = renamed({column: None})
        hint = f"; it is called {now!r} now" if now != column else ""
        raise ValueError(f"column must be one of {', '.join(names)}, got {column!r}{hint}")
    one, other = flight_values(ours, column), flight_values(theirs, column)
    seeds = dict.fromkeys(seed for seed in one if seed in other)
    if not seeds:
        raise ValueError("paired_difference needs flights with the same seeds, and these have none in common")
    crashed = any(record.crashed for record in (*ours, *theirs) if record.seed in seeds)
    if crashed and COLUMNS[column].has(CUT_SHORT):
        return _NO_ESTIMATE
    return estimate(one[seed] - other[seed] for seed in seeds)


def summarize(records: Sequence[Record]) -> dict[str, Estimate]:
    """Column -> estimate over flights, for every averaged column and for a team's, if it is one.

    Those of CUT_SHORT are nan if a flight crashed.
    """
    crashed = any(record.crashed for record in records)
    return {
        column.name: _NO_ESTIMATE
        if crashed and column.has(CUT_SHORT)
        else estimate(flight_values(records, column.name).values())
        for column in averaged(has_team(records))
    }


def totals(records: Sequence[Record]) -> dict[str, int]:
    """Column -> sum, for every counted column; of crashes the flights, however many vehicles crash."""
    names = [column.source for column in COLUMNS.values() if column.source and column.has(COUNTED | FALLBACK)]
    counts = {name: int(sum(getattr(record, name) for record in records)) for name in names}
    crashed = sum(any(record.crashed for record in team) for team in by_flight(records).values())
    return counts | {"crashed": crashed}


def crash_causes(records: Sequence[Record]) -> dict[str, int]:
    """Cause -> flights in which a vehicle crashed by it, the most frequent first."""
    found = Counter(
        cause
        for team in by_flight(records).values()
        for cause in {record.crash_cause for record in team} - {""}
    )
    return dict(found.most_common())


def said_causes(records: Sequence[Record]) -> str:
    """Those causes as words, "tilt 2, lost 1"."""
    return ", ".join(f"{cause} {n}" for cause, n in crash_causes(records).items())


def worst_violations(records: Sequence[Record]) -> Mapping[str, float]:
    """Constraint name -> largest excess over all flights, SI."""
    names = records[0].worst_violation if records else {}
    return {name: max(record.worst_violation[name] for record in records) for name in names}
