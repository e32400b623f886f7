"""Caches of compiled functions: read again, and begun anew where they cannot be read."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from threading import Event
from typing import Any

import numba
import numpy as np
import platformdirs
import pytest

from scripts import loaded, run_script
from unifg.codegen import cache_folder, jit
from unifg.codegen.artifact import Artifact
from unifg.codegen.dispatcher import ADDRESS, LINKED, PYTHON
from unifg.codegen.fingerprint import fingerprint
from unifg.codegen.jit import compiled
from unifg.codegen.objects import read_sealed, write_sealed
from unifg.scenarios.command import main

FORKS = pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this platform")
SOURCE = "def twice(x):\n    return 2.0 * x\n"


@pytest.fixture
def twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[float], float]:
    """A function in a file of its own, with a cache of its own."""
    monkeypatch.setenv(cache_folder.VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(jit, "cache_folder", cache_folder.cache_folder.__wrapped__)
    path = tmp_path / "doubling.py"
    path.write_text(SOURCE, encoding="utf-8")
    function: Callable[[float], float] = loaded(path).twice
    return function


def read_from_cache(function: Any) -> bool:
    """Test whether the last call's machine code came from the disk."""
    return bool(function.stats.cache_hits)


def test_machine_code_is_read_again(twice: Callable[[float], float]) -> None:
    first, second = compiled(twice), compiled(twice)
    assert first(3.0) == second(3.0) == 6.0
    assert not read_from_cache(first) and read_from_cache(second)


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "zeroed": lambda content: bytes(len(content)),
    "cut off": lambda content: content[: len(content) // 2],
    "empty": lambda content: b"",
    "random": lambda content: np.random.default_rng(1).bytes(len(content)),
    "one bit": lambda content: content[:-100] + bytes([content[-100] ^ 4]) + content[-99:],
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_named_and_written_anew(
    twice: Callable[[float], float], tmp_path: Path, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    assert compiled(twice)(3.0) == 6.0
    (file,) = tmp_path.rglob("*.code")
    file.write_bytes(DAMAGES[damage](file.read_bytes()))
    again = compiled(twice)
    assert again(3.0) == 6.0 and not read_from_cache(again)
    assert [str(file) in record.message for record in caplog.records if "is damaged" in record.message] == [True]
    after = compiled(twice)
    assert after(3.0) == 6.0 and read_from_cache(after), "written anew"


@pytest.mark.parametrize("change", [{"result": "no such type"}, {"arguments": None}, {"symbol": "elsewhere"}])
def test_code_whose_header_says_something_else_begins_anew(
    twice: Callable[[float], float], tmp_path: Path, change: dict[str, Any], caplog: pytest.LogCaptureFixture
) -> None:
    first = compiled(twice)
    assert first(3.0) == 6.0
    (file,) = tmp_path.rglob("*.code")
    made = first._cache._made((numba.float64,), fingerprint(twice))  # type: ignore[attr-defined]
    content = read_sealed(file)
    assert content is not None and content.startswith(made)
    artifact = Artifact.unpacked(content[len(made) :])
    header = {name: value for name, value in (artifact.header | change).items() if value is not None}
    write_sealed(file, made + artifact._replace(header=header).packed())
    again = compiled(twice)
    assert again(3.0) == 6.0 and not read_from_cache(again) and str(file) in caplog.text
    assert read_from_cache(again) or compiled(twice)(3.0) == 6.0


def test_code_of_other_versions_is_left_alone(
    twice: Callable[[float], float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    assert compiled(twice)(3.0) == 6.0
    monkeypatch.setattr(numba, "__version__", "0.1")
    other = compiled(twice)
    assert other(3.0) == 6.0 and not read_from_cache(other)
    assert "damaged" not in caplog.text


def test_functions_made_under_one_name_have_files_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Loops over the elements of two manifolds took each other's file, and were compiled in every process."""
    monkeypatch.setattr(jit, "cache_folder", lambda: tmp_path)

    def made(factor: float) -> Callable[[float], float]:
        def scaled(x: float) -> float:
            return factor * x

        scaled.__qualname__ = "scaled"
        return compiled(scaled)

    for known in (False, True):
        scales = made(2.0), made(3.0)
        assert [scale(1.0) for scale in scales] == [2.0, 3.0]
        assert [read_from_cache(scale) for scale in scales] == [known, known]


MEET = """
import os, sys
import numpy as np
from unifg.codegen.compile_counter import tally
from unifg.codegen.jit import in_order

def made(k):
    @in_order
    def inner(x, y):
        s = 0.0
        for i in range(len(x)):
            for j in range(len(y)):
                a = np.sin(x[i] * k) + np.cos(y[j]) * np.exp(-x[i]) + np.arctan2(x[i], y[j])
                b = np.sin(y[j] * k) + np.cos(x[i]) * np.exp(-y[j]) + np.arctan2(y[j], x[i])
                if a > b:
                    s += np.tan(a) * np.sqrt(abs(b)) + np.log1p(abs(a))
                elif a < -b:
                    s -= np.tanh(a) * np.cbrt(abs(b)) + np.expm1(-abs(a))
                else:
                    s += np.hypot(a, b) + np.sinh(a) + np.cosh(b)
        return s

    @in_order
    def outer(x, y):
        return inner(x, y) + inner(y, x) + inner(x, x) + inner(y, y) + inner(x[1:], y)
    return outer

def check(k):
    function, x, y = made(k), np.arange(4.0), np.ones(3)
    assert abs(function(x, y) - function.py_func(x, y)) < 1e-9, (k, function(x, y), function.py_func(x, y))

for word in sys.argv[2:]:
    if sys.argv[1] == "fork":
        child = os.fork()
        if child == 0:
            check(float(word))
            os._exit(0)
        assert os.waitpid(child, 0)[1] == 0
    else:
        check(float(word))
print(bool(tally.compiled))
"""


@pytest.mark.parametrize("runs", [["here 2", "here 3"], pytest.param(["fork 2 3"], marks=FORKS)], ids=["runs", "forks"])
@pytest.mark.product(2, of="processes of their own")
def test_what_processes_have_compiled_meets_in_a_third(tmp_path: Path, runs: list[str]) -> None:
    """Numba numbers the functions of each process from one: two callers took the first one's copy of their callee."""
    for run in (*runs, "here 2 3"):
        ended = run_script(MEET, *run.split(), variables={cache_folder.VARIABLE: str(tmp_path)})
    assert ended.stdout.strip() == "False"


def test_functions_are_made_ready_no_further_than_they_are_used(
    twice: Callable[[float], float], tmp_path: Path
) -> None:
    """A callee has neither machine code nor a wrapper; asked for more it is compiled again, and then serves all."""

    def uses() -> list[tuple[int, bool]]:
        found = [read_sealed(path) or b"" for path in sorted(tmp_path.rglob("*twice*.code"))]
        return [(part.header["use"], bool(part.code)) for part in (Artifact.unpacked(item[32:]) for item in found)]

    callee: Any = compiled(twice)
    assert adding(callee, 1.0)(3.0) == 7.0 and uses() == [(LINKED, False)]
    callee.compile((numba.float64,))
    assert uses() == [(ADDRESS, True)]
    assert callee(3.0) == 6.0 and uses() == [(PYTHON, True)]
    again: Any = compiled(twice)
    assert adding(again, 1.0)(3.0) == 7.0 and again(3.0) == 6.0 and read_from_cache(again)
    assert uses() == [(PYTHON, True)], "what serves more is not overwritten by what serves less"


def test_code_that_callers_link_is_read_without_machine_code(twice: Callable[[float], float], tmp_path: Path) -> None:
    for offset in (1.0, 2.0):
        callee: Any = compiled(twice)
        assert adding(callee, offset)(3.0) == 6.0 + offset
    assert read_from_cache(callee)


def adding(callee: Callable[[float], float], offset: float) -> Callable[[float], float]:
    @compiled
    def caller(x: float) -> float:
        return callee(x) + offset

    return caller


def test_a_file_holds_the_signature_it_is_named_by(twice: Callable[[float], float], tmp_path: Path) -> None:
    assert compiled(twice)(3.0) == 6.0 and compiled(twice)(3) == 6.0
    one, other = tmp_path.rglob("*.code")
    content = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(content)
    again = compiled(twice)
    assert again(3.0) == 6.0 and again(3) == 6.0


def test_functions_of_one_line_that_close_over_other_numbers_have_files_of_their_own(tmp_path: Path) -> None:
    for number in (2.0, 3.0, 2.0, 3.0):
        function = compiled(times(number))
        assert function(2.0) == 2.0 * number
    assert read_from_cache(function)


def times(number: float) -> Callable[[float], float]:
    def function(x: float) -> float:
        return number * x

    return function


def test_a_full_disk_costs_the_cache_and_a_warning(
    twice: Callable[[float], float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(jit, "write_sealed", full)
    monkeypatch.setattr(cache_folder, "_said", Event())
    assert compiled(twice)(3.0) == 6.0 and compiled(twice)(3) == 6.0
    assert [record.message.count("No space left") for record in caplog.records if "kept" in record.message] == [1]
    assert not list(tmp_path.rglob("*.code"))


NOWHERE = """
import logging, os, sys
os.environ.pop("HOME", None)
logging.basicConfig(level=logging.WARNING, format="%(message)s")
import unifg as fg
from unifg.codegen.cache_folder import cache_folder
group = fg.SO2.compose([[0.5]], [[0.25]])
assert group[0, 0] == 0.75
assert cache_folder() is None
function = fg.compiled(eval("lambda x: 2.0 * x"))
assert function(3.0) == 6.0
"""


@pytest.mark.product(2, of="processes of their own")
def test_without_a_folder_to_write_to_everything_works_after_one_warning(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder", encoding="utf-8")
    ended = run_script(NOWHERE, variables={cache_folder.VARIABLE: str(tmp_path / "file" / "below")})
    assert ended.stderr.count("\n") == 1 and cache_folder.VARIABLE in ended.stderr


def test_a_folder_that_others_may_write_to_or_own_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv(cache_folder.VARIABLE, str(tmp_path))
    monkeypatch.setattr(cache_folder, "_said", Event())
    found = cache_folder.cache_folder.__wrapped__
    folder = found()
    assert folder is not None and folder.parent == tmp_path and folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o722)
    assert found() is None and found() is None and caplog.text.count("others may write") == 1
    folder.chmod(0o700)
    monkeypatch.setattr(os, "getuid", lambda: -1)
    assert found() is None
    monkeypatch.undo()
    monkeypatch.setenv(cache_folder.VARIABLE, "")
    assert cache_folder.place().parent.name == "unifg" and tmp_path not in cache_folder.place().parents


def test_a_user_without_a_home_keeps_nothing(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    def homeless(*_: Any, **__: Any) -> None:
        raise RuntimeError("could not determine the home directory")

    monkeypatch.setattr(platformdirs, "user_cache_path", homeless)
    monkeypatch.delenv(cache_folder.VARIABLE, raising=False)
    monkeypatch.setattr(cache_folder, "_said", Event())
    assert cache_folder.cache_folder.__wrapped__() is None and "there is no home" in caplog.text
    assert main(["cache"]) == 2 and "name one in UNIFG_CACHE_DIR" in capsys.readouterr().err


def test_what_cannot_be_deleted_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(cache_folder.VARIABLE, str(tmp_path))
    assert main(["cache", "--clear"]) == 0  # there is none
    assert capsys.readouterr().out == f"{cache_folder.place()}\n"
    cache_folder.place().write_bytes(b"")  # no folder
    assert main(["cache", "--clear"]) == 2
    assert str(cache_folder.place()) in capsys.readouterr().err


def test_a_numba_that_compiles_nothing_is_refused() -> None:
    script = "try: import unifg\nexcept ValueError as error: assert 'unset it' in str(error)\nelse: raise SystemExit(1)"
    run_script(script, variables={"NUMBA_DISABLE_JIT": "1"})


HAMMER = """
import importlib.util, sys
from pathlib import Path
spec = importlib.util.spec_from_file_location("doubling", sys.argv[1])
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
from unifg.codegen.jit import compiled
for k in range(4):
    function = compiled(module.twice)
    kinds = (3.0, 3, True) if k % 2 else (True, 3, 3.0)
    assert [function(x) for x in kinds] == [2.0 * x for x in kinds]
    for file in Path(sys.argv[1]).parent.rglob("*.code") if k < 3 else ():
        file.unlink(missing_ok=True)
    (Path(sys.argv[1]).parent / "turns").open("a").write("x")
"""


@pytest.mark.product(2, of="processes of their own")
def test_processes_compile_at_once_and_one_is_killed(tmp_path: Path) -> None:
    (tmp_path / "doubling.py").write_text(SOURCE, encoding="utf-8")
    command = [sys.executable, "-c", HAMMER, str(tmp_path / "doubling.py")]
    place = {**os.environ, cache_folder.VARIABLE: str(tmp_path / "cache")}
    runs = [subprocess.Popen(command, cwd=Path(__file__).parent.parent, env=place) for _ in range(2)]
    turns = tmp_path / "turns"
    while runs[0].poll() is None and not (turns.exists() and turns.stat().st_size > 1):
        time.sleep(0.01)
    runs[0].kill()
    runs[0].wait()
    assert runs[1].wait(timeout=120) == 0
    assert not [file for file in tmp_path.rglob("*.code") if read_sealed(file) is None]


@pytest.mark.product(2, of="processes of their own")
def test_what_is_read_needs_no_compiler_until_a_function_of_ones_own_does() -> None:
    script = (
        "import sys\n"
        "import numba, numpy as np\n"
        "from unifg.codegen.compile_counter import tally\n"
        "from unifg.pose_graphs import manhattan\n"
        "from unifg.solvers import GaussNewton\n"
        "def solve():\n"
        "    graph, x, guess = manhattan(20).pose_graph.graph()\n"
        "    return GaussNewton().solve(graph, guess)[x]\n"
        "first = solve()\n"
        "assert tally.read and not tally.generated, tally.generated\n"
        "assert 'numba.np.linalg' not in sys.modules\n"
        "matrix = np.array([[2.0, 1.0], [1.0, 3.0]])\n"
        "assert abs(numba.njit(lambda m: np.linalg.inv(m))(matrix) - np.linalg.inv(matrix)).max() < 1e-15\n"
        "assert (solve() == first).all()\n"
    )
    for _ in range(2):  # what was generated the first time is read the second time
        ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=300)
        if ended.returncode == 0:
            return
    pytest.fail(ended.stderr)


NEWER = """
import logging, sys
logging.basicConfig(level=logging.INFO, format="%(message)s")
import numba
from numba import _helperlib
numba.__version__ = "99.0.0"
_helperlib.c_helpers["numba_of_tomorrow"] = 0
if "renamed" in sys.argv:
    import numba.core.runtime
    from numba.core.codegen import CodeLibrary
    del CodeLibrary._set_compiled_object, numba.core.runtime._nrt_python
    sys.modules["numba.core.runtime._nrt_python"] = None
import numpy as np
import unifg as fg
from unifg.codegen.compile_counter import tally
for _ in range(2):
    assert abs(fg.SE2.compose(np.ones((2, 3)), -np.ones((2, 3)))[:, 2]).max() < 1e-12
    assert abs(fg.SO2.compose(np.ones((2, 1)), -np.ones((2, 1)))).max() < 1e-12
print(bool(tally.compiled), bool(tally.generated), bool(tally.read))
"""


@pytest.mark.product(2, of="processes of their own")
def test_a_newer_numba_works_from_sources(tmp_path: Path) -> None:
    """Its layout is not the archive's, which is said once; what it has renamed the cache does without."""

    def said(*how: str) -> tuple[str, int, int]:
        ended = run_script(NEWER, *how, variables={cache_folder.VARIABLE: str(tmp_path)})
        return ended.stdout.strip(), ended.stderr.count("not for Numba 99.0.0"), ended.stderr.count("than unifg knows")

    assert said() == ("True False False", 1, 0)
    assert said() == ("False False True", 0, 0)
    assert said("renamed") == ("True False False", 0, 1)
