"""Storage of position, orientation and velocity in the state of a rigid body."""

from __future__ import annotations

from unifg.errors import ModelError
from unifg.lie import SE3, SE23, SO3, Manifold, Product, Rn


def pose_parts(state: Manifold, what: str) -> tuple[slice, slice]:
    """Slices of position and orientation in the storage.

    Args:
        state: SE3, SE23, a product with components p in Rn(3) and R in SO3, or one with a component ``pose`` in SE3.
        what: asks for them, for the message.

    Raises:
        ModelError: for another manifold.
    """
    if state in (SE3, SE23):
        return slice(0, 3), slice(state.storage - 4, state.storage)
    parts = state.components if isinstance(state, Product) else {}
    if _has(state, p=Rn(3), R=SO3):
        return parts["p"].storage, parts["R"].storage
    if _has(state, pose=SE3):
        first = parts["pose"].storage.start
        return slice(first, first + 3), slice(first + 3, first + 7)
    raise ModelError(
        f"{what} needs a position and an orientation, which {state.name} has not: use SE3, SE23, or a product with "
        "components p=Rn(3) and R=SO3, or pose=SE3"
    )


def motion_parts(state: Manifold, what: str) -> tuple[slice, slice, slice]:
    """Slices of position, velocity in the world and orientation in the storage.

    Args:
        state: SE23, or a product with components p and v in Rn(3) and R in SO3.
        what: asks for them, for the message.

    Raises:
        ModelError: for another manifold.
    """
    if state == SE23:
        return slice(0, 3), slice(3, 6), slice(6, 10)
    if isinstance(state, Product) and _has(state, p=Rn(3), v=Rn(3), R=SO3):
        parts = state.components
        return parts["p"].storage, parts["v"].storage, parts["R"].storage
    raise ModelError(
        f"{what} needs a position, a velocity and an orientation, which {state.name} has not: use SE23, or a product "
        "with components p=Rn(3), v=Rn(3) and R=SO3"
    )


def _has(state: Manifold, **wanted: Manifold) -> bool:
    parts = state.components if isinstance(state, Product) else {}
    return all(name in parts and parts[name].manifold == kind for name, kind in wanted.items())
