"""The hunt for decisions without tests: what is changed, what the tests touch, what survives and why it may."""

from __future__ import annotations

import ast
import json
import shutil
import tomllib
from pathlib import Path

import pytest

from scripts import run_script
from tools.mutants import CHECKOUT, SURVIVORS, TARGETS
from tools.mutations import mutations

SOURCE = '''"""A file."""

LIMIT = 0.5


def near(gap: float, mover: bool) -> bool:
    """Whether to stop."""
    if mover and gap < LIMIT:
        return True
    return not mover


@compiled
def total(a: Array) -> float:
    return a[0] + max(a[1], 2)


class Box:
    def __repr__(self) -> str:
        return "box" + str(1)

    def first(self, rows: list[float]) -> float | None:
        self.seen = len(rows)
        return rows[0] if rows else None
'''


def test_each_mutant_differs_in_one_place_and_still_reads() -> None:
    found = mutations(SOURCE)
    assert len({mutation.name for mutation in found}) == len(found)
    for mutation in found:
        changed = mutation.applied(SOURCE)
        assert ast.unparse(ast.parse(changed)) != ast.unparse(ast.parse(SOURCE))
        assert sum(a != b for a, b in zip(changed.splitlines(), SOURCE.splitlines(), strict=True)) == 1
    names = {mutation.name for mutation in found}
    assert {
        "module: 0.5 -> 1.0",
        "near: gap < LIMIT -> gap >= LIMIT",
        "near: mover and gap < LIMIT -> (mover or (gap < LIMIT))",
        "near: True -> False",
        "near: not mover -> not (not mover)",
        "total: a[0] + max(a[1], 2) -> (a[0] - max(a[1], 2))",
        "total: max(a[1], 2) -> min(a[1], 2)",
        "Box.first: self.seen = len(rows) -> pass",
        "Box.first: rows[0] if rows else None -> None",
    } <= names
    assert not any("__repr__" in name for name in names)  # words are not decisions
    assert {mutation.compiled for mutation in found if mutation.function == "total"} == {True}


def test_names_do_not_depend_on_where_the_code_stands() -> None:
    moved = SOURCE.replace("LIMIT = 0.5", "LIMIT = 0.5\n\n# A remark: ä.\n")
    assert [m.name for m in mutations(moved)] == [m.name for m in mutations(SOURCE)]
    assert all(m.applied(moved) != moved for m in mutations(moved))


@pytest.mark.parametrize("path", TARGETS)
@pytest.mark.product(25)
def test_mutants_of_the_decisions_read_and_have_tests(path: str) -> None:
    source = (CHECKOUT / path).read_text(encoding="utf-8")
    found = mutations(source)
    assert len(found) > 10
    for mutation in found[:: len(found) // 5]:
        compile(mutation.applied(source), path, "exec", ast.PyCF_ONLY_AST)
    for name in TARGETS[path]:
        assert (CHECKOUT / "tests" / f"test_{name}.py").exists()


def test_every_excuse_belongs_to_a_file_that_is_searched_and_gives_a_reason() -> None:
    table = tomllib.loads(SURVIVORS.read_text(encoding="utf-8"))
    assert set(table) <= set(TARGETS)
    assert all(len(reason) > 10 for excuses in table.values() for reason in excuses.values())


HUNTED = """
import json, sys
from pathlib import Path
from tools.mutants import Hunt
from tools.mutant_tests import touched
from tools.mutations import mutations
import pytest
scratch, tests = Path(sys.argv[1]), ["tests/test_gate.py"]
seen = touched(scratch, "gate.py", tests)
hunt = Hunt(scratch, "gate.py", tests, seen)
said = {m.name: hunt.judge(m).outcome for m in mutations(hunt.source)}
print(json.dumps([said, seen.tests([9]), (scratch / "gate.py").read_text() == hunt.source]))
"""


@pytest.mark.product(2, of="processes of their own")
def test_a_hunt_tells_what_is_noticed_from_what_is_not(tmp_path: Path) -> None:
    (tmp_path / "tests").mkdir()
    for folder in ("benchmarks", "tools"):
        shutil.copytree(CHECKOUT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "gate.py").write_text(
        '''"""A gate."""


def closes(gap: float, least: float) -> bool:
    return gap < least


def width(gap: float) -> float:
    return gap * gap


def nobody(gap: float, most: float) -> bool:
    return gap > most
''',
        encoding="utf-8",
    )
    (tmp_path / "tests" / "test_gate.py").write_text(
        """import pytest
import gate

@pytest.fixture(scope="module")
def wide():
    return gate.width(1.0)

def test_closes():
    assert gate.closes(0.1, 0.25) and not gate.closes(0.3, 0.25)

def test_width(wide):
    assert wide > 0.0

def test_width_again(wide):
    assert wide > 0.1
""",
        encoding="utf-8",
    )
    done = run_script(HUNTED, tmp_path, cwd=tmp_path)
    said, users, restored = json.loads(done.stdout.splitlines()[-1])
    assert said == {
        "closes: gap < least -> gap >= least": "killed",
        "width: gap * gap -> (gap / gap)": "survived",
        "nobody: gap > most -> gap <= most": "unseen",
    }
    assert sorted(users) == ["tests/test_gate.py::test_width", "tests/test_gate.py::test_width_again"]
    assert restored


@pytest.mark.parametrize("mark", ["compiled", "inlined", "linked", "njit(cache=True)"])
def test_functions_under_numba_are_given_to_all_tests(mark: str) -> None:
    source = f"@{mark}\ndef f(x):\n    return x + 1\n\n\ndef g(x):\n    return x + 1\n"
    assert {change.function: change.compiled for change in mutations(source)} == {"f": True, "g": False}
