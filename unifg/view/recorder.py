"""A window for meshcat that records instead of showing, so that a scene becomes a file without a server.

``meshcat.Visualizer(window=Recorder())`` sends its commands here; `Recorder.packed` gives them back as the
bytes the browser side understands. Two things are mended on the way: numpy scalars, which meshcat cannot
pack, become Python numbers, and the random identifiers of meshcat's objects become a running count, so that
the same scene is the same bytes.
"""

from __future__ import annotations

import base64
import re
import warnings
from importlib import resources
from typing import Protocol

import numpy as np

from unifg.errors import ViewError

__all__ = ["Recorder", "load_meshcat", "viewer_script"]

_UUID = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")


class Command(Protocol):
    """Command that meshcat sends to its window."""

    def lower(self) -> dict[str, object]:
        """The command as nested dictionaries."""


class Recorder:
    """Takes the place of ``meshcat.visualizer.ViewerWindow``; keeps commands in the order sent."""

    def __init__(self) -> None:
        """Start with nothing recorded."""
        self.commands: list[dict[str, object]] = []
        self._names: dict[str, str] = {}

    def send(self, command: Command) -> None:
        """Record one command."""
        plain = self._plain(command.lower())
        assert isinstance(plain, dict)
        self.commands.append(plain)

    def packed(self) -> list[bytes]:
        """The commands as MessagePack, animations last: the objects they animate must exist before."""
        import umsgpack

        ordered = sorted(self.commands, key=lambda command: command["type"] == "set_animation")
        return [umsgpack.packb(command) for command in ordered]

    def packed_base64(self) -> list[str]:
        """The same as text that can stand in a script."""
        return [base64.b64encode(data).decode("ascii") for data in self.packed()]

    def _plain(self, value: object) -> object:
        """The same value of plain Python types, identifiers renamed; extension types pass as they are."""
        if isinstance(value, dict):
            return {str(key): self._plain(item) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [self._plain(item) for item in value]
        if isinstance(value, np.ndarray):
            return value.tolist()
        if isinstance(value, np.generic):
            return value.item()
        if isinstance(value, str) and _UUID.fullmatch(value):
            return self._names.setdefault(value, f"{len(self._names):06d}")
        return value


def viewer_script() -> str:
    """The browser side of meshcat, to be written into the page itself.

    Raises:
        ViewError: meshcat is not installed.
    """
    load_meshcat()
    return resources.files("meshcat").joinpath("viewer", "dist", "main.min.js").read_text(encoding="utf-8")


def load_meshcat() -> None:
    """Import meshcat, an optional dependency, with its warnings about its own imports kept quiet.

    Raises:
        ViewError: meshcat is not installed.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            import meshcat  # noqa: F401
    except ModuleNotFoundError as error:
        raise ViewError("a scene needs meshcat: pip install 'unifg[view]'") from error
