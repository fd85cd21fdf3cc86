"""Panoramas of 360° × 180° (equirectangular) as perspective views of one place.

The panorama's own camera frame has x to the right, y down and z towards the middle of the picture. Longitude grows to
the right, from -π at the left edge.
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

FIELD_OF_VIEW = np.deg2rad(100.0)
"""Field of view of each square view; with the headings below no direction is left out."""
AROUND = 6
"""Number of views around the horizon; one view up and one down join them."""
ROWS_AT_ONCE = 128
SEAM_TOLERANCE, LEAST_SEAM = 2.0, 3.0
"""Largest step of brightness over the seam, in steps of neighbouring columns and in grey levels above that."""


class Direction(NamedTuple):
    """A view of a panorama."""

    name: str
    rotation: np.ndarray
    """[3, 3] from the panorama's frame to the view's."""


def directions() -> tuple[Direction, ...]:
    """Return the views that a panorama is cut into, the one towards its middle first."""
    headings = [360.0 * number / AROUND for number in range(AROUND)]
    angles = [(f"heading{heading:03.0f}", heading, 0.0) for heading in headings]
    angles += [("up", 0.0, 90.0), ("down", 0.0, -90.0)]
    # A view is turned right by its heading and then up by its pitch.
    turns = [Rotation.from_euler("YX", [heading, pitch], degrees=True) for _, heading, pitch in angles]
    return tuple(Direction(name, turn.as_matrix().T) for (name, _, _), turn in zip(angles, turns, strict=True))


def view_size(width: int) -> tuple[int, float]:
    """Return (side, focal length) in pixels of the views of a panorama, which keep its resolution at their middle."""
    side = 2 * round(width / (2 * np.pi) * np.tan(FIELD_OF_VIEW / 2))
    return side, side / (2 * np.tan(FIELD_OF_VIEW / 2))


def cut_view(panorama: np.ndarray, direction: Direction) -> np.ndarray:
    """Return the square view [side, side, C] uint8 of a panorama [H, W, C] in a direction, sampled bilinearly."""
    height, width, channels = panorama.shape
    side, focal = view_size(width)
    wrapped = np.concatenate([panorama[:, -1:], panorama, panorama[:, :1]], axis=1)  # Columns continue over the seam.
    view = np.empty((side, side, channels), np.uint8)
    for top in range(0, side, ROWS_AT_ONCE):
        rows = view[top : top + ROWS_AT_ONCE]
        x, y = np.meshgrid(np.arange(side) + 0.5 - side / 2, np.arange(top, top + len(rows)) + 0.5 - side / 2)
        rays = np.stack([x, y, np.full_like(x, focal)], -1) @ direction.rotation
        longitude = np.arctan2(rays[..., 0], rays[..., 2])
        latitude = np.arctan2(-rays[..., 1], np.hypot(rays[..., 0], rays[..., 2]))
        row, column = (0.5 - latitude / np.pi) * height, (0.5 + longitude / (2 * np.pi)) * width
        places = np.stack([row - 0.5, column - 0.5 + 1])  # One more for the wrapped column on the left.
        for channel in range(channels):
            rows[..., channel] = np.rint(map_coordinates(wrapped[..., channel], places, np.float32, 1, mode="nearest"))
    return view


def is_panorama(pixels: np.ndarray) -> bool:
    """Return whether a picture [H, W, C] is twice as wide as high, and its right edge continues at its left edge."""
    if pixels.shape[1] != 2 * pixels.shape[0]:
        return False
    columns = pixels[:, [-1, 0, 1, 2, 3]].astype(np.float32)
    steps = np.abs(np.diff(columns, axis=1)).mean(axis=(0, 2))
    return bool(steps[0] <= SEAM_TOLERANCE * steps[1:].mean() + LEAST_SEAM)
