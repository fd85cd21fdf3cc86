"""Pinhole cameras in OpenCV's frame: x right, y down, z forward; pixel centres at +0.5."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.checks import check_floats, short_repr


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Camera:
    """One view. `viewmat` and `K` are differentiable; the image size is static."""

    viewmat: Array
    """[4, 4] world to camera, a rigid motion."""
    K: Array
    """[3, 3] intrinsics in pixels, last row (0, 0, 1)."""
    width: int = dataclasses.field(metadata={"static": True})
    """Image width in pixels."""
    height: int = dataclasses.field(metadata={"static": True})
    """Image height in pixels."""

    @property
    def center(self) -> Array:
        """[3] position of the camera in the world, −Rcᵀt."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def __repr__(self) -> str:
        return short_repr(self)


def check_camera(camera: Camera, name: str = "camera") -> None:
    """Raises ValueError, naming the field, unless the matrices have their shapes and the image a size."""
    if not isinstance(camera, Camera):
        raise ValueError(f"{name} must be a Camera; got {type(camera).__name__}")
    check_floats(f"{name}.viewmat", camera.viewmat, (4, 4))
    check_floats(f"{name}.K", camera.K, (3, 3))
    for side in ("width", "height"):
        value = getattr(camera, side)
        if not isinstance(value, int | np.integer) or value < 1:
            raise ValueError(f"{name}.{side} must be a positive number of pixels; got {value!r}")


def resize_camera(camera: Camera, width: int, height: int) -> Camera:
    """The same view sampled at another image size: K scales with each side (pixel edges stay edges)."""
    dtype = camera.K.dtype
    factors = jnp.asarray([[width / camera.width], [height / camera.height], [1.0]], dtype)
    return Camera(camera.viewmat, camera.K * factors, width, height)
