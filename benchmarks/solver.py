"""The structured solver on random OCP-QPs of many families: statuses, residuals, steps, times.

Run `python -m benchmarks.solver --number 100000` for the full study.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable
from time import process_time
from typing import Any, NamedTuple

import numpy as np

from baselines.evaluation.table import format_table
from controllers.model import hover_pair
from controllers.qp import Solution, Status, StructuredSolver, residuals
from controllers.qp.ocp import OcpQp, no_rows, output_rows
from quad_envs.parameters import N_INPUT, N_STATE, Array, QuadrotorParams

HORIZONS = (1, 2, 3, 5, 8, 10, 15, 20, 25, 40, 60)
_SHARES = np.array([10, 10, 10, 15, 15, 15, 8, 7, 6, 2.5, 1.5]) / 100.0
Change = Callable[[np.random.Generator, OcpQp], OcpQp]


def base_problem(rng: np.random.Generator) -> OcpQp:
    """Random dynamics near the identity (half of them those of hover), box, rate, soft rows in 7 of 10."""
    n, m = N_STATE, N_INPUT
    N = int(rng.choice(HORIZONS, p=_SHARES))
    pairs = N if rng.random() < 0.4 else 1
    if rng.random() < 0.5:
        A_0, B_0 = hover_pair(QuadrotorParams(), 0.05)
        A, B = A_0 + 0.01 * rng.normal(size=(pairs, n, n)), np.repeat(B_0[None], pairs, 0)
    else:
        A, B = np.eye(n) + 0.1 * rng.normal(size=(pairs, n, n)), 0.3 * rng.normal(size=(pairs, n, m))
    Q = np.diag(10.0 ** rng.uniform(-1.0, 1.0, n))
    lower, upper = -3.0 * rng.random(m), 3.0 * rng.random(m)
    rows = no_rows()
    if rng.random() < 0.7:
        H = int(rng.integers(1, 6))
        half = 10.0 ** rng.uniform(-2.0, 1.0, H)
        rows = output_rows(rng.normal(size=(H, n)), -half, half, 10.0 ** rng.uniform(-3.0, 6.0), N)
    return OcpQp(
        A=np.ascontiguousarray(A), B=np.ascontiguousarray(B), c=0.1 * rng.normal(size=(N, n)),
        Q=Q[None].copy(),
        R=np.diag(10.0 ** rng.uniform(-1.0, 1.0, m))[None], Q_f=Q.copy(), stationary=False,
        x_0=rng.normal(size=n) * 10.0 ** rng.uniform(-2.0, 1.5), r=rng.normal(size=(N + 1, n)),
        lower=lower, upper=upper, rate_step=float(rng.choice([np.inf, 0.05, 0.5, 2.0])),
        u_last=rng.uniform(lower, upper), rows=rows,
    )  # fmt: skip


def _hard(rng: np.random.Generator, qp: OcpQp) -> OcpQp:
    return qp._replace(rows=qp.rows._replace(weight=np.full_like(qp.rows.weight, np.inf)))


def _weights(rng: np.random.Generator, qp: OcpQp) -> OcpQp:
    Q = np.diag(10.0 ** rng.uniform(-8.0, 8.0, N_STATE))
    return qp._replace(
        Q=Q[None].copy(), Q_f=Q.copy(), R=np.diag(10.0 ** rng.uniform(-6.0, 6.0, N_INPUT))[None]
    )


def _unstable(rng: np.random.Generator, qp: OcpQp) -> OcpQp:
    """Spectral radius 1.3. At 1.75 and N = 60 states grow by 1e15: round-off then makes the method cycle."""
    radius = np.abs(np.linalg.eigvals(qp.A)).max(axis=-1)
    return qp._replace(A=qp.A * (1.3 / radius)[:, None, None])


def _wide(rng: np.random.Generator, qp: OcpQp) -> OcpQp:
    free = np.full(N_INPUT, np.inf)
    return qp._replace(lower=-free, upper=free)


def _degenerate(rng: np.random.Generator, qp: OcpQp) -> OcpQp:
    normals: Array = qp.rows.normals.copy()
    normals[1:] = normals[:1] * rng.choice([1.0, -1.0, 2.0])
    return qp._replace(rows=qp.rows._replace(normals=normals))


FAMILIES: dict[str, Change] = {
    "plain": lambda rng, qp: qp,
    "hard rows": _hard,
    "weights apart": _weights,
    "no state weight": lambda rng, qp: qp._replace(Q=0.0 * qp.Q, Q_f=0.0 * qp.Q_f),
    "unstable": _unstable,
    "no box": _wide,
    "no freedom": lambda rng, qp: qp._replace(upper=qp.lower.copy()),
    "rate 0": lambda rng, qp: qp._replace(rate_step=0.0),
    "rate 1e-9": lambda rng, qp: qp._replace(rate_step=1e-9),
    "starts outside": lambda rng, qp: qp._replace(u_last=qp.upper + 10.0 * rng.random(N_INPUT)),
    "parallel rows": _degenerate,
    "equality rows": lambda rng, qp: qp._replace(rows=qp.rows._replace(lower=qp.rows.upper.copy())),
}


class Judged(NamedTuple):
    """One solve."""

    family: str
    qp: OcpQp
    solution: Solution
    stationarity: float
    primal: float
    seconds: float


def problem(seed: int, k: int) -> tuple[str, OcpQp]:
    """The family of problem k of a seed, and the problem: families in turn, a generator for each problem."""
    rng = np.random.default_rng([seed, k])
    family = list(FAMILIES)[k % len(FAMILIES)]
    return family, FAMILIES[family](rng, base_problem(rng))


def judge(number: int, seed: int) -> list[Judged]:
    """Solve the first `number` problems of a seed."""
    solver, found = StructuredSolver(), []
    for k in range(number):
        family, qp = problem(seed, k)
        begin = process_time()
        solution = solver.solve(qp)
        seconds = process_time() - begin
        optimal = solution.status == Status.OPTIMAL
        error = residuals(qp, solution) if optimal else None
        largest = 1.0 + float(max(np.abs(solution.u).max(), np.abs(solution.x).max()))
        found.append(
            Judged(
                family,
                qp,
                solution,
                error.stationarity if error else 0.0,
                error.primal / largest if error else 0.0,
                seconds,
            )
        )
    return found


def is_soft(qp: OcpQp) -> bool:
    """Whether the problem cannot be infeasible."""
    return bool(np.isfinite(qp.rows.weight).all())


def main() -> None:
    """Solve and print one line per family."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.solver", description=__doc__.splitlines()[0])
    parser.add_argument("--number", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    found = judge(arguments.number, arguments.seed)
    table: list[list[Any]] = []
    for family in FAMILIES:
        group = [one for one in found if one.family == family]
        count = Counter(one.solution.status for one in group)
        steps = [one.solution.iterations for one in group]
        times = 1e3 * np.array([one.seconds for one in group])
        table.append(
            [
                family,
                *(str(count[status]) for status in Status),
                *(
                    f"{max(errors):.0e}"
                    for errors in zip(*((one.stationarity, one.primal) for one in group), strict=True)
                ),
                *(f"{value:.0f}" for value in (*np.percentile(steps, [50, 99]), max(steps))),
                *(f"{value:.2f}" for value in (*np.percentile(times, [50, 99]), times.max())),
            ]
        )
    header = ["family", *(status.name.lower() for status in Status), "stationarity", "primal"]
    header += ["steps p50", "p99", "max", "ms p50", "p99", "max"]
    print(format_table(header, table))


if __name__ == "__main__":
    main()
