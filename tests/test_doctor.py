"""``unifg doctor`` finds what is wrong, ``unifg bench`` what has become slower, and neither cries wolf."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unifg as fg
from unifg.codegen.cache_folder import VARIABLE
from unifg.codegen.objects import write_sealed
from unifg.errors import ScenarioError
from unifg.scenarios import command
from unifg.scenarios.commands import doctor, performance
from unifg.scenarios.commands.doctor import Finding
from unifg.scenarios.commands.performance import Record


def record(scale: float = 1.0, noise: float = 0.05, machine: str = "here", seed: int = 0) -> Record:
    """Two cases, one of which takes ``scale`` times what it does elsewhere."""
    rng = np.random.default_rng(seed)
    rows = {"a": scale * (1.0 + noise * rng.standard_normal(21)), "b": 2.0 + 2.0 * noise * rng.standard_normal(21)}
    return Record("0.1.0", "2026-01-01", machine, {"a": scale, "b": 2.0}, {k: v.tolist() for k, v in rows.items()})


def said(findings: Iterator[Finding] | list[Finding], good: bool | None) -> list[str]:
    return [finding.text for finding in findings if finding.good is good]


def test_a_loss_is_told_from_noise() -> None:
    def slower(now: Record, then: Record) -> list[str]:
        return [name for name, row in performance.compared(now, then).items() if row.slower]

    assert slower(record(1.3, seed=1), record()) == ["a"]
    assert slower(record(1.1, seed=1), record()) == [], "less than is asked for"
    assert slower(record(1.3, noise=0.9, seed=1), record(noise=0.9)) == [], "nobody knows"
    assert slower(record(0.5, seed=1), record()) == []
    a = performance.compared(record(1.3, seed=1), record())["a"]
    assert a.low < a.factor < a.high and abs(a.factor - 1.3) < 0.1


def test_records_go_to_a_file_and_back(tmp_path: Path) -> None:
    file = tmp_path / "history.jsonl"
    for machine in ("here", "there", "here"):
        performance.append(file, record(machine=machine))
    found = performance.history(file)
    assert [one.machine for one in found] == ["here", "there", "here"]
    np.testing.assert_allclose(found[0].ratios["a"], record().ratios["a"], atol=1e-4)
    assert performance.last(found, "there") is found[1]
    assert performance.last(found) is found[2]
    assert performance.last(found, "nowhere") is None
    file.write_text(file.read_text() + '{"version": 1}\n')
    with pytest.raises(ScenarioError, match="no record"):
        performance.history(file)
    with pytest.raises(ScenarioError, match="cannot be read"):
        performance.history(tmp_path / "none")
    file.write_bytes(b"\xfc\x00")
    with pytest.raises(ScenarioError, match="no record"):
        performance.history(file)


@pytest.mark.parametrize("ratios", ["[]", '{"a": []}', '{"a": 1.0}', '{"a": ["b"]}', '{"a": [0.0]}'])
def test_records_without_ratios_are_refused(tmp_path: Path, ratios: str) -> None:
    file = tmp_path / "history.jsonl"
    file.write_text('{"version": "", "when": "", "machine": "", "milliseconds": {}, "ratios": ' + ratios + "}")
    with pytest.raises(ScenarioError, match="is no record"):
        performance.history(file)


@pytest.mark.parametrize(("scale", "machine", "status"), [(1.0, "here", 0), (1.4, "here", 1), (1.4, "there", 0)])
def test_bench_fails_for_a_loss_on_a_machine_of_the_same_kind(
    scale: float, machine: str, status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    file, kept = tmp_path / "history.jsonl", tmp_path / "now.jsonl"
    performance.append(file, record())
    monkeypatch.setattr(performance, "measured", lambda rounds, progress: record(scale, machine=machine, seed=1))
    words = ["bench", "--quick", "--against", str(file), "--record", str(kept)]
    assert command.main([*words, "--strict"]) == status
    out = capsys.readouterr().out
    assert ("SLOWER" in out) == (scale > 1.0)
    assert ("another machine (here)" in out) == (machine == "there")
    assert len(performance.history(kept)) == 1
    assert command.main(words) == 0, "only when it is asked to be strict"
    monkeypatch.setattr(performance, "measured", lambda rounds, progress: pytest.fail("measured in vain"))
    assert command.main([*words[:-1], str(tmp_path / "absent" / "now.jsonl")]) == 2


def test_the_record_that_ships_is_one() -> None:
    shipped = performance.last(performance.history())
    assert shipped is not None
    assert {f"backend {name}" for name, _, _ in performance.self_tests()} < shipped.ratios.keys()


def test_every_case_can_be_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    now = performance.measured(1, lambda done, text: None)
    shipped = performance.last(performance.history())
    assert shipped is not None and now.ratios.keys() == shipped.ratios.keys(), "record anew: unifg bench --record"
    assert all(len(row) == 1 and row[0] > 0.0 for row in now.ratios.values())
    assert performance.report(now, performance.compared(now, shipped)).count("\n") == len(now.ratios)


@pytest.mark.product(2, of="processes of their own")
def test_a_healthy_installation_is_called_well(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["doctor"]) == 0
    out = capsys.readouterr().out
    assert out.rstrip().endswith("all is well")
    for words in ("unifg ", "numba ", "compiled functions", "cores for this process", "ipm      right"):
        assert words in out


def test_wrong_backends_are_named(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    tests = list(performance.self_tests())
    name, solve, right = tests[-1]

    def broken() -> fg.Solution:
        raise MemoryError("no room")

    def slow() -> fg.Solution:
        for _ in range(400):  # which share a workspace
            solve()
        return solve()

    monkeypatch.setattr(
        performance, "self_tests", lambda: [(name, solve, right + 1.0), ("gn", broken, 0.0), (name, slow, right)]
    )
    found = list(doctor._backends())
    assert [finding.good for finding in found] == [False, False, None]
    assert "wrong: CONVERGED, cost 0.085786" in found[0].text
    assert "MemoryError: no room" in found[1].text
    monkeypatch.setattr(doctor, "examined", lambda progress: iter(found))
    assert command.main(["doctor"]) == 1
    assert "2 things are wrong (X)" in capsys.readouterr().out


def test_caches_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert said(doctor._cache(tmp_path), None) == ["nothing is compiled yet: `unifg warmup` does it beforehand"]
    write_sealed(tmp_path / "a.1.code", b"code")
    assert said(doctor._cache(tmp_path), True)[1] == "all of them read and whole"
    (tmp_path / "b.2.code").write_bytes(b"half of a file")
    (text,) = said(doctor._cache(tmp_path), None)
    assert text.startswith("1 of 2 damaged")
    (tmp_path / "c.3.code").symlink_to(tmp_path / "absent")
    (text,) = said(doctor._cache(tmp_path), None)
    assert text.startswith("2 of 3 damaged")
    monkeypatch.setattr(doctor, "cache_folder", lambda: None)
    assert VARIABLE in said(doctor._caches(), False)[0]


def test_what_is_missing_is_named_with_what_it_is_for(monkeypatch: pytest.MonkeyPatch) -> None:
    true_version, true_spec = doctor._version, find_spec

    def version(package: str) -> Any:
        return None if package == "osqp" else true_version(package)

    def spec(module: str) -> Any:
        return None if module == "pymunk" else true_spec(module)

    monkeypatch.setattr(doctor, "_version", version)
    monkeypatch.setattr("unifg.scenarios.commands.doctor.find_spec", spec)
    found = list(doctor._versions())
    assert said(found, False) == ["missing: osqp; install unifg again"]
    assert "pymunk is not installed; it is for simulated worlds: unifg[scenarios]" in said(found, None)


def test_threads_that_wait_for_each_other_are_mentioned(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert said(doctor._threads(), None) == []
    monkeypatch.delenv("OMP_NUM_THREADS")
    assert "OMP_NUM_THREADS=1" in said(doctor._threads(), None)[0]
    assert replace(Finding("a", "b"), good=None).good is None
