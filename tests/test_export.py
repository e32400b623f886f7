"""A prepared solver as a C function: the bits of Python in a program without Python, and what is refused by name."""

from __future__ import annotations

import ctypes
import logging
import os
import re
import shutil
import subprocess
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unifg as fg
from asserting import below
from fences import fences
from problems.around_a_disc import around_a_disc
from problems.control import Quadrotor, Stated, Unicycle
from problems.graphs import drawn_to, graph_of, graph_with
from problems.parkings import least_time
from scripts import CHECKOUT
from unifg.codegen import standalone
from unifg.errors import BackendError
from unifg.solution.solver import Prepared
from unifg.solvers import SQP, InteriorPoint
from unifg.typing import Array

COMPILER = shutil.which(os.environ.get("CC", "cc"))
compiled_by_c = pytest.mark.skipif(COMPILER is None, reason="no C compiler is here")
MAIN = Path(__file__).with_name("export_main.c")
REPORT = 7
Run = Callable[[Sequence[tuple[Array, Array, Array]]], list[tuple[int, Array, Array, Array]]]


def built(folder: Path, threads: int = 1) -> Run:
    """Compile the C program of the tests for an export, and return what runs it."""
    program = folder / "program"
    warnings = ["-std=c11", "-D_POSIX_C_SOURCE=200809L", "-O1", "-Wall", "-Wextra", "-Werror"]
    command = [str(COMPILER), *warnings, "-I", str(folder), str(MAIN), str(folder / "solver.o"), "-lm", "-lpthread"]
    subprocess.run([*command, "-o", str(program)], check=True)

    def run(instances: Sequence[tuple[Array, Array, Array]]) -> list[tuple[int, Array, Array, Array]]:
        given = np.concatenate([part for instance in instances for part in instance])
        call = [str(program), str(len(instances)), str(threads), "2"]  # the second solve finds traces of the first
        ended = subprocess.run(call, input=given.tobytes(), capture_output=True, check=True)
        sizes = len(instances[0][1]), len(instances[0][2])
        rows = np.frombuffer(ended.stdout).reshape(len(instances), 1 + sum(sizes) + REPORT)
        ends = np.cumsum([1, *sizes])
        return [(int(row[0]), *np.split(row[1:], ends[1:] - 1)) for row in rows]  # type: ignore[misc]

    return run


def words(folder: Path) -> dict[str, int]:
    """Constants of a header."""
    found = re.findall(r"SOLVER_(\w+) = (-?\d+)", (folder / "solver.h").read_text(encoding="utf-8"))
    return {word: int(value) for word, value in found}


def in_order(prepared: Prepared, data: Mapping[fg.Data, Any]) -> Array:
    """Data as the C function takes them."""
    handles = prepared.program.binding.present
    return np.concatenate([np.zeros(0), *(np.ravel(data.get(handle, handle.value)) for handle in handles)])


def flat(prepared: Prepared, guess: Any) -> tuple[Array, Array]:
    """Values and multipliers of a guess as the C function takes them."""
    values, multipliers, _ = prepared.read(guess)
    return values, multipliers


def ready(build: Callable[[], tuple[fg.Graph, Any, fg.Data]]) -> tuple[Prepared, Any]:
    """A backend that has solved a problem once, and the guess."""
    graph, guess, _ = build()
    prepared = InteriorPoint().prepare(graph)
    prepared.solve(guess)
    return prepared, guess


def assert_same(prepared: Prepared, folder: Path, guess: Any, each: Sequence[Mapping[fg.Data, Any]]) -> None:
    """Solves in C and in Python agree in every bit, cold and from the answer before."""
    run, enumerated = built(folder, threads=2), words(folder)
    for start in (guess, prepared.solve(guess)):
        singles, given = [], []
        for data in each:
            singles.append(prepared.solve(start, data=data))
            given.append((in_order(prepared, data), *flat(prepared, start)))
        for single, (status, values, multipliers, report) in zip(singles, run(given), strict=True):
            assert status == enumerated[single.status.name]
            families = prepared.program.families
            np.testing.assert_array_equal(values, np.concatenate([single[family].ravel() for family in families]))
            np.testing.assert_array_equal(multipliers, flat(prepared, single)[1])
            measured = single.cost, single.stationarity, single.violation, single.complementarity
            assert report[1] == single.iterations and (*report[2:3], *report[4:]) == measured


def with_losses() -> tuple[fg.Graph, dict[fg.Family, Array], fg.Data]:
    """A cost that is no square, a robust one, comparisons, a table, and a constraint between quaternions."""
    graph, q, p = graph_of(("q", fg.SO3, 3), ("p", fg.Rn(2), 3))
    place, levels = graph.data("place", [1.0, 2.0]), np.array([0.0, 0.5, 0.2, 0.9])
    turned = graph.data("turned", fg.SO3.exp([0.3, 0.1, -0.2]))
    graph.minimize(fg.prior, q, turned, sigma=0.1, name="turn")
    graph.minimize(lambda x, to: x - to, p, place, robust=fg.Cauchy(0.5), name="place")
    graph.minimize_scalar(lambda x: 1.0 / (1.0 + (x**2).sum(axis=1)) + 0.1 * x[:, 0] ** 4, p, name="far")
    graph.minimize(
        lambda x: np.where(x[:, :1] > 0.4, np.interp(x[:, :1], np.arange(4.0), levels), 0.0), p, name="table"
    )
    graph.constrain(lambda a, b: fg.SO3.local(a, b), q[:-1], q[1:], lower=-0.01, upper=0.02, name="near")
    graph.bound(p, lower=-1.0, upper=1.5, name="box")
    return graph, {q: np.tile(fg.SO3.identity(), (3, 1)), p: np.full((3, 2), 0.3)}, place


@pytest.mark.product(1, of="exports")
@compiled_by_c
@pytest.mark.parametrize("make", [around_a_disc, with_losses])
def test_c_gives_the_bits_of_python(make: Callable[[], tuple[fg.Graph, Any, fg.Data]], tmp_path: Path) -> None:
    graph, guess, handle = make()
    prepared = InteriorPoint().prepare(graph)
    last = prepared.solve(guess)
    files = prepared.export(tmp_path)
    assert [file.name for file in files] == ["solver.h", "solver.o", "libsolver.so"]
    assert prepared.solve(guess).cost == last.cost and prepared.solve(guess).times  # and Python goes on
    rng = np.random.default_rng(0)
    each = [{handle: handle.value + 0.1 * rng.standard_normal(handle.value.shape)} for _ in range(12)]
    assert_same(prepared, tmp_path, guess, each)


@compiled_by_c
def test_c_does_without_the_restoration_of_python(tmp_path: Path) -> None:
    """Equalities become elastic where Python would look for a feasible point first."""
    graph, guess = least_time(3)
    prepared = InteriorPoint().prepare(graph)
    assert prepared.solve(guess, check=True).restoration_steps > 0
    prepared.export(tmp_path)
    assert prepared.solve(guess).restoration_steps > 0
    assert_same(InteriorPoint(restoration=False).prepare(graph), tmp_path, guess, [{}])


@pytest.mark.product(1, of="exports")
@compiled_by_c
@pytest.mark.parametrize("case", [Unicycle("straight", True, 20), Quadrotor("goto", True, 20)], ids=str)
def test_ticks_of_control_problems_are_the_same(case: Unicycle | Quadrotor, tmp_path: Path) -> None:
    stated: Stated = case.formulation()
    prepared = InteriorPoint(tolerance=1e-4, step_tolerance=np.inf).prepare(stated.graph)
    prepared.solve(stated.guess)
    prepared.export(tmp_path)
    steps = 0.1 * np.random.default_rng(0).standard_normal((8, case.manifold.dim))
    starts = case.manifold.retract(np.tile(case.start, (8, 1)), steps)
    assert_same(prepared, tmp_path, stated.guess, [stated.data(start, 0) for start in starts])


@pytest.mark.product(1, of="exports")
@compiled_by_c
def test_nothing_but_mathematics_is_expected_of_others(tmp_path: Path) -> None:
    """The shared object is linked without any symbol left open, and keeps its own names to itself."""
    if (nm := shutil.which("nm")) is None:
        pytest.skip("no nm is here")
    prepared, _ = ready(with_losses)
    *_, shared = prepared.export(tmp_path, name="mine")
    listed = subprocess.run([nm, "-D", "-P", str(shared)], capture_output=True, text=True, check=True).stdout
    symbols = [line.split()[:2] for line in listed.splitlines()]
    assert {name for name, kind in symbols if kind in "TRDB"} >= {"mine_solve", "mine_data", "mine_values"}
    wanted = {name.partition("@")[0] for name, kind in symbols if kind == "U"}
    mathematics = {"sin", "cos", "tan", "sincos", "exp", "log", "log1p", "pow", "sqrt", "atan2", "fmod", "hypot"}
    assert wanted <= mathematics | {"memcpy", "memset", "memmove", "frexp", "ldexp"}


def test_code_that_needs_more_than_mathematics_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    prepared, _ = ready(around_a_disc)
    monkeypatch.setattr(standalone, "OUTSIDE", re.compile(r"llvm\.|log1p$"))
    with pytest.raises(BackendError, match="expects cos, sin, sqrt, tan, which is a part of Python"):
        prepared.export(tmp_path)
    assert not [*tmp_path.iterdir()]
    monkeypatch.undo()
    found = prepared.entry()
    found.entry.addressing[0][4] += 2**20  # an address in the description of an array
    monkeypatch.setattr(prepared, "entry", lambda: found)
    with pytest.raises(BackendError, match="is that of no function and no array that is known"):
        prepared.export(tmp_path)


@pytest.mark.product(1, of="exports")
@compiled_by_c
def test_input_that_python_refuses_is_refused(tmp_path: Path) -> None:
    prepared, guess = ready(with_losses)
    prepared.export(tmp_path)
    data, (values, multipliers) = in_order(prepared, {}), flat(prepared, guess)
    wrong = []
    for which, place in ((0, 0), (0, 3), (1, 0), (1, 13), (2, 1)):  # data and values each in a vector and a quaternion
        for number in (np.nan, 0.5):
            given = data.copy(), values.copy(), multipliers.copy()
            given[which][place] = number
            wrong.append(given)
    found, enumerated = built(tmp_path)([*wrong, (data, values, multipliers)]), words(tmp_path)
    refused = [status == enumerated["REFUSED"] for status, *_ in found]
    assert refused == [True, False, True, True, True, True, True, False, True, False, False]
    assert found[-1][0] == enumerated["CONVERGED"]


@pytest.mark.product(1, of="exports")
@compiled_by_c
def test_a_cost_beyond_numbers_is_no_success(tmp_path: Path) -> None:
    graph, x = graph_with(fg.Rn(1), 1)
    seen = graph.data("seen", [1.0])
    graph.minimize(lambda p, at: p - at, x, seen, robust=fg.Cauchy(1.0), name="seen")
    graph.bound(x, lower=-1.0, upper=1.0, name="box")
    prepared = InteriorPoint().prepare(graph)
    prepared.solve({x: np.zeros((1, 1))})
    prepared.export(tmp_path)
    found, enumerated = (
        built(tmp_path)([(np.array([at]), np.zeros(1), np.zeros(1)) for at in (0.5, 1e200)]),
        words(tmp_path),
    )
    assert [status for status, *_ in found] == [enumerated["CONVERGED"], enumerated["NOT_FINITE"]]


@pytest.mark.product(1, of="exports")
@compiled_by_c
def test_a_workspace_that_was_moved_is_set_up_anew(tmp_path: Path) -> None:
    """It would refer to where it was before; one of another solver, to functions of that."""
    graph, guess, _ = around_a_disc()
    functions = []
    for name, limit in (("solver", 300), ("other", 2)):
        prepared = InteriorPoint(max_iterations=limit).prepare(graph)
        prepared.solve(guess)
        *_, shared = prepared.export(tmp_path, name=name)
        functions.append(ctypes.CDLL(str(shared))[f"{name}_solve"])
    arrays = [in_order(prepared, {}), *flat(prepared, guess), np.zeros(103), np.zeros(120), np.zeros(REPORT)]

    def answer(which: int, space: Array) -> Array:
        functions[which](*(ctypes.c_void_p(array.ctypes.data) for array in (*arrays, space)))
        return arrays[3].copy()

    space = np.zeros(words(tmp_path)["WORKSPACE"] // 8)  # both solvers have the same arrays
    found = answer(0, space)
    moved, before = space.copy(), space.tobytes()
    np.testing.assert_array_equal(answer(0, moved), found)
    assert space.tobytes() == before and found.any()
    np.testing.assert_array_equal(answer(1, space), answer(1, np.zeros_like(space)))
    assert arrays[-1][1] == 2.0


@pytest.mark.product(1, of="exports")
@compiled_by_c
def test_too_little_room_is_an_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Compiled functions that find none go on with what they have not computed."""
    prepared, guess = ready(around_a_disc)
    found = prepared.entry()
    monkeypatch.setattr(prepared, "entry", lambda: found._replace(entry=found.entry._replace(room=64)))
    prepared.export(tmp_path)
    [(status, *_)] = built(tmp_path)([(in_order(prepared, {}), *flat(prepared, guess))])
    assert status == words(tmp_path)["NO_ROOM"]


@pytest.mark.product(1, of="exports")
@compiled_by_c
def test_the_program_of_the_page_plans(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its ticks are those of Python."""
    page = list(fences(CHECKOUT / "docs" / "howto" / "export.md"))
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(next(fence.code for fence in page if fence.language == "python"), names)
    Path("main.c").write_text(next(fence.code for fence in page if fence.language == "c"), encoding="utf-8")
    subprocess.run([str(COMPILER), "-std=c11", "main.c", "plan/plan.o", "-Iplan", "-lm", "-o", "main"], check=True)
    told = subprocess.run(["./main"], capture_output=True, text=True, check=True).stdout
    plan, run, u = names["solution"], names["run"], names["u"]
    for tick, line in enumerate(told.splitlines()):
        plan = run.solve(plan, data={names["here"]: [0.0, 0.01 * tick, 0.0]}, check=True)
        assert line.split() == [str(plan.iterations), f"{plan[u][0, 0]:.17g}", f"{plan.cost:.17g}"]


def test_every_export_begins_at_the_last_answer() -> None:
    prepared, _ = ready(with_losses)
    first, second = prepared.entry(), prepared.entry()
    assert first.values.any() and first.multipliers.any()
    np.testing.assert_array_equal(second.values, first.values)
    np.testing.assert_array_equal(second.multipliers, first.multipliers)


@pytest.mark.product(1, of="exports")
def test_the_data_of_the_header_are_those_of_the_last_solve(tmp_path: Path) -> None:
    graph, guess, handle = around_a_disc()
    prepared = InteriorPoint().prepare(graph)
    prepared.solve(guess)
    fg.solve(graph, guess, data={handle: handle.value + 0.1})
    with pytest.raises(BackendError, match="have replaced the data of its last one: solve once more"):
        prepared.export(tmp_path)
    prepared.solve(guess)
    assert prepared.export(tmp_path)


@pytest.mark.product(1, of="exports")
def test_an_object_file_for_another_processor(tmp_path: Path) -> None:
    prepared, _ = ready(with_losses)
    header, made = prepared.export(tmp_path / "new", name="arm", target="aarch64-unknown-linux-gnu")
    code = made.read_bytes()
    assert code[:4] == b"\x7fELF" and code[18] == 183 and b"arm_solve\0" in code
    text = header.read_text(encoding="utf-8")
    assert "aarch64-unknown-linux-gnu" in text and "ARM_VALUES = 18," in text
    assert "0..1: place, 2" in text and "0..11: q, 3 x 4 SO3" in text and "6..11: box, 3 x 2" in text
    with pytest.raises(BackendError, match="no code can be generated for 'moon'"):
        prepared.export(tmp_path, target="moon")


@pytest.mark.product(1, of="exports")
def test_without_a_compiler_it_says_how_to_link(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    prepared, _ = ready(around_a_disc)
    monkeypatch.setenv("CC", "no-such-compiler")
    with caplog.at_level(logging.WARNING, "unifg"):
        assert [file.name for file in prepared.export(tmp_path)] == ["solver.h", "solver.o"]
    assert "-shared -o" in caplog.text
    monkeypatch.setenv("CC", "false")
    if shutil.which("false"):
        with pytest.raises(BackendError, match="failed"):
            prepared.export(tmp_path)


def refused(graph: fg.Graph, guess: Any, **options: Any) -> str:
    """The reason why a graph is not exported."""
    prepared = InteriorPoint(**options).prepare(graph)
    prepared.solve(guess)
    with pytest.raises(BackendError) as caught:
        prepared.export("nowhere")
    assert not Path("nowhere").exists()
    return str(caught.value)


def test_backends_whose_loop_is_python_are_refused() -> None:
    graph, guess, _ = around_a_disc()
    prepared = SQP().prepare(graph)
    prepared.solve(guess)
    with pytest.raises(BackendError, match=r"SQP is not exported: its loop is Python's: prepare InteriorPoint\(\)"):
        prepared.export("nowhere")
    with pytest.raises(BackendError, match="solve once"):
        InteriorPoint().prepare(graph).export("nowhere")
    assert "time limit" in refused(graph, guess, time_limit=1.0)
    with pytest.raises(BackendError, match="'my solver' is no name in C"):
        prepared.export("nowhere", name="my solver")
    for wrong in ({"name": 5}, {"target": None}):
        with pytest.raises(BackendError, match="must be of the class str"):
            prepared.export("nowhere", **wrong)


def test_parts_of_python_are_refused_by_name() -> None:
    def graph() -> tuple[fg.Graph, fg.Family, dict[fg.Family, Array]]:
        made, x = drawn_to([1.0, 2.0], 2, name="there")
        return made, x, {x: np.zeros((2, 2))}

    made, x, guess = graph()
    assert "add a bound" in refused(made, guess)
    made.bound(x, lower=-1.0, upper=made.data("most", [1.5, 1.5]), name="box")
    assert "data from which limits, weights or flags are made: most" in refused(made, guess)
    made, x, guess = graph()
    made.constrain(lambda p: p[:, :1] + np.linalg.matrix_rank(p[0, None]), x, lower=0.0, name="rank")
    assert "evaluated or differenced: rank" in refused(made, guess)
    made, x, guess = graph()
    made.constrain(lambda p: p[:, :1], x, upper=0.5, soft=10.0, name="wish")
    assert "soft constraints: wish" in refused(made, guess)

    made, x, guess = graph()
    made.constrain(below, x, upper=0.5, name="certain")
    assert "assert something: certain" in refused(made, guess)
    made, x, guess = graph()
    made.bound(x, lower=-1.0, upper=1.0, name="box")
    shown = made.data("shown", [True, False], each=True)
    made.minimize(lambda p: p, x, active=shown, name="some")
    assert "shown" in refused(made, guess)


@pytest.mark.product(1, of="exports")
def test_the_header_tells_order_shapes_and_units(tmp_path: Path) -> None:
    prepared, _ = ready(around_a_disc)
    prepared.export(tmp_path)
    words = " ".join((tmp_path / "solver.h").read_text().replace("\n * ", " ").split())
    assert "row by row (the last axis runs fastest)" in words and "units the graph was written in" in words
    for family in prepared.program.families:
        assert f"{family.name}, {family.count} x {family.manifold.storage} {family.manifold.name}" in words


@pytest.mark.product(1, of="exports")
@compiled_by_c
def test_a_name_does_not_end_the_comment_that_it_stands_in(tmp_path: Path) -> None:
    graph = fg.Graph()
    x = graph.variables("state */ [m]", fg.Rn(1), 1)
    graph.minimize(lambda p, to: p - to, x, graph.data("goal\n*/ int goal; /*", [2.0]), name="there")
    graph.bound(x, upper=1.0, name="box")
    prepared = InteriorPoint().prepare(graph)
    prepared.solve({x: np.zeros((1, 1))})
    prepared.export(tmp_path)
    assert "0..0: goal * / int goal; / *, 1\n" in (tmp_path / "solver.h").read_text(encoding="utf-8")
    [(status, values, *_)] = built(tmp_path)([(np.array([0.5]), np.zeros(1), np.zeros(1))])
    assert status == words(tmp_path)["CONVERGED"] and abs(values[0] - 0.5) < 1e-5
