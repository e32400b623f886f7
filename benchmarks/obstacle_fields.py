"""Hundred random fields of discs: potential field, potential field with vortex, and hard clearance.

A unicycle shall follow a straight line that leads through 3 to 6 discs, with hard dynamics, from the line itself as a
guess. Only the way of keeping clear of the discs differs. Discs leave gaps a robot fits through, so that every field
can be passed. Weight and vortex were chosen on the twenty fields of TUNING, never on these. Beside the vortex stands a
control: the same number of first steps in full and without a merit test, but along the true gradient (a vortex of
weight 1e-9).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pandas as pd

from benchmarks.comparison import Row
from benchmarks.report import table
from benchmarks.runner import Study, every
from benchmarks.timing import clocked
from problems.control import Stated, Unicycle
from unifg.models import obstacles
from unifg.models.potential import Sense, potential
from unifg.solution.status import Status
from unifg.solvers.names import backend as named
from unifg.typing import Array

HORIZON = 50
SPEED = 0.8  # of the reference [m/s]
ROBOT = 0.17  # radius [m]
GAP = 0.5  # least distance between the surfaces of two discs [m]; the robot is 0.34 m wide
CONTACT = 1e-3  # a node deeper than this in a disc is a collision [m]
NEAR_END = 0.2  # a robot that ends closer than this to the end of the line has reached it [m]
TOLERANCE = 1e-4  # of the KKT test: the acceptance of the reference problems
PUSH = 0.2  # standard deviation of the potential's error
TUNING = range(1000, 1020)
BACKENDS = ("alm", "sqp")


@cache
def drawn(seed: int) -> tuple[Array, Array]:
    """A field: the first disc stands in the way, the others anywhere around it.

    Returns:
        (3,) pose beside the beginning of the line [m, m, rad], and (M, 3) x, y, radius of the discs [m].
    """
    rng = np.random.default_rng(seed)
    start = np.array([0.0, rng.uniform(-0.1, 0.1), rng.uniform(-0.2, 0.2)])
    count, length = int(rng.integers(3, 7)), SPEED * Unicycle.dt * HORIZON
    ends = np.array([[0.0, 0.0], [length, 0.0]])
    while True:
        discs = np.zeros((0, 3))
        for _ in range(200):
            radius = rng.uniform(0.15, 0.35)
            height = rng.uniform(-1.0, 1.0) * (0.8 * (radius + ROBOT) if not len(discs) else 0.9)
            disc = np.array([rng.uniform(0.8, length - 0.6), height, radius])
            apart = np.linalg.norm(discs[:, :2] - disc[:2], axis=1) - discs[:, 2] - radius
            aside = np.linalg.norm(ends - disc[:2], axis=1) - radius - ROBOT
            if (apart >= GAP).all() and (aside >= 0.2).all():
                discs = np.vstack([discs, disc])
            if len(discs) == count:
                return start, discs


@dataclass(frozen=True)
class Field(Unicycle):
    """One random field on the straight line of the reference problems; discs are kept off when it is ``blocked``."""

    seed: int = 0

    @property
    def start(self) -> Array:
        """(3,) first pose."""
        return drawn(self.seed)[0]

    @property
    def discs(self) -> Array:
        """(M, 3) x, y and radius with the robot's [m]."""
        return drawn(self.seed)[1] + [0.0, 0.0, ROBOT]


@dataclass(frozen=True)
class Method:
    """A way of keeping clear.

    Attributes:
        name: for the tables.
        hard: clearance as a constraint; otherwise a potential on the distance to the hull.
        vortex: weight of the tangent vector.
        sense: its sense.
        search: iterations with it.
    """

    name: str
    hard: bool = False
    vortex: float = 0.0
    sense: Sense = "circulate"
    search: int = 0

    def stated(self, seed: int) -> tuple[Field, Stated]:
        """The problem of a field with this method."""
        field = Field("straight", self.hard, HORIZON, seed)
        stated, discs = field.formulation(), field.discs
        if not self.hard:
            push = potential(obstacles.disc_clearance, vortex=self.vortex, sense=self.sense)
            stated.graph.minimize(push, stated.x[1:], discs[:, :2], discs[:, 2], sigma=PUSH, name="discs")
        return field, stated


METHODS = (
    Method("hard clearance", hard=True),
    Method("potential"),
    Method("potential, first steps in full", vortex=1e-9, search=15),
    Method("potential, vortex", vortex=0.3, search=15),
    Method("potential, vortex aside", vortex=1.0, sense="aside", search=15),
)


def measure(seed: int, method: int, backend: str) -> Row:
    """Solve one field cold; the cost is that of tracking and effort, without the potential."""
    way = METHODS[method]
    field, stated = way.stated(seed)
    made = named(backend, tolerance=TOLERANCE, search_iterations=way.search)
    run = made.prepare(stated.graph)
    solution, seconds = clocked(run.solve, stated.guess)
    states, (reference, _) = solution[stated.x], field.reference()
    error = potential(obstacles.disc_clearance)(states[1:], field.discs[:, :2], field.discs[:, 2])
    pushed = 0.0 if way.hard else 0.5 * float((error**2).sum()) / PUSH**2
    given = 0.5 * float(field.stage @ field.error(states[0], reference[0]) ** 2)  # of the first pose, which is fixed
    return {
        "solved": solution.converged,
        "degenerate": solution.status is Status.DEGENERATE,
        "free": bool(max(map(field.penetration, states)) <= CONTACT),
        "reached": float(np.linalg.norm(states[-1, :2] - reference[-1, :2])) < NEAR_END,
        "cost": solution.cost - pushed - given,
        "iterations": solution.iterations,
        "milliseconds": 1e3 * seconds,
    }


FACTS = ["solved", "degenerate", "free", "reached", "passed", "passed and solved"]


def tables(rows: list[Row]) -> str:
    """Counts of each method, and fields in which a change of method changes the result."""
    frame = pd.DataFrame(rows)
    frame["passed"] = frame["free"] & frame["reached"]  # a robot could use the answer, optimal or not
    frame["passed and solved"] = frame["passed"] & frame["solved"]
    found = {key: part.set_index("seed") for key, part in frame.groupby(["method", "backend"], sort=False)}
    lines, moves = [], []
    for (number, backend), part in found.items():
        name, hard, plain = METHODS[number].name, found[0, backend], found[1, backend]
        ratios = (part["cost"] / hard["cost"])[part["passed"] & hard["passed"]]
        ratio = f"{ratios.median():.2f}" if len(ratios) else "-"
        medians = (f"{part[what].median():.0f}" for what in ("iterations", "milliseconds"))
        lines.append((name, backend, *map(str, part[FACTS].sum()), ratio, *medians))
        if name != "potential":
            changes = (
                str(((plain[what] == before) & (part[what] != before)).sum())
                for what in FACTS[-2:] for before in (False, True)
            )  # fmt: skip
            moves.append((f"potential -> {name}", backend, *changes))
    fields = frame["seed"].nunique()
    parts = [
        table(("method", "solver", *FACTS, "cost", "iterations", "ms"), lines, text=2),
        table(("change", "solver", "passed: rescued", "broken", "passed and solved: rescued", "broken"), moves, text=2),
        f"{fields} fields, seeds 0 to {fields - 1}; tolerance {TOLERANCE:g}. "
        "Iterations and processor times are medians.",
    ]
    return "\n\n".join(parts)


STUDY = Study(every(method=range(len(METHODS)), backend=BACKENDS), measure, tables, range(100))
