"""Functions whose code depends on the platform that JAX compiles for: the CPU, an NVIDIA GPU, or another one.

JAX knows the platform of a computation when it lowers it, from the devices of its arguments. Unlike
`jax.lax.platform_dependent`, which traces the code of all platforms, `by_platform` traces that of this one only.
"""

import functools
from collections.abc import Callable, Hashable
from typing import Any, NoReturn

import jax
from jax import Array
from jax.core import ShapedArray

# It registers configuration that belongs to every trace's key: if its first import were during the first trace, such as
# by `tracing`, JAX would trace and compile all of it a second time.
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from a2tg_jax.parallel.sharded_rows import vary_with

CodeOf = Callable[..., Callable[..., Any]]
"""Function of a platform ("cpu", "cuda" or "other") and of static arguments that returns a function of arrays."""


def by_platform(
    code_of: CodeOf, static: tuple[Hashable, ...], results: Any, *arrays: Any, advice: str = "it has no derivative"
) -> Any:
    """Call `code_of(platform, *static)(*arrays)`, for the platform that JAX compiles for.

    Args:
      code_of: module-level function.
      static: further arguments of it.
      results: pytree of `jax.ShapeDtypeStruct`, the same on all platforms.
      arrays: pytrees of arrays.
      advice: message of the ValueError that is raised if JAX differentiates the call.

    Returns:
      The results, varying over the devices of a `shard_map` as the arrays do.
    """
    flat, structure = jax.tree.flatten(arrays)
    shapes, structure_of_results = jax.tree.flatten(results)
    found = by_platform_p.bind(
        *flat, code_of=code_of, static=static, structure=structure, shapes=tuple(shapes), axes=(), advice=advice
    )
    return vary_with(flat, jax.tree.unflatten(structure_of_results, found))


def _lower(platform: str, context: Any, *operands: Any, **parameters: Any) -> Any:
    # Without the axes of a `shard_map`, for XLA's loops do not say along which of them their carries vary.
    avals = [ShapedArray(aval.shape, aval.dtype) for aval in context.avals_in]
    run = functools.partial(_run, platform, **parameters)
    return mlir.lower_fun(run, multiple_results=True)(context.replace(avals_in=avals), *operands)


def _run(
    platform: str, *flat: Array, code_of: CodeOf, static: Any, structure: Any, shapes: Any, axes: Any, advice: str
) -> list[Array]:
    def function(*flat: Array) -> list[Array]:
        return jax.tree.leaves(code_of(platform, *static)(*jax.tree.unflatten(structure, flat)))

    for of_arrays in axes:
        function = jax.vmap(function, of_arrays)
    return function(*flat)


def _batched(
    arrays: Any, of_arrays: Any, *, shapes: Any, axes: Any, **parameters: Any
) -> tuple[list[Array], list[int]]:
    mapped = zip(arrays, of_arrays, strict=True)
    size = next(array.shape[axis] for array, axis in mapped if axis is not None)
    shapes = tuple(jax.ShapeDtypeStruct((size, *shape.shape), shape.dtype) for shape in shapes)
    found = by_platform_p.bind(*arrays, shapes=shapes, axes=(*axes, tuple(of_arrays)), **parameters)
    return found, [0] * len(found)


def _refuse(*_: Any, advice: str, **parameters: Any) -> NoReturn:
    raise ValueError(advice)


@functools.lru_cache(maxsize=256)
def _compiled(parameters: frozenset[tuple[str, Hashable]]) -> jax.stages.Wrapped:
    return jax.jit(functools.partial(by_platform_p.bind, **dict(parameters)))


def _now(*arrays: Array, **parameters: Any) -> list[Array]:
    with jax.disable_jit(False):
        found: list[Array] = _compiled(frozenset(parameters.items()))(*arrays)
    return found


by_platform_p = Primitive("a2tg_by_platform")
by_platform_p.multiple_results = True
by_platform_p.def_impl(_now)
by_platform_p.def_abstract_eval(lambda *_, shapes, **__: [ShapedArray(shape.shape, shape.dtype) for shape in shapes])
batching.primitive_batchers[by_platform_p] = _batched
ad.primitive_jvps[by_platform_p] = _refuse
mlir.register_lowering(by_platform_p, functools.partial(_lower, "other"))
for _platform in ("cpu", "cuda"):
    mlir.register_lowering(by_platform_p, functools.partial(_lower, _platform), platform=_platform)
