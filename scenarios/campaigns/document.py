"""A report as Markdown and as one HTML file that needs nothing else: headings, words, tables and pictures."""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from unifg.scenarios.campaigns.markdown import cell, table

__all__ = ["Document"]

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


class Document:
    """A document that grows block by block.

    Attributes:
        markdown: its text so far; pictures are named relative to its folder.
    """

    def __init__(self, title: str, folder: Path) -> None:
        """Begin with a title.

        Args:
            title: of the document.
            folder: that the Markdown file will lie in.
        """
        self._title, self._folder = html.escape(title), folder
        self.markdown, self._html = f"# {cell(title)}\n", list[str]()

    def heading(self, text: str) -> None:
        """Add a heading below the title."""
        self._add(f"## {cell(text)}", f"<h2>{html.escape(text)}</h2>")

    def words(self, text: str) -> None:
        """Add a paragraph."""
        self._add(text, f"<p>{_CODE.sub(_AS_CODE, html.escape(text))}</p>")

    def table(self, head: Sequence[str], rows: Sequence[Sequence[str]], text: int) -> None:
        """Add a table whose first columns, ``text`` of them, are words, and the others numbers."""
        kinds = ["" if k < text else ' class="n"' for k in range(len(head))]
        marked = [
            "".join(f"<{tag}{kind}>{html.escape(word)}</{tag}>" for kind, word in zip(kinds, row, strict=True))
            for tag, row in (("th", head), *(("td", row) for row in rows))
        ]
        lines = "\n".join(f"<tr>{line}</tr>" for line in marked)
        plain = table([cell(word) for word in head], [[cell(word) for word in row] for row in rows], text)
        self._add(plain, f'<div class="wide"><table>\n{lines}\n</table></div>')

    def picture(self, path: Path, text: str) -> None:
        """Add a PNG file below the folder."""
        data = base64.b64encode(path.read_bytes()).decode()
        plain = f"![{cell(text)}]({path.relative_to(self._folder).as_posix()})"
        self._add(plain, f'<p><img alt="{html.escape(text)}" src="data:image/png;base64,{data}"></p>')

    @contextmanager
    def fold(self, title: str) -> Iterator[None]:
        """Fold away what is added meanwhile."""
        self._add(f"### {cell(title)}", f"<details><summary>{html.escape(title)}</summary>")
        yield
        self._html.append("</details>")

    def html(self) -> str:
        """The HTML file, pictures and all."""
        head = (
            '<!doctype html>\n<html lang="en">\n<meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            f"<title>{self._title}</title>\n<style>{_STYLE}</style>\n<h1>{self._title}</h1>\n"
        )
        return head + "\n".join(self._html) + "\n</html>\n"

    def _add(self, plain: str, marked: str) -> None:
        self.markdown += f"\n{plain}\n"
        self._html.append(marked)
