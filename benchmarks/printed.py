"""Numbers of the papers, read from papers.toml, where each stands once as it is printed."""

from __future__ import annotations

import re
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

FILE = Path(__file__).with_name("papers.toml")


@cache
def printed() -> dict[str, Any]:
    """The file: paper, place, name, text as printed."""
    return tomllib.loads(FILE.read_text(encoding="utf-8"))


def texts(paper: str, place: str) -> dict[str, str]:
    """Texts that a place of a paper prints, by name."""
    found: dict[str, str] = printed()[paper][place]
    return found


def numbers(paper: str, place: str, name: str) -> list[float]:
    """The numbers in one of these texts."""
    return [float(word) for word in re.findall(r"\d+(?:\.\d+)?", texts(paper, place)[name])]


def pairs(paper: str, place: str) -> dict[str, tuple[float, float]]:
    """Mean and standard deviation by name, of a column of such."""
    return {name: (found[0], found[1]) for name in texts(paper, place) if (found := numbers(paper, place, name))}
