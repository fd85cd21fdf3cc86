"""What native loops are made for (`KernelSpec`), and the scalar functions that they apply, traced to jaxprs."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from a2tg_jax import pixel
from a2tg_jax.appearance import StaticRule
from a2tg_jax.bilinear import Lookup, Sample, TextureRegion
from a2tg_jax.kernels import jit
from a2tg_jax.kernels.lanes import trace
from a2tg_jax.kernels.packing import num_numbers


@dataclasses.dataclass(frozen=True)
class KernelSpec:
    """What a pair of loops is made for; hashable."""

    rule: StaticRule
    """What the splats show."""
    num_rule_numbers: int
    """K, what else the rule knows of a splat."""
    num_columns: int
    """C, numbers of a texel; 0 where its splats have no textures."""
    dtype: str
    """Of all that is computed: "float32" or "float64"."""
    tile_size: int
    near_plane: float
    has_geometry: bool
    statistic: pixel.Statistic | None

    @property
    def num_channels(self) -> int:
        return 8 if self.has_geometry else 3

    @property
    def num_floats(self) -> int:
        """S: the splat's own numbers, and the squared distance beyond which it does not show."""
        return num_numbers(self.has_geometry) + self.num_rule_numbers + 1

    @property
    def lanes(self) -> int:
        """L, numbers that fit the processor's vectors."""
        return jit.vector_bytes() // np.dtype(self.dtype).itemsize

    @property
    def num_vectors(self) -> int:
        """Vectors of L pixels in a tile, the last one perhaps not full."""
        return -(-(self.tile_size**2) // self.lanes)


class Functions:
    """The jaxprs of one spec, all of scalars."""

    def __init__(self, spec: KernelSpec):
        rule = spec.rule.rule
        number: Any = jax.ShapeDtypeStruct((), spec.dtype)
        integer: Any = jax.ShapeDtypeStruct((), jnp.int32)
        flag = jax.ShapeDtypeStruct((), jnp.bool_)
        triple, near_plane = (number,) * 3, spec.near_plane
        normal, numbers = triple if spec.has_geometry else None, (number,) * spec.num_rule_numbers
        splat = pixel.Splat((triple,) * 3, number, triple, normal, numbers)
        values = (number,) * spec.num_columns
        region = TextureRegion(integer, integer, integer) if values else None
        lookup = Lookup(region, Sample(values, values, values)) if region else None

        self.prepare, structure = trace(pixel.planes_of, splat.M, number, number)
        planes = jax.tree.unflatten(structure, [number] * structure.num_leaves)
        self.num_planes = structure.num_leaves

        def prepare_vjp(M, x, y, d_planes):
            return jax.vjp(lambda M: pixel.planes_of(M, x, y), M)[1](d_planes)[0]

        self.prepare_vjp, _ = trace(prepare_vjp, splat.M, number, number, planes)

        def reach(planes, region, x, y):
            hit = pixel.intersect(planes, x, y, near_plane, rule.has_low_pass)
            return hit.rho, () if region is None else rule.texel_position(region, hit.u, hit.v)

        self.reach, _ = trace(reach, planes, region, number, number)

        def forward(planes, splat, values, x, y, transmittance, is_live, channels):
            at_pixel = planes, splat, values, x, y, transmittance, is_live
            added, transmittance, is_live = pixel.blend(rule, near_plane, *at_pixel)
            return transmittance, is_live, tuple(total + more for total, more in zip(channels, added, strict=True))

        def backward(planes, splat, lookup, x, y, transmittance, is_live, suffix_sum, g, center, jacobian):
            at_pixel = planes, splat, lookup, x, y, transmittance, is_live, suffix_sum, g
            state, weight, d = pixel.blend_vjp(rule, near_plane, *at_pixel, spec.statistic is not None)
            added = ()
            if spec.statistic:
                moved = splat.M, x, y, *center, d.rho, jacobian
                added = pixel.positional_gradient(spec.statistic, *moved, near_plane, rule.has_low_pass)
            return state, weight != 0, d.values, (d.planes, d.opacity, d.color, d.normal, d.numbers, added)

        at_pixel = number, number, number, flag
        channels = (number,) * spec.num_channels
        self.forward, _ = trace(forward, planes, splat, values, *at_pixel, channels)
        last = number, channels, (number, number), (triple,) * 3
        self.backward, _ = trace(backward, planes, splat, lookup, *at_pixel, *last)
