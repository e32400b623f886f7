"""Answers in files: `solution.save`, and `unifg check` with the graph of a script."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_with
from unifg.errors import FileFormatError, GraphError
from unifg.scenarios.command import main
from unifg.solution.saved import check_answer
from unifg.solvers import InteriorPoint
from unifg.typing import Array

SCRIPT = """
import numpy as np
import unifg as fg

def make():
    graph = fg.Graph()
    x = graph.variables("x", fg.SE2, 3)
    goal, shown = graph.data("goal", [1.0, 0.5, 0.2]), graph.data("shown", [True, True, False], each=True)
    graph.minimize(fg.prior, x, goal, sigma=0.1, active=shown, name="there")
    graph.minimize(fg.between, x[:-1], x[1:], [0.1, 0.0, 0.0], name="apart")
    graph.constrain(lambda p: p[:, :1], x, upper=0.8, name="wall")
    graph.constrain(lambda p: p[:, 1:2], x, upper=0.3, soft=0.5, name="wish")
    return graph

graph = make()
"""


@pytest.fixture
def script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A script with a graph, in the working directory."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    path = tmp_path / "wall_ahead.py"
    path.write_text(SCRIPT, encoding="utf-8")
    yield path
    sys.modules.pop("wall_ahead", None)


def fresh_graph() -> fg.Graph:
    """The graph of the script."""
    names: dict[str, fg.Graph] = {}
    exec(SCRIPT, names)
    return names["graph"]


def graph_and_answer(path: str | os.PathLike[str] = "answer.npz") -> tuple[fg.Graph, fg.Solution]:
    """The graph of the script, and an answer with other data than its own, in a file."""
    graph = fresh_graph()
    x, goal, shown = graph.families["x"], graph._data["goal"], graph._data["shown"]
    data = {goal: [1.2, 0.4, 0.1], shown: [True, False, True]}
    solution = InteriorPoint().solve(graph, {x: np.zeros((3, 3))}, data=data, check=True)
    solution.save(path)
    return graph, solution


def changed(**others: Array | float | None) -> None:
    """Write the answer again with other arrays, or without some."""
    with np.load("answer.npz") as file:
        arrays = {name: file[name] for name in file.files}
    arrays.update({name.replace("_", "/", 1): np.asarray(array) for name, array in others.items() if array is not None})
    for name in (name.replace("_", "/", 1) for name, array in others.items() if array is None):
        del arrays[name]
    np.savez("answer.npz", **arrays)


@pytest.mark.parametrize("name", ["wall_ahead.py:graph", "wall_ahead.py:make", "wall_ahead:graph"])
def test_a_saved_answer_is_checked_with_its_own_data(
    script: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    _, solution = graph_and_answer()
    assert main(["check", name, "answer.npz"]) == 0
    assert capsys.readouterr().out == f"{solution.verify()}\n"
    assert str(solution.verify()).startswith("passes: ")


def test_an_answer_that_fails_is_said_to(script: Path, capsys: pytest.CaptureFixture[str]) -> None:
    graph, solution = graph_and_answer()
    changed(data_goal=np.array([1.3, 0.4, 0.1]))
    assert main(["check", "wall_ahead.py:graph", "answer.npz"]) == 1
    assert "fails: the cost is" in capsys.readouterr().out
    changed(data_goal=None)  # the default counts
    assert main(["check", "wall_ahead.py:graph", "answer.npz"]) == 1
    graph_and_answer()
    moved = np.array(solution["x"])
    moved[2, 0] += 1e-4
    changed(values_x=moved)
    assert main(["check", "wall_ahead.py:graph", "answer.npz"]) == 1
    assert "term 'wall', factor 2, row 0 is 0.0001 outside" in capsys.readouterr().out
    changed(cost=check_answer(graph, "answer.npz").cost)
    assert main(["check", "wall_ahead.py:graph", "answer.npz", "--tolerance", "0.1"]) == 0


def test_what_does_not_fit_is_refused_by_name(script: Path, capsys: pytest.CaptureFixture[str]) -> None:
    graph, solution = graph_and_answer()
    for others, reason in (
        ({"values_x": None}, "holds no 'values/x', of shape (3, 3)"),
        ({"multipliers_wall": np.zeros((2, 1))}, "'multipliers/wall' is float64 of shape (2, 1), in this graph of"),
        ({"data_goal": np.array(["a", "b", "c"])}, "'data/goal' is <U1 of shape (3,)"),
        ({"cost": np.array(1j)}, "'cost' is complex128 of shape (), in this graph of shape (), of real"),
        ({"data_other": np.zeros(2)}, "holds 'data/other', which is no part of this graph"),
        ({"cost": None}, "holds no 'cost'"),
    ):
        solution.save("answer.npz")
        changed(**others)
        with pytest.raises(FileFormatError, match=r"answer\.npz") as caught:
            check_answer(graph, "answer.npz")
        assert reason in str(caught.value)
    Path("other.npz").write_bytes(b"no file of arrays")
    Path("broken.py").write_bytes(b"graph = \0")
    for name, file, reason in (
        ("wall_ahead.py:graph", "other.npz", "is no file of arrays"),
        ("wall_ahead.py:graph", "absent.npz", "absent.npz: No such file"),
        ("wall_ahead.py:nothing", "answer.npz", "wall_ahead.py defines no graph 'nothing'"),
        ("absent.py:graph", "answer.npz", "there is no script absent.py"),
        ("no_such_module:graph", "answer.npz", "cannot import no_such_module"),
        ("wall_ahead.py", "answer.npz", "names no graph: give SCRIPT.py:NAME"),
        ("json:loads", "answer.npz", "json: 'loads' is called without arguments, and needs some"),
        ("broken.py:graph", "answer.npz", "broken.py cannot be run as Python"),
    ):
        assert main(["check", name, file]) == 2
        said = capsys.readouterr().err
        assert reason in said and "pickle" not in said


def test_data_that_a_file_leaves_out_have_their_defaults(script: Path) -> None:
    """Not those of the last solve."""
    graph, _ = graph_and_answer()
    changed(data_goal=None, data_shown=None)
    found = check_answer(graph, "answer.npz")
    assert not found and found.cost == check_answer(fresh_graph(), "answer.npz").cost


@pytest.mark.filterwarnings("error")
def test_tolerances_and_weights_that_check_nothing(script: Path, capsys: pytest.CaptureFixture[str]) -> None:
    graph, solution = graph_and_answer()
    wrong: list[Any] = [-1.0, 0.0, np.nan, "a", None]
    for tolerance in wrong:
        for check in (solution.verify, lambda tolerance: check_answer(graph, "answer.npz", tolerance)):
            with pytest.raises(GraphError, match="verify: tolerance must be"):
                check(tolerance)
    assert main(["check", "wall_ahead.py:graph", "answer.npz", "--tolerance", "-1"]) == 2
    assert "tolerance must be positive, found -1.0" in capsys.readouterr().err
    weighed, x = graph_with(fg.Rn(1), 2)
    sigma = weighed.data("sigma", 1.0)
    weighed.minimize(fg.prior, x, [1.0], sigma=sigma, name="there")
    fg.solve(weighed, {x: np.zeros((2, 1))}).save("answer.npz")
    changed(data_sigma=0.0)
    found = check_answer(weighed, "answer.npz")
    assert (found.verdict, found.sentence[:25]) == ("fails", "the cost is not finite: l")


def test_an_answer_whose_data_are_gone_is_not_saved(script: Path) -> None:
    graph, _ = graph_and_answer()
    x = graph.families["x"]
    prepared = InteriorPoint().prepare(graph)
    solution = prepared.solve({x: np.zeros((3, 3))})
    copied = fg.Solution.__new__(fg.Solution)
    copied.__dict__.update(solution.__dict__)
    prepared.solve({x: np.zeros((3, 3))}, data={graph._data["goal"]: [0.5, 0.0, 0.0]})
    solution.save("kept.npz")  # a solution that was returned keeps them
    assert check_answer(graph, "kept.npz")
    with pytest.raises(GraphError, match="save: the data of this solution were replaced; save what the solve returned"):
        copied.save("copied.npz")
    assert not Path("copied.npz").exists()
    with pytest.raises(GraphError, match="save: the path of a file is expected, found 3"):
        solution.save(3)  # type: ignore[arg-type]
