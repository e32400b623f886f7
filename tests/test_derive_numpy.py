"""NumPy functions, traced: values to the last digits, first and second derivatives by differences of the first."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import unifg as fg
from test_derive import compared_with_differences, curved, differences, evaluated
from unifg.factors.autodiff.rows import traced
from unifg.factors.autodiff.symbols import TraceError
from unifg.lie import Rn
from unifg.typing import Array

Function = Callable[..., Any]


def inplace1(x: Array, y: Array) -> Any:
    r = x.copy()
    r += 2.0 * np.sin(r)
    r[:, 1:] *= y
    r[:, 0] -= 1
    r /= 2
    r **= 2
    return r


def inplace2(x: Array, y: Array) -> Any:
    r = np.zeros((len(x), 5))
    r[:, :2] = x[:, :2]
    r[:, [2, 4]] = y[:, :2]
    r[:, 3] = 1.0
    r[:, np.array([True, False, False, False, True])] *= x[:, 2:]
    return r


def inplace3(x: Array, y: Array) -> Any:
    r = np.empty((x.shape[0], 2, 2))
    r[:, 0, 0] = np.cos(x[:, 0])
    r[:, 0, 1] = -np.sin(x[:, 0])
    r[:, 1, 0] = -r[:, 0, 1]
    r[:, 1, 1] = r[:, 0, 0]
    return np.einsum("nij,nj->ni", r, y[:, :2])


def floatfill(x: Array, y: Array) -> Any:
    R = np.zeros((3, 3))
    R[0, 1] = 2.0
    R = R + np.eye(3)
    return x[:, :3] @ R.T


def ones_like(x: Array, y: Array) -> Any:
    z = np.ones_like(x)
    z[:, 0] = y[:, 0]
    return z * x + np.full_like(x, 2.0) + np.zeros_like(y[:, :1])


def outsin(x: Array, y: Array) -> Any:
    r = np.empty_like(x)
    np.sin(x, out=r)
    np.multiply(r, 2.0, out=r)
    return r


def listcomp(x: Array, y: Array) -> Any:
    return np.stack([sum(x[:, j] * k for j in range(4)) for k in range(3)], axis=-1)


def pylist(x: Array, y: Array) -> Any:
    return np.array([x[:, 0], y[:, 1]]).T


def helper_loop(x: Array, y: Array) -> Any:
    total: Any = 0.0
    for a, b in zip(x.T, y.T, strict=False):
        total = total + a * b
    return total[:, None]


def rows_iter(x: Array, y: Array) -> Any:
    return np.concatenate([x[:, k : k + 1] * k for k in range(4)], axis=1)


def norm_where(x: Array, y: Array) -> Any:
    th = np.linalg.norm(y, axis=1, keepdims=True)
    return np.where(th < 1e-8, 1 - th**2 / 6, np.sin(th) / th) * y


def block(x: Array, y: Array) -> Any:
    return np.block([[x[:, :2], y], [2 * x[:, :2], y]])[: len(x)]


def tril(x: Array, y: Array) -> Any:
    return np.triu(np.einsum("ni,nj->nij", y, y)).reshape(len(x), 9)


SURFACE: dict[str, Function] = {
    "in place": inplace1,
    "filled by indices": inplace2,
    "matrices filled": inplace3,
    "constants filled": floatfill,
    "like others": ones_like,
    "out=": outsin,
    "list comprehension": listcomp,
    "list of columns": pylist,
    "loop over columns": helper_loop,
    "columns": rows_iter,
    "series or quotient": norm_where,
    "triu": tril,
    "hstack": lambda x, y: np.hstack([x, y]),
    "vstack": lambda x, y: np.vstack([x.T, y.T]).T,
    "dstack": lambda x, y: np.dstack([x[:, :3], y]).reshape(len(x), -1),
    "colstack": lambda x, y: np.column_stack([x[:, 0], y]),
    "append": lambda x, y: np.append(x, y, axis=1),
    "insert": lambda x, y: np.insert(x, 1, 3.0, axis=1),
    "delete": lambda x, y: np.delete(x, 2, axis=1),
    "tile": lambda x, y: np.tile(y, (1, 2)),
    "repeat": lambda x, y: np.repeat(y, 2, axis=1),
    "roll": lambda x, y: np.roll(y, -1, axis=-1),
    "flip": lambda x, y: np.flip(y, 1),
    "fliplr": lambda x, y: np.fliplr(y),
    "swap": lambda x, y: np.swapaxes(x.reshape(-1, 2, 2), 1, 2).reshape(len(x), 4),
    "transpose": lambda x, y: np.transpose(x.reshape(-1, 2, 2), (0, 2, 1)).reshape(-1, 4),
    "moveaxis": lambda x, y: np.moveaxis(x.reshape(-1, 2, 2), 1, 2).reshape(-1, 4),
    "expand": lambda x, y: np.expand_dims(x[:, 0], 1),
    "squeeze": lambda x, y: np.squeeze(x[:, :1], 1)[:, None],
    "newaxis": lambda x, y: x[:, 0][:, np.newaxis],
    "ravel": lambda x, y: x.ravel().reshape(-1, 4),
    "flatten": lambda x, y: x.flatten().reshape(x.shape),
    "split": lambda x, y: np.concatenate(np.split(x, 2, axis=1)[::-1], axis=1),
    "hsplit": lambda x, y: np.hsplit(x, [1])[1],
    "array_split": lambda x, y: np.array_split(x, 3, axis=1)[0],
    "take": lambda x, y: np.take(x, [0, 2], axis=1),
    "atleast2": lambda x, y: np.atleast_2d(x),
    "broadcast": lambda x, y: np.broadcast_to(x[:, :1], (len(x), 3)) * y,
    "barrays": lambda x, y: np.broadcast_arrays(x[:, :1], y)[0],
    "sum": lambda x, y: x.sum(axis=1, keepdims=True),
    "sum2": lambda x, y: np.sum(x, 1)[:, None],
    "mean": lambda x, y: x.mean(axis=1)[:, None],
    "var": lambda x, y: np.var(x, axis=1, keepdims=True),
    "std": lambda x, y: np.std(x, axis=1, keepdims=True),
    "prod": lambda x, y: x.prod(axis=1, keepdims=True),
    "cumsum": lambda x, y: np.cumsum(x, axis=1),
    "cumsum2": lambda x, y: x.cumsum(axis=1),
    "cumprod": lambda x, y: np.cumprod(x, axis=1),
    "diff": lambda x, y: np.diff(x, n=2, axis=1),
    "max": lambda x, y: x.max(axis=1, keepdims=True),
    "amin": lambda x, y: np.amin(x, axis=1, keepdims=True),
    "min": lambda x, y: x.min(1)[:, None],
    "average": lambda x, y: np.average(x, axis=1, weights=[1, 2, 3, 4.0])[:, None],
    "ptp": lambda x, y: np.ptp(x, axis=1)[:, None],
    "dot": lambda x, y: np.dot(x, np.arange(8.0).reshape(4, 2)),
    "dotm": lambda x, y: x.dot(np.arange(8.0).reshape(4, 2)),
    "matmul": lambda x, y: np.matmul(x, np.arange(8.0).reshape(4, 2)),
    "rmat": lambda x, y: (np.arange(8.0).reshape(2, 4) @ x.T).T,
    "matvec": lambda x, y: (np.arange(8.0).reshape(2, 4) @ x[:, :, None])[..., 0],
    "inner": lambda x, y: np.inner(x, np.arange(8.0).reshape(2, 4)),
    "tensordot": lambda x, y: np.tensordot(x, np.arange(8.0).reshape(4, 2), axes=1),
    "kron": lambda x, y: np.kron(y, [1.0, 2.0]),
    "vecdot": lambda x, y: np.vecdot(x[:, :3], y)[:, None],
    "trace": lambda x, y: np.trace(x.reshape(-1, 2, 2), axis1=1, axis2=2)[:, None],
    "diag": lambda x, y: np.diagonal(x.reshape(-1, 2, 2), axis1=1, axis2=2),
    "multi_dot": lambda x, y: np.linalg.multi_dot([x, np.ones((4, 3)), np.ones((3, 2))]),
    "einsum1": lambda x, y: np.einsum("ni,ni->n", y, y)[:, None],
    "einsum2": lambda x, y: np.einsum("...i,ij->...j", x, np.ones((4, 3))),
    "einsum3": lambda x, y: np.einsum("ni,ij,nj->n", y, np.arange(9.0).reshape(3, 3), y)[:, None],
    "einsum_opt": lambda x, y: np.einsum("ni,ij,nj->n", y, np.arange(9.0).reshape(3, 3), y, optimize=True)[:, None],
    "einsum_no": lambda x, y: np.einsum("ij,jk", x, np.ones((4, 2))),
    "norm1": lambda x, y: np.linalg.norm(x, axis=-1)[:, None],
    "norm2": lambda x, y: np.linalg.norm(x, ord=1, axis=1, keepdims=True),
    "norminf": lambda x, y: np.linalg.norm(x, np.inf, axis=1, keepdims=True),
    "vecnorm": lambda x, y: np.linalg.vector_norm(x, axis=1)[:, None],
    "solve": lambda x, y: np.linalg.solve(x.reshape(-1, 2, 2) ** 2 + 3 * np.eye(2), y[:, :2, None])[..., 0],
    "solve3": lambda x, y: np.linalg.solve(np.einsum("ni,nj->nij", y, y) + 2 * np.eye(3), y[..., None])[..., 0],
    "inv": lambda x, y: np.linalg.inv(x.reshape(-1, 2, 2) + 3 * np.eye(2)).reshape(-1, 4),
    "det": lambda x, y: np.linalg.det(x.reshape(-1, 2, 2))[:, None],
    "invc": lambda x, y: x[:, :2] @ np.linalg.inv(np.array([[2.0, 1], [0, 1]])),
    "sinc": lambda x, y: np.sinc(x),
    "logaddexp": lambda x, y: np.logaddexp(x[:, :3], y),
    "logaddexp2": lambda x, y: np.logaddexp2(x[:, :3], y),
    "arccosh": lambda x, y: np.arccosh(2 + x * x),
    "cbrt": lambda x, y: np.cbrt(x),
    "hyp": lambda x, y: np.hypot(x[:, :3], y),
    "exp2": lambda x, y: np.exp2(x),
    "log10": lambda x, y: np.log10(x * x + 1),
    "powsym": lambda x, y: np.abs(x[:, :3]) ** y,
    "pow7": lambda x, y: x**7,
    "pow-3": lambda x, y: x ** (-3),
    "pow1.5": lambda x, y: np.abs(x) ** 1.5,
    "2**": lambda x, y: 2.0**x,
    "npow": lambda x, y: np.power(x, 3),
    "float_power": lambda x, y: np.float_power(x, 3),
    "powint": lambda x, y: x ** np.arange(4),
    "sqrtsq": lambda x, y: np.sqrt(x**2),
    "mod": lambda x, y: x % 0.7,
    "mod2": lambda x, y: np.mod(x + np.pi, 2 * np.pi) - np.pi,
    "fmod": lambda x, y: np.fmod(x, 0.7),
    "floor": lambda x, y: x - np.floor(x),
    "ceil": lambda x, y: x * np.ceil(x),
    "round": lambda x, y: x - np.round(x),
    "around2": lambda x, y: x - np.round(x, 1),
    "trunc": lambda x, y: x * np.trunc(x),
    "fix": lambda x, y: x * np.fix(x),
    "floordiv": lambda x, y: x // 0.3,
    "divmod": lambda x, y: np.divmod(x, 0.3)[1],
    "modf": lambda x, y: np.modf(x)[0],
    "clip3": lambda x, y: x.clip(-0.5, 0.5),
    "clipN": lambda x, y: np.clip(x, None, 0.5),
    "clipmin": lambda x, y: np.clip(x, a_min=-0.2, a_max=None),
    "clipsym": lambda x, y: np.clip(y, -np.abs(x[:, :3]), np.abs(x[:, :3])),
    "maximumc": lambda x, y: np.maximum(x, 0),
    "fmax": lambda x, y: np.fmax(x, 0.1),
    "heavi": lambda x, y: np.heaviside(x, 0.5) * x,
    "signx": lambda x, y: np.sign(x) * x,
    "copysign": lambda x, y: np.copysign(y, x[:, :3]),
    "nan_to_num": lambda x, y: np.nan_to_num(x),
    "where3": lambda x, y: np.where(np.logical_and(x > 0, x < 0.5), x, 0),
    "select": lambda x, y: np.select([x < -0.5, x < 0.5], [x, x * x], 2 * x),
    "piecewise": lambda x, y: np.piecewise(x, [x < 0], [lambda t: -t, lambda t: t * t]),
    "boolmul": lambda x, y: (x > 0) * x,
    "boolarr": lambda x, y: x * (y[:, :1] > 0.1),
    "not": lambda x, y: np.where(~(x > 0), x, 1),
    "any": lambda x, y: np.where(np.any(x > 1, axis=1, keepdims=True), y, 2 * y),
    "all": lambda x, y: np.where((x > -1).all(axis=1)[:, None], y, 2 * y),
    "isfinite": lambda x, y: np.where(np.isfinite(x), x, 0),
    "isclose": lambda x, y: np.where(np.isclose(x, 0), 1, x),
    "isnan": lambda x, y: np.where(np.isnan(x), 0, x),
    "angle": lambda x, y: np.arctan2(np.sin(x), np.cos(x)),
    "real": lambda x, y: np.real(x),
    "realofplain": lambda x, y: np.asarray(x).real * y[:, :1] + np.asarray(x).imag,
    "imag": lambda x, y: x + np.imag(x) + x.imag,
    "polyval": lambda x, y: np.polyval([1, 2, 3.0], x),
    "gradient": lambda x, y: np.gradient(x, axis=1),
    "vander": lambda x, y: np.vander(x[:, 0], 3),
    "pad": lambda x, y: np.pad(y, ((0, 0), (1, 1))),
    "ix": lambda x, y: x[:, [3, 1]],
    "mask": lambda x, y: x[:, np.array([True, False, True, False])],
    "ellipsis": lambda x, y: x[..., 1:],
    "neg": lambda x, y: x[:, ::-1],
    "fancy2": lambda x, y: x[np.arange(len(x)), np.zeros(len(x), int)][:, None],
    "astype": lambda x, y: x.astype(float),
    "asarray": lambda x, y: np.asarray(x, dtype=np.float64) * 2,
    "arraycopy": lambda x, y: np.array(x, copy=True),
    "ascont": lambda x, y: np.ascontiguousarray(x.T).T,
    "float64": lambda x, y: np.float64(2.0) * x,
    "size": lambda x, y: x * x.size / len(x),
    "shape": lambda x, y: np.zeros(x.shape) + x,
    "ndim": lambda x, y: x * np.ndim(x),
    "linspace": lambda x, y: x * np.linspace(0, 1, 4),
    "arange": lambda x, y: x + np.arange(x.shape[1]),
    "concat1": lambda x, y: np.concatenate((x, y), -1),
    "r_": lambda x, y: np.c_[x, y],
    "absin": lambda x, y: abs(x),
    "minb": lambda x, y: np.minimum.reduce(x, axis=1)[:, None],
    "addred": lambda x, y: np.add.reduce(x, axis=1)[:, None],
    "outeru": lambda x, y: np.multiply.outer(x[:, 0], [1.0, 2.0]),
    "square": lambda x, y: np.square(x),
    "crossc": lambda x, y: np.cross(np.array([0, 0, 1.0]), y),
    "cross2": lambda x, y: np.cross(y, x[:, :3], axis=1),
    "roundm": lambda x, y: x.round(),
    "rowsum": lambda x, y: x.sum(-1, keepdims=True),
    "ndimsum": lambda x, y: np.sum(x.reshape(-1, 2, 2), axis=(1, 2))[:, None],
    "einsumlist": lambda x, y: np.einsum("nij,nj->ni", x.reshape(-1, 2, 2), y[:, :2]),
    "triu_indices": lambda x, y: np.einsum("ni,nj->nij", y, y)[:, *np.triu_indices(3)],
    "fsum": lambda x, y: sum([x[:, :1], y[:, :1]]),
    "degrees": lambda x, y: np.degrees(x),
    "trapz_like": lambda x, y: (x[:, 1:] + x[:, :-1]) / 2,
    "matrix_power": lambda x, y: np.linalg.matrix_power(x.reshape(-1, 2, 2), 3).reshape(-1, 4),
    "cholesky": lambda x, y: np.linalg.cholesky(np.einsum("ni,nj->nij", y, y) + np.eye(3)).reshape(-1, 9),
    "T": lambda x, y: (x.T * 2).T,
    "mT": lambda x, y: x.reshape(-1, 2, 2).mT.reshape(-1, 4),
    "stackneg": lambda x, y: np.stack([x[:, :2], y[:, :2]], axis=-1).reshape(-1, 4),
    "nested list": lambda x, y: np.array([[x[:, 0], x[:, 1]], [y[:, 0], y[:, 1]]]).transpose(2, 0, 1).reshape(-1, 4),
    "fullsym": lambda x, y: np.full((len(x), 3), 1.5) * y,
}


OLD = np.lib.NumpyVersion(np.__version__) < "2.0.0"
SINCE_TWO = {"vecdot", "vecnorm", "mT", "isclose"}
"""What NumPy has not had before, or has had as functions that look at the numbers themselves."""


@pytest.mark.product(60)
@pytest.mark.filterwarnings("ignore:numpy.fix is deprecated:DeprecationWarning")
@pytest.mark.parametrize("name", [name for name in SURFACE if not OLD or name not in SINCE_TWO])
def test_what_numpy_offers(name: str) -> None:
    function = SURFACE[name]
    rng = np.random.default_rng(0)
    away = [0.42, 0.47, 0.53, 0.57, 0.63, 0.68, 0.74, 0.77, 0.83, 0.88, 1.07, 1.13, 1.22, 1.28]  # from kinks and jumps
    v = np.stack([rng.permutation(away)[:7] for _ in range(4)]) * rng.choice([-1.0, 1.0], (4, 7))

    def alone(x: Array, y: Array) -> Array:
        with np.errstate(all="ignore"):
            rows = zip(x, y, strict=True)
            return np.stack([np.asarray(function(a[None].copy(), b[None].copy()))[0] for a, b in rows])

    arguments = (Rn(4), Rn(3))
    compared_with_differences(traced(function, arguments, name=name), alone, arguments, [v[:, :4], v[:, 4:]])


# ---------------------------------------------------------------- where functions are not smooth


def at(function: Function, *point: float) -> tuple[Array, Array, Array]:
    """Value, Jacobian and second derivatives at one point."""
    v, nothing = np.array([point]), np.zeros((1, 0))
    expression = traced(function, (Rn(len(point)),))
    r, J = evaluated(expression, v, nothing)
    return r[0], J[0], curved(expression, v, nothing, np.ones_like(r))[0]


@pytest.mark.parametrize(
    ("function", "point", "slope"),
    [
        (lambda x: np.abs(x), (0.0,), [0.0]),
        (lambda x: np.sign(x), (0.0,), [0.0]),
        (lambda x: np.maximum(x[:, :1], x[:, 1:]), (1.0, 1.0), [1.0, 0.0]),  # of equals the first moves
        (lambda x: np.minimum(x[:, :1], x[:, 1:]), (1.0, 1.0), [1.0, 0.0]),
        (lambda x: np.maximum(0.0, x), (0.0,), [0.0]),
        (lambda x: np.maximum(x, 0.0), (0.0,), [1.0]),
        (lambda x: np.clip(x, -1.0, 2.0), (2.0,), [1.0]),
        (lambda x: np.clip(x, -1.0, 2.0), (2.0 + 1e-15,), [0.0]),
        (lambda x: np.max(x, axis=1, keepdims=True), (3.0, 3.0, 3.0), [1.0, 0.0, 0.0]),
        (lambda x: np.where(x > 0.0, x, -3.0 * x), (0.0,), [-3.0]),
        (lambda x: np.floor(x) + np.rint(x), (1.0,), [0.0]),
        (lambda x: x % 1.0, (2.0,), [1.0]),
    ],
)
def test_slopes_at_ties_are_fixed(function: Function, point: tuple[float, ...], slope: list[float]) -> None:
    _, J, S = at(function, *point)
    np.testing.assert_array_equal(J, [slope])
    assert not S.any()


def test_what_is_not_chosen_does_not_spoil_what_is() -> None:
    """The partials of the quotient are 0/0 where the series is chosen."""

    def cardinal(x: Array) -> Any:
        return np.where(np.abs(x) < 1e-4, 1.0 - x * x / 6.0, np.sin(x) / x)

    for r, J, S in (at(cardinal, 0.0), at(lambda x: np.where(x != 0.0, np.sin(x) / x, 1.0 - x * x / 6.0), 0.0)):
        np.testing.assert_array_equal([r[0], J[0, 0]], [1.0, 0.0])
        assert S[0, 0] == pytest.approx(-1.0 / 3.0, abs=1e-15)
    r, J, S = at(lambda x: np.where(x > 0.0, np.sqrt(np.abs(x)), 2.0 * x) + np.where(x > 1.0, np.log(x), 0.0), 0.0)
    np.testing.assert_array_equal([r[0], J[0, 0], S[0, 0]], [0.0, 2.0, 0.0])


@pytest.mark.parametrize("function", [np.maximum, np.minimum, np.fmod, np.hypot])
def test_numbers_that_are_none_stay_so(function: Any) -> None:
    expression = traced(lambda x, f=function: f(x[:, :1], x[:, 1:]), (Rn(2),))
    points = np.array([[np.nan, 1.0], [1.0, np.nan]])
    assert np.isnan(evaluated(expression, points, np.zeros((1, 0)))[0]).all()


# ---------------------------------------------------------------- compiled functions of one factor


@fg.compiled
def rotated(angle: float, x: float, y: float) -> tuple[float, float]:
    c, s = math.cos(angle), math.sin(angle)
    return c * x - s * y, s * x + c * y


@fg.compiled
def chain(q: Array, lengths: Array, gain: float, r: Array) -> None:
    """End of a planar arm, and a penalty; the options of what a compiled function of one factor does."""
    end, angle = np.zeros(2), 0.0
    scratch = np.empty((len(q), 2))
    for k in range(len(q)):
        angle += q[k]
        scratch[k, 0], scratch[k, 1] = rotated(angle, lengths[k], 0.0)
    for k in range(len(q)):
        end[0] += scratch[k, 0]
        end[1] += scratch[k, 1]
    r[0] = math.hypot(end[0], end[1])
    r[1] = math.atan2(end[1], end[0])
    if len(lengths) == 3:
        r[2] = gain * math.fabs(q[1]) + max(q[0], 0.0) * min(q[2], 0.5) - float(len(q)) + math.floor(gain)
        return
    r[2] = math.nan


def test_a_compiled_function_of_one_factor() -> None:
    rng = np.random.default_rng(1)
    q, lengths, gain = rng.normal(size=(5, 3)), np.array([1.0, 0.7, 0.4]), 1.3
    expression = traced(chain, (Rn(3), (3,), ()), rows=3)
    shared = np.ascontiguousarray(np.broadcast_to(np.append(lengths, gain), (5, 4)))
    r, J = evaluated(expression, q, shared)

    def one_by_one(q: Array) -> Array:
        rows = np.empty((5, 3))
        for joints, row in zip(q, rows, strict=True):
            chain(joints, lengths, gain, row)
        return rows

    np.testing.assert_allclose(r, one_by_one(q), rtol=0, atol=1e-15)
    np.testing.assert_allclose(J, differences(one_by_one, (Rn(3),), [q]), rtol=0, atol=1e-9)


# ---------------------------------------------------------------- what cannot be traced is said, with its line


def decides(x: Array) -> Any:
    y = 2.0 * x
    if y[0, 0] > 1.0:
        return y
    return -y


def loops(x: Array) -> Any:
    while np.abs(x).max() > 1.0:
        x = 0.5 * x
    return x


KNOWN = {1.0: 2.0}


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (decides, r"\.py:LINE: asks whether a number holds that is not known yet; write np\.where"),
        (loops, r"\.py:\d+: asks whether"),
        (lambda x: float(x[0, 0]) * x, r"\.py:\d+: turns a number that is not known yet into a float"),
        (lambda x: x * int(x[0, 0]), "into an integer"),
        (lambda x: np.arange(5.0)[x[:, 0].astype(int)][:, None], r"\.py:\d+: IndexError: arrays used as indices"),
        (lambda x: x[:, x[0]], "takes entries by a number that is not known yet"),
        (lambda x: KNOWN[x[0, 0]] * x, "looks up a number that is not known yet in a dictionary"),
        (lambda x: np.linalg.eigh(np.einsum("ni,nj->nij", x, x))[0], r"calls np\.linalg\.eigh; of np\.linalg, norm"),
        (lambda x: np.sort(x, axis=1), r"calls np\.sort, .* write np\.minimum and np\.maximum, or leave it to diff"),
        (lambda x: np.searchsorted([0.0, 1.0], x), r"np\.searchsorted, .* write np\.interp or a spline"),
        (lambda x: Rotation.from_rotvec(x).as_rotvec(), r"test_derive_numpy\.py:\d+: "),
        (lambda x: np.real(np.exp(1j * x)), "makes a complex number"),
        (lambda x: np.add(x, 1.0, where=x > 0.0), r"np\.add with where=; write np\.where"),
        (lambda x: np.where(x > 0.0), "asks np.where for places"),
        (lambda x: np.linalg.inv(np.ones((1, 13, 13)) * x[:, :1, None])[:, 0], "more than 12 rows"),
        (lambda x: x[:, 7:8] * x[:, 9], r"\.py:\d+: IndexError"),
        (lambda x: x[0], r"returns an array of shape \(3,\) for one factor, expected \(1, m\)"),
    ],
)
def test_what_cannot_be_traced_is_said(function: Function, words: str) -> None:
    line = function.__code__.co_firstlineno + 2
    with pytest.raises(TraceError, match=words.replace("LINE", str(line))):
        traced(function, (Rn(3),))


class Gain:
    """A method, and names that only what stands inside a function looks up."""

    def __init__(self, gain: float) -> None:
        self.gain = gain

    def turned(self, x: Array) -> Any:
        def column(k: int) -> Any:
            filled = np.zeros((len(x), 2))
            filled[:, 0] = self.gain * x[:, k]
            return fg.SE2.act(np.array([1.0, 2.0, 0.3]), filled)[:, 1]

        return np.stack([column(k) for k in range(2)] + [fg.SO2.log(x[:, k : k + 1])[:, 0] for k in range(2)], axis=1)


def test_names_inside_functions_inside_methods() -> None:
    function, x = Gain(3.0).turned, np.array([[0.3, -2.0]])
    r, J = evaluated(traced(function, (Rn(2),)), x, np.zeros((1, 0)))
    np.testing.assert_allclose(r, function(x), rtol=0, atol=1e-15)
    slope = 3.0 * math.sin(0.3)
    np.testing.assert_allclose(J, [[[slope, 0.0], [0.0, slope], [1.0, 0.0], [0.0, 1.0]]], rtol=0, atol=1e-15)


def test_functions_without_a_file() -> None:
    names: dict[str, Any] = {"np": np}
    exec("def f(x):\n    return np.sin(x)\ndef g(x):\n    y = x\n    return y if y[0, 0] > 0 else -y", names)

    class Models:
        square = staticmethod(lambda x: x * x)

    x = np.array([[0.3, -2.0]])
    for function in (names["f"], Models.square, eval("lambda x: 3.0 * x", {})):
        r, _ = evaluated(traced(function, (Rn(2),)), x, np.zeros((1, 0)))
        np.testing.assert_allclose(r, function(x), rtol=0, atol=1e-15)
    with pytest.raises(TraceError, match=r"^<string>:5: asks whether"):
        traced(names["g"], (Rn(2),))
