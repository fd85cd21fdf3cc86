"""Checks of what loss functions and events return, traced or not: kinds, shapes and dtypes only."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from a2tg_jax.core.checks import check_kind, described, dtype_of
from a2tg_jax.core.gaussians import check_gaussians
from a2tg_jax.core.optim import AdamState
from a2tg_jax.core.pytree import partition
from a2tg_jax.events import Change
from a2tg_jax.host.text import shortened
from a2tg_jax.io.validate import check_like
from a2tg_jax.model import Model


def check_scalar(name: str, value: object) -> None:
    """Raise ValueError unless what a loss function or term of that name returned is a real number."""
    is_number = isinstance(value, int | float | np.ndarray | np.generic | jax.Array) and np.shape(value) == ()
    kind = dtype_of(value) if is_number else None
    if kind is None or not (jnp.issubdtype(kind, jnp.floating) or jnp.issubdtype(kind, jnp.integer)):
        raise ValueError(f"{name} must return a scalar, such as jnp.mean(…); got {described(value)}")


def checked_change(name: str, change: Any) -> Change:
    """Return what an event returned, with the number of Gaussians that exist as an array.

    Raises:
      ValueError: unless it is a change whose moments fit its model.
    """
    check_kind(f"{name}: the result", change, Change, "say Change(model, moments, state)")
    check_kind(f"{name}: model", change.model, Model)
    check_kind(f"{name}: moments", change.moments, AdamState)
    check_gaussians(change.model.gaussians, f"{name}: model.gaussians")
    floats, _ = partition(change.model)
    for field in ("mu", "nu"):
        try:
            check_kept(f"{name}: moments.{field}", getattr(change.moments, field), floats)
        except ValueError as error:
            hint = "keep_rows(model, moments, state, is_kept) removes Gaussians from both"
            raise ValueError(f"{error}, as in the model: {hint}") from None
    return change._replace(model=dataclasses.replace(change.model, num_live=change.model.live_count))


def check_kept(name: str, found: object, wanted: object) -> None:
    """Raise ValueError, naming the leaf, unless a pytree has the structure, shapes and dtypes of another."""
    before, after = (str(jax.tree.structure(tree)) for tree in (wanted, found))
    if after != before:
        raise ValueError(f"{name} must keep its structure, {shortened(before)}; got {shortened(after)}")
    check_like(name, jax.tree.map(_shape_of, found), wanted)


def _shape_of(leaf: ArrayLike) -> jax.ShapeDtypeStruct:
    """Return the shape and dtype that JAX gives a number or an array, which stays where it is."""
    return jax.ShapeDtypeStruct(np.shape(leaf), jax.dtypes.canonicalize_dtype(dtype_of(leaf)))
