"""A prepared graph as a layer: a function of data, solved for many instances at once, and the pull-back of slopes.

`unifg.torch` and `unifg.jax` make layers of their frameworks of it. Values of variables and elements are arrays as they
are stored, so slopes are taken to tangent coordinates and back by the Jacobian of t -> x Exp(t) at 0. A slope along
what leaves a manifold, as the length of a quaternion, is zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Literal, NamedTuple

import numpy as np

from unifg.errors import GraphError
from unifg.lie import Manifold, Rn
from unifg.modeling.duplicates import doubles
from unifg.modeling.variables import Data, Family
from unifg.problem.parameters import datum
from unifg.solution.batch import Batch
from unifg.solution.solution import AnyGuess
from unifg.solution.solver import Prepared
from unifg.typing import Array, Numbers

__all__ = ["Layer"]

STEP = 1e-3  # of the differences of x Exp(t), whose error is of its fourth power
TURN = 2.0 * np.pi


class Answers(NamedTuple):
    """Answers of a layer.

    Attributes:
        values: (..., n, storage) of each output.
        batch: what was solved.
        shapes: of the inputs.
    """

    values: list[Array]
    batch: Batch
    shapes: tuple[tuple[int, ...], ...]


class Layer:
    """A function from data to values of families, with derivatives.

    Attributes:
        inputs: data that vary; all others keep the values they have.
        outputs: families that are returned.
    """

    def __init__(
        self,
        prepared: Prepared,
        inputs: Sequence[Data],
        outputs: Sequence[Family],
        guess: AnyGuess,
        *,
        threads: int = 1,
        failed: Literal["raise", "zero"] = "raise",
    ) -> None:
        """State what goes in and what comes out.

        Args:
            prepared: of any backend; a tolerance of 1e-9 lets derivatives be right near changes of the active set.
            inputs: data of the graph.
            outputs: families of the graph.
            guess: of every solve.
            threads: that solve instances at once.
            failed: whether an instance that does not converge raises, or is returned with slopes of zero.

        Raises:
            GraphError: an input has no derivative, or something is of another kind.
        """
        for what, given, kind in (("inputs", inputs, Data), ("outputs", outputs, Family)):
            if not (isinstance(given, Sequence) and all(isinstance(one, kind) for one in given)):
                raise GraphError(
                    f"layer: {what} are a list of objects of the class {kind.__name__}, found {given!r}"[:200]
                )
            if twice := [one for k, one in enumerate(given) if one in given[:k]]:
                raise GraphError(f"layer: {twice[0]!r} is among the {what} twice, whose slopes would not be its own")
        if failed not in ("raise", "zero"):
            raise GraphError(f"layer: failed must be 'raise' or 'zero', found {failed!r}")
        self.inputs, self.outputs = tuple(inputs), tuple(outputs)
        self._prepared, self._guess, self._threads, self._failed = prepared, guess, threads, failed
        self._manifolds = [datum(prepared.program, handle).manifold for handle in inputs]

    @property
    def others(self) -> list[Array]:
        """Values that all other data have now."""
        return [handle.value for handle in self._prepared.program.binding.present if handle not in self.inputs]

    def solve(self, *given: Numbers) -> Answers:
        """Solve for data, one instance or several.

        Args:
            given: of each input, its shape, or (..., shape) for several instances.

        Raises:
            GraphError: shapes do not fit; an instance does not converge.
        """
        arrays = [doubles(f"layer: data '{h.name}'", one) for one, h in zip(given, self.inputs, strict=False)]
        lead, wanted = self.together([np.shape(one) for one in given])
        data = {
            handle: np.broadcast_to(array, shape).reshape(-1, *handle.value.shape)
            for array, handle, shape in zip(arrays, self.inputs, wanted, strict=True)
        }
        batch = self._prepared.solve_many(self._guess, data=data, threads=self._threads)
        for index, status in enumerate(batch.statuses):
            if not status.converged and self._failed == "raise":
                raise GraphError(
                    f"layer: instance {index} ended {status.name}, and has no derivative; failed='zero' goes on"
                )
        values = [batch[family].reshape(*lead, family.count, family.manifold.storage) for family in self.outputs]
        return Answers(values, batch, tuple(array.shape for array in arrays))

    def together(self, shapes: Sequence[tuple[int, ...]]) -> tuple[tuple[int, ...], list[tuple[int, ...]]]:
        """Axes of the instances that inputs of such shapes make together, and the shape of each with all of them.

        Raises:
            GraphError: shapes do not fit.
        """
        if len(shapes) != len(self.inputs):
            raise GraphError(f"layer: takes {len(self.inputs)} inputs, found {len(shapes)}")
        own = [handle.value.shape for handle in self.inputs]
        leads = [shape[: max(0, len(shape) - len(last))] for shape, last in zip(shapes, own, strict=True)]
        lead = max(leads, key=len, default=())
        with suppress(ValueError):
            lead = np.broadcast_shapes(*leads)
        wanted = [lead + last for last in own]
        for handle, shape, whole in zip(self.inputs, shapes, wanted, strict=True):
            if any(size not in (1, full) for size, full in zip(shape[::-1], whole[::-1], strict=False)):
                raise GraphError(
                    f"layer: data '{handle.name}' have shape {shape}, expected {handle.value.shape}, with {lead} in "
                    "front for several instances"
                )
        return lead, wanted

    def pull(self, answers: Answers, slopes: Sequence[Array]) -> list[Array]:
        """Slopes in the shapes of the inputs, from slopes in those of the outputs; the sums where instances share one.

        Raises:
            GraphError: shapes do not fit; and as of `unifg.Solution.gradient`.
        """
        batch, given = answers.batch, [doubles("layer: a slope", slope) for slope in slopes]
        found, wanted = ([array.shape for array in arrays] for arrays in (given, answers.values))
        if found != wanted:
            raise GraphError(f"layer: slopes have the shapes {found}, expected those of the outputs, {wanted}")
        given = [slope.reshape(len(batch), *slope.shape[-2:]) for slope in given]
        pulled = [np.zeros((len(batch), *handle.value.shape)) for handle in self.inputs]
        for index in range(len(batch)):
            if not batch.statuses[index].converged:
                continue
            solution, data = batch.solution(index), batch.data_of(index)
            weights = {
                family: _tangent(family.manifold, solution[family], slope[index])
                for family, slope in zip(self.outputs, given, strict=True)
            }
            for handle, manifold, out in zip(self.inputs, self._manifolds, pulled, strict=True):
                gradient = solution.gradient(weights, handle)
                out[index] = gradient if manifold is None else _stored(manifold, data[handle], gradient)
        lead = answers.values[0].shape[:-2]
        many = [p.reshape(lead + handle.value.shape) for p, handle in zip(pulled, self.inputs, strict=True)]
        return [_folded(p, shape) for p, shape in zip(many, answers.shapes, strict=True)]


def _folded(array: Array, shape: tuple[int, ...]) -> Array:
    """Sums over what a shape was repeated along."""
    total = array.sum(axis=tuple(range(array.ndim - len(shape))))
    once = tuple(k for k, size in enumerate(shape) if size == 1)
    return np.asarray(total.sum(axis=once, keepdims=True))


def _tangent(manifold: Manifold, points: Array, slopes: Array) -> Array:
    """(n, d) slopes along tangent coordinates, from (n, storage) slopes."""
    if isinstance(manifold, Rn):
        return slopes
    return np.asarray(np.einsum("nsd,ns->nd", _frames(manifold, points), slopes))


def _stored(manifold: Manifold, points: Array, slopes: Array) -> Array:
    """Slopes by stored numbers, in the shape of the points, from (..., d) slopes along tangent coordinates."""
    flat = points.reshape(-1, manifold.storage)
    back = np.linalg.pinv(_frames(manifold, flat))
    return np.asarray(np.einsum("nds,nd->ns", back, slopes.reshape(len(flat), -1)).reshape(points.shape))


def _frames(manifold: Manifold, points: Array) -> Array:
    """(n, storage, d) Jacobians of t -> x Exp(t) at 0; where a stored angle wraps around, it does not jump."""
    frames = np.empty((*points.shape, manifold.dim))
    for k in range(manifold.dim):
        step = np.zeros((len(points), manifold.dim))
        step[:, k] = STEP
        near, far = (
            np.asarray(manifold.retract(points, times * step)) - np.asarray(manifold.retract(points, -times * step))
            for times in (1.0, 2.0)
        )
        frames[:, :, k] = (8.0 * (near - TURN * np.round(near / TURN)) - (far - TURN * np.round(far / TURN))) / (
            12.0 * STEP
        )
    return frames
