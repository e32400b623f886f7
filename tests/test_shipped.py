"""Kernels that come with the library: found by what they are made of, and by nothing else."""

from __future__ import annotations

import gc
import importlib.util
import logging
import lzma
import re
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from scripts import run_script
from unifg.codegen import compile_counter, fingerprint, jit, precompiled
from unifg.codegen.compile_counter import Tally, counting
from unifg.codegen.jit import compiled, in_order

SOURCE = """from unifg.codegen.jit import compiled
FACTOR = 2.0
@compiled
def inner(x):
    return FACTOR * x
def twice(x):
    return inner(x) + 0.0
"""


def module(path: Path, source: str) -> Any:
    """Module held by a file, imported anew under its own name."""
    path.parent.mkdir(exist_ok=True)
    path.write_text(source, encoding="utf-8")
    spec = importlib.util.spec_from_file_location("doubling", path)
    assert spec is not None and spec.loader is not None
    found = importlib.util.module_from_spec(spec)
    sys.modules["doubling"] = found
    spec.loader.exec_module(found)
    return found


@pytest.fixture(autouse=True)
def forgotten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The module is nobody else's, and so is the cache."""
    (tmp_path / "kept").mkdir()
    monkeypatch.setattr(fingerprint, "began", float("inf"))
    monkeypatch.setattr(jit, "cache_folder", lambda: tmp_path / "kept")
    yield
    sys.modules.pop("doubling", None)


@pytest.fixture
def archive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Of the function ``twice``, made in another folder, in the place of the library's own."""
    path = tmp_path / "kernels.zip"
    there = module(tmp_path / "there" / "doubling.py", SOURCE)
    with precompiled.recording() as recorder:
        assert compiled(there.twice)(3.0) == 6.0
    recorder.write(path)
    monkeypatch.setattr(precompiled, "ARCHIVE", path)
    precompiled.archive.cache_clear()
    yield path
    precompiled.archive.cache_clear()


def first_use(tmp_path: Path, source: str = SOURCE, how: Callable[..., Any] = compiled) -> Tally:
    """Tally of a first use in a new folder, which has no cache."""
    with counting() as counted:
        assert how(module(tmp_path / "here" / "doubling.py", source).twice)(3.0) == 6.0
    return counted


def test_only_code_is_generated_and_then_read(archive: Path, tmp_path: Path) -> None:
    first = first_use(tmp_path)
    assert (first.compiled, first.generated, first.read) == ([], ["doubling.twice"], [])
    function = module(tmp_path / "here" / "doubling.py", SOURCE).twice
    assert compiled(function)(3.0) == 6.0
    with counting() as second:
        assert compiled(function)(3.0) == 6.0
    assert (second.compiled, second.generated, second.read) == ([], [], ["doubling.twice"])


@pytest.mark.product(2, of="processes of their own")
@pytest.mark.parametrize(
    ("source", "how"),
    [
        (SOURCE.replace("FACTOR * x", "x + FACTOR + x - 2.0"), compiled),
        (SOURCE.replace("FACTOR = 2.0", "FACTOR = 2"), compiled),
        (SOURCE.replace("+ 0.0", "+ -0.0"), compiled),
        (SOURCE.replace("def inner(x)", "def inner(x, more=1.0)"), compiled),
        (SOURCE, in_order),
    ],
    ids=["callee", "constant", "number", "default", "liberties"],
)
def test_what_has_changed_is_compiled(archive: Path, tmp_path: Path, source: str, how: Callable[..., Any]) -> None:
    assert "doubling.twice" in first_use(tmp_path, source, how).compiled


@pytest.mark.parametrize("name", ["llvm", "platform", "surroundings"])
def test_an_archive_for_others_is_left_alone(
    archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    other = {**precompiled.versions(), name: "of another kind"}
    monkeypatch.setattr(precompiled, "versions", lambda: other)
    assert first_use(tmp_path).generated == []
    assert precompiled.outdated(archive) == ["archive"]


def test_a_numba_without_what_the_digest_reads_is_another_one(monkeypatch: pytest.MonkeyPatch) -> None:
    import numba.core.runtime

    present = precompiled.surroundings.__wrapped__
    assert present() == precompiled.surroundings()
    monkeypatch.setitem(sys.modules, "numba.core.runtime._nrt_python", None)
    monkeypatch.delattr(numba.core.runtime, "_nrt_python")
    assert present().startswith("unknown: ")


@pytest.mark.parametrize("content", [None, b"", b"PK nothing of the kind"], ids=["none", "empty", "no archive"])
def test_an_archive_that_cannot_be_read_is_none(
    archive: Path, tmp_path: Path, content: bytes | None, caplog: pytest.LogCaptureFixture
) -> None:
    archive.unlink()
    if content is not None:
        archive.write_bytes(content)
    assert "doubling.twice" in first_use(tmp_path).compiled
    assert (f"{archive} is damaged" in caplog.text) == (content is not None)


def rewritten(archive: Path, **changes: bytes) -> None:
    """Replace parts of an archive."""
    with zipfile.ZipFile(archive) as file:
        parts = {name: file.read(name) for name in file.namelist()} | changes
    with zipfile.ZipFile(archive, "w") as file:
        for name, data in parts.items():
            file.writestr(name, data)


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "cut off": lambda code: code[:-40],
    "other numbers": lambda code: lzma.compress(lzma.decompress(code).replace(b"2.000000e+00", b"3.000000e+00")),
    "empty": lambda code: b"",
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_members_that_are_damaged_are_none(
    archive: Path, tmp_path: Path, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    with zipfile.ZipFile(archive) as file:
        rewritten(archive, **{precompiled.CODE: DAMAGES[damage](file.read(precompiled.CODE))})
    assert "doubling.twice" in first_use(tmp_path).compiled
    assert caplog.text.count(f"{archive} is damaged") == 1


@pytest.mark.product(2, of="processes of their own")
def test_nothing_of_python_is_archived() -> None:
    """Every member that ships expects LLVM's, Numba's and C's functions alone, and holds neither objects nor errors."""
    shipped = precompiled.Archive(precompiled.ARCHIVE)
    assert shipped.usable
    for key in shipped.about["members"]:
        found = shipped.find(key)
        assert found is not None
        wrong = [symbol for symbol in precompiled.undefined(found[1]) if not precompiled.OUTSIDE.match(symbol)]
        assert wrong == [], found[0]["symbol"]
        assert not re.search(r"pickle|builtins\\94|inttoptr \(i64 \d{6,}", found[1]), found[0]["symbol"]


def test_an_error_of_archived_code_is_raised_here(archive: Path, tmp_path: Path) -> None:
    source = """from unifg.codegen.jit import compiled
import numpy as np
def twice(n):
    return np.empty(n)[0]
"""
    with precompiled.recording() as recorder, pytest.raises(ValueError, match="negative"):
        compiled(module(tmp_path / "there" / "doubling.py", source).twice)(-1)
    recorder.write(archive)
    precompiled.archive.cache_clear()
    function = compiled(module(tmp_path / "here" / "doubling.py", source).twice)
    with counting() as counted, pytest.raises(ValueError, match="arrays of other sizes"):
        function(-1)
    assert (counted.compiled, counted.generated) == ([], ["doubling.twice"])


FIRST = """
import importlib.util, sys
from pathlib import Path
from unifg.codegen import jit, precompiled
from unifg.codegen.compile_counter import counting

precompiled.ARCHIVE, source = map(Path, sys.argv[1:])
jit.cache_folder = lambda: None
spec = importlib.util.spec_from_file_location("unifg.doubling", source)
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
with counting() as counted:
    assert jit.compiled(module.first)((3.0, 1.0)) == 3.0
assert (counted.compiled, counted.generated) == ([], ["unifg.doubling.first"]), counted
"""


@pytest.mark.product(2, of="processes of their own")
def test_the_first_function_of_a_process_can_be_generated(archive: Path, tmp_path: Path) -> None:
    """Nothing has been compiled there that would have loaded Numba's rules for tuples."""
    source = "def first(pair):\n    return pair[0] + 0.0\n"
    with precompiled.recording() as recorder:
        compiled(module(tmp_path / "there" / "doubling.py", source).first)((3.0, 1.0))
    recorder.write(archive)
    run_script(FIRST, archive, tmp_path / "there" / "doubling.py")


@pytest.mark.parametrize(
    "source",
    [
        "\n# a comment\n" + SOURCE,
        SOURCE.replace("def inner(x):", 'def inner(x):\n    """Twice."""'),
        "def another(x):\n    return 5.0 * x\n" + SOURCE,
    ],
    ids=["comment", "docstring", "another function"],
)
def test_what_computes_the_same_is_found(archive: Path, tmp_path: Path, source: str) -> None:
    first = first_use(tmp_path, source)
    assert (first.compiled, first.generated, first.read) == ([], ["doubling.twice"], [])
    first = first_use(tmp_path, "\n" + source)
    assert (first.compiled, first.generated, first.read) == ([], [], ["doubling.twice"])


def test_an_archive_names_the_functions_that_have_changed_since(archive: Path, tmp_path: Path) -> None:
    module(tmp_path / "here" / "doubling.py", "\n" + SOURCE)
    assert precompiled.outdated(archive) == []
    module(tmp_path / "here" / "doubling.py", SOURCE.replace("+ 0.0", "+ 1.0"))
    assert precompiled.outdated(archive) == ["doubling:twice"]
    module(tmp_path / "here" / "doubling.py", SOURCE.replace("FACTOR * x", "x"))
    assert precompiled.outdated(archive) == ["doubling:inner", "doubling:twice"]
    sys.modules["doubling"] = type(sys)("doubling")
    assert precompiled.outdated(archive) == ["doubling:inner", "doubling:twice"]


def test_members_have_numbers_of_their_own(archive: Path) -> None:
    """Two functions of one name and of the same types would otherwise be one to the linker."""
    members = precompiled.Archive(archive).about["members"]
    numbers = [re.search(r"B\d+v(\d+)B", member["header"]["symbol"]) for member in members.values()]
    found = {int(number[1]) for number in numbers if number}
    assert len(members) == len(found) == 2 and min(found) >= jit.NUMBERS[0]


def test_a_compilation_is_announced_once_and_disturbs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(compile_counter.listener, "announced", False)
    before = gc.get_threshold()
    with caplog.at_level(logging.INFO, "unifg"):
        first_use(tmp_path)
        first_use(tmp_path, SOURCE.replace("+ 0.0", "+ -0.0"))
    (said,) = [record.message for record in caplog.records if record.levelno == logging.WARNING]
    assert "doubling.twice" in said and str(tmp_path / "kept") in said
    assert gc.get_threshold() == before

    @compiled
    def wrong(x: float) -> Any:
        return x.no_such_attribute  # type: ignore[attr-defined]

    with pytest.raises(Exception, match="no_such_attribute"):
        wrong(1.0)
    assert gc.get_threshold() == before


def test_reading_is_no_compilation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    function = module(tmp_path / "here" / "doubling.py", SOURCE).twice
    assert compiled(function)(3.0) == 6.0
    monkeypatch.setattr(compile_counter.listener, "announced", False)
    with counting() as counted:
        assert compiled(function)(3.0) == 6.0
    assert (counted.compiled, counted.generated, counted.read) == ([], [], ["doubling.twice"])
    assert counted.everything == 1 and caplog.records == []
