"""Statement of a campaign: a scenario, settings of all episodes, axes along which settings change, and seeds.

An episode is one combination of the axes with one seed. All of it is stated by a mapping, usually a TOML file:

    scenario = "navigation"
    seeds = {spawn = 30, from = 2022}

    [settings]
    obstacles = 3

    [grid]
    coupling = ["sequential", "joint"]

    [[grid.leg]]
    name = "A to B"
    start = [3.0, 25.2, 0.0]
    goal = [21.5, 8.6, -0.5]

    [[grid.leg]]
    ...

`extends = "other.toml"` begins with what another file of the same folder states; tables are laid over its tables.
"""

from __future__ import annotations

import hashlib
import json
import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from importlib import import_module
from itertools import product
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from unifg.errors import ScenarioError, UnifgError
from unifg.scenarios.campaigns.stated_settings import Fields, identity, nearest
from unifg.scenarios.commands.catalogue import SCENARIOS

__all__ = ["Axis", "Episode", "Statement", "read", "spawned", "stated"]

_WORDS = ("scenario", "title", "seeds", "settings", "grid", "measures", "compare", "succeeded_only")


@dataclass(frozen=True)
class Axis:
    """A name and its values: each a label, and the settings it stands for, by path.

    Attributes:
        name: of the axis.
        values: by label.
        bundle: whether a value stands for several settings, as the leg of a way does.
    """

    name: str
    values: Mapping[str, Mapping[str, Any]]
    bundle: bool


@dataclass(frozen=True)
class Episode:
    """One episode.

    Attributes:
        key: short, the same for the same settings, files and seed wherever they are stated.
        labels: of the axes.
        settings: as stated, by path.
        seed: None where the scenario has none.
    """

    key: str
    labels: dict[str, str]
    settings: dict[str, Any]
    seed: int | None


@dataclass(frozen=True)
class Statement:
    """A campaign.

    Attributes:
        scenario: one of ``unifg run``'s, or a module with ``SETTINGS`` and ``run`` as theirs have them.
        title: for people.
        fixed: settings of all episodes, as stated, by path.
        axes: along which settings change.
        seeds: of every combination; (None,) where there are none.
        measures: names of metrics that come first in reports.
        compare: axes whose values are compared with each other.
        succeeded_only: whether reports leave out episodes that failed, but for counting them.
        base: folder that paths are relative to.
        given: the mapping.
    """

    scenario: str
    title: str
    fixed: Mapping[str, Any]
    axes: tuple[Axis, ...]
    seeds: tuple[int | None, ...]
    measures: tuple[str, ...]
    compare: tuple[str, ...]
    succeeded_only: bool
    base: Path
    given: Mapping[str, Any]

    @cached_property
    def fields(self) -> Fields:
        """The settings there are."""
        return fields_of(self.scenario, self.base)

    @cached_property
    def modules(self) -> tuple[str, ...]:
        """Modules that settings name, as MODULE:CLASS, and that of the scenario first."""
        words = (str(word) for _, settings in self.combinations() for word in settings.values())
        named = (word.partition(":")[0] for word in words if re.fullmatch(r"[^\W\d][\w.]*:[^\W\d]\w*", word))
        return tuple(dict.fromkeys((module_of(self.scenario).__name__, *named)))

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self.seeds) * int(np.prod([len(axis.values) for axis in self.axes], dtype=np.int64))

    def combinations(self) -> Iterator[tuple[dict[str, str], dict[str, Any]]]:
        """Labels and settings of every combination of the axes."""
        for chosen in product(*(axis.values.items() for axis in self.axes)):
            labels = {axis.name: label for axis, (label, _) in zip(self.axes, chosen, strict=True)}
            settings = dict(self.fixed)
            for _, given in chosen:
                settings |= given
            yield labels, settings

    def episodes(self) -> Iterator[Episode]:
        """Every episode, seed by seed so that a campaign that is stopped has some of everything."""
        known = [(labels, settings, self._identified(settings)) for labels, settings in self.combinations()]
        for seed in self.seeds:
            for labels, settings, what in known:
                text = json.dumps([self.scenario, what, seed], sort_keys=True)
                yield Episode(hashlib.sha256(text.encode()).hexdigest()[:12], labels, settings, seed)

    def _identified(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        return {path: identity(self.fields.value(path, given, path)) for path, given in settings.items()}


def read(file: str | Path) -> Statement:
    """Read a campaign.

    Args:
        file: TOML.

    Raises:
        ScenarioError: it cannot be read, or states what the scenario does not have.
    """
    path = Path(file)
    return stated({"title": path.stem, **_written(path, ())}, path.resolve().parent, str(path))


def _written(path: Path, before: tuple[str, ...]) -> dict[str, Any]:
    """Content of a file, laid over the file that it extends.

    Args:
        path: of the file.
        before: names of the files that extend it, the first one first.
    """
    try:
        given = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read ({error.strerror})") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{path}: is no TOML: {error}") from None
    if "extends" not in given:
        return given
    other, chain = given.pop("extends"), (*before, path.name)
    if not isinstance(other, str) or other != Path(other).name:  # paths inside are relative to one folder
        raise ScenarioError(f"{path}: `extends` must name a file of the same folder, got {other!r}")
    if other in chain:
        raise ScenarioError(f"{path}: extends itself: {', '.join((*chain, other))}")
    return _laid_over(_written(path.with_name(other), chain), given)


def _laid_over(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Both mappings, table by table; what both state is that of the second."""
    both = {**below, **above}
    for name in below.keys() & above.keys():
        if isinstance(below[name], Mapping) and isinstance(above[name], Mapping):
            both[name] = _laid_over(below[name], above[name])
    return both


def stated(given: Mapping[str, Any], base: str | Path = ".", name: str = "campaign") -> Statement:
    """A campaign from a mapping.

    Args:
        given: what a file would hold.
        base: folder that paths are relative to.
        name: of it, for errors.

    Raises:
        ScenarioError: it states what the scenario does not have.
    """
    for word in given:
        if word not in _WORDS:
            raise ScenarioError(f"{name}: there is no entry {word!r}; {nearest(word, _WORDS)}")
    scenario = given.get("scenario")
    if not isinstance(scenario, str):
        raise ScenarioError(f"{name}: `scenario` must name one of {', '.join(SCENARIOS)}")
    if not isinstance(given.get("succeeded_only", False), bool):
        raise ScenarioError(f"{name}: `succeeded_only` must be true or false, got {given['succeeded_only']!r}")
    base = Path(base).resolve()
    known = fields_of(scenario, base)
    fixed = _assigned(known, _table(given, "settings", name), f"{name}, settings")
    axes = tuple(_axis(known, axis, values, name) for axis, values in _flat(_table(given, "grid", name)))
    set_by = dict.fromkeys(fixed, "`settings`")
    for axis in axes:
        for path in dict.fromkeys(path for values in axis.values.values() for path in values):
            if path in set_by:
                raise ScenarioError(f"{name}: {path} is set by {set_by[path]} and by the axis {axis.name!r}")
            set_by[path] = f"the axis {axis.name!r}"
    made = Statement(
        scenario, str(given.get("title", name)), fixed, axes, _seeds(given, known, name),
        _names(given, "measures", name), _compared(given, axes, name), given.get("succeeded_only", False),
        base, given,
    )  # fmt: skip
    for labels, settings in made.combinations():  # settings that do not go together are refused before the first run
        where = ", ".join(f"{axis} {label}" for axis, label in labels.items())
        built(made.scenario, settings, None, base, f"{name} ({where})" if where else name)
    keys = [episode.key for episode in made.episodes()]
    if len(set(keys)) < len(keys):
        raise ScenarioError(f"{name}: the grid or the seeds state the same episode more than once")
    return made


def spawned(count: int, root: int) -> tuple[int, ...]:
    """Independent seeds by ``numpy.random.SeedSequence.spawn``; more of them begin with the same ones.

    Args:
        count: of seeds.
        root: entropy they come from.
    """
    children = np.random.SeedSequence(root).spawn(count)
    return tuple(int(child.generate_state(1, np.uint64)[0] >> np.uint64(11)) for child in children)  # exact in JSON


def module_of(scenario: str) -> ModuleType:
    """The module that runs a scenario."""
    if scenario in SCENARIOS:
        return import_module(f"unifg.scenarios.commands.{SCENARIOS[scenario].module}")
    if "." not in scenario:
        raise ScenarioError(f"there is no scenario {scenario!r}; {nearest(scenario, list(SCENARIOS))}")
    try:
        module = import_module(scenario)
    except ImportError as error:
        raise ScenarioError(f"scenario {scenario!r}: {error}") from None
    if not hasattr(module, "SETTINGS") or not hasattr(module, "run"):
        raise ScenarioError(
            f"scenario {scenario!r}: the module needs SETTINGS and run, as unifg.scenarios.commands has"
        )
    return module


def fields_of(scenario: str, base: Path) -> Fields:
    """The settings of a scenario."""
    from unifg.solvers import names

    chosen = {"solver": getattr(names, SCENARIOS[scenario].solvers)} if scenario in SCENARIOS else {}
    return Fields(module_of(scenario).SETTINGS, base, chosen)


def built(scenario: str, settings: Mapping[str, Any], seed: int | None, base: Path, where: str) -> Any:
    """The settings of an episode; what is not stated is what ``unifg run`` takes.

    Raises:
        ScenarioError: a value does not fit.
    """
    known = fields_of(scenario, base)
    defaults = dict(SCENARIOS[scenario].defaults) if scenario in SCENARIOS else {}
    values = {path: known.value(path, given, f"{where}: {path}") for path, given in settings.items()}
    try:
        return known.built(values | ({} if seed is None else {"seed": seed}), **defaults)
    except (UnifgError, ValueError, TypeError) as error:  # settings that look at themselves
        raise ScenarioError(f"{where}: {error}") from None


def _assigned(known: Fields, given: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Settings by path, tables inside tables taken apart."""
    found: dict[str, Any] = {}
    for name, value in _flat(given):
        path = known.named(name, where)
        if path == "seed":
            raise ScenarioError(f"{where}: seeds are stated by `seeds`")
        if path in found:
            raise ScenarioError(f"{where}: {path} is stated twice")
        known.value(path, value, f"{where}, {name}")
        found[path] = value
    return found


def _flat(given: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in given.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{before}{name}.")
        else:
            yield f"{before}{name}", value


def _axis(known: Fields, name: str, values: Any, file: str) -> Axis:
    where = f"{file}, grid.{name}"
    if not isinstance(values, list) or not values:
        raise ScenarioError(f"{where}: a list of values is expected, at least one")
    bundle = all(isinstance(value, Mapping) for value in values)
    if bundle and name in known:
        raise ScenarioError(f"{where}: an axis of tables needs a name that is no setting")
    path = name if bundle else known.named(name, where)
    found: dict[str, dict[str, Any]] = {}
    for number, value in enumerate(values, start=1):
        if bundle:
            label, given = str(value.get("name", number)), {word: value[word] for word in value if word != "name"}
        else:
            label, given = _label(known.value(path, value, where)), {path: value}
        if label in found:
            raise ScenarioError(f"{where}: {label} is stated twice")
        found[label] = _assigned(known, given, f"{where} {label}")
    return Axis(name, found, bundle)


def _label(value: Any) -> str:
    if isinstance(value, tuple):
        return "(" + ", ".join(map(_label, value)) + ")" if len(value) != 1 else _label(value[0])
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, Path):
        return value.stem
    return f"{value:g}" if isinstance(value, float) and float(f"{value:g}") == value else str(value)


def _seeds(given: Mapping[str, Any], known: Fields, name: str) -> tuple[int | None, ...]:
    stated, has = given.get("seeds"), any(f.name == "seed" for f in fields(known.settings))
    if not has:
        if stated is not None:
            raise ScenarioError(f"{name}: this scenario has nothing random and no seed; leave `seeds` out")
        return (None,)
    wrong = ScenarioError(f"{name}: `seeds` must be a list of whole numbers, or {{spawn = COUNT, from = NUMBER}}")
    if isinstance(stated, Mapping):
        count, root = stated.get("spawn"), stated.get("from", 0)
        whole = all(type(number) is int for number in (count, root))
        if set(stated) - {"spawn", "from"} or not whole or count < 1 or root < 0:  # type: ignore[operator]
            raise wrong
        return spawned(count, root)  # type: ignore[arg-type]
    if not isinstance(stated, list) or not stated or not all(type(seed) is int and seed >= 0 for seed in stated):
        raise wrong
    if len(set(stated)) < len(stated):
        raise ScenarioError(f"{name}: a seed is stated twice")
    return tuple(stated)


def _compared(given: Mapping[str, Any], axes: tuple[Axis, ...], name: str) -> tuple[str, ...]:
    if "compare" not in given:
        return tuple(axis.name for axis in axes if not axis.bundle)
    wanted, known = _names(given, "compare", name), [axis.name for axis in axes]
    for axis in wanted:
        if axis not in known:
            raise ScenarioError(f"{name}: `compare` names {axis!r}, which is no axis; {nearest(axis, known)}")
    return wanted


def _names(given: Mapping[str, Any], entry: str, name: str) -> tuple[str, ...]:
    found = given.get(entry, [])
    if not isinstance(found, list) or not all(isinstance(word, str) for word in found):
        raise ScenarioError(f"{name}: `{entry}` must be a list of names")
    return tuple(found)


def _table(given: Mapping[str, Any], entry: str, name: str) -> Mapping[str, Any]:
    found = given.get(entry, {})
    if not isinstance(found, Mapping):
        raise ScenarioError(f"{name}: `{entry}` must be a table")
    return found
