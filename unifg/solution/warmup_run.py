"""Small solves before a control loop begins, so that its ticks compile nothing and read nothing from a disk.

What a solve runs depends on how it goes: where a line search fails, constraints cannot be met or a matrix is singular,
other compiled functions take over. Their types are the same for every graph. So a backend is taken once through small
problems that end in every way, and what has been asked of their answers can be asked of those of the real graph.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from unifg.errors import UnifgError
from unifg.factors.residuals import residual
from unifg.factors.robust import Huber, Reweighted
from unifg.lie import SE2, Rn
from unifg.modeling.factors import between, prior
from unifg.modeling.model import Model
from unifg.modeling.variables import Family
from unifg.typing import Array

STAGES = 4
ITERATIONS = 100
MARK = "rehearsed "  # begins the names of terms here
SECONDS = 2.0  # for one solve: far more than any of them takes once it is compiled

logger = logging.getLogger("unifg")
_rehearsed: set[object] = set()


class Scene(NamedTuple):
    """A problem and where to begin."""

    graph: Model
    guess: Mapping[Family, Array]


def rehearse(solver: Any) -> None:
    """Take a backend through all problems that it accepts, once per process and mode."""
    mode = _mode(solver)
    if mode in _rehearsed:
        return
    _rehearsed.add(mode)
    short = replace(solver, max_iterations=ITERATIONS, time_limit=SECONDS, verbose=False, search_iterations=0)
    logger.addFilter(_of_others)
    try:
        for scene in scenes(solver.constraints, solver.scalar_costs):
            _play(short, scene)
    finally:
        logger.removeFilter(_of_others)


def _of_others(record: logging.LogRecord) -> bool:
    """Test whether a message is about terms that a user has stated."""
    return MARK not in record.getMessage()


def _mode(solver: Any) -> object:
    """Code that a backend runs: its class and the options that are words."""
    options = fields(solver) if is_dataclass(solver) else ()
    return type(solver), *((f.name, v) for f in options if isinstance(v := getattr(solver, f.name), str | bool))


def _play(solver: Any, scene: Scene) -> None:
    """Solve, solve again from the answer, and ask what loops ask of answers."""
    try:
        prepared = solver.bound(scene.graph)
        solution = prepared.solve(scene.guess)
        again = prepared.solve(solution.shifted(*scene.guess))
        prepared.solve(scene.guess, callback=lambda row: None)
        replace(solver, max_iterations=1).bound(scene.graph).solve(again)
    except Exception as error:  # a backend of one's own may refuse anything; a real graph will hear why
        logger.info("%s does not rehearse: %s", solver.name, error)
        return
    x = next(iter(scene.guess))
    questions: tuple[Callable[[], object], ...] = (
        lambda: again.covariance(x[-1]),
        lambda: again.marginals(x),
        lambda: again.report(),
        lambda: again.information([MARK + "start"], x[0], x[1]),
        lambda: again.marginal_prior([MARK + "start", MARK + "steps"], x[0], x[1]),
    )
    for question in questions:
        try:
            question()
        except UnifgError:
            continue


def scenes(constraints: str, scalar_costs: bool) -> Iterator[Scene]:
    """Problems that end in every way.

    Args:
        constraints: which may be stated: "none", "equalities" or "all".
        scalar_costs: whether costs may be no squares.
    """
    yield _chain()
    yield _chain(loops=True)
    yield _chain(plain=True)
    if scalar_costs:
        yield _chain(scalar=True)
    if constraints == "none":
        return
    yield _chain(equality=True)
    yield _chain(equality=True, loops=True)
    yield _chain(equality=True, contradiction=True)
    if constraints != "all":
        return
    yield _chain(equality=True, inequality=True)
    yield _chain(equality=True, inequality=True, loops=True, scalar=scalar_costs)
    yield _chain(equality=True, inequality=True, plain=True)
    yield _chain(equality=True, inequality=True, contradiction=True)
    yield _chain(equality=True, inequality=True, contradiction=True, plain=True)


def _chain(
    *,
    equality: bool = False,
    inequality: bool = False,
    contradiction: bool = False,
    scalar: bool = False,
    loops: bool = False,
    plain: bool = False,
) -> Scene:
    """Poses in a row, pulled to a goal.

    Args:
        equality: one of them is where it must be.
        inequality: they keep out of a circle and within bounds.
        contradiction: they must be in two places at once.
        scalar: a cost is no square.
        loops: the last knows the first, through a robust loss.
        plain: functions of NumPy that are not traced take the place of compiled ones, and a loss of Python's.
    """
    graph = Model()
    x = graph.variables("x", SE2, STAGES)
    u = graph.variables("u", Rn(2), STAGES - 1)
    graph.minimize(prior, x[0], [0.0, 0.0, 0.0], sigma=0.1, name=MARK + "start")
    graph.minimize(between, x[:-1], x[1:], [1.0, 0.0, 0.1], sigma=[0.1, 0.1, 0.05], name=MARK + "steps")
    graph.minimize(prior, u, [0.1, 0.2], sigma=1.0, name=MARK + "effort")
    if plain:
        goal = residual(lambda pose: pose[:, :2] - [3.0, 0.5], derivatives="differences")
        graph.minimize(goal, x[-1], sigma=0.3, robust=Reweighted(np.ones_like), name=MARK + "goal")
    if loops:
        graph.minimize(between, x[0], x[-1], [2.5, 0.5, 0.4], sigma=0.1, robust=Huber(1.0), name=MARK + "closure")
    if scalar:
        graph.minimize_scalar(lambda control: np.cosh(control[:, 0]), u, name=MARK + "energy")
    if equality:
        graph.constrain(prior, x[-1], [3.0, 0.5, 0.2], lower=0, upper=0, name=MARK + "arrival")
        graph.constrain(
            lambda pose, control: pose[:, :2] - 0.1 - control, x[:-1], u, lower=0, upper=0, name=MARK + "motion"
        )
    if inequality:
        graph.bound(u, lower=-3.0, upper=3.0, name=MARK + "limits")
        graph.constrain(
            lambda pose: (pose[:, :2] - [1.5, 0.3]) ** 2 @ np.ones((2, 1)), x, lower=0.1, name=MARK + "clear"
        )
    if contradiction:
        graph.constrain(prior, x[-1], [2.0, 0.0, 0.1], lower=0, upper=0, name=MARK + "elsewhere")
    start = np.linspace([0.0, 0.1, 0.0], [3.0, 0.4, 0.1], STAGES)
    return Scene(graph, {x: start, u: start[:-1, :2].copy()})
