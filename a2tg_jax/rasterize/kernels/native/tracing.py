"""Jaxprs of scalar functions, traced whatever JAX is tracing around them."""

import concurrent.futures
from collections.abc import Callable
from typing import Any

import jax
from jax.extend import core


def trace(function: Callable, *examples) -> tuple[core.ClosedJaxpr, Any]:
    """The jaxpr of a function of scalars, and the structure of what it returns.

    Whatever is being traced around it has no part in it: not the axes of a `shard_map`, nor a mesh.

    Args:
      examples: pytrees of `jax.ShapeDtypeStruct` with shape ().
    """
    closed, shape = _in_clean_context(lambda: jax.make_jaxpr(function, return_shape=True)(*examples))
    return closed, jax.tree.structure(shape)


def _in_clean_context(work: Callable[[], Any]) -> Any:
    """work(), on a thread of its own: JAX keeps what it is tracing by thread. Its rules for dtypes are the caller's."""
    config: Any = jax.config
    is_x64, promotion = config.jax_enable_x64, config.jax_numpy_dtype_promotion

    def with_rules() -> Any:
        with jax.enable_x64(is_x64), jax.numpy_dtype_promotion(promotion):
            return work()

    with concurrent.futures.ThreadPoolExecutor(1, thread_name_prefix="a2tg-trace") as pool:
        return pool.submit(with_rules).result()
