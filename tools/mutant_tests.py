"""Tests that touch the lines of a file: one traced run, fixtures counted for every test that uses them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import pytest


@dataclass(frozen=True)
class Touched:
    """Record of a traced run of the tests.

    Attributes:
        lines: of the file, by test.
        always: lines that ran while tests were collected: imports, and what parametrisation calls.
        took: time of each test [s].
    """

    lines: dict[str, frozenset[int]]
    always: frozenset[int]
    took: dict[str, float]

    def tests(self, lines: Collection[int] | None) -> list[str]:
        """Tests that touch one of the lines, the quickest first; all tests for None or what runs on import."""
        every = lines is None or bool(self.always.intersection(lines))
        found = [name for name, touched in self.lines.items() if every or touched.intersection(lines or ())]
        return sorted(found, key=lambda name: self.took[name])

    def seconds(self, tests: Collection[str]) -> float:
        """Time of some tests together [s]."""
        return sum(self.took[name] for name in tests)


def touched(scratch: Path, path: str, tests: list[str]) -> Touched:
    """Run tests in a copy of the checkout and record what they touch of a file.

    Raises:
        RuntimeError: when a test fails though nothing has been changed.
    """
    store = scratch / "touched.json"
    command = [sys.executable, "-m", "tools.mutant_tests", path, str(store), *tests]
    done = subprocess.run(
        command, cwd=scratch, env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}, capture_output=True, text=True
    )
    if done.returncode:
        raise RuntimeError(f"{path}: its tests fail without any change:\n{done.stdout[-4000:]}{done.stderr[-2000:]}")
    result = json.loads(store.read_text(encoding="utf-8"))
    return Touched(
        {name: frozenset(lines) for name, lines in result["lines"].items()}, frozenset(result["always"]), result["took"]
    )


class Recorder:
    """A pytest plugin that notes which lines of one file run, test by test."""

    def __init__(self, file: Path) -> None:
        """Trace ``file`` from now on."""
        self._file = os.path.realpath(file)
        self._known: dict[str, bool] = {}
        self.always: set[int] = set()
        self._open: list[set[int]] = [self.always]
        self._fixtures: dict[int, set[int]] = {}
        self.lines: dict[str, set[int]] = {}
        self.took: dict[str, float] = {}
        sys.settrace(self._enter)

    def _enter(self, frame: FrameType, event: str, argument: Any) -> Any:
        name = frame.f_code.co_filename
        known = self._known.get(name)
        if known is None:
            known = self._known[name] = os.path.realpath(name) == self._file
        if not known:
            return None
        self._open[-1].add(frame.f_lineno)
        return self._line

    def _line(self, frame: FrameType, event: str, argument: Any) -> Any:
        self._open[-1].add(frame.f_lineno)
        return self._line

    @contextmanager
    def _noting(self, lines: set[int]) -> Iterator[None]:
        self._open.append(lines)
        try:
            yield
        finally:
            self._open.pop()

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Iterator[None]:
        """Lines of a fixture belong to every test that uses it."""
        with self._noting(self._fixtures.setdefault(id(fixturedef), set())):
            return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Lines and time of one test."""
        begin = time.perf_counter()
        sys.settrace(self._enter)
        with self._noting(self.lines.setdefault(item.nodeid, set())):
            result = yield
        self.took[item.nodeid] = time.perf_counter() - begin
        used = getattr(item, "_fixtureinfo", None)
        for fixtures in used.name2fixturedefs.values() if used else ():
            for fixture in fixtures:
                self.lines[item.nodeid] |= self._fixtures.get(id(fixture), set())
        return result


def main(path: str, store: str, tests: list[str]) -> int:
    """Run the tests and write what they touch."""
    recorder = Recorder(Path(path))
    status = int(pytest.main(["-q", "-p", "no:cacheprovider", *tests], plugins=[recorder]))
    sys.settrace(None)
    result = {
        "lines": {name: sorted(lines) for name, lines in recorder.lines.items()},
        "always": sorted(recorder.always),
        "took": recorder.took,
    }
    Path(store).write_text(json.dumps(result), encoding="utf-8")
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2], sys.argv[3:]))
