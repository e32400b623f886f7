"""Run the shell commands shown in README.md and docs/*.md in a scratch copy of the checkout: `make fences`.

The commands of one page run in order, as a reader would type them, with the tools of the environment
this script runs in; pages run side by side, and what one printed stands together. `unifg ...` runs for
real. A few commands cannot be repeated here and are replaced by what can be checked of them:

    git clone ...           the scratch copy is already there, one directory below where the page starts
    make TARGET             make --dry-run TARGET: the target exists (tests and demo have runs of their own)
    python -m venv ...      nothing, and nothing for `activate`: an environment is active
    pip install .           pip install --dry-run, without dependencies

Every other command runs as it stands. A fence is left out only by `<!-- skip: reason -->` before it.
"""

import argparse
import io
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import TextIO

CHECKOUT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(CHECKOUT / "tests"))  # one reader of fences and one seed serve the tests and this script

from drawn import seed  # noqa: E402
from fences import SHELL, Fence, documents, fences, relative  # noqa: E402

SHARED = CHECKOUT.parent / "shared"
# A command begins a line, or follows one of && || ; |
_START = r"(?P<start>^\s*|&&\s*|\|\|\s*|;\s*|\|\s*)"
_RULES = [
    (re.compile(_START + r"git clone\b[^&|;]*"), r"\g<start>: "),
    (re.compile(_START + r"(?:source|\.)\s+\S*activate\b"), r"\g<start>:"),
    (re.compile(_START + r"python[\d.]* -m venv\b[^&|;]*"), r"\g<start>: "),
    (re.compile(_START + r"make\b"), r"\g<start>make --dry-run >/dev/null"),
    (
        re.compile(_START + r"(?:python[\d.]* -m )?pip install(?=.*\s[\"']?\.)"),
        r"\g<start>python -m pip install --quiet --dry-run --no-deps --no-build-isolation",
    ),
]
_UNCHECKED = re.compile(_START + r"(?:python[\d.]* -m )?pip install(?! --quiet --dry-run)\b")


def rewrite(line: str) -> str:
    """Replace the commands that cannot be repeated here; the number of lines stays the same.

    Raises:
        ValueError: If the line installs something else than this checkout.
    """
    line = line.replace(".venv/bin/", "")
    if "../shared/" in line and not SHARED.is_dir():
        return f": no ../shared here, not run: {line.strip()}"
    changed = line
    for pattern, replacement in _RULES:
        changed = pattern.sub(replacement, changed)
    if _UNCHECKED.search(changed):
        raise ValueError("installs from elsewhere, not checked: put <!-- skip: reason --> before the fence")
    return changed


def scratch_copy(parent: Path, told: TextIO) -> Path:
    """Clone the checkout; where it holds uncommitted changes, copy what a commit of them would hold."""
    target = parent / "unifg"
    git = ["git", "-C", str(CHECKOUT)]
    status = subprocess.run([*git, "status", "--porcelain"], capture_output=True, text=True, check=False)
    if status.returncode == 0 and not status.stdout:
        subprocess.run(["git", "clone", "--quiet", str(CHECKOUT), str(target)], check=True)
    elif status.returncode == 0:
        print("The checkout holds uncommitted changes: checking a copy of it as it stands", file=told)
        listing = subprocess.run(
            [*git, "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        for name in filter(None, listing.stdout.split("\0")):
            if (CHECKOUT / name).is_symlink() or (CHECKOUT / name).is_file():
                (target / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(CHECKOUT / name, target / name, follow_symlinks=False)
    else:
        shutil.copytree(CHECKOUT, target, symlinks=True, ignore=shutil.ignore_patterns(".venv", "out"))
    if SHARED.is_dir():
        (parent / "shared").symlink_to(SHARED)
    return target


def run_fence(fence: Fence, directory: Path, seconds: float, told: TextIO) -> tuple[Path, str | None]:
    """Run one fence in a directory; what it prints is added to ``told``.

    Returns:
        The directory the fence ended in, and what went wrong, if anything.
    """
    try:
        lines = [rewrite(line) for line in fence.code.splitlines()]
    except ValueError as error:
        return directory, f"{fence.place}: {error}"
    where, failed_at, file = (directory / name for name in (".fence-pwd", ".fence-failed", ".fence.sh"))
    # The page's own lines start on line 2 of the script; the trap turns its line into one of the page.
    place = f"{relative(fence.path)}:$((LINENO + {fence.line - 2}))"
    first = f'set -eEo pipefail; trap \'echo "{place}" >"{failed_at}"\' ERR'
    file.write_text("\n".join([first, *lines, f'pwd >"{where}"', ""]), encoding="utf-8")
    environment = os.environ | {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "MPLBACKEND": "Agg",
    }
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as printed:
        process = subprocess.Popen(
            ["bash", str(file)],
            cwd=directory, env=environment, stdin=subprocess.DEVNULL, stdout=printed, stderr=subprocess.STDOUT,
            start_new_session=True,
        )  # fmt: skip
        try:
            status = process.wait(timeout=seconds)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            return directory, f"{fence.place}: not finished after {seconds:.0f} s"
        finally:
            printed.seek(0)
            told.write(printed.read())
    if status:
        failed = failed_at.read_text(encoding="utf-8").split()[0] if failed_at.exists() else fence.place
        failed_at.unlink(missing_ok=True)
        return directory, f"{failed}: failed with status {status}"
    directory = Path(where.read_text(encoding="utf-8").strip())
    where.unlink()
    return directory, None


def check_page(page: Path, seconds: float) -> tuple[int, int, list[str], str]:
    """Run the shell fences of a page.

    Returns:
        How many were run, how many were skipped, the failures, and what is to be shown.
    """
    told = io.StringIO()
    blocks = [fence for fence in fences(page) if fence.language in SHELL]
    run = skipped = 0
    failures: list[str] = []
    with tempfile.TemporaryDirectory(prefix="unifg-fences-") as parent:
        directory = scratch_copy(Path(parent), told) if blocks else Path(parent)
        if any("git clone" in fence.code for fence in blocks):
            directory = Path(parent)
        for fence in blocks:
            if fence.skip is not None:
                print(f"--- {fence.place}: skipped: {fence.skip}", file=told)
                skipped += 1
                continue
            print(f"--- {fence.place}", fence.code, sep="\n", end="", file=told)
            directory, failure = run_fence(fence, directory, seconds, told)
            run += 1
            failures += [failure] if failure else []
    return run, skipped, failures, told.getvalue()


def main() -> int:
    """Check the pages named on the command line, or all of them; return 0 when every fence passed."""
    parser = argparse.ArgumentParser(description="Run the shell commands shown in the documentation.")
    parser.add_argument("pages", nargs="*", type=Path, help="pages to check (default: README.md and docs/*.md)")
    parser.add_argument("--seconds", type=float, default=300.0, help="time limit of one fence [s]")
    parser.add_argument("--workers", type=int, default=2, help="pages at once")
    parser.add_argument("--half", action="store_true", help="README.md and half of the other pages, drawn by commit")
    options = parser.parse_args()
    run, skipped, failures = 0, 0, list[str]()
    pages = [page.resolve() for page in options.pages] or documents()
    pages = [page for page in pages if any(fence.language in SHELL for fence in fences(page))]
    if options.half:
        pages = pages[:1] + random.Random(seed()).sample(pages[1:], len(pages) // 2)
        print(f"=== of half of the pages, drawn with UNIFG_TEST_SEED={seed()}")
    with ThreadPoolExecutor(options.workers) as pool:
        for counts in pool.map(partial(check_page, seconds=options.seconds), pages):
            run, skipped, failures = run + counts[0], skipped + counts[1], failures + counts[2]
            print(counts[3], end="", flush=True)
    print(f"=== shell fences: {run} run, {skipped} skipped, {len(failures)} failed")
    for failure in failures:
        print(failure)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
