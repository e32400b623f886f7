"""Do the tests notice when a decision is changed? Mutants of the decisions' files, each run against its tests.

    python -m tools.mutants                            every file of TARGETS (hours)
    python -m tools.mutants scenarios/ground/drive_past.py   one file
    python -m tools.mutants --share 0.3 --seed 1 ...   a drawn share of the mutants of each file

Everything happens in a scratch copy of the checkout. The tests of a file run once with every line they touch recorded;
a mutant is then given to the tests that touch its line, the quickest first, and what survives these to all other tests
of the file. Functions under Numba run unseen: their mutants are given to all tests, and compiled. Those that may
survive stand in ``tools/survivors.toml``, each with its reason, and are not run; the run ends with exit code 1
when there are others.

Tools of this kind that are at hand do not fit: they rename or wrap the functions they mutate, which Numba cannot
compile, or edit the checkout itself and run all tests for every mutant; and the links inside ``unifg`` show them every
side folder twice.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tools.mutant_tests import Touched, touched
from tools.mutations import Mutation, mutations

CHECKOUT = Path(__file__).resolve().parent.parent
SURVIVORS = CHECKOUT / "tools" / "survivors.toml"
LEFT_OUT = (".git", ".venv", "out", "build", "dist", ".mypy_cache", ".ruff_cache", ".pytest_cache", ".hypothesis")
PATIENCE = 4.0  # times as long as the tests took, and a minute: what takes longer has been noticed
EARLY = 60.0  # [s]

# Decisions, and the tests that are to notice when they change.
TARGETS: dict[str, tuple[str, ...]] = {
    "unifg/solution/check.py": ("answers", "refusals", "graph"),
    "unifg/solution/covariance.py": ("answers", "covariance", "graph"),
    "unifg/solution/optimality.py": ("kkt", "infeasible", "solvers", "refusals"),
    "unifg/solution/marginal.py": ("answers", "marginal_prior"),
    "unifg/solution/warm_start.py": ("answers", "binding", "graph"),
    "unifg/solution/solution.py": (
        "answers",
        "residual_history",
        "covariance",
        "refusals",
        "graph",
        "kkt",
        "binding",
        "plots",
    ),
    "unifg/solution/solver.py": ("answers", "early_ends", "solvers", "refusals", "verification"),
    "unifg/solution/solve_state.py": (
        "answers",
        "early_ends",
        "interior_point",
        "solvers",
        "refusals",
        "infeasible",
        "own_backend",
    ),
    "unifg/factors/autodiff/array_functions.py": ("derive_kinds", "derive_numpy", "tape_rules"),
    "unifg/factors/autodiff/calculus.py": ("tape_rules", "derive"),
    "unifg/factors/autodiff/captured.py": ("traced_terms", "derive_kinds"),
    "unifg/factors/autodiff/rows.py": ("rows", "traced_terms"),
    "unifg/factors/autodiff/symbols.py": ("derive_kinds", "derive_numpy", "rows"),
    "unifg/factors/autodiff/tape.py": ("tape_rules", "derive", "derive_kinds", "loops"),
    "unifg/factors/autodiff/loops.py": ("loops",),
    "unifg/factors/autodiff/emit.py": ("loops", "tape_rules", "derive"),
    "unifg/factors/autodiff/trace.py": ("traced_terms", "derive_kinds", "rows"),
    "unifg/problem/traced.py": ("rows", "traced_terms"),
    "unifg/problem/verification.py": ("verification",),
    "unifg/pose_graphs/certificate.py": ("certificate",),
    "unifg/pose_graphs/consistency.py": ("consistency",),
    "unifg/pose_graphs/initialise.py": ("pose_graphs", "spanning"),
    "unifg/pose_graphs/relaxation.py": ("certificate",),
    "unifg/pose_graphs/spanning.py": ("spanning", "pose_graphs"),
    "unifg/elimination/ordering.py": ("elimination",),
    "unifg/elimination/saddle.py": ("elimination", "kkt"),
    "unifg/elimination/symbolic.py": ("elimination",),
    "unifg/lie/se3.py": ("lie", "lie_space", "integrators"),
    "unifg/lie/so3.py": ("lie", "lie_space", "integrators"),
    "unifg/lie/product.py": ("lie", "manifolds"),
    "models/barriers.py": ("barriers",),
    "models/rkmk.py": ("rkmk", "integrators"),
    "models/terminal.py": ("uncertainty", "quadrotor_mpc"),
    "models/uncertainty.py": ("uncertainty",),
    "unifg/smoothing/fixed_lag.py": ("fixed_lag",),
    "unifg/smoothing/marginalize.py": ("fixed_lag", "smoothing_factors"),
    "unifg/smoothing/smoother.py": ("incremental", "smoothing_factors"),
    "unifg/smoothing/update.py": ("incremental", "smoothing_factors"),
    "unifg/modeling/summary.py": ("statements",),
    "unifg/modeling/model.py": ("statements", "refusals", "graph", "errors"),
    "unifg/modeling/probing.py": ("statements", "refusals", "kernels"),
    "unifg/modeling/variables.py": ("statements", "refusals", "graph"),
    "unifg/modeling/weights.py": ("statements", "refusals"),
    "unifg/plots/descent.py": ("plots",),
    "unifg/plots/factor_graph.py": ("plots",),
    "unifg/plots/shown.py": ("plots",),
    "unifg/problem/binding.py": ("binding", "graph", "refusals"),
    "solvers/augmented_lagrangian.py": ("augmented_lagrangian", "answers", "solvers", "infeasible", "least_violation"),
    "solvers/interior_point/barrier.py": ("interior_point", "solvers", "infeasible"),
    "solvers/interior_point/direction.py": ("interior_point", "solvers"),
    "solvers/interior_point/filter_search.py": ("interior_point", "solvers", "infeasible"),
    "solvers/interior_point/loop.py": ("interior_point", "solvers", "infeasible"),
    "solvers/globalize/damping.py": ("augmented_lagrangian", "penalty", "solvers", "robust"),
    "solvers/least_squares.py": ("answers", "relative_offset", "solvers", "robust"),
    "solvers/graduated_non_convexity.py": ("robust",),
    "solvers/interior_point/method.py": ("interior_point", "elastic", "early_ends", "solvers", "infeasible"),
    "solvers/kkt.py": ("kkt", "answers", "solvers", "infeasible"),
    "solvers/globalize/feasibility_restoration.py": ("infeasible", "solvers"),
    "solvers/penalty.py": ("penalty", "solvers"),
    "solvers/augmented_objective.py": ("augmented_lagrangian", "solvers"),
    "solvers/augmented_step.py": ("augmented_lagrangian", "penalty", "solvers"),
    "solvers/quadratic_programs/exact_hessian.py": ("sqp_exact", "solvers"),
    "solvers/sqp.py": (
        "sqp_decisions",
        "sqp_steps",
        "sqp_exact",
        "scaling",
        "osqp",
        "answers",
        "solvers",
        "infeasible",
    ),
    "scenarios/ground/drive_control.py": ("control_decisions", "navigation", "joint"),
    "scenarios/ground/drive_parts.py": ("control_decisions", "navigation", "joint"),
    "scenarios/ground/drive_settings.py": ("control_decisions", "navigation", "joint"),
    "scenarios/ground/drive_past.py": ("control_decisions", "joint"),
    "scenarios/ground/localiser.py": ("navigation",),
    "scenarios/navigation.py": ("navigation",),
    "scenarios/perception/disc_tracker.py": ("perception", "control_decisions"),
    "scenarios/ground/drive_pilot.py": ("navigation", "joint"),
    "scenarios/planning/grid.py": ("planner", "route"),
    "scenarios/ground/route.py": ("route", "navigation"),
    "unifg/horizon/receding_horizon.py": ("horizon", "examples", "control_decisions", "quadrotor_decisions"),
    "unifg/horizon/coupling.py": ("horizon", "joint"),
    "unifg/horizon/decision.py": ("horizon", "control_decisions"),
    "unifg/horizon/past.py": ("horizon", "joint", "quadrotor_estimator"),
    "unifg/horizon/history.py": ("horizon",),
    "unifg/horizon/robot.py": ("horizon",),
    "unifg/horizon/terms.py": ("horizon", "examples"),
    "unifg/horizon/window.py": ("horizon", "joint", "quadrotor_estimator"),
    "scenarios/logs/columns.py": ("metrics",),
    "scenarios/options.py": ("cli",),
    "scenarios/scenes/drive_scene.py": ("scene",),
    "unifg/view/canvas.py": ("view",),
    "unifg/view/paper.py": ("view",),
    "unifg/view/recording.py": ("view", "scene", "quadrotor_scene"),
    "unifg/view/stage.py": ("scene", "quadrotor_scene"),
    "unifg/view/things.py": ("view",),
    "scenarios/simulation/placement.py": ("unforeseen",),
    "scenarios/quadrotor/arrival.py": ("quadrotor_mpc", "quadrotor_flights"),
    "scenarios/perception/association.py": ("quadrotor_estimator", "quadrotor_world"),
    "scenarios/quadrotor/braking.py": ("quadrotor_controller",),
    "scenarios/quadrotor/flight_control.py": ("quadrotor_decisions", "quadrotor_controller"),
    "scenarios/quadrotor/flight_parts.py": ("quadrotor_decisions", "quadrotor_controller"),
    "scenarios/quadrotor/estimator.py": ("quadrotor_estimator", "quadrotor_joint"),
    "scenarios/quadrotor/guide.py": ("quadrotor_controller", "quadrotor_layouts"),
    "scenarios/quadrotor/flight_joint.py": ("quadrotor_decisions", "quadrotor_joint"),
    "scenarios/course.py": ("quadrotor_obstacles",),
    "scenarios/quadrotor/flight_settings.py": ("quadrotor_decisions", "quadrotor_controller"),
    "scenarios/scenes/flight_scene.py": ("quadrotor_scene",),
    "scenarios/quadrotor/slots.py": ("quadrotor_decisions", "quadrotor_controller"),
    "scenarios/perception/line_tracker.py": ("quadrotor_estimator", "quadrotor_world"),
    "scenarios/quadrotor/flight_past.py": ("quadrotor_estimator", "quadrotor_joint"),
}


@dataclass(frozen=True)
class Verdict:
    """Fate of a mutant: "killed", "survived", or "unseen" when no test touches its line."""

    mutation: Mutation
    outcome: str
    seconds: float


def excused(path: str) -> dict[str, str]:
    """Mutants of a file that may survive, by name, with the reason."""
    table = tomllib.loads(SURVIVORS.read_text(encoding="utf-8")) if SURVIVORS.exists() else {}
    reasons: dict[str, str] = table.get(path, {})
    return reasons


def copied(folder: Path) -> Path:
    """The checkout in a scratch folder: links stay links, Numba's caches stay valid."""
    scratch = folder / "checkout"
    shutil.copytree(CHECKOUT, scratch, symlinks=True, ignore=shutil.ignore_patterns(*LEFT_OUT))
    return scratch


def run_tests(scratch: Path, tests: Sequence[str], limit: float) -> bool:
    """True if all tests pass, in a child process that begins after the imports that never change."""
    child = os.fork()
    if not child:
        status = 1
        try:
            os.setpgid(0, 0)
            status = _in_child(scratch, ["-x", *tests])
        finally:
            os._exit(status)
    end = time.monotonic() + limit
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status) == 0
        if time.monotonic() > end:
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return False
        time.sleep(0.02)


def _in_child(scratch: Path, arguments: list[str]) -> int:
    import pytest

    enter(scratch)
    quiet = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(quiet, stream)
    return int(pytest.main(["-q", "-p", "no:cacheprovider", *arguments]))


def enter(scratch: Path) -> None:
    """Run in the copy: its folder is the working folder and the first to import from."""
    os.chdir(scratch)
    sys.dont_write_bytecode = True  # files change within the second that tells compiled ones apart
    here = ("", str(CHECKOUT), str(CHECKOUT / "tests"))
    sys.path[:] = [str(scratch), *(entry for entry in sys.path if entry not in here)]
    for name in [name for name in sys.modules if name.partition(".")[0] in ("benchmarks", "unifg")]:
        del sys.modules[name]


class Hunt:
    """The mutants of one file."""

    def __init__(self, scratch: Path, path: str, tests: Sequence[str], seen: Touched) -> None:
        """Begin with what the tests touch."""
        self.file, self.tests, self.seen = scratch / path, tests, seen
        self.scratch = scratch
        self.source = self.file.read_text(encoding="utf-8")
        self.times = self.file.stat()

    def judge(self, mutation: Mutation) -> Verdict:
        """Run the tests that touch a mutant's line, then, if they pass, all others."""
        begin = time.monotonic()
        first = self.seen.tests(None if mutation.compiled else self._lines(mutation))
        others = [test for test in self.seen.tests(None) if test not in set(first)]
        if not first:
            return Verdict(mutation, "unseen", 0.0)
        self.file.write_text(mutation.applied(self.source), encoding="utf-8")
        try:
            passed = all(
                run_tests(self.scratch, batch, PATIENCE * self.seen.seconds(batch) + EARLY)
                for batch in (first, others)
                if batch
            )
        finally:
            self.file.write_text(self.source, encoding="utf-8")
            os.utime(self.file, ns=(self.times.st_atime_ns, self.times.st_mtime_ns))
        return Verdict(mutation, "survived" if passed else "killed", time.monotonic() - begin)

    def _lines(self, mutation: Mutation) -> range:
        """A statement over several lines is recorded at some of them."""
        last = mutation.line + self.source.encode()[mutation.begin : mutation.end].count(b"\n")
        return range(mutation.line, last + 1)


def hunt(scratch: Path, path: str, share: float, seed: int, skip_compiled: bool, only: str) -> list[Verdict]:
    """Judge the mutants of one file, and say what becomes of them."""
    tests = [f"tests/test_{name}.py" for name in TARGETS[path]]
    tests = [test for test in tests if (scratch / test).exists()]
    seen = touched(scratch, path, tests)
    hunter = Hunt(scratch, path, tests, seen)
    chosen = [m for m in mutations(hunter.source) if only in m.name and not (skip_compiled and m.compiled)]
    if share < 1.0:
        drawn = random.Random(f"{seed} {path}").sample(range(len(chosen)), round(share * len(chosen)))
        chosen = [chosen[k] for k in sorted(drawn)]
    print(f"{path}: {len(chosen)} mutants, {len(seen.tests(None))} tests", flush=True)
    reasons = excused(path)
    for name in set(reasons) - {mutation.name for mutation in mutations(hunter.source)}:
        print(f"  excused though there is no such mutant any more: {name}", flush=True)
    verdicts = []
    for mutation in chosen:
        if mutation.name in reasons and not only:
            continue
        verdict = hunter.judge(mutation)
        verdicts.append(verdict)
        if verdict.outcome != "killed":
            print(f"  {verdict.outcome:8} {path}:{mutation.line}: {mutation.name}", flush=True)
    killed = sum(verdict.outcome == "killed" for verdict in verdicts)
    print(f"{path}: {killed} of {len(verdicts)} killed, {len(chosen) - len(verdicts)} excused", flush=True)
    return verdicts


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m tools.mutants", description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="*", metavar="FILE", help="of TARGETS; all when none is named")
    parser.add_argument("--share", type=float, default=1.0, help="of the mutants of each file that is drawn")
    parser.add_argument("--seed", type=int, default=0, help="of the draw")
    parser.add_argument("--only", default="", metavar="TEXT", help="mutants whose name holds this, excused or not")
    parser.add_argument("--skip-compiled", action="store_true", help="leave out functions that run under Numba")
    options = parser.parse_args(arguments)
    for file in options.files:
        if file not in TARGETS:
            parser.error(f"{file} is not one of {', '.join(TARGETS)}")
    import numba  # noqa: F401 - children inherit what is loaded here
    import pytest  # noqa: F401
    import scipy.sparse.csgraph  # noqa: F401

    left = 0
    with tempfile.TemporaryDirectory(prefix="unifg-mutants-") as folder:
        scratch = copied(Path(folder))
        for path in options.files or TARGETS:
            verdicts = hunt(scratch, path, options.share, options.seed, options.skip_compiled, options.only)
            left += sum(verdict.outcome != "killed" for verdict in verdicts)
    return 1 if left else 0


if __name__ == "__main__":
    sys.exit(main())
