"""What is measured: the random workload, textures for it, and trained scenes."""

import jax
import jax.numpy as jnp
import numpy as np

import a2tg_jax

TEXTURE_KINDS = ("none", "mixed", "4x4", "16x16")


def random_scene(num: int, width: int, height: int, seed: int = 0) -> tuple[a2tg_jax.Gaussians, a2tg_jax.Camera]:
    """Means uniform in a unit cube seen from 1.5 away, scales log-uniform in [0.005, 0.03], opacities uniform in
    [0.1, 0.9], SH degree 3, focal length 0.8 times the width."""
    rng = np.random.default_rng(seed)
    opacities = rng.uniform(0.1, 0.9, num)
    gaussians = a2tg_jax.Gaussians(
        means=rng.uniform(-0.5, 0.5, (num, 3)),
        quats=rng.normal(size=(num, 4)),
        log_scales=rng.uniform(np.log(0.005), np.log(0.03), (num, 2)),
        logit_opacities=np.log(opacities / (1 - opacities)),
        sh=rng.normal(size=(num, 16, 3)) * 0.2,
    )
    viewmat = np.eye(4)
    viewmat[2, 3] = 1.5
    K = np.array([[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1]])
    as_float = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    return jax.tree.map(as_float, gaussians), a2tg_jax.Camera(as_float(viewmat), as_float(K), width, height)


def random_textures(num: int, kind: str, seed: int = 1):
    """Textures of one kind: none, 70% 1×1 and 30% up to 4×4 ("mixed"), or all of one size."""
    if kind == "none":
        return None, None
    rng = np.random.default_rng(seed)
    sizes = np.ones((num, 2), np.int64)
    if kind == "mixed":
        is_larger = rng.uniform(size=num) < 0.3
        sizes[is_larger] = rng.choice([1, 2, 4], size=(is_larger.sum(), 2))
    else:
        sizes[:] = int(kind.split("x")[0])
    textures, layout = a2tg_jax.allocate_textures(sizes)
    noise = lambda x: x + jnp.asarray(rng.normal(size=x.shape) * [0.2, 0.2, 0.2, 0], jnp.float32)  # noqa: E731
    return jax.tree.map(noise, textures), layout
