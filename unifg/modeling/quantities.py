"""Units and frames as they are declared: of families, data, constants, and arguments of functions.

Units are a text with one unit for each number, separated by commas: of variables for each tangent coordinate, of data
for each stored number, where ``wxyz`` or ``xyzw`` stands for the four numbers of a quaternion. One unit alone holds for
all numbers of a vector. A frame is a name, or
``map_T_base`` for what takes coordinates of the second frame to the first.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from unifg.errors import GraphError
from unifg.lie import SE2, SE3, SE23, SO2, SO3, Manifold, Rn
from unifg.lie.product import leaves

ANGLES: dict[object, int] = {
    SO2: 1,
    SE2: 1,
    SO3: 3,
    SE3: 3,
    SE23: 3,
}  # tangent coordinates that are angles, the last ones of each
CHAIN = "_T_"


@dataclass(frozen=True)
class Quantity:
    """Declared units and frame; empty where nothing is declared.

    Attributes:
        units: one for each number, as written.
        frame: its name.
    """

    units: tuple[str, ...] = ()
    frame: str = ""

    @property
    def declared(self) -> bool:
        """True if there is a unit or a frame."""
        return bool(self.units or self.frame)

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Units with three in the place of a quaternion: ``rad`` for w first, ``xyzw`` for what is out of order."""
        words = {"wxyz": ("rad",) * 3, "xyzw": ("xyzw",) * 3}
        return tuple(word for unit in self.units for word in words.get(unit, (unit,)))

    def component(self, manifold: Manifold, tangent: slice) -> Quantity:
        """The quantity of a component: its units, and the outer frame alone where it is a vector."""
        frame = self.frame.partition(CHAIN)[0] if isinstance(manifold, Rn) else self.frame
        return Quantity(self.coordinates[tangent], frame)


NOTHING = Quantity()


def quantity(what: str, units: str | None, frame: str | None, manifold: Manifold | None = None) -> Quantity:
    """Read a declaration.

    Args:
        what: the subject of messages.
        units: separated by commas; None for none.
        frame: its name; None for none.
        manifold: of variables, whose angles are in radians and whose units are as many as tangent coordinates.

    Raises:
        GraphError: one of them is no text or has an empty place, or the units do not fit the manifold.
    """
    for name, given in (("units", units), ("frame", frame)):
        if given is not None and not (isinstance(given, str) and all(part.strip() for part in given.split(","))):
            raise GraphError(f"{what}: {name}= is a text such as {_EXAMPLES[name]}, found {given!r}")
    found = Quantity(tuple(unit.strip() for unit in units.split(",")) if units else (), (frame or "").strip())
    if isinstance(manifold, Rn) and len(found.units) == 1:
        found = replace(found, units=found.units * manifold.dim)
    if manifold is not None and found.units:
        fits(what, found, manifold)
    return found


def fits(what: str, found: Quantity, manifold: Manifold) -> None:
    """Compare the units of elements with their manifold.

    Raises:
        GraphError: they are not as many as tangent coordinates, or angles that are stored in radians have another unit.
    """
    units = found.coordinates
    if len(units) != manifold.dim and not (len(units) == 1 and isinstance(manifold, Rn)):
        raise GraphError(
            f"{what} declares {len(units)} units ({', '.join(found.units)}), but {manifold.name} has {manifold.dim} "
            f"tangent coordinates: give {'one unit for all, or ' * isinstance(manifold, Rn)}one for each, with commas"
        )
    at = 0
    for leaf, _, _ in leaves(manifold):
        for k in range(at + leaf.dim - ANGLES.get(leaf, 0), at + leaf.dim):
            if units[k] != "rad":
                raise GraphError(
                    f"{what} declares '{units[k]}' for coordinate {k} of {manifold.name}, which is stored "
                    f"{'w first' if units[k] == 'xyzw' else 'in radians'}{remedy(units[k], 'rad')}"
                )
        at += leaf.dim


def remedy(found: str, expected: str) -> str:
    """Advice for a unit that is not the expected one."""
    if found == "xyzw":
        return ": reorder the quaternions by from_quaternion(rows, order='xyzw') of SO3 or SE3, and declare 'wxyz'"
    if found.startswith("deg") and expected.startswith("rad"):
        return ": convert by np.radians, and declare 'rad'"
    return ": convert the numbers, or correct the declaration"


def taken(text: str) -> Quantity:
    """The quantity of an argument as ``takes=`` of a residual states it: ``"m, m, rad in W_T_B"``."""
    units, _, frame = text.partition(" in ") if not text.startswith("in ") else ("", "", text[3:])
    return quantity("takes=", units.strip() or None, frame.strip() or None)


_EXAMPLES: dict[str, Any] = {"units": "'m, m, rad'", "frame": "'map'"}
