"""Case studies of ecg2o (Abdelkarim et al. 2026): iterations and times of its KKT method and augmented Lagrangian.

The first study drives the paper's profile, which is no part of unifg: it is looked for in ``$UNIFG_DATA`` or in
``shared/data`` beside the checkout. Without it nothing is measured, because the paper's numbers are of that profile.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TypeAlias

import numpy as np

import unifg as fg
from unifg.errors import ScenarioError
from unifg.scenarios.papers.comparison import Comparison, Effort, Line, measured, stated
from unifg.scenarios.papers.measuring import clock, interleave
from unifg.scenarios.papers.printed import numbers, shared, texts
from unifg.scenarios.velocity_tracking import TrackingSettings, state_problem
from unifg.solvers import KKT, AugmentedLagrangian, GaussNewton, Penalty
from unifg.typing import Array

Stated: TypeAlias = tuple[fg.Graph, fg.Guess | dict[fg.Family, Array]]

LENGTHS = (50, 100, 200, 385)
STARTS = [(-0.2, -0.2), (-1.2, -1.0), (1.0, 1.0), (-2.0, -2.0), (0.5, -0.5), (2.0, 2.0)]
STEP = 1e-3  # stop rule of the paper, on the norm of the step
STRICT = 1e-18  # a tolerance that leaves the end to the stop rule
LITERAL = 1e4  # rho of the literal loop in the first study, found by trying powers of ten
LITERAL_SMALL = 10.0  # the same in the second study
SLIGHTLY = 0.75  # ratio down to which a time is slightly lower


def profile() -> Path:
    """The paper's profile.

    Raises:
        ScenarioError: it is not there.
    """
    path = (shared("profiles") or Path("profiles")) / "velocity_profile_388.csv"
    if not path.is_file():
        raise ScenarioError(
            f"the first study drives the paper's profile, and there is no {path}: set UNIFG_DATA to the folder that "
            "has profiles/velocity_profile_388.csv"
        )
    return path


def drive(
    length: int, drag: str = "quadratic", bounds: tuple[float, float] | None = None, constrained: bool = True
) -> tuple[fg.Graph, fg.Guess]:
    """The first study.

    Args:
        length: steps of 1 s.
        drag: "quadratic", or "linear".
        bounds: of the force [N].
        constrained: False leaves the dynamics out.
    """
    settings = TrackingSettings(length, profile=profile(), linear=drag == "linear", force_bounds=bounds)
    graph, _, _, guess = state_problem(settings, settings.speeds(), constrained)
    return graph, guess


def small_residual(x: Array) -> Array:
    """(n, 2) residuals of the second study at (n, 2) unknowns."""
    return np.stack([x[:, 0] + np.exp(-x[:, 1]), x[:, 0] ** 2 + 2.0 * x[:, 1] + 1.0], axis=1)


def small_equality(x: Array) -> Array:
    """(n, 1) constraint of the second study at (n, 2) unknowns."""
    return (x[:, 0] + x[:, 0] ** 3 + x[:, 1] + x[:, 1] ** 2)[:, None]


def small(start: tuple[float, float]) -> tuple[fg.Graph, dict[fg.Family, Array]]:
    """The second study from one of its starts."""
    graph = fg.Graph()
    x = graph.variables("x", fg.Rn(2), 1)
    graph.minimize(small_residual, x, name="cost")
    graph.constrain(small_equality, x, lower=0.0, upper=0.0, name="curve")
    return graph, {x: np.array([start])}


def literal(penalty: float, step: float = 0.0, tolerance: float = 1e-6) -> AugmentedLagrangian:
    """One primal and one dual step in turn, constant rho: the paper's tuned augmented Lagrangian."""
    return AugmentedLagrangian(schedule="bazzana", penalty=penalty, step_tolerance=step, tolerance=tolerance)


def damped(penalty: float) -> AugmentedLagrangian:
    """The same loop with Levenberg-Marquardt steps."""
    return AugmentedLagrangian(schedule="bazzana-damped", penalty=penalty)


RULE = KKT(full_steps=True, step_tolerance=STEP, tolerance=STRICT)
TUNED = literal(LITERAL, STEP, STRICT)
FREE = GaussNewton(line_search=False, step_tolerance=STEP, tolerance=STRICT)
PAPERS_RULE = KKT(full_steps=True, step_tolerance=STEP)
LITERAL_BOTH: dict[str, fg.Solver] = {"KKT, full steps": KKT(full_steps=True), "AL, literal": literal(LITERAL)}


def iterations(solver: fg.Solver, problem: Stated, multiplier: float | None = None) -> tuple[int, bool] | None:
    """Iterations of a solve, and whether it ended with the KKT conditions or by the stop rule; None where refused.

    Args:
        solver: any.
        problem: graph and guess.
        multiplier: of the constraint in the guess.
    """
    graph, guess = problem
    duals = None
    if multiplier is not None:
        force = graph.families.get("force")
        count, name = (1, "curve") if force is None else (force.count, "dynamics")
        duals = {name: np.full((count, 1), multiplier)}
    try:
        solution = solver.solve(graph, guess, duals=duals)
    except fg.BackendError:
        return None
    return solution.iterations, solution.converged or solution.status is fg.Status.STOP_RULE


def seconds_an_iteration(solvers: Mapping[str, fg.Solver], length: int, rounds: int) -> dict[str, Array]:
    """(rounds,) processor time of cold solves of the first study over their iterations [s]; the solvers take turns."""
    runs, taken = {}, {}
    for name, solver in solvers.items():
        graph, guess = drive(length)
        run = solver.prepare(graph)
        taken[name] = run.solve(guess, check=True).iterations
        runs[name] = partial(clock, partial(run.solve, guess))
    return {name: found / taken[name] for name, found in interleave(runs, rounds, warm=5).items()}


def table_1(effort: Effort) -> Comparison:
    """Iterations of the second study, mean over its starts."""
    printed = partial(numbers, "ecg2o", "section 5.2, Table 1")
    penalty, lagrangian = printed("penalty_gtsam")
    cases: tuple[tuple[str, list[float], fg.Solver], ...] = (
        ("KKT, steps below 1e-3", printed("kkt"), PAPERS_RULE),
        ("augmented Lagrangian, damped loop, rho 10", printed("augmented_lagrangian"), damped(LITERAL_SMALL)),
        ("augmented Lagrangian, five inner steps", printed("augmented_lagrangian"),
         AugmentedLagrangian(inner_iterations=5)),
        ("augmented Lagrangian (paper: GTSAM's)", [lagrangian], AugmentedLagrangian()),
        ("penalty (paper: GTSAM's)", [penalty], Penalty()),
    )  # fmt: skip
    lines = [measured(f"iterations, {name}", of, _counts(solver)) for name, of, solver in cases]
    runs = f"{len(STARTS)} starts of our own, since the paper lists none of its; --quick and --full are the same."
    return Comparison(lines, runs)


def _counts(solver: fg.Solver) -> list[float]:
    """Iterations from every start; NaN where a solve ends without the KKT conditions."""
    found = [iterations(solver, small(start)) for start in STARTS]
    return [float(one[0]) if one is not None and one[1] else np.nan for one in found]


def figure_3(effort: Effort) -> Comparison:
    """Iterations of the first study against its length."""
    printed = partial(numbers, "ecg2o", "section 5.1, Fig. 3")
    lines = list[Line]()
    for what, name, solver, drag in (
        ("KKT, linear drag", "linear", RULE, "linear"),
        ("KKT", "nonlinear", RULE, "quadratic"),
        ("augmented Lagrangian, one inner step", "augmented_lagrangian", TUNED, "quadratic"),
    ):
        for length in LENGTHS:
            found = iterations(solver, drive(length, drag))
            count = [found[0]] if found is not None and found[1] else []
            lines.append(measured(f"iterations, {what}, N = {length}", printed(name), count, 0))
    return Comparison(lines, "One solve each, to a step below 1e-3; --quick and --full are the same.")


def figure_4(effort: Effort) -> Comparison:
    """Times of an iteration of the first study."""
    rounds = effort.of(50, int(texts("ecg2o", "section 5.1, Fig. 4")["rounds"].split()[1].replace(",", "")))
    lines = list[Line]()
    for number, length in enumerate(LENGTHS):
        effort.progress(number / len(LENGTHS), f"N = {length}")
        each = seconds_an_iteration(LITERAL_BOTH, length, rounds)
        lines += [measured(f"{name}, N = {length} [ms]", [], 1e3 * found, 4) for name, found in each.items()]
        ratio = each["AL, literal"] / each["KKT, full steps"]
        shown = measured("", [], ratio)
        text = texts("ecg2o", "section 5.1, Fig. 4")["lower"].partition(" than")[0]
        holds = SLIGHTLY <= float(ratio.mean()) < 1.0
        lines.append(stated(f"AL over KKT, N = {length}", text, shown.ours, holds, shown.interval))
    return Comparison(lines, f"{rounds} cold solves (paper: 1000), which take turns; processor times.")


def figure_5(effort: Effort) -> Comparison:
    """Inner iterations of the second study with few and many of them allowed."""
    limits = map(int, numbers("ecg2o", "section 5.2, Fig. 5", "limits"))
    solvers = {f"at most {limit} inner ones": AugmentedLagrangian(inner_iterations=limit) for limit in limits}
    lines = [measured(f"iterations, {name}", [], _counts(solver)) for name, solver in solvers.items()]
    return Comparison(lines, f"{len(STARTS)} starts; the paper draws the counts and prints none.")
