"""Compositing by CUDA kernels on NVIDIA GPUs. Each thread composites one pixel; `tiles.c` is the kernel.

What a splat adds to the gradient is summed over warps and added atomically: gradients are reproducible to rounding.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance import AppearanceRule, StaticRule
from a2tg_jax.core.bilinear import TextureRegion
from a2tg_jax.rasterize.kernels.cuda.launch import launch
from a2tg_jax.rasterize.kernels.cuda.source import source
from a2tg_jax.rasterize.kernels.manual_axes import vary_with
from a2tg_jax.rasterize.kernels.packing import pack_inputs, split_image, unpack_gradients
from a2tg_jax.rasterize.kernels.traced import KernelSpec, refusal_of
from a2tg_jax.rasterize.splats import CompositingSettings, Splats
from a2tg_jax.rasterize.tiles import TileLists


def refusal(settings: CompositingSettings, rule: AppearanceRule, splats: Splats) -> str | None:
    """Return why a rule cannot run in GPU kernels; None if it can."""
    return _refusal(KernelSpec.of(settings, StaticRule.of(rule), splats, rule.texels, rule.regions))


@functools.cache
def _refusal(spec: KernelSpec) -> str | None:
    return refusal_of(spec, functools.partial(source, dialect="cuda"))


def forward(
    settings: CompositingSettings, static: StaticRule, splats: Splats, texels: Array, regions: TextureRegion | None,
    cutoff: Array, lists: TileLists,
) -> tuple[Array, Array]:  # fmt: skip
    """Return channels [tiles, 1, D, P] and transmittance [tiles, 1, P], as `xla.forward` does."""
    spec = KernelSpec.of(settings, static, splats, texels, regions)
    size = settings.grid.num, spec.num_channels + 1, spec.tile_size**2
    shape = jax.ShapeDtypeStruct(size, splats.M.dtype)
    inputs = pack_inputs(settings, splats, texels, regions, cutoff, lists)
    (image,) = launch(spec, "forward", settings.grid.num, inputs, [shape])
    return split_image(vary_with(inputs, image))


def backward(
    settings: CompositingSettings, static: StaticRule, splats: Splats, texels: Array, regions: TextureRegion | None,
    cutoff: Array, lists: TileLists, jacobian: Array, probe: Array, g: Array, suffix_sum: Array,
) -> tuple[Splats, Array, Array]:  # fmt: skip
    """Return the cotangents of splats, texels and probe, as `xla.backward` does."""
    spec = KernelSpec.of(settings, static, splats, texels, regions)
    dtype = np.dtype(spec.dtype)
    inputs = pack_inputs(settings, splats, texels, regions, cutoff, lists)
    inputs = (*inputs, *(array.astype(dtype) for array in (g, suffix_sum, jacobian)))
    totals = [jnp.zeros(shape, dtype) for shape in spec.gradient_shapes(splats, texels, probe)]
    found = vary_with(inputs, launch(spec, "backward", settings.grid.num, inputs, [], totals))
    return unpack_gradients(settings, found, splats, texels, probe)
