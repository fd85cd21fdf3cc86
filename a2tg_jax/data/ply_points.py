"""Points with colours from ASCII or binary PLY files, as from nerfstudio and point-cloud programs."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from a2tg_jax.core.gaussians import SH_C0
from a2tg_jax.data.assembly import PointCloud
from a2tg_jax.data.ply_header import VertexHeader, offset_of, read_vertex_header
from a2tg_jax.host.regular_files import is_regular, open_regular

COLORS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
"""Names of colours, in order of preference."""
SH_DEGREE0 = ("f_dc_0", "f_dc_1", "f_dc_2")
FLOAT_RANGES, INTEGER_RANGES = (1, 255, 65535), (255, 65535, 2**32 - 1)
"""Largest values of colours in files."""


def read_ply_points(path: Path) -> PointCloud:
    """Return the points of a PLY file whose first element is `vertex` with x, y, z.

    Positions that are relative to an offset, as `save_ply` writes those of maps, are in the original world.

    Colours are whole numbers of 8 bits or, if some are above 255, of 16 or 32; or floats in [0, 1] or, if their mean
    is above 1, in 0..255 (above 255: 0..65535). Numbers beyond are clipped. Gaussians have the colours of their f_dc.
    Points without colours are mid-grey.

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
    names = next((names for names in (*COLORS, SH_DEGREE0) if set(names).issubset(columns)), None)
    if names is None or not header.count:
        return np.full((header.count, 3), 128, np.uint8)
    given = np.nan_to_num(np.stack([columns[name] for name in names], axis=-1).astype(np.float64))
    if names == SH_DEGREE0:
        colors = 0.5 + SH_C0 * given
    elif header.fields[names[0]].startswith("f"):  # Some floats are a little above 1, or far: the mean decides.
        mean = np.clip(given, 0, FLOAT_RANGES[-1]).mean()
        colors = given / next(largest for largest in FLOAT_RANGES if mean <= largest)
    else:
        colors = given / next(largest for largest in INTEGER_RANGES if given.max() <= largest)
    pixels: np.ndarray = np.rint(255 * np.clip(colors, 0, 1)).astype(np.uint8)
    return pixels
