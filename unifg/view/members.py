"""Members of a family as drawn: positions, orientations, uncertainties."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from unifg.errors import GraphError, ViewError
from unifg.lie import SE2, SE3, Manifold, Product, Rn
from unifg.modeling.variables import Family, Selection
from unifg.plots.shown import carried
from unifg.typing import Array

__all__ = ["Members", "Position", "Values", "finite", "members_of"]

Position: TypeAlias = Callable[[Array], Array]
"""Takes stored values (n, storage), returns (n, 2) or (n, 3) places [m] or (n, 7) poses, quaternion w first."""

Values: TypeAlias = Mapping[Family, Array]


@dataclass(frozen=True)
class Members:
    """Members of a family, or of a part of it, as drawn.

    Attributes:
        selection: of them.
        kind: "plane" for poses (x, y, theta), "space" for poses (position, quaternion w first), "points" for places.
        position: for members that are none of the three.
    """

    selection: Selection
    kind: str
    position: Position | None = None

    @property
    def name(self) -> str:
        """Name of the family, with its component; that of the layer."""
        component = self.selection.component
        return self.selection.family.name + (f".{component}" if component else "")

    @property
    def joined(self) -> bool:
        """True if its members are a way: those of a family of bare points are not."""
        return self.kind != "points" or self.position is not None or bool(self.selection.component)

    def of(self, values: Values) -> Array:
        """(n, storage) values of the members shown.

        Raises:
            GraphError: they are those of another graph.
        """
        family = self.selection.family
        if family not in values:
            raise GraphError(f"family '{family.name}' is not part of this solution", family=family.name)
        return values[family][self.selection.indices][:, self.selection.storage]

    def read(self, values: Array) -> tuple[Array, Array | None]:
        """Places (n, 2) or (n, 3) [m], and poses (n, 3) or (n, 7) of what has an attitude, of values (n, storage).

        Raises:
            ViewError: something is not finite, or the function for positions returns something else.
        """
        finite(self.name, values)
        if self.position is None:
            size = {"plane": 2, "space": 3}.get(self.kind, values.shape[1])
            return values[:, :size], None if self.kind == "points" else values
        given = np.asarray(self.position(values), dtype=np.float64)
        if given.ndim != 2 or len(given) != len(values) or given.shape[1] not in (2, 3, 7):
            raise ViewError(
                f"'{self.name}': position= was given {values.shape} and returned {given.shape}; return "
                f"({len(values)}, 2) or ({len(values)}, 3) places, or ({len(values)}, 7) positions and quaternions"
            )
        finite(self.name, given, "place")
        return (given[:, :3], given) if given.shape[1] == 7 else (given, None)

    def covariances(self, values: Array, marginals: Array) -> Array:
        """Covariances of the places in the world, (n, p, p) [m^2].

        Args:
            values: (n, storage).
            marginals: (n, d, d), in the tangent space.
        """
        if self.position is None and self.kind == "points":
            return marginals
        return carried(self.selection.manifold, values, marginals, lambda members: self.read(members)[0])


def members_of(selection: Selection, position: Position | None) -> Members:
    """Members of a family or a part of it: poses and points as what they are, all else by a function.

    Args:
        selection: the family, some of its members, or a component.
        position: where a member is, for what is neither a pose nor a point.

    Raises:
        ViewError: there is no telling where its members are.
    """
    manifold = selection.manifold
    kind = _kind(manifold)
    if kind is not None or position is not None:
        return Members(selection, kind or "points", position if kind is None else None)
    name, way = Members(selection, "points").name, "give"
    if isinstance(manifold, Product) and selection.component is None:
        parts = [part for part, component in manifold.components.items() if _kind(component.manifold)]
        way = f"name a component ({' or '.join(f'{name}.{part}' for part in parts)}), or give" if parts else "give"
    raise ViewError(
        f"'{name}' of {manifold.name} cannot be drawn: its members have no place. SE2, SE3, Rn(2) and Rn(3) have one; "
        f"{way} position=lambda values: (n, 2) or (n, 3) places",
        family=selection.family.name,
    )


def finite(name: str, values: Array, what: str = "member") -> None:
    """Refuse what is not finite.

    Raises:
        ViewError: a number is NaN or infinite; the message says whose.
    """
    good = np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
    if not good.all():
        k = int(np.argmin(good))
        raise ViewError(f"'{name}': {what} {k} is {values[k].tolist()}, which has no place in a picture", index=k)


def _kind(manifold: Manifold) -> str | None:
    if manifold == SE2:
        return "plane"
    if manifold == SE3:
        return "space"
    return "points" if isinstance(manifold, Rn) and manifold.storage in (2, 3) else None
