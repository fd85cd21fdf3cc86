"""Supersampling: a view is drawn at k times its size, and each pixel is the mean over its k × k."""

from jax import Array

from a2tg_jax.core.cameras import Camera, resize_camera


def finer(camera: Camera, factor: int) -> Camera:
    """Return the view at `factor` times the size; the same camera for a factor of 1."""
    return camera if factor == 1 else resize_camera(camera, factor * camera.width, factor * camera.height)


def box_mean(image: Array, factor: int) -> Array:
    """Return the means [H, W, ...] over squares of an image [factor·H, factor·W, ...]."""
    height, width = image.shape[0] // factor, image.shape[1] // factor
    mean: Array = image.reshape(height, factor, width, factor, *image.shape[2:]).mean(axis=(1, 3))
    return mean
