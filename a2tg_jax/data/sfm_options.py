"""Values of the options of `run_sfm`."""

from typing import Literal

Matching = Literal["auto", "exhaustive", "sequential"]
"""Pairs of photographs to match: all of them (exhaustive), neighbours by name (sequential), or by their number."""
CameraModel = Literal[
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE", "OPENCV_FISHEYE",
]  # fmt: skip
"""COLMAP's names of camera models that can be estimated from photographs."""
Panorama = Literal["auto", "yes", "no"]
"""Whether pictures twice as wide as high are panoramas: those that are recognised (auto), all of them, or none."""
DEFAULT_FRAMES = 150
"""Default largest number of frames from a video."""
