"""The Riccati recursion over a finite horizon as its equations stand: the numpy twin of `qp.recursion`."""

from __future__ import annotations

import numpy as np


def backward(problem):
    """Gains K_i, (N, 4, n), Hessians S_i, (N, 4, 4), and costs to go P_{i+1}, (N, n, n)."""
    N, n = problem.c.shape
    K, S, P_next = np.empty((N, 4, n)), np.empty((N, 4, 4)), np.empty((N, n, n))
    P = problem.Q_f
    for i in range(N - 1, -1, -1):
        A, B = (pairs[i if len(pairs) > 1 else 0] for pairs in (problem.A, problem.B))
        P_next[i] = P
        S[i] = problem.R[i if len(problem.R) > 1 else 0] + B.T @ P @ B
        K[i] = np.linalg.solve(S[i], B.T @ P @ A)
        P = problem.Q[i if len(problem.Q) > 1 else 0] + A.T @ P @ (A - B @ K[i])
        P = 0.5 * (P + P.T)
    return K, S, P_next


def forward(problem, K, S, P_next):
    """Inputs u, (N, 4), and states x, (N+1, n), of the optimum."""
    N, n = problem.c.shape
    u, x = np.empty((N, 4)), np.empty((N + 1, n))
    pairs = [[pairs[i if len(pairs) > 1 else 0] for i in range(N)] for pairs in (problem.A, problem.B)]
    s = -problem.Q_f @ problem.r[N]
    for i, (A, B) in reversed(list(enumerate(zip(*pairs, strict=True)))):
        y = s + P_next[i] @ problem.c[i]
        u[i] = -np.linalg.solve(S[i], B.T @ y)
        s = (A - B @ K[i]).T @ y - problem.Q[i if len(problem.Q) > 1 else 0] @ problem.r[i]
    x[0] = problem.x_0
    for i, (A, B) in enumerate(zip(*pairs, strict=True)):
        u[i] -= K[i] @ x[i]
        x[i + 1] = A @ x[i] + B @ u[i] + problem.c[i]
    return u, x
