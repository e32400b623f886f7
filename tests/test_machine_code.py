"""Machine code of traced functions: who owns it, when it goes, and what is kept of it on disk."""

from __future__ import annotations

import copy
import gc
import os
import pickle
import subprocess
import sys
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

import unifg as fg
from at_once import at_once
from problems.graphs import graph_with, smoother_with
from unifg.codegen import native, objects
from unifg.codegen.native import Native
from unifg.codegen.objects import SWITCH, Objects
from unifg.errors import GraphError
from unifg.factors.autodiff import derived as derived_room
from unifg.factors.autodiff import expression as expression_room
from unifg.factors.autodiff.expression import Expression
from unifg.factors.autodiff.rows import traced
from unifg.factors.autodiff.stated import StatedKernel
from unifg.factors.kernel import evaluate_rows
from unifg.models.spline import SplineCurve
from unifg.smoothing import Incremental
from unifg.solvers import GaussNewton, InteriorPoint
from unifg.typing import Array

N = 5
Function = Callable[..., Any]
COPIES = [copy.deepcopy, lambda thing: pickle.loads(pickle.dumps(thing))]


@pytest.fixture(autouse=True)
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Objects:
    """Nothing that other processes have kept is found, and no kernel is remembered; old objects are no garbage."""
    gc.freeze()  # these tests look for garbage all the time, and other tests have left a million objects behind
    own = Objects(tmp_path / "kept")
    monkeypatch.setattr(expression_room, "_objects", lambda: own)
    monkeypatch.setattr(derived_room, "_kernels", OrderedDict())
    return own


def forget() -> None:
    """Let go of kernels that nobody uses."""
    derived_room._kernels.clear()
    gc.collect()


def stated(function: Function) -> tuple[fg.Graph, Any]:
    graph, x = graph_with(fg.Rn(2), N)
    graph.minimize(function, x, name="own")
    return graph, x


def bowl(by: float = 1.0) -> Expression:
    return traced(lambda x: np.sin(x) * x - by, (fg.Rn(2),))


def evaluated(expression: Expression) -> Array:
    r, J = np.empty((1, 2)), np.empty((1, 2, 2))
    x = np.array([[0.3, -0.7]])
    evaluate_rows(expression.residual().address, x, np.zeros((1, 0)), expression.table, r, J)
    return np.concatenate([r.ravel(), J.ravel()])


def native_of(graph: fg.Graph) -> weakref.ref[Native]:
    trace = graph.compile().terms[0].trace
    assert trace is not None
    return weakref.ref(trace.kernel.expression.residual())


# ---------------------------------------------------------------- who owns it


def test_machine_code_goes_with_its_expression() -> None:
    expression = bowl()
    native = weakref.ref(expression.residual())
    assert expression.residual() is native() and expression.second() is not native()
    with pytest.raises(TypeError, match="neither copied nor pickled"):
        copy.copy(expression.residual())
    gc.collect()
    assert native() is not None
    del expression
    gc.collect()
    assert native() is None


def test_a_graph_keeps_its_machine_code_and_nobody_else_does() -> None:
    graph, x = stated(lambda x: np.sin(x) + x - 1.0)
    solution = GaussNewton().solve(graph, {x: np.zeros((N, 2))})
    native = native_of(graph)
    forget()
    assert native() is not None
    del graph, x, solution
    gc.collect()
    assert native() is None


def test_a_table_owns_what_its_rows_name() -> None:
    """Also between a term's change of mind and the table's."""
    graph, _ = stated(lambda x: np.sin(x) + x - 1.0)
    program, native = graph.compile(), native_of(graph)
    (term,) = program.terms
    term.trace = term.kernel = None
    forget()
    assert native() is not None
    program.table.give_up(term)
    gc.collect()
    assert native() is None


def resident() -> int:
    """Kilobytes."""
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") // 1024


@pytest.mark.product(2, of="processes of their own")
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs /proc")
def test_functions_that_keep_changing_leave_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(derived_room, "KEPT", 4)
    monkeypatch.setenv(SWITCH, "0")

    def work(first: int, count: int) -> None:
        for k in range(first, first + count):
            stated(lambda x, k=float(k): np.sin(x) + k * x - 1.0)[0].compile()
            gc.collect()

    work(0, 30)
    before = resident()
    work(30, 60)
    assert resident() - before < 60 * 12, "kilobytes of each"


GAIN = 1.0


def shifted(x: Array) -> Array:
    return np.sin(x) + x - GAIN


@pytest.mark.parametrize("copied", COPIES)
def test_copies_run_code_of_their_own(copied: Function, monkeypatch: pytest.MonkeyPatch) -> None:
    graph, x = stated(shifted)
    prepared = GaussNewton().prepare(graph)
    guess = np.zeros((N, 2))
    solution = prepared.solve({x: guess})
    before = solution[x]
    native = native_of(graph)
    twin, answer, y = copied((prepared, solution, x))
    for changed in (2.0, 1.0):
        monkeypatch.setitem(globals(), "GAIN", changed)
        again = prepared.solve({x: guess})[x]
        forget()
        np.testing.assert_array_equal(twin.solve({y: guess})[y], again)
        assert twin.program.terms[0].route.startswith("traced"), "what changed before its first solve, too"
    np.testing.assert_array_equal(again, before)
    del prepared, graph, solution, x
    forget()
    assert native() is None
    np.testing.assert_allclose(answer.marginals(y), twin.solve({y: guess}).marginals(y), rtol=1e-12)
    np.testing.assert_array_equal(twin.solve({y: guess})[y], before)


def straight(x: Array) -> Array:
    return x - 1.0


def apart(x: Array) -> Array:
    return np.where(np.abs(x) > 5.0, x - x.mean(axis=0), x - 1.0)


HELPER = straight


def helped(x: Array) -> Array:
    return HELPER(x)


def test_a_retrace_that_is_refused_leaves_all_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is refused is refused each time, and what runs meanwhile is there still."""
    graph, x = stated(helped)
    prepared, far = GaussNewton().prepare(graph), 10.0 + np.arange(2.0 * N).reshape(N, 2)
    prepared.solve({x: far})
    monkeypatch.setitem(globals(), "HELPER", apart)
    for _ in range(5):
        with pytest.raises(GraphError, match="when the variables of other factors do"):
            prepared.solve({x: far})
        forget()
    monkeypatch.setitem(globals(), "HELPER", straight)
    np.testing.assert_allclose(prepared.solve({x: far})[x], 1.0)


CURVE = SplineCurve(np.arange(8.0) ** 2)


def along(x: Array) -> Array:
    return np.asarray(CURVE(x[:, :1]) - 4.0)


def test_a_function_that_is_traced_again_reads_its_own_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    graph, x = graph_with(fg.Rn(1), N)
    graph.minimize(fg.residual(along, derivatives="trace"), x)
    prepared, guess = GaussNewton().prepare(graph), {x: np.full((N, 1), 2.5)}
    np.testing.assert_allclose(prepared.solve(guess)[x], 2.0, atol=1e-6)
    for k in range(3):
        monkeypatch.setitem(globals(), "CURVE", SplineCurve((k + 2.0) * np.arange(8.0 + k)))
        found = prepared.solve(guess)[x]
        forget()
        np.testing.assert_allclose(found, 4.0 / (k + 2.0), atol=1e-6)


def test_the_graph_goes_while_another_thread_solves() -> None:
    graph, x = stated(lambda x: np.sin(3.0 * x) * x + x - 1.0)
    graph.constrain(lambda x: np.cos(x) * x, x, upper=0.5)
    prepared, guess = InteriorPoint().prepare(graph), {x: np.linspace(-1.0, 1.0, 2 * N).reshape(N, 2)}
    expected, found, begun = prepared.solve(guess)[x], [], threading.Event()

    def work(own: Any, given: dict[Any, Array]) -> None:
        for _ in range(10):
            begun.set()
            found.append(own.solve(given)[next(iter(given))])

    threads = [threading.Thread(target=work, args=(prepared, guess))]
    threads[0].start()
    begun.wait()
    native = native_of(graph)
    del graph, prepared, guess, x
    for k in range(6):
        forget()
        evaluated(bowl(float(k)))  # takes the place of what has gone
    for thread in threads:
        thread.join()
    threads.clear()
    for values in found:
        np.testing.assert_array_equal(values, expected)
    gc.collect()
    assert len(found) == 10 and native() is None


@pytest.mark.parametrize("copied", COPIES)
def test_copies_of_smoothers_run_code_of_their_own(copied: Function) -> None:
    smoother, x = smoother_with(Incremental(relinearize=0.0), fg.SE2)
    smoother.minimize(fg.prior, x[0], np.zeros(3), sigma=0.1)
    smoother.minimize(stepped, x[0], x[1], np.ones(3), sigma=0.1)
    smoother.update({x: np.zeros((2, 3))})
    twin = copied(smoother)

    def go_on(one: Any) -> Array:
        y = one.families["x"]
        one.update()  # nothing new is stated: what is there is evaluated again
        one.minimize(stepped, y[1], y[2], np.ones(3), sigma=0.1)
        one.minimize(lambda x: np.sin(x) - 0.2, y[2], sigma=0.3)
        one.update({y: np.zeros(3)})
        return np.asarray(one.estimate(y))

    expected = go_on(smoother)
    del smoother, x
    forget()
    for k in range(20):
        evaluated(bowl(float(k)))
    np.testing.assert_allclose(go_on(twin), expected, atol=1e-12)


def stepped(x: Array, y: Array, by: Array) -> Array:
    return fg.SE2.local(x, y) - 0.1 * by


def test_threads_share_what_they_generate() -> None:
    kernel = StatedKernel(lambda x: np.sin(x) * x, (fg.Rn(2),), 2)
    found = at_once(lambda k: (kernel.expression, kernel.expression.residual(), kernel.address), 6)
    assert len(set(map(id, (e for e, _, _ in found)))) == len({id(n) for _, n, _ in found}) == 1
    assert {a for _, _, a in found} == {found[0][1].address}


# ---------------------------------------------------------------- on disk


def files(store: Objects) -> list[Path]:
    return sorted(store.folder.iterdir()) if store.folder and store.folder.is_dir() else []


def refuse(*_: Any) -> bytes:
    raise AssertionError("generated")


def test_what_is_on_disk_is_not_generated_again(store: Objects, monkeypatch: pytest.MonkeyPatch) -> None:
    one = bowl()
    first, second = evaluated(one), one.second()
    assert len(files(store)) == 2 and second.address
    monkeypatch.setattr(Expression, "slopes", property(refuse))
    monkeypatch.setattr(Expression, "curvature", property(refuse))
    monkeypatch.setattr(expression_room, "residual_code", refuse)
    two = traced(lambda x: np.sin(x) * x - (x - x + 1.0) * 1.0, (fg.Rn(2),), name="said otherwise")
    np.testing.assert_array_equal(evaluated(two), first)
    assert two.second().address != second.address
    with pytest.raises(AssertionError, match="generated"):
        evaluated(bowl(np.nextafter(1.0, 2.0)))


def test_what_differs_at_all_is_not_taken_for_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    def key(function: Function, arguments: Any = None) -> str:
        return traced(function, arguments or (fg.Rn(2),))._stated

    functions: list[tuple[Any, ...]] = [
        (lambda x: x - 0.1,), (lambda x: x - np.nextafter(0.1, 1.0),), (lambda x: x[:, ::-1] - 0.1,),
        (lambda x: x[:, :1] - 0.1,), (lambda x, y: x - 0.1, (fg.Rn(2), fg.Rn(1))), (lambda x: 0.1 - x,),
        (lambda x, p: x - p, (fg.Rn(2), (2,))), (lambda x, p: x - p[:, ::-1], (fg.Rn(2), (2,))),
        (lambda x: np.sin(x),), (lambda x: np.cos(x),), (lambda x: np.where(x > 0.0, x, 0.1),),
        (lambda x: np.where(x > 0.0, 0.1, x),), (lambda x: x / 0.0,), (lambda x: x / -0.0,),
        (lambda x: CURVE(x),), (lambda x: SplineCurve(np.arange(9.0))(x),),
    ]  # fmt: skip
    with np.errstate(all="ignore"):
        assert len({key(*case) for case in functions}) == len(functions)
        assert key(lambda x: x - 0.1) == key(lambda y: -(0.1 - y))
    before = bowl()._stated
    monkeypatch.setattr(expression_room, "_WRITERS", "")
    assert bowl()._stated == before and evaluated(bowl()).any()


@pytest.mark.parametrize("damage", ["cut", "empty", "flipped", "longer", "folder"])
def test_damaged_files_count_as_none(store: Objects, damage: str) -> None:
    first = evaluated(bowl())
    (path,) = files(store)
    whole = path.read_bytes()
    path.unlink()
    if damage == "folder":
        path.mkdir()
    else:
        flipped = bytes([*whole[:500], whole[500] ^ 1, *whole[501:]])
        path.write_bytes({"cut": whole[:-1], "empty": b"", "flipped": flipped, "longer": whole + b"0"}[damage])
    np.testing.assert_array_equal(evaluated(bowl()), first)
    if damage != "folder":
        assert path.read_bytes()[:32] == whole[:32]


def test_it_is_turned_off_by_the_environment_or_where_nothing_can_be_written(
    store: Objects, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = evaluated(bowl())
    (path,) = files(store)
    with monkeypatch.context() as patched:
        patched.setenv(SWITCH, "0")
        assert store.find(path.name) is None
        evaluated(bowl(2.0))
        assert files(store) == [path]
    blocked = Objects(path / "below")
    monkeypatch.setattr(expression_room, "_objects", lambda: blocked)
    np.testing.assert_array_equal(evaluated(bowl()), first)
    np.testing.assert_array_equal(evaluated(bowl()), first)
    assert not list(tmp_path.rglob("below"))


def test_the_oldest_go_when_there_are_too_many(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(objects, "EVERY", 2)
    kept = Objects(tmp_path, 20 * objects.BLOCK)
    for k in range(60):
        kept.keep(f"k{k}", b"code")
        os.utime(tmp_path / f"k{k}", (k, k))
        if k >= 1:
            assert kept.find("k0") == b"code"  # what is read stays
            os.utime(tmp_path / "k0", (k, k))
    left = {path.name for path in tmp_path.iterdir()}
    assert len(left) <= 22 and {"k0", "k59", "k58"} <= left and "k1" not in left


HAMMER = """
import importlib.util, sys, types
from pathlib import Path
library = sys.modules["unifg"] = types.ModuleType("unifg")  # without all that it imports
library.__path__ = [str(Path(sys.argv[1]).parent.parent)]
spec = importlib.util.spec_from_file_location("objects", sys.argv[1])
objects = importlib.util.module_from_spec(spec)
spec.loader.exec_module(objects)
objects.EVERY = 3
kept = objects.Objects(Path(sys.argv[2]), 30 * objects.BLOCK)
for turn in range(300):
    key = f"k{turn % 50}"
    found = kept.find(key)
    assert found is None or found == key.encode() * 2000, "half a file"
    kept.keep(key, key.encode() * 2000)
    assert kept._writable
"""


def test_processes_write_at_once(tmp_path: Path) -> None:
    file = str(Path(objects.__file__))
    runs = [subprocess.Popen([sys.executable, "-c", HAMMER, file, str(tmp_path)]) for _ in range(3)]
    assert [run.wait(timeout=60) for run in runs] == [0, 0, 0]
    assert all("." not in path.name for path in tmp_path.iterdir())


def test_the_processor_that_numba_is_told_is_that_of_derived_code(monkeypatch: pytest.MonkeyPatch) -> None:
    """A cluster of several processors shares one home: code is kept apart by what it was generated for."""
    monkeypatch.setattr(native, "_processor", native._processor.__wrapped__)
    here, kept = native._processor(), native.generation.__wrapped__()
    monkeypatch.setattr(numba.config, "CPU_NAME", "generic")
    monkeypatch.setattr(numba.config, "CPU_FEATURES", "")
    assert native._processor() == (here[0], "generic", "") != here
    assert native.generation.__wrapped__() != kept
