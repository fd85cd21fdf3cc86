"""Losses: the photometric loss, 2DGS's normal consistency, and the regularisers of 3DGS-MCMC.

Images are [H, W, 3], nominally in [0, 1] and never clipped here; a clip would kill the gradient where it is needed.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.base.checks import check_array, check_floats, check_number, check_shape, plain_array
from a2tg_jax.core.cameras import Camera, back_project, check_is_camera
from a2tg_jax.core.numerics import first_rows, normalize, safe_divide
from a2tg_jax.rasterize.kernels import window_scores
from a2tg_jax.rasterize.kernels.score import Score

SSIM_SIGMA = 1.5
SSIM_RADIUS = 5
SSIM_WINDOW = 2 * SSIM_RADIUS + 1
_WEIGHTS = np.exp(-0.5 * (np.arange(-SSIM_RADIUS, SSIM_RADIUS + 1) / SSIM_SIGMA) ** 2)
SSIM_TAPS = tuple((_WEIGHTS / _WEIGHTS.sum()).tolist())
SSIM_C1 = 0.01**2  # (K₁·L)² and (K₂·L)² of Wang et al., for a data range L of 1
SSIM_C2 = 0.03**2


def photometric_loss(image: Array, target: Array, *, ssim_weight: float | Array = 0.2) -> Array:
    """Compare two images by (1 - w)·L1 + w·(1 - SSIM), the loss of 3DGS (Kerbl et al., 2023).

    L1 is the mean over all pixels and channels, SSIM the mean over windows of 11 × 11 pixels (Wang et al., 2004).

    Args:
      image: [H, W, 3], sides of at least 11 pixels unless `ssim_weight` is 0.
      target: [H, W, 3].
      ssim_weight: w in [0, 1].

    Returns:
      The loss, a scalar; 0 for equal images.

    Raises:
      ValueError: if one is no image or is in 0..255, the shapes differ, a side is too short, or the weight is out of
        range.

    Examples:
      >>> photograph = jnp.asarray(a2tg.view_image(scene.test[0]))
      >>> float(a2tg.photometric_loss(photograph, photograph)) < 1e-5
      True
    """
    return functools.reduce(jnp.add, photometric_parts(image, target, ssim_weight=ssim_weight).values())


def photometric_parts(image: Array, target: Array, *, ssim_weight: float | Array = 0.2) -> dict[str, Array]:
    """Return the summands of `photometric_loss`, weighted, as "l1" and "ssim"; without "ssim" if its weight is 0."""
    image = plain_array("image", image)
    target = plain_array("target", target)
    check_same_shape(image, target)
    l1 = jnp.mean(jnp.abs(image - target))
    if not isinstance(ssim_weight, Array):
        check_number("ssim_weight", ssim_weight, least=0, most=1)
        if ssim_weight == 0:
            return {"l1": l1}
    return {"l1": (1 - ssim_weight) * l1, "ssim": ssim_weight * (1 - mean_ssim(image, target))}


def mean_ssim(image: Array, target: Array) -> Array:
    """Structural similarity, averaged over the windows that are wholly inside the image (Wang et al., 2004).

    The window is a Gaussian of σ 1.5 and 11 taps; the data range is 1. It equals scikit-image's
    `structural_similarity(gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1)`.

    Both images are [H, W, 3] floats, which the caller has checked. ValueError: if a side is shorter than the window.
    """
    if min(image.shape[:2]) < SSIM_WINDOW:
        raise ValueError(
            f"SSIM needs images of at least {SSIM_WINDOW} by {SSIM_WINDOW} pixels; got {image.shape[1]} by "
            f"{image.shape[0]}: use larger images or ssim_weight=0"
        )
    x = jnp.moveaxis(image, -1, 0)
    y = jnp.moveaxis(target, -1, 0)
    return window_scores.mean_score(Score(_similarity, SSIM_TAPS), x, y)


def _similarity(mean_x: Array, mean_y: Array, mean_squares: Array, mean_product: Array) -> Array:
    """SSIM of a window, from its means of x, y, x² + y² and x·y; element-wise."""
    means_product = mean_x * mean_y
    means_squares = mean_x * mean_x + mean_y * mean_y
    # E(x·y) − E(x)·E(y) is the covariance; of the squares, the sum of both variances.
    luminance = (2 * means_product + SSIM_C1) / (means_squares + SSIM_C1)
    structure = (2 * (mean_product - means_product) + SSIM_C2) / (mean_squares - means_squares + SSIM_C2)
    return luminance * structure


def normal_consistency(normal: Array, depth: Array, alpha: Array, camera: Camera) -> Array:
    """2DGS's normal consistency: the mean over pixels of Σ_i ω_i·(1 - n_i·n_depth) = alpha - normal·n_depth.

    n_depth is the normal of the rendered depth. Pixels at the image border, or next to an empty pixel, have no such
    normal and count as 0.

    Args:
      normal: [H, W, 3] rendered normals Σ n·α·T in the world, facing the camera, not divided by alpha.
      depth: [H, W] rendered depth Σ z·α·T, not divided by alpha.
      alpha: [H, W] rendered alpha in [0, 1].
      camera: the view.

    Returns:
      A scalar in [0, 2].

    Raises:
      ValueError: if an image is not of the camera's size.
    """
    check_is_camera(camera)
    size = camera.height, camera.width
    check_floats("normal", normal, (*size, 3))
    check_floats("depth", depth, size)
    check_floats("alpha", alpha, size)
    surface, is_defined = depth_normals(safe_divide(depth, alpha), alpha > 0, camera)
    error = alpha[1:-1, 1:-1] - jnp.sum(normal[1:-1, 1:-1] * surface, axis=-1)
    return jnp.sum(jnp.where(is_defined, error, 0.0)) / alpha.size


def depth_normals(depth: Array, is_valid: Array, camera: Camera) -> tuple[Array, Array]:
    """Return normals of a depth map [H, W], from central differences of its back-projected points.

    They are [H-2, W-2, 3] unit vectors in the world, facing the camera, of all pixels but the border; and [H-2, W-2],
    whether the pixel and the four neighbours it needs are valid. ValueError: if an image is not of the camera's size.
    """
    check_is_camera(camera)
    check_floats("depth", depth, (camera.height, camera.width))
    check_shape("is_valid", is_valid, depth.shape)
    if camera.rays is not None:
        is_valid = is_valid & jnp.all(jnp.isfinite(camera.rays), axis=2)
    points = back_project(depth, camera)
    along_x = points[1:-1, 2:] - points[1:-1, :-2]
    along_y = points[2:, 1:-1] - points[:-2, 1:-1]
    is_defined = (
        is_valid[1:-1, 1:-1] & is_valid[1:-1, 2:] & is_valid[1:-1, :-2] & is_valid[2:, 1:-1] & is_valid[:-2, 1:-1]
    )
    # With x right and y down, (down) × (right) points towards the camera for any positive depths.
    normal = jnp.where(is_defined[..., None], jnp.cross(along_y, along_x), 0.0)
    return normalize(normal), is_defined


def live_mean(values: Array, num_live: Array) -> Array:
    """Return the mean of the first `num_live` of N values."""
    is_live = first_rows(values.shape[0], num_live)
    return jnp.sum(jnp.where(is_live, values, 0.0)) / jnp.maximum(num_live, 1).astype(values.dtype)


LARGEST_MEAN = 2.0
"""Largest mean of an image in [0, 1]: renders may exceed 1 in places, but images in 0..255 do on average."""


def check_same_shape(image: Array, target: Array) -> None:
    """Raise ValueError unless both are floats [H, W, 3] of one shape; outside transformations, in [0, 1] on average."""
    for name, value in (("image", image), ("target", target)):
        hint = "use view_image(view, background)" if hasattr(value, "picture") else ""
        check_array(name, value, "use output.color" if hasattr(value, "color") else hint)
    if image.shape != target.shape or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"image and target must both be [H, W, 3]; got {image.shape} and {target.shape}")
    if not (jnp.issubdtype(image.dtype, jnp.floating) and jnp.issubdtype(target.dtype, jnp.floating)):
        raise ValueError(f"image and target must be floats in [0, 1]; got {image.dtype} and {target.dtype}")
    for name, value in (("image", image), ("target", target)):
        if isinstance(value, jax.core.Tracer) or not value.size:
            continue
        # By NumPy: under jit, JAX would trace the mean of an array that is known.
        mean = float(np.mean(jax.device_get(value)))
        if mean > LARGEST_MEAN:
            raise ValueError(f"{name} must be floats in [0, 1]; got a mean of {mean:.4g}: divide by 255")
