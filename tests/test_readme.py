"""The first screen of README.md: a short example that prints what stands below it, links that outlive a checkout."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

import pytest

from fences import PYTHON, fences
from scripts import CHECKOUT, loaded

README = CHECKOUT / "README.md"
PICTURES = re.compile(r"docs/images/[\w/-]+\.(?:gif|png)")


def test_the_first_example_is_short_and_prints_what_it_says() -> None:
    blocks = list(fences(README))
    first = next(k for k, block in enumerate(blocks) if block.language in PYTHON)
    lines = [line for line in blocks[first].code.splitlines() if line.strip()]
    assert len(lines) <= 15
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile("\n".join(lines), str(README), "exec"), {})
    times = re.compile(r"\d[\d.]* ms")
    assert times.sub("", printed.getvalue()) == times.sub("", blocks[first + 1].code.rstrip("\n") + "\n")


def test_the_demo_is_what_pages_say() -> None:
    makefile = (CHECKOUT / "Makefile").read_text(encoding="utf-8")
    (words,) = re.findall(
        r"^demo: .*\n\t\S+unifg (run .*--coupling joint.*) --seed 0 --out out/demo$", makefile, re.MULTILINE
    )
    for page in ("README.md", "docs/results/navigation.md"):
        assert f"unifg {words} " in (CHECKOUT / page).read_text(encoding="utf-8"), page


def test_the_film_is_small_and_moves() -> None:
    image = pytest.importorskip("PIL.Image")
    film = CHECKOUT / "docs" / "images" / "demo.gif"
    assert film.stat().st_size < 1_000_000
    with image.open(film) as frames:
        assert frames.n_frames > 20


def described(repository: str | None) -> str:
    """README.md as a package index gets it."""
    text: str = loaded(CHECKOUT / "setup.py").described(README.read_text(encoding="utf-8"), repository, "1.2.3")
    return text


def test_pictures_and_links_survive_a_package_index() -> None:
    assert described(None) == README.read_text(encoding="utf-8")
    text = described("https://example.org/owner/unifg/")
    pictures = PICTURES.findall(README.read_text(encoding="utf-8"))
    assert len(pictures) >= 3
    for name in pictures:
        assert Path(CHECKOUT / name).is_file()
        assert f"https://example.org/owner/unifg/raw/v1.2.3/{name}" in text
    assert "](https://example.org/owner/unifg/blob/v1.2.3/docs/guide/tutorial.md)" in text
    assert "](https://gtsam.org)" in text, "what is absolute stays"
    assert not re.search(r'\]\((?![a-z]+:|#)|(?:src|srcset)="(?!https:)', text)
