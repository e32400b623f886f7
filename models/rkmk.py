"""Runge-Kutta-Munthe-Kaas integrators: a motion on a Lie group as conditions on (x_i, u_i, x_{i+1}).

The state obeys x' = x hat(F(x, u, ...)), F in the Lie algebra and trivialised on the left (Ta et al. 2014, eq. 9). In
the exponential coordinates x(t) = x_i Exp(xi(t)) (eq. 10) this is a differential equation in a vector space,

    xi' = dexp_inv(xi) F(x_i Exp(xi), u),   xi(0) = 0                                             (eq. 15, 17)

with Exp(xi)^-1 Exp(xi + d) = Exp(dexp(xi) d): Ta's dexp is the *right* Jacobian and its inverse is
I + ad/2 + ad^2/12 - ...; the formula he cites, (4.5) on page 84 of his [12], trivialises on the right and has -ad/2.
Any Runge-Kutta method applied to it gives a step that stays on the group. With the inputs u held, and eq. 16 for xi,
the defect of a step is xi - h Phi, xi = Log(x_i^-1 x_{i+1}):

    explicit Euler         Phi = F(x_i, u)
    implicit Euler         Phi = F(x_{i+1}, u)
    implicit midpoint      Phi = F(x_i Exp(xi/2), u)
    full trapezoid         Phi = 1/2 (F(x_i, u) + dexp_inv(xi) F(x_{i+1}, u))                     (Ta, III-B)
    simplified trapezoid   Phi = 1/2 (F(x_i, u) + F(x_{i+1}, u))                                  (Ta, III-B)
    rk4                    the classical tableau of four stages, k = dexp_inv(sigma) F(x_i Exp(sigma), u)
    hermite-simpson        the trapezoid's two velocities and a third between them, by the rule of Simpson

dexp_inv drops out of implicit Euler and of the midpoint rule: their single stage stands at sigma = c h k on the line
of its own velocity k = dexp_inv(sigma) F, and dexp(sigma) k = k because ad(k) k = 0; hence k = F.

The simplified trapezoid changes the step of the full one by h^3/8 [F, F'] to leading order, as small as the
trapezoid's own error: both are of second order. All methods are exact where F does not depend on the state.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, Literal, TypeAlias

import numpy as np

from unifg.codegen.calls import RETRACTION, address, call_residual, call_retraction, vector
from unifg.codegen.jit import compiled
from unifg.errors import ModelError, UnifgError
from unifg.factors.autodiff.captured import captured_by
from unifg.factors.autodiff.derived import DerivedKernel, derived
from unifg.factors.autodiff.rows import Each
from unifg.factors.autodiff.symbols import TraceError
from unifg.factors.differences import jacobian
from unifg.factors.residuals import Residual, residual
from unifg.lie import LieGroup
from unifg.lie.functions import functions_of
from unifg.modeling.duplicates import doubles
from unifg.models.tableau import METHODS, Tableau
from unifg.typing import Array, ArrayLike

__all__ = ["advance", "integrator", "rollout", "unicycle_field"]

Field: TypeAlias = Callable[..., Array]
Rows: TypeAlias = Sequence[Sequence[float]]
Method: TypeAlias = (
    Literal[
        "explicit euler",
        "implicit euler",
        "implicit midpoint",
        "full trapezoid",
        "simplified trapezoid",
        "rk4",
        "hermite-simpson",
    ]
    | Tableau
)
WEIGHT, END, FLAT, BEFORE = 0, 1, 2, 3  # columns of Tableau.rows
FEW = 100  # steps that a simulation takes in NumPy: machine code for its step costs more
NEWTON_STEPS = 30
ENOUGH = 1e-13  # of the last Newton step, relative to the state: what rounding leaves


def integrator(group: LieGroup, field: Field, method: Method = "full trapezoid") -> Residual:
    """``integrator(group, F)(x, u, x_next, h)``: defect xi - h Phi of one step, (n, dim).

    Use it with ``constrain(..., lower=0, upper=0)`` or, soft, with ``minimize``. A field of several inputs,
    F(x, u, w, m), makes ``(x, u, w, m, x_next, h)``; each input is a variable on ``Rn`` (a family of length 1 is shared
    by all steps), or data. The step h [s] is one number or one for each factor; a duration to be found is an input:
    F(x, u, T) = T f(x, u), with h in parts of T.

    Args:
        group: of the states x and x_next, (n, storage).
        field: F(x, u, ...), velocities in the body frame, (n, dim), for states (n, storage) and inputs (n, k). It is
            traced with all stages; where it cannot be, the step is differenced.
        method: its name, or a :class:`Tableau` of your own.

    Raises:
        ModelError: on an unknown method.
    """
    tableau = _tableau(method)
    return residual(partial(step_defect, group, field, tableau.numbers), name=tableau.name)


def _tableau(method: Method) -> Tableau:
    if isinstance(method, Tableau):
        return method
    try:
        return METHODS[method]
    except KeyError:
        known = ", ".join(f"'{name}'" for name in METHODS)
        raise ModelError(f"method must be a Tableau or one of {known}; found {method!r}") from None


# ---------------------------------------------------------------- one step


def step_defect(group: LieGroup, field: Field, rows: Rows, x: Array, *rest: Any) -> Array:
    """Xi - h Phi of (x, inputs, x_next, h), (n, dim).

    Args:
        group: of x and x_next.
        field: F(x, inputs), (n, dim).
        rows: of the method's :class:`~unifg.models.tableau.Tableau`.
        x: (n, storage).
        rest: inputs (n, k) or (1, k) each, x_next (n, storage), h one or (n,).

    Raises:
        ModelError: x_next is no state, as when arguments are in another order, or an input has no rows.
    """
    *inputs, after, step = rest
    if getattr(after, "shape", ())[1:] != (group.storage,):
        found = getattr(after, "shape", after)
        raise ModelError(
            f"an integrator takes x, the inputs of its field, x_next and h, in this order: the last but one is no "
            f"(n, {group.storage}) of {group.name}, found {found}"
        )
    x, after, *inputs = alike(x, after, *inputs)
    xi = group.local(x, after)
    defect = xi
    for part in _parts(group, field, rows, x, inputs, np.reshape(step, (-1, 1)), xi, after):
        defect = defect - part
    return defect


def travel(group: LieGroup, field: Field, rows: Rows, x: Array, *rest: Any) -> Array:
    """H Phi of (x, inputs, h), (n, dim), for an explicit method."""
    *inputs, step = rest
    x, *inputs = alike(x, *inputs)
    total: Array = sum(_parts(group, field, rows, x, inputs, np.reshape(step, (-1, 1))))  # type: ignore[assignment]
    return total


def alike(*parts: Array) -> list[Array]:
    """The same arrays, those of a single row repeated.

    Raises:
        ModelError: one of them has no two axes, or another number of rows.
    """
    if flat := [np.shape(part) for part in parts if len(np.shape(part)) < 2]:
        raise ModelError(
            f"inputs of a field have rows, found shape {flat[0]}: c[None] is one row for all steps, c[:, None] a "
            "number for each step"
        )
    count = max(len(part) for part in parts)
    if odd := [len(part) for part in parts if len(part) not in (1, count)]:
        raise ModelError(f"states and inputs of a field have as many rows, or one; found {odd[0]} beside {count}")
    return [np.broadcast_to(part, (count, part.shape[1])) for part in parts]


def _parts(
    group: LieGroup,
    field: Field,
    rows: Rows,
    x: Array,
    inputs: Sequence[Array],
    h: Array,
    xi: Array | float = 0.0,
    after: Array | None = None,
) -> Iterator[Array]:
    """H b k of every stage, (n, dim)."""
    speeds: list[Array] = []
    for row in rows:
        before = row[BEFORE : BEFORE + len(speeds)]
        inside = any(before) or row[END] not in (0.0, 1.0)
        sigma = row[END] * xi + h * sum(a * k for a, k in zip(before, speeds, strict=True))
        point = group.retract(x, sigma) if inside else after if row[END] else x
        speed = field(point, *inputs)
        if np.shape(speed) not in ((len(x), group.dim), (1, group.dim)):
            raise ModelError(
                f"a field gives velocities in {group.name}, one row for each state, ({len(x)}, {group.dim}); found "
                f"shape {np.shape(speed)}: np.stack([...], axis=1) makes rows of (n,) numbers"
            )
        if (inside or row[END]) and not row[FLAT]:
            speed = times(group.right_jacobian_inverse(sigma), speed)
        speeds.append(speed)
        yield h * row[WEIGHT] * speed


def times(matrices: Array, vectors: Array) -> Array:
    """(n, d) products of (n, d, d) matrices and (n, d) vectors."""
    product: Array = np.einsum("nij,nj->ni", matrices, vectors)
    return product


# ---------------------------------------------------------------- simulation


def advance(
    group: LieGroup, field: Field, x: ArrayLike, *inputs: ArrayLike, h: ArrayLike, method: Method = "rk4"
) -> Array:
    """One step of every state, (n, storage): the x_next at which the defect of :func:`integrator` vanishes.

    Explicit methods take it directly, implicit ones by Newton's method from a step of explicit Euler.

    Args:
        group: of the states.
        field: F(x, u, ...).
        x: states (n, storage).
        inputs: (n, k) or (1, k) each, held over the step.
        h: step [s], one or (n,).
        method: as for :func:`integrator`.

    Raises:
        UnifgError: when Newton's method does not converge: the step is too long.
        ModelError: on an unknown method, or shapes that do not fit.
    """
    tableau = _tableau(method)
    x, *held = alike(*(np.asarray(part, dtype=np.float64) for part in (x, *inputs)))
    if x.shape[1] != group.storage or np.size(h) not in (1, len(x)):
        raise ModelError(
            f"advance takes states (n, {group.storage}) of {group.name}, inputs (n, k) and h, one or (n,); found "
            f"{x.shape} and h {np.shape(h)}"
        )
    return _advance(group, field, tableau, x, held, h)


def rollout(
    group: LieGroup,
    field: Field,
    start: ArrayLike,
    *inputs: ArrayLike,
    h: ArrayLike,
    method: Method = "rk4",
    count: int | None = None,
    substeps: int = 1,
) -> Array:
    """States reached from ``start`` under inputs, (n + 1, storage).

    Args:
        group: of the states.
        field: F(x, u, ...).
        start: (storage,).
        inputs: (n, k) each, held over a step; (k,) or (1, k) when held over all of them.
        h: step [s], one or (n,).
        method: as for :func:`integrator`.
        count: n; where neither inputs nor steps tell it, one step is taken without it.
        substeps: steps of the method, of length h / substeps, for each row of the inputs.

    Raises:
        UnifgError: when Newton's method does not converge in a step of an implicit method.
        ModelError: on an unknown method, no whole number of substeps, or shapes that do not fit.
    """
    tableau = _tableau(method)
    require_substeps("rollout", substeps)
    parts = [np.atleast_2d(np.asarray(part, dtype=np.float64)) for part in inputs]
    lengths = np.ravel(doubles("rollout: h", h)) / substeps
    even, rows = len(lengths) == 1, {len(part) for part in (*parts, lengths)}
    count = max(rows) if count is None else count
    if not isinstance(count, int | np.integer) or count < 0:
        raise ModelError(f"rollout takes a whole number of steps, 0 or more; found count={count!r}")
    if np.size(start) != group.storage or not rows <= {1, count}:
        found = ", ".join(str(np.shape(part)) for part in (start, *parts, h))
        raise ModelError(
            f"rollout takes a start ({group.storage},), inputs ({count}, k) or (k,) and h, one or ({count},); found "
            f"{found}"
        )
    parts = [np.broadcast_to(part, (count, part.shape[1])) for part in parts]
    states = np.empty((count + 1, group.storage))
    states[0] = start
    functions = functions_of(group) if count * substeps > FEW and tableau.explicit and even else None
    step = _stepping(group, field, tableau, states[0], parts, lengths[0]) if functions is not None else None
    if functions is not None and step is not None:  # which goes, and its machine code with it, when its name does
        code, retraction = step.address, address(functions.retract, RETRACTION)
        u = np.concatenate([*parts, np.empty((count, 0))], axis=1)
        _follow(code, retraction, u, lengths[0], substeps, np.empty(group.dim), states)
        return states
    for n, length in enumerate(np.broadcast_to(lengths, count)):
        x, held = states[n : n + 1], [part[n : n + 1] for part in parts]
        for _ in range(substeps):
            x = _advance(group, field, tableau, x, held, length)
        states[n + 1] = x[0]
    return states


def require_substeps(who: str, count: object) -> None:
    """Refuse a number of substeps that is not whole, or below one."""
    if not isinstance(count, int | np.integer) or count < 1:
        raise ModelError(f"{who} takes a whole number of substeps, 1 or more; found {count!r}")


def _stepping(
    group: LieGroup, field: Field, tableau: Tableau, start: Array, inputs: Sequence[Array], h: float
) -> DerivedKernel | None:
    """An explicit step as a kernel; None where its field cannot be traced."""
    step = partial(travel, group, field, tableau.numbers)
    first = [start[None], *(part[:1] for part in inputs), np.array([h])]
    reach = captured_by(step)
    if reach.refusal:
        return None
    try:
        kernel = derived(step, [Each(part.shape[1:]) for part in first], reach, name=tableau.name)
    except TraceError:
        return None
    if kernel.expression.required:  # which nothing would test
        return None
    if not np.allclose(kernel(*first), travel(group, field, tableau.numbers, *first), rtol=1e-9, atol=1e-12):
        return None
    return kernel


@compiled
def _follow(where: int, retraction: int, u: Array, h: float, substeps: int, moves: Array, states: Array) -> None:
    """Take explicit steps, several for every row of the inputs."""
    storage, inputs = states.shape[1], u.shape[1]
    p, nothing, empty = np.empty(storage + inputs + 1), np.empty(0), np.empty((0, 0))
    p[storage + inputs] = h
    p[:storage] = states[0]
    x = vector(p, 0, storage)
    for n in range(len(u)):
        p[storage : storage + inputs] = u[n]
        for _ in range(substeps):
            call_residual(where, nothing, p, nothing, moves, empty)
            call_retraction(retraction, x, moves, x)
        states[n + 1] = x


def _advance(group: LieGroup, field: Field, tableau: Tableau, x: Array, inputs: Sequence[Array], h: ArrayLike) -> Array:
    """Solve for the end of the step."""
    count = max(len(part) for part in (x, *inputs))
    x = np.array(np.broadcast_to(x, (count, x.shape[1])), dtype=np.float64)
    if tableau.explicit:
        return group.retract(x, travel(group, field, tableau.numbers, x, *inputs, h))

    def defect(end: Array) -> Array:
        return step_defect(group, field, tableau.numbers, x, *inputs, end, h)

    after, value = x, defect(x)
    for _ in range(NEWTON_STEPS):
        move = np.linalg.solve(jacobian(defect, [after], [group])[0], value[:, :, None])[:, :, 0]
        after = group.retract(after, -move)
        value = defect(after)
        if np.abs(move).max() <= ENOUGH * (1.0 + np.abs(x).max()):
            return after
    raise UnifgError(
        f"{tableau.name}: Newton's method found no end of a step of {np.max(h):g} s, the defect is "
        f"{np.abs(value).max():.1e}; take shorter steps"
    )


# ---------------------------------------------------------------- the unicycle


def unicycle_field(x: Array, u: Array) -> Array:
    """F of a unicycle on SE(2), (n, 3): (v, 0, omega) for controls (n, 2) [m/s, rad/s], whatever the pose."""
    return np.stack([u[:, 0], 0.0 * u[:, 0], u[:, 1]], axis=1)
