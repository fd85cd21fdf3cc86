"""Views under `vmap`: on CPUs, groups of them are computed one after the other.

All views at once would have arrays [V, N, ...] for every step of the projection, which are read from memory again and
again. A group's arrays stay in the caches, and their gradients are summed group by group. Threads divide the views of a
group (`kernels.native.ffi`).
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

from a2tg_jax.base.threads import num_threads
from a2tg_jax.rasterize.kernels.platforms import by_platform_p

T = TypeVar("T")
ROWS_PER_THREAD = 40_000
"""Number of splats of all views in a group, for each thread."""


def in_groups(view: Callable[..., T], num_rows: int, *arrays: Any) -> T:
    """Return view(*arrays), for pytrees of arrays. Under `vmap`, several views are computed in groups.

    Args:
      view: function of a view, as JAX code that may be differentiated in any mode.
      num_rows: number N of splats, which determines how many views are in a group.
    """
    flat, structure = jax.tree.flatten(arrays)

    def of_flat(*flat: Array) -> T:
        return view(*jax.tree.unflatten(structure, flat))

    code, shapes = jax.make_jaxpr(of_flat, return_shape=True)(*flat)
    results: T = jax.tree.unflatten(jax.tree.structure(shapes), view_p.bind(*flat, code=code, num_rows=num_rows))
    return results


def group_size(num_views: int, num_rows: int) -> int:
    """Return the number of views in a group: a divisor of the number of views, unless that is less than half of what
    fits."""
    if jax.default_backend() != "cpu":
        return num_views
    most = max(1, ROWS_PER_THREAD * num_threads() // max(1, num_rows))
    if most >= num_views:
        return num_views
    # The views that are left over would be compiled a second time.
    return next((size for size in range(most, most // 2, -1) if num_views % size == 0), most)


def _run(*flat: Array, code: ClosedJaxpr, num_rows: int) -> list[Array]:
    results: list[Array] = jaxpr_as_fun(code)(*flat)
    return results


def _batched(
    flat: Sequence[Array], axes: Sequence[int | None], *, code: ClosedJaxpr, num_rows: int
) -> tuple[list[Array], list[int]]:
    mapped = [jnp.moveaxis(x, axis, 0) for x, axis in zip(flat, axes, strict=True) if axis is not None]

    def view(mapped: Sequence[Array]) -> list[Array]:
        own = iter(mapped)
        each = [x if axis is None else next(own) for x, axis in zip(flat, axes, strict=True)]
        return _run(*each, code=code, num_rows=num_rows)

    num_views = mapped[0].shape[0]
    size = group_size(num_views, num_rows)
    if size == num_views:
        results = jax.vmap(view)(mapped)
    else:
        # The backward pass projects the splats again; lists and images are kept.
        view = jax.checkpoint(view, prevent_cse=False, policy=lambda primitive, *_, **__: primitive is by_platform_p)
        results = jax.lax.map(view, mapped, batch_size=size)
    return results, [0] * len(results)


def _jvp(primals: Sequence[Array], tangents: Sequence[Any], **parameters: Any) -> tuple[Any, Any]:
    # The code itself, of which JAX knows all derivatives; symbolic zeros stay out of it.
    is_varied = [not isinstance(tangent, ad.Zero) for tangent in tangents]

    def of_varied(*varied: Array) -> list[Array]:
        own = iter(varied)
        return _run(*(next(own) if is_own else x for x, is_own in zip(primals, is_varied, strict=True)), **parameters)

    def chosen(values: Sequence[Any]) -> tuple[Any, ...]:
        return tuple(value for value, is_own in zip(values, is_varied, strict=True) if is_own)

    return jax.jvp(of_varied, chosen(primals), chosen(tangents))


view_p = Primitive("a2tg_view")
view_p.multiple_results = True
view_p.def_impl(_run)
view_p.def_abstract_eval(lambda *_, code, **__: code.out_avals)
batching.primitive_batchers[view_p] = _batched
ad.primitive_jvps[view_p] = _jvp
mlir.register_lowering(view_p, mlir.lower_fun(_run, multiple_results=True))
