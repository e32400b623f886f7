"""Factors of linear graphs: rows to be met as well as possible or exactly, and quadratic terms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np

from unifg.typing import Array

Kind: TypeAlias = Literal["cost", "constraint", "curvature", "damping", "balance"]


@dataclass(frozen=True, eq=False)
class LinearFactor:
    """Rows sum_v A_v d_v = b: to be met in the sense of least squares, or exactly by a constraint.

    Attributes:
        name: of the factor it was made of.
        kind: "constraint" when the rows must hold.
        blocks: (m, d_v) per variable.
        right: (m,) b.
        size: largest entry of the rows when they were made; what is far below it is rounding.
    """

    name: str
    kind: Kind
    blocks: Mapping[str, Array]
    right: Array
    size: float

    @property
    def variables(self) -> tuple[str, ...]:
        """Names of its variables."""
        return tuple(self.blocks)

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(self.right)

    def residual(self, values: Mapping[str, Array]) -> Array:
        """(m,) A d - b."""
        return sum((block @ values[name] for name, block in self.blocks.items()), -self.right)

    def gradient_at(self, values: Mapping[str, Array]) -> dict[str, Array]:
        """(d_v,) per variable: gradient of 1/2 |A d - b|^2."""
        residual = self.residual(values)
        return {name: block.T @ residual for name, block in self.blocks.items()}

    def __str__(self) -> str:
        """Name, kind and variables."""
        relation = "=" if self.kind == "constraint" else "~"
        return f"{self.name}: {self.kind}, {self.rows} rows: A ({', '.join(self.variables)}) {relation} b"


@dataclass(frozen=True, eq=False)
class QuadraticFactor:
    """1/2 d'Gd + g'd, where G need not be positive: curvature, and costs that are no squares.

    Attributes:
        name: of the factor it was made of.
        kind: what it stands for.
        sizes: d_v per variable, in the order of the rows of G.
        hessian: (D, D) G.
        gradient: (D,) g.
    """

    name: str
    kind: Kind
    sizes: Mapping[str, int]
    hessian: Array
    gradient: Array

    @property
    def variables(self) -> tuple[str, ...]:
        """Names of its variables."""
        return tuple(self.sizes)

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Rows of each variable in G."""
        ends = np.cumsum([0, *self.sizes.values()]).tolist()
        return {name: slice(ends[k], ends[k + 1]) for k, name in enumerate(self.sizes)}

    def gradient_at(self, values: Mapping[str, Array]) -> dict[str, Array]:
        """(d_v,) per variable: G d + g."""
        step = np.concatenate([values[name] for name in self.sizes])
        total = self.hessian @ step + self.gradient
        return {name: total[part] for name, part in self.slices.items()}

    def __str__(self) -> str:
        """Name, kind and variables."""
        return f"{self.name}: {self.kind}, 1/2 d'Gd + g'd over ({', '.join(self.variables)})"


Factor: TypeAlias = LinearFactor | QuadraticFactor
