"""Campaigns: what a file states, episodes that go wrong in every way, and what is on file when something is killed."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calls import calls_of
from problems import short_walks
from unifg.errors import ScenarioError
from unifg.scenarios import command
from unifg.scenarios.campaigns import campaign as campaigns
from unifg.scenarios.campaigns import replay as replaying
from unifg.scenarios.campaigns import task
from unifg.scenarios.campaigns.campaign import Campaign, run_campaign
from unifg.scenarios.campaigns.journal import Journal, lines_of
from unifg.scenarios.campaigns.replay import episode_of
from unifg.scenarios.campaigns.sheet import load
from unifg.scenarios.campaigns.sources import fingerprint
from unifg.scenarios.campaigns.statement import Episode, Statement, read, stated
from unifg.scenarios.campaigns.task import Task, WrongLibrary, run_task
from unifg.scenarios.episode import silent
from unifg.scenarios.workers import Workers, finished

WALKS = "problems.short_walks"
TESTS = Path(__file__).resolve().parent


def walks(seeds: object = (0, 1, 2), base: Path | str = ".", **entries: Any) -> Statement:
    given = list(seeds) if isinstance(seeds, tuple) else seeds
    return stated({"scenario": WALKS, "seeds": given, **entries}, base, "walks")


@pytest.fixture(autouse=True)
def _one_code(monkeypatch: pytest.MonkeyPatch) -> None:
    """The digest of everything takes seconds; a test that is about it sets another one."""
    for module in (campaigns, replaying):
        monkeypatch.setattr(module, "code_of", lambda statement: "now")


def run(statement: Statement, folder: Path, **options: Any) -> Campaign:
    with ThreadPoolExecutor(1) as executor:
        return run_campaign(statement, folder, executor=options.pop("executor", executor), **options)


def rows(folder: Path) -> list[dict[str, Any]]:
    return list(lines_of(folder / campaigns.EPISODES))


def test_a_line_cut_anywhere_is_mended(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    first, last = b'{"a": 1}\n', '{"b": "ü"}\n'.encode()
    for cut in range(len(last) + 1):
        path.write_bytes(first + last[:cut])
        with Journal(path) as journal:
            complete = cut >= len(last) - 1
            assert bool(journal.mended) == (cut not in (0, len(last)))
            journal.add('{"c": 3}')
        assert list(lines_of(path)) == [{"a": 1}, *([{"b": "ü"}] if complete else []), {"c": 3}]
    path.write_bytes(b"x" * 200_000)
    with Journal(path) as journal:
        journal.add("{}")
    assert path.read_bytes() == b"{}\n"


def test_lines_that_hold_no_row_do_not_count(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    path.write_bytes(b'{"a": 1}\n\0\0\0\n[1]\n\n\xff\xfe\n{"a": 2}\n' + b"[" * 100_000 + b"\n")
    unreadable: list[int] = []
    assert list(lines_of(path, unreadable)) == [{"a": 1}, {"a": 2}]
    assert unreadable == [2, 3, 5, 7]
    assert list(lines_of(tmp_path / "none.jsonl")) == []


def test_one_process_writes_at_a_time(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    with (
        Journal(path),
        pytest.raises(ScenarioError, match=f"process {os.getpid()} on .* is at work here"),
        Journal(path),
    ):
        pass
    with Journal(path):
        pass
    with Journal(tmp_path / campaigns.EPISODES), pytest.raises(ScenarioError, match="at work here"):
        run(walks(), tmp_path)


def test_folders_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ScenarioError, match="cannot write into this folder"):
        run(walks(), tmp_path / "file" / "below")
    (tmp_path / "there" / campaigns.EPISODES).mkdir(parents=True)
    with pytest.raises(ScenarioError, match="cannot be written"):
        run(walks(), tmp_path / "there")


def test_a_full_disk_keeps_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    with Journal(path) as journal:
        journal.add('{"a": 1}')
        before = path.read_bytes()
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) + 5, limits[1]))  # the file can take half of a line
        try:
            with pytest.raises(ScenarioError, match="make room and start the same command again"):
                journal.add('{"b": 2, "c": 3}')
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert path.read_bytes() == before
        journal.add('{"b": 2}')
    assert list(lines_of(path)) == [{"a": 1}, {"b": 2}]


# ---------------------------------------------------------------- one episode


def task_of(behaviour: str, seed: int = 1, sources: str | None = None, **settings: Any) -> Task:
    stated = {"behaviour": behaviour, **settings}
    return Task(WALKS, Episode("key", {}, stated, seed), ".", "now", sources or fingerprint())


@pytest.mark.parametrize(
    ("behaviour", "outcome", "error"),
    [
        ("walk", "ok", None), ("fail", "failed", None), ("nan", "ok", None), ("raise", "error", "Odd('1 and 2')"),
        ("refuse", "error", "ScenarioError: not today"), ("exit", "error", "SystemExit(3)"),
    ],
)  # fmt: skip
def test_an_episode_is_a_line_whatever_happens(behaviour: str, outcome: str, error: str | None) -> None:
    text = run_task(task_of(behaviour))
    assert "\n" not in text and "NaN" not in text
    row = json.loads(text)
    assert (row["outcome"], row.get("error"), row["seed"], row["code"]) == (outcome, error, 1, "now")
    if error is not None:
        assert "short_walks.py" in row["traceback"] and "metrics" not in row
        return
    assert row["metrics"]["length_m"] == pytest.approx(sum(map(abs, row["metrics"]["steps"])))
    assert row.get("not_finite") == (["inside.least"] if behaviour == "nan" else None)
    assert (row["metrics"]["inside"]["least"] is None) == (behaviour == "nan")


def test_settings_that_no_longer_fit_are_an_error() -> None:
    assert json.loads(run_task(task_of("walk", pace="fast")))["error"].startswith(
        "ScenarioError: problems.short_walks: pace"
    )


def test_a_worker_is_warmed_once_for_each_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = calls_of(monkeypatch, short_walks, "run")
    monkeypatch.setattr(task, "_warm", set())
    for number, behaviour in enumerate(("walk", "walk", "fail", "walk")):
        run_task(task_of(behaviour, seed=number, pace=float(number + 1)))
    warming, recorded = ([s.behaviour for s, told in calls if (told is silent) is kept] for kept in (False, True))
    assert warming == ["walk", "fail"]
    assert recorded == ["walk", "walk", "fail", "walk"]


def test_a_worker_with_other_sources_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(WrongLibrary, match="has other sources of unifg"):
        run_task(task_of("walk", sources="0" * 12))
    monkeypatch.setattr(campaigns, "fingerprint", lambda: "0" * 12)
    with pytest.raises(WrongLibrary):
        run(walks(), tmp_path)
    assert rows(tmp_path) == []


# ---------------------------------------------------------------- many of them


class Threads(ThreadPoolExecutor):
    """Threads in the place of processes, which take a second to start."""

    def __init__(self, count: int, ready: object) -> None:
        super().__init__(count)

    def kill(self) -> None:
        self.shutdown(cancel_futures=True)


class Watched(Executor):
    """Does things later, one for every look, and knows how many wait at most."""

    def __init__(self, deaths: int = 0, broken: bool = False) -> None:
        self.pool, self.waiting, self.most, self.deaths, self.broken = ThreadPoolExecutor(1), 0, 0, deaths, broken

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        if self.broken:
            raise BrokenExecutor("gone")
        self.waiting += 1
        self.most = max(self.most, self.waiting)

        def later() -> Any:
            self.waiting -= 1
            if self.deaths:
                self.deaths -= 1
                raise BrokenExecutor("worker 7 ended by signal 9")
            return fn(*args, **kwargs)

        return self.pool.submit(later)


def test_few_of_ten_thousand_are_under_way() -> None:
    executor, taken, ended = Watched(), 0, 0

    def jobs() -> Iterator[int]:
        nonlocal taken
        for job in range(10_000):
            taken += 1
            assert taken - ended <= 6
            yield job

    for job, future in finished(executor, abs, jobs(), lambda: 6):
        assert future.result() == job
        ended += 1
    assert ended == 10_000 and executor.most <= 6


def test_what_a_dead_worker_did_is_done_once_more() -> None:
    found = list(finished(Watched(deaths=1), abs, [-1, -2], lambda: 1))
    assert [(job, future.result()) for job, future in found] == [(-1, 1), (-2, 2)]
    (_, future), (_, other) = finished(Watched(deaths=2), abs, [-1, -2], lambda: 1)
    assert isinstance(future.exception(), BrokenExecutor) and other.result() == 2
    with pytest.raises(ScenarioError, match="takes no more jobs"):
        list(finished(Watched(broken=True), abs, [1], lambda: 1))


def test_a_lost_episode_is_a_row(tmp_path: Path) -> None:
    found = run(walks((1,)), tmp_path, executor=Watched(deaths=2))
    (row,) = rows(tmp_path)
    assert row["outcome"] == "lost" and "worker 7 ended by signal 9" in row["error"]
    assert "0 ok, 0 failed, 0 error, 1 lost" in found.summary and not found.succeeded
    assert run(walks((1,)), tmp_path).ran == 0
    assert run(walks((1,)), tmp_path, again=True).succeeded


def test_a_campaign_goes_on_where_it_stopped(tmp_path: Path) -> None:
    grid = {"behaviour": ["walk", "fail", "raise"]}
    told = list[str]()

    def impatient(done: float, text: str) -> None:
        told.append(text)
        if len(rows(tmp_path)) == 4:
            raise KeyboardInterrupt

    first = run(walks(grid=grid), tmp_path, progress=impatient)
    assert first.interrupted and 4 <= len(rows(tmp_path)) < 9 and "start the same command again" in first.summary
    assert any("left" in text for text in told)
    second = run(walks(grid=grid), tmp_path)
    assert not second.interrupted and first.ran + second.ran == 9 and not second.remarks
    assert len({row["key"] for row in rows(tmp_path)}) == len(rows(tmp_path)) == 9
    assert second.summary == "9 of 9 episodes: 3 ok, 3 failed, 3 error, 0 lost"
    assert run(walks(grid=grid), tmp_path, again=True).ran == 3


@pytest.mark.parametrize(
    "damage",
    [
        {"outcome": "fine"},
        {"outcome": None},
        {"labels": ["walk"]},
        {"settings": 3},
        {"metrics": 3},
        {"seconds": None},
        {"scenario": 0},
        {"key": 1},
        {"seed": "one"},
    ],
)
def test_a_row_that_is_not_whole_does_not_count(tmp_path: Path, damage: dict[str, Any]) -> None:
    run(walks(), tmp_path)
    file = tmp_path / campaigns.EPISODES
    first, *others = file.read_text().splitlines()
    file.write_text("\n".join([json.dumps(json.loads(first) | damage), *others, ""]))
    sheet = load(tmp_path)
    assert len(sheet.episodes) == 2 and sheet.unreadable == [1]
    with pytest.raises(ScenarioError, match=r"no episode .* is on file"):
        episode_of(tmp_path, json.loads(first)["key"])
    again = run(walks(), tmp_path)
    assert again.ran == 1 and again.remarks == ["episodes.jsonl: line 1 cannot be read and does not count"]
    assert again.succeeded and len(load(tmp_path).episodes) == 3


def test_changes_are_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(walks((0, 1)), tmp_path)
    more = run(walks((0, 1, 2)), tmp_path)
    assert more.ran == 1 and more.remarks == [
        "the campaign has changed since it was begun here (seeds): 2 episodes on file still belong to it"
    ]
    fewer = run(walks((0,)), tmp_path)
    assert fewer.ran == 0 and "2 episodes on file are not of this campaign (any more): left alone" in fewer.remarks
    monkeypatch.setattr(campaigns, "code_of", lambda statement: "later")
    assert run(walks((0,)), tmp_path, any_code=True).ran == 0
    changed = run(walks((0,)), tmp_path)
    assert changed.ran == 1 and any("the code has changed (later now, on file 1 of now)" in r for r in changed.remarks)
    with (tmp_path / campaigns.EPISODES).open("ab") as file:
        file.write(b"\0\n")
    (tmp_path / campaigns.MANIFEST).write_text("{")
    assert {r.split(":")[0] for r in run(walks((0,)), tmp_path).remarks} >= {
        campaigns.EPISODES, f"{campaigns.MANIFEST} cannot be read"
    }  # fmt: skip


def test_a_module_that_settings_name_is_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    found = []
    for text in ("", "class Mine: ..."):
        (tmp_path / "myplanner.py").write_text(text)
        fingerprint.cache_clear()
        found.append(campaigns.code_of(walks(settings={"mark": "myplanner:Mine"})))
    assert found[0] != found[1] and campaigns.code_of(walks()) not in found


def test_rows_have_the_labels_of_the_present_file(tmp_path: Path) -> None:
    def load_with(*names: str) -> Any:
        grid = {"which": [{"name": name, "pace": pace} for name, pace in zip(names, (1.0, 2.0), strict=True)]}
        run(walks((0, 1), measures=["length_m"], grid={**grid, "shoes.size": [40, 41]}), tmp_path)
        return load(tmp_path)

    first, turned = load_with("slow", "fast"), load_with("fast", "slow")
    assert len(rows(tmp_path)) == 8, "names are for people: nothing runs again"
    for size in ("40", "41"):
        np.testing.assert_array_equal(
            first.column("length_m", ("slow", size)), turned.column("length_m", ("fast", size))
        )
    renamed = load_with("A", "B")
    assert [sum(renamed.counts(which).values()) for which in renamed.combinations] == [2, 2, 2, 2]


@pytest.mark.product(2, of="processes of their own")
def test_workers_are_processes_of_one_thread_that_are_replaced(tmp_path: Path) -> None:
    mark = tmp_path / "died"
    grid = {"behaviour": ["threads", "die once", "raise"]}
    found = run_campaign(walks((1,), settings={"mark": str(mark)}, grid=grid), tmp_path / "out", workers=1)
    by = {row["labels"]["behaviour"]: row for row in rows(tmp_path / "out")}
    assert found.summary == "3 of 3 episodes: 2 ok, 0 failed, 1 error, 0 lost" and mark.exists()
    assert by["threads"]["metrics"]["threads"] == 1 and by["threads"]["metrics"]["pid"] != os.getpid()
    assert by["die once"]["worker"] != by["threads"]["worker"]


def dies() -> None:
    os._exit(3)


@pytest.mark.product(2, of="processes of their own")
def test_workers_that_cannot_start_are_no_lost_episodes() -> None:
    with pytest.raises(ScenarioError, match="no worker can be started"):
        Workers(1, dies)
    with pytest.raises(ScenarioError, match="at least one worker"):
        Workers(0)


KILLED = """
import sys
from unifg.scenarios.campaigns import campaign
campaign.code_of = lambda statement: "now"
from unifg.scenarios import command
if __name__ == "__main__":
    sys.exit(command.main(sys.argv[1:]))
"""


@pytest.mark.product(2, of="processes of their own")
def test_a_campaign_that_is_killed_loses_and_repeats_nothing(tmp_path: Path) -> None:
    file, script, out = tmp_path / "slow.toml", tmp_path / "killed.py", tmp_path / "out ü"
    file.write_text(f'scenario = "{WALKS}"\nseeds = {{spawn = 40}}\nsettings = {{behaviour = "slow", pace = 0.05}}\n')
    script.write_text(KILLED)
    where = {**os.environ, "PYTHONPATH": os.pathsep.join([str(TESTS), str(TESTS.parent)])}
    process = subprocess.Popen(
        [sys.executable, str(script), "campaign", str(file), "--out", str(out)], env=where, stderr=subprocess.DEVNULL
    )
    deadline = time.monotonic() + 60.0
    while len(rows(out)) < 5:
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    process.kill()
    process.wait()
    kept = rows(out)
    path = out / campaigns.EPISODES
    path.write_bytes(path.read_bytes()[:-7])  # killed in the middle of a line
    worker = int(kept[0]["worker"].rpartition(":")[2])
    while Path(f"/proc/{worker}").exists() and Path(f"/proc/{worker}/status").read_text().find("Z (zombie)") < 0:
        assert time.monotonic() < deadline, "an orphan works on"
        time.sleep(0.05)
    resumed = run(read(file), out)
    assert resumed.ran == 40 - len(kept) + 1 and resumed.remarks[0].startswith("the last line was cut off")
    assert [row["key"] for row in rows(out)][: len(kept) - 1] == [row["key"] for row in kept[:-1]]
    assert len({row["key"] for row in rows(out)}) == len(rows(out)) == 40


def test_a_cluster_runs_a_campaign(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    here = {"n_workers": 2, "threads_per_worker": 1, "processes": False, "protocol": "tcp", "dashboard_address": None}
    with distributed.LocalCluster(**here) as scheduler:
        found = run_campaign(
            walks(tuple(range(10)), grid={"behaviour": ["walk", "exit"]}),
            tmp_path,
            scheduler=scheduler.scheduler_address,
        )
    assert found.summary == "20 of 20 episodes: 10 ok, 0 failed, 10 error, 0 lost"
    with pytest.raises(ScenarioError, match="no scheduler answers at nonsense"):
        run_campaign(walks((99,)), tmp_path, scheduler="nonsense://1")


# ---------------------------------------------------------------- the command


def test_the_command(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(campaigns, "Workers", Threads)
    file, out = tmp_path / "fast.toml", tmp_path / "out"
    file.write_text(f'scenario = "{WALKS}"\nseeds = [1, 2]\n[grid]\nbehaviour = ["walk", "fail"]\n')
    assert command.main(["campaign", str(file), "--out", str(out)]) == 1
    said = capsys.readouterr().out
    assert "4 of 4 episodes: 2 ok, 2 failed" in said and f"unifg report {out}" in said
    file.write_text(f'scenario = "{WALKS}"\nseeds = [1]\n')
    assert command.main(["campaign", str(file), "--out", str(out)]) == 0
    assert "note: the campaign has changed since it was begun here (grid, seeds)" in capsys.readouterr().out
    (key,) = json.loads((out / campaigns.MANIFEST).read_text())["keys"]
    assert command.main(["replay", str(out), key[:6]]) == 0
    assert (out / "replay" / key[:6] / "walk.txt").is_file() and "other code" not in caplog.text
    monkeypatch.setattr(replaying, "code_of", lambda statement: "0123")
    assert command.main(["replay", str(out), key]) == 0
    assert f"{key} was run by other code (now, now 0123): its numbers may differ" in caplog.text
    for words, message in (
        (["replay", str(out), "zzz"], "no episode 'zzz' is on file"),
        (["replay", str(tmp_path), key], "holds no campaign"),
        (["report", str(tmp_path)], "holds no campaign"),
        (["campaign", str(tmp_path / "none.toml")], "cannot be read"),
        (["campaign", str(file), "--workers", "0"], "is not a whole number of at least 1"),
        (["campaign", str(file), "--scheduler", "nonsense://1", "--workers", "2"], "not allowed with"),
    ):
        assert command.main(words) == 2
        assert message in capsys.readouterr().err


def test_signals_end_a_campaign_with_what_there_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaigns, "Workers", Threads)
    file = tmp_path / "slow.toml"
    file.write_text(f'scenario = "{WALKS}"\nseeds = {{spawn = 100}}\nsettings = {{behaviour = "slow", pace = 0.01}}\n')
    for number, stop in enumerate((signal.SIGTERM, signal.SIGINT)):
        out = tmp_path / str(number)
        before = signal.getsignal(stop)
        real = Journal.add

        def added(journal: Journal, line: str, stop: signal.Signals = stop, real: Any = real) -> None:
            real(journal, line)
            if len(line) and sum(1 for _ in lines_of(journal.path)) == 3:
                os.kill(os.getpid(), stop)

        monkeypatch.setattr(Journal, "add", added)
        assert command.main(["campaign", str(file), "--out", str(out)]) == 130
        monkeypatch.setattr(Journal, "add", real)
        assert 3 <= len(rows(out)) < 100 and signal.getsignal(stop) == before


# ---------------------------------------------------------------- what it says


@pytest.mark.product(1, of="scenes and pictures")
def test_a_report_says_what_the_rows_say(tmp_path: Path) -> None:
    from unifg.scenarios.campaigns.report import write_report
    from unifg.scenarios.campaigns.sheet import load

    made = walks(
        tuple(range(6)), title="Walks | <ways> *_& `a_b`", measures=["length_m"],
        grid={"pace": [1.0, 2.0], "behaviour": ["walk", "fail", "raise", "nan"]},
    )  # fmt: skip
    run(made, tmp_path / "a b")
    html, markdown = (path.read_text(encoding="utf-8") for path in write_report(tmp_path / "a b"))
    sheet = load(tmp_path / "a b")
    short, long = (sheet.column("length_m", (pace, "walk")) for pace in ("1", "2"))
    np.testing.assert_allclose(2.0 * short, long)
    std = 100.0 * short.std(ddof=1) / short.mean()
    assert f"| 1 | walk | 6 | {short.mean():.5g} | {short.std(ddof=1):.3g} | {std:.2f} |" in markdown
    assert "| 1 | raise | 0 | - |" in markdown and "| 1 | nan | 6 | 6 | 0 | 0 | 0 | 100 |" in markdown
    assert "| 1 | nan | 0 | - |" in markdown, "what is not finite is not counted as a number"
    assert f"| length_m | 2 - 1 | 18 | +{short.mean():.2g} |" in markdown
    assert markdown.startswith("# Walks \\| \\<ways> \\*\\_\\& \\`a_b\\`\n")
    assert "<h1>Walks | &lt;ways&gt; *_&amp; `a_b`</h1>" in html
    assert "24 failures" in markdown
    failed = next(row for row in rows(tmp_path / "a b") if row["outcome"] == "failed")
    assert f"unifg replay '{tmp_path / 'a b'}' {failed['key']}" in markdown and "arrived: no" in markdown
    assert 'src="data:image/png;base64,' in html and "http" not in html
    for name in ("outcomes.png", "measure-0.png"):
        assert (tmp_path / "a b" / "report" / name).is_file() and f"(report/{name})" in markdown


@pytest.mark.usefixtures("undrawn")
def test_a_report_sets_two_campaigns_side_by_side(tmp_path: Path) -> None:
    from unifg.scenarios.campaigns.report import write_report

    for folder, behaviour in (("old", "walk"), ("new", "fail")):
        grid = {"which": [{"name": "it", "behaviour": behaviour}]}
        run(walks((1, 2), measures=["length_m"], grid=grid), tmp_path / folder)
    text = write_report(tmp_path / "new", tmp_path / "old")[1].read_text()
    assert "| length_m | here - there | 2 | +0 |" in text and "ok there, not here: 2." in text
    text = write_report(tmp_path / "old", tmp_path / "new")[1].read_text()
    new = {row["seed"]: row["key"] for row in rows(tmp_path / "new")}
    assert "ok here, not there: 2." in text and f"unifg replay {tmp_path / 'new'} {new[1]}" in text


@pytest.mark.usefixtures("undrawn")
def test_a_report_of_nothing_yet(tmp_path: Path) -> None:
    from unifg.scenarios.campaigns.report import write_report

    with pytest.raises(ScenarioError):
        run(walks(), tmp_path, executor=Watched(broken=True))
    assert "0 of 3 episodes" in write_report(tmp_path)[1].read_text()


@pytest.mark.parametrize(
    ("below", "text", "why"),
    [
        ("nowhere", None, "there is no such folder"),
        ("a file", None, "campaign.json cannot be read"),
        (".", None, "there is no campaign.json in it"),
        (".", "{", "campaign.json is damaged"),
        (".", "[]", "damaged"),
        (".", "{}", "entries are missing"),
    ],
)
def test_no_campaign_is_a_sentence(below: str, text: str | None, why: str, tmp_path: Path) -> None:
    (tmp_path / "a file").touch()
    if text:
        (tmp_path / "campaign.json").write_text(text)
    with pytest.raises(ScenarioError, match=why) as error:
        campaigns.manifest_of(tmp_path / below)
    assert "Errno" not in str(error.value)


def test_chance_of_differences() -> None:
    from unifg.scenarios.campaigns.comparison import by_chance
    from unifg.scenarios.campaigns.report import _holm

    assert by_chance(np.array([1.0, 1.0, 1.0, 1.0])) == 2 / 16  # all signs alike, one way or the other
    assert by_chance(np.array([1.0, -1.0])) == 1.0 and by_chance(np.zeros(3)) == 1.0
    assert by_chance(np.array([0.3])) == 1.0  # of one pair, either sign is as far
    assert by_chance(np.full(40, 2.0)) == pytest.approx(1 / 4097)
    assert _holm([0.01, 0.04, 0.03]) == [0.03, 0.06, 0.06] and _holm([0.9, 0.8]) == [1.0, 1.0]
