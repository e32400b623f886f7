"""Every backend that takes constraints, with default options, by the names of tables and tests."""

from __future__ import annotations

import unifg as fg
from unifg.solvers import KKT, SQP, AugmentedLagrangian, InteriorPoint, Penalty

CONSTRAINED: dict[str, fg.Solver] = {
    "alm": AugmentedLagrangian(),
    "sqp": SQP(),
    "sqp exact": SQP(hessian="exact"),
    "sqp graph": SQP(qp="graph"),
    "ipm": InteriorPoint(),
    "penalty": Penalty(),
}
EQUALITIES_ONLY: dict[str, fg.Solver] = {
    "kkt": KKT(),
    "kkt full": KKT(full_steps=True),
    "kkt lm": KKT(globalization="levenberg-marquardt"),
}
