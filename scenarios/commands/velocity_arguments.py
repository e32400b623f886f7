"""Arguments of ``unifg run velocity-tracking``; apart from the scenario, whose imports help does not need."""

from __future__ import annotations

import argparse
from pathlib import Path

__all__ = ["DESCRIPTION", "add_arguments"]

DESCRIPTION = "Forces that make a car follow a speed profile: one optimal control problem over the whole drive."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the scenario's own options, but not ``--solver`` and ``--out``."""
    parser.add_argument("--length", type=_length, default=385, metavar="N", help="steps (default: %(default)s)")
    parser.add_argument(
        "--profile",
        type=_profile_file,
        metavar="F.csv",
        help="speeds to follow, column v_ref_mps [m/s] (default: a drive cycle that ships with unifg)",
    )
    parser.add_argument("--linear", action="store_true", help="air drag linear in the speed instead of quadratic")
    parser.add_argument(
        "--force-bounds", type=_bounds, metavar="LO,HI", help="least and greatest force [N]; not for kkt"
    )
    parser.add_argument(
        "--tolerance",
        type=_tolerance,
        default=1e-6,
        metavar="T",
        help="of the KKT test (default: %(default)s); penalty reaches 1e-5",
    )


def _length(text: str) -> int:
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least 1")
    return int(text)


def _tolerance(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive number")
    return value


def _bounds(text: str) -> tuple[float, float]:
    try:
        low, high = (float(word) for word in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not LO,HI: expected two numbers [N], without blanks") from None
    if not low < high:
        raise argparse.ArgumentTypeError(f"{text!r}: the first number must be below the second")
    return low, high


def _profile_file(text: str) -> Path:
    path = Path(text)
    if not path.is_file():
        raise argparse.ArgumentTypeError(f"{text}: no such file; give a CSV file with a column v_ref_mps")
    return path
