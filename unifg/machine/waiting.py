"""How threads wait for each other in compiled code: they look at what another one is going to change."""

from __future__ import annotations

from unifg.machine.jit import compiled
from unifg.machine.vectors import Address, present

__all__ = ["changes", "wait_for"]

PATIENCE = 2_000_000  # looks for a change, about a millisecond


@compiled
def changes(integers: Address, at: int, old: int) -> bool:
    """Look for a while whether an integer that another thread writes is still ``old``; True when it is not."""
    for _ in range(PATIENCE):
        if present(integers, at) != old:
            return True
    return False


@compiled
def wait_for(counters: Address, phase: int, chunks: int) -> None:
    """Return when all chunks of a phase are done; each has two counters, of chunks taken and of chunks done."""
    while present(counters, 2 * phase + 1) < chunks:
        pass
