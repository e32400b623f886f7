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
from unifg.scenarios.campaigns import task
from unifg.scenarios.campaigns.campaign import Campaign, run_campaign
from unifg.scenarios.campaigns.journal import Journal, lines_of
from unifg.scenarios.campaigns.replay import episode_of
from unifg.scenarios.campaigns.sheet import load
from unifg.scenarios.campaigns.sources import fingerprint
from unifg.scenarios.campaigns.stated_settings import identity
from unifg.scenarios.campaigns.statement import Episode, Statement, read, spawned, stated
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
    monkeypatch.setattr(campaigns, "code_of", lambda statement: "now")


def run(statement: Statement, folder: Path, **options: Any) -> Campaign:
    with ThreadPoolExecutor(1) as executor:
        return run_campaign(statement, folder, executor=options.pop("executor", executor), **options)


def rows(folder: Path) -> list[dict[str, Any]]:
    return list(lines_of(folder / campaigns.EPISODES))


# ---------------------------------------------------------------- what is stated


def test_a_file_may_extend_another(tmp_path: Path) -> None:
    (tmp_path / "base.toml").write_text(
        f'scenario = "{WALKS}"\nseeds = {{spawn = 3, from = 7}}\n[settings]\nshoes.size = 40\nshoes.grip = 0.5\n'
        '[grid]\npace = [0.5, 1]\n[[grid.leg]]\nname = "A"\nway = [0, 1]\n'
    )
    (tmp_path / "more.toml").write_text(
        'extends = "base.toml"\nseeds = {spawn = 2}\nsettings.shoes.grip = 1\ngrid.pace = [2]\n'
    )
    first, more = read(tmp_path / "base.toml"), read(tmp_path / "more.toml")
    assert more.seeds == first.seeds[:2] and more.title == "more"
    assert next((e.labels, e.settings) for e in more.episodes()) == (
        {"pace": "2", "leg": "A"}, {"shoes.size": 40, "shoes.grip": 1, "pace": 2, "ways": [0, 1]},
    )  # fmt: skip
    same = stated(more.given, tmp_path)  # what the folder of a campaign keeps of it needs the file no longer
    assert [e.key for e in same.episodes()] == [e.key for e in more.episodes()]
    cases = (
        ("loop", 'extends = "back.toml"', "extends itself: loop.toml, back.toml, loop.toml"),
        ("back", 'extends = "loop.toml"', "extends itself"),
        ("self", 'extends = "self.toml"', "extends itself: self.toml, self.toml"),
        ("away", 'extends = "../base.toml"', "a file of the same folder"),
        ("gone", 'extends = "nothing.toml"', "nothing.toml: cannot be read"),
        ("odd", "extends = 3", "a file of the same folder, got 3"),
    )
    for name, text, _ in cases:
        (tmp_path / f"{name}.toml").write_text(text)
    for name, _, message in cases:
        with pytest.raises(ScenarioError, match=message):
            read(tmp_path / f"{name}.toml")


def test_a_grid_is_every_combination_with_every_seed() -> None:
    legs = [{"name": "A", "ways": [[0, 1]], "shoes": {"size": 40}}, {"name": "B", "way": [0, 2]}]
    made = walks((3, 4), settings={"behaviour": "walk"}, grid={"pace": [0.5, 1], "leg": legs})
    episodes = list(made.episodes())
    assert len(made) == len(episodes) == 8
    assert [(e.labels["pace"], e.labels["leg"], e.seed) for e in episodes][:5] == [
        ("0.5", "A", 3), ("0.5", "B", 3), ("1", "A", 3), ("1", "B", 3), ("0.5", "A", 4),
    ]  # fmt: skip
    assert episodes[0].settings == {"behaviour": "walk", "pace": 0.5, "ways": [[0, 1]], "shoes.size": 40}
    assert made.compare == ("pace",) and walks(compare=["leg"], grid={"leg": legs}).compare == ("leg",)
    built = made.fields.built({"shoes.size": 40, "ways": ((0.0, 2.0),)})
    assert built.shoes.size == 40 and built.ways == ((0.0, 2.0),)


def test_the_same_episode_has_the_same_key_however_it_is_stated(tmp_path: Path) -> None:
    def keys(folder: Path = tmp_path, **entries: Any) -> list[str]:
        return [episode.key for episode in walks((7,), folder, **entries).episodes()]

    assert keys(settings={"shoes": {"grip": 1}}) == keys(grid={"grip": [1.0]}) == keys(grid={"shoes.grip": [1.0]})
    assert keys(settings={"grip": 1}) != keys(settings={"grip": 0.5}) != keys()
    for folder, content in (("a", "x"), ("b", "x"), ("c", "y")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "büro [1].yaml").write_text("image: büro [1].pgm")
        (tmp_path / folder / "büro [1].pgm").write_text(content)
    a, b, c = (keys(tmp_path / folder, settings={"map": "büro [1].yaml"}) for folder in "abc")
    assert a == b != c, "a file is what it and its image hold, wherever it lies"
    settings = {"map": "büro [1].yaml"}
    for image in ("floor.pgm", "more/floor.pgm"):
        (tmp_path / "a" / "more").mkdir(exist_ok=True)
        (tmp_path / "a" / "büro [1].yaml").write_text(f'image: "{image}"\r\nresolution: 0.05\n', newline="")
        (tmp_path / "a" / image).write_text("x")
        before = keys(tmp_path / "a", settings=settings)
        (tmp_path / "a" / image).write_text("y")
        assert keys(tmp_path / "a", settings=settings) != before, "an image may have a name of its own"
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "bag.db3").write_text(name)
        (tmp_path / f"log-{name}").write_text(name)
    for pattern in ("{}", "log-{}"):
        one, two = (identity(tmp_path / pattern.format(name)) for name in ("one", "two"))
        assert one != two, "a folder is what its files hold, and so is a file without an ending"


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"scenario": "navigatoin"}, "there is no scenario 'navigatoin'; did you mean navigation"),
        ({"scenario": "no.such"}, "scenario 'no.such': No module named 'no'"),
        ({"scenario": "json.decoder"}, "the module needs SETTINGS and run"),
        ({"scenario": 3}, "`scenario` must name one of navigation"),
        ({"setings": {}}, "there is no entry 'setings'; did you mean settings"),
        ({"settings": {"pcae": 1.0}}, "walks, settings: there is no setting 'pcae'; did you mean pace"),
        ({"settings": {"shoes": {"siez": 1}}}, "there is no setting 'shoes.siez'; did you mean shoes.size"),
        ({"grid": {"Pace!": [1.0]}}, "grid.Pace!: there is no setting 'Pace!'; did you mean pace"),
        ({"settings": {"größe": 1}}, "there is no setting 'größe'"),
        ({"settings": 3}, "`settings` must be a table"),
        ({"settings": {"pace": "fast"}}, "settings, pace: 'fast' does not fit: a number is expected"),
        ({"settings": {"pace": True}}, "True does not fit: a number"),
        ({"settings": {"pace": float("nan")}}, "nan does not fit"),
        ({"settings": {"pace": -1.0}}, "'-1.0' is not a positive number"),
        ({"settings": {"shoes": {"size": 4.5}}}, "4.5 does not fit: a whole number"),
        ({"settings": {"shoes": 3}}, "there is no setting 'shoes'"),
        ({"settings": {"behaviour": "wlak"}}, "'wlak' is none of walk, fail"),
        ({"settings": {"ways": [[1.0]]}}, r"\[1.0\] does not fit: a list of 2, each a number, is expected"),
        ({"settings": {"ways": 3.0}}, "3.0 does not fit: a list of 2"),
        ({"settings": {"mark": 3}}, "3 does not fit: a word is expected"),
        ({"settings": {"map": "C:\\maps\\büro.yaml"}}, "büro.yaml: no such file; give a map"),
        ({"settings": {"map": 3}}, "3 does not fit: a file"),
        ({"settings": {"pace": 101.0}}, "walks: nobody walks that fast"),
        ({"grid": {"pace": [1.0, 101.0]}}, r"walks \(pace 101\): nobody walks that fast"),
        ({"settings": {"seed": 3}}, "seeds are stated by `seeds`"),
        ({"settings": {"pace": 1.0}, "grid": {"pace": [1.0]}}, "pace is set by `settings` and by the axis 'pace'"),
        ({"grid": {"pace": [1.0], "leg": [{"pace": 2.0}]}}, "pace is set by the axis 'pace' and by the axis 'leg'"),
        ({"grid": {"pace": [1, 1.0]}}, "grid.pace: 1 is stated twice"),
        ({"grid": {"pace": []}}, "a list of values is expected"),
        ({"grid": {"pace": 3.0}}, "a list of values is expected"),
        ({"grid": {"pace": [{"mark": "x"}]}}, "an axis of tables needs a name that is no setting"),
        ({"grid": {"leg": [{"name": "A"}, {"name": "A"}]}}, "grid.leg: A is stated twice"),
        ({"grid": {"leg": [{}, {}]}}, "state the same episode more than once"),
        ({"settings": {"shoes.grip": 1, "grip": 1}}, "shoes.grip is stated twice"),
        ({"seeds": None}, "`seeds` must be a list"),
        ({"seeds": [1.0]}, "`seeds` must be a list"),
        ({"seeds": [-1]}, "`seeds` must be a list"),
        ({"seeds": [1, 1]}, "a seed is stated twice"),
        ({"seeds": {"spawn": 0}}, "`seeds` must be"),
        ({"seeds": {"spawn": 3, "form": 2}}, "`seeds` must be"),
        ({"compare": ["pcae"], "grid": {"pace": [1.0]}}, "`compare` names 'pcae', which is no axis; did you mean pace"),
        ({"succeeded_only": "false"}, "`succeeded_only` must be true or false, got 'false'"),
        ({"measures": "length_m"}, "`measures` must be a list of names"),
        ({"scenario": "velocity-tracking"}, "has nothing random and no seed; leave `seeds` out"),
        ({"scenario": "navigation", "settings": {"solver": "lm"}}, "'lm' is none of"),
        ({"scenario": "navigation", "grid": {"fault": ["lidar-nan@2:1", "gust@1"]}}, "unknown fault 'gust'"),
        ({"scenario": "navigation", "settings": {"fault": 3}}, "cannot be stated in a file but by a word"),
        ({"scenario": "navigation", "settings": {"fault": "lidar-nan"}}, "is not KIND"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused(entries: dict[str, Any], message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        stated({"scenario": WALKS, "seeds": [1], **entries}, ".", "walks")


def test_defaults_are_those_of_the_command_line() -> None:
    made = stated({"scenario": "navigation", "seeds": [1], "grid": {"goal": [[20.0, 8.0, 0.0]]}})
    (episode,) = made.episodes()
    settings = campaigns_settings(made, episode.settings)
    assert (settings.obstacles, settings.seed, settings.goals) == (3, 1, ((20.0, 8.0, 0.0),))

    assert stated({"scenario": "velocity-tracking"}).seeds == (None,)


def campaigns_settings(made: Statement, settings: dict[str, Any]) -> Any:
    from unifg.scenarios.campaigns.statement import built

    return built(made.scenario, settings, 1, made.base, "")


def test_spawned_seeds_go_on_where_fewer_ended() -> None:
    more, fewer = spawned(50, 2022), spawned(30, 2022)
    assert more[:30] == fewer and len(set(more)) == 50 and spawned(30, 1) != fewer
    assert all(seed == int(float(seed)) for seed in more), "programs that know only doubles read them right"


@pytest.mark.parametrize(
    ("content", "words"), [(None, "cannot be read"), (b"\xff\xfe", "is no TOML"), (b"scenario = ", "is no TOML")]
)
def test_files_that_are_none(content: bytes | None, words: str, tmp_path: Path) -> None:
    path = tmp_path / "campaign.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ScenarioError, match=words):
        read(path)


def test_a_file_as_editors_on_windows_write_it(tmp_path: Path) -> None:
    path = tmp_path / "weg ü.toml"
    path.write_text(f'\ufeffscenario = "{WALKS}"\nseeds = [1]\n', encoding="utf-8")
    assert read(path).title == "weg ü"


def test_a_fault_is_stated_by_its_word() -> None:
    one, same, other = (
        next(stated({"scenario": "navigation", "seeds": [0], "settings": {"fault": word}}).episodes())
        for word in ("lidar-nan@2:1", "lidar-nan@2.0:1.0", "lidar-nan@2:3")
    )
    assert one.key == same.key != other.key and json.dumps(one.settings)
    built = campaigns_settings(stated({"scenario": "navigation", "seeds": [0]}), {"faults": ["lidar-nan@2:1"]})
    assert [str(fault) for fault in built.faults] == ["lidar-nan@2:1"]


# ---------------------------------------------------------------- rows on file


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


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
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
    assert (out / "replay" / key[:6] / "walk.txt").is_file()
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
