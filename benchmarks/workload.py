"""The measured workload: random Gaussians as this library's arrays, and textures for them."""

import dataclasses

import jax.numpy as jnp
import numpy as np

import a2tg_jax
from benchmarks.arrays import camera_matrices, random_splats


def random_scene(num: int, width: int, height: int) -> tuple[a2tg_jax.Gaussians, a2tg_jax.Camera]:
    """Return the Gaussians and the camera of `benchmarks.arrays`."""
    splats = random_splats(num)
    viewmat, K = camera_matrices(width, height)
    as_float = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    gaussians = a2tg_jax.Gaussians(
        means=as_float(splats.means),
        quats=as_float(splats.quats),
        log_scales=as_float(np.log(splats.scales)),
        logit_opacities=as_float(np.log(splats.opacities / (1 - splats.opacities))),
        sh=as_float(splats.sh),
    )
    return gaussians, a2tg_jax.Camera(as_float(viewmat), as_float(K), width, height)


def random_textures(num: int, kind: str, seed: int = 1) -> a2tg_jax.Textures | None:
    """Return textures of one kind: none, 70% 1×1 and 30% up to 4×4 ("mixed"), or all of one size."""
    if kind == "none":
        return None
    rng = np.random.default_rng(seed)
    sizes = np.ones((num, 2), np.int64)
    if kind == "mixed":
        is_larger = rng.uniform(size=num) < 0.3
        sizes[is_larger] = rng.choice([1, 2, 4], size=(is_larger.sum(), 2))
    else:
        sizes[:] = int(kind.split("x")[0])
    textures = a2tg_jax.allocate_textures(sizes)
    noise = lambda x: x + jnp.asarray(rng.normal(size=x.shape) * [0.2, 0.2, 0.2, 0], jnp.float32)  # noqa: E731
    return dataclasses.replace(textures, buckets=tuple(map(noise, textures.buckets)))
