"""Variation of foreign functions' results over devices inside `shard_map`.

JAX assumes that such results are the same on all devices unless it is told otherwise.
"""

from typing import Any

import jax
from jax import Array, lax


def _axes(tree: Any) -> frozenset[str]:
    """Return the axes of a mesh along which an array of a pytree varies."""
    types = [getattr(jax.typeof(leaf), "manual_axis_type", None) for leaf in jax.tree.leaves(tree)]
    return frozenset().union(*(type_.varying for type_ in types if type_ is not None))


def vary_with(inputs: Any, results: Any) -> Any:
    """Mark the results as varying along every axis of the mesh along which an input varies."""
    axes = _axes(inputs)

    def vary(result: Array) -> Array:
        missing = tuple(sorted(axes - _axes(result)))
        return lax.pcast(result, missing, to="varying") if missing else result

    return jax.tree.map(vary, results)


def cotangent_of(primal: Any, cotangent: Any) -> Any:
    """Sum a cotangent over the devices that share its primal value, leaf by leaf."""

    def total(value: Any, cotangent: Any) -> Any:
        shared = tuple(sorted(_axes(cotangent) - _axes(value)))
        return lax.psum(cotangent, shared) if shared else cotangent

    return jax.tree.map(total, primal, cotangent)
