"""The table of short names: every shipped backend once, and lists made from what the classes say."""

from pathlib import Path

import pytest

import unifg as fg
from problems.graphs import drawn_to, graph_with
from scripts import CHECKOUT
from unifg import solvers
from unifg.scenarios import command as shell
from unifg.scenarios.commands.catalogue import FROM_FILES, SCENARIOS
from unifg.solvers import names

CLASSES = {getattr(solvers, name) for name in solvers.__all__ if name != "LinearGraphs"}


def test_every_backend_has_one_name() -> None:
    assert {entry.made_by for entry in names.TABLE.values()} == CLASSES
    assert len(names.TABLE) == len({entry.title for entry in names.TABLE.values()}) == len(CLASSES)


def test_lists_follow_from_the_classes() -> None:
    assert names.LEAST_SQUARES == ("gn", "lm", "dogleg")
    assert set(names.CONSTRAINED) == {"kkt", "penalty", "alm", "sqp", "ipm"}
    assert set(names.SECOND_ORDER) == {"alm", "sqp", "ipm"}


@pytest.mark.parametrize("name", [*names.LEAST_SQUARES, *names.CONSTRAINED])
def test_a_class_takes_what_it_says(name: str) -> None:
    solver = names.backend(name)
    for limits, taken in (((0.0, 0.0), solver.constraints != "none"), ((-1.0, 1.0), solver.constraints == "all")):
        graph, x = drawn_to([1.0])
        graph.constrain(lambda x: x, x, lower=limits[0], upper=limits[1], name="limits")
        if taken:
            solver.prepare(graph)
        else:
            with pytest.raises(fg.BackendError, match=f"{solver.name} cannot take the .* 'limits'"):
                solver.prepare(graph)
    graph, x = graph_with(fg.Rn(1))
    graph.minimize_scalar(lambda x: x[:, 0] ** 2, x, name="general")
    if solver.scalar_costs:
        solver.prepare(graph)
    else:
        with pytest.raises(fg.BackendError, match=f"{solver.name} cannot take the scalar cost 'general'"):
            solver.prepare(graph)


def test_options_arrive() -> None:
    assert names.backend("sqp", tolerance=1e-3, qp="graph") == solvers.SQP(tolerance=1e-3, qp="graph")
    assert names.backends("ipm", "gn", max_iterations=7) == {
        "ipm": solvers.InteriorPoint(max_iterations=7),
        "gn": solvers.GaussNewton(max_iterations=7),
    }


@pytest.mark.parametrize("command", [("run", name) for name in SCENARIOS] + [("solve",)])
def test_commands_offer_names_with_titles(command: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    assert shell.main([*command, "--help"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    scenario = FROM_FILES["solve"] if command == ("solve",) else SCENARIOS[command[1]]
    assert names.choices(getattr(names, scenario.solvers)).replace("-", "") in said.replace("- ", "").replace("-", "")


def test_a_short_name_stands_in_no_second_table() -> None:
    found = [
        path.name
        for folder in ("solvers", "scenarios", "benchmarks", "tools", "tests")
        for path in (CHECKOUT / folder).rglob("*.py")
        if path != Path(__file__).resolve() and '"ipm": InteriorPoint' in path.read_text(encoding="utf-8")
    ]
    assert sorted(found) == []
