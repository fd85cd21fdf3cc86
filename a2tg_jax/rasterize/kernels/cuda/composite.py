"""Compositing by CUDA kernels on NVIDIA GPUs. Each thread composites one pixel; `tiles.c` is the kernel.

What a splat adds to the gradient is summed over warps and added atomically: gradients are reproducible to rounding.

XLA's GPU backend launches PTX that a custom call carries (`launch`). A kernel gets pointers to the operands, then to
the results.
"""

import functools
from collections.abc import Sequence

import jax
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
def refusal(kernel: PassSettings) -> str | None:
    """Return why an appearance cannot run in GPU kernels; None if it can."""
    if kernel.has_rays:
        return "CUDA kernels do not draw cameras with rays"
    return refusal_of(kernel, functools.partial(source, dialect="cuda"))


def forward(settings: PassSettings, inputs: PassInputs) -> tuple[Array, Array]:
    """Return channels [tiles, D, P] and transmittance [tiles, P], as `xla.forward` does."""
    size = settings.grid.num, settings.num_channels + 1, settings.num_pixels
    shape = jax.ShapeDtypeStruct(size, inputs.splats.M.dtype)
    (image,) = launch(settings.kernel_settings, "forward", settings.grid.num, pack_inputs(settings, inputs), [shape])
    return image[:, :-1], image[:, -1]


def backward(
    settings: PassSettings, inputs: PassInputs, jacobian: Array, probe: Array, g: Array, suffix_sum: Array
) -> tuple[Splats, Array, Array]:
    """Return the cotangents of splats, texels and probe, as `xla.backward` does."""
    dtype = np.dtype(settings.dtype)
    operands = (*pack_inputs(settings, inputs), *(array.astype(dtype) for array in (g, suffix_sum, jacobian)))
    # Blocks add to these atomically: they start as zeros, and are operands that the call returns.
    totals = [jnp.zeros(shape, dtype) for shape in settings.gradient_shapes(inputs)]
    gradients = launch(settings.kernel_settings, "backward", settings.grid.num, operands, [], totals)
    return unpack_gradients(settings, gradients, inputs, probe)


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
    call = jax.ffi.ffi_call(TARGET, shapes, input_output_aliases=aliases, vmap_method="sequential")
    attributes = {f"{kind}_{axis}": np.int32(1) for kind in ("grid", "block") for axis in "xyz"}
    attributes["grid_x"] = np.int32(num_tiles * num_parts(tile_size))
    attributes["block_x"] = np.int32(block_threads(tile_size))
    attributes["shared_mem_bytes"] = np.int32(0)  # Beyond what the kernel declares.
    return list(call(*inputs, *totals, name=name, kernel_type="ptx", kernel_data=program, **attributes))
