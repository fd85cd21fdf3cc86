"""`a2tg doctor`: what this machine computes with, and whether all its compositors agree."""

import os
import platform
import time
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version

import jax
import jax.numpy as jnp
import numpy as np

from a2tg_jax import Camera, Gaussians, RenderSettings, Textures, allocate_textures, init_from_points, render_image
from a2tg_jax.base.memory import memory_limit
from a2tg_jax.base.operating_system import cuda_of_driver
from a2tg_jax.base.threads import VARIABLE, num_threads
from a2tg_jax.core.numerics import MOST_DIFFERENCE, relative_difference
from a2tg_jax.host.startup import compilation_cache_folder
from a2tg_jax.rasterize.kernels import platforms
from a2tg_jax.rasterize.splats import Compositor

PACKAGES = ("jax", "jaxlib", "jax-cuda13-plugin", "jaxopt", "numpy", "llvmlite", "nvidia-cuda-nvrtc", "pycolmap")
WIDTH = 96
HEIGHT = 64
NUM = 400


def diagnose() -> None:
    """Print what this machine computes with. Raises ValueError if its compositors differ."""
    device = jax.devices()[0]
    cuda = cuda_of_driver()
    wanted = os.environ.get(VARIABLE)
    # As JAX names it when it compiles; a device calls both CUDA and ROCm "gpu".
    of_jax = "cuda" if "cuda" in device.client.platform_version.lower() else device.platform
    kinds = ["the CPU" if one.platform == "cpu" else f"{one.platform} ({one.device_kind})" for one in jax.devices()]
    machine = f"Python {platform.python_version()} on {platform.system()} {platform.machine()}"
    lines = {
        "a2tg-jax": f"{version('a2tg-jax')}, {machine}",
        "packages": ", ".join(f"{name} {_version(name)}" for name in PACKAGES),
        "devices": ", ".join(kinds),
        "driver": f"NVIDIA's, for CUDA {cuda[0]}.{cuda[1]}" if cuda else "no NVIDIA driver is found",
        "threads": f"{num_threads()} ({f'{VARIABLE}={wanted}' if wanted else f'{VARIABLE} is not set'})",
        "memory": f"{memory_limit() / 1e9:.1f} GB may be used",
        "XLA_FLAGS": os.environ.get("XLA_FLAGS") or "not set",
        "cache": str(compilation_cache_folder()),
        "compositor": f"{platforms.choose('auto', of_jax)} is the choice of 'auto'",
    }
    for name, text in lines.items():
        _print(name, text)
    missing = {name: text for name, text in platforms.REMEDIES.items() if not platforms.is_available(name, of_jax)}
    for name, remedy in missing.items():
        _print("", f"{name} is not available: it needs {remedy}")
    largest = _compare([name for name in platforms.PLATFORMS if platforms.is_available(name, of_jax)])
    if not largest <= MOST_DIFFERENCE:
        raise ValueError(f"the compositors differ by {largest:.2g}; please report this with the lines above")
    _print("verdict", _verdict(of_jax, missing, has_driver=cuda is not None))


def _verdict(platform: str, missing: Mapping[Compositor, str], *, has_driver: bool) -> str:
    """Return how well everything works on a machine whose compositors agree.

    Args:
      platform: JAX's name of the device's platform.
      missing: what each missing compositor needs.
      has_driver: whether the machine has an NVIDIA driver.
    """
    if platform == "cpu" and has_driver:
        return "everything works, but on the CPU: JAX does not find the NVIDIA GPU; pip install 'a2tg-jax[cuda13]'"
    for name, remedy in missing.items():
        if platforms.PLATFORMS[name] == platform:
            return f"everything works, but slowly: {name} is not available, which needs {remedy}"
    return "everything works on this machine"


def _print(name: str, text: str) -> None:
    print(f"{name:12}{text}", flush=True)


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def _compare(available: Sequence[Compositor]) -> float:
    """Render a textured image by each compositor, with gradients; return the largest `relative_difference` from XLA's,
    infinite if it is not finite."""
    rng = np.random.default_rng(0)
    gaussians = init_from_points(rng.uniform(-1, 1, (NUM, 3)), rng.uniform(0, 1, (NUM, 3)), opacity=0.5)
    textures = allocate_textures(np.tile([[1, 1], [2, 4]], (NUM // 2, 1)))
    K = [[WIDTH, 0, WIDTH / 2], [0, WIDTH, HEIGHT / 2], [0, 0, 1]]
    camera = Camera(jnp.eye(4, dtype=jnp.float32).at[2, 3].set(4), jnp.asarray(K, jnp.float32), WIDTH, HEIGHT)

    def loss(gaussians: Gaussians, textures: Textures, settings: RenderSettings) -> tuple[jax.Array, jax.Array]:
        color = render_image(gaussians, camera, textures, settings=settings).color
        return jnp.sum(color**2), color

    arrays = {}
    largest = 0.0
    for name in ("xla", *available):  # First, to compare the others with it.
        start = time.perf_counter()
        settings = RenderSettings(compositor=name, capacity=1 << 16)  # Room for all Gaussians in all tiles.
        gradient = jax.grad(loss, argnums=(0, 1), has_aux=True, allow_int=True)(gaussians, textures, settings)
        leaves = map(np.asarray, jax.tree.leaves(gradient))
        arrays[name] = [leaf for leaf in leaves if np.issubdtype(leaf.dtype, np.floating)]
        text = f"{name}: {time.perf_counter() - start:.2f} s with compiling"
        if name != "xla":
            difference = float(np.nan_to_num(relative_difference(arrays[name], arrays["xla"]), nan=np.inf))
            largest = max(largest, difference)
            text += f", at most {difference:.1g} from XLA's image and gradients"
        _print("render", text)
    return largest
