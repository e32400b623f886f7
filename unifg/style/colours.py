"""One colour stands for one thing, in scenes and plots alike; from colour-blind-safe sets (Okabe and Ito 2008)."""

from __future__ import annotations

import re

from unifg.errors import ViewError

__all__ = ["COLOURS", "GREY", "INK", "channels", "css", "rgb"]

COLOURS = {
    "floor": 0xF6F4EF,
    "metres": 0xE2DFD6,
    "grid": 0xBCC3CC,
    "wall": 0x9AA3AE,
    "ink": 0x1D2430,
    "dark": 0x2B3340,
    "plan": 0x4D4D4D,
    "start": 0x4D4D4D,
    "goal": 0xF0C000,
    "pole": 0x4D4D4D,
    "robot": 0x0A56A8,
    "heading": 0xFFFFFF,
    "trail": 0x3D95E0,
    "estimate": 0x8A3FD0,
    "odometry": 0x7F7F7F,
    "horizon": 0x009E4F,
    "scan": 0xE6007E,
    "fixed": 0xF09000,
    "moving": 0xD62718,
    "detected": 0x000000,
    "closure": 0x009E4F,
    "outlier": 0xD62718,
    "landmark": 0xF09000,
}
"""Name to 0xRRGGBB."""


_HEX = re.compile(r"#[0-9a-fA-F]{6}")


def rgb(colour: str) -> int:
    """A colour of the palette by its name, or ``#rrggbb``, as 0xRRGGBB.

    Raises:
        ViewError: it is neither.
    """
    if colour in COLOURS:
        return COLOURS[colour]
    if not _HEX.fullmatch(colour):
        raise ViewError(f"there is no colour {colour!r}: take '#rrggbb' or one of {', '.join(COLOURS)}")
    return int(colour[1:], 16)


def channels(colour: str) -> tuple[int, ...]:
    """Red, green and blue of the colour, from 0 to 255."""
    return tuple(rgb(colour).to_bytes(3, "big"))


def css(colour: str) -> str:
    """The colour as ``#rrggbb``."""
    return f"#{rgb(colour):06x}"


INK, GREY = css("ink"), "#6b7280"
