"""``make fuzz``: mutated files for every reader, a minute each; what finds something is kept by its number.

    python -m benchmarks.fuzz [--seconds 60] [--first 0] [--only g2o]

Prints, for every reader, how many files were tried, and the numbers of those that ended in anything but an answer or
the reader's own error. ``tests/test_hostile_files.py`` tries the first few, and all numbers it keeps.
"""

from __future__ import annotations

import argparse
import logging
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

from hostile import READERS, trouble


def main() -> int:
    """Try, and say what came of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="for each reader (default: %(default)s)")
    parser.add_argument("--first", type=int, default=0, help="number of the first mutation (default: %(default)s)")
    parser.add_argument("--only", choices=READERS, help="one reader")
    options = parser.parse_args()
    logging.getLogger("unifg").setLevel(logging.CRITICAL)
    tried, wrong = 0, 0
    with tempfile.TemporaryDirectory() as folder:
        for name in [options.only] if options.only else READERS:
            number, found, end = options.first, dict[int, str](), time.monotonic() + options.seconds
            while time.monotonic() < end:
                if said := trouble(READERS[name], Path(folder), number):
                    found[number] = said
                number += 1
            print(f"{name}: {number - options.first} files, {len(found)} ended wrongly", flush=True)
            for kept, said in list(found.items())[:20]:
                print(f"  {kept}: {said}", flush=True)
            tried, wrong = tried + number - options.first, wrong + len(found)
    print(f"{tried} files, {wrong} ended wrongly")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
