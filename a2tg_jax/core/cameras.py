"""Pinhole cameras in OpenCV's frame: x right, y down, z forward; pixel centres at +0.5."""

from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.base.checks import (
    LARGEST_NUMBER,
    check_array,
    check_floats,
    check_int,
    check_kind,
    make_plain,
    short_repr,
)
from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.core.pytree import pytree, static

LONGEST_SIDE = 100_000
"""Largest longer side of an image, in pixels."""
SHORTEST_FOCAL = 1e-3
"""Least focal length, in units of the longer side: an angle of view of 179.9°."""
LONGEST_FOCAL = 1e5
"""Largest focal length, in units of the longer side: 2 arc seconds."""
LARGEST_OFFSET = 100.0
"""Largest distance of the principal point from the image's corner, in units of the longer side."""
MAX_SKEW = 1e-2
"""Largest deviation of a rotation from an orthonormal matrix that still passes as rounding."""
MAX_DRIFT = 5e-2
"""Largest deviation of a rendered camera's rotation from an orthonormal matrix, as left by gradient steps."""
LARGEST_COORDINATE = LARGEST_NUMBER
"""Largest coordinate of a camera or a point, in any world."""


@pytree
class Camera(NamedFields):
    """One view: a pinhole camera in OpenCV's frame, x right, y down, z forward; pixel centres are at +0.5.

    `viewmat` and `K` are differentiable; the image size is static.

    Examples:
      >>> K = jnp.array([[50.0, 0, 24], [0, 50, 18], [0, 0, 1]])
      >>> viewmat = jnp.eye(4).at[2, 3].set(4.0)  # 4 units behind the origin, looking along z
      >>> camera = a2tg.Camera(viewmat, K, width=48, height=36)
      >>> float(camera.center[2])
      -4.0
    """

    viewmat: Array
    """[4, 4] world to camera, a rigid motion: x_camera = viewmat[:3, :3] · x_world + viewmat[:3, 3]."""
    K: Array
    """[3, 3] intrinsics in pixels, last row (0, 0, 1)."""
    width: int = static()
    """Image width in pixels."""
    height: int = static()
    """Image height in pixels."""
    rays: Array | None = None
    """[H, W, 2] points (x, y) of the image plane of K, in its pixels, where the rays of the pixels of a lens meet it:
    they run along K⁻¹·(x, y, 1). A pixel without finite numbers shows the background. Not differentiated; None: a
    pinhole camera."""

    def __post_init__(self) -> None:
        """Convert sides of numpy's integers to Python's, and lists and NumPy's special arrays to plain arrays."""
        make_plain(self, "camera", "viewmat", "K", "rays")
        for side in ("width", "height"):
            if isinstance(getattr(self, side), np.integer):
                object.__setattr__(self, side, int(getattr(self, side)))

    @property
    def center(self) -> Array:
        """[3] position of the camera in the world, −Rcᵀt."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def __repr__(self) -> str:
        return short_repr(self)


def check_camera(camera: Camera, name: str = "camera") -> None:
    """Raise ValueError, naming the field, unless the matrices have their shapes and the image a size.

    Outside jit, vmap and grad, the pose must also be a rigid motion and K have the form of intrinsics.
    """
    check_is_camera(camera, name)
    for field, shape in (("viewmat", (4, 4)), ("K", (3, 3))):
        value = getattr(camera, field)
        check_array(f"{name}.{field}", value)
        check_floats(f"{name}.{field}", value, shape)
    if camera.rays is not None:
        check_floats(f"{name}.rays", camera.rays, (camera.height, camera.width, 2))
    for side in ("width", "height"):
        value = getattr(camera, side)
        if not isinstance(value, int) or value < 1:
            kind = "" if isinstance(value, int) else ", a Python int"
            raise ValueError(f"{name}.{side} must be a positive number of pixels{kind}; got {value!r}")
    # Gradient steps may make both drift, within `MAX_DRIFT`; a pose with NaN passes.
    if not isinstance(camera.viewmat, jax.core.Tracer):
        viewmat = np.asarray(jax.device_get(camera.viewmat), np.float64)
        rotation = viewmat[:3, :3]
        skew = np.abs(rotation @ rotation.T - np.eye(3)).max()
        wanted = f"{name}.viewmat must be a rigid motion, world to camera, OpenCV axes (x right, y down, z forward)"
        if skew > MAX_DRIFT:
            raise ValueError(f"{wanted}; its rotation R has entries of R·Rᵀ − I up to {skew:.2g}")
        if np.linalg.det(rotation) < 0:
            raise ValueError(f"{wanted}; its rotation mirrors, with a determinant of −1")
        if np.abs(viewmat[3] - [0, 0, 0, 1]).max() > MAX_DRIFT:
            raise ValueError(f"{wanted}; its last row must be 0, 0, 0, 1, and is {_numbers(viewmat[3])}")
    if not isinstance(camera.K, jax.core.Tracer):
        K = np.asarray(jax.device_get(camera.K), np.float64)
        focal = K[[0, 1], [0, 1]]
        is_upper = abs(K[1, 0]) <= MAX_DRIFT * focal[1] and np.abs(K[2] - [0, 0, 1]).max() <= MAX_DRIFT
        if not (np.isfinite(K).all() and (focal > 0).all() and is_upper):
            wanted = "[[fx, skew, cx], [0, fy, cy], [0, 0, 1]] in pixels, finite, with positive focal lengths fx and fy"
            raise ValueError(f"{name}.K must be {wanted}; got {_numbers(K)}")


def check_is_camera(camera: Camera, name: str = "camera") -> None:
    """Raise ValueError unless a value is a camera; its fields are not checked."""
    check_kind(name, camera, Camera, "use view.camera" if hasattr(camera, "camera") else "")


def checked_cameras(cameras: Any, name: str = "cameras") -> list[Camera]:
    """Return one camera, or several, as a list. ValueError: it is neither, or as `check_camera` raises."""
    if isinstance(cameras, Camera):
        check_camera(cameras, name)
        return [cameras]
    try:
        several: list[Camera] = list(cameras)
    except TypeError:  # Sequences that only have __getitem__ are no Iterable, but can be listed.
        check_kind(name, cameras, (Camera, Iterable), "use view.camera" if hasattr(cameras, "camera") else "")
        raise
    for index, camera in enumerate(several):
        check_camera(camera, f"{name}[{index}]")
    return several


def check_calibration(viewmat: np.ndarray, K: np.ndarray, width: int, height: int, what: str) -> None:
    """Raise ValueError, naming the camera, if a number from a file is NaN, infinite, or outside this module's limits
    (host)."""
    check_intrinsics(K, width, height, what)
    rotation = viewmat[:3, :3]
    if not (np.abs(viewmat) <= LARGEST_COORDINATE).all():  # False for NaN.
        raise ValueError(f"{what}: its pose must be finite, within ±{LARGEST_COORDINATE:g}; got {_numbers(viewmat)}")
    is_rotation = np.abs(rotation @ rotation.T - np.eye(3)).max() <= MAX_SKEW and np.linalg.det(rotation) > 0
    if not is_rotation or not np.array_equal(viewmat[3], [0, 0, 0, 1]):
        raise ValueError(f"{what}: its pose must be a rigid motion; got {_numbers(viewmat)}")


def check_intrinsics(K: np.ndarray, width: int, height: int, what: str) -> None:
    """Check the image size and K as `check_calibration` does, with the same errors."""
    side = max(width, height)
    if not 1 <= min(width, height) <= side <= LONGEST_SIDE:
        raise ValueError(f"{what}: its image must have sides of 1..{LONGEST_SIDE} pixels; got {width}x{height}")
    K = np.asarray(K, np.float64)
    focal = K[[0, 1], [0, 1]]
    offset = K[[0, 1], [2, 2]]
    if not ((focal >= SHORTEST_FOCAL * side) & (focal <= LONGEST_FOCAL * side)).all():  # False for NaN.
        wanted = f"{SHORTEST_FOCAL * side:g}..{LONGEST_FOCAL * side:g} pixels, because its image is {width}x{height}"
        raise ValueError(f"{what}: its focal lengths must be in {wanted}; got {_numbers(focal)}")
    if not (np.abs(offset) <= LARGEST_OFFSET * side).all():
        wanted = f"within {LARGEST_OFFSET:g} sides of its image of {width}x{height}"
        raise ValueError(f"{what}: its principal point must be {wanted}; got {_numbers(offset)}")
    if not np.array_equal(K[2], [0, 0, 1]) or K[1, 0] != 0 or not np.abs(K[0, 1]) <= focal[0]:
        raise ValueError(f"{what}: its K must be upper triangular, with a last row of (0, 0, 1); got {_numbers(K)}")


def _numbers(values: np.ndarray) -> str:
    return ", ".join(f"{value:g}" for value in np.asarray(values).ravel())


def resize_camera(camera: Camera, width: int, height: int) -> Camera:
    """Return the same view at another image size: K scales with each side (pixel edges stay edges).

    Args:
      camera: the view.
      width: new image width in pixels.
      height: new image height in pixels.

    Returns:
      The camera of that size.

    Raises:
      ValueError: if it is not a camera, or a side is not a positive int.
    """
    check_is_camera(camera)
    check_int("width", width, 1)
    check_int("height", height, 1)
    dtype = camera.K.dtype
    factors = jnp.asarray([[width / camera.width], [height / camera.height], [1.0]], dtype)
    rays = camera.rays
    if rays is not None:
        rays = _resampled(_resampled(rays, height, axis=0), width, axis=1) * factors[:2, 0].reshape(1, 1, 2)
    return Camera(camera.viewmat, camera.K * factors, width, height, rays)


def halved_camera(camera: Camera) -> Camera:
    """Return the same view at half the width and height, without a last odd row or column of pixels."""
    width = camera.width // 2
    height = camera.height // 2
    rays = None if camera.rays is None else camera.rays[: 2 * height, : 2 * width]
    return resize_camera(Camera(camera.viewmat, camera.K, 2 * width, 2 * height, rays), width, height)


def _resampled(values: Array, num: int, axis: int) -> Array:
    """Return values at the centres of `num` pixels along an axis, linear between and beyond the old centres."""
    num_old = values.shape[axis]
    if num_old == num:
        return values
    if num_old == 1:
        return jnp.repeat(values, num, axis=axis)
    # Centres are at +0.5 at both sizes; places count from the centre of the first old pixel.
    place = (np.arange(num) + 0.5) * (num_old / num) - 0.5
    # Up to the last but one, so that the line through the last two continues beyond them.
    below = np.clip(np.floor(place), 0, num_old - 2).astype(np.int32)
    share = jnp.asarray(np.expand_dims(place - below, [k for k in range(values.ndim) if k != axis]), values.dtype)
    low = jnp.take(values, below, axis=axis)
    high = jnp.take(values, below + 1, axis=axis)
    return low + share * (high - low)


def back_project(depth: Array, camera: Camera) -> Array:
    """Return the points of the world that pixels show at given depths; differentiable.

    Args:
      depth: [H, W] depths along the camera's z axis, such as `RenderOutput.depth`.
      camera: the view, of that size.

    Returns:
      Points [H, W, 3], without meaning where a pixel has no ray.
    """
    height, width = depth.shape
    x, y = jnp.meshgrid(jnp.arange(width, dtype=depth.dtype) + 0.5, jnp.arange(height, dtype=depth.dtype) + 0.5)
    if camera.rays is not None:
        x, y = jnp.moveaxis(jnp.where(jnp.isfinite(camera.rays), camera.rays, 0.0), -1, 0)
    to_rays = jnp.linalg.inv(camera.K).T
    rotation = camera.viewmat[:3, :3]
    # By default GPUs may round the factors of large products to 10 bits (TF32), by a tenth of the step between pixels.
    with jax.default_matmul_precision("highest"):
        rays = jnp.stack([x, y, jnp.ones_like(x)], -1) @ to_rays
        # Rays are rows: r·Rc is Rcᵀ·r, transposed.
        return (rays @ rotation) * depth[..., None] + camera.center[None, None]


def pinhole_pixels(points: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Return x and y [P, 2] in pixels of points [P, 3] in front of a pinhole camera, in its frame."""
    projected = points @ K.T
    return projected[:, :2] / projected[:, 2:]


# Small rigid motions of cameras, so(3) × R³: a twist [6] is a rotation vector ω in radians and a translation. θ is the
# angle |ω|, W the matrix with W·x = ω × x.

SMALL = 1e-2
"""Squared angle below which the series are exact to 14 digits."""


def rotation_exp(rotvec: Array) -> Array:
    """Return R [3, 3] = I + (sin θ/θ)·W + ((1 − cos θ)/θ²)·W², exactly I for 0, with derivatives of any order there."""
    squared = jnp.sum(rotvec * rotvec)
    is_small = squared < SMALL
    # `where` differentiates both branches: the one not taken must be finite too, or 0·∞ gives NaN.
    safe = jnp.where(is_small, 1.0, squared)
    angle = jnp.sqrt(safe)
    first = jnp.where(is_small, _series(squared, 1, 6, 120, 5040), jnp.sin(angle) / angle)
    second = jnp.where(is_small, _series(squared, 2, 24, 720, 40320), (1 - jnp.cos(angle)) / safe)
    x = rotvec[0]
    y = rotvec[1]
    z = rotvec[2]
    zero = jnp.zeros_like(x)
    W = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    # W² = ω·ωᵀ − θ²·I, without a product of matrices, which some devices round coarsely.
    W_squared = rotvec[:, None] * rotvec[None, :] - squared * jnp.eye(3, dtype=rotvec.dtype)
    return jnp.eye(3, dtype=rotvec.dtype) + first * W + second * W_squared


def moved_viewmat(twist: Array, viewmat: Array) -> Array:
    """Return world to camera [4, 4] followed by a twist [6] in the camera's frame, about its centre."""
    rotation = rotation_exp(twist[:3])
    # Sums of products, for the same reason as in `rotation_exp`.
    rows = jnp.sum(rotation[:, :, None] * viewmat[None, :3], axis=1)
    return viewmat.at[:3].set(rows.at[:, 3].add(twist[3:]))


def _series(x: Array, *denominators: int) -> Array:
    """Return 1/a − x/b + x²/c − x³/d."""
    a, b, c, d = (1 / number for number in denominators)
    return a - x * (b - x * (c - x * d))
