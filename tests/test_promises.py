"""Promises: a row of the list is shown by tests, which the check of a release runs from the installed wheel."""

import re
from pathlib import Path

import pytest

from promises import NODES, PROMISES
from scripts import CHECKOUT


@pytest.mark.parametrize("node", NODES)
def test_tests_of_promises_exist(node: str) -> None:
    file, _, name = node.partition("::")
    assert f"\ndef {name}(" in (CHECKOUT / "tests" / file).read_text(encoding="utf-8")


def test_every_row_of_the_list_is_shown(shared_reference: Path) -> None:
    rows = re.findall(r"^\| ([\d-]+) \|", (shared_reference / "promises.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert rows == list(PROMISES)
