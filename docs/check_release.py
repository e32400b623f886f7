"""Build what is released, twice, and try it where nothing else is: `make release-build`, part of `make release-check`.

Both builds begin with a copy of what git tracks and end in dist/: a wheel, and an sdist whose times, owners and order
are made the same. They have to be equal to the last bit, within the size that the page of releases allows.
Then, with every Python that the classifiers name and this machine has, the wheel has to solve and answer
`unifg doctor` in an environment of its own, and with its extras pass `TESTS` and the tests of promises, drive, and
solve a file, in a folder without sources: with the newest of all packages, and with the lowest where these have wheels
for that Python, as they must for the oldest. What could not be tried is said.

`--no-install` builds only, for the rest fetches packages; `--python 3.12` (repeated) chooses among the Pythons;
`--newest` leaves the lowest packages out, `--lowest` the newest.
"""

from __future__ import annotations

import argparse
import glob
import gzip
import hashlib
import io
import os
import re
import runpy
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import tomllib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parent.parent
TESTS = (  # what needs no checkout: names, every backend on problems with known answers, files, processes
    "test_public.py", "test_doctor.py", "test_choice.py", "test_solvers.py", "test_processes.py", "test_g2o.py",
    "test_trajectories.py",
)  # fmt: skip
TRIAL = """
import sys
import numpy as np, unifg as fg
assert fg.__file__.startswith(sys.prefix), fg.__file__
graph = fg.Graph()
x = graph.variables("x", fg.SE2, 3)
graph.fix(x[0], [0, 0, 0])
graph.minimize(fg.between, x[:-1], x[1:], [1.0, 0.0, 0.3], sigma=0.1)
assert fg.solve(graph, {x: np.zeros((3, 3))}, check=True).converged
print(fg.__version__)
"""
POSES = """VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 1.1 0 0
VERTEX_SE2 2 1 1.1 1.5
EDGE_SE2 0 1 1 0 1.57 500 0 0 500 0 500
EDGE_SE2 1 2 1 0 0 500 0 0 500 0 500
EDGE_SE2 0 2 1 1 1.57 500 0 0 500 0 500
"""
# Without wheels for a Python, pip says one of these; and where a lower bound names what nobody has published, which is
# told apart by the oldest Python: what is lowest has wheels for it.
NO_WHEELS = re.compile(r"No matching distribution found for|ResolutionImpossible")


def main() -> int:
    """Build, compare, weigh, try."""
    parser = argparse.ArgumentParser(description="Build what is released, twice, and try it.")
    parser.add_argument("--no-install", action="store_true", help="build and compare only")
    parser.add_argument("--python", action="append", choices=named(), help="one of those that the classifiers name")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--newest", action="store_true", help="leave the lowest packages out")
    which.add_argument("--lowest", action="store_true", help="leave the newest packages out")
    chosen = parser.parse_args()
    epoch = os.environ.get("SOURCE_DATE_EPOCH") or run("git", "log", "-1", "--format=%ct", cwd=CHECKOUT).strip()
    with tempfile.TemporaryDirectory() as home:
        builds = [built(Path(home) / name, epoch) for name in ("once", "again")]
        first, second = ({path.name: path.read_bytes() for path in paths} for paths in builds)
        different = [name for name in first.keys() | second.keys() if first.get(name) != second.get(name)]
        if different:
            print(f"two builds differ: {', '.join(sorted(different))}")
            return 1
        folder = CHECKOUT / "dist"
        folder.mkdir(exist_ok=True)
        for name, content in first.items():
            (folder / name).write_bytes(content)
            print(f"{folder / name}: {len(content) / 1e6:.1f} MB, sha256 {hashlib.sha256(content).hexdigest()}")
        heavy = list(too_large({name: len(content) for name, content in first.items()}))
        if heavy:
            print("\n".join(heavy))
            return 1
        if chosen.no_install:
            return 0
        (wheel,) = (folder / name for name in first if name.endswith(".whl"))
        (sdist,) = (folder / name for name in first if name.endswith(".tar.gz"))
        cases = [case for case, left in (("newest", chosen.lowest), ("lowest", chosen.newest)) if not left]
        return installed(wheel, sdist, Path(home), chosen.python or named(), cases)


def installed(wheel: Path, sdist: Path, home: Path, wanted: Iterable[str], cases: Sequence[str]) -> int:
    """Try a wheel with every Python that is there, for each of `cases`; 1 where there is none, or one fails."""
    failed, tried, oldest = list[str](), 0, named()[0]
    for minor in wanted:
        python = interpreter(minor, candidates(minor))
        if python is None:
            print(f"Python {minor}: NOT TRIED, none that builds environments was found on this machine")
            continue
        for packages in cases:
            case = f"Python {minor} with the {packages} packages"
            began = time.monotonic()
            try:
                said = trial(wheel, sdist, python, home / f"{minor}-{packages}", packages == "lowest")
            except Failed as failure:
                if packages == "lowest" and minor != oldest and NO_WHEELS.search(str(failure)):
                    print(f"{case}: NOT TRIED, not all of them have wheels for it")
                    continue
                failed.append(case)
                print(f"{case}: FAILED\n{failure}", flush=True)
                continue
            tried += 1
            print(f"{case} ({time.monotonic() - began:.0f} s): {said}", flush=True)
            shutil.rmtree(home / f"{minor}-{packages}")
    if failed:
        print(f"failed: {', '.join(failed)}")
    elif not tried:
        print("the wheel was tried nowhere")
    return int(bool(failed) or not tried)


def named() -> list[str]:
    """The Pythons of the classifiers, as 3.11."""
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    found = (re.fullmatch(r"Programming Language :: Python :: (3\.\d+)", line) for line in project["classifiers"])
    return [match[1] for match in found if match]


def candidates(minor: str) -> Iterator[str]:
    """Candidates for a Python interpreter: this one, the path, pyenv's and uv's."""
    yield sys.executable
    yield f"python{minor}"
    for place in (f"~/.pyenv/versions/{minor}.*", f"~/.local/share/uv/python/cpython-{minor}.*"):
        yield from sorted(glob.glob(os.path.expanduser(f"{place}/bin/python{minor}")), reverse=True)


def interpreter(minor: str, among: Iterable[str]) -> str | None:
    """The first that starts, is of this version and builds environments with pip."""
    asked = "import sys, venv, ensurepip; print('%d.%d' % sys.version_info[:2])"
    for python in among:
        try:
            done = subprocess.run([python, "-I", "-c", asked], capture_output=True, text=True, check=False)
        except OSError:
            continue
        if done.returncode == 0 and done.stdout.strip() == minor:
            return python
    return None


class Failed(SystemExit):
    """A command that has ended with an error; what it said."""


def run(*command: str | Path, cwd: Path, **environment: str) -> str:
    """Run a command, without what leads Python elsewhere; what it said, if it fails."""
    kept = {
        k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "UNIFG_CACHE_DIR")
    }
    done = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env=kept | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"} | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise Failed(f"{' '.join(map(str, command))}\n{done.stdout}\n{done.stderr}")
    return done.stdout


def built(home: Path, epoch: str) -> list[Path]:
    """Wheel and sdist of what git tracks, made in a folder of its own."""
    home.mkdir()
    archive = subprocess.run(["git", "archive", "HEAD"], cwd=CHECKOUT, capture_output=True, check=True).stdout
    with tarfile.open(fileobj=io.BytesIO(archive)) as tracked:
        tracked.extractall(home, filter="tar")
    run(sys.executable, "-m", "build", "--no-isolation", ".", cwd=home, SOURCE_DATE_EPOCH=epoch, PYTHONHASHSEED="0")
    (sdist,), (wheel,) = (home / "dist").glob("*.tar.gz"), (home / "dist").glob("*.whl")
    sdist.write_bytes(evened(sdist.read_bytes(), int(epoch)))
    return [sdist, wheel]


def evened(archive: bytes, epoch: int) -> bytes:
    """A packed archive with its members in order, at one time and of nobody; setuptools writes those of the day."""
    inner = io.BytesIO()
    with tarfile.open(fileobj=io.BytesIO(archive)) as old, tarfile.open(fileobj=inner, mode="w") as new:
        for member in sorted(old.getmembers(), key=lambda one: one.name):
            content = old.extractfile(member) if member.isfile() else None
            member.mtime, member.uid, member.gid, member.uname, member.gname = epoch, 0, 0, "", ""
            member.mode = 0o755 if member.mode & 0o100 else 0o644
            member.pax_headers = {}
            new.addfile(member, content)
    return gzip.compress(inner.getvalue(), mtime=epoch)


def too_large(sizes: dict[str, int]) -> Iterator[str]:
    """Messages on files, by name, that have more bytes than docs/reference/releases.md allows."""
    for name, size in sizes.items():
        kind = "wheel" if name.endswith(".whl") else "sdist"
        if size > 1e6 * allowed(kind):
            yield f"{name} has {size / 1e6:.1f} MB, more than the {allowed(kind):g} MB that the page of releases allows"


def allowed(kind: str) -> float:
    """Megabytes that docs/reference/releases.md allows."""
    found = re.search(
        rf"^\| {kind} \| (\d+) MB \|$", (CHECKOUT / "docs/reference/releases.md").read_text(), flags=re.MULTILINE
    )
    if found is None:
        raise SystemExit(f"docs/reference/releases.md does not say how large a {kind} may be")
    return float(found[1])


def trial(wheel: Path, sdist: Path, python: str, home: Path, lowest: bool) -> str:
    """Install a wheel alone, then with its extras, and use it; what it has shown."""
    run(python, "-m", "venv", home / "environment", cwd=CHECKOUT)
    scripts = home / "environment" / ("Scripts" if os.name == "nt" else "bin")
    pip: list[str | Path] = [scripts / "python", "-m", "pip", "--disable-pip-version-check", "install", "--quiet"]
    quiet = list[str]()
    if lowest:
        (home / "lowest.txt").write_text(run(sys.executable, "tests/lowest.py", cwd=CHECKOUT), encoding="utf-8")
        pip += ["--constraint", home / "lowest.txt", "--only-binary", ":all:"]
        quiet = ["-W", "ignore::DeprecationWarning"]  # what is old calls what is new in ways deprecated since
    run(*pip, wheel, cwd=home)
    version = run(scripts / "python", "-I", "-c", TRIAL, cwd=home).strip()
    well = run(scripts / "unifg", "doctor", cwd=home).strip().split("\n")[-1]

    run(*pip, f"{wheel}[scenarios,test]", cwd=home)
    with tarfile.open(sdist) as archive:
        archive.extractall(home, filter="data")
    (source,) = home.glob("unifg-*")
    (home / "away").mkdir()
    shutil.move(source / "tests", home / "away")
    shutil.move(source / "pyproject.toml", home / "away")  # what pytest is told
    shutil.rmtree(source)
    paths = [
        f"tests/{name}" for name in (*TESTS, *runpy.run_path(str(home / "away" / "tests" / "promises.py"))["NODES"])
    ]
    summary = (
        run(scripts / "python", "-I", "-m", "pytest", "-q", *quiet, *paths, cwd=home / "away").strip().split("\n")[-1]
    )

    run(scripts / "unifg", "run", "navigation", "--obstacles", "1", "--seed", "0", "--out", "drive", cwd=home / "away")
    (home / "away" / "three.g2o").write_text(POSES, encoding="utf-8")
    run(scripts / "unifg", "solve", "three.g2o", "--out", "solved", cwd=home / "away")
    for file in ("drive/scene.html", "drive/metrics.json", "solved/metrics.json"):
        if not (home / "away" / file).is_file():
            raise Failed(f"the wheel has not written {file}")
    return f"unifg {version} solves alone; doctor: {well}; {summary}; a drive and a file of poses"


if __name__ == "__main__":
    raise SystemExit(main())
