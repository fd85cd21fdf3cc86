"""The scalar functions that kernels apply, as jaxprs."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.core.bilinear import Lookup, Sample, TextureRegion
from a2tg_jax.rasterize import pixel
from a2tg_jax.rasterize.kernels.jaxprs import Untranslatable
from a2tg_jax.rasterize.kernels.tracing import example, trace
from a2tg_jax.rasterize.splats import KernelSpec

CUTOFF_SLACK = 1e-3
"""Added to the squared distance within which a pixel is looked at; what it shows is decided exactly."""


class Functions:
    """Jaxprs of scalars for one spec.

    `prepare` and `prepare_vjp` run once per splat and tile; `reach`, `forward` and `backward` run at every pixel.
    """

    def __init__(self, spec: KernelSpec):
        self._spec, self._functions = spec, spec.static.functions
        number, integer, flag = example(spec.dtype), example(jnp.int32), example(jnp.bool_)
        triple = (number,) * 3
        normal, numbers = triple if spec.has_geometry else None, (number,) * spec.num_own_numbers
        splat = pixel.Splat((triple,) * 3, number, (number,) * spec.num_colors, normal, numbers)
        values = (number,) * spec.num_columns
        region = TextureRegion(integer, integer, integer) if values else None
        lookup = Lookup(region, Sample(values, values, values)) if region else None

        tile = (number,) * spec.num_tile_numbers
        self.prepare, structure = trace(pixel.planes_of, splat.M, tile)
        self.num_planes = structure.num_leaves
        planes = jax.tree.unflatten(structure, [number] * structure.num_leaves)
        self.prepare_vjp, _ = trace(_planes_vjp, splat.M, tile, planes)
        self.reach, _ = trace(self._reach, planes, region, number, number)
        at_pixel, channels = (number, number, number, flag), (number,) * spec.num_channels
        self.forward, _ = trace(self._forward, planes, splat, values, *at_pixel, channels)
        of_backward = number, channels, tile, (triple,) * 3
        self.backward, _ = trace(self._backward, planes, splat, lookup, *at_pixel, *of_backward)

    def _reach(
        self, planes: pixel.Planes, region: TextureRegion | None, x: Array, y: Array
    ) -> tuple[Array, tuple[Array, ...]]:
        """Return the squared distance ρ of the pixel, and the position of the texture lookup."""
        hit = pixel.intersect(planes, x, y, self._spec.near_plane, self._functions.has_low_pass)
        return hit.rho, () if region is None else self._functions.texel_position(region, hit.u, hit.v)

    def _forward(
        self, planes: pixel.Planes, splat: pixel.Splat, values: tuple[Array, ...], x: Array, y: Array,
        transmittance: Array, is_live: Array, channels: tuple[Array, ...],
    ) -> tuple[Array, Array, tuple[Array, ...]]:  # fmt: skip
        """Return transmittance and liveness behind the splat, and the channels with it."""
        at_pixel = planes, splat, values, x, y, transmittance, is_live
        added, transmittance, is_live = pixel.blend(self._functions, self._spec.near_plane, *at_pixel)
        return transmittance, is_live, tuple(total + more for total, more in zip(channels, added, strict=True))

    def _backward(
        self, planes: pixel.Planes, splat: pixel.Splat, lookup: Lookup | None, x: Array, y: Array,
        transmittance: Array, is_live: Array, suffix_sum: Array, g: tuple[Array, ...], tile: pixel.TileNumbers,
        jacobian: pixel.Rows,
    ) -> tuple[pixel.State, Array, tuple[Array, ...], Any]:  # fmt: skip
        """Return the state behind the splat, whether it contributes, the cotangents of the values, and all others."""
        spec, functions = self._spec, self._functions
        at_pixel = planes, splat, lookup, x, y, transmittance, is_live, suffix_sum, g
        state, weight, d = pixel.blend_vjp(functions, spec.near_plane, *at_pixel, spec.statistic is not None)
        added: tuple[Array, ...] = ()
        if spec.statistic and d.rho is not None:
            added = pixel.positional_gradient(
                spec.statistic, splat.M, x, y, tile, d.rho, jacobian, spec.near_plane, functions.has_low_pass
            )
        return state, weight != 0, d.values, (d.planes, d.opacity, d.color, d.normal, d.numbers, added)


def refusal_of(spec: KernelSpec, translate: Callable[[KernelSpec], Any]) -> str | None:
    """Return why a kind of kernels cannot be made for a spec; None if `translate` makes them."""
    try:
        translate(spec)
    except Untranslatable as error:
        return str(error) + (_place_of(error.primitive, spec) if error.primitive else "")
    return None


def _place_of(primitive: str, spec: KernelSpec) -> str:
    """Return in which function of an appearance a primitive occurs, as in " in MyRule.shade"; "" if in none."""
    functions = spec.static.functions
    for name, given in spec.arguments.of(()).items():
        function = getattr(functions, name)
        if primitive in _primitives(trace(function, *given)[0]):
            return f" in {spec.static.name}.{name}"
        if name != "texel_position" and primitive in _primitives(trace(_gradient_of(function), *given)[0]):
            return f" in the gradient of {spec.static.name}.{name}"
    return ""


def _gradient_of(function: Callable[..., Any]) -> Callable[..., Any]:
    def gradient(*given: Any) -> Any:
        results, pull_back = jax.vjp(function, *given)
        return pull_back(results)

    return gradient


def _primitives(jaxpr: Any) -> set[str]:
    """Return the names of the primitives of a jaxpr and of the jaxprs within it."""
    found: set[str] = set()
    for equation in getattr(jaxpr, "jaxpr", jaxpr).eqns:
        inner = [leaf for leaf in jax.tree.leaves(tuple(equation.params.values())) if hasattr(leaf, "eqns")]
        found |= {equation.primitive.name}.union(*map(_primitives, inner))
    return found


def _planes_vjp(M: pixel.Rows, tile: pixel.TileNumbers, d_planes: pixel.Planes) -> pixel.Rows:
    """Return the cotangent of M, given that of its planes."""
    d_M: pixel.Rows = jax.vjp(lambda M: pixel.planes_of(M, tile), M)[1](d_planes)[0]
    return d_M
