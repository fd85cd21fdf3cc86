"""A few Gaussians and a change of world, for tests of files and models; rotations and places by scipy and numpy."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from a2tg_jax import Gaussians, Similarity

SH_C0 = 0.5 / np.sqrt(np.pi)


def rotations(quats) -> np.ndarray:
    """Rotation matrices [N, 3, 3] of quaternions wxyz [N, 4] of any length."""
    return Rotation.from_quat(np.asarray(quats), scalar_first=True).as_matrix()


def centers_of(viewmats) -> np.ndarray:
    """Places [V, 3] of cameras."""
    return np.linalg.inv(viewmats)[:, :3, 3]


def matrix_of(similarity: Similarity) -> np.ndarray:
    """A similarity as a matrix [4, 4] for columns."""
    matrix = np.eye(4)
    matrix[:3, :3] = similarity.scale * similarity.rotation
    matrix[:3, 3] = similarity.translation
    return matrix


def moved_by(twist, viewmat) -> np.ndarray:
    """A camera [4, 4] followed by a twist [6] about its own centre: a rotation vector and a translation."""
    moved = np.array(viewmat, np.float32)
    moved[:3] = Rotation.from_rotvec(twist[:3]).as_matrix() @ moved[:3]
    moved[:3, 3] += twist[3:]
    return moved


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
