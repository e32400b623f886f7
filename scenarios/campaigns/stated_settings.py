"""Settings as a file states them: which field a name means, whether a value fits it, and the settings they make.

What a field may be is declared where it stands (`unifg.scenarios.options`); a file can name every field, also those
that are no options: ``controller.speed`` is the field ``speed`` of the settings in ``controller``.
"""

from __future__ import annotations

import argparse
import glob
import hashlib
import math
import os
import re
import tomllib
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin

from unifg.errors import ScenarioError
from unifg.scenarios.options import Option, Text, leaves, plain, read_word, replaced

__all__ = ["Fields", "identity", "nearest"]

S = TypeVar("S")


class Fields:
    """The fields of a class of settings and of the settings inside, by name.

    Attributes:
        settings: the class.
        base: folder that relative paths are relative to.
        choices: words to choose from, by field, beside those that are declared.
    """

    def __init__(self, settings: type, base: Path, choices: Mapping[str, Sequence[str]] | None = None) -> None:
        """Look at a class."""
        self.settings, self.base, self.choices = settings, base, dict(choices or {})
        self._leaves = {".".join(leaf.path): leaf for leaf in leaves(settings)}
        self._short: dict[str, list[str]] = {}
        for path, leaf in self._leaves.items():
            if leaf.option is not None:
                for short in {leaf.path[-1], leaf.option.flag} - {"", path}:
                    self._short.setdefault(short, []).append(path)

    def named(self, name: str, where: str) -> str:
        """The path of a field; options inside settings need no more than the name they have on the command line.

        Raises:
            ScenarioError: there is none, or more than one.
        """
        if name in self._leaves:
            return name
        found = self._short.get(name.replace("-", "_"), [])
        if len(found) == 1:
            return found[0]
        if found:
            raise ScenarioError(f"{where}: {name!r} may mean {' or '.join(found)}; write which")
        raise ScenarioError(f"{where}: there is no setting {name!r}; {nearest(name, [*self._leaves, *self._short])}")

    def __contains__(self, name: str) -> bool:
        """True for a name that means one field."""
        return name in self._leaves or len(self._short.get(name.replace("-", "_"), [])) == 1

    def value(self, path: str, given: Any, where: str) -> Any:
        """A value as its field wants it.

        Raises:
            ScenarioError: it does not fit.
        """
        kind, option = self._leaves[path].kind, self._leaves[path].option
        many = option is not None and option.many
        values = given if not many or (isinstance(given, list | tuple) and not _single(kind, given)) else [given]
        found = self._fitting(plain(kind), values, where, option.text if option is not None else None)
        for one in found if many else (found,):
            self._permitted(path, option, one, where)
        return found

    def built(self, values: Mapping[str, Any], **defaults: Any) -> Any:
        """The settings that have these values; the others are the defaults."""
        made = self.settings(**{name: value for name, value in defaults.items() if name not in values})
        for path, value in values.items():
            made = replaced(made, path.split("."), value)
        return made

    def restated(self, settings: S, words: Sequence[str], given_by_option: Collection[str] = ()) -> S:
        """Settings with other values, each stated as NAME=VALUE in the words of a campaign's file.

        Args:
            settings: with what options say.
            words: of the command line.
            given_by_option: paths of fields that an option has stated, which no word states once more.

        Raises:
            ScenarioError: a word is none, its value does not fit, or an option states that field, too.
        """
        for word in words:
            name, equals, text = word.partition("=")
            try:
                given = tomllib.loads(f"value = {text}")["value"]
            except tomllib.TOMLDecodeError:
                given = text  # a word without its quotes
            if not equals:
                raise ScenarioError(f"--set {word}: give NAME=VALUE, such as controller.margin=0.3")
            path = self.named(name.strip(), "--set")
            if path in given_by_option:
                raise ScenarioError(f"--set {word}: an option states {path}, too; give one of the two")
            settings = replaced(settings, path.split("."), self.value(path, given, f"--set {word}"))
        return settings

    def _fitting(self, kind: Any, given: Any, where: str, text: Text | None) -> Any:
        arguments = get_args(kind)
        wrong = ScenarioError(f"{where}: {given!r} does not fit: {_words(kind)} is expected")
        if get_origin(kind) is Literal:
            if given not in arguments or isinstance(given, bool):
                raise ScenarioError(f"{where}: {given!r} is none of {', '.join(map(str, arguments))}")
            return given
        if get_origin(kind) is tuple:
            if not isinstance(given, list | tuple):
                raise wrong
            if len(arguments) == 2 and arguments[1] is Ellipsis:
                return tuple(self._fitting(plain(arguments[0]), one, where, text) for one in given)
            if len(given) != len(arguments):
                raise wrong
            return tuple(self._fitting(plain(k), one, where, text) for k, one in zip(arguments, given, strict=True))
        if kind is float:
            if text is not None and isinstance(given, str):  # a word for a number, as "auto" for a latency
                with suppress(argparse.ArgumentTypeError):
                    given = text(given)
            if isinstance(given, bool) or not isinstance(given, int | float) or math.isnan(given):
                raise wrong
            return float(given)
        if kind is Path:
            if not isinstance(given, str | Path):
                raise wrong
            return self.base / given
        if kind in (bool, int, str):
            if type(given) is not kind:
                raise wrong
            return given
        if text is None or not isinstance(given, str):
            raise ScenarioError(f"{where}: {_words(kind)} cannot be stated in a file" + " but by a word" * bool(text))
        return read_word(text, given, where)

    def _permitted(self, path: str, option: Option | None, value: Any, where: str) -> None:
        """Refuse what the command line refuses."""
        words = self.choices.get(path, option.choices if option is not None else ())
        if words and value not in words:
            raise ScenarioError(f"{where}: {value!r} is none of {', '.join(words)}")
        if option is not None and option.text is not None and not isinstance(value, tuple | bool):
            read_word(option.text, str(value), where)


def nearest(name: str, known: Sequence[str]) -> str:
    """Suggestion for a misspelt name."""
    close = get_close_matches(name.lower(), known, 3, 0.5)
    return f"did you mean {' or '.join(close)}?" if close else f"there are {', '.join(sorted(known))}"


def identity(value: Any) -> Any:
    """Identity of a value as JSON can hold it; of a file or folder, a digest of it and of what belongs to it."""
    if isinstance(value, Path):
        total = hashlib.sha256()
        for part in sorted(_parts(value)):
            total.update(part.name.encode() + b"\0" + part.read_bytes() + b"\0")
        return total.hexdigest()[:12]
    if isinstance(value, tuple):
        return [identity(one) for one in value]
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def _parts(path: Path) -> set[Path]:
    """Files of a folder; or a file, those that are named like it, and the image that a map names."""
    if path.is_dir():
        return {part for part in path.rglob("*") if part.is_file()}
    beside = path.parent.glob(f"{glob.escape(path.stem)}.*")
    found = {path, *(part for part in beside if part.suffix != ".toml")}  # a campaign may be named like its map
    if path.suffix in (".yaml", ".yml") and path.is_file():
        named = re.findall(rb"""^image:[ \t]*["']?(.*?)["']?[ \t\r]*$""", path.read_bytes(), re.MULTILINE)
        found |= {path.parent / os.fsdecode(image) for image in named}
    return {part for part in found if part.is_file()}


def _single(kind: Any, given: Sequence[Any]) -> bool:
    """True for a list that is one of many values, such as a pose among poses."""
    arguments = get_args(plain(kind))
    return get_origin(arguments[0]) is tuple and not any(isinstance(one, list | tuple) for one in given)


def _words(kind: Any) -> str:
    names = {bool: "true or false", int: "a whole number", float: "a number", str: "a word", Path: "a file"}
    if get_origin(kind) is tuple:
        first, *rest = get_args(kind)
        inner = names.get(plain(first)) or f"a list of {len(get_args(plain(first)))} numbers"
        return f"a list, each {inner}," if rest == [Ellipsis] else f"a list of {1 + len(rest)}, each {inner},"
    return names.get(kind, f"a {getattr(kind, '__name__', kind)}")
