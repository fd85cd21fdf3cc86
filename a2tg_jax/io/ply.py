"""PLY files of Gaussians with the attribute names of 2DGS.

x y z nx ny nz f_dc_0..2 f_rest_0..44 opacity scale_0 scale_1 rot_0..3, little-endian float32: opacities as logits,
scales as logarithms, quaternions wxyz. f_rest lists the coefficients of degree 1 to 3 channel by channel: all of red,
then green, then blue. What splats show besides has no place in this format: textures, movable kernels and billboards,
and with them the colours and opacities that they carry, are lost; `save_model` keeps all.

Programs made for 3DGS want a third scale, scale_2, of the axis along the normal.
"""

import dataclasses
import os
from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

import jax.numpy as jnp
import numpy as np

from a2tg_jax.core.gaussians import Gaussians, check_gaussians, rotation_matrices
from a2tg_jax.core.similarity import Similarity
from a2tg_jax.core.transform import transform_gaussians
from a2tg_jax.data.ply_header import read_vertex_header
from a2tg_jax.host.atomic import replacing
from a2tg_jax.host.regular_files import is_regular, open_regular
from a2tg_jax.io.flat import plain_splats, with_third_axis, without_thinnest_axis
from a2tg_jax.io.ply_packed import is_packed, read_packed
from a2tg_jax.io.suffixes import check_suffix
from a2tg_jax.io.validate import check_model
from a2tg_jax.model import Model

MEANS, NORMALS = ("x", "y", "z"), ("nx", "ny", "nz")
SH_DEGREE0, SH_REST = tuple(f"f_dc_{i}" for i in range(3)), tuple(f"f_rest_{i}" for i in range(45))
SCALES, QUATS = ("scale_0", "scale_1"), tuple(f"rot_{i}" for i in range(4))
ATTRIBUTES = (*MEANS, *NORMALS, *SH_DEGREE0, *SH_REST, "opacity", *SCALES, *QUATS)
REQUIRED = (*MEANS, *SH_DEGREE0, "opacity", *SCALES, *QUATS)
THIRD_SCALE = "scale_2"
ENCODING = "binary_little_endian"


def save_ply(
    path: str | os.PathLike[str],
    gaussians: Gaussians | Model,
    transform: Similarity | None = None,
    *,
    third_scale: bool = False,
) -> None:
    """Write Gaussians as 2DGS does, normals along the splats' own.

    Args:
      path: the file; an older one is replaced once the new one is whole.
      gaussians: N Gaussians; or a model, of which the Gaussians that exist are written, without what they show;
        they are as opaque as `Appearance.opacities` takes them to be (movable kernels and billboards have opacities of
        their own).
      transform: `scene.transform`, which led from the original world to the one the Gaussians live in; given, they are
        brought back to the original world first, SH included. None writes Gaussians as they are, and brings those of a
        model back to the original world of its origin, if it has one.
      third_scale: write scale_2, too, a thousandth of the shorter scale, for viewers of 3DGS files.

    Raises:
      ValueError: if a field of the Gaussians has another shape than it must have.
    """
    check_suffix(path, "save_ply")
    if isinstance(gaussians, Model):
        model = gaussians.live
        gaussians = plain_splats(model)
        transform = model.origin.transform if transform is None and model.origin is not None else transform
    check_gaussians(gaussians)
    if transform is not None:
        gaussians = transform_gaussians(gaussians, transform.inverse())
    sh, log_scales = np.asarray(gaussians.sh), np.asarray(gaussians.log_scales)
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(gaussians.num, 3 * (sh.shape[1] - 1))
    names = [name for name in ATTRIBUTES if name not in SH_REST[rest.shape[1] :]]
    if third_scale:
        names.insert(names.index(SCALES[-1]) + 1, THIRD_SCALE)
        log_scales = with_third_axis(log_scales)
    columns = [
        np.asarray(gaussians.means),
        np.asarray(rotation_matrices(gaussians.quats)[:, :, 2]),
        sh[:, 0],
        rest,
        np.asarray(gaussians.logit_opacities)[:, None],
        log_scales,
        np.asarray(gaussians.quats),
    ]
    properties = "".join(f"property float {name}\n" for name in names)
    header = f"ply\nformat {ENCODING} 1.0\nelement vertex {gaussians.num}\n{properties}end_header\n"
    with replacing(path) as temporary, open(temporary, "wb") as file:
        file.write(header.encode("ascii"))
        file.write(np.concatenate(columns, axis=1).astype("<f4").tobytes())


def load_ply(path: str | os.PathLike[str]) -> Gaussians:
    """Read Gaussians from a PLY file of 2DGS, of a program that uses its attribute names, or as SuperSplat packs it.

    They have the SH degree of the file; further attributes are left aside. A 3DGS file (scale_2) holds
    ellipsoids: the thinnest axis of each becomes the normal and its scale is dropped, with a warning if that is more
    than a thousandth of the others.

    Returns:
      float32 Gaussians in the world of the file.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if it is not a binary little-endian PLY, is cut off, lacks an attribute, or a number is not finite.
    """
    check_suffix(path, "load_ply")
    path = Path(path)
    if not is_regular(path):
        raise FileNotFoundError(f"{path}: no such PLY file")
    with open_regular(path) as file:
        vertices = read_packed(file, path) if is_packed(file, path) else _read_vertices(file, path)
    gaussians = _gaussians_of(vertices, path)
    try:
        _check_rows(gaussians)
        check_model(Model(gaussians))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return gaussians


def _check_rows(gaussians: Gaussians) -> None:
    """Raise ValueError, naming a field, the number of rows and the first of them, if some are not finite."""
    for field in dataclasses.fields(gaussians):
        rows = np.asarray(getattr(gaussians, field.name))
        bad = np.flatnonzero(~np.isfinite(rows).all(axis=tuple(range(1, rows.ndim))))
        if len(bad):
            raise ValueError(
                f"gaussians.{field.name} must be finite; {len(bad):,} of {gaussians.num:,} rows have NaN or infinite "
                f"numbers, the first is row {bad[0]:,} (from 0)"
            )


def _read_vertices(file: BinaryIO, path: Path) -> np.ndarray:
    """Return the vertices, structured, with the attributes that 2DGS gives them."""
    header = read_vertex_header(file, path)
    if header.encoding != ENCODING:
        raise ValueError(f"{path}: is a PLY in {header.encoding}; save it as {ENCODING}")
    header.require(REQUIRED, "a PLY of 2D Gaussians")
    return header.read_binary(file)


def _gaussians_of(vertices: np.ndarray, path: Path) -> Gaussians:
    """Return the Gaussians of a structured array of vertices."""
    names = vertices.dtype.names or ()
    rest = [name for name in SH_REST if name in names]
    if len(rest) not in (0, 9, 24, 45) or rest != list(SH_REST[: len(rest)]):
        raise ValueError(f"{path}: has {len(rest)} attributes f_rest_*; SH of degree 0 to 3 have 0, 9, 24 or 45")

    def columns(wanted: Iterable[str]) -> np.ndarray:
        with np.errstate(over="ignore"):  # What is too large becomes infinite, and is refused then.
            return np.stack([vertices[name].astype(np.float32) for name in wanted], axis=-1)

    sh = np.zeros((len(vertices), 1 + len(rest) // 3, 3), np.float32)
    sh[:, 0] = columns(SH_DEGREE0)
    if rest:
        per_channel = columns(rest).reshape(len(vertices), 3, len(rest) // 3)
        sh[:, 1:] = per_channel.transpose(0, 2, 1)
    quats, log_scales = columns(QUATS), columns(SCALES)
    if THIRD_SCALE in names:
        quats, log_scales = without_thinnest_axis(quats, columns((*SCALES, THIRD_SCALE)), path)
    return Gaussians(
        means=jnp.asarray(columns(MEANS)),
        quats=jnp.asarray(quats),
        log_scales=jnp.asarray(log_scales),
        logit_opacities=jnp.asarray(columns(("opacity",))[:, 0]),
        sh=jnp.asarray(sh),
    )
