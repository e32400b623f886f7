"""Descriptions of arrays by one address: arrays of another type are noticed, equal layouts are named once."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from calls import calls_of
from unifg.codegen import function_pointers
from unifg.codegen.function_pointers import LAYOUT, Memory
from unifg.errors import UnifgError

FIRST = (np.zeros((3, 2)), (np.zeros(4, dtype=np.int64), np.zeros(0)))


def read_only() -> Any:
    found = np.zeros((3, 2))
    found.flags.writeable = False
    return found


@pytest.mark.parametrize(
    "matrix", [np.zeros((3, 2), order="F"), np.zeros((3, 4))[:, ::2], np.zeros((3, 2), dtype=np.float32), np.zeros(6),
               read_only()], ids=["columns first", "with gaps", "single precision", "a vector", "read-only"],
)  # fmt: skip
def test_arrays_of_another_type_are_refused(matrix: Any) -> None:
    memory = Memory()
    memory.describe(FIRST)
    for wrong in ((matrix, FIRST[1]), (FIRST[0], FIRST[1], FIRST[0]), (FIRST[0], *FIRST[1])):
        with pytest.raises(UnifgError, match="compiled for arrays of type"):
            memory.describe(wrong)


def test_equal_layouts_are_named_once(monkeypatch: pytest.MonkeyPatch) -> None:
    named = calls_of(monkeypatch, function_pointers, "typeof")
    memory, again = Memory(), (np.ones((1, 5)), (np.arange(7), np.ones(1)))
    memory.describe(FIRST)
    words = memory.describe(again)
    assert len(named) == 1
    place = LAYOUT.index("data")
    assert words[place] == again[0].ctypes.data and words[place + 1 : place + 5].tolist() == [1, 5, 40, 8]
    assert len(words) == 9 + 7 + 7 and words[9 + place] == again[1][0].ctypes.data
