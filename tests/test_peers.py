"""Page of the peers: tables of made-up contestants, answers that are not compared, and the environment."""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("casadi", reason="the judge evaluates with casadi, which comes with the extra 'bench'")
from benchmarks import peers, runner
from benchmarks.control_loops import STEPS
from benchmarks.own_functions import stated
from benchmarks.peers import HOME, compared, rendered
from problems.control import Tick, Unicycle
from unifg.solvers import InteriorPoint


class Fake:
    """A contestant with an answer and a time that never changes."""

    iterations = 3

    def __init__(self, answer: Any, seconds: float, status: str = "converged") -> None:
        self.answer, self.seconds, self.status = answer, seconds, status

    def __call__(self) -> float:
        return self.seconds


def test_answers_are_compared_only_where_the_judge_accepts_both() -> None:
    fakes = {
        "ours": Fake((0.0, 1.0), 1e-3), "good": Fake((9e-5, 1.009), 4e-3), "limit": Fake((0.0, 1.0), 4e-3, "limit"),
        "outside": Fake((2e-4, 0.5), 4e-3), "other": Fake((0.0, 1.02), 4e-3), "nan": Fake((np.nan, np.nan), 4e-3),
    }  # fmt: skip
    results = peers.cold(fakes, lambda *judged: judged, 3)
    text = rendered({"case": results}, ["ours"], peers.WHOLE, "left out", peers.MEDIAN)
    assert "| case | good | 0.250 (0.250 to 0.250) |" in text
    assert "| case | good | accepted | 3 | 4.00 | - | 9.0e-05 | 1.009 |" in text
    reasons = {"limit": "limit", "outside": "violates by 0.0002", "other": "costs 2.0 % more", "nan": "violates by nan"}
    for name, reason in reasons.items():
        assert f"| case | {name} | peer: {reason} |" in text
    assert compared(results, "outside", "good", np.asarray) == "ours: violates by 0.0002"


def test_judge_knows_an_optimum_and_what_is_outside() -> None:
    for problem in (Unicycle("straight", True, 20), peers.problems()[-1]):
        ours = peers.on(problem, InteriorPoint(tolerance=1e-6))
        assert ours() > 0.0
        violation, cost = peers.judge(problem, *ours.answer)
        assert violation < 1e-6 and cost == pytest.approx(problem.optima[0], rel=1e-5)
        for part, index in ((0, (3, 1)), (1, (4, 0))):
            moved = [part.copy() for part in ours.answer]
            moved[part][index] += 1e-2
            assert 1e-4 < peers.judge(problem, *moved)[0] < 2e-2
    free = peers.on(Unicycle("straight", False, 20), InteriorPoint())
    free()
    violation, cost = peers.judge(Unicycle("straight", True, 20), *free.answer)
    assert violation > 0.1  # through a disc
    assert cost == pytest.approx(6.40874, rel=1e-4)


def test_loops_are_driven_in_turn_and_failures_end_the_comparison() -> None:
    problem = peers.problems()[0]
    ours = peers.Whole(stated(problem, "numpy"), peers.LOOPS["InteriorPoint, safe"])

    def broken(state: Any, index: int) -> Tick:
        return Tick(ours.control(state, 0).control, 1.0, 1, "QP failure" if index == 7 else "converged")

    results = peers.race(problem, {"ours": ours.control}, 2) | peers.race(problem, {"peer": broken}, 1)
    assert results["ours"].times.shape == (2, STEPS)
    assert results["ours"].cost == pytest.approx(6.5994, rel=1e-3)
    assert not results["ours"].refused()
    assert compared(results, "ours", "peer", peers.TAILS[", mean"]) == "peer: 1 x QP failure"
    assert 0.02 < peers.compiled_share(problem, ours.control) < 1.0


@pytest.mark.product(2, of="processes of their own")
def test_page_is_left_out_without_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(peers, "HOME", tmp_path)
    monkeypatch.setattr(runner, "RESULTS", tmp_path)
    assert runner.main(["peers"]) == 0
    assert "build it with `make peers`" in capsys.readouterr().out
    assert not list(tmp_path.iterdir())
    (tmp_path / "bin").mkdir()
    python = tmp_path / "bin" / "python"
    python.write_text(f'#!/bin/sh\nexec "{sys.executable}" "$@"\n')
    python.chmod(0o755)
    (tmp_path / "ready").touch()
    monkeypatch.setattr(peers, "PARTS", {"Machine": None})
    text = peers.STUDY.run("peers", argparse.Namespace(rounds=None))
    assert text.startswith("### Machine\n\nMeasured at commit")


@pytest.mark.skipif(not (HOME / "ready").is_file(), reason="the peers' environment is built by `make peers`")
def test_acados_reaches_the_listed_optimum() -> None:
    code = (
        "from benchmarks.peers import judge, problems\n"
        "from benchmarks.acados_peer import Acados\n"
        "peer = Acados(problems()[0], 1e-4)\n"
        "print(peer() < 0.1, peer.status, *judge(peer.problem, *peer.answer))\n"
    )
    run = subprocess.run([HOME / "bin" / "python", "-c", code], cwd=HOME.parent, capture_output=True, text=True)
    *words, violation, cost = run.stdout.split()
    assert words == ["True", "converged"], run.stderr
    assert float(violation) < 1e-6 and float(cost) == pytest.approx(6.40874, rel=1e-5)
