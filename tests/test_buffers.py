"""Memory of linearisations is handed out again when nothing refers to it, and not before."""

from __future__ import annotations

import copy

import numpy as np

from unifg.codegen.buffers import LARGE, SETS, Buffers


def at(array: np.ndarray[tuple[int], np.dtype[np.float64]]) -> int:
    """Address of an array."""
    return int(array.__array_interface__["data"][0])


def test_a_set_is_handed_out_again_once_nothing_refers_to_it() -> None:
    buffers = Buffers([LARGE, 3])
    first, second = buffers.take()
    where, part = at(first), first[10:20].reshape(2, 5)[1]
    assert (
        first.shape == (LARGE,) and second.shape == (3,) and first.flags.writeable and at(second) % 64 == at(first) % 64
    )
    del first, second
    assert at(buffers.take()[0]) != where, "a view of a view still refers to it"
    del part
    assert at(buffers.take()[0]) == where


def test_more_sets_than_are_kept_are_as_many_as_there_are() -> None:
    buffers = Buffers([LARGE])
    held = [buffers.take()[0] for _ in range(2 * SETS)]
    for number, array in enumerate(held):
        array[:] = number
    assert [float(array.max()) for array in held] == list(range(2 * SETS)) == [float(array.min()) for array in held]
    assert copy.copy(buffers).take()[0].shape == (LARGE,)
    assert len({at(array) for array in Buffers([3, 3]).take()}) == 2
