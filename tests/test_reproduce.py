"""``unifg reproduce``: what it lists and refuses, what its lines say beside the printed numbers, and that it runs."""

from __future__ import annotations

import re
from collections import Counter
from functools import cache
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from unifg.errors import ScenarioError
from unifg.scenarios import command, manoeuvres
from unifg.scenarios.campaigns.campaign import Campaign
from unifg.scenarios.campaigns.statement import Statement
from unifg.scenarios.campaigns.task import FAILED, OK
from unifg.scenarios.episode import Progress
from unifg.scenarios.papers import barrier_flights, bazzana, catalogue, corridor_flights, ecg2o, factormpc, ta
from unifg.scenarios.papers.barrier_flights import Job
from unifg.scenarios.papers.comparison import Comparison, Effort, Line, counted, measured, paired, stated
from unifg.scenarios.papers.printed import numbers, pairs, printed

ITEMS = [(paper, item) for paper, found in catalogue.PAPERS.items() for item in found]
# Legs of 170 m take minutes: `test_a_quick_campaign_...` looks at what is run.
ERRORS = (bazzana.POSITION, bazzana.HEADING)
LONG = [("bazzana", "--table I"), ("bazzana", "--table II"), ("factormpc", "--figure 10")]  # more than a minute each
MINUTE = ("bazzana", "--figure 6")  # three legs of 170 m
SHORT = [(paper, item) for paper, item in ITEMS if (paper, item.option) not in [*LONG, MINUTE]]


class Least(Effort):
    """Two runs at most."""

    def of(self, few: int, many: int) -> int:
        return min(few, 2)


def effort(tmp_path: Path, quick: bool = True) -> Effort:
    return (Least if quick else Effort)(quick, tmp_path, 1, lambda done, text: None)


def consistent(line: Line) -> bool:
    """The difference is that of the numbers shown, and the interval holds ours."""
    ours = re.match(r"-?\d+(?:\.\d+)?", line.ours)
    ends = re.fullmatch(r"(-?[\d.]+) to (-?[\d.]+)", line.interval)
    if ends is not None and ours is not None and not float(ends[1]) <= float(ours[0]) <= float(ends[2]):
        return False
    if not re.fullmatch(r"[+-][\d.]+", line.difference):
        return line.difference in ("-", "agrees", "differs", "undecided")
    assert ours is not None
    low, *rest = (float(word) for word in line.paper.partition(" ±")[0].split(" to "))
    nearest = min(max(float(ours[0]), low), (rest or [low])[-1])
    places = len(line.difference.partition(".")[2])
    return abs(float(line.difference) - (float(ours[0]) - nearest)) <= 1.1 * 10.0**-places


def test_all_tables_and_figures_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["reproduce"]) == 0
    text = capsys.readouterr().out
    for paper, found in catalogue.PAPERS.items():
        assert f"{paper}: {printed()[paper]['title']}" in text
        for item in found:
            assert re.search(rf"  {item.option} +{re.escape(item.summary)}", text)
    assert command.main(["reproduce", "ta"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == ["ta:", "--figure", "--figure"]


def test_every_listed_item_has_a_function_and_the_reverse() -> None:
    for paper, found in catalogue.PAPERS.items():
        module = import_module(f"unifg.scenarios.papers.{paper}")
        functions = {name for name in vars(module) if re.match(r"(table|figure)_", name)}
        assert functions == {f"{item.kind}_{item.number.lower()}" for item in found}
        assert catalogue.found(paper, found[0].kind, found[0].number.lower()).__name__ in functions


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["gtsam"], "there is no paper 'gtsam' that can be reproduced; there are bazzana, ta, factormpc, ecg2o"),
        (["bazana", "--table", "I"], "there is no paper 'bazana' that can be reproduced; there are bazzana, ta,"),
        (["ecg2o", "--table", "2"],
         "ecg2o has no table '2' that can be reproduced; there are --table 1, --figure 3, --figure 4, --figure 5"),
        (["ta", "--table", "5"], "ta has no table '5' that can be reproduced; there are --figure 3, --figure 5"),
        (["--figure", "5"], "name the paper of --figure 5: bazzana, ta, factormpc, ecg2o"),
        (["ta", "--figure", "5", "--table", "1"], "argument --table: not allowed with argument --figure"),
        (["ta", "--figure", "5", "--quick", "--full"], "argument --full: not allowed with argument --quick"),
    ],
)  # fmt: skip
def test_unknown_names_are_refused_by_name(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["reproduce", *arguments]) == 2
    assert said in capsys.readouterr().err


def test_a_table_is_printed_beside_the_paper(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The printed numbers stand here once more, so that a change of papers.toml fails."""
    table = ["reproduce", "ecg2o", "--table", "1", "--out", str(tmp_path)]
    assert command.main(table) == 0
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in capsys.readouterr().out.splitlines()]
    assert lines[0] == ["quantity", "paper", "ours", "difference", "95 % interval"]
    rows = lines[2:7]
    assert [row[1] for row in rows] == ["5", "20", "20", "72", "73"]
    assert rows[0][2:4] == ["7.33", "+2.33"] and all(consistent(Line(*row)) for row in rows)
    assert "6 starts" in lines[-1][0]
    monkeypatch.setitem(printed()["ecg2o"]["section 5.2, Table 1"], "kkt", "average of 9 iterations")
    changed = ecg2o.table_1(effort(tmp_path)).lines[0]
    assert (changed.paper, changed.difference) == ("9", "-1.67")


def test_differences_are_to_the_printed_number_or_the_nearer_end() -> None:
    assert measured("a", [3.0, 4.0], [5.0, 6.0, 7.0]) == Line("a", "3 to 4", "6.00", "+2.00", "5.00 to 7.00")
    assert measured("a", [3.0, 4.0], [3.5]) == Line("a", "3 to 4", "3.50", "+0.00", "-")
    assert measured("a", [3.0, 4.0], [2.5], 1).difference == "-0.5"
    assert measured("a", [10.0], [9.0, 11.0, np.nan], 1, 0.25) == Line(
        "a", "10 ± 0.25", "10.0 ± 1.4 (2 of 3)", "+0.0", "9.0 to 11.0"
    )
    assert measured("a", [], [1.0]) == Line("a", "-", "1.00", "-", "-")
    assert measured("a", [1.0], [np.nan]) == Line("a", "1", "-", "-", "-")


def test_statements_hold_do_not_or_are_undecided() -> None:
    assert stated("a", "text", "ours", False) == Line("a", "text", "ours", "differs", "-")
    apart = np.array([1.0, 2.0, 3.0, 2.0])
    assert paired("a", "farther", apart, 1.0).difference == "agrees"
    assert paired("a", "nearer", apart, -1.0).difference == "differs"
    assert paired("a", "nearer", -apart, -1.0) == Line("a", "nearer", "-2.00", "agrees", "-2.75 to -1.25")
    assert paired("a", "farther", np.array([-2.0, 3.0, -1.0]), 1.0).difference == "undecided"
    assert counted("a", "always", 9, 10).difference == "differs" and counted("a", "always", 9, 9).difference == "agrees"
    assert counted("a", "often", 5, 10, 0.5) == Line("a", "often", "5 of 10", "undecided", "24 to 76 %")
    assert [counted("a", "often", hits, 100, 0.5).difference for hits in (80, 20)] == ["agrees", "differs"]


@pytest.mark.product(1)
@pytest.mark.parametrize(("paper", "item"), SHORT, ids=[f"{paper} {item.option}" for paper, item in SHORT])
def test_an_item_runs(paper: str, item: catalogue.Item, tmp_path: Path) -> None:
    check_item(paper, item, tmp_path)


@pytest.mark.product(0)
def test_an_item_of_a_minute_runs(tmp_path: Path) -> None:
    check_item(MINUTE[0], next(item for _, item in ITEMS if item.option == MINUTE[1]), tmp_path)


def check_item(paper: str, item: catalogue.Item, tmp_path: Path) -> None:
    try:
        found = catalogue.found(paper, item.kind, item.number)(effort(tmp_path))
    except ScenarioError as error:
        assert "velocity_profile_388.csv" in str(error)
        pytest.skip("the profile of the paper is not here")
    texts = {text for place in printed()[paper].values() if isinstance(place, dict)
             for text in place.values()}  # fmt: skip
    assert found.lines and found.runs and str(found).count("\n") == len(found.lines) + 3
    for line in found.lines:
        assert consistent(line), line
        assert re.fullmatch(r"-|[\d.]+( to [\d.]+| ± [\d.]+)?", line.paper) or any(line.paper in t for t in texts)
    assert any(line.paper != "-" for line in found.lines) or item.option == "--figure 5"


def test_figure_eights_are_compared_in_pairs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    flown: list[Any] = []

    def flights(effort: Effort, jobs: list[Any]) -> list[dict[str, float]]:
        """Plans are 10 mm better than flatness at 1 and 2 m/s, and as much worse at 3 m/s."""
        flown.extend(jobs)
        better = {1.0: -0.01, 2.0: -0.01, 3.0: 0.01}
        return [{"error": 0.05 + 0.001 * job.seed + better[job.speed] * (job.controller == "barrier")} for job in jobs]

    monkeypatch.setattr(factormpc, "_flown", flights)
    found = factormpc.figure_10(effort(tmp_path))
    assert len(flown) == 12 and len({(job.controller, job.speed, job.seed) for job in flown}) == 12
    assert [line.difference for line in found.lines[2::3]] == ["agrees", "agrees", "differs"]
    assert [float(line.ours.split()[0]) for line in found.lines[2::3]] == pytest.approx([-10.0, -10.0, 10.0])


def drives(runs: int) -> pd.DataFrame:
    """Drives that are 1 m longer, 2 m in every other run, than the paper's; one of them failed."""
    rows = [
        {"planner": "ours, sequential", "table": "I", "leg": leg, "seed": seed, "outcome": OK,
         bazzana.LENGTH: mean + 1.0 + seed % 2, bazzana.DURATION: 100.0}
        for seed in range(runs) for leg, (mean, _) in pairs("bazzana", "Table I (a), Ours").items()
    ]  # fmt: skip
    return pd.DataFrame([*rows, {**rows[0], "outcome": FAILED, bazzana.LENGTH: 0.0}])


def test_a_quick_campaign_ends_in_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ended = 1

    def run(part: Statement, folder: Path, workers: int, progress: Progress) -> Campaign:
        found = Campaign(folder, 9, Counter(ok=ended) if ended else Counter())
        try:
            progress(0.1, "first drive")
        except KeyboardInterrupt:
            found.interrupted = True
        return found

    def stop(done: float, text: str) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(bazzana, "run_campaign", run)
    monkeypatch.setattr(bazzana, "load", lambda folder, failed_too: None)
    monkeypatch.setattr(bazzana, "drives_of", lambda sheet, name: drives(1))
    assert len(bazzana.driven(effort(tmp_path), "department", 2)) == 9
    assert len(bazzana.driven(effort(tmp_path, quick=False), "department", 2, patience=-1.0)) == 9
    assert len(bazzana.driven(effort(tmp_path), "department", 2, patience=-1.0)) == 9
    # of the user, who wants no other base either
    with pytest.raises(KeyboardInterrupt, match=r"; drives in .*bazzana-department-light: 1"):
        bazzana.driven(Effort(True, tmp_path, 1, stop), "department", 2)
    ended = 0
    with pytest.raises(ScenarioError, match="no drive has ended within -1 s"):
        bazzana.driven(effort(tmp_path), "department", 2, patience=-1.0)


def test_legs_are_compared_with_their_own_column(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[Any, ...]] = []

    def driven(*given: Any) -> pd.DataFrame:
        asked.append(given)
        return drives(4 if "light" in given else 2)

    monkeypatch.setattr(bazzana, "driven", driven)
    found = bazzana.table_i(effort(tmp_path))
    lines = {line.what: line for line in found.lines}
    assert len(lines) == 2 * (16 + 2) and all(map(consistent, found.lines))
    assert [given[4] for given in asked] == ["light", "harsh"] and sum(given[5] for given in asked) < 280.0
    assert lines["AC, length [m]"] == Line(
        "AC, length [m]", "175.42 ± 0.68", "176.92 ± 0.58", "+1.50", "176.42 to 177.42"
    )
    assert lines["EA, duration [s]"].paper == "108.74 ± 1.37" and lines["EA, duration [s]"].difference == "-8.74"
    assert lines["AC, length [m], lagging and slipping base"].ours == "176.92 ± 0.71"
    spread = lines["deviation of length, mean of legs [%]"]
    means = [mean for mean, _ in pairs("bazzana", "Table I (a), Ours").values()]
    assert spread.paper == "0.6" and spread.ours == f"{np.mean([100.0 / 3.0**0.5 / (m + 1.5) for m in means]):.2f}"
    assert found.runs.startswith("Runs of each leg: 4 to 5, 32 of 33 succeeded. Runs of each leg, lagging and slipping")


def test_the_mean_deviation_of_the_department_is_no_number_of_the_factory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    factory = drives(4)[lambda found: found["leg"].isin(["AB", "BC", "CD", "DE"])]
    monkeypatch.setattr(bazzana, "driven", lambda *given: factory)
    lines = {line.what: line for line in bazzana.table_ii(effort(tmp_path)).lines}
    for what in ("length", "duration"):
        line = lines[f"deviation of {what}, mean of legs [%]"]
        assert line.paper == line.difference == "-" and line.ours != "-"


def test_an_interrupt_names_the_drives_that_are_on_file(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(_: Effort) -> Comparison:
        raise KeyboardInterrupt("; drives in here: 3")

    monkeypatch.setattr(catalogue, "found", lambda *_: stop)
    assert command.main(["reproduce", "bazzana", "--table", "I"]) == 130
    assert capsys.readouterr().err.endswith("unifg: interrupted; drives in here: 3\n")


@pytest.mark.parametrize(("there", "said"), [(1.0, "agrees"), (0.4, "differs")])
def test_speeds_count_where_the_way_inflects(
    there: float, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The paper's is greatest in the inflection; here the greatest of the whole way counted, wherever it was."""
    made = SimpleNamespace(
        controls=np.array([[1.0, 0.5], [there, 0.1], [there, -0.1]]), time=np.arange(3.0), cusps=[1], inflections=[2],
        within_limits=True,
    )  # fmt: skip
    monkeypatch.setattr(manoeuvres, "run_manoeuvre", lambda case, solver: made)
    assert [line.difference for line in bazzana.figure_7(effort(tmp_path)).lines] == ["agrees", "agrees", said] * 2


def test_a_solve_that_does_not_end_has_no_iterations(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that stopped at the third iteration agreed with the paper's three to four."""
    monkeypatch.setattr(ecg2o, "drive", lambda length, drag: None)
    monkeypatch.setattr(ecg2o, "iterations", lambda solver, problem: (3, False))
    assert {line.ours for line in ecg2o.figure_3(effort(tmp_path)).lines} == {"-"}


def test_times_of_flights_are_those_of_a_warm_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first tick of a process took half a second, beside less than 20 ms in the paper."""
    flown: list[float] = []
    real = Job.flight

    def flight(job: Job) -> Any:
        flown.append(job.duration)
        return real(job)

    monkeypatch.setattr(Job, "flight", flight)
    barrier_flights.fly(study="times", case="ellipse", duration=2.1)
    assert flown == [0.5, 2.1]


@cache
def whole_campaign(name: str) -> tuple[tuple[int | None, ...], set[str]]:
    """Seeds of a campaign as the page of results has it, and keys of its episodes."""
    campaign = bazzana.campaign(name)
    return campaign.seeds, {episode.key for episode in campaign.episodes()}


@pytest.mark.parametrize("quick", [True, False])
def test_a_quick_campaign_is_a_part_of_the_whole_one(
    quick: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[Statement] = []

    def run(part: Statement, folder: Path, **how: Any) -> Campaign:
        ran.append(part)
        return Campaign(folder, 1, Counter(ok=1))

    monkeypatch.setattr(bazzana, "run_campaign", run)
    monkeypatch.setattr(bazzana, "load", lambda folder, failed_too: None)
    monkeypatch.setattr(bazzana, "drives_of", lambda sheet, name: drives(2).iloc[:0].assign(**dict.fromkeys(ERRORS)))
    for function in (bazzana.table_i, bazzana.table_ii, bazzana.figure_6):
        function(effort(tmp_path, quick))
    whole = [whole_campaign(name) for name in ("department", "factory", "department")]
    assert [part.fixed.get("plant") for part in ran] == [None, "harsh"] * 2 + [None]
    for part, (seeds, keys), legs in zip(ran[::2], whole, (8, 4, 3 if quick else 8), strict=True):
        assert part.seeds == seeds[: 2 if quick else 30]
        episodes = list(part.episodes())
        assert {episode.labels["coupling"] for episode in episodes} == {"sequential"}
        assert len({episode.labels["leg"] for episode in episodes}) == legs
        assert {episode.key for episode in episodes} <= keys


def test_efforts_are_smaller_when_quick(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Flights of both efforts, counted without being flown."""
    flown: list[Any] = []

    def fly(**job: Any) -> dict[str, Any]:
        flown.append(job)
        return {"boundary": 0.1 * job["gamma"] + 0.3 / job["alpha"], "error": 1.0 + (job["controller"] == "flatness"),
                "margin_kept": True, "arrived": True, "decide_ms": [1.0, 12.0]}  # fmt: skip

    def fly_through(**job: Any) -> dict[str, Any]:
        flown.append(job)
        spread = {"rms": 0.03}
        return {"mass": {"5": [-0.02, 0.01]}, "metrics": {
            "succeeded": True, "position_error_m": spread, "velocity_error_m_per_s": spread, "min_clearance_m": 0.3,
            "tick_ms": {"p50": 10.0},
        }}  # fmt: skip

    monkeypatch.setattr(factormpc, "fly", fly)
    monkeypatch.setattr(corridor_flights, "fly", fly_through)
    few_and_many = {
        factormpc.figure_5: (10, 40), factormpc.figure_6: (10, 40), factormpc.figure_7: (6, 20),
        factormpc.figure_8: (5, 100), factormpc.figure_10: (12, 60), factormpc.figure_11: (4, 11), ta.figure_5: (8, 50),
    }  # fmt: skip
    results: dict[str, Comparison] = {}
    for function, counts in few_and_many.items():
        for quick, count in zip((True, False), counts, strict=True):
            flown.clear()
            results[function.__name__] = function(Effort(quick, tmp_path, 1, lambda done, text: None))
            assert len(flown) == count, (function.__name__, quick)
    (far,) = numbers("factormpc", "Fig. 5", "far")
    beside = factormpc.figure_5(effort(tmp_path)).lines
    assert beside[1] == Line(f"least distance, alpha {far:g} [mm]", "-", "1000", "-", "1000 to 1000")
    assert beside[2].ours == "750" and beside[2].difference == "agrees"
    assert [line.difference for line in results["figure_7"].lines] == ["-", "agrees", "+1.10", "-49.60"]
    assert [line.difference for line in results["figure_10"].lines[2::3]] == ["agrees"] * 3
