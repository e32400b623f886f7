"""A run again: what went into it, written beside its results, and whether it came out the same to the last bit.

``inputs.json`` holds the words of the command line, from which everything follows, digests of the files they name, all
settings spelled out, and what was run where. What is compared are the numbers of all logs (``.npz``), trajectories
and ``metrics.json``, but for those that a clock has told.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from unifg.errors import ScenarioError
from unifg.scenarios.commands.host import machine
from unifg.typing import Array
from unifg.whole import write_whole

__all__ = ["INPUTS", "Inputs", "differences", "read_inputs", "write_inputs"]

INPUTS = "inputs.json"
CLOCKED = re.compile(r"(^|[._\[])(ms|seconds|wall|cpu)($|[._\]])|_ms($|[._\]])|_seconds($|[._\]])|per_second|real_time")


@dataclass(frozen=True)
class Inputs:
    """What went into a run.

    Attributes:
        words: of the command line, without ``--out`` and ``--live``.
        files: digests by name of the files among them.
        settings: all of them, spelled out.
        version: of unifg.
        sources: digest of its code.
        machine: kind.
    """

    words: list[str]
    files: dict[str, str]
    settings: str
    version: str
    sources: str
    machine: str

    def changed(self, other: Inputs) -> list[str]:
        """What is not the same, as sentences."""
        said = [
            f"{what}: {before} then, {now} now"
            for what, before, now in (
                ("version", self.version, other.version), ("code", self.sources, other.sources),
                ("machine", self.machine, other.machine), ("settings", self.settings, other.settings),
            )
            if before != now
        ]  # fmt: skip
        return said + [f"{name}: another content" for name in self.files if self.files[name] != other.files.get(name)]


def inputs(words: Sequence[str], settings: object, version: str, sources: str) -> Inputs:
    """Of the run that these words ask for."""
    kept, skip = list[str](), False
    for word in words:
        if skip or word.startswith("--out=") or word in ("--live", "--out"):
            skip = word == "--out" and not skip
            continue
        kept.append(word)
    named = {word.rpartition("=")[2] for word in kept}
    files = {name: hashlib.sha256(Path(name).read_bytes()).hexdigest() for name in sorted(named) if _is_file(name)}
    return Inputs(kept, files, repr(settings), version, sources, machine())


def _is_file(name: str) -> bool:
    try:
        return Path(name).is_file()
    except (OSError, ValueError):  # too long for a name, or a word with a zero byte
        return False


def write_inputs(folder: Path, found: Inputs) -> Path:
    """Write them beside the results."""
    write_whole(folder / INPUTS, json.dumps(vars(found), indent=2) + "\n")
    return folder / INPUTS


def read_inputs(folder: Path) -> Inputs:
    """Read them.

    Raises:
        ScenarioError: there are none, or they say something else.
    """
    file = folder / INPUTS
    try:
        found = Inputs(**json.loads(file.read_text(encoding="utf-8")))
    except FileNotFoundError:
        raise ScenarioError(
            f"{folder}: holds no {INPUTS}, as `unifg run` writes; of a campaign, name an episode, too"
        ) from None
    except (OSError, ValueError, TypeError) as error:
        raise ScenarioError(f"{file}: is not what `unifg run` has written ({error})") from error
    if not (_are_words(found.words) and isinstance(found.files, dict)):
        raise ScenarioError(
            f"{file}: is not what `unifg run` has written (words {found.words!r}, files {found.files!r})"
        )
    if found.words[:1] not in (["run"], ["solve"]):
        raise ScenarioError(f"{file}: names no run: {found.words!r}")
    return found


def _are_words(words: object) -> bool:
    return isinstance(words, list) and all(isinstance(word, str) for word in words)


def require_files(found: Inputs) -> None:
    """See that what a run has read can be read again.

    Raises:
        ScenarioError: a file is gone.
    """
    for name in found.files:
        if not _is_file(name):
            raise ScenarioError(f"{name}: the run has read this file, which is no longer there (from {Path.cwd()})")


def ended_early(folder: Path) -> bool:
    """Whether a user has ended a run before its end; False where its results do not say."""
    return any(str(value) == "true" for name, value in _numbers(folder) if name == "metrics.json.interrupted")


def differences(first: Path, second: Path) -> tuple[int, list[str]]:
    """How many rows of numbers two folders of results have in common, and where they differ.

    Raises:
        ScenarioError: a file is damaged.
    """
    mine, theirs = dict(_numbers(first)), dict(_numbers(second))
    found = [f"{name}: only in one of them" for name in sorted(mine.keys() ^ theirs.keys())]
    both = [name for name in mine if name in theirs]
    for name in both:
        a, b = mine[name], theirs[name]
        if a.shape != b.shape:
            found.append(f"{name}: {a.shape} and {b.shape}")
        elif a.tobytes() != b.tobytes():
            found.append(f"{name}: {_apart(a, b)}")
    return len(both), found


def _apart(a: Array, b: Array) -> str:
    """From which row on, and by how much."""
    equal = (a == b) | ((a != a) & (b != b))
    if equal.all():
        return "zeros of different signs, or other bits that compare equal"
    row = int(np.argwhere(~equal)[0][0]) if a.ndim else 0
    if a.dtype.kind not in "fiu":
        return f"from row {row} on"
    apart = np.nanmax(np.abs(a.astype(np.float64) - b.astype(np.float64)))
    return f"from row {row} of {len(np.atleast_1d(a))} on, by up to {apart:.3g}"


def _numbers(folder: Path) -> Iterator[tuple[str, Array]]:
    """Everything in a folder that the same run has to repeat, by name.

    Raises:
        ScenarioError: a file is damaged.
    """
    for file in sorted(folder.iterdir()):
        try:
            yield from _of_file(file)
        except (OSError, ValueError, EOFError, BadZipFile) as error:
            raise ScenarioError(f"{file}: cannot be compared ({error})") from error


def _of_file(file: Path) -> Iterator[tuple[str, Array]]:
    if file.suffix == ".npz":
        with np.load(file, allow_pickle=False) as stored:
            for name in stored.files:
                if not CLOCKED.search(name):
                    yield f"{file.name}[{name}]", stored[name]
    elif file.suffix in (".tum", ".g2o", ".csv"):
        yield file.name, np.array(file.read_text(encoding="utf-8").split("\n"))
    elif file.name == "metrics.json":
        yield from _of_json(file.name, json.loads(file.read_text(encoding="utf-8")))


def _of_json(name: str, value: Any) -> Iterator[tuple[str, Array]]:
    if isinstance(value, Mapping):
        for key, inner in value.items():
            if not CLOCKED.search(str(key)):
                yield from _of_json(f"{name}.{key}", inner)
    else:
        yield name, np.array(json.dumps(value))
