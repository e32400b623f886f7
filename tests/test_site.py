"""The site: every page has a place in it, every public name an entry."""

from __future__ import annotations

import importlib
import sys

import pytest
import yaml

import unifg as fg
from scripts import CHECKOUT

sys.path.insert(0, str(CHECKOUT / "docs" / "site"))

import reference


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    """Text of every page that is made."""
    return reference.pages()


def test_every_page_has_a_place(pages: dict[str, str]) -> None:
    sections = yaml.safe_load((CHECKOUT / "mkdocs.yml").read_text())["nav"]
    listed = [page for section in sections for own in section.values() if isinstance(own, list) for page in own]
    written = {path.relative_to(CHECKOUT / "docs").as_posix() for path in (CHECKOUT / "docs").rglob("*.md")}
    made = {name for name in pages if name.endswith(".md") and not name.startswith("api/")}
    assert sorted(listed) == sorted((written | made) - {"license.md"})


@pytest.mark.product(1)
@pytest.mark.parametrize("room", ["unifg", "unifg.solvers", "unifg.horizon", "unifg.pose_graphs", "unifg.view"])
def test_every_public_name_has_an_entry(room: str, pages: dict[str, str]) -> None:
    page = pages[f"api/{room}.md"]
    for name in importlib.import_module(room).__all__:
        assert f"::: {room}.{name}\n" in page or f"## {name}\n" in page, name
    assert room in pages["api/index.md"]


def test_every_module_of_the_shelves_that_has_public_names_has_a_page() -> None:
    for shelf in ("unifg.models", "unifg.files"):
        for name in importlib.import_module(shelf).__all__:
            assert (f"{shelf}.{name}" in reference.public()) == bool(reference.names_of(f"{shelf}.{name}"))
    assert "chordal" in reference.public()["unifg.pose_graphs"]


def test_residuals_say_what_help_says() -> None:
    for module, name in (("unifg", "between"), ("unifg.models.unicycle", "tracking"), ("unifg.pose_graphs", "bearing")):
        assert reference.told(module, name) == getattr(importlib.import_module(module), name).__doc__
    assert reference.told("unifg", "Graph") is None
    between = reference.entry("unifg", "between")
    assert "**Args**" in between and "- measured:" in between and fg.between.__doc__ is not None
