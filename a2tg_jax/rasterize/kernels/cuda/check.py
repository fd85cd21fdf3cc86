"""Check of the CUDA kernels on a GPU before they draw anything: XLA must draw the same, and find the same gradient."""

import contextlib
import hashlib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxlib.version import __version__ as jaxlib_version

from a2tg_jax.appearance import Appearance, StaticShading, Texture, gaussian_cutoff
from a2tg_jax.base.atomic import write_whole
from a2tg_jax.base.machine import cache_folder
from a2tg_jax.base.operating_system import cuda_of_driver
from a2tg_jax.core.bilinear import TextureRegion
from a2tg_jax.core.numerics import MOST_DIFFERENCE, relative_difference
from a2tg_jax.rasterize.kernels import xla
from a2tg_jax.rasterize.kernels.cuda import composite as cuda
from a2tg_jax.rasterize.kernels.cuda.source import source
from a2tg_jax.rasterize.kernels.jaxprs import in_clean_context
from a2tg_jax.rasterize.splats import PassInputs, PassSettings, Splats
from a2tg_jax.rasterize.tiles import TileGrid, tile_lists

NUM = 400
"""Number of splats: lists of tiles then have several batches of 64."""
GRID = TileGrid(width=48, height=32, tile_size=16)


def failure() -> str | None:
    """Return why the kernels cannot be used on this process's GPU; None if they can, or if there is no GPU.

    Call it at any time, also while JAX traces or compiles: the check runs on a thread of its own. The first process
    keeps the result in the cache folder, for this GPU, driver, jaxlib and text of the kernels.
    """
    return in_clean_context(_failure)


def _failure() -> str | None:
    try:
        device = jax.local_devices(backend="cuda")[0]
    except RuntimeError:  # Something is compiled for a GPU of another machine.
        return None
    driver = Path("/proc/driver/nvidia/version")
    version = driver.read_text(encoding="utf-8") if driver.is_file() else cuda_of_driver()
    key = version, device.device_kind, jax.__version__, jaxlib_version, source(_inputs()[0].kernel_settings, "cuda")
    # An empty file means that the kernels agree.
    file = cache_folder() / f"cuda-kernels-{hashlib.sha256(repr(key).encode()).hexdigest()[:16]}.txt"
    with contextlib.suppress(OSError):
        return file.read_text(encoding="utf-8") or None
    try:
        difference = largest_difference(device)
        reason = "" if difference <= MOST_DIFFERENCE else f"CUDA kernels differ from XLA by {100 * difference:.2g} %"
    except Exception as error:  # Whatever it is, XLA can draw.
        reason = " ".join(f"CUDA kernels failed: {type(error).__name__}: {error}".split())[:300]
    reason = reason and f"{reason}; please report this, and delete {file} to check them again"
    with contextlib.suppress(OSError):
        write_whole(file, reason)
    return reason or None


def largest_difference(device: object) -> float:
    """Return the largest difference between kernels and XLA on a GPU, of a textured view's arrays and gradient."""
    settings, arrays = _inputs()

    def drawn(kernels: Any, *arrays: Any) -> list[Any]:
        splats, texels, regions, cutoff, jacobian, probe, g = arrays
        # A capacity for every splat in every tile: nothing overflows.
        lists = tile_lists(splats.M, cutoff, settings.near_plane, GRID, NUM * GRID.num)
        inputs = PassInputs(splats, texels, regions, cutoff, lists)
        channels, transmittance = kernels.forward(settings, inputs)
        # The transmittance has the cotangent 1.
        suffix_sum = jnp.sum(g * channels, axis=1) + transmittance
        gradients = kernels.backward(settings, inputs, jacobian, probe, g, suffix_sum)
        return jax.tree.leaves((channels, transmittance, gradients))

    with jax.default_device(device):
        draw = jax.jit(drawn, static_argnums=0)
        results = draw(cuda, *arrays)
        references = draw(xla, *arrays)
    return relative_difference(results, references)


def _inputs() -> tuple[PassSettings, tuple[Any, ...]]:
    """Return the settings of the pass, the arrays of kernels and the cotangent of the image."""
    rng = np.random.default_rng(0)

    def draw(low: float, high: float, *shape: int) -> Any:
        return rng.uniform(low, high, (*shape, NUM)).astype(np.float32).T

    x = draw(0, GRID.width)
    y = draw(0, GRID.height)
    depth = draw(1, 3)
    angle = draw(1, 4)
    u = draw(1, 6)
    v = draw(1, 6)
    u_tilt = draw(-0.05, 0.05)
    v_tilt = draw(-0.05, 0.05)
    # Columns of M: the axes u and v of a splat of 1 to 6 pixels, slightly inclined, and its centre.
    rows = (
        (u * np.cos(angle) + x * u_tilt, -v * np.sin(angle) + x * v_tilt, x),
        (u * np.sin(angle) + y * u_tilt, v * np.cos(angle) + y * v_tilt, y),
        (u_tilt, v_tilt, np.ones_like(x)),
    )
    M: Any = np.moveaxis(depth * np.asarray(rows, np.float32), -1, 0)
    normals = draw(-1, 1, 3)
    nothing = draw(0, 0, 0)
    splats = Splats(M, draw(0, 1, 3), draw(0.05, 0.6), normals, nothing)
    texels = draw(0.1, 0.9, 4, 4).reshape(-1, 4)
    # The kernels read textures of one texel in another way than larger ones.
    sides: Any = 1 + np.arange(NUM, dtype=np.int32) % 2
    first: Any = 4 * np.arange(NUM, dtype=np.int32)
    regions = TextureRegion(first, sides, sides)
    static = StaticShading.of(Appearance(texture=Texture()))
    settings = PassSettings(static, 0, 4, 3, "float32", GRID, 0.2, True, "position", tile_batch=0)
    g = rng.normal(size=(GRID.num, settings.num_channels, settings.num_pixels)).astype(np.float32)
    jacobian = np.diag([40, 40, 1]).astype(np.float32)
    probe = draw(0, 0, 4)
    return settings, (splats, texels, regions, gaussian_cutoff(splats.opacities), jacobian, probe, g)
