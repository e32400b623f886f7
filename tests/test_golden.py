"""The golden file: what counts as the same, and what fails a comparison."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from tools import golden

BEFORE = golden.Row("CONVERGED", 7, 2.5, "0123456789abcdef")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({}, "same"),
        ({"digest": "other", "cost": 2.5 * (1.0 + 1e-12)}, "rounding"),
        ({"digest": "other", "cost": 2.5001}, "2.5 -> 2.5001"),
        ({"digest": "other", "iterations": 8}, "7 -> 8 iterations"),
        ({"digest": "other", "status": "STALLED"}, "CONVERGED -> STALLED"),
        ({"iterations": 8}, "7 -> 8 iterations"),
    ],
)
def test_a_change_is_named(change: dict[str, object], said: str) -> None:
    assert replace(BEFORE, **change).change(BEFORE) == said  # type: ignore[arg-type]


def test_what_was_recorded_compares_equal_and_anything_else_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "golden.json"
    rows = {"a": BEFORE, "b": replace(BEFORE, cost=3.0)}
    monkeypatch.setitem(golden.PARTS, "control", lambda: ((name, partial(rows.__getitem__, name)) for name in rows))
    asked = ["--parts", "control", "--file", str(file)]
    assert golden.main(["compare", *asked]) == 2, "nothing recorded yet"
    assert golden.main(["record", *asked]) == 0
    assert golden.main(["compare", *asked]) == 0
    assert "2 rows the same to the bit" in capsys.readouterr().out

    rows["b"] = replace(rows["b"], digest="other", cost=3.1)
    assert golden.main(["compare", *asked]) == 1
    assert "control: b: 3.0 -> 3.1" in capsys.readouterr().out

    del rows["b"]
    assert golden.main(["compare", *asked]) == 1
    assert "control: b: is gone" in capsys.readouterr().out
    assert len(json.loads(file.read_text())) == 2


def test_rows_of_real_solves_repeat_to_the_bit(shared_data: Path) -> None:
    tasks = dict(list(golden.of_ecg2o())[:7])
    assert [task() for task in tasks.values()] == [task() for task in tasks.values()]
