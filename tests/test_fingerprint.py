"""Digests of compiled functions: all that they reach counts, and nothing that computes the same."""

from __future__ import annotations

import hashlib
import json
import math
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from unifg.codegen import calls, loops
from unifg.codegen import fingerprint as room
from unifg.codegen.fingerprint import _parts, fingerprint, is_compiled
from unifg.codegen.jit import compiled, in_order
from unifg.codegen.loops import dot
from unifg.solvers import SQP, InteriorPoint

PLACES = {
    "helper.py": "def number(value):\n    return 2 * value\n",
    "callee.py": "from unifg.codegen.jit import compiled\n@compiled\ndef far(x):\n    return x + 1.0\n",
    "between.py": """
from unifg.codegen.jit import compiled
from callee import far
@compiled
def near(x):
    return far(x)
""",
    "entry.py": """
from typing import NamedTuple
import numpy as np
from numba.extending import intrinsic
from unifg.codegen.jit import compiled
from unifg.codegen.loops import dot
from unifg.solvers import SQP, InteriorPoint
from between import near
FACTOR = 3.0
TABLE = np.arange(3.0)
KIND = np.dtype([("a", np.float64)])

class Pair(NamedTuple):
    first: float
    second: float

def made(captured):
    @compiled
    def entry(x):
        own = FACTOR * x
        pair = Pair(own, captured)
        rows = np.zeros(1, KIND)
        return near(pair.first) + TABLE[1] + dot(TABLE, TABLE) + rows[0].a
    return entry
entry = made(1.5)
""",
}
CHANGES = {
    "formula": ("entry.py", "own = FACTOR * x", "own = FACTOR + x"),
    "captured number": ("entry.py", "made(1.5)", "made(1.25)"),
    "global constant": ("entry.py", "FACTOR = 3.0", "FACTOR = 3.5"),
    "array": ("entry.py", "np.arange(3.0)", "np.arange(3.0) + 1e-17"),
    "field of a named tuple": ("entry.py", "second: float", "other: float"),
    "dtype": ("entry.py", '("a", np.float64)', '("a", np.float32)'),
    "callee two files away": ("callee.py", "x + 1.0", "x + 2.0"),
}
NEUTRAL = {
    "comment": ("entry.py", "        own = ", "        # a comment\n        own = "),
    "docstring": ("entry.py", "    def entry(x):", '    def entry(x):\n        """Doubled."""'),
    "annotation": ("entry.py", "def entry(x):", "def entry(x: float) -> float:"),
    "another function": ("entry.py", "def made(", "def unrelated(x):\n    return x\n\ndef made("),
    "lines": ("callee.py", "@compiled", "\n\n\n@compiled"),
    "what is not reached": ("helper.py", "2 * value", "3 * value"),
}


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Folder of modules that are imported anew each time."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(room, "began", float("inf"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # sources of one second and one length look the same to it
    yield tmp_path
    _forget()


def _forget() -> None:
    for name in ("entry", "between", "callee", "helper"):
        sys.modules.pop(name, None)


def digest(folder: Path, change: tuple[str, str, str] | None = None) -> str:
    """Fingerprint of the entry, after one change."""
    _forget()
    for name, source in PLACES.items():
        if change is not None and change[0] == name:
            assert change[1] in source
            source = source.replace(change[1], change[2])
        (folder / name).write_text(source, encoding="utf-8")
    import entry  # type: ignore[import-not-found]

    found = fingerprint(entry.entry)
    sys.modules.pop("entry")
    return found


@pytest.mark.parametrize("change", CHANGES)
def test_what_computes_something_else_has_another_fingerprint(places: Path, change: str) -> None:
    assert digest(places, CHANGES[change]) != digest(places)


@pytest.mark.parametrize("change", NEUTRAL)
def test_what_computes_the_same_has_the_same(places: Path, change: str) -> None:
    assert digest(places, NEUTRAL[change]) == digest(places)


def test_a_file_that_has_changed_since_it_was_loaded_says_nothing(
    places: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression test: machine code of a function as it was would be kept as that of the function as it is."""
    digest(places)
    import entry

    function, before = entry.entry, fingerprint(entry.entry)
    monkeypatch.setattr(room, "began", time.time())
    later = time.time() + 10.0
    for name in ("entry.py", "callee.py"):
        path = places / name
        path.write_text(path.read_text(encoding="utf-8").replace("1.0", "2.0").replace("FACTOR * x", "FACTOR + x"))
        os.utime(path, (later, later))
    now = fingerprint(function)
    monkeypatch.setattr(room, "began", float("inf"))
    _forget()
    import entry

    assert fingerprint(entry.entry) not in (before, now)


def viewed(x: Any) -> Any:
    """View three numbers."""
    return calls.vector(x, 0, 3)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("def f(x):\n return math.sin(math.cos(x))", "def f(x):\n return math.cos(math.sin(x))"),
        ("def f(x):\n return x + math.pi", "def f(x):\n return x + math.tau"),
        ("def f(x):\n return x + 1.0", "def f(x):\n return x + 2.0"),
        ("def f(x, y):\n return y", "def f(x, *y):\n return y"),
    ],
)
def test_functions_without_a_file_differ_by_their_names_in_order(one: str, other: str) -> None:
    """As in a notebook: the bytecode counts names, and says in which place each is used."""
    found = []
    for source in (one, one, other):
        names: dict[str, Any] = {"math": math}
        exec(source, names)
        found.append(fingerprint(names["f"]))
    assert found[0] == found[1] != found[2]


def test_flags_and_helpers_of_primitives_count(monkeypatch: pytest.MonkeyPatch) -> None:
    source: Any = dot.py_func  # type: ignore[attr-defined]
    assert fingerprint(in_order(source)) != fingerprint(compiled(source)) == fingerprint(dot)
    before = fingerprint(viewed)
    monkeypatch.setattr(calls, "_view", calls._allocate)
    assert fingerprint(viewed) != before, "a helper of a primitive is another"


def test_own_variables_are_not_those_of_the_module() -> None:
    """Regression test: a variable named like an object of its module made a function another in every process."""
    tree = room._parsed(b"kind = 1\ndef f(x, kind):\n    total = kind + y\n    return [z for z in total]\n")
    (shape,) = tree.values()
    assert shape.names == ("y", "z")


def test_files_that_came_with_the_archive_are_not_parsed(monkeypatch: pytest.MonkeyPatch) -> None:
    content = Path(str(loops.__file__)).read_bytes()
    table = {hashlib.sha256(content).hexdigest(): json.loads(json.dumps(room._parsed(content)))}
    expected = room.shapes(str(loops.__file__))

    def refuse(content: bytes) -> None:
        raise AssertionError("parsed")

    monkeypatch.setattr(room, "_parsed", refuse)
    monkeypatch.setattr(room, "archived", lambda: table)
    room._shapes.cache_clear()
    assert room.shapes(str(loops.__file__)) == expected != {}


def test_no_shipped_function_has_an_address_in_its_fingerprint() -> None:
    """It would be another one in every process: compiled anew each time, and never found in the archive."""
    assert InteriorPoint().name and SQP().name  # their modules are there
    modules = [module for name, module in sys.modules.items() if name.startswith("unifg.")]
    functions = [found for module in modules for found in vars(module).values() if is_compiled(found)]
    assert len(functions) > 200
    for function in functions:
        assert [part for part in _parts(function, set()) if " at 0x" in part] == [], function
