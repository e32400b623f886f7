"""Axioms of a manifold, tested at random points, near the edges, with short and long steps.

Sola et al., "A micro Lie theory", arXiv:1812.01537, states what is asked of groups; equation numbers are its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from unifg.errors import UnifgError
from unifg.lie.elementwise import LAYOUTS, stated_in
from unifg.lie.functions import functions_of
from unifg.lie.manifold import LieGroup, Manifold
from unifg.typing import Array

ALGEBRA = 1e-9  # of what holds but for rounding, over the largest number that takes part
SLOPES = 1e-6  # of what is differenced
STEP = 1e-5  # of central differences
LENGTHS = (1e-9, 1e-4, 0.3, 1.0)  # of steps, beside those of the reach and none


@dataclass(frozen=True)
class Breach:
    """An axiom that does not hold.

    Attributes:
        axiom: as a sentence or a formula.
        error: largest entry of the difference of both sides, over the largest entry of them (at least 1); NaN where a
            side is not finite, or could not be found.
        allowed: error that rounding, or differencing, explains.
        where: the points and steps at which it is largest, by name.
        note: what a method raised, if it did.
    """

    axiom: str
    error: float
    allowed: float
    where: dict[str, Array]
    note: str = ""

    def __str__(self) -> str:
        """Name the axiom, by how much it is missed, and where."""
        with np.printoptions(precision=6, suppress=False, threshold=20):
            places = "".join(f"\n    {name} = {value}" for name, value in self.where.items())
        missed = self.note or f"off by {self.error:.3g}, allowed {self.allowed:.1g}"
        return f"{self.axiom}: {missed}{places}"


@dataclass(frozen=True)
class Axioms:
    """Result of :func:`check_manifold`.

    Attributes:
        name: of the manifold.
        tried: names of the axioms that were tried.
        breaches: those that do not hold.
    """

    name: str
    tried: tuple[str, ...]
    breaches: tuple[Breach, ...]

    @property
    def ok(self) -> bool:
        """True if all hold."""
        return not self.breaches

    def require(self) -> None:
        """Do nothing if all hold.

        Raises:
            UnifgError: the report, when one does not.
        """
        if not self.ok:
            raise UnifgError(str(self))

    def __str__(self) -> str:
        """One line, and the breaches below it."""
        if self.ok:
            return f"{self.name}: {len(self.tried)} axioms hold"
        head = f"{self.name}: {len(self.breaches)} of {len(self.tried)} axioms do not hold"
        return "\n".join([head, *(f"- {breach}" for breach in self.breaches)])


class _Claim(NamedTuple):
    """Two sides that should agree, row by row."""

    axiom: str
    where: dict[str, Array]
    sides: Callable[[], tuple[Array, Array]]
    points: bool = False  # of the manifold, which it may store in several ways; else numbers
    allowed: float = ALGEBRA


def check_manifold(manifold: Manifold, *, reach: float = 3.0, count: int = 8, seed: int = 0) -> Axioms:
    """Try the axioms of a manifold, and of a group those of groups, where they are most easily broken.

    Points are random, the identity, and what long and tiny steps lead to; steps have lengths from 1e-9 to ``reach``.
    Of a group that states them, adjoint, Jacobians, matrices and actions are tried too; of compiled functions, whether
    they agree with the batched methods, leave their arguments alone, and may write a result over an argument.

    Args:
        manifold: as a variable takes it.
        reach: longest step that ``local`` has to find again, in the units of the tangent; pi or less for rotations.
        count: points of each sort.
        seed: of the random numbers.

    Returns:
        A report: ``print`` it, ask ``.ok``, or let ``.require()`` raise.
    """
    breaches: list[Breach] = []
    tried: list[str] = []
    with np.errstate(all="ignore"):
        try:
            claims = list(_claims(manifold, reach, count, np.random.default_rng(seed)))
        except Exception as error:  # whatever a user's method raises is what there is to report
            note = f"raises {type(error).__name__}: {error}"
            raised = Breach("identity, random and retract can be called", np.nan, 0.0, {}, note)
            return Axioms(manifold.name, ("identity, random and retract",), (raised,))
        for claim in claims:
            tried.append(claim.axiom)
            breach = _try(manifold, claim)
            if breach is not None and breach.axiom not in (known.axiom for known in breaches):
                breaches.append(breach)
    return Axioms(manifold.name, tuple(dict.fromkeys(tried)), tuple(breaches))


def _try(manifold: Manifold, claim: _Claim) -> Breach | None:
    """Compare both sides."""
    try:
        left, right = (np.asarray(side, dtype=np.float64) for side in claim.sides())
        if left.shape != right.shape:
            return Breach(claim.axiom, np.nan, claim.allowed, {}, f"has shape {left.shape}, expected {right.shape}")
        errors = _errors(left, right)
        if claim.points:  # one point may be stored in several ways: then no step leads from one to the other
            step = np.asarray(manifold.local(left, right), dtype=np.float64)
            errors = np.fmin(errors, _errors(step, np.zeros_like(step)) / np.maximum(1.0, np.abs(left).max(axis=-1)))
    except Exception as error:
        return Breach(claim.axiom, np.nan, claim.allowed, {}, f"raises {type(error).__name__}: {error}")
    if not len(errors) or bool((errors <= claim.allowed).all()):
        return None
    worst = int(np.argmax(np.where(np.isfinite(errors), errors, np.inf)))
    where = {name: values[worst] for name, values in claim.where.items()}
    return Breach(claim.axiom, float(errors[worst]), claim.allowed, where)


def _errors(left: Array, right: Array) -> Array:
    """(n,) largest differences of rows, over their largest entries."""
    rows = (len(left), -1) if left.size else (len(left), 0)
    left, right = left.reshape(rows), right.reshape(rows)
    scale = np.maximum(1.0, np.maximum(np.abs(left).max(axis=1, initial=0.0), np.abs(right).max(axis=1, initial=0.0)))
    result: Array = np.abs(left - right).max(axis=1, initial=0.0) / scale
    return result


def _claims(manifold: Manifold, reach: float, count: int, rng: np.random.Generator) -> Iterator[_Claim]:
    """Everything that is asked."""
    m, dim = manifold, manifold.dim
    base = np.concatenate([m.random(rng, (count,)), np.tile(m.identity(), (count, 1))])
    directions = rng.standard_normal((len(base), dim))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    lengths = np.resize([reach, 1e-9, reach / 3.0], len(base))[:, None]
    x = np.concatenate([base, m.retract(base, lengths * directions)])
    y, z = x[rng.permutation(len(x))], x[rng.permutation(len(x))]
    units = rng.standard_normal((len(x), dim))
    units /= np.linalg.norm(units, axis=1, keepdims=True)
    d = np.resize([*LENGTHS, reach], len(x))[:, None] * units
    rows = np.ones(len(x))

    yield _Claim(
        "identity and random are valid points", {"x": x}, lambda: (np.asarray(m.is_valid(base)), base[:, 0] ** 0)
    )
    yield _Claim("x [+] d is a valid point", {"x": x, "d": d}, lambda: (np.asarray(m.is_valid(m.retract(x, d))), rows))
    yield _Claim("x [+] 0 = x", {"x": x}, lambda: (m.retract(x, 0.0 * d), x), True)
    yield _Claim("local(x, x) = 0", {"x": x}, lambda: (m.local(x, x), 0.0 * d))
    yield _Claim("local(x, x [+] d) = d", {"x": x, "d": d}, lambda: (m.local(x, m.retract(x, d)), d))
    yield _Claim("x [+] local(x, y) = y", {"x": x, "y": y}, lambda: (m.retract(x, m.local(x, y)), y), True)
    yield _Claim("x [+] d is smooth in d", {"x": x, "d": d}, lambda: _slopes_of_two_steps(m, x, d, units), False, 1e-4)
    yield _Claim(
        "methods take any leading axes",
        {},
        lambda: (
            m.retract(np.stack([x, y]), np.stack([d, units])).reshape(-1, m.storage),
            np.concatenate([m.retract(x, d), m.retract(y, units)]),
        ),
        False,
        1e-14,
    )
    if isinstance(m, LieGroup):
        yield from _group_claims(m, x, y, z, d, units)
    yield from _compiled_claims(m, x, y, d, units)


def _slopes_of_two_steps(m: Manifold, x: Array, d: Array, units: Array) -> tuple[Array, Array]:
    """Differences of stored numbers over a step and half of it, where no number jumps."""

    def slope(h: float) -> Array:
        return (m.retract(x, d + h * units) - m.retract(x, d - h * units)) / (2.0 * h)

    first, second = slope(1e-4), slope(5e-5)
    jumps = np.maximum(np.abs(first), np.abs(second)).max(axis=1, keepdims=True) > 1e3 * np.maximum(
        1.0, np.abs(x).max()
    )
    return np.where(jumps, 0.0, first), np.where(jumps, 0.0, second)


def _group_claims(g: LieGroup, x: Array, y: Array, z: Array, d: Array, units: Array) -> Iterator[_Claim]:
    """The axioms of groups."""
    from scipy.linalg import expm  # slow to load

    e = np.broadcast_to(g.identity(), x.shape)
    one, eye = np.broadcast_to(np.eye(g.dim), (len(x), g.dim, g.dim)), np.eye(g.dim)
    xy, xd = {"x": x, "y": y}, {"x": x, "d": d}
    product, inverse = g.compose(x, y), g.inverse(x)
    yield _Claim("e x = x", {"x": x}, lambda: (g.compose(e, x), x), True)
    yield _Claim("x e = x", {"x": x}, lambda: (g.compose(x, e), x), True)
    yield _Claim("x x^-1 = e", {"x": x}, lambda: (g.compose(x, inverse), e), True)
    yield _Claim("x^-1 x = e", {"x": x}, lambda: (g.compose(inverse, x), e), True)
    yield _Claim("x y is a valid element", xy, lambda: (np.asarray(g.is_valid(product)), np.ones(len(x))))
    yield _Claim(
        "(x y) z = x (y z)", xy | {"z": z}, lambda: (g.compose(product, z), g.compose(x, g.compose(y, z))), True
    )
    yield _Claim("between(x, y) = x^-1 y", xy, lambda: (g.between(x, y), g.compose(inverse, y)), True)
    yield _Claim("Exp(d) is a valid element", {"d": d}, lambda: (np.asarray(g.is_valid(g.exp(d))), np.ones(len(x))))
    yield _Claim("Exp(0) = e", {}, lambda: (g.exp(0.0 * d), e), True)
    yield _Claim("Log(Exp(d)) = d", {"d": d}, lambda: (g.log(g.exp(d)), d))
    yield _Claim("Exp(Log(x)) = x", {"x": x}, lambda: (g.exp(g.log(x)), x), True)
    yield _Claim(
        "Exp(d) = Exp(0.3 d) Exp(0.7 d)", {"d": d}, lambda: (g.exp(d), g.compose(g.exp(0.3 * d), g.exp(0.7 * d))), True
    )
    if stated_in(type(g), "retract") is stated_in(type(g), "exp"):
        yield _Claim("x [+] d = x Exp(d)", xd, lambda: (g.retract(x, d), g.compose(x, g.exp(d))), True)
    if stated_in(type(g), "local") is stated_in(type(g), "log"):
        yield _Claim(
            "local(x, y) = Log(x^-1 y)",
            xy,
            lambda: (g.retract(x, g.local(x, y)), g.compose(x, g.exp(g.log(g.between(x, y))))),
            True,
        )

    def slopes(of: Callable[[Array], Array]) -> Array:
        """(n, k, dim) of a function of steps (n, dim)."""
        return np.stack([(of(STEP * axis) - of(-STEP * axis)) / (2.0 * STEP) for axis in eye], axis=-1)

    yield _Claim(
        "x [+] d = x Exp(d) to first order",
        {"x": x},
        lambda: (slopes(lambda s: g.log(g.between(x, g.retract(x, 0.0 * d + s)))), one),
        False,
        SLOPES,
    )
    short = d * np.minimum(1.0, 2.0 / np.linalg.norm(d, axis=1, keepdims=True))  # clear of the edges of Log
    half = 0.5 * units
    yield _Claim(
        "x Exp(d) x^-1 = Exp(Ad(x) d)",
        {"x": x, "d": half},
        lambda: (_times(g.adjoint(x), half), g.log(g.compose(g.compose(x, g.exp(half)), inverse))),
    )
    yield _Claim("Ad(x y) = Ad(x) Ad(y)", xy, lambda: (g.adjoint(product), g.adjoint(x) @ g.adjoint(y)))
    yield _Claim(
        "Ad(Exp(d)) = expm(ad(d))", {"d": short}, lambda: (g.adjoint(g.exp(short)), expm(g.ad(short))), False, 1e-8
    )
    back = g.inverse(g.exp(short))
    yield _Claim(
        "Exp(d + s) = Exp(d) Exp(Jr(d) s) to first order",
        {"d": short},
        lambda: (g.right_jacobian(short), slopes(lambda s: g.log(g.compose(back, g.exp(short + s))))),
        False,
        SLOPES,
    )
    yield _Claim(
        "Exp(d + s) = Exp(Jl(d) s) Exp(d) to first order",
        {"d": short},
        lambda: (g.left_jacobian(short), slopes(lambda s: g.log(g.compose(g.exp(short + s), back)))),
        False,
        SLOPES,
    )
    yield _Claim(
        "Jr^-1(d) Jr(d) = I", {"d": short}, lambda: (g.right_jacobian_inverse(short) @ g.right_jacobian(short), one)
    )
    yield _Claim(
        "Jl^-1(d) Jl(d) = I", {"d": short}, lambda: (g.left_jacobian_inverse(short) @ g.left_jacobian(short), one)
    )
    if g.matrix_dim:
        yield _Claim("matrix(x y) = matrix(x) matrix(y)", xy, lambda: (g.matrix(product), g.matrix(x) @ g.matrix(y)))
        yield _Claim(
            "matrix(Exp(d)) = expm(hat(d))",
            {"d": short},
            lambda: (g.matrix(g.exp(short)), expm(g.hat(short))),
            False,
            1e-8,
        )
    if g.point_dim:
        p = np.resize(units, (len(x), g.point_dim))
        yield _Claim("(x y) p = x (y p)", xy | {"p": p}, lambda: (g.act(product, p), g.act(x, g.act(y, p))))


def _compiled_claims(m: Manifold, x: Array, y: Array, d: Array, units: Array) -> Iterator[_Claim]:
    """Axioms of functions of one element."""
    functions = functions_of(m)
    for name, (given, result) in LAYOUTS.items():
        function = getattr(functions, name, None)
        if function is None or not all(getattr(m, size, 0) for size in (*given, *result)):
            continue
        offered: dict[str, Sequence[Array]] = {
            "storage": (x, y),
            "dim": (d, units),
            "point_dim": (np.resize(units, (len(x), getattr(m, "point_dim", 0))),),
        }
        places = [given[:k].count(size) for k, size in enumerate(given)]
        arguments = [np.ascontiguousarray(offered[size][place]) for size, place in zip(given, places, strict=True)]
        where = dict(zip("ab", arguments, strict=False))
        run = _Alone(function, getattr(m, name), arguments, tuple(getattr(m, size) for size in result))
        yield _Claim(f"the compiled {name} agrees with the batched one", where, run.beside, False, 1e-12)
        yield _Claim(f"the compiled {name} leaves its arguments as they are", where, run.untouched, False, 0.0)
        for place, size in enumerate(given):
            if (size,) == result:
                written = partial(run.over, place)
                yield _Claim(f"the compiled {name} may write over argument {place}", where, written, False, 0.0)


class _Alone:
    """A compiled function, run for one element after the other."""

    def __init__(
        self,
        function: Callable[..., None],
        batched: Callable[..., Array],
        arguments: list[Array],
        shape: tuple[int, ...],
    ) -> None:
        self.function, self.batched, self.arguments, self.shape = function, batched, arguments, shape

    def __call__(self) -> Array:
        out = np.full((len(self.arguments[0]), *self.shape), np.nan)
        for k, row in enumerate(out):
            self.function(*(argument[k].copy() for argument in self.arguments), row)
        return out

    def beside(self) -> tuple[Array, Array]:
        return self(), self.batched(*self.arguments)

    def untouched(self) -> tuple[Array, Array]:
        copies = [argument.copy() for argument in self.arguments]
        for k in range(len(copies[0])):
            self.function(*(copy[k] for copy in copies), np.empty(self.shape))
        return np.concatenate(copies, axis=1), np.concatenate(self.arguments, axis=1)

    def over(self, place: int) -> tuple[Array, Array]:
        copies = [argument.copy() for argument in self.arguments]
        for k in range(len(copies[0])):
            self.function(*(copy[k] for copy in copies), copies[place][k])
        return copies[place], self()


def _times(matrices: Array, vectors: Array) -> Array:
    """Matrix times vector, row by row."""
    return (matrices @ vectors[..., None])[..., 0]
