"""SIGTERM at random moments: a command has to end soon, and the files it leaves have to be whole.

    python -m tools.stops [--count 30] [--seed S] [--only COMMAND ...]

``unifg run navigation`` on a short way, ``unifg campaign`` over manoeuvres and ``unifg solve`` on a pose graph are
run to their end, which says how long they take, and then stopped, each time at a moment uniform in that time. A
command that is stopped ends with status 130, or with that of a run that has come to its end meanwhile; before its
handlers stand, as any process does that is ended. What it leaves has to be nothing, or whole: JSON that parses,
archives that open, graphs and trajectories that read, a journal of whole lines, no file that was still being written;
and a run whose record had begun has results. Exit status 1 where one did not.
"""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.report import command, table
from unifg.files.g2o import read_g2o, write_g2o
from unifg.files.tum import read_tum
from unifg.pose_graphs.generate import manhattan

COUNT = 30
INTERRUPTED = 130
BEFORE = (-signal.SIGTERM, 128 + signal.SIGTERM)  # of a process whose handlers do not stand yet
NOTHING = "before there was anything to write"
RUN = "run navigation --start 6.5,14,0 --goal 13.5,14.1,0 --obstacles 0"
CAMPAIGN = """\
scenario = "manoeuvres"
[grid]
solver = ["ipm", "sqp"]
"""
"""Of two episodes."""


def commands(folder: Path) -> dict[str, list[str]]:
    """Arguments of the command line, but for where results go."""
    graph, campaign = folder / "graph.g2o", folder / "two.toml"
    write_g2o(graph, manhattan(4000).pose_graph)
    campaign.write_text(CAMPAIGN, encoding="utf-8")
    return {
        "run": RUN.split(),
        "campaign": ["campaign", str(campaign), "--workers", "1"],
        "solve": ["solve", str(graph), "--init", "file", "--effort", "full"],
    }


def wrong_in(out: Path) -> list[str]:
    """Files of a folder of results that are not whole."""
    wrong = []
    for file in sorted(path for path in out.rglob("*") if path.is_file()):
        try:
            if file.name.startswith("."):
                wrong.append(f"{file.name} is left over")
            elif file.suffix == ".json":
                json.loads(file.read_text(encoding="utf-8"))
            elif file.suffix == ".jsonl":
                lines = file.read_text(encoding="utf-8").splitlines(keepends=True)
                [json.loads(line) for line in lines]
                wrong += [f"{file.name} ends within a line" for line in lines[-1:] if not line.endswith("\n")]
            elif file.suffix == ".npz":
                with np.load(file, allow_pickle=False) as stored:
                    [stored[name] for name in stored.files]
            elif file.suffix == ".g2o":
                read_g2o(file)
            elif file.suffix == ".tum":
                read_tum(file)
            elif file.suffix == ".html" and not file.read_text(encoding="utf-8").rstrip().endswith("</html>"):
                wrong.append(f"{file.name} is cut off")
        except Exception as error:
            wrong.append(f"{file.name}: {type(error).__name__}: {error}")
    return wrong


def stopped(words: list[str], out: Path, after: float | None) -> tuple[int, float, str]:
    """Exit status, seconds from the signal to the end (or in all), and what was said, of one run.

    Args:
        words: arguments of the command.
        out: folder of its results.
        after: when to send the signal [s]; None for never.
    """
    began = time.perf_counter()
    child = subprocess.Popen(
        [sys.executable, "-m", "unifg.scenarios.command", *words, "--out", str(out)],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    if after is not None:
        try:
            child.wait(timeout=after)
        except subprocess.TimeoutExpired:
            began = time.perf_counter()
            child.send_signal(signal.SIGTERM)
    said = child.communicate()[0]
    return child.returncode, time.perf_counter() - began, said


def judged(status: int, said: str, out: Path, finished: int) -> list[str]:
    """Faults of the end of a run."""
    wrong = wrong_in(out) if out.is_dir() else []
    if status not in (INTERRUPTED, finished, *BEFORE):
        wrong.append(f"status {status}")
    if status == INTERRUPTED and NOTHING not in said and not any(path.is_file() for path in out.rglob("*")):
        wrong.append("its results are lost")
    if "Traceback" in said:
        wrong.append(said[said.index("Traceback") :].strip().splitlines()[-1])
    return wrong


def main(arguments: list[str] | None = None) -> int:
    """Stop every command many times; 1 if anything was left that is not whole."""
    parser = command(__doc__)
    parser.add_argument("--count", type=int, default=COUNT, help="stops of each command")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--only", nargs="+", metavar="COMMAND", default=["run", "campaign", "solve"])
    chosen = parser.parse_args(arguments)
    rng, rows, failed = random.Random(chosen.seed), [], False
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for kind, words in commands(folder).items():
            if kind not in chosen.only:
                continue
            stopped(words, folder / f"{kind}-warm", None)
            finished, seconds, said = stopped(words, folder / f"{kind}-whole", None)
            if finished != 0:
                raise SystemExit(f"{kind} does not come to its end: {said}")
            ends, longest, wrong = [0, 0, 0], 0.0, 0
            for number in range(chosen.count):
                out = folder / f"{kind}-{number}"
                after = rng.uniform(0.0, seconds)
                status, took, said = stopped(words, out, after)
                found = judged(status, said, out, finished)
                ends[2 if status in BEFORE else 1 if status == finished else 0] += 1
                longest, wrong = max(longest, took), wrong + bool(found)
                if found:
                    print(f"{kind}, stopped after {after:.2f} s of {seconds:.1f}: {'; '.join(found)}", flush=True)
            failed |= wrong > 0
            rows.append((kind, f"{seconds:.1f}", *map(str, ends), f"{longest:.1f}", str(wrong)))
    head = ("command", "whole [s]", "stopped", "came to its end", "not begun", "at most after [s]", "not whole")
    print(table(head, rows, text=1))
    return int(failed)


if __name__ == "__main__":
    raise SystemExit(main())
