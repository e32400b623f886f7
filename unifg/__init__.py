"""unifg: robot estimation and robot control as one factor graph on Lie groups.

import unifg as fg

graph = fg.Graph()
x = graph.variables("x", fg.SE2, 2)
graph.fix(x[0], [0.0, 0.0, 0.0])
graph.minimize(fg.between, x[0], x[1], [1.0, 0.0, 0.3], sigma=0.1)
solution = fg.solve(graph, {x: np.zeros((2, 3))})
print(solution.report())
"""

import typing as _typing
from collections.abc import Callable as _Callable
from collections.abc import Mapping as _Mapping
from pathlib import Path as _Path

from unifg.codegen.jit import compiled
from unifg.codegen.threads import use_threads
from unifg.errors import (
    BackendError,
    FileFormatError,
    GraphError,
    ModelError,
    ScenarioError,
    UnifgError,
    ViewError,
)
from unifg.factors.autodiff.casadi_function import from_casadi
from unifg.factors.residuals import Residual, residual
from unifg.factors.robust import DCS, Cauchy, GemanMcClure, Huber, Loss, Reweighted, TruncatedLeastSquares, Tukey
from unifg.lie import (
    SE2,
    SE3,
    SE23,
    SO2,
    SO3,
    LieGroup,
    Manifold,
    ManifoldBase,
    Product,
    Rn,
    check_manifold,
    elementwise,
    wrap_angle,
)
from unifg.modeling.factors import between, difference, prior
from unifg.modeling.joint_prior import joint_prior
from unifg.modeling.soft import Soft
from unifg.modeling.variables import Data, Family, Selection, each, shared
from unifg.solution.check import Report
from unifg.solution.graph import Graph
from unifg.solution.guess import Guess
from unifg.solution.history import Iteration
from unifg.solution.optimality import optimality
from unifg.solution.solution import AnyGuess as _AnyGuess
from unifg.solution.solution import NotConverged, Solution
from unifg.solution.solve_state import Callback as _Callback
from unifg.solution.solver import Prepared, Solver
from unifg.solution.status import Status
from unifg.typing import Numbers as _Numbers

if _typing.TYPE_CHECKING:
    from unifg.smoothing import FixedLag, Incremental

_HERE = _Path(__file__).resolve().parent
# Where links are lost (Windows, some archives), a checkout finds its side folders beside this one.
if not (_HERE / "solvers" / "__init__.py").is_file() and (_HERE.parent / "solvers" / "__init__.py").is_file():
    __path__.append(str(_HERE.parent))

__version__: str

__all__ = [
    "DCS",
    "SE2",
    "SE3",
    "SE23",
    "SO2",
    "SO3",
    "BackendError",
    "Cauchy",
    "Data",
    "Family",
    "FileFormatError",
    "FixedLag",
    "GemanMcClure",
    "Graph",
    "GraphError",
    "Guess",
    "Huber",
    "Incremental",
    "Iteration",
    "LieGroup",
    "Loss",
    "Manifold",
    "ManifoldBase",
    "ModelError",
    "NotConverged",
    "Prepared",
    "Product",
    "Report",
    "Residual",
    "Reweighted",
    "Rn",
    "ScenarioError",
    "Selection",
    "Soft",
    "Solution",
    "Solver",
    "Status",
    "TruncatedLeastSquares",
    "Tukey",
    "UnifgError",
    "ViewError",
    "best_guess",
    "between",
    "check_manifold",
    "compiled",
    "difference",
    "each",
    "elementwise",
    "from_casadi",
    "joint_prior",
    "optimality",
    "prior",
    "residual",
    "shared",
    "solve",
    "use_threads",
    "warmup",
    "wrap_angle",
]


def solve(
    graph: Graph,
    guess: _AnyGuess,
    *,
    data: _Mapping[Data, _Numbers] | None = None,
    check: bool = False,
    callback: _Callback | None = None,
    tolerance: float = 1e-6,
    time_limit: float = float("inf"),
    verbose: bool = False,
    starts: int = 1,
) -> Solution:
    """Solve once, with the backend that what the graph states asks for.

    `LevenbergMarquardt` for least squares without constraints, `InteriorPoint` for everything else. Where it ends
    without a solution, and not for want of time, another one begins at the same guess: `InteriorPoint` after the
    first, `AugmentedLagrangian` after the second. The solution is that of the second one if it converged, else the
    one of the two that violates less or, where both violate no more than the tolerance, costs less. What was picked,
    and for what, stands in ``solution.picked`` and ``solution.report()``, and goes to the logger ``unifg`` at level
    INFO. Control loops name a backend and prepare it.

    Args:
        graph: the problem.
        guess: values per family, ``{x: array, ...}``, or a guess or solution that carries multipliers too.
        data: values of data for this solve; others keep their defaults.
        check: raise instead of returning a solution that did not converge.
        callback: called with every row of the history, from every start; returning True ends the solve.
        tolerance: of the KKT test.
        time_limit: seconds for all of it: both backends, and all starts.
        verbose: log one line per iteration, or print it where logging is not configured.
        starts: solve from so many starts, the guess and others around it, and keep the cheapest answer; what the others
            found stands in ``solution.others``. Those that the time limit leaves no time for are not tried, nor those
            at which a term is not finite.

    Raises:
        GraphError: when the graph, guess or data is malformed.
        NotConverged: with ``check=True``.
    """
    from unifg.solvers import choice  # only who solves this way loads all backends

    options = {"data": data, "check": check, "callback": callback}
    numbers = {"tolerance": tolerance, "time_limit": time_limit, "verbose": verbose, "starts": starts}
    return choice.solve(graph, guess, **options, **numbers)  # type: ignore[arg-type]  # each as it is declared above


def best_guess(
    graph: Graph, guess: _AnyGuess, *, along: Family | None = None, data: _Mapping[Data, _Numbers] | None = None
) -> Guess:
    """The cheapest of a guess and others that are found by following a trajectory, for graphs with landmarks.

    Least squares from dead reckoning may end in another minimum, or nowhere. If twenty steps do not lead to a cost that
    fits the degrees of freedom, the trajectory begins with ten members and grows by half each time the costs that touch
    nothing else are minimised, and if that does not fit either, by a tenth. New members continue the estimate by the
    steps between those of the guess. Landmarks come in when enough rows determine them, where the guess has them
    relative to the trajectory. What all factors of a cost share (calibrations) is held until the end. Constraints and
    costs that are no squares are left out, fixed variables stay.

    Args:
        graph: with costs that are squares.
        guess: values of all families; of the trajectory its steps count, of landmarks their order of magnitude.
        along: the family that runs along the trajectory; None for the one with the most members in a chain.
        data: as of a solve.

    Raises:
        GraphError: when no cost ties successive members of a family, and as of a solve.
    """
    from unifg.solvers import continuation

    return continuation.best_guess(graph, guess, along=along, data=data)


def warmup(progress: _Callable[[float, str], object] | None = None) -> None:
    """Compile what the shipped backends, smoothers and models can reach, and keep it on disk for programs to come.

    Where everything is there already it is read and found to run, which takes a second or two.

    Args:
        progress: called with the share that is done, and what comes next.
    """
    from unifg.precompile import jobs, perform

    perform("library", lambda: list(jobs()), progress)


def __getattr__(name: str) -> object:
    """Version and smoothers, looked up when they are asked for: batch solves need neither."""
    if name == "__version__":
        from unifg.codegen.cache_folder import version

        return version()
    if name in ("FixedLag", "Incremental"):
        from unifg import smoothing

        return getattr(smoothing, name)
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")


def __dir__() -> list[str]:
    """List what is public; the rooms are imported by name, as ``unifg.solvers``."""
    return [*__all__, "__version__"]
