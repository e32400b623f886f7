"""Synchronisation of threads that share a compiled pass: chunks of a phase, and barriers.

Each phase has two counters, of chunks taken and of chunks done.
"""

from __future__ import annotations

from unifg.codegen.jit import compiled
from unifg.codegen.vectors import Address, advance, present

__all__ = ["first_chunk", "next_chunk", "wait_for"]


@compiled
def first_chunk(counters: Address, phase: int) -> int:
    """Take a chunk of a phase; a number beyond the last one where none is left."""
    return advance(counters, 2 * phase)


@compiled
def next_chunk(counters: Address, phase: int) -> int:
    """Say that a chunk of a phase is done, and take another."""
    advance(counters, 2 * phase + 1)
    return advance(counters, 2 * phase)


@compiled
def wait_for(counters: Address, phase: int, chunks: int) -> None:
    """Return when all chunks of a phase are done."""
    while present(counters, 2 * phase + 1) < chunks:
        pass
