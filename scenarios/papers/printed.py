"""Numbers of the papers, read from papers.toml, where each stands once as it is printed."""

from __future__ import annotations

import os
import re
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parent
SPELLED = {"two": "2", "five": "5"}


@cache
def printed() -> dict[str, Any]:
    """The file: paper, place, name, text as printed."""
    return tomllib.loads((FOLDER / "papers.toml").read_text(encoding="utf-8"))


def texts(paper: str, place: str) -> dict[str, str]:
    """Texts that a place of a paper prints, by name."""
    found: dict[str, str] = printed()[paper][place]
    return found


def numbers(paper: str, place: str, name: str) -> list[float]:
    """The numbers in one of these texts, in figures or spelled out."""
    words = re.findall(r"\d+(?:\.\d+)?|\b(?:two|five)\b", texts(paper, place)[name])
    return [float(SPELLED.get(word, word)) for word in words]


def pairs(paper: str, place: str) -> dict[str, tuple[float, float]]:
    """Mean and standard deviation by name, of a column of such."""
    return {name: (found[0], found[1]) for name in texts(paper, place) if (found := numbers(paper, place, name))}


def shared(folder: str) -> Path | None:
    """Folder of data sets in ``$UNIFG_DATA``, or in ``shared/data`` beside the checkout; None if it is missing."""
    path = Path(os.environ.get("UNIFG_DATA", FOLDER.parents[2] / "shared" / "data")) / folder
    return path if path.is_dir() else None
