"""Results of foreign functions inside `shard_map`: JAX takes them to be the same on all devices unless it is told."""

from typing import Any

import jax
from jax import lax


def _axes(tree: Any) -> frozenset[str]:
    """The axes of a mesh along which some array of a tree differs."""
    types = [getattr(jax.typeof(leaf), "manual_axis_type", None) for leaf in jax.tree.leaves(tree)]
    return frozenset().union(*(type_.varying for type_ in types if type_ is not None))


def vary_with(inputs: Any, results: Any) -> Any:
    """Results, differing between devices along all axes along which an input does."""
    axes = _axes(inputs)

    def vary(result):
        missing = tuple(sorted(axes - _axes(result)))
        return lax.pcast(result, missing, to="varying") if missing else result

    return jax.tree.map(vary, results)


def cotangent_of(primal: Any, cotangent: Any) -> Any:
    """A cotangent, summed over the devices that share what it is of; tree by tree."""

    def total(value, of):
        shared = tuple(sorted(_axes(of) - _axes(value)))
        return lax.psum(of, shared) if shared else of

    return jax.tree.map(total, primal, cotangent)
