"""Pinhole cameras in OpenCV's frame: x right, y down, z forward; pixel centres at +0.5."""

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array


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


def resize_camera(camera: Camera, width: int, height: int) -> Camera:
    """The same view sampled at another image size: K scales with each side (pixel edges stay edges)."""
    dtype = camera.K.dtype
    factors = jnp.asarray([[width / camera.width], [height / camera.height], [1.0]], dtype)
    return Camera(camera.viewmat, camera.K * factors, width, height)
