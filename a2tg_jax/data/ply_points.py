"""Points with colours from ASCII or binary PLY files, as from nerfstudio and point-cloud programs."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from a2tg_jax.data.assembly import PointCloud
from a2tg_jax.data.ply_header import VertexHeader, offset_of, read_vertex_header
from a2tg_jax.host.regular_files import is_regular, open_regular

COLORS = ("red", "green", "blue")


def read_ply_points(path: Path) -> PointCloud:
    """Return the points of a PLY file whose first element is `vertex` with x, y, z. Points without colours are
    mid-grey. Positions that are relative to an offset, as `save_ply` writes those of maps, are in the original world.

    Colours are whole numbers in 0..255, or floats in [0, 1]; those beyond are clipped.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: naming the file, if it is no such PLY or is truncated.
    """
    if not is_regular(path):
        raise FileNotFoundError(f"{path}: no such point file, but transforms.json names it; correct ply_file_path")
    with open_regular(path) as file:
        header = read_vertex_header(file, path)
        header.require("xyz", "a PLY file of points")
        vertices = header.read(file)
        columns = {name: vertices[name] for name in header.fields}
        offset = offset_of(file, path)
    points = np.stack([columns[name].astype(np.float64) for name in "xyz"], axis=-1) + offset
    return PointCloud(points, _colors(columns, header))


def _colors(columns: Mapping[str, np.ndarray], header: VertexHeader) -> np.ndarray:
    """Return uint8 colours [P, 3] of the vertices."""
    if not set(COLORS).issubset(columns):
        return np.full((header.count, 3), 128, np.uint8)
    colors = np.stack([columns[name] for name in COLORS], axis=-1)
    if header.fields["red"].startswith("f"):
        colors = np.rint(np.clip(np.nan_to_num(colors), 0, 1) * 255)
    pixels: np.ndarray = np.clip(np.nan_to_num(colors), 0, 255).astype(np.uint8)
    return pixels
