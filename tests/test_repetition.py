"""``unifg replay DIR``: a run again, the same to the last bit, or what differs and from where on."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from unifg.errors import ScenarioError
from unifg.scenarios import command
from unifg.scenarios.commands import repetition
from unifg.scenarios.commands.repetition import Inputs, differences, inputs, read_inputs, write_inputs


def results(folder: Path, state: np.ndarray[tuple[int, ...], np.dtype[np.float64]], took: float) -> Path:
    """As a run leaves them."""
    folder.mkdir()
    np.savez(folder / "log.npz", state=state, solve_ms=np.full(len(state), took), names=np.array(["a", "b"]))
    (folder / "metrics.json").write_text(json.dumps({"cost": 1.5, "solve_ms": {"p50": took}, "ways": [1, None]}))
    (folder / "trajectory.tum").write_text("0.0 1.0\n")
    (folder / "scene.html").write_text(str(took))  # drawn of the others
    return folder


def test_numbers_are_compared_to_the_last_bit(tmp_path: Path) -> None:
    state = np.linspace(0.0, 1.0, 12).reshape(6, 2)
    state[2, 0] = np.nan
    first = results(tmp_path / "first", state, 1.0)
    count, found = differences(first, results(tmp_path / "same", state, 2.0))
    assert (count, found) == (5, []), "clocks do not count, NaN is NaN"
    other = state.copy()
    other[4, 1] = np.nextafter(other[4, 1], 2.0)
    count, found = differences(first, results(tmp_path / "other", other, 1.0))
    assert found == ["log.npz[state]: from row 4 of 6 on, by up to 1.11e-16"]
    _, found = differences(first, results(tmp_path / "short", state[:3], 1.0))
    assert found == ["log.npz[state]: (6, 2) and (3, 2)"]
    other = state.copy()
    other[0, 0] = -0.0
    (said,) = differences(first, results(tmp_path / "sign", other, 1.0))[1]
    assert "zeros of different signs" in said
    changed = results(tmp_path / "less", state, 1.0)
    (changed / "trajectory.tum").unlink()
    (changed / "metrics.json").write_text(json.dumps({"cost": 1.25, "ways": [1, None]}))
    assert differences(first, changed)[1] == ["trajectory.tum: only in one of them", "metrics.json.cost: from row 0 on"]


def test_inputs_are_words_and_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("graph.g2o").write_text("nothing")
    found = inputs(["solve", "graph.g2o", "--out", "a", "--live", "--seed=3", "--out=b"], 3, "1.0", "abc")
    assert found.words == ["solve", "graph.g2o", "--seed=3"]
    assert list(found.files) == ["graph.g2o"]
    assert read_inputs(write_inputs(tmp_path, found).parent) == found
    Path("graph.g2o").write_text("something")
    later = inputs(found.words, 4, "1.1", "abc")
    assert found.changed(later) == [
        "version: 1.0 then, 1.1 now", "settings: 3 then, 4 now", "graph.g2o: another content",
    ]  # fmt: skip
    rest = {"settings": "", "version": "", "sources": "", "machine": ""}
    numbers, nothing = ({"words": ["solve", 5], "files": {}} | rest), ({"words": ["solve", "a"], "files": None} | rest)
    for text in ("{}", "[", "null", '{"words": []}', json.dumps(numbers), json.dumps(nothing)):
        (tmp_path / "inputs.json").write_text(text)
        with pytest.raises(ScenarioError, match="is not what"):
            read_inputs(tmp_path)
    write_inputs(tmp_path, Inputs(["campaign", "x"], {}, "", "", "", ""))
    with pytest.raises(ScenarioError, match="names no run"):
        read_inputs(tmp_path)
    with pytest.raises(ScenarioError, match="name an episode, too"):
        read_inputs(tmp_path / "nowhere")


def test_a_run_is_repeated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "out"
    assert command.main(["run", "velocity-tracking", "--out", str(folder)]) == 0
    assert str(folder / "inputs.json") in capsys.readouterr().out
    assert command.main(["replay", str(folder)]) == 0
    assert "the same to the last bit" in capsys.readouterr().out
    numbers = json.loads((folder / "metrics.json").read_text())
    name = next(
        key for key, value in numbers.items() if isinstance(value, float) and not repetition.CLOCKED.search(key)
    )
    (folder / "metrics.json").write_text(json.dumps(numbers | {name: 1.0 + numbers[name]}))
    written = read_inputs(folder)
    write_inputs(folder, Inputs(**(vars(written) | {"machine": "an abacus"})))
    assert command.main(["replay", str(folder), "--out", str(tmp_path / "again")]) == 1
    out = capsys.readouterr().out
    assert f"differs: metrics.json.{name}" in out
    assert "note: machine: an abacus then" in out
    assert command.main(["replay", str(tmp_path)]) == 2
    capsys.readouterr()
    before = (folder / "metrics.json").read_bytes()
    assert command.main(["replay", str(folder), "--out", str(tmp_path / "again" / ".." / "out")]) == 2
    assert "would write over the run" in capsys.readouterr().err
    assert (folder / "metrics.json").read_bytes() == before
    (folder / "metrics.json").write_text("{")
    assert command.main(["replay", str(folder), "--out", str(tmp_path / "again")]) == 2
    assert "metrics.json: cannot be compared" in capsys.readouterr().err
    (folder / "metrics.json").write_text(json.dumps(numbers | {"interrupted": True}))
    assert command.main(["replay", str(folder), "--out", str(tmp_path / "again")]) == 1
    assert "note: its user ended the first run early" in capsys.readouterr().out


def test_files_that_a_run_read_and_that_have_moved_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gone = str(tmp_path / "grün und blau.g2o")
    write_inputs(tmp_path, Inputs(["solve", gone], {gone: "0"}, "", "", "", ""))
    assert command.main(["replay", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert f"{gone}: the run has read this file, which is no longer there" in error
    assert "understood" not in error
