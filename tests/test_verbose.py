"""Lines that ``verbose=True`` shows, whether or not logging is configured, and shares of time with their names."""

from __future__ import annotations

import logging

import numpy as np
import pytest

import unifg as fg
from problems.graphs import drawn_to, graph_with
from scripts import run_script
from unifg.solvers import SQP, GaussNewton

SCRIPT = """
import sys, logging
{configure}
import numpy as np
import unifg as fg
graph = fg.Graph()
x = graph.variables("x", fg.Rn(2), 1)
graph.minimize(fg.prior, x, [1.0, 2.0])
for verbose in (True, False):
    fg.solve(graph, {{x: np.zeros((1, 2))}}, verbose=verbose)
    print("solved", file=sys.stderr)
"""


@pytest.mark.parametrize("configure", ["", "logging.basicConfig()"])
@pytest.mark.product(1)
def test_verbose_prints_although_logging_is_not_configured(configure: str) -> None:
    verbose, silent, rest = run_script(SCRIPT.format(configure=configure)).stderr.split("solved\n")
    assert sum(line.startswith("iter ") for line in verbose.splitlines()) == 1 and verbose.count("\n") >= 3
    assert "iter" not in silent and not rest


def test_verbose_logs_where_logging_is_configured(
    caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    graph, x = drawn_to([1.0, 2.0])
    with caplog.at_level(logging.INFO, "unifg"):
        GaussNewton(verbose=True).solve(graph, {x: np.zeros((1, 2))})
    assert "iter " in caplog.text
    assert "iter " not in capsys.readouterr().err


def test_costs_that_were_traced_take_no_time_in_python() -> None:
    graph, x = graph_with(fg.Rn(2))
    graph.minimize_scalar(lambda p: np.cosh(p[:, 0] - 1.0) + p[:, 1] ** 2, x, name="bowl")
    solution = SQP(hessian="exact").solve(graph, {x: np.full((1, 2), 3.0)}, check=True)
    assert solution.converged and solution.in_python == 0.0
    assert "in Python" not in solution.report()
