"""Statements of campaigns: files, grids, keys, seeds and refusals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from test_campaigns import WALKS, walks
from unifg.errors import ScenarioError
from unifg.scenarios.campaigns.stated_settings import identity
from unifg.scenarios.campaigns.statement import Statement, read, spawned, stated


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
        ({"scenario": "navigation", "settings": {"coupling": "joint", "localiser": "amcl"}}, "'amcl' stands"),
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
