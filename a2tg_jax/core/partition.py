"""Floats of a pytree apart from the rest: what training differentiates and changes.

`jax.grad` rejects integers, such as the places of textures. A model, and anything else, is split by dtype:

    floats, rest = partition(model)
    gradient = jax.grad(lambda floats: loss(combine(floats, rest)))(floats)
"""

from typing import Any, TypeVar

import jax
import jax.numpy as jnp

T = TypeVar("T")


def partition(tree: T) -> tuple[T, T]:
    """Return a pytree with its float arrays only, None in place of all other leaves, and one with the others only."""

    def is_float(leaf: Any) -> bool:
        dtype = getattr(leaf, "dtype", None)
        return isinstance(leaf, float) if dtype is None else jnp.issubdtype(dtype, jnp.floating)

    floats: T = jax.tree.map(lambda leaf: leaf if is_float(leaf) else None, tree)
    rest: T = jax.tree.map(lambda leaf: None if is_float(leaf) else leaf, tree)
    return floats, rest


def combine(floats: T, rest: T) -> T:
    """Return the pytree that `partition` split, or one with other floats."""
    whole: T = jax.tree.map(
        lambda one, other: other if one is None else one, floats, rest, is_leaf=lambda leaf: leaf is None
    )
    return whole
