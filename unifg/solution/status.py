"""Why a solve ended, as a sentence; what is kept of a solve from one of several starts."""

from enum import Enum
from typing import NamedTuple

from unifg.typing import Array


class Status(Enum):
    """Outcome of a solve; the value is the sentence shown to the user.

    Only CONVERGED and HARDLY_DETERMINED claim a solution, and only the KKT test of :mod:`unifg.solution.optimality`
    grants them.
    """

    CONVERGED = "The KKT conditions of the problem hold to the tolerance."
    HARDLY_DETERMINED = (
        "The KKT conditions of the problem hold to the tolerance, but some direction is so weakly determined that few "
        "digits of it are known; look at solution.conditioning, add a prior or another measurement."
    )
    DEGENERATE = (
        "The KKT conditions hold, or nearly hold, only with huge multipliers: constraints have lost their slope there, "
        "and the point need not be an optimum; state them with a slope where they are met."
    )
    STOP_RULE = "The chosen stop rule ended the loop, but the KKT conditions do not hold to the tolerance."
    ITERATION_LIMIT = "The iteration limit was reached before the KKT conditions held; raise max_iterations."
    TIME_LIMIT = "The time limit was reached before the KKT conditions held; raise time_limit."
    STALLED = "No step improved the merit any more, though the KKT conditions do not hold to the tolerance."
    LOCALLY_INFEASIBLE = (
        "The point is stationary for the violation of the constraints: no nearby point violates them less."
    )
    INFEASIBLE = (
        "A constraint whose variables are all fixed is violated, and no step can change that: change what is fixed, or "
        "the limits."
    )
    UNBOUNDED = "The objective fell below every reasonable value: it is probably unbounded below."
    UNDETERMINED = (
        "The costs are stationary but do not determine every unknown: others would fit as well; run "
        "graph.check(guess), fix a variable or add priors."
    )
    IMPRECISE = (
        "The KKT conditions seem to hold, but rounding of values as large as these cannot tell: state them in smaller "
        "numbers, as distances from a point nearby; or attach Jacobians where they are differenced."
    )
    SINGULAR = (
        "The linear system is singular: the costs do not determine every unknown; run graph.check(guess), add priors, "
        "or use a damped backend."
    )
    NOT_FINITE = "A residual, Jacobian or linear system was not finite where the backend needed it."
    INTERRUPTED = "The callback or the user ended the solve."

    @property
    def converged(self) -> bool:
        """True if a solution is claimed."""
        return self in (Status.CONVERGED, Status.HARDLY_DETERMINED)


class Found(NamedTuple):
    """Answer from one of several starts.

    Attributes:
        status: of its solve.
        cost: there.
        violation: of its constraints.
        values: by the names of the families.
    """

    status: Status
    cost: float
    violation: float
    values: dict[str, Array]
