"""Rows of what takes longer to run than one sitting, kept in the checkout.

To read them: ``xz -dc benchmarks/campaigns/rows/department.jsonl.xz``.
"""

from __future__ import annotations

import json
import lzma
from pathlib import Path

from benchmarks.report import CAMPAIGNS
from unifg.atomic_write import write_atomically
from unifg.errors import ScenarioError
from unifg.scenarios.campaigns.journal import Journal, lines_of

__all__ = ["ROWS", "keep", "restore"]

ROWS = CAMPAIGNS / "rows"


def keep(store: Path, archive: Path) -> None:
    """Pack the rows of a file of one object a line, of each key the last; the same rows give the same bytes."""
    last = {str(row["key"]): row for row in lines_of(store)}
    text = "".join(json.dumps(last[key]) + "\n" for key in sorted(last))
    archive.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(archive, lzma.compress(text.encode(), preset=9))


def restore(archive: Path, store: Path) -> int:
    """Add to a file of one object a line the rows that are kept and whose keys are not there.

    Returns:
        How many were added.

    Raises:
        ScenarioError: the archive is damaged, or the file cannot be written or is in use.
    """
    if not archive.is_file():
        return 0
    try:
        kept = {
            str(json.loads(line)["key"]): line for line in lzma.decompress(archive.read_bytes()).decode().splitlines()
        }
    except (lzma.LZMAError, ValueError, KeyError, TypeError) as error:
        raise ScenarioError(f"{archive}: is damaged ({error}); take it from the repository again") from None
    on_file = {str(row.get("key")) for row in lines_of(store)}
    missing = [line for key, line in kept.items() if key not in on_file]
    if missing:
        with Journal(store) as journal:
            journal.add("\n".join(missing))  # on the disk at once, or not at all
    return len(missing)
