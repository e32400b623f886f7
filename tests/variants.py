"""Every backend that takes constraints, with default options, by the names of tables and tests."""

from __future__ import annotations

import unifg as fg
from unifg.solvers import KKT, SQP
from unifg.solvers.names import backends

CONSTRAINED: dict[str, fg.Solver] = {
    **backends("alm", "sqp"),
    "sqp exact": SQP(hessian="exact"),
    "sqp graph": SQP(qp="graph"),
    **backends("ipm", "penalty", "kkt"),
    "kkt full": KKT(full_steps=True),
    "kkt lm": KKT(globalization="levenberg-marquardt"),
}
