"""A prepared graph as a PyTorch module; of the extra ``torch``.

layer = unifg.torch.Layer(run, [weight], [x], guess)
loss = (layer(numbers) - wanted).square().sum()
loss.backward()
"""

from __future__ import annotations

from typing import Any

import torch

from unifg.errors import GraphError
from unifg.layers import Layer as Function

__all__ = ["Layer"]


class _Solve(torch.autograd.Function):  # type: ignore[misc]
    """Solve forward, take slopes back by the implicit function theorem."""

    @staticmethod
    def forward(ctx: Any, layer: Function, *given: Any) -> tuple[Any, ...]:
        ctx.answers = layer.solve(*((one.double() if one.is_floating_point() else one).cpu().numpy() for one in given))
        ctx.layer, ctx.given = layer, given
        return tuple(torch.as_tensor(array).to(given[0]) for array in ctx.answers.values)

    @staticmethod
    def backward(ctx: Any, *slopes: Any) -> tuple[Any, ...]:
        found = ctx.layer.pull(ctx.answers, [slope.detach().double().cpu().numpy() for slope in slopes])
        return None, *(_Once.apply(torch.as_tensor(f).to(g), *ctx.given) for f, g in zip(found, ctx.given, strict=True))


class _Once(torch.autograd.Function):  # type: ignore[misc]
    """A slope as it is: without this, a second derivative would silently lack the share of the answers."""

    @staticmethod
    def forward(ctx: Any, slope: Any, *given: Any) -> Any:
        return slope.view_as(slope)

    @staticmethod
    def backward(ctx: Any, *slopes: Any) -> tuple[Any, ...]:
        raise GraphError("layer: has first derivatives only, and a second one was asked for")


class Layer(torch.nn.Module, Function):  # type: ignore[misc]
    """A module from data to values of families; arguments as of `unifg.layers.Layer`.

    Tensors have the shapes of the data, or (..., shape) for several instances. The result is the tensor of the output,
    a tuple of several, with the type and on the device of the first input. Whole numbers and what is no tensor count as
    tensors of 64-bit numbers. Slopes have no derivatives of their own: a second derivative raises.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        """State what goes in and what comes out."""
        torch.nn.Module.__init__(self)
        Function.__init__(self, *args, **options)

    def forward(self, *given: Any) -> Any:
        """Values of the outputs.

        Raises:
            GraphError: shapes do not fit; an instance does not converge.
        """
        kept = (torch.is_tensor(one) and (one.is_floating_point() or one.is_complex()) for one in given)
        tensors = [x if k else torch.as_tensor(x, dtype=torch.float64) for x, k in zip(given, kept, strict=True)]
        found = _Solve.apply(self, *tensors)
        return found if len(found) > 1 else found[0]
