"""Graduated non-convexity: robust estimation without a good start (Yang et al. 2020).

A robust loss that ignores outliers has many minima. Its surrogates begin nearly quadratic, where a global minimum is
within reach, and sharpen step by step. By the duality of
Black and Rangarajan the weights of a surrogate are those its reweighted least squares would find, so any least-squares
backend does.

Each surrogate is solved from the solution of the one before, and from the guess, and the cheaper answer counts: a wrong
measurement that was believed once bends the trajectory, and everything that started from there would stay bent; where
odometry is weak, the guess alone misses what the surrogates found step by step. While every measurement is heard
there is nothing to escape from: the guess led to nothing cheaper then on any graph that was tried, so surrogates follow
each other in longer strides and from each other alone. Dynamic covariance scaling, a loss with the same bound,
takes a few iterations from the guess and sometimes finds what graduation did not.

The optimum without losses is a start of its own: on a clean graph it is the answer. Where it leaves every measurement
within its threshold, and the sum of all squares is as stated, nothing contradicts what was stated: it is given up
only for single measurements that are improbable as stated, and for groups. Answers are compared by the cost as
stated, in which each measurement left out counts the bound of its loss. Where all terms have losses no measurement can
be trusted, the guess least: all is done from the further starts of the graph, too, and from the optimum of Huber's
loss.

Measurements that were left out are then taken back where they agree with the rest, and those that counted are taken out
where the rest contradicts them (:mod:`unifg.solvers.gating`). Here the size of the noise counts, found for each term
over what both answers keep: by the stated numbers a wrong measurement often pays, since to fit it what only odometry
holds is bent within its standard deviations. If all others agree ten times better than they had to, that is a
contradiction. Measurements that join the same stretches are tested as a group as well, since each would be borne out by
the others; groups that agree with themselves alone are named with the answer that reads them the other way.

H. Yang, P. Antonante, V. Tzoumas, L. Carlone, "Graduated non-convexity for robust spatial perception: from non-minimal
solvers to global outlier rejection", IEEE RA-L 5(2), 2020.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import NamedTuple

import numpy as np

from unifg.codegen.inner import inner
from unifg.errors import BackendError, GraphError, require_kinds
from unifg.factors.robust import DCS, Graduated, Huber, Loss
from unifg.modeling.model import Model
from unifg.modeling.terms import Cost
from unifg.modeling.variables import Data
from unifg.problem.linearization import Linearization
from unifg.problem.term import CompiledTerm
from unifg.solution.chi_squared import upper_quantile
from unifg.solution.history import Iteration
from unifg.solution.outlier_report import Group, OutlierReport
from unifg.solution.solution import AnyGuess, NotConverged, Solution, values_of
from unifg.solution.solve_state import Backend, Callback
from unifg.solution.solver import Prepared, Solver
from unifg.solution.status import Status
from unifg.solvers.gating import CHANCE, Innovations, VarianceFactor, groups_of
from unifg.solvers.least_squares import GaussNewton, LevenbergMarquardt
from unifg.typing import Array, ArrayLike, BoolArray, IntArray, Numbers

logger = logging.getLogger("unifg")

FAR = 1e30  # a squared residual that no loss believes
FEWER = 0.7  # share of the measurements to take back or out where all were too many
HALF = 0.5  # smaller weights mean that a measurement was left out
LESS = 1e-9  # share of the cost by which a solution must be better
ROUGH = 1e-2  # tolerance of the stages: a share of 1e-4 of the cost
HEARD = 1e-2  # share of the strongest pull, below which a measurement that is farther off is not heard
STRIDE = 2  # surrogates at a time while all are
RIVALS = 3  # other answers that are named, at most
HUBER = 1.345  # [sigma]
GROUPS = 3  # that are tried, of those that count and of those left out
SPARE = 4.0  # noise is rarely of one size: twice the standard deviation of the others is no contradiction
ROUNDS = 20  # of taking back or out
DECIDED = 1e-3  # a truncated loss is done when every weight is this close to zero or one


STATED = VarianceFactor(0.0, np.inf)  # noise as large as stated


class _Held:
    """Weights that were chosen."""

    held = False

    def __init__(self, weights: ArrayLike) -> None:
        self.weights: Array = np.asarray(weights, dtype=np.float64)

    def value(self, squared: Array) -> Array:
        return self.weights * squared

    def weight(self, squared: Array) -> Array:
        return np.broadcast_to(self.weights, squared.shape)


NO_LOSS = _Held(1.0)  # where the graduation begins


class _Stage:
    """A loss that is replaced between solves without a new graph, and remembers what it was last asked."""

    held = False

    def __init__(self, goal: Graduated) -> None:
        self.goal = goal
        self.now: Loss = NO_LOSS
        self.squared = np.zeros(0)
        self.largest = 0.0

    def value(self, squared: Array) -> Array:
        return self.now.value(squared)

    def weight(self, squared: Array) -> Array:
        self.squared = squared.copy()
        self.largest = max(self.largest, float(squared.max(initial=0.0)))
        return self.now.weight(squared)

    @property
    def influential(self) -> bool:
        """True if no factor pulls much less for being farther off than another one."""
        if not len(self.squared):
            return True
        pulls = self.now.weight(self.squared) * np.sqrt(self.squared)
        strongest = pulls.argmax()
        farther = self.squared > self.squared[strongest]
        return bool((pulls[farther] >= HEARD * pulls[strongest]).all())

    @property
    def decided(self) -> bool:
        """True if every factor counts in full or not at all."""
        weights = self.now.weight(self.squared)
        return bool((np.minimum(weights, 1.0 - weights) < DECIDED).all())


@dataclass(kw_only=True)
class GraduatedNonConvexity(Backend):
    """Solves graphs with `unifg.TruncatedLeastSquares` or `unifg.GemanMcClure` in one or more terms.

    The answer is the best found, not the best there is: no local method knows that. CONVERGED says that it is
    stationary. ``solution.verdict`` says which measurements it believes and which other answers were found that cost
    less, or as much (:class:`unifg.solution.outlier_report.OutlierReport`).

    It is called like a backend. Terms with other losses, or none, take part as they are: measurements that can be
    trusted, such as odometry, are stated without a loss.

    Attributes:
        solver: the least-squares backend inside. Its options hold for the last solves, with the losses themselves.
            Damping does not help here: from odometry far off it ends early.
        growth: how much sharper each surrogate is than the one before (1.4 in the paper).
        stage_iterations: iterations of the backend without the losses and for each surrogate, at most; a rough answer
            will do.
    """

    constraints = "none"
    scalar_costs = False

    solver: Solver = field(default_factory=GaussNewton)
    growth: float = 1.4
    stage_iterations: int = 20

    def __post_init__(self) -> None:
        """Refuse options no solve could honour."""
        require_kinds(self.name, BackendError, type(self).__annotations__, vars(self), Solver)
        if not self.growth > 1.0:
            raise BackendError(f"{self.name}: growth must be above 1, found {self.growth}")
        if self.stage_iterations < 1:
            raise BackendError(f"{self.name}: stage_iterations must be positive, found {self.stage_iterations}")

    def solve(
        self,
        graph: Model,
        guess: AnyGuess,
        *,
        data: Mapping[Data, Numbers] | None = None,
        check: bool = False,
        callback: Callback | None = None,
    ) -> Solution:
        """Solve without the losses, through their surrogates, and with the losses themselves.

        Arguments as for :class:`unifg.solution.solve_state.Backend`; every surrogate starts at the guess.

        Returns:
            The solution of the graph as stated, judged with its own losses. The history holds all stages, numbered
            through; ``stage`` among the details of a row is 0 without the losses.

        Raises:
            BackendError: also when no term has a loss with surrogates.
        """
        started = time.perf_counter()
        staged, stages = _staged(graph)
        if not stages:
            raise BackendError(
                f"{self.name}: no term has a loss with surrogates; use robust=TruncatedLeastSquares(...) or "
                f"GemanMcClure(...), or give the graph to {self.solver.name}"
            )
        search = _Search(self, graph, staged, stages, data, callback)
        solution = search.best(guess)
        history = search.history
        solution.history, solution.iterations = history.rows, history.rows[-1].number
        solution.seconds, solution.solver = time.perf_counter() - started, f"{self.name} ({self.solver.name})"
        if check and not solution.converged:
            raise NotConverged(solution)
        return solution


class _Search:
    """One solve: candidates from the surrogates and from the rival, the best of them gated."""

    def __init__(
        self,
        options: GraduatedNonConvexity,
        graph: Model,
        staged: Model,
        stages: list[_Stage],
        data: Mapping[Data, Numbers] | None,
        callback: Callback | None,
    ) -> None:
        self._options, self._stages, self._data = options, stages, data
        self.history = _History(callback)
        solver = options.solver
        rough = max(solver.tolerance, ROUGH)
        self._run = replace(solver, max_iterations=options.stage_iterations, tolerance=rough).bound(staged)
        self._last = solver.bound(graph)
        self._damped: Prepared | None = None
        self.found: list[_Answer] = []
        self._shares: dict[str, _Sum] = {}
        self._calm: _Answer | None = None
        self._groups: list[tuple[str, IntArray, bool, Solution]] = []
        robust = self._run.program.table.robust
        self._terms = [t for t, _ in robust if isinstance(t.term, Cost) and isinstance(t.term.robust, _Stage)]
        staged_names = {term.name for term in self._terms}
        self._plain_terms = [term for term in self._last.program.cost_terms if term.name not in staged_names]
        self._parts = {term.name: part for term, part in self._last.program.table.robust}

    def best(self, guess: AnyGuess) -> Solution:
        """The best answer found, judged with the losses themselves."""
        told: list[str] = []

        def influential(origin: str, solution: Solution) -> None:
            told.append(f"{origin} {self._answer(solution).solution.cost:.6g}")

        for start in self._starts(guess):
            graduated = self._graduated(start)
            if graduated.status is Status.INTERRUPTED:
                break
            influential("surrogates", self._stated(graduated))
            # The optimum without losses believes everything: on a clean graph it is the answer.
            influential("squares", self.history.add(self._last, self._plain.values, self._data, restart=True))
            if self._plain_terms and self._calm is None and self._within(self._plain) and self.found[-1].consistent:
                self._calm = self.found[-1]
            for make in (_rival,) if self._plain_terms else (_rival, _huber):
                for stage in self._stages:
                    stage.now = make(stage.goal)
                influential(str(self._stages[0].now), self._stated(self._from(start)))
            if not self._plain_terms:
                influential("guess", self.history.add(self._last, start, self._data, restart=True))
        if not self.found:
            return self._interrupted(graduated)
        # Nothing contradicts what was stated: a right measurement is not given up because that is cheaper.
        answer = self._calm or min(self.found, key=lambda one: one.solution.cost)
        logger.info("%s: answers of cost %s", self._options.name, ", ".join(told))
        if any(one.status is Status.INTERRUPTED for one in [graduated, *(one.solution for one in self.found)]):
            answer.solution.status = Status.INTERRUPTED
            return answer.solution
        return self._concluded(self._revised(answer))

    def _starts(self, guess: AnyGuess) -> Iterator[AnyGuess]:
        """The guess, and the further ones of the graph."""
        yield guess
        for make in self._last.program.graph.starts:
            with suppress(GraphError):  # what the measurements do not determine is no start
                yield {**values_of(guess), **make()}

    def _within(self, found: Solution) -> bool:
        """Test whether an answer leaves every measurement within its threshold."""
        squares = self._run.program.linearize(found.values).squares
        parts = {term.name: part for term, part in self._run.program.table.robust}
        return all(
            bool((squares[parts[term.name]] <= _bound(stage.goal)).all())
            for term, stage in zip(self._terms, self._stages, strict=True)
        )

    def _graduated(self, guess: AnyGuess) -> Solution:
        """Without the losses, then through their surrogates."""
        stages = self._stages
        for stage in stages:
            stage.now, stage.largest = NO_LOSS, 0.0
        self._plain = solution = self._from(guess)
        # The largest residual on the way from the guess: the solution without losses may hide an outlier by spreading
        # it over many weak measurements.
        paths = [stage.goal.surrogates(stage.largest, self._options.growth) for stage in stages]
        stride = 1
        while solution.status is not Status.INTERRUPTED:
            for stage, path in zip(stages, paths, strict=True):
                stage.now = next(islice(path, stride - 1, None), stage.goal)
            if all(stage.now is stage.goal for stage in stages):
                break
            solution = self._from(solution.values)
            stride = STRIDE
            if not all(stage.influential for stage in stages):
                solution, stride = self._or_from(guess, solution), 1
            if all(stage.decided for stage in stages):
                break
        return solution

    def _or_from(self, guess: AnyGuess, found: Solution) -> Solution:
        """The answer of the present surrogate, or one from the guess that costs no more."""
        if found.status is Status.INTERRUPTED:
            return found
        seen = [stage.squared for stage in self._stages]
        anew = self._from(guess)
        if anew.status is Status.INTERRUPTED or anew.cost <= found.cost:
            return anew
        for stage, squared in zip(self._stages, seen, strict=True):
            stage.squared = squared
        return found

    def _from(self, start: AnyGuess) -> Solution:
        """Solve the present stage; with damping, where weights of zero leave something undetermined."""
        found = self.history.add(self._run, start, self._data, restart=True)
        if found.status is not Status.SINGULAR:
            return found
        if self._damped is None:
            limit, tolerance = self._run.solver.max_iterations, self._run.solver.tolerance
            damped = LevenbergMarquardt(max_iterations=limit, tolerance=tolerance)
            self._damped = damped.bound(self._run.program.graph)
        return self.history.add(self._damped, found.values, self._data, restart=True)

    def _stated(self, found: Solution) -> Solution:
        """Go on from there with the losses themselves."""
        return self.history.add(self._last, found.values, self._data)

    def _interrupted(self, found: Solution) -> Solution:
        last = replace(self._options.solver, max_iterations=0).bound(self._last.program.graph)
        solution = self.history.add(last, found.values, self._data)
        solution.status = Status.INTERRUPTED
        return solution

    def _revised(self, answer: _Answer) -> _Answer:
        """Take back what was left out but agrees with the rest, take out what the rest contradicts."""
        program = self._last.program
        factorization = program.systems.normal()
        for _ in range(ROUNDS):
            for stage in self._stages:
                stage.now = NO_LOSS
            values = answer.solution.values
            plain = self._run.program.linearize(values)
            innovations = Innovations(program, factorization, program.linearize(values).hessian)
            if answer.solution.status is Status.INTERRUPTED or not innovations.determined:
                return answer
            self._shares = self._redundancies(answer, plain, innovations)
            back, out = [], []
            everything = sum(len(kept) for kept in answer.kept)
            for term, stage, kept, squared in zip(self._terms, self._stages, answer.kept, answer.squared, strict=True):
                bound = _bound(stage.goal)
                left = ~kept if term.active is None else ~kept & term.active
                score = np.full(len(kept), np.inf)
                score[left] = innovations.squared(term, plain, left)
                score[score > min(bound, answer.scatter.limit(term.size, everything))] = np.inf
                back.append(score / bound)
                fall, far = innovations.without(term, plain, kept, stage.goal.weight(squared)[kept])
                wrong = answer.scatter.rejects(fall, term.size, everything)
                answer.flagged[term.name] = np.flatnonzero(kept)[wrong]
                if self._calm is not None:
                    wrong = STATED.rejects(fall, term.size, everything)
                # What would stay within its threshold counts, by the loss as stated, however the others scatter.
                score = np.full(len(kept), np.inf)
                score[kept] = np.where(wrong & (far > bound), -fall, np.inf)
                out.append(score / bound)
            better = self._with(answer, back, 1.0) or self._with(answer, out, 0.0) or self._without_group(answer)
            better = better or self._by_groups(answer, plain, innovations)
            if better is None:
                return answer
            answer = better
        return answer

    def _without_group(self, answer: _Answer) -> _Answer | None:
        """A better answer found before that leaves out several measurements, or None.

        Where all is consistent as stated, these have to be groups, and the answer cheaper.
        """
        for other in sorted(self.found, key=lambda one: one.solution.cost):
            if not other.solution.converged or other.count >= answer.count:
                continue
            if self._calm is None:
                if self._prefers(other, answer, SPARE):
                    return other
            elif other.solution.cost < (1.0 - LESS) * answer.solution.cost:
                dropped = [ours & ~theirs for ours, theirs in zip(answer.kept, other.kept, strict=True)]
                grouped = sum(len(g) for t, gone in zip(self._terms, dropped, strict=True) for g in groups_of(t, gone))
                if grouped > HALF * sum(int(gone.sum()) for gone in dropped):
                    return other
        return None

    def _by_groups(self, answer: _Answer, plain: Linearization, innovations: Innovations) -> _Answer | None:
        """A better answer without a group of measurements that counts, or with one that was left out, or None."""
        self._groups = []
        flagged: list[tuple[float, int, IntArray]] = []
        left: list[tuple[int, IntArray]] = []
        for k, (term, kept, weight) in enumerate(zip(self._terms, answer.kept, answer.weights, strict=True)):
            groups = groups_of(term, kept)
            for group in groups:
                fall = innovations.joint(term, plain, group, weight[group])
                if answer.scatter.rejects(np.array([fall]), term.size, len(groups))[0]:
                    flagged.append((fall / len(group), k, group))
            left += [(k, group) for group in groups_of(term, ~kept & (_active(term) > 0.0))]
        flagged.sort(key=lambda one: -one[0])
        left.sort(key=lambda one: -len(one[1]))
        tried = [(k, group, 0.0) for _, k, group in flagged[:GROUPS]] + [(k, group, 1.0) for k, group in left[:GROUPS]]
        for k, group, share in tried:
            for j, (stage, squared) in enumerate(zip(self._stages, answer.squared, strict=True)):
                held = stage.goal.weight(squared)
                if j == k:
                    held[group] = share
                stage.now = _Held(held)
            found = self._answer(self._stated(self.history.add(self._run, answer.solution.values, self._data)))
            if bool(share) != bool(found.kept[k][group].mean() >= HALF):
                continue  # the others decide about its members, one by one
            if self._prefers(found, answer, 1.0):
                return found
            self._groups.append((self._terms[k].name, group, not share, found.solution))
        return None

    def _prefers(self, one: _Answer, other: _Answer, spare: float) -> bool:
        """Test whether an answer costs less than another once the noise of each term has the size found for both.

        Where every term has a loss, no measurement is trusted, and scale does not tell which of two that contradict
        each other is wrong: the cost as stated decides.
        """
        units: Mapping[str, float] = {}
        usual = all(_bound(s.goal) >= t.size for s, t in zip(self._stages, self._terms, strict=True))
        if self._plain_terms and usual and (self._calm is None or spare == 1.0):
            units = {name: min(1.0, spare * unit) for name, unit in one.units_with(other, self._shares).items()}
        return one.judged(units) < (1.0 - LESS) * other.judged(units)

    def _competes(self, one: _Answer, final: _Answer) -> bool:
        """Test whether an answer costs less than the final one, or keeps something else for nearly as little."""
        if one.solution.cost < (1.0 - LESS) * final.solution.cost:
            return True
        if not any((ours & ~theirs).any() for ours, theirs in zip(one.kept, final.kept, strict=True)):
            return False  # it only gave up more
        units = one.units_with(final, self._shares) if self._shares else {}
        return one.judged(units) < final.judged(units) + max(_bound(stage.goal) for stage in self._stages)

    def _with(self, answer: _Answer, scores: list[Array], weight: float) -> _Answer | None:
        """A better answer in which the measurements with the lowest finite scores have that weight, or None."""
        every = np.sort(np.concatenate(scores))
        every = every[np.isfinite(every)]
        weights = [stage.goal.weight(s) for stage, s in zip(self._stages, answer.squared, strict=True)]
        while len(every):
            for stage, present, score in zip(self._stages, weights, scores, strict=True):
                stage.now = _Held(np.where(score <= every[-1], weight, present))
            found = self._answer(self._stated(self.history.add(self._run, answer.solution.values, self._data)))
            if self._prefers(found, answer, SPARE):
                return found
            every = every[: int(FEWER * len(every))]
        return None

    def _answer(self, solution: Solution) -> _Answer:
        """A solution with what it believes, remembered."""
        program = self._last.program
        lin = program.linearize(solution.values)
        squared = [lin.squares[self._parts[term.name]] for term in self._terms]
        plain = {}
        for term in self._plain_terms:
            active, loss = _active(term), term.term.robust if isinstance(term.term, Cost) else None
            own = lin.norms[term.name] ** 2
            if loss is not None:
                own = inner(loss.value(lin.squares[self._parts[term.name]]), active)
            plain[term.name] = _Sum(own, term.size * float(active.sum()))
        found = _Answer(solution, self._stages, self._terms, squared, plain, program.size)
        self.found.append(found)
        return found

    def _redundancies(self, answer: _Answer, plain: Linearization, innovations: Innovations) -> dict[str, _Sum]:
        """Of each term, the residuals that the unknowns do not take up, and those that count, at an answer."""
        weights = dict(zip([t.name for t in self._terms], answer.weights, strict=True))
        found = {}
        for term in self._last.program.cost_terms:
            weight = weights.get(term.name, _active(term))
            found[term.name] = _Sum(innovations.redundancy(term, plain, weight), term.size * float(weight.sum()))
        return found

    def _concluded(self, answer: _Answer) -> Solution:
        """Solve once more, and say what was found besides."""
        final = self._answer(self._stated(answer.solution))
        flagged = answer.flagged if final.believes_as(answer) else {}
        rivals: list[_Answer] = []
        for other in sorted(self.found, key=lambda a: a.solution.cost):
            known = any(other.believes_as(one) for one in [final, *rivals])
            if other.solution.converged and not known and self._competes(other, final):
                rivals.append(other)
        kept = {term.name: kept for term, kept in zip(self._terms, final.kept, strict=True)}
        others = tuple(other.solution for other in rivals[:RIVALS])
        for other in rivals[:RIVALS]:
            theirs = {term.name: kept for term, kept in zip(self._terms, other.kept, strict=True)}
            other.solution.verdict = OutlierReport(theirs, other.flagged, other.scatter.unit)
        groups = [
            Group(name, factors, held, other, self._moved(final.solution, other))
            for name, factors, held, other in self._groups
        ]
        final.solution.verdict = OutlierReport(kept, flagged, final.scatter.unit, others, tuple(groups))
        return final.solution

    def _moved(self, one: Solution, other: Solution) -> tuple[str, int, float]:
        """Family and member whose values differ most, and by how much."""
        found = ("", 0, 0.0)
        for name, family in self._last.program.graph.families.items():
            apart = np.linalg.norm(family.manifold.local(one[family], other[family]), axis=1)
            member = int(apart.argmax())
            found = max(found, (name, member, float(apart[member])), key=lambda one: one[2])
        return found


class _Sum(NamedTuple):
    """A sum over residuals that count, and their number."""

    total: float
    rows: float


class _Answer:
    """A solution, which measurements it believes, and how much those scatter."""

    def __init__(
        self,
        solution: Solution,
        stages: list[_Stage],
        terms: list[CompiledTerm],
        squared: list[Array],
        plain: dict[str, _Sum],
        unknowns: int,
    ) -> None:
        """Sum up.

        Args:
            solution: of the graph as stated.
            stages: of every term with a loss.
            terms: those terms.
            squared: (n,) squared residuals of their factors.
            plain: of every other term, twice its cost.
            unknowns: number of them.
        """
        self.solution, self.squared, self._plain, self._terms = solution, squared, plain, terms
        self._goals = [stage.goal for stage in stages]
        self._active = [_active(term) for term in terms]
        self.weights = [goal.weight(s) * a for goal, s, a in zip(self._goals, squared, self._active, strict=True)]
        self.kept: list[BoolArray] = [weight >= HALF for weight in self.weights]
        self.count = sum(int(kept.sum()) for kept in self.kept)
        self.flagged: dict[str, IntArray] = {}
        sums = [*plain.values()]
        for term, weight, own in zip(terms, self.weights, squared, strict=True):
            sums.append(_Sum(inner(weight, own), term.size * float(weight.sum())))
        self.scatter = VarianceFactor(sum(one.total for one in sums), sum(one.rows for one in sums) - unknowns)

    @property
    def consistent(self) -> bool:
        """Test whether the sum of all squares is no larger than what is stated makes likely."""
        return self.scatter.freedom < 1.0 or self.scatter.squared <= upper_quantile(self.scatter.freedom, CHANCE)

    def units_with(self, other: _Answer, shares: Mapping[str, _Sum]) -> dict[str, float]:
        """Variance of unit weight of each term, over all measurements that this answer or another one keeps.

        A measurement that one of them leaves out counts where it is kept, so it is at least about that of the answer
        which keeps more.

        Args:
            other: answer.
            shares: of each term, the redundancy and the number of its residuals at one of both.
        """
        found = {}
        for name, one in self._plain.items():
            found[name] = VarianceFactor(max(one.total, other._plain[name].total), shares[name].total).unit
        for k, term in enumerate(self._terms):
            ours, theirs = self.weights[k] * self.squared[k], other.weights[k] * other.squared[k]
            rows = term.size * float(np.maximum(self.weights[k], other.weights[k]).sum())
            freedom = shares[term.name].total + rows - shares[term.name].rows
            found[term.name] = VarianceFactor(float(np.maximum(ours, theirs).sum()), freedom).unit
        return found

    def judged(self, units: Mapping[str, float]) -> float:
        """Twice the cost with the noise of each term smaller, by the root of its unit (or one), than it states."""
        losses = sum(
            float((goal.value(squared / units.get(term.name, 1.0)) * active).sum())
            for term, goal, squared, active in zip(self._terms, self._goals, self.squared, self._active, strict=True)
        )
        return sum(one.total / units.get(name, 1.0) for name, one in self._plain.items()) + losses

    def believes_as(self, other: _Answer) -> bool:
        """Test whether both keep the same measurements."""
        return all(np.array_equal(a, b) for a, b in zip(self.kept, other.kept, strict=True))


class _History:
    """Rows of several solves, numbered through.

    A solve that goes on from the one before repeats its last row; one that starts anew has no row for its start.
    """

    def __init__(self, callback: Callback | None) -> None:
        self.rows: list[Iteration] = []
        self._callback = callback
        self._stage = -1
        self._restart = False

    def add(
        self, run: Prepared, start: AnyGuess, data: Mapping[Data, Numbers] | None, *, restart: bool = False
    ) -> Solution:
        """Solve and keep the rows."""
        self._stage += 1
        self._restart = restart
        return run.solve(start, data=data, callback=self._row)

    def _row(self, row: Iteration) -> bool | None:
        before = self.rows[-1].number if self.rows else 0
        number = before + (1 if row.number else 0)
        if self.rows and not row.number:
            if self._restart:
                return None
            self.rows.pop()  # the same point, seen through the next loss
        row = replace(row, number=number, details={**row.details, "stage": self._stage})
        self.rows.append(row)
        return None if self._callback is None else self._callback(row)


def _active(term: CompiledTerm) -> Array:
    """(n,) one for each factor that is switched on."""
    return np.ones(term.count) if term.active is None else np.asarray(term.active, dtype=np.float64)


def _bound(loss: Loss) -> float:
    """Limit of the loss of a measurement that is left out."""
    return float(loss.value(np.array([FAR]))[0])


def _rival(loss: Loss) -> Loss:
    """Dynamic covariance scaling with the same bound."""
    return DCS(_bound(loss) / 3.0)


def _huber(loss: Loss) -> Loss:
    """The convex loss nearest to squares: 95 % as efficient where all is right."""
    return Huber(HUBER)


def _staged(graph: Model) -> tuple[Model, list[_Stage]]:
    """The same graph with a `_Stage` in place of every loss that has surrogates."""
    staged, stages = graph.snapshot(), []
    for k, term in enumerate(staged.terms):
        if isinstance(term, Cost) and isinstance(term.robust, Graduated):
            stages.append(_Stage(term.robust))
            staged.terms[k] = replace(term, robust=stages[-1])
    return staged, stages
