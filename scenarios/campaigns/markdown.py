"""Tables as Markdown."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

__all__ = ["cell", "table"]

_MARKS = re.compile(r"[\\`*<&\[|~]|\b_|_\b")


def table(head: Sequence[str], rows: Iterable[Sequence[str]], text: int = 1) -> str:
    """A Markdown table whose first ``text`` columns are words and the others numbers."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * text + "---:|" * (len(head) - text)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def cell(text: str) -> str:
    """Somebody else's words as they may stand in a heading or table, where they mark and mean nothing."""
    return _MARKS.sub(r"\\\g<0>", " ".join(text.split()))
