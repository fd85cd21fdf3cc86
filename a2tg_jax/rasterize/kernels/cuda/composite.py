"""Compositing by CUDA kernels on NVIDIA GPUs. Each thread composites one pixel; `tiles.c` is the kernel.

What a splat adds to the gradient is summed over warps and added atomically: gradients are reproducible to rounding.

XLA's GPU backend launches PTX that a custom call carries (`launch`). A kernel gets pointers to the operands, then to
the results. One launch composites the tiles of all V views of a `vmap`.
"""

import functools
from collections.abc import Sequence
from typing import Literal

import jax
import jax.custom_batching
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.rasterize.kernels.cuda import nvrtc
from a2tg_jax.rasterize.kernels.cuda.source import block_threads, num_parts, source
from a2tg_jax.rasterize.kernels.jaxprs import refusal_of
from a2tg_jax.rasterize.splats import PassInputs, PassSettings, Splats, pack_inputs, unpack_gradients

TARGET = "__gpu$xla.gpu.ptx"
DEFAULT_CAPABILITY = "9.0"
"""Compute capability that is compiled for if there is no GPU."""


@functools.cache
def refusal(_: str, kernel: PassSettings) -> str | None:
    """Return why an appearance cannot run in GPU kernels; None if it can. Both passes are one source."""
    if kernel.has_rays:
        return "CUDA kernels do not draw cameras with rays"
    return refusal_of(kernel, functools.partial(source, dialect="cuda"))


def forward(settings: PassSettings, inputs: PassInputs) -> tuple[Array, Array]:
    """Return channels [tiles, D, P] and transmittance [tiles, P], as `xla.forward` does."""
    (image,) = _run(settings, "forward", pack_inputs(settings, inputs))
    return image[:, :-1], image[:, -1]


def backward(
    settings: PassSettings, inputs: PassInputs, jacobian: Array, probe: Array, g: Array, suffix_sum: Array
) -> tuple[Splats, Array, Array]:
    """Return the cotangents of splats, texels and probe, as `xla.backward` does."""
    dtype = np.dtype(settings.dtype)
    operands = (*pack_inputs(settings, inputs), *(array.astype(dtype) for array in (g, suffix_sum, jacobian)))
    return unpack_gradients(settings, _run(settings, "backward", operands), inputs, probe)


def _run(settings: PassSettings, name: Literal["forward", "backward"], operands: Sequence[Array]) -> list[Array]:
    """Run a kernel for a view, or under `vmap` for all views at once."""

    @jax.custom_batching.custom_vmap
    def of_views(*operands: Array) -> list[Array]:
        return _launch_views(settings, name, operands)

    @of_views.def_vmap
    def of_batch(num: int, is_batched: Sequence[bool], *operands: Array) -> tuple[list[Array], list[bool]]:
        pairs = zip(operands, is_batched, strict=True)
        own = [x if has_axis else jnp.broadcast_to(x, (num, *x.shape)) for x, has_axis in pairs]
        num_views = own[0].shape[1]
        # [num, V, ...] as [num · V, ...]; without −1, because arrays may be empty.
        results = of_views(*(x.reshape(num * num_views, *x.shape[2:]) for x in own))
        return [x.reshape(num, num_views, *x.shape[1:]) for x in results], [True] * len(results)

    return [x[0] for x in of_views(*(x[None] for x in operands))]


def _launch_views(settings: PassSettings, name: str, operands: Sequence[Array]) -> list[Array]:
    """Run a kernel for V views: the operands of a view have one more axis [V], and so have the results.

    Splats, texels and lists of all views are behind each other, so that indices grow by what the views before have.
    """
    ids, starts, splats, regions, texels, size, *cotangents = operands
    num_views, capacity = ids.shape
    num_splats = splats.shape[1]
    num_texels = texels.shape[1]
    num_tiles = settings.grid.num
    dtype = np.dtype(settings.dtype)
    if num_views * max(capacity, num_splats, num_texels, starts.shape[1]) > np.iinfo(np.int32).max:
        each = jax.lax.map(lambda own: _launch_views(settings, name, [x[None] for x in own]), tuple(operands))
        return [x[:, 0] for x in each]

    def moved(indices: Array, stride: int) -> Array:
        first = jnp.arange(num_views, dtype=jnp.int32) * stride
        return indices + first.reshape(-1, *(1,) * (indices.ndim - 1))

    if settings.num_values:
        regions = jnp.concatenate([moved(regions[..., :1], num_texels), regions[..., 1:]], axis=-1)
    size = jnp.append(size[0], jnp.int32(num_tiles))
    operands = (moved(ids, num_splats), moved(starts, capacity), splats, regions, texels, size, *cotangents)
    kernel = settings.kernel_settings
    if name == "forward":
        shape = num_views, num_tiles, settings.num_channels + 1, settings.num_pixels
        return launch(kernel, name, num_views * num_tiles, operands, [jax.ShapeDtypeStruct(shape, dtype)])
    # Blocks add to these atomically: they start as zeros, and are operands that the call returns.
    shapes = settings.gradient_shapes(num_splats, texels.shape[1:])
    totals = [jnp.zeros((num_views, *shape), dtype) for shape in shapes]
    return launch(kernel, name, num_views * num_tiles, operands, [], totals)


def launch(
    kernel: PassSettings, name: str, num_tiles: int, inputs: Sequence[Array], results: Sequence[object],
    totals: Sequence[Array] = (),
) -> list[Array]:  # fmt: skip
    """Run a kernel of `source.source` on a GPU.

    Its parameters are pointers to the inputs, which it reads, then to the results (given by shape and dtype), which it
    writes whole, or to the totals, which it adds to. Returns the results, then the totals.
    """
    try:
        capabilities = [device.compute_capability for device in jax.local_devices(backend="cuda")]
    except RuntimeError:
        capabilities = [DEFAULT_CAPABILITY]
    capability = min(capabilities, key=lambda text: [int(part) for part in text.split(".")])
    program = nvrtc.ptx(source(kernel, "cuda"), capability)
    tile_size = kernel.grid.tile_size
    shapes = [*results, *(jax.typeof(total) for total in totals)]
    # XLA passes operands before results: an aliased operand and its result are one buffer, passed twice.
    aliases = {len(inputs) + k: len(results) + k for k in range(len(totals))}
    call = jax.ffi.ffi_call(TARGET, shapes, input_output_aliases=aliases)
    attributes = {f"{kind}_{axis}": np.int32(1) for kind in ("grid", "block") for axis in "xyz"}
    attributes["grid_x"] = np.int32(num_tiles * num_parts(tile_size))
    attributes["block_x"] = np.int32(block_threads(tile_size))
    attributes["shared_mem_bytes"] = np.int32(0)  # Beyond what the kernel declares.
    return list(call(*inputs, *totals, name=name, kernel_type="ptx", kernel_data=program, **attributes))
