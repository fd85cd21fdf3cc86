"""Lenses of any camera model of COLMAP: undistorted to a pinhole, or kept, with a ray for each pixel."""

import dataclasses
import functools
import threading
from collections.abc import Callable
from functools import cached_property
from typing import Literal

import numpy as np
from PIL import Image
from scipy.ndimage import map_coordinates

from a2tg_jax.core.cameras import check_intrinsics
from a2tg_jax.data.colmap_cameras import CUT, ColmapCamera
from a2tg_jax.data.colmap_library import pycolmap

PINHOLE_TOLERANCE = 1e-3
"""Largest deviation in pixels of a camera that still counts as a pinhole."""
LARGEST_DISTORTION = 1e6
"""Largest absolute distortion parameter. Telephoto lenses, with small angles, have large ones."""
GRID = 9
MARGIN = 0.1
"""Number of test points along an axis of an undistorted image, and their largest distance outside the photograph."""
ROWS_AT_ONCE = 128  # Rays of a whole photograph would take many times its memory.
WIDEST_ANGLE = np.deg2rad(80.0)
"""Largest angle between a ray of a kept lens and the direction of view; pixels beyond it do not count."""
FARTHEST_FROM_RAY = 0.1
"""Largest distance in pixels between a pixel and the projection of its ray; rays farther off are dropped."""
LEAST_SEEN = 0.05
LensUse = Literal["undistort", "keep"]
"""Whether photographs are undistorted to pinholes, or kept as they are and drawn through the lens."""

# lru_cache may compute a value twice, and scene.kinds_of recognises a lens by the identity of its rays.
_LOCK = threading.Lock()


@dataclasses.dataclass(frozen=True, eq=False)
class Lens:
    """A calibrated camera of any COLMAP model."""

    camera: ColmapCamera
    is_kept: bool = False
    """Whether photographs are kept as they are, with `rays` as places in the image plane of their K."""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the images it was calibrated for."""
        return self.camera.width, self.camera.height

    @cached_property
    def is_pinhole(self) -> bool:
        """Whether the camera projects like its calibration matrix (models with zero distortion do)."""
        if self.camera.is_undistorted:
            return True
        width, height = self.size
        grid = np.stack(np.meshgrid(np.linspace(0, width, 5), np.linspace(0, height, 5)), -1).reshape(-1, 2)
        projected = _homogeneous(self.camera.slopes(grid)) @ self.camera.matrix[:2].T
        return bool(np.abs(projected - grid).max() <= PINHOLE_TOLERANCE)  # False for NaN: no ray, no pinhole

    @cached_property
    def pinhole(self) -> tuple[np.ndarray, tuple[int, int]]:
        """K [3, 3] and (width, height) of the undistorted image: same focal lengths, largest area without blanks."""
        if self.camera.is_undistorted:
            return self.camera.matrix, self.size
        colmap = pycolmap()
        try:
            if self.is_pinhole:
                return self.camera.matrix, self.size
            pinhole = colmap.undistort_camera(colmap.UndistortCameraOptions(), self.camera.colmap)
        except (ValueError, RuntimeError):  # COLMAP's own check that the model is perspective
            raise ValueError(f"{self.camera.name} cannot be undistorted to a pinhole camera{CUT}") from None
        K = pinhole.calibration_matrix()
        size = (pinhole.width, pinhole.height)
        # The middle half of the image must be nearly in the photograph and not mirrored. Corners may fold, because
        # calibrations are arbitrary where they saw no feature.
        x, y = (side * np.linspace(0.25, 0.75, GRID) for side in size)
        rays = _homogeneous(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)) @ np.linalg.inv(K).T
        places = self.camera.pixels(rays).reshape(GRID, GRID, 2) / self.size
        is_inside = ((places >= -MARGIN) & (places <= 1 + MARGIN)).all()  # False for NaN.
        is_ordered = (np.diff(places[..., 0], axis=1) > 0).all() and (np.diff(places[..., 1], axis=0) > 0).all()
        if not (is_inside and is_ordered):
            raise ValueError(
                f"{self.camera.name} has a distortion that folds the image or leaves it: correct its parameters, "
                'or keep the photographs as they are (lens="keep")'
            )
        return K, size

    def view_pixels(self, pixels: np.ndarray, downscale: int = 1) -> np.ndarray:
        """Return the pixels [h', w', C] of a photograph's view.

        The photograph, [h, w, C] uint8, is of the calibrated size, perhaps scaled. Unless kept, it is undistorted
        before it is downscaled, which keeps it sharp.
        """
        size, _ = self.view_of((pixels.shape[1], pixels.shape[0]), downscale)
        if not (self.is_kept or self.is_pinhole):
            planes = pixels.astype(np.float32)
            if planes.shape[2] == 4:  # Colours are multiplied by alpha, so that transparent neighbours do not bleed.
                planes[..., :3] *= planes[..., 3:] / 255
            planes = self._undistorted(planes)
            if planes.shape[2] == 4:
                planes[..., :3] *= 255 / np.maximum(planes[..., 3:], 1)  # Colours are 0 where alpha is.
            pixels = np.clip(np.rint(planes), 0, 255).astype(np.uint8)
        return resize_pixels(pixels, *size)

    def view_of(self, stored: tuple[int, int], downscale: int) -> tuple[tuple[int, int], np.ndarray]:
        """Return (width, height) and K [3, 3] of the view that `view_pixels` makes of a photograph of a size."""
        K, size = (self.camera.matrix, self.size) if self.is_kept else self.pinhole
        width, height = stored if self.is_kept else self._undistorted_size(stored)
        new_size = max(1, round(width / downscale)), max(1, round(height / downscale))
        return new_size, _scaled_intrinsics(K, size, new_size)

    def _undistorted_size(self, stored: tuple[int, int]) -> tuple[int, int]:
        """Return (width, height) of a photograph of a size after it is undistorted, before it is downscaled."""
        if self.is_pinhole:
            return stored
        _, size = self.pinhole
        width, height = np.divide(stored, self.size) * size
        return round(width), round(height)

    def view_plane(self, plane: np.ndarray) -> np.ndarray:
        """Return numbers [h, w] float32 of a photograph's pixels, undistorted like its view, not downscaled."""
        return plane if self.is_kept or self.is_pinhole else self._undistorted(plane[..., None])[..., 0]

    def rays(self, width: int, height: int) -> np.ndarray | None:
        """Return the rays [height, width, 2] of views of a size, as in `Camera.rays`; NaN where there is none.

        None for a pinhole, or if photographs are undistorted. Raise ValueError if almost no pixel has a ray.
        """
        if not self.is_kept or self.is_pinhole:
            return None
        with _LOCK:  # Threads that read photographs of one lens share its rays.
            return _rays(self.camera, (width, height))

    def _undistorted(self, planes: np.ndarray) -> np.ndarray:
        """Return float32 planes of the undistorted image, sampled bilinearly from planes [h, w, C] of a photograph."""
        stored = planes.shape[1::-1]
        size = self._undistorted_size(stored)
        to_rays = np.linalg.inv(_scaled_intrinsics(*self.pinhole, size)).T

        def places(x: np.ndarray, y: np.ndarray) -> np.ndarray:
            rays = _homogeneous(np.stack([x, y], -1).reshape(-1, 2)) @ to_rays
            # From x and y of COLMAP, whose first pixel has its centre at 0.5, to row and column of the array.
            pixels = self.camera.pixels(rays) * np.divide(stored, self.size) - 0.5
            return pixels[:, ::-1].T.reshape(2, *x.shape)

        return sampled(planes, size, places)


def sampled(
    planes: np.ndarray, size: tuple[int, int], places: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> np.ndarray:
    """Return float32 planes of a size (width, height), sampled bilinearly from planes [h, w, C].

    `places` is the function from x and y of pixel centres, [rows, width] each, to rows and columns [2, rows, width] of
    the given planes.
    """
    width, height = size
    picture = np.empty((height, width, planes.shape[2]), np.float32)
    for top in range(0, height, ROWS_AT_ONCE):
        rows = picture[top : top + ROWS_AT_ONCE]
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(top, top + len(rows)) + 0.5)
        coordinates = places(x, y)
        for channel in range(planes.shape[2]):
            rows[..., channel] = map_coordinates(planes[..., channel], coordinates, np.float32, order=1, mode="nearest")
    return picture


@functools.lru_cache(maxsize=256)
def _rays(camera: ColmapCamera, picture: tuple[int, int]) -> np.ndarray:
    """Return the rays of a lens for pictures of a size; the same array for the same lens."""
    x, y = np.meshgrid(*(np.arange(side) + 0.5 for side in picture))
    size = (camera.width, camera.height)
    places = np.stack([x, y], -1).reshape(-1, 2) * np.divide(size, picture)
    slopes = camera.slopes(places)
    # A polynomial that folds has no inverse there: what comes back must lead to the pixel again.
    again = camera.pixels(_homogeneous(np.nan_to_num(slopes)))
    is_ray = np.linalg.norm(again - places, axis=1) <= FARTHEST_FROM_RAY
    is_ray &= np.linalg.norm(slopes, axis=1) <= np.tan(WIDEST_ANGLE)  # False for NaN.
    if is_ray.mean() < LEAST_SEEN:
        raise ValueError(
            f"{camera.name} gives {is_ray.mean():.0%} of the pixels a ray within {np.rad2deg(WIDEST_ANGLE):.0f}° of "
            "the direction of view: are its parameters right?"
        )
    in_plane = _homogeneous(slopes) @ _scaled_intrinsics(camera.matrix, size, picture)[:2].T
    width, height = picture
    rays = np.where(is_ray[:, None], in_plane, np.nan).astype(np.float32).reshape(height, width, 2)
    rays.setflags(write=False)  # Views share it.
    return rays


def forget_rays() -> None:
    """Release the rays that scenes no longer hold, once the photographs of a scene are read."""
    _rays.cache_clear()


def checked_lens(camera: ColmapCamera, what: str, use: LensUse = "undistort") -> Lens:
    """Return the lens of a camera, named `what` in errors.

    Raise ValueError if a number is not finite or beyond the bounds of `check_intrinsics` and `LARGEST_DISTORTION`.
    """
    if not np.isfinite(camera.params).all():
        raise ValueError(f"{what}: its camera's parameters must be finite; got {list(camera.params)}")
    if any(abs(value) > LARGEST_DISTORTION for value in camera.distortion):
        wanted = f"within ±{LARGEST_DISTORTION:g}"
        raise ValueError(f"{what}: its distortion must be {wanted}; got {list(camera.distortion)}")
    if camera.model.num_focal:  # Panoramas have none.
        check_intrinsics(camera.matrix, camera.width, camera.height, what)
    return Lens(camera, is_kept=use == "keep")


def _homogeneous(points: np.ndarray) -> np.ndarray:
    """Return [P, 2] → [P, 3] with a last coordinate of 1."""
    return np.concatenate([points, np.ones((len(points), 1))], axis=1)


def resize_pixels(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return the image at a smaller size, each new pixel a weighted mean around its area (weighted with alpha too)."""
    if pixels.shape[:2] == (height, width):
        return pixels
    # Pillow's box filter uses whole pixels only, which shifts details at fractional ratios.
    return np.asarray(Image.fromarray(pixels).resize((width, height), Image.Resampling.HAMMING))


def _scaled_intrinsics(K: np.ndarray, old: tuple[int, int], new: tuple[int, int]) -> np.ndarray:
    """Return K [3, 3] for an image of the size `new` instead of `old`, both (width, height); pixel edges stay edges."""
    return np.diag([new[0] / old[0], new[1] / old[1], 1.0]) @ K
