"""A document of headings, words, tables and pictures: as Markdown, and as one HTML file that needs nothing else."""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from unifg.scenarios.campaigns.markdown import cell, table

__all__ = ["Block", "Command", "Fold", "Heading", "Picture", "Table", "Words", "as_html", "as_markdown"]


@dataclass(frozen=True)
class Heading:
    """A heading below the title."""

    text: str


@dataclass(frozen=True)
class Words:
    """A paragraph."""

    text: str


@dataclass(frozen=True)
class Command:
    """What a user types."""

    text: str


@dataclass(frozen=True)
class Table:
    """A table whose first columns, ``text`` of them, are words, and the others numbers."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    text: int = 1


@dataclass(frozen=True)
class Picture:
    """A PNG file."""

    path: Path
    text: str


@dataclass(frozen=True)
class Fold:
    """Blocks that only some readers want to see."""

    title: str
    blocks: Sequence[Block]


Block: TypeAlias = Heading | Words | Command | Table | Picture | Fold

_CODE, _AS_CODE = re.compile("`([^`]+)`"), r"<code>\1</code>"
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1f2937; background: #fff; margin: 2rem auto; max-width: 72rem;
  padding: 0 1rem; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin: 2.2rem 0 .6rem; border-bottom: 1px solid #e3e6ea; }
.wide { overflow-x: auto; margin: .8rem 0; }
table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; }
th { text-align: left; border-bottom: 2px solid #8a919c; padding: .25rem .7rem .25rem 0; white-space: nowrap; }
td { border-bottom: 1px solid #e3e6ea; padding: .2rem .7rem .2rem 0; vertical-align: top; }
.n { text-align: right; white-space: nowrap; }
code { font: 12.5px/1.4 ui-monospace, monospace; background: #f3f4f6; padding: .1rem .3rem; border-radius: 3px; }
img { max-width: 100%; } details { margin: 1rem 0; } summary { cursor: pointer; font-weight: 600; }
@media print { body { max-width: none; } }
"""


def as_markdown(title: str, blocks: Sequence[Block], folder: Path) -> str:
    """The document; pictures are named relative to a folder."""
    return "\n\n".join([f"# {cell(title)}", *_markdown(blocks, folder)]) + "\n"


def as_html(title: str, blocks: Sequence[Block]) -> str:
    """The document, pictures and all."""
    head = (
        '<!doctype html>\n<html lang="en">\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(title)}</title>\n<style>{_STYLE}</style>\n<h1>{html.escape(title)}</h1>\n"
    )
    return head + "\n".join(_html(blocks)) + "\n</html>\n"


def _markdown(blocks: Sequence[Block], folder: Path) -> list[str]:
    parts = list[str]()
    for block in blocks:
        match block:
            case Heading(text):
                parts.append(f"## {cell(text)}")
            case Words(text):
                parts.append(text)
            case Command(text):
                parts.append(f"```sh\n{text}\n```")
            case Table(head, rows, text):
                parts.append(table([cell(word) for word in head], [[cell(word) for word in row] for row in rows], text))
            case Picture(path, text):
                parts.append(f"![{cell(text)}]({path.relative_to(folder).as_posix()})")
            case Fold(name, inner):
                parts += [f"### {cell(name)}", *_markdown(inner, folder)]
    return parts


def _html(blocks: Sequence[Block]) -> list[str]:
    parts = list[str]()
    for block in blocks:
        match block:
            case Heading(text):
                parts.append(f"<h2>{html.escape(text)}</h2>")
            case Words(text):
                parts.append(f"<p>{_CODE.sub(_AS_CODE, html.escape(text))}</p>")
            case Command(text):
                parts.append(f"<p><code>{html.escape(text)}</code></p>")
            case Table(head, rows, text):
                kinds = ["" if k < text else ' class="n"' for k in range(len(head))]
                first = "".join(f"<th{kind}>{html.escape(w)}</th>" for kind, w in zip(kinds, head, strict=True))
                lines = (
                    "<tr>" + "".join(f"<td{k}>{html.escape(w)}</td>" for k, w in zip(kinds, row, strict=True)) + "</tr>"
                    for row in rows
                )
                body = "\n".join(lines)
                parts.append(f'<div class="wide"><table>\n<tr>{first}</tr>\n{body}\n</table></div>')
            case Picture(path, text):
                data = base64.b64encode(path.read_bytes()).decode()
                parts.append(f'<p><img alt="{html.escape(text)}" src="data:image/png;base64,{data}"></p>')
            case Fold(name, inner):
                parts.append(f"<details><summary>{html.escape(name)}</summary>")
                parts += _html(inner)
                parts.append("</details>")
    return parts
