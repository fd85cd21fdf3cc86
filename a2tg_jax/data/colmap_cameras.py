"""Cameras of COLMAP as plain numbers. Pinholes project without pycolmap, which has no wheel for some machines."""

import dataclasses
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from a2tg_jax.core.cameras import pinhole_pixels
from a2tg_jax.data.colmap_library import pycolmap


class CameraModel(NamedTuple):
    """Camera model of COLMAP: focal lengths, then the principal point, then other parameters."""

    name: str
    num_focal: int
    num_others: int
    is_perspective: bool = False
    """Whether it is a pinhole if all of its other parameters are 0."""

    @property
    def num_params(self) -> int:
        return self.num_focal + 2 + self.num_others


MODELS = {
    0: CameraModel("SIMPLE_PINHOLE", 1, 0, True),
    1: CameraModel("PINHOLE", 2, 0, True),
    2: CameraModel("SIMPLE_RADIAL", 1, 1, True),
    3: CameraModel("RADIAL", 1, 2, True),
    4: CameraModel("OPENCV", 2, 4, True),
    5: CameraModel("OPENCV_FISHEYE", 2, 4),
    6: CameraModel("FULL_OPENCV", 2, 8, True),
    7: CameraModel("FOV", 2, 1),
    8: CameraModel("SIMPLE_RADIAL_FISHEYE", 1, 1),
    9: CameraModel("RADIAL_FISHEYE", 1, 2),
    10: CameraModel("THIN_PRISM_FISHEYE", 2, 8),
    11: CameraModel("RAD_TAN_THIN_PRISM_FISHEYE", 2, 12),
    12: CameraModel("SIMPLE_DIVISION", 1, 1, True),
    13: CameraModel("DIVISION", 2, 1, True),
    14: CameraModel("SIMPLE_FISHEYE", 1, 0),
    15: CameraModel("FISHEYE", 2, 0),
    16: CameraModel("EUCM", 2, 2),
    17: CameraModel("EQUIRECTANGULAR", 0, 0),
}
"""COLMAP's camera models by their number in binary files."""
BY_NAME = {model.name: model for model in MODELS.values()}
CUT = ": find cameras again with a2tg sfm, which cuts panoramas into views"
"""Advice for panoramas, which have no image plane."""


@dataclasses.dataclass(frozen=True)
class ColmapCamera:
    """Camera of any COLMAP model, at the size it was calibrated for. Pixel centres are at +0.5, as in COLMAP."""

    name: str
    """Name of the camera model, a key of `BY_NAME`."""
    width: int
    height: int
    params: tuple[float, ...]

    @property
    def model(self) -> CameraModel:
        return BY_NAME[self.name]

    @property
    def distortion(self) -> tuple[float, ...]:
        """Parameters besides the focal lengths and the principal point."""
        return self.params[self.model.num_focal + 2 :]

    @property
    def is_undistorted(self) -> bool:
        """Whether it is a pinhole by its parameters. Other models can still project like one."""
        return self.model.is_perspective and not any(self.distortion)

    @property
    def matrix(self) -> np.ndarray:
        """Calibration matrix K [3, 3].

        Raises:
          ValueError: if the camera has no image plane, like a panorama.
        """
        if not self.model.num_focal:
            raise ValueError(f"{self.name} has no image plane{CUT}")
        num_focal = self.model.num_focal
        cx, cy = self.params[num_focal : num_focal + 2]
        return np.array([[self.params[0], 0.0, cx], [0.0, self.params[num_focal - 1], cy], [0.0, 0.0, 1.0]])

    @cached_property
    def colmap(self) -> Any:
        """The same camera as a pycolmap.Camera."""
        return pycolmap().Camera(model=self.name, width=self.width, height=self.height, params=self.params)

    def pixels(self, points: np.ndarray) -> np.ndarray:
        """Return x and y [P, 2] in pixels of points [P, 3] in the camera's frame."""
        if self.is_undistorted:
            return pinhole_pixels(points, self.matrix)
        return np.asarray(self.colmap.img_from_cam(points))

    def slopes(self, pixels: np.ndarray) -> np.ndarray:
        """Return x/z and y/z [P, 2] of the rays through pixels [P, 2]; NaN where there is no ray."""
        if self.is_undistorted:
            return (pixels - self.matrix[:2, 2]) / np.diag(self.matrix)[:2]
        return np.asarray(self.colmap.cam_from_img(pixels), np.float64)
