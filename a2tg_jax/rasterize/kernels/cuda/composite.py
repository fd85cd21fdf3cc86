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
from a2tg_jax.rasterize.kernels.jaxprs import Untranslatable
from a2tg_jax.rasterize.kernels.manual_axes import vary_with
from a2tg_jax.rasterize.kernels.packing import pack_inputs, unpack_splats
from a2tg_jax.rasterize.kernels.traced import KernelSpec, place_of
from a2tg_jax.rasterize.splats import CompositingSettings, Splats
from a2tg_jax.rasterize.tiles import TileLists


def refusal(settings: CompositingSettings, rule: AppearanceRule, splats: Splats) -> str | None:
    """Return why a rule cannot run in GPU kernels; None if it can."""
    return _refusal(KernelSpec.of(settings, StaticRule.of(rule), splats, rule.texels, rule.regions))


@functools.cache
def _refusal(spec: KernelSpec) -> str | None:
    try:
        source(spec, "cuda")
    except Untranslatable as error:
        return str(error) + (place_of(error.primitive, spec) if error.primitive else "")
    return None


def forward(
    settings: CompositingSettings, static: StaticRule, splats: Splats, texels: Array, regions: TextureRegion | None,
    cutoff: Array, lists: TileLists,
) -> tuple[Array, Array]:  # fmt: skip
    """As `xla.forward`: channels [tiles, 1, D, P] and transmittance [tiles, 1, P]."""
    spec = KernelSpec.of(settings, static, splats, texels, regions)
    size = settings.grid.num, spec.num_channels + 1, spec.tile_size**2
    shape = jax.ShapeDtypeStruct(size, splats.M.dtype)
    inputs = pack_inputs(settings, splats, texels, regions, cutoff, lists)
    (image,) = launch(spec, "forward", settings.grid.num, inputs, [shape])
    image = vary_with(inputs, image)[:, None]
    return image[:, :, :-1], image[:, :, -1]


def backward(
    settings: CompositingSettings, static: StaticRule, splats: Splats, texels: Array, regions: TextureRegion | None,
    cutoff: Array, lists: TileLists, jacobian: Array, probe: Array, g: Array, suffix_sum: Array,
) -> tuple[Splats, Array, Array]:  # fmt: skip
    """As `xla.backward`."""
    spec = KernelSpec.of(settings, static, splats, texels, regions)
    dtype = np.dtype(spec.dtype)
    inputs = pack_inputs(settings, splats, texels, regions, cutoff, lists)
    inputs = (*inputs, *(array.astype(dtype) for array in (g, suffix_sum, jacobian)))
    totals = [
        jnp.zeros((splats.M.shape[0], spec.num_floats), dtype),
        jnp.zeros(texels.shape, dtype),
        jnp.zeros(probe.shape if spec.statistic else (1, 4), dtype),
    ]
    packed, d_texels, d_probe = vary_with(inputs, launch(spec, "backward", settings.grid.num, inputs, [], totals))
    d_splats = unpack_splats(packed, splats, spec.has_geometry)
    d_probe = d_probe.astype(probe.dtype) if spec.statistic else jnp.zeros_like(probe)
    return d_splats, d_texels.astype(texels.dtype), d_probe
