"""Flat Gaussians in formats of 3D Gaussians: ellipsoids with a thin third axis, and flat Gaussians of these again."""

import dataclasses
import warnings
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from a2tg_jax.appearance.copies import LARGEST_OPACITY
from a2tg_jax.core.gaussians import Gaussians, logit
from a2tg_jax.model import Model

THICKNESS = 1e-3
"""Ratio of the third scale of a flat Gaussian in a file to its shorter one."""
LEAST_OPACITY = 1e-6
AXES_TO_NORMAL = np.array([[0.5, 0.5, 0.5, 0.5], [0.5, -0.5, -0.5, -0.5], [1.0, 0.0, 0.0, 0.0]], np.float32)
"""Row k: the rotation (wxyz) of the axes among themselves that makes the k-th the third."""


def plain_splats(model: Model) -> Gaussians:
    """Return the Gaussians of a model, opaque by themselves, with all spherical harmonics that they have."""
    shown = model.gaussians, model.params, model.layout
    gaussians = dataclasses.replace(model.gaussians, sh=jnp.asarray(model.sh))
    if model.appearance.has_own_opacities:
        return gaussians
    opacities = jnp.clip(model.appearance.opacities(*shown), LEAST_OPACITY, LARGEST_OPACITY)
    return dataclasses.replace(gaussians, logit_opacities=logit(opacities))


def with_third_axis(log_scales: np.ndarray) -> np.ndarray:
    """Return log-scales [N, 3] of flat ones [N, 2]: the third is a thousandth of the shorter."""
    third = log_scales.min(axis=1, keepdims=True) + np.log(THICKNESS)
    return np.concatenate([log_scales, third], axis=1)


def without_thinnest_axis(quats: np.ndarray, log_scales: np.ndarray, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return quaternions [N, 4] and log-scales [N, 2] of ellipsoids [N, 3], with the thinnest axis as the normal.

    The axes are moved around in their cycle, so that the rotation stays one; of two equally thin the later goes.
    """
    thinnest = 2 - np.argmin(log_scales[:, ::-1], axis=1)
    kept = np.take_along_axis(log_scales, (thinnest[:, None] + np.array([[1, 2]])) % 3, axis=1)
    dropped = np.take_along_axis(log_scales, thinnest[:, None], axis=1)[:, 0]
    num_thick = np.count_nonzero(dropped > kept.min(axis=1) + np.log(2 * THICKNESS))
    if num_thick:
        message = f"{path}: holds 3D Gaussians (scale_2), {num_thick} of them not flat; their thinnest axis is dropped"
        warnings.warn(message, stacklevel=4)
    return _quaternion_product(quats, AXES_TO_NORMAL[thinnest]), kept


def _quaternion_product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return [N, 4] wxyz: the second rotation, and after it the first."""
    w, x, y, z = first.T
    a, b, c, d = second.T
    return np.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ],
        axis=-1,
    )
