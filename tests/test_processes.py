"""Other processes: graphs go there, solutions come back and know their families by name."""

from __future__ import annotations

import copy
import multiprocessing as mp
import os
import pickle
from typing import Any

import numpy as np
import pytest

import unifg as fg
from backends import BACKENDS, Walk, everything, solved_as_sent, solved_elsewhere

KINDS = [*BACKENDS]
EVERY = os.environ.get("UNIFG_EVERY_START") == "1"  # as `make processes` sets it: a new interpreter takes seconds
every = pytest.mark.skipif(not EVERY, reason="make processes")


def like(mine: fg.Solution, theirs: fg.Solution) -> None:
    """A solution that has travelled says what it said."""
    np.testing.assert_array_equal(theirs["x"], mine["x"])
    assert (theirs.status, theirs.cost, theirs.iterations) == (mine.status, mine.cost, mine.iterations)
    assert [row.cost for row in theirs.history] == [row.cost for row in mine.history]
    for name, norms in mine.residuals.items():
        np.testing.assert_array_equal(theirs.residuals[name], norms)
    for name, multipliers in mine.multipliers.items():
        np.testing.assert_array_equal(theirs.dual(name), multipliers)
    assert theirs.report() == mine.report() and theirs.worst == mine.worst
    np.testing.assert_array_equal(theirs.marginals("x"), mine.marginals("x"))
    member = theirs.families["x"][-1]
    np.testing.assert_array_equal(theirs.covariance(member), mine.covariance(mine.families["x"][-1]))


@pytest.mark.parametrize("name", KINDS)
def test_solutions_travel(name: str) -> None:
    mine = Walk(name).solved(name, 2)
    assert mine.converged
    like(mine, pickle.loads(pickle.dumps(mine)))
    like(mine, copy.deepcopy(mine))  # whose covariance has been asked for
    like(mine, pickle.loads(pickle.dumps(mine)))


def test_a_solution_names_its_families() -> None:
    walk = Walk("gn")
    mine = walk.solved("gn", 1)
    sent = pickle.loads(pickle.dumps(mine))

    with pytest.raises(fg.GraphError, match=r"family 'x' is not part of this solution.*solution\.families"):
        sent[walk.x]
    np.testing.assert_array_equal(mine.covariance("x"), mine.covariance(walk.x))
    assert len(mine.plot("x").axes) > 0


def prepared_solve(work: tuple[Any, Walk]) -> fg.Solution:
    """A prepared solver that has come from another process."""
    prepared, walk = work
    solution: fg.Solution = prepared.solve(walk.guess)
    return solution


@pytest.mark.parametrize("start", ["fork", "spawn", pytest.param("forkserver", marks=every)])
@pytest.mark.product(1)
def test_pools_solve_with_every_backend(start: str) -> None:
    if start not in mp.get_all_start_methods():
        pytest.skip(f"this system does not {start}")
    work = everything()
    with mp.get_context(start).Pool(1) as pool:  # one process does all: it reads the compiled functions once
        found = pool.map(solved_as_sent, work, chunksize=len(work))
        for (name, walk, number), theirs in zip(work, found, strict=True):
            mine = walk.solved(name, number)
            np.testing.assert_allclose(theirs["x"], mine["x"], rtol=0, atol=1e-12, err_msg=name)
            assert theirs.status is mine.status
        if start == "fork":
            walk = Walk("ipm")
            there = pool.apply(prepared_solve, [(BACKENDS["ipm"].bound(walk.graph), walk)])
            np.testing.assert_allclose(there["x"], BACKENDS["ipm"].solve(walk.graph, walk.guess)["x"], atol=1e-12)


@every
def test_joblib() -> None:
    joblib, work = pytest.importorskip("joblib"), everything()
    found = joblib.Parallel(n_jobs=2, batch_size=len(work))(
        joblib.delayed(solved_elsewhere)(name, number) for name, _, number in work
    )
    for (name, walk, number), theirs in zip(work, found, strict=True):
        np.testing.assert_allclose(theirs["x"], walk.solved(name, number)["x"], rtol=0, atol=1e-12, err_msg=name)


@every
def test_dask() -> None:
    dask, work = pytest.importorskip("dask"), everything()
    for scheduler in ("threads", "processes"):
        asked = [dask.delayed(solved_elsewhere)(name, number) for name, _, number in work]
        found = dask.compute(*asked, scheduler=scheduler, num_workers=1)
        for (name, walk, number), theirs in zip(work, found, strict=True):
            np.testing.assert_allclose(theirs["x"], walk.solved(name, number)["x"], rtol=0, atol=1e-12, err_msg=name)
