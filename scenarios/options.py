"""Settings as options of a command line: what a field may be is said once, where it is declared.

A field declared by :func:`option` is an option of its name; its default, its kind and its choices come from the
declaration, and its help is what the docstring of its class says of it. Settings inside settings bring their options
along. Help of the command line therefore has to load the settings it speaks of, and nothing else.
"""

from __future__ import annotations

import argparse
import dataclasses
import inspect
import math
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import MISSING, dataclass, field, replace
from functools import cache, partial
from numbers import Real
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, NamedTuple, TypeAlias, TypeVar, cast, get_args, get_origin, get_type_hints

from unifg.errors import ScenarioError, UnifgError
from unifg.files.contents import legible

__all__ = [
    "AboveZero",
    "AtLeastOne",
    "AtLeastTwo",
    "Help",
    "Leaf",
    "Option",
    "Positive",
    "Settings",
    "Signed",
    "Text",
    "Unasked",
    "above_zero",
    "add_options",
    "checked",
    "count",
    "existing",
    "find_modules_in",
    "leaves",
    "not_negative",
    "number",
    "option",
    "pair",
    "plain",
    "pose",
    "positive",
    "read_word",
    "replaced",
    "settings_of",
    "share",
]

S = TypeVar("S")
T = TypeVar("T")
Text = Callable[[str], Any]
"""Makes a value of a word of the command line, or raises ArgumentTypeError."""


class Unasked(int):
    """A whole number that nobody has asked for: the default of a command where settings have another."""


@dataclass(frozen=True)
class Option:
    """Declaration of a field for the command line: see :func:`option`."""

    text: Text | None
    metavar: str | None
    choices: tuple[str, ...]
    flag: str
    many: bool


def option(
    default: Any = MISSING,
    *,
    text: Text | None = None,
    metavar: str | None = None,
    choices: Sequence[str] = (),
    flag: str = "",
    many: bool = False,
) -> Any:
    """Declare a field of settings that is an option; without a default it is an argument that must be given.

    Args:
        default: of the field.
        text: makes a value of a word; None goes by the annotation (whole numbers, literals, flags).
        metavar: what stands for the value in the help.
        choices: words to choose from; those of an annotated Literal need not be repeated.
        flag: name of the option where it is not that of the field.
        many: the option may be repeated, and the field holds a tuple of all values.
    """
    declared = Option(text, metavar, tuple(choices), flag, many)
    return field(default=default, metadata={"option": declared})


class Leaf(NamedTuple):
    """A field of settings, or of settings inside them.

    Attributes:
        path: names that lead to it.
        owner: class that declares it.
        kind: its annotation.
        declared: the field.
        within: reader of numbers that it may hold, as its annotation says by `Positive`, `Signed` or `AtLeastOne`; None
            where that says nothing.
    """

    path: tuple[str, ...]
    owner: type
    kind: Any
    declared: dataclasses.Field[Any]
    within: Text | None

    @property
    def option(self) -> Option | None:
        """Declaration of :func:`option`, if it is one."""
        return self.declared.metadata.get("option")

    @property
    def choices(self) -> tuple[str, ...]:
        """Words to choose from; none where any will do."""
        kind, declared = plain(self.kind), () if self.option is None else self.option.choices
        return declared or (get_args(kind) if get_origin(kind) is Literal else ())

    @property
    def text(self) -> Text | None:
        """Reader of a word of the command line."""
        return (self.option and self.option.text) or (count if plain(self.kind) is int else None)


def leaves(settings: type, before: tuple[str, ...] = ()) -> Iterator[Leaf]:
    """Fields of a class of settings and of the settings inside."""
    kinds, full = get_type_hints(settings), get_type_hints(settings, include_extras=True)
    for declared in dataclasses.fields(settings):
        kind, path = plain(kinds[declared.name]), (*before, declared.name)
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            yield from leaves(kind, path)
        elif declared.init:
            parts = (full[declared.name], *get_args(full[declared.name]))  # one of which may be None
            within = next((one for part in parts for one in getattr(part, "__metadata__", ())), None)
            yield Leaf(path, settings, kinds[declared.name], declared, within)


class Settings:
    """Settings that refuse, wherever they are made, the words and numbers that the command line refuses.

    Numbers are finite and zero or more, except where the annotation or the option says something else.
    """

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            ScenarioError: naming the field.
        """
        for leaf in _own(cast(type, type(self))):
            name, value = leaf.path[0], getattr(self, leaf.path[0])
            read_as_one = leaf.option is not None and leaf.option.text is not None and not leaf.option.many
            row = isinstance(value, Iterable) and not isinstance(value, str) and (leaf.within or not read_as_one)
            each, size = tuple(value) if row else (value,), get_args(plain(leaf.kind))
            if row and get_origin(plain(leaf.kind)) is tuple and ... not in size and len(each) != len(size):
                raise ScenarioError(f"{name}: {len(size)} numbers are expected, found {value!r}")
            for one in each:
                if leaf.choices and one is not None and one not in leaf.choices:
                    raise ScenarioError(f"unknown {name} {one!r}: choose {', '.join(leaf.choices)}")
                if isinstance(one, Real) and not isinstance(one, bool):
                    read_word(leaf.within or leaf.text or not_negative, str(one), name)


@cache
def _own(settings: type) -> list[Leaf]:
    """Fields of a class of settings itself."""
    return [leaf for leaf in leaves(settings) if len(leaf.path) == 1]


def replaced(settings: S, path: Sequence[str], value: Any) -> S:
    """Settings with another value at a path."""
    first, *rest = path
    inner = replaced(getattr(settings, first), rest, value) if rest else value
    return replace(settings, **{first: inner})  # type: ignore[type-var]


def add_options(parser: argparse.ArgumentParser, settings: type, **defaults: Any) -> None:
    """Add the options of a class of settings.

    Args:
        parser: to add them to.
        settings: the class.
        defaults: values of fields where the command line does not give one; None for the field's own.
    """
    groups: dict[str, Any] = {"": parser}
    for leaf in leaves(settings):
        chosen, name, inside = leaf.option, leaf.path[-1], " ".join(leaf.path[:-1])
        if chosen is None:
            continue
        if inside not in groups:
            groups[inside] = parser.add_argument_group(inside)
        default = defaults.get(name, leaf.declared.default)
        words: dict[str, Any] = {"help": _help(leaf, default).replace("%", "%%"), "metavar": chosen.metavar}
        if plain(leaf.kind) is bool:
            del words["metavar"]
            words["action"] = "store_true"
        else:
            words["choices"] = leaf.choices or None
            words["type"] = leaf.text or str
            if chosen.many:
                words["action"] = "append"
        if leaf.declared.default is MISSING:
            parser.add_argument(name, **words)
        else:
            flag = "--" + (chosen.flag or name).replace("_", "-")
            groups[inside].add_argument(
                flag, dest=".".join(leaf.path), default=defaults.get(name, argparse.SUPPRESS), **words
            )


class Help(argparse.Action):
    """Help on the options that are asked for most; with the word "all" on every one, in groups."""

    def __init__(self, option_strings: Sequence[str], dest: str, first: Sequence[str] = ()) -> None:
        """Show those of ``first`` alone, by flag; without any, all."""
        super().__init__(option_strings, argparse.SUPPRESS, nargs="?", choices=("all",), default=argparse.SUPPRESS)
        self.first, self.help = first, "show this help, or all options"

    def __call__(self, parser: argparse.ArgumentParser, namespace: Any, values: Any, option: str | None = None) -> None:
        """Print the help and leave."""
        if self.first and values != "all":
            for action in parser._actions:
                if action is not self and action.option_strings and action.option_strings[-1] not in self.first:
                    action.help = argparse.SUPPRESS
            parser.epilog = f"{len(parser._actions)} options in all: {parser.prog} --help all"
        parser.print_help()
        parser.exit()


def settings_of(settings: type[S], chosen: argparse.Namespace, **more: Any) -> S:
    """The settings that were chosen; fields that were not named keep their defaults.

    Args:
        settings: the class.
        chosen: result of the parser.
        more: further fields.
    """
    given = {
        leaf.path: tuple(value) if leaf.option.many else value
        for leaf in leaves(settings)
        if leaf.option is not None and (value := getattr(chosen, ".".join(leaf.path), MISSING)) is not MISSING
    }
    made = settings(**{path[0]: value for path, value in given.items() if len(path) == 1}, **more)
    for path, value in given.items():
        if len(path) > 1:
            made = replaced(made, path, value)
    return made


def plain(kind: Any) -> Any:
    """An annotation without its None."""
    kinds = [part for part in get_args(kind) if part is not NoneType]
    return kinds[0] if NoneType in get_args(kind) and len(kinds) == 1 else kind


def _help(leaf: Leaf, default: Any) -> str:
    """Text about a field in the docstring of its class or of one it inherits from, and its default."""
    doc = "\n".join(inspect.getdoc(one) or "" for one in leaf.owner.__mro__)
    found = re.search(rf"^    {leaf.path[-1]}: (.*?)(?=^ {{0,4}}\S|\Z)", doc, re.MULTILINE | re.DOTALL)
    words = " ".join(found[1].split()).rstrip(".") if found else ""
    quiet = default in (MISSING, None, "") or isinstance(default, bool)
    return words if quiet else f"{words} (default: {default})"


def read_word(text: Text, word: str, where: str) -> Any:
    """Value of a word.

    Raises:
        ScenarioError: for a word that is refused, naming where it stands.
    """
    try:
        return text(word)
    except argparse.ArgumentTypeError as error:
        raise ScenarioError(f"{where}: {error}") from None


def checked(reader: Callable[[str], object]) -> Text:
    """A word that ``reader`` takes; one that it refuses is refused by the message of its error."""

    def word(text: str) -> str:
        try:
            reader(text)
        except UnifgError as error:
            raise argparse.ArgumentTypeError(str(error)) from error
        return text

    return word


def count(text: str, least: int = 0, most: int = 10**18) -> int:
    """A whole number, not below the least nor above the most."""
    if not text.isdecimal() or len(text) > 100 or int(text) < least:
        raise argparse.ArgumentTypeError(f"{text[:100]!r} is not a whole number of at least {least}")
    if int(text) > most:
        raise argparse.ArgumentTypeError(f"{text!r} is more than {most}")
    return int(text)


def number(what: str, permitted: Callable[[float], bool]) -> Text:
    """Reader of a number; ``what`` says in words which ones are permitted."""

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not permitted(value):
            raise argparse.ArgumentTypeError(f"{text!r} is not {what}")
        return value

    return read


positive = number("a positive number", lambda value: 0.0 < value < math.inf)
not_negative = number("a number of zero or more", lambda value: 0.0 <= value < math.inf)
share = number("a number in [0, 1)", lambda value: 0.0 <= value < 1.0)

above_zero = number("a number above zero", lambda value: value > 0.0)

Positive: TypeAlias = Annotated[T, positive]
AboveZero: TypeAlias = Annotated[T, above_zero]  # may be infinite, as limits of an ideal base
Signed: TypeAlias = Annotated[T, number("a finite number", math.isfinite)]
AtLeastOne: TypeAlias = Annotated[int, partial(count, least=1)]
AtLeastTwo: TypeAlias = Annotated[int, partial(count, least=2)]


def pose(text: str) -> tuple[float, ...]:
    """Three numbers X,Y,THETA."""
    values = _numbers(text, 3, "a pose: expected three numbers X,Y,THETA [m, m, rad], without blanks")
    if not all(abs(value) < math.inf for value in values):
        raise argparse.ArgumentTypeError(f"{text!r} is not a pose: every number must be finite")
    return values


def pair(text: str, equal: bool = False) -> tuple[float, ...]:
    """Two numbers LO,HI, the first below the second, or ``equal`` to it where it may be."""
    values = _numbers(text, 2, "LO,HI: expected two numbers, without blanks")
    if not (values[0] < values[1] or (equal and values[0] == values[1])):
        beyond = "must not be above" if equal else "must be below"
        raise argparse.ArgumentTypeError(f"{text!r}: the first number {beyond} the second")
    return values


def _numbers(text: str, size: int, what: str) -> tuple[float, ...]:
    """Some numbers between commas, which are ``what`` in words."""
    with suppress(ValueError):
        values = tuple(float(word) for word in text.split(","))
        if len(values) == size:
            return values
    raise argparse.ArgumentTypeError(f"{text!r} is not {what}")


def find_modules_in(folder: Path) -> None:
    """Let modules of a folder be imported by name, as a user's own that options name."""
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))


def existing(what: str, folders: bool = False) -> Text:
    """A file that is there, or a folder where these will do; ``what`` says which would do."""

    def path(text: str) -> Path:
        found = Path(text)
        if not (found.is_file() or (folders and found.is_dir())):
            why = "is no file" if found.exists() else "no such file"
            raise argparse.ArgumentTypeError(f"{legible(text)}: {why}; give {what}")
        return found

    return path
