"""Regressions of NIST's Statistical Reference Datasets: certified parameters, residuals and standard errors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest

import unifg as fg
from unifg.solvers import KKT, SQP, AugmentedLagrangian, DogLeg, GaussNewton, InteriorPoint, LevenbergMarquardt
from unifg.typing import Array

BACKENDS = [GaussNewton, LevenbergMarquardt, DogLeg, KKT, AugmentedLagrangian, SQP, InteriorPoint]


class Regression(NamedTuple):
    """A data set: model of parameters (n, k) and x (n, 1), numbers, second start, certified results."""

    model: Callable[[Any, Any], Any]
    x: list[float]
    y: list[float]
    start: list[float]
    parameters: list[float]
    errors: list[float]
    squares: float


def _saturation(b: Any, x: Any) -> Any:
    return b[:, :1] * (1.0 - np.exp(-b[:, 1:] * x))


def _sigmoid(b: Any, x: Any) -> Any:
    return b[:, :1] / (1.0 + np.exp(b[:, 1:2] - b[:, 2:] * x))


def _power(b: Any, x: Any) -> Any:
    return b[:, :1] * x ** b[:, 1:]


def _arrhenius(b: Any, x: Any) -> Any:
    return b[:, :1] * np.exp(b[:, 1:2] / (x + b[:, 2:]))


def _kinetics(b: Any, x: Any) -> Any:
    return b[:, :1] * (x**2 + x * b[:, 1:2]) / (x**2 + x * b[:, 2:3] + b[:, 3:])


# fmt: off
MISRA = Regression(
    _saturation, [77.6, 114.9, 141.1, 190.8, 239.9, 289.0, 332.8, 378.4, 434.8, 477.3, 536.8, 593.1, 689.1, 760.0],
    [10.07, 14.73, 17.94, 23.93, 29.61, 35.18, 40.02, 44.82, 50.76, 55.05, 61.01, 66.40, 75.47, 81.78],
    [250.0, 5e-4], [2.3894212918e2, 5.5015643181e-4], [2.7070075241, 7.2668688436e-6], 1.2455138894e-1,
)
KNOWN = {
    "Misra1a": MISRA,
    "BoxBOD": Regression(
        _saturation, [1.0, 2.0, 3.0, 5.0, 7.0, 10.0], [109.0, 149.0, 149.0, 191.0, 213.0, 224.0],
        [100.0, 0.75], [2.1380940889e2, 5.4723748542e-1], [1.2354515176e1, 1.0455993237e-1], 1.1680088766e3,
    ),
    "Rat42": Regression(
        _sigmoid, [9.0, 14.0, 21.0, 28.0, 42.0, 57.0, 63.0, 70.0, 79.0],
        [8.93, 10.8, 18.59, 22.33, 39.35, 56.11, 61.73, 64.62, 67.08], [75.0, 2.5, 0.07],
        [7.2462237576e1, 2.6180768402, 6.7359200066e-2], [1.7340283401, 8.8295217536e-2, 3.4465663377e-3],
        8.0565229338,
    ),
    "DanWood": Regression(
        _power, [1.309, 1.471, 1.490, 1.565, 1.611, 1.680], [2.138, 3.421, 3.597, 4.340, 4.882, 5.660],
        [0.7, 4.0], [7.6886226176e-1, 3.8604055871], [1.8281973860e-2, 5.1726610913e-2], 4.3173084083e-3,
    ),
    "MGH10": Regression(
        _arrhenius, [50.0 + 5.0 * k for k in range(16)],
        [34780.0, 28610.0, 23650.0, 19630.0, 16370.0, 13720.0, 11540.0, 9744.0, 8261.0, 7030.0, 6005.0, 5147.0, 4427.0,
         3820.0, 3307.0, 2872.0], [0.02, 4000.0, 250.0],
        [5.6096364710e-3, 6.1813463463e3, 3.4522363462e2], [1.5687892471e-4, 2.3309021107e1, 7.8486103508e-1],
        8.7945855171e1,
    ),
    "MGH09": Regression(
        _kinetics, [4.0, 2.0, 1.0, 0.5, 0.25, 0.167, 0.125, 0.1, 0.0833, 0.0714, 0.0625],
        [0.1957, 0.1947, 0.1735, 0.16, 0.0844, 0.0627, 0.0456, 0.0342, 0.0323, 0.0235, 0.0246],
        [0.25, 0.39, 0.415, 0.39], [1.9280693458e-1, 1.9128232873e-1, 1.2305650693e-1, 1.3606233068e-1],
        [1.1435312227e-2, 1.9633220911e-1, 8.0842031232e-2, 9.0025542308e-2], 3.0750560385e-4,
    ),
}
# fmt: on


def stated(known: Regression, unit: Array | float = 1.0) -> tuple[fg.Graph, fg.Family]:
    """The regression as a graph, its parameters measured in ``unit``."""
    x, y = np.array(known.x)[:, None], np.array(known.y)[:, None]
    graph = fg.Graph()
    b = graph.variables("b", fg.Rn(len(known.start)), 1)
    graph.minimize(lambda b, x, y: known.model(b * unit, x) - y, b[0], fg.each(x), fg.each(y), name="fit")
    return graph, b


@pytest.mark.parametrize("name", KNOWN)
def test_regressions_end_at_the_certified_parameters(name: str) -> None:
    known = KNOWN[name]
    graph, b = stated(known)
    solution = fg.solve(graph, {b: [known.start]}, tolerance=1e-9, check=True)
    np.testing.assert_allclose(solution[b][0], known.parameters, rtol=1e-7)
    assert 2.0 * solution.cost == pytest.approx(known.squares, rel=1e-9)
    of_one = known.squares / (len(known.x) - len(known.start))
    np.testing.assert_allclose(np.sqrt(of_one * np.diag(solution.covariance(b))), known.errors, rtol=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", ["Misra1a", "BoxBOD", "Rat42", "DanWood"])
def test_every_backend_ends_there(name: str, backend: Callable[[], fg.Solver]) -> None:
    known = KNOWN[name]
    graph, b = stated(known)
    solution = backend().solve(graph, {b: [known.start]}, check=True)
    np.testing.assert_allclose(solution[b][0], known.parameters, rtol=1e-5)


@pytest.mark.parametrize("unit", [1.0, [1.0, 1e-6], [1e3, 1e-9], [1e-4, 1e4]], ids=str)
def test_the_interior_point_fits_in_any_unit_of_the_parameters(unit: float | list[float]) -> None:
    """The curvatures of the far start are 1e13 apart: no small one is taken for none, for which steps were damped."""
    graph, b = stated(MISRA, np.array(unit))
    start = np.array([[500.0, 1e-4]]) / np.array(unit)
    solution = InteriorPoint().solve(graph, {b: start}, check=True)
    np.testing.assert_allclose(solution[b][0] * unit, MISRA.parameters, rtol=1e-6)
    assert solution.iterations <= 25


def test_a_function_whose_arrays_have_a_row_for_each_factor_is_told_how_to_say_so() -> None:
    graph = fg.Graph()
    b = graph.variables("b", fg.Rn(2), 1)
    x, y = np.array(MISRA.x)[:, None], np.array(MISRA.y)[:, None]
    with pytest.raises(fg.GraphError, match=r"row for each of 14 factors, say so: fg.each\(array\)"):
        graph.minimize(lambda b, x, y: _saturation(b, x) - y, b[0], x, y)
    data = graph.data("x", x)
    with pytest.raises(fg.GraphError, match=r"factors, say so: fg.each\(array\), graph.data\(..., each=True\)"):
        graph.minimize(lambda b, x: _saturation(b, x), b[0], data)
    with pytest.raises(fg.GraphError, match=r"say it where they are made: graph.data\('x', ..., each=True\)"):
        fg.each(data)  # type: ignore[arg-type]
    with pytest.raises(fg.GraphError, match=r"fg.shared takes constants; of data 'x' say it .* each=False\)"):
        fg.shared(data)  # type: ignore[arg-type]
