"""Calls that are written down and go on as before."""

from __future__ import annotations

from typing import Any

import pytest


def calls_of(monkeypatch: pytest.MonkeyPatch, owner: Any, name: str) -> list[tuple[Any, ...]]:
    """Positional arguments of every call of an owner's function from now on; it does what it did."""
    calls: list[tuple[Any, ...]] = []
    function = getattr(owner, name)

    def called(*given: Any, **named: Any) -> Any:
        calls.append(given)
        return function(*given, **named)

    monkeypatch.setattr(owner, name, called)
    return calls
