"""Jaxprs of scalar functions, independent of what JAX is tracing around them."""

import concurrent.futures
from collections.abc import Callable
from typing import Any

import jax
from jax.extend import core
from jax.typing import DTypeLike


def example(dtype: DTypeLike) -> Any:
    """Return an abstract scalar as an example for `trace`."""
    return jax.ShapeDtypeStruct((), dtype)


def trace(function: Callable[..., Any], *examples: Any) -> tuple[core.ClosedJaxpr, Any]:
    """Return the jaxpr of a function of scalars, and the tree structure of its result.

    The jaxpr does not depend on what is being traced around it, such as the axes of a `shard_map` or a mesh.

    Args:
      function: function to trace.
      examples: pytrees of `example`, one per argument.
    """
    closed, shape = in_clean_context(lambda: jax.make_jaxpr(function, return_shape=True)(*examples))
    return closed, jax.tree.structure(shape)


def in_clean_context(work: Callable[[], Any]) -> Any:
    """Return work(), run on a thread of its own, because JAX's tracing is per thread, with the caller's dtype rules."""
    config: Any = jax.config
    is_x64, promotion = config.jax_enable_x64, config.jax_numpy_dtype_promotion

    def with_rules() -> Any:
        with jax.enable_x64(is_x64), jax.numpy_dtype_promotion(promotion):
            return work()

    with concurrent.futures.ThreadPoolExecutor(1, thread_name_prefix="a2tg-trace") as pool:
        return pool.submit(with_rules).result()
