"""How fast one large front is eliminated: a full matrix beside LAPACK's Cholesky factorisation of it.

Where many closures join poses at random, nearly all unknowns end in one front, and this is what a solve costs. Both
begin with the matrix as their callers have it: ours with the entries of its upper triangle, which go into the front,
LAPACK with a square array, which SciPy copies.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import scipy.linalg

from benchmarks.report import listing
from benchmarks.section import Result, goal
from benchmarks.timing import interleave, milliseconds, shown, spread, timed
from unifg.elimination.factorization import Factorization
from unifg.elimination.symmetric import Symmetric
from unifg.typing import Array

SIZES = 300, 600, 1200, 2100, 3000, 4500
NODE = 3  # scalars of a node


def matrix(size: int) -> Array:
    """(n, n), positive definite."""
    root = np.random.default_rng(0).normal(size=(size, size))
    full: Array = root @ root.T / size + NODE * np.eye(size)
    return full


def measure(rounds: int, small: bool = False) -> Result:
    """All sizes."""
    rows = [measure_size(size, rounds) for size in (SIZES[:1] if small else SIZES)]
    goals = [
        goal(f"a full matrix of {row['size']} rows", "times faster than LAPACK", row["ratio"], 1.0) for row in rows
    ]
    return {"rows": rows, "rounds": rounds, "goals": goals}


def measure_size(size: int, rounds: int) -> Result:
    """One matrix.

    Raises:
        AssertionError: what is solved with the factor is wrong.
    """
    first, second = np.tril_indices(size // NODE, -1)[::-1]
    pattern = Symmetric.of_blocks(np.arange(0, size + 1, NODE), first.astype(np.int64), second.astype(np.int64))
    full, columns = matrix(size), np.repeat(np.arange(size), np.diff(pattern.indptr))
    entries, factorization = full[pattern.indices, columns], Factorization(pattern)
    right = np.ones(size)
    assert factorization.factor(entries)
    np.testing.assert_allclose(full @ factorization.solve(right), right, atol=1e-9)
    times = interleave(
        {
            "ours": timed(partial(factorization.factor, entries)),
            "LAPACK": timed(partial(scipy.linalg.cholesky, full, lower=True, check_finite=False)),
        },
        rounds,
    )
    return {
        "size": size,
        "ours": milliseconds(times["ours"]),
        "LAPACK": milliseconds(times["LAPACK"]),
        "speed": float(size**3 / 6e9 / np.median(times["ours"])),
        "ratio": spread(times["LAPACK"] / times["ours"]),
    }


COLUMNS: dict[str, Callable[[Result], str]] = {
    "ours [ms]": lambda row: shown(row["ours"]),
    "LAPACK [ms]": lambda row: shown(row["LAPACK"]),
    "ours [10^9 multiplications and additions a second]": lambda row: f"{row['speed']:.1f}",
    "times faster": lambda row: shown(row["ratio"]),
}


def render(result: Result) -> str:
    """A table, and what it compares."""
    text = (
        "A full positive definite matrix, of one front, by one thread; LAPACK is SciPy's `cholesky` with OpenBLAS. "
        f"{result['rounds']} rounds."
    )
    return "\n\n".join([listing(("rows",), {(str(row["size"]),): row for row in result["rows"]}, COLUMNS), text])
