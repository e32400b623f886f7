"""``make performance`` fails for what is slower twice, beside the last commit that changed the record."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import pytest

from tools import performance as compare


class Timed:
    """A side of a comparison: seconds of each case by how often it was asked, the last for all that follow."""

    def __init__(self, **seconds: list[float]) -> None:
        self.cases, self.asked, self._seconds = list(seconds), dict.fromkeys(seconds, 0), seconds

    def seconds(self, case: str) -> float:
        self.asked[case] += 1
        own = self._seconds[case]
        return own[min(self.asked[case], len(own)) - 1]


def test_a_commit_is_slower_where_it_is_so_twice(capsys: pytest.CaptureFixture[str]) -> None:
    rounds = 5
    now = Timed(same=[1.1], worse=[1.2], at_first=[1.3] * rounds + [1.0], new=[1.0])
    then = Timed(same=[1.0], worse=[1.0], at_first=[1.0], gone=[1.0])
    sides: Any = now, then
    assert compare.slower(sides, rounds) == ["worse"]
    assert now.asked == {"same": rounds, "worse": 5 * rounds, "at_first": 5 * rounds, "new": 0}
    assert capsys.readouterr().out.count("SLOWER") == 3
    assert compare.slower((sides[1], sides[0]), rounds) == [], "faster is no loss"


def test_the_last_commit_that_changed_the_record_is_accepted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def git(*words: str) -> str:
        who = ["-c", "user.name=a", "-c", "user.email=a@b"]
        return subprocess.run(["git", *who, *words], cwd=tmp_path, check=True, capture_output=True, text=True).stdout

    monkeypatch.setattr(compare, "CHECKOUT", tmp_path)
    assert compare.accepted() is None, "no history"
    git("init", "-q", ".")
    record = tmp_path / compare.RECORD
    record.parent.mkdir(parents=True)
    for text in ("first", "second"):
        record.write_text(text)
        git("add", ".")
        git("commit", "-qm", text)
    (tmp_path / "other").write_text("later")
    git("add", ".")
    git("commit", "-qm", "later")
    assert compare.accepted() == git("rev-parse", "HEAD~1").strip()
    code = compare.unpacked(str(compare.accepted()), tmp_path / "out")
    assert (code / compare.RECORD).read_text() == "second" and not (code / "other").exists()
