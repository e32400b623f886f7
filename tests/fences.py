"""Read the fenced code blocks of the documentation; shared by the tests and `docs/check_shell_fences.py`."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from scripts import CHECKOUT

PYTHON = frozenset({"python"})
SHELL = frozenset({"sh", "bash"})
# Shown, never run. Anything else, and a fence without a language, is refused: a slip must not hide code.
SHOWN = frozenset({"c", "text", "bibtex", "json", "toml", "yaml", "mermaid"})

_OPENING = re.compile(r"^(?P<indent>[ \t]*)(?P<mark>`{3,}|~{3,})[ \t]*(?P<info>[^`]*)$")
_SKIP = re.compile(r"^\s*<!--\s*skip:\s*(?P<reason>.*?)\s*-->\s*$")


@dataclass(frozen=True)
class Fence:
    """One fenced block: the file, the line its code starts on (from 1), its language and its code."""

    path: Path
    line: int
    language: str
    code: str
    skip: str | None
    """Reason in a comment `<!-- skip: reason -->` on the line before the fence; None without one."""

    @property
    def place(self) -> str:
        """File and line in the form editors open."""
        return f"{relative(self.path)}:{self.line}"


def relative(path: Path) -> str:
    """Name a file as seen from the checkout, or in full where it lies elsewhere."""
    return path.relative_to(CHECKOUT).as_posix() if path.is_relative_to(CHECKOUT) else str(path)


def documents(root: Path = CHECKOUT) -> list[Path]:
    """List the pages whose code is executed: README.md and all pages below docs/."""
    readme = root / "README.md"
    return ([readme] if readme.is_file() else []) + sorted((root / "docs").rglob("*.md"))


def fences(path: Path) -> Iterator[Fence]:
    """Yield the fences of one page in order.

    Raises:
        ValueError: If a fence is never closed.
    """
    lines = path.read_text(encoding="utf-8").splitlines()
    number = 0
    while number < len(lines):
        opening = _OPENING.match(lines[number])
        if opening is None:
            number += 1
            continue
        start, indent, mark = number + 1, len(opening["indent"]), opening["mark"]
        end = start
        while end < len(lines) and not _closes(lines[end], mark):
            end += 1
        if end == len(lines):
            raise ValueError(f"{relative(path)}:{start}: this fence is never closed")
        skip = _SKIP.match(lines[number - 1]) if number else None
        body = [text[min(indent, len(text) - len(text.lstrip())) :] for text in lines[start:end]]
        info = opening["info"].split()
        yield Fence(path, start + 1, info[0].lower() if info else "", "\n".join(body) + "\n", skip and skip["reason"])
        number = end + 1


def _closes(line: str, mark: str) -> bool:
    """Test whether a line closes the fence that was opened by `mark`."""
    text = line.strip()
    return len(text) >= len(mark) and set(text) == {mark[0]}
