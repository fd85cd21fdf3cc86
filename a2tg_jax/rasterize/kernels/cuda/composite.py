"""Compositing by CUDA kernels on NVIDIA GPUs. Each thread composites one pixel; `tiles.c` is the kernel.

What a splat adds to the gradient is summed over warps and added atomically: gradients are reproducible to rounding.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.core.bilinear import TextureRegion
from a2tg_jax.rasterize.kernels.cuda.launch import launch
from a2tg_jax.rasterize.kernels.cuda.source import source
from a2tg_jax.rasterize.kernels.packing import pack_inputs, split_image, unpack_gradients
from a2tg_jax.rasterize.kernels.traced import refusal_of
from a2tg_jax.rasterize.splats import CompositingSettings, KernelSpec, Splats
from a2tg_jax.rasterize.tiles import TileLists


@functools.cache
def refusal(spec: KernelSpec) -> str | None:
    """Return why an appearance cannot run in GPU kernels; None if it can."""
    if spec.has_rays:
        return "CUDA kernels do not draw cameras with rays"
    return refusal_of(spec, functools.partial(source, dialect="cuda"))


def forward(
    settings: CompositingSettings, splats: Splats, texels: Array, regions: TextureRegion | None,
    cutoff: Array, lists: TileLists,
) -> tuple[Array, Array]:  # fmt: skip
    """Return channels [tiles, D, P] and transmittance [tiles, P], as `xla.forward` does."""
    spec = settings.kernel
    size = settings.grid.num, spec.num_channels + 1, spec.tile_size**2
    shape = jax.ShapeDtypeStruct(size, splats.M.dtype)
    inputs = pack_inputs(settings, splats, texels, regions, cutoff, lists)
    (image,) = launch(spec, "forward", settings.grid.num, inputs, [shape])
    return split_image(image)


def backward(
    settings: CompositingSettings, splats: Splats, texels: Array, regions: TextureRegion | None,
    cutoff: Array, lists: TileLists, jacobian: Array, probe: Array, g: Array, suffix_sum: Array,
) -> tuple[Splats, Array, Array]:  # fmt: skip
    """Return the cotangents of splats, texels and probe, as `xla.backward` does."""
    spec = settings.kernel
    dtype = np.dtype(spec.dtype)
    inputs = pack_inputs(settings, splats, texels, regions, cutoff, lists)
    inputs = (*inputs, *(array.astype(dtype) for array in (g, suffix_sum, jacobian)))
    totals = [jnp.zeros(shape, dtype) for shape in spec.gradient_shapes(splats, texels, probe)]
    found = launch(spec, "backward", settings.grid.num, inputs, [], totals)
    return unpack_gradients(settings, found, splats, texels, probe)
