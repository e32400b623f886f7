"""List the public surface: `python docs/site/surface.py` rewrites docs/reference/surface.md, which a test holds fast.

A name that appears or goes is thereby a line of a change, seen by whoever reads it.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

import reference

PAGE = reference.CHECKOUT / "docs" / "reference" / "surface.md"
HEAD = """# The public surface

Every name that a release promises, by the module it is imported from; what it does is in the reference of the site
(`make docs`). Everything else, names with an underscore and modules that are not listed, may change at any time. The
page is made by `python docs/site/surface.py`, and a test fails until a name that was added or removed stands here, too.
What happens to these names between versions: [releases](releases.md).
"""


def text() -> str:
    """The page."""
    parts = [f"## {module}\n\n{', '.join(f'`{name}`' for name in sorted(names))}" for module, names in _public()]
    return HEAD + "\n" + "\n\n".join(parts) + "\n"


def _public() -> list[tuple[str, list[str]]]:
    return sorted(reference.public().items())


if __name__ == "__main__":
    PAGE.write_text(text(), encoding="utf-8", newline="\n")
    print(PAGE)
