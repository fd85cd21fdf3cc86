"""Checks of what loss functions and events return, traced or not: kinds, shapes and dtypes only."""

import contextlib
import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from a2tg_jax.base.checks import check_kind, check_like, described, dtype_of
from a2tg_jax.base.text import shortened
from a2tg_jax.core.gaussians import check_gaussians
from a2tg_jax.core.optim import AdamState
from a2tg_jax.core.pytree import partition
from a2tg_jax.events import Change, Event
from a2tg_jax.model import Model


@contextlib.contextmanager
def calling(event: Event, method: str, stage_name: str | None = None) -> Iterator[None]:
    """Name the event and its method in errors of the block, which calls the method, and the stage if it is given."""
    try:
        yield
    except (ValueError, ArithmeticError) as error:
        where = "" if stage_name is None else f"stage {stage_name!r}: "
        raise ValueError(f"{where}{type(event).__name__}.{method}: {error}") from error


def check_scalar(name: str, value: object) -> None:
    """Raise ValueError unless what a loss function or term of that name returned is a real number."""
    is_number = isinstance(value, int | float | np.ndarray | np.generic | jax.Array) and np.shape(value) == ()
    kind = dtype_of(value) if is_number else None
    if kind is None or not (jnp.issubdtype(kind, jnp.floating) or jnp.issubdtype(kind, jnp.integer)):
        raise ValueError(f"{name} must return a scalar, such as jnp.mean(…); got {described(value)}")


def checked_change(change: Any) -> Change:
    """Return what an event returned, with the number of Gaussians that exist as an array.

    Raises:
      ValueError: unless it is a change whose moments fit its model.
    """
    check_kind("the result", change, Change, "use Change(model, moments, state)")
    check_kind("model", change.model, Model)
    check_kind("moments", change.moments, AdamState)
    check_gaussians(change.model.gaussians, "model.gaussians")
    floats, _ = partition(change.model)
    for field in ("mu", "nu"):
        try:
            check_kept(f"moments.{field}", getattr(change.moments, field), floats)
        except ValueError as error:
            hint = "keep_rows(model, moments, state, is_kept) removes Gaussians from both"
            raise ValueError(f"{error}, as in the model: {hint}") from None
    return change._replace(model=dataclasses.replace(change.model, num_live=change.model.live_count))


def check_kept(name: str, returned: object, given: object) -> None:
    """Raise ValueError, naming the leaf, unless a returned pytree has the structure, shapes and dtypes of the one that
    was given."""
    structure = str(jax.tree.structure(returned))
    expected = str(jax.tree.structure(given))
    if structure != expected:
        raise ValueError(f"{name} must keep its structure, {shortened(expected)}; got {shortened(structure)}")

    def shape_of(leaf: ArrayLike) -> jax.ShapeDtypeStruct:
        # Without a copy of the array; a number has JAX's dtype of it.
        return jax.ShapeDtypeStruct(np.shape(leaf), jax.dtypes.canonicalize_dtype(dtype_of(leaf)))

    check_like(name, jax.tree.map(shape_of, returned), given)
