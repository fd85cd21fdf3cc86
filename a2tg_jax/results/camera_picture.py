"""Picture of where the cameras of a scene stand: from above and from the side, with its sparse points."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from a2tg_jax.data.colmap import read_cameras_and_points
from a2tg_jax.results.figures import COLORS, save_figure

MOST_POINTS = 20_000
"""Number of points drawn at most."""
WIDEST = 3.0
"""Largest half of the side of the picture, in distances of the farthest camera from the middle."""


def save_camera_picture(scene: Path, path: Path) -> None:
    """Draw the cameras and points of a COLMAP scene folder as a PNG.

    Raises:
      FileNotFoundError, ValueError: if there is no model, or it cannot be read.
    """
    viewmats, cloud = read_cameras_and_points(scene)
    rotations = viewmats[:, :3, :3]
    centers = -np.einsum("vij,vi->vj", rotations, viewmats[:, :3, 3])
    axes = _upright_axes(rotations)
    middle = np.median(np.concatenate([centers, cloud.points]), axis=0)
    reach = _reach(centers, cloud.points, middle)
    step = max(1, len(cloud.points) // MOST_POINTS)
    figure = Figure(figsize=(11, 5.5), layout="constrained")
    for panel, rows, title in zip(
        figure.subplots(1, 2), ([0, 1], [0, 2]), ("from above", "from the side"), strict=True
    ):
        plane = axes[rows]
        x, y = plane @ (cloud.points[::step] - middle).T
        panel.scatter(x, y, s=1, c=cloud.colors[::step] / 255, linewidths=0)
        _draw_cameras(panel, plane @ (centers - middle).T, plane @ rotations[:, 2].T * (0.06 * reach))
        panel.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", xticks=[], yticks=[])
        panel.set_title(f"{len(centers)} cameras {title}", fontsize=10)
    save_figure(path, figure)


def _draw_cameras(panel: Axes, places: np.ndarray, ahead: np.ndarray) -> None:
    """Draw places [2, V] with lines in the viewing directions [2, V], joined in the order of their names."""
    panel.plot(*places, color=COLORS[2], linewidth=0.5, alpha=0.5)
    panel.plot(*np.stack([places, places + ahead], axis=1), color=COLORS[1], linewidth=0.8)
    panel.scatter(places[0], places[1], s=8, color=COLORS[0], zorder=3)


def _upright_axes(rotations: np.ndarray) -> np.ndarray:
    """Return rows right, ahead and up [3, 3] of the picture; up is the mean upper side of the photographs."""
    up = -rotations[:, 1].mean(axis=0)
    up = up / max(float(np.linalg.norm(up)), 1e-9)
    right = rotations[:, 0].mean(axis=0)
    right = right - up * (right @ up)
    if np.linalg.norm(right) < 1e-6:  # Cameras all around have no common right side.
        right = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(up, right), up])


def _reach(centers: np.ndarray, points: np.ndarray, middle: np.ndarray) -> float:
    """Return half the side of the picture: all cameras, and most of the points."""
    far_cameras = float(np.abs(centers - middle).max())
    far_points = float(np.quantile(np.abs(points - middle).max(axis=1), 0.9)) if len(points) else 0.0
    return 1.1 * max(far_cameras, min(far_points, WIDEST * far_cameras), 1e-9)
