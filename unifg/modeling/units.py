"""Units and frames of a term's arguments, compared with those its function takes.

Names of frames that a function takes are literal, but for single capital letters: one letter is one frame, whichever,
in all arguments of a term, and the two letters of a chain as ``W_T_B`` are different frames. ``*`` in the place of
units stands for any, alike in all arguments that have it.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import pi
from typing import Any

import numpy as np

from unifg.errors import GraphError
from unifg.lie import Manifold, Rn
from unifg.lie.product import leaves
from unifg.modeling.elements import QUATERNIONS
from unifg.modeling.quantities import CHAIN, NOTHING, Quantity, fits, remedy, taken
from unifg.modeling.variables import Data, Declared, as_selection, is_variable, quantity_of

logger = logging.getLogger("unifg")
TURNS = 4.0 * pi  # [rad] beyond which a number is taken for degrees
SAME = ("* in A_T_B",) * 3  # what a fix or a bound takes


def compare(
    name: str, function: str, arguments: Sequence[Any], takes: Sequence[str | None], elements: Mapping[int, Manifold]
) -> None:
    """Compare what the arguments of a term declare with what its function takes, where both do.

    Args:
        name: of the term.
        function: its name.
        arguments: of the term, as given.
        takes: texts of ``fg.residual``, by place; fewer than arguments where nothing more is declared.
        elements: manifolds of arguments that are elements, by place.

    Raises:
        GraphError: naming term, argument, both declarations and a remedy.
    """
    if all(quantity_of(argument) == NOTHING for argument in arguments):
        return
    wanted = [taken(text or "") for text in takes] + [NOTHING] * (len(arguments) - len(takes))
    alike: tuple[tuple[str, ...], str] | None = None
    frames = Frames(frozenset(frozenset(one.frame.split(CHAIN)) for one in wanted if CHAIN in one.frame))
    for place, argument in enumerate(arguments):
        own, who, unknown = quantity_of(argument), _name(argument), is_variable(argument)
        where = f"term '{name}': argument {place} of {function}, {who},"
        manifold = None if unknown else elements.get(place)
        if manifold is not None and own.units:
            fits(where, own, manifold)
        if wanted[place].units == ("*",):
            expected = alike = alike or ((own.coordinates, who) if own.units else None)
        else:
            expected = (wanted[place].coordinates, "the function") if wanted[place].units else None
        if own.units and expected is not None:
            _require_units(where, own, *expected, term=name)
        if own.frame and wanted[place].frame:
            frames.require(where, who, own.frame, wanted[place].frame, name)
        if not unknown:
            _notice(where, name, argument, (expected or (own.coordinates, ""))[0], manifold, function)


def _name(argument: Any) -> str:
    """An argument as messages call it."""
    if is_variable(argument):
        return f"family '{as_selection(argument).family.name}'"
    return f"data '{argument.name}'" if isinstance(argument, Data) else "a constant"


def _require_units(where: str, own: Quantity, expected: tuple[str, ...], by: str, term: str) -> None:
    found = own.coordinates
    longest = max(len(found), len(expected))
    if {len(found), len(expected)} - {1, longest}:
        raise GraphError(
            f"{where} declares {len(found)} units ({', '.join(own.units)}), {by} {len(expected)} "
            f"({', '.join(expected)}): give one for each number",
            term=term,
        )
    pairs = zip(found * (longest // len(found)), expected * (longest // len(expected)), strict=True)
    for k, (unit, other) in enumerate(pairs):
        if unit != other:
            raise GraphError(
                f"{where} declares '{unit}' for number {k}, {by} '{other}'{remedy(unit, other)}", term=term
            )


@dataclass(frozen=True)
class Frames:
    """Frames that the letters of a function's chains stand for in one term.

    Attributes:
        apart: pairs of letters that stand for different frames.
        known: of each letter its frame, and the argument that declares it.
    """

    apart: frozenset[frozenset[str]]
    known: dict[str, tuple[str, str]] = field(default_factory=dict)

    def require(self, where: str, who: str, own: str, wanted: str, term: str) -> None:
        """Refuse a frame that is another than its letter stands for, or that of a letter it must differ from."""
        for letter, found in zip(wanted.split(CHAIN), own.split(CHAIN), strict=False):
            free = len(letter) == 1 and letter.isupper()
            name, by = self.known.setdefault(letter, (found, who)) if free else (letter, "the function")
            expected = f"'{name}' ({by})" if name != found else ""
            for other, (frame, of) in self.known.items():
                if frame == found and frozenset((letter, other)) in self.apart:
                    expected = expected or f"another than '{frame}' ({of})"
            if expected:
                raise GraphError(
                    f"{where} is declared in frame '{own}', expected {expected}: transform it by the pose "
                    "between the two frames (act, compose), or correct the frame that is declared",
                    term=term,
                )


def _notice(
    where: str, name: str, given: Any, units: tuple[str, ...], manifold: Manifold | None, function: str
) -> None:
    """Refuse angles of several turns, which are degrees; warn of them in vectors, and of quaternions out of order."""
    array = np.asarray(given.value if isinstance(given, Data | Declared) else given, dtype=np.float64)
    rows = array.reshape(-1, array.shape[-1] if array.ndim and len(units) > 1 else 1)
    angles = [k for k, unit in enumerate(units) if unit == "rad"] if rows.shape[1] == len(units) else []
    size = np.abs(rows[:, angles])
    beyond = np.argwhere((size > TURNS) & (size < np.inf))
    if len(beyond):
        row, k = int(beyond[0][0]), angles[int(beyond[0][1])]
        said = (
            f"{where} is in radians, and row {row} has {rows[row, k]:g} for number {k}, more than two turns: convert "
            "degrees by np.radians, and angles counted over several turns by fg.wrap_angle"
        )
        if not isinstance(manifold, Rn):
            raise GraphError(said, term=name, index=row)
        logger.warning("%s", said)
    for leaf, start, _ in leaves(manifold) if function == "between" and manifold is not None else ():
        if isinstance(leaf, QUATERNIONS):
            turn = np.abs(array[..., start + leaf.storage - 4 : start + leaf.storage])
            if (turn[..., 0] < 0.25).all() and (turn[..., 3] > 0.9).all():
                logger.warning("%s turns by half a turn about z in every row: are its quaternions x first? "
                               "from_quaternion(rows, order='xyzw') reorders them", where)  # fmt: skip
