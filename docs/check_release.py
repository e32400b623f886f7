"""Build what is released, twice, and try it where nothing else is: part of `make release-check`.

Both builds begin with a copy of what git tracks and end in dist/: a wheel, and an sdist whose times, owners and order
are made the same. They have to be equal to the last bit, within the size that docs/releases.md allows, and the wheel
has to solve and answer `unifg doctor` in an environment of its own (`--no-install` leaves that out, for it fetches
packages).
"""

from __future__ import annotations

import gzip
import hashlib
import io
import os
import re
import subprocess
import sys
import tarfile
import tempfile
import venv
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parent.parent
TRIAL = """
import numpy as np, unifg as fg
graph = fg.Graph()
x = graph.variables("x", fg.SE2, 3)
graph.fix(x[0], [0, 0, 0])
graph.minimize(fg.between, x[:-1], x[1:], [1.0, 0.0, 0.3], sigma=0.1)
assert fg.solve(graph, {x: np.zeros((3, 3))}, check=True).converged
print(fg.__version__)
"""


def main() -> int:
    """Build, compare, weigh, try."""
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
            kind = "wheel" if name.endswith(".whl") else "sdist"
            size, most = len(content) / 1e6, allowed(kind)
            print(f"{folder / name}: {size:.1f} MB, sha256 {hashlib.sha256(content).hexdigest()}")
            if size > most:
                print(f"that is more than the {most:g} MB that docs/releases.md allows")
                return 1
        if "--no-install" not in sys.argv:
            (wheel,) = (folder / name for name in first if name.endswith(".whl"))
            tried(wheel, Path(home) / "clean")
    return 0


def run(*command: str | Path, cwd: Path, **environment: str) -> str:
    """Run a command; what it said, if it fails."""
    done = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, command))}\n{done.stdout}\n{done.stderr}")
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


def allowed(kind: str) -> float:
    """Megabytes that docs/releases.md allows."""
    found = re.search(
        rf"^\| {kind} \| (\d+) MB \|$", (CHECKOUT / "docs" / "releases.md").read_text(), flags=re.MULTILINE
    )
    if found is None:
        raise SystemExit(f"docs/releases.md does not say how large a {kind} may be")
    return float(found[1])


def tried(wheel: Path, home: Path) -> None:
    """Install a wheel with nothing else, solve with it, and let it examine itself."""
    venv.create(home, with_pip=True)
    scripts = home / ("Scripts" if os.name == "nt" else "bin")
    run(scripts / "python", "-m", "pip", "--disable-pip-version-check", "install", "--quiet", wheel, cwd=home)
    print(f"installed alone: unifg {run(scripts / 'python', '-I', '-c', TRIAL, cwd=home).strip()} solves")
    print(run(scripts / "unifg", "doctor", cwd=home).strip().split("\n")[-1])


if __name__ == "__main__":
    raise SystemExit(main())
