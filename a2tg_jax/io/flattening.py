"""Flat Gaussians from the ellipsoids of other programs' files, and thin ellipsoids from flat Gaussians."""

import warnings

import numpy as np

from a2tg_jax.host.text import counted

THICKNESS = 1e-3
"""Ratio of the third scale of a flat Gaussian in a file to its shorter one."""
AXES_TO_NORMAL = np.array([[0.5, 0.5, 0.5, 0.5], [0.5, -0.5, -0.5, -0.5], [1.0, 0.0, 0.0, 0.0]], np.float32)
"""Row k: the rotation (wxyz) of the axes among themselves that makes the k-th the third."""


def third_log_scales(log_scales: np.ndarray) -> np.ndarray:
    """Return the logarithms [N, 1] of third scales: of flat Gaussians [N, 2], a thousandth of the shorter one."""
    third: np.ndarray = log_scales.min(axis=1, keepdims=True) + np.log(THICKNESS)
    return third


def whole_rows(name: str, scales: np.ndarray, *columns: np.ndarray) -> np.ndarray:
    """Return which rows [N] have finite numbers only. The others are counted in a warning.

    If no row is finite, all are returned, for the checks of a model to refuse.

    Args:
      name: the file, for the warning.
      scales: [N, 2] or [N, 3], or their logarithms. The smallest of three may be −inf: `flattened` drops it.
      columns: other arrays [N, ...].
    """
    seen = np.sort(scales, axis=1)[:, -2:]  # NaN is sorted to the end.
    finite = [np.isfinite(column).all(axis=tuple(range(1, column.ndim))) for column in (seen, *columns)]
    is_whole: np.ndarray = np.logical_and.reduce(finite)
    bad = np.flatnonzero(~is_whole)
    if len(bad) == len(is_whole):
        return np.ones(len(bad), bool)
    if len(bad):
        message = (
            f"{name}: {counted(len(bad), 'Gaussian')} of {len(is_whole):,} left out, with NaN or infinite numbers; the "
            f"first is row {bad[0]:,} (from 0)"
        )
        warnings.warn(message, stacklevel=4)
    return is_whole


def flattened(quats: np.ndarray, log_scales: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return quaternions [N, 4] and log-scales [N, 2] of ellipsoids [N, 3], with the thinnest axis as the normal.

    The axes are moved around in their cycle, so that the rotation stays one; of two equally thin the later goes. If all
    have one third scale, the smallest of the file, they are flat Gaussians of a file that rounds scales.

    Args:
      quats: [N, 4] wxyz.
      log_scales: [N, 3].
      name: the file, for the warning that some ellipsoids are not flat.
    """
    if _share_a_thin_third(log_scales):
        return quats, log_scales[:, :2]
    thinnest = 2 - np.argmin(log_scales[:, ::-1], axis=1)
    kept = np.take_along_axis(log_scales, (thinnest[:, None] + np.array([[1, 2]])) % 3, axis=1)
    dropped = np.take_along_axis(log_scales, thinnest[:, None], axis=1)[:, 0]
    num_thick = np.count_nonzero(dropped > kept.min(axis=1) + np.log(2 * THICKNESS))
    if num_thick:
        message = f"{name}: holds 3D Gaussians (scale_2), {num_thick} of them not flat; their thinnest axis is dropped"
        warnings.warn(message, stacklevel=4)
    return _quaternion_product(quats, AXES_TO_NORMAL[thinnest]), kept


def _share_a_thin_third(log_scales: np.ndarray) -> bool:
    """Return whether all ellipsoids have one third scale, none has a smaller one, and most are far wider."""
    if not len(log_scales):
        return False
    others, third = log_scales[:, :2], log_scales[:, 2]
    return bool(third.min() == third.max() <= others.min() and third[0] < np.median(others) + np.log(0.1))


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
