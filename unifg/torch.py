"""A prepared graph as a PyTorch module; of the extra ``torch``.

layer = unifg.torch.Layer(run, [weight], [x], guess)
loss = (layer(numbers) - wanted).square().sum()
loss.backward()
"""

from __future__ import annotations

from typing import Any

import torch

from unifg.layers import Layer as Function

__all__ = ["Layer"]


class _Solve(torch.autograd.Function):  # type: ignore[misc]
    """Solve forward, take slopes back by the implicit function theorem."""

    @staticmethod
    def forward(ctx: Any, layer: Function, *given: Any) -> tuple[Any, ...]:
        ctx.answers = layer.solve(*(tensor.detach().cpu().numpy() for tensor in given))
        ctx.layer, ctx.given = layer, given
        return tuple(torch.as_tensor(array).to(given[0]) for array in ctx.answers.values)

    @staticmethod
    def backward(ctx: Any, *slopes: Any) -> tuple[Any, ...]:
        found = ctx.layer.pull(ctx.answers, [slope.detach().cpu().numpy() for slope in slopes])
        return None, *(torch.as_tensor(slope).to(g) for slope, g in zip(found, ctx.given, strict=True))


class Layer(torch.nn.Module, Function):  # type: ignore[misc]
    """A module from data to values of families; arguments as of `unifg.layers.Layer`.

    Tensors have the shapes of the data, or (..., shape) for several instances. The result is the tensor of the output,
    a tuple of several, with the type and on the device of the first input.
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
        found = _Solve.apply(self, *given)
        return found if len(found) > 1 else found[0]
