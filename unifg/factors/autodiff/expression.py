"""A plain function as a kernel: its residual, its Jacobian and its second derivatives, exact and in machine code."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from threading import RLock
from typing import Any

import numpy as np

from unifg.codegen.cache_folder import cache_folder
from unifg.codegen.native import SOURCES, Native, Source, generated, generation
from unifg.codegen.objects import Objects
from unifg.factors.autodiff.calculus import bent, hessian, jacobian
from unifg.factors.autodiff.emit import residual_code, second_code
from unifg.factors.autodiff.operations import Op
from unifg.factors.autodiff.tape import Tape
from unifg.typing import Array, IntArray

WRITERS = ("calculus", "emit", "expression", "loops", "operations", "tape")  # modules that make machine code of a tape
generating = RLock()  # tracing rebinds names in copies of functions, and what it writes is one tape


def _digest() -> str:
    """Of the sources that make machine code of a tape; empty where there are none."""
    own = [Path(__file__).with_name(f"{name}.py") for name in WRITERS]
    own += map(Path, SOURCES)
    try:
        return hashlib.sha256(b"".join(file.read_bytes() for file in own)).hexdigest()
    except OSError:
        return ""


_WRITERS = _digest()  # as they are when they are loaded: they may be edited while the process runs


@cache
def _objects() -> Objects:
    """Beside what Numba keeps."""
    folder = cache_folder()
    return Objects(None if folder is None else folder / "derived")


@dataclass(frozen=True)
class Expression:
    """A residual on a tape, with every variable moved along its tangent coordinates.

    It owns its machine code: an address is good for as long as the expression lives.

    Attributes:
        tape: the nodes.
        rows: node of each row.
        width: number of tangent coordinates.
        name: for messages.
        required: conditions without which the function raises an exception.
    """

    tape: Tape
    rows: tuple[int, ...]
    width: int
    name: str
    required: tuple[int, ...] = ()
    _natives: dict[str, Native] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        """Pickle without machine code, which copies load for themselves."""
        return {**self.__dict__, "_natives": {}}

    @cached_property
    def linear_rows(self) -> tuple[bool, ...]:
        """Rows without second derivatives, being linear in the tangent coordinates or made of linear pieces."""
        return tuple(not row for row in bent(self.tape, self.rows))

    @cached_property
    def conditions(self) -> Expression | None:
        """Comparisons that the rows make, smallest and largest numbers among them; None where they make none."""
        tape, found = self.tape, list[int]()
        for i in tape.live(self.rows):
            if tape.op[i] in (Op.LESS, Op.LESS_EQUAL, Op.EQUAL):
                found.append(i)
            elif tape.op[i] in (Op.MINIMUM, Op.MAXIMUM):
                found.append(tape.apply(Op.LESS, tape.a[i], tape.b[i]))
        return Expression(tape, tuple(found), self.width, f"conditions of {self.name}") if found else None

    @cached_property
    def requirements(self) -> Expression | None:
        """The required conditions as numbers, 1.0 where they hold; None where there are none."""
        return Expression(self.tape, self.required, 0, f"requirements of {self.name}") if self.required else None

    @cached_property
    def table(self) -> Array:
        """Numbers that look-ups read, flat: what the kernel is given as its table."""
        return np.concatenate([np.zeros(0), *self.tape.tables])

    @cached_property
    def slopes(self) -> dict[tuple[int, int], int]:
        """Nodes of the Jacobian's entries that are not zero, on the same tape."""
        return jacobian(self.tape, self.rows, self.width)

    @cached_property
    def curvature(self) -> dict[tuple[int, int], int]:
        """Nodes of the entries on and above the diagonal of the Hessian of ``w' r`` that are not zero."""
        return hessian(self.tape, self.rows, self.width)

    def residual(self) -> Native:
        """``f(v, p, table, r, J)`` as machine code."""
        return self._native("residual")

    def second(self) -> Native:
        """``second(v, p, table, w, S)`` as machine code."""
        return self._native("second")

    def sources(self) -> dict[int, Source]:
        """The functions whose machine code has been asked for, by the addresses of that."""
        with generating:
            return {native.address: self._source(which) for which, native in self._natives.items()}

    def _native(self, which: str) -> Native:
        """Load code from disk, or generate it, once: what is handed out is never replaced."""
        with generating:
            native = self._natives.get(which)
            if native is None:
                key = hashlib.sha256(f"{which} {self._stated} {_WRITERS} {generation()}".encode()).hexdigest()
                code = _objects().find(key) if _WRITERS else None
                if code is None:
                    code = generated(self._source(which))
                    if _WRITERS:
                        _objects().keep(key, code)
                native = self._natives[which] = Native(code)
            return native

    @cached_property
    def _stated(self) -> str:
        """Digest of the tape as far as the rows go, however its nodes are numbered: all that code depends on."""
        tape = self.tape
        live = tape.live(self.rows)
        end = live[-1] + 1 if live else 0
        place = np.full(end + 1, -1)  # the last stands for no node
        place[live] = np.arange(len(live))
        op = np.array(tape.op[:end], dtype=np.int64)[live]
        inner = op > Op.TANGENT
        digest = hashlib.sha256(op.tobytes())
        for column in (tape.a, tape.b, tape.c):
            operands: IntArray = np.array(column[:end], dtype=np.int64)[live]
            operands[inner] = place[operands[inner]]
            digest.update(operands.tobytes())
        digest.update(np.array(tape.value[:end], dtype=np.float64)[live].tobytes())
        digest.update(repr((place[list(self.rows)].tolist(), self.width, tape.size)).encode())
        return digest.hexdigest()

    def _source(self, which: str) -> Source:
        return self._residual() if which == "residual" else self._second()

    def _residual(self) -> Source:
        tape, nodes = self.tape.at_rest([*self.rows, *self.slopes.values()])
        count = len(self.rows)
        slopes = dict(zip(self.slopes, nodes[count:], strict=True))
        return residual_code(tape, nodes[:count], slopes, self.width)

    def _second(self) -> Source:
        tape, nodes = self.tape.at_rest(list(self.curvature.values()))
        return second_code(tape, dict(zip(self.curvature, nodes, strict=True)), self.width)
