"""The random workload as numpy arrays, for this library and for programs beside it that have no JAX."""

from typing import NamedTuple

import numpy as np


class RandomSplats(NamedTuple):
    """N flat Gaussians."""

    means: np.ndarray
    """[N, 3], uniform in a unit cube."""
    quats: np.ndarray
    """[N, 4] (w, x, y, z), not of unit length."""
    scales: np.ndarray
    """[N, 2], log-uniform in [0.005, 0.03]."""
    opacities: np.ndarray
    """[N], uniform in [0.1, 0.9]."""
    sh: np.ndarray
    """[N, 16, 3], degree 3."""


def random_splats(num: int) -> RandomSplats:
    """Return the Gaussians of the workload."""
    rng = np.random.default_rng(0)
    opacities = rng.uniform(0.1, 0.9, num)
    return RandomSplats(
        means=rng.uniform(-0.5, 0.5, (num, 3)),
        quats=rng.normal(size=(num, 4)),
        scales=np.exp(rng.uniform(np.log(0.005), np.log(0.03), (num, 2))),
        opacities=opacities,
        sh=rng.normal(size=(num, 16, 3)) * 0.2,
    )


def camera_matrices(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Return viewmat [4, 4] from 1.5 away and K [3, 3] with a focal length of 0.8 times the width."""
    viewmat = np.eye(4)
    viewmat[2, 3] = 1.5
    return viewmat, np.array([[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1]])


def random_image(width: int, height: int) -> np.ndarray:
    """Return the target image, [H, W, 3] float32."""
    return np.random.default_rng(3).uniform(size=(height, width, 3)).astype(np.float32)
