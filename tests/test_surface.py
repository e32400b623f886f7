"""The public surface is listed and frozen, the version is stated once, licences of what is installed are known."""

from __future__ import annotations

import importlib
import importlib.util
import re
import sys
from importlib import metadata

import pytest

from scripts import CHECKOUT

sys.path.insert(0, str(CHECKOUT / "docs" / "site"))

import licences
import reference
import surface


def test_no_name_comes_or_goes_unseen() -> None:
    listed = surface.PAGE.read_text(encoding="utf-8")
    assert listed == surface.text(), (
        "the public surface has changed: python docs/site/surface.py, and say so in CHANGELOG"
    )


def test_every_listed_name_can_be_imported() -> None:
    for module, names in reference.public().items():
        if module in ("unifg.torch", "unifg.jax") and not importlib.util.find_spec(module.removeprefix("unifg.")):
            continue  # of an extra that is not installed
        found = importlib.import_module(module)
        assert [name for name in names if not hasattr(found, name)] == [], module


def test_every_dependency_has_a_licence_on_the_page() -> None:
    page = licences.PAGE.read_text(encoding="utf-8")
    named = set(re.findall(r"^\| ([\w.-]+) \|", page, flags=re.MULTILINE))
    assert {licences.plain(name) for name in licences.stated()} <= named, "python docs/site/licences.py"
    assert "unknown" not in page


def test_what_is_not_installed_is_not_left_off_the_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """pymetis once went that way, without a word."""
    monkeypatch.setattr(licences, "stated", lambda: {"numpy": "unifg", "no-such-package": "`unifg[metis]`"})
    with pytest.raises(SystemExit, match=r"no-such-package.*pip install"):
        licences.closure()


def test_packages_of_other_platforms_are_not_on_the_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression test: the listing of colorama depended on which other package had installed it."""
    monkeypatch.setattr(licences, "stated", lambda: {"numpy": "unifg", "scipy": "unifg"})
    needs = {"scipy": ["numpy>=1", "colorama; sys_platform == 'beos'", "tqdm; extra == 'nice'"], "numpy": []}
    monkeypatch.setattr(metadata, "requires", needs.__getitem__)
    assert licences.closure() == {"numpy": "unifg", "scipy": "unifg"}
