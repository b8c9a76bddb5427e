"""Products L'R of small matrices in vector registers, four rows of the result at a time.

Matrices are C-contiguous float64; the numbers of columns of both are multiples of four. Each entry is summed
in the order of the inner index, as in `linalg.matmul`, which takes matrices of other sizes.
"""

from __future__ import annotations

from typing import Any

from quad_envs.compilation.decorators import inline_kernel
from quad_envs.parameters import Array

from .vectors import WIDTH, add_scaled, entry, load, load_part, store, store_part, transposed, zero

BAND = 3 * WIDTH  # columns: so many of four rows fill the 16 registers of AVX2


@inline_kernel
def _load_band(A: Array, i: int, j: int) -> Any:
    """A[i, j : j + 12]."""
    return load(A, i, j), load(A, i, j + WIDTH), load(A, i, j + 2 * WIDTH)


@inline_kernel
def _store_band(band: Any, A: Array, i: int, j: int) -> None:
    """A[i, j : j + 12] = band."""
    store(band[0], A, i, j)
    store(band[1], A, i, j + WIDTH)
    store(band[2], A, i, j + 2 * WIDTH)


@inline_kernel
def _add_band(total: Any, factor: float, band: Any) -> Any:
    """Total + factor * band."""
    return (
        add_scaled(total[0], factor, band[0]),
        add_scaled(total[1], factor, band[1]),
        add_scaled(total[2], factor, band[2]),
    )


@inline_kernel
def _load_block(A: Array, i: int, j: int) -> Any:
    """The four rows of A[i : i + 4, j : j + 4]."""
    return load(A, i, j), load(A, i + 1, j), load(A, i + 2, j), load(A, i + 3, j)


@inline_kernel
def _store_block(rows: Any, A: Array, i: int, j: int) -> None:
    """A[i : i + 4, j : j + 4] = rows."""
    store(rows[0], A, i, j)
    store(rows[1], A, i + 1, j)
    store(rows[2], A, i + 2, j)
    store(rows[3], A, i + 3, j)


@inline_kernel
def _add_to_bands(L: Array, R: Array, i: int, j: int, t0: Any, t1: Any, t2: Any, t3: Any, out: Array) -> None:
    """Four rows of out, twelve columns from (i, j) on: t + L'R."""
    for k in range(L.shape[0]):
        band = _load_band(R, k, j)
        t0 = _add_band(t0, entry(L, k, i), band)
        t1 = _add_band(t1, entry(L, k, i + 1), band)
        t2 = _add_band(t2, entry(L, k, i + 2), band)
        t3 = _add_band(t3, entry(L, k, i + 3), band)
    _store_band(t0, out, i, j)
    _store_band(t1, out, i + 1, j)
    _store_band(t2, out, i + 2, j)
    _store_band(t3, out, i + 3, j)


@inline_kernel
def _add_to_block(L: Array, R: Array, i: int, j: int, t0: Any, t1: Any, t2: Any, t3: Any, out: Array) -> None:
    """As `_add_to_bands`, for four columns."""
    for k in range(L.shape[0]):
        row = load(R, k, j)
        t0 = add_scaled(t0, entry(L, k, i), row)
        t1 = add_scaled(t1, entry(L, k, i + 1), row)
        t2 = add_scaled(t2, entry(L, k, i + 2), row)
        t3 = add_scaled(t3, entry(L, k, i + 3), row)
    _store_block((t0, t1, t2, t3), out, i, j)


@inline_kernel
def product(L: Array, R: Array, out: Array) -> None:
    """L'R into out, for L (k, n), R (k, m) and out (n, m)."""
    m = R.shape[1]
    none = (zero(), zero(), zero())
    for i in range(0, L.shape[1], WIDTH):
        j = 0
        while j + BAND <= m:
            _add_to_bands(L, R, i, j, none, none, none, none, out)
            j += BAND
        while j < m:
            _add_to_block(L, R, i, j, zero(), zero(), zero(), zero(), out)
            j += WIDTH


@inline_kernel
def add_product(start: Array, L: Array, R: Array, out: Array) -> None:
    """Start + L'R into out, for L (k, n), R (k, m), start and out (n, m); out may be start."""
    m = R.shape[1]
    for i in range(0, L.shape[1], WIDTH):
        j = 0
        while j + BAND <= m:
            t0, t1 = _load_band(start, i, j), _load_band(start, i + 1, j)
            t2, t3 = _load_band(start, i + 2, j), _load_band(start, i + 3, j)
            _add_to_bands(L, R, i, j, t0, t1, t2, t3, out)
            j += BAND
        while j < m:
            t0, t1, t2, t3 = _load_block(start, i, j)
            _add_to_block(L, R, i, j, t0, t1, t2, t3, out)
            j += WIDTH


@inline_kernel
def negate(A: Array, out: Array) -> None:
    """-A into out."""
    for i in range(A.shape[0]):
        for j in range(0, A.shape[1], WIDTH):
            store(add_scaled(zero(), -1.0, load(A, i, j)), out, i, j)


@inline_kernel
def transpose(A: Array, out: Array) -> None:
    """A' into out, for A (n, m), both multiples of four."""
    for i in range(0, A.shape[0], WIDTH):
        for j in range(0, A.shape[1], WIDTH):
            t0, t1, t2, t3 = _load_block(A, i, j)
            _store_block(transposed(t0, t1, t2, t3), out, j, i)


@inline_kernel
def _mean(a: Any, b: Any) -> Any:
    """(a + b) / 2."""
    return add_scaled(add_scaled(zero(), 0.5, a), 0.5, b)


@inline_kernel
def symmetric_part(A: Array, out: Array) -> None:
    """(A + A') / 2 into out, which may not be A."""
    for i in range(0, A.shape[0], WIDTH):
        for j in range(0, i + WIDTH, WIDTH):
            t0, t1, t2, t3 = _load_block(A, j, i)
            t0, t1, t2, t3 = transposed(t0, t1, t2, t3)
            s0, s1, s2, s3 = _load_block(A, i, j)
            m0, m1, m2, m3 = _mean(s0, t0), _mean(s1, t1), _mean(s2, t2), _mean(s3, t3)
            _store_block((m0, m1, m2, m3), out, i, j)
            _store_block(transposed(m0, m1, m2, m3), out, j, i)


@inline_kernel
def add_matvec_transposed(A: Array, x: Array, sign: float, out: Array) -> None:
    """Adds sign A'x to out (n,), for A (k, n) and x (k,).

    Where A is symmetric or its transpose is at hand this is the way to a product with A: rows are added.
    """
    n, j = A.shape[1], 0
    while j + BAND <= n:
        t0, t1, t2 = load_part(out, j), load_part(out, j + WIDTH), load_part(out, j + 2 * WIDTH)
        for i in range(A.shape[0]):
            t0, t1, t2 = _add_band((t0, t1, t2), sign * x[i], _load_band(A, i, j))
        store_part(t0, out, j)
        store_part(t1, out, j + WIDTH)
        store_part(t2, out, j + 2 * WIDTH)
        j += BAND
    while j < n:
        total = load_part(out, j)
        for i in range(A.shape[0]):
            total = add_scaled(total, sign * x[i], load(A, i, j))
        store_part(total, out, j)
        j += WIDTH
