"""Processor time of the checkout beside that of an accepted commit, both in one run: ``make performance``.

    python -m tools.performance [--base COMMIT] [--rounds N]

The cases of ``unifg bench`` run in two processes, one with the code of the checkout and one with that of the commit,
in turn and in random order, on one core; only one of them works at a time. Another machine slows both, so nothing is
compared with times that were measured elsewhere. A case that seems slower is timed again, longer, and the second time
counts: exit status 1 where the 95 % bootstrap interval of the ratio of its medians lies above `SLOWER`.

The accepted commit is the last one that changed the record of times that ships: whoever records anew
(``unifg bench --record scenarios/commands/performance.jsonl``) accepts the speed as it is. A checkout without that
commit (a shallow clone, an archive) is timed without a comparison.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

import unifg as fg
from unifg.scenarios import command
from unifg.scenarios.commands.host import machine
from unifg.scenarios.commands.performance import QUICK, SLOWER, Comparison, Record, compared

CHECKOUT = Path(__file__).resolve().parents[1]
RECORD = "scenarios/commands/performance.jsonl"
AGAIN = 4  # times as many rounds where a case seems slower
WORKER = """\
import os, sys, time
if hasattr(os, "sched_setaffinity"):  # cores of a shared machine differ by a quarter: both sides have the same one
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
from unifg.scenarios.commands.performance import cases
found = cases()
print(*found, sep="\\t", flush=True)
for line in sys.stdin:
    action = found[line.strip()]
    began = time.process_time()
    action()
    print(time.process_time() - began, flush=True)
"""


class Side:
    """A process that times cases with the code of one folder.

    Attributes:
        cases: names of what it can time.
    """

    def __init__(self, folder: Path, cleanup: ExitStack) -> None:
        """Start it; ``cleanup`` ends it.

        Raises:
            RuntimeError: when its code cannot be run.
        """
        environment = os.environ | {"PYTHONPATH": str(folder), "PYTHONSAFEPATH": "1"}
        self._process = cleanup.enter_context(
            subprocess.Popen(
                [sys.executable, "-c", WORKER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
                env=environment, cwd=folder,
            )
        )  # fmt: skip
        cleanup.callback(self._process.kill)
        self.cases = self._answer().split("\t")

    def seconds(self, case: str) -> float:
        """Processor time of one run of a case [s]."""
        assert self._process.stdin is not None
        self._process.stdin.write(case + "\n")
        self._process.stdin.flush()
        return float(self._answer())

    def _answer(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline().strip()
        if not line:
            raise RuntimeError(f"the code in {self._process.args!r} ended with status {self._process.wait()}")
        return line


def accepted() -> str | None:
    """Last commit that changed the record; None without git or its history."""
    try:
        shallow = _git("rev-parse", "--is-shallow-repository").strip() == "true"
        return None if shallow else _git("log", "-1", "--format=%H", "--", RECORD).strip() or None
    except (OSError, subprocess.CalledProcessError):
        return None


def _git(*words: str) -> str:
    return subprocess.run(["git", *words], cwd=CHECKOUT, check=True, capture_output=True, text=True).stdout


def unpacked(commit: str, folder: Path) -> Path:
    """The files of a commit in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "commit.tar"
    _git("archive", "--format=tar", f"--output={file}", commit)
    with tarfile.open(file) as archive:
        archive.extractall(folder / "code", filter="data")
    file.unlink()
    return folder / "code"


def timed(sides: tuple[Side, Side], cases: Iterable[str], rounds: int, rng: np.random.Generator) -> list[Record]:
    """Seconds of the cases on both sides, a round of each in random order at a time."""
    names = list(cases)
    rows: list[dict[str, list[float]]] = [{name: [] for name in names} for _ in sides]
    for _ in range(rounds):
        for name in rng.permutation(names):
            for k in rng.permutation(len(sides)):
                rows[k][name].append(sides[k].seconds(name))
    today = datetime.now(UTC).date().isoformat()
    return [
        Record(fg.__version__, today, machine(), {name: 1e3 * float(np.median(row[name])) for name in names}, row)
        for row in rows
    ]


def slower(sides: tuple[Side, Side], rounds: int) -> list[str]:
    """Print the comparison; name the cases that the first side takes longer for, also when timed again."""
    rng = np.random.default_rng()
    suspects = [name for name in sides[0].cases if name in sides[1].cases]
    for times in (rounds, AGAIN * rounds):
        now, then = timed(sides, suspects, times, rng)
        rows = compared(now, then)
        print(table(now, then, rows), flush=True)
        suspects = [name for name in suspects if rows[name].slower]
        if not suspects:
            break
    return suspects


def table(now: Record, then: Record, rows: Mapping[str, Comparison]) -> str:
    """Milliseconds of both sides and their ratio."""
    lines = [f"{'case':18} {'ms':>9} {'before':>9}  ratio"]
    for name, row in rows.items():
        mark = "  SLOWER" if row.slower else ""
        ratio = "{:.2f} ({:.2f} to {:.2f})".format(*row)
        lines.append(f"{name:18} {now.milliseconds[name]:9.3f} {then.milliseconds[name]:9.3f}  {ratio}{mark}")
    return "\n".join(lines)


def main() -> int:
    """Compare, and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--base", help="commit to compare with (default: the last that changed the record)")
    parser.add_argument("--rounds", type=int, default=QUICK)
    chosen = parser.parse_args()
    base = chosen.base or accepted()
    if base is None:
        print(f"nothing to compare with: this checkout has no history of {RECORD} (a shallow clone, an archive)")
        return command.main(["bench", "--quick"])
    with ExitStack() as cleanup:
        folder = Path(cleanup.enter_context(tempfile.TemporaryDirectory()))
        sides = Side(CHECKOUT, cleanup), Side(unpacked(base, folder), cleanup)
        print(f"the checkout beside {base[:10]}, processor time, {chosen.rounds} rounds", flush=True)
        found = slower(sides, chosen.rounds)
    if found:
        print(f"slower by more than {100 * (SLOWER - 1):.0f} %: {', '.join(found)}")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
