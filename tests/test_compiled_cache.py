"""Caches of compiled functions: read again, and begun anew where they cannot be read."""

from __future__ import annotations

import importlib.util
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from unifg.machine.jit import compiled

SOURCE = "def twice(x):\n    return 2.0 * x\n"


class Moved:
    """Stands for a type that an older version knew under another name."""

    def __reduce__(self) -> tuple[Any, ...]:
        """As pickled by a module that is no more."""
        return _gone, ()


def _gone() -> None:
    raise ModuleNotFoundError("No module named 'unifg.where_it_was'")


@pytest.fixture
def twice(tmp_path: Path) -> Callable[[float], float]:
    """A function in a file of its own, whose cache lies beside it."""
    path = tmp_path / "doubling.py"
    path.write_text(SOURCE, encoding="utf-8")
    spec = importlib.util.spec_from_file_location("doubling", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    function: Callable[[float], float] = module.twice
    return function


def read_from_cache(function: Any) -> bool:
    """Whether the last call's machine code came from the disk."""
    return bool(function.stats.cache_hits)


def test_machine_code_is_read_again(twice: Callable[[float], float]) -> None:
    first, second = compiled(twice), compiled(twice)
    assert first(3.0) == second(3.0) == 6.0
    assert not read_from_cache(first) and read_from_cache(second)


@pytest.mark.parametrize("damage", ["types have moved", "cut off", "empty", "no pickle"])
def test_a_cache_that_cannot_be_read_begins_anew(twice: Callable[[float], float], tmp_path: Path, damage: str) -> None:
    assert compiled(twice)(3.0) == 6.0
    (index,) = tmp_path.rglob("*.nbi")
    content = index.read_bytes()
    version = pickle.loads(content)
    index.write_bytes(
        {
            "types have moved": pickle.dumps(version) + pickle.dumps(((0.0, 0), {Moved(): "doubling"})),
            "cut off": content[:-20],
            "empty": b"",
            "no pickle": b"\x80\x04nothing of the kind",
        }[damage]
    )
    again = compiled(twice)
    assert again(3.0) == 6.0 and not read_from_cache(again)
    after = compiled(twice)
    assert after(3.0) == 6.0 and read_from_cache(after), "written anew"
