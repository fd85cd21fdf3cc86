"""A few Gaussians and a change of world, for tests of files and models."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from a2tg_jax import Gaussians, Similarity


def some_gaussians(num: int = 7, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    draw = lambda *shape: jnp.asarray(rng.normal(size=shape), jnp.float32)  # noqa: E731
    return Gaussians(draw(num, 3), draw(num, 4), draw(num, 2) - 2, draw(num), 0.3 * draw(num, 16, 3))


def some_world(seed: int = 1) -> Similarity:
    rng = np.random.default_rng(seed)
    return Similarity(1.7, Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))


def assert_same(a: Gaussians, b: Gaussians, atol: float = 0.0) -> None:
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(np.asarray(x), np.asarray(y), atol=atol, rtol=0)
