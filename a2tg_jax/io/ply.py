"""PLY files of Gaussians with the attribute names of 2DGS, and a third scale for programs made for 3DGS.

Written are x y z nx ny nz f_dc_0..2 f_rest_0..44 opacity scale_0 scale_1 scale_2 rot_0..3, little-endian float32:
opacities as logits, scales as logarithms, quaternions wxyz. f_rest lists the coefficients of degree 1 to 3 channel by
channel: all of red, then green, then blue. scale_2 belongs to the axis along the normal; files of 2DGS lack it. The
comment "SplatRenderMode: 2dgs" says that splats are flat. What splats show besides has no place in this format:
textures, movable kernels and billboards, and with them the colours and opacities that they carry, are lost;
`save_model` keeps all.
"""

import dataclasses
import os
from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

import jax.numpy as jnp
import numpy as np
from numpy.lib.recfunctions import append_fields

from a2tg_jax.appearance.copies import LARGEST_OPACITY
from a2tg_jax.appearance.nearest_gaussians import nearest_gaussians
from a2tg_jax.core.gaussians import SH_C0, Gaussians, check_gaussians, logit, rotation_matrices
from a2tg_jax.core.sh import NUM_BASES
from a2tg_jax.core.similarity import Similarity
from a2tg_jax.core.transform import transform_gaussians
from a2tg_jax.data.ply_header import header_lines, read_vertex_header
from a2tg_jax.host.atomic import replacing
from a2tg_jax.host.regular_files import is_regular, open_regular
from a2tg_jax.io.flattening import flattened, third_log_scales, whole_rows
from a2tg_jax.io.ply_packed import is_packed, read_packed
from a2tg_jax.io.sh_degrees import degree_to_read
from a2tg_jax.io.suffixes import check_suffix
from a2tg_jax.io.validate import check_model
from a2tg_jax.model import Model

MEANS, NORMALS = ("x", "y", "z"), ("nx", "ny", "nz")
SH_DEGREE0, SH_REST = tuple(f"f_dc_{i}" for i in range(3)), tuple(f"f_rest_{i}" for i in range(45))
SCALES, QUATS = ("scale_0", "scale_1"), tuple(f"rot_{i}" for i in range(4))
ATTRIBUTES = (*MEANS, *NORMALS, *SH_DEGREE0, *SH_REST, "opacity", *SCALES, *QUATS)
COLORS = ("red", "green", "blue")
"""What some programs write in place of f_dc_*."""
NUM_REST = (0, 9, 24, 45, 72)
"""Number of attributes f_rest_* by degree of the spherical harmonics; some programs write degree 4."""
THIRD_SCALE = "scale_2"
LEAST_OPACITY = 1e-6
ENCODING = "binary_little_endian"
FLAT_MARK = "SplatRenderMode: 2dgs"
"""Comment in the header by which programs tell flat splats from ellipsoids."""


def save_ply(
    path: str | os.PathLike[str],
    gaussians: Gaussians | Model,
    transform: Similarity | None = None,
    *,
    third_scale: bool = True,
) -> None:
    """Write Gaussians with the attributes of 2DGS, normals along the splats' own, and a third scale.

    Args:
      path: the file; an older one is replaced once the new one is whole.
      gaussians: N Gaussians; or a model, of which the Gaussians that exist are written, without what they show;
        they are as opaque as `Appearance.opacities` takes them to be (movable kernels and billboards have opacities of
        their own). Kernels of other shapes become the nearest Gaussians.
      transform: `scene.transform`, which led from the original world to the one the Gaussians live in; given, they are
        brought back to the original world first, SH included. None writes Gaussians as they are, and brings those of a
        model back to the original world of its origin, if it has one.
      third_scale: write scale_2, a thousandth of the shorter scale, which programs for 3DGS want. False leaves it out,
        as 2DGS does.

    Raises:
      ValueError: if a field of the Gaussians has another shape than it must have, or `load_ply` would refuse them, as
        it does numbers that are not finite.
    """
    check_suffix(path, "save_ply")
    gaussians = plain_gaussians(gaussians, transform)
    third = third_log_scales(np.asarray(gaussians.log_scales)) if third_scale else None
    with replacing(path) as temporary:
        temporary.write_bytes(encode_ply(gaussians, third))


def plain_gaussians(
    gaussians: Gaussians | Model, transform: Similarity | None = None, *, keeps_shapes: bool = False
) -> Gaussians:
    """Return the Gaussians of a model without what they show, in the original world.

    Args:
      gaussians, transform: as in `save_ply`.
      keeps_shapes: the file keeps the shapes of kernels besides. If not, each kernel becomes the nearest Gaussian.
    """
    if isinstance(gaussians, Model):
        model = gaussians.live
        gaussians = _as_plain(model, keeps_shapes)
        transform = model.origin.transform if transform is None and model.origin is not None else transform
    check_gaussians(gaussians)
    return gaussians if transform is None else transform_gaussians(gaussians, transform.inverse())


def encode_ply(gaussians: Gaussians, third: np.ndarray | None) -> bytes:
    """Return a PLY file of Gaussians, with the logarithms [N, 1] of third scales, or without a third scale.

    Raises:
      ValueError: if `load_ply` would refuse the Gaussians, as it does numbers that are not finite.
    """
    _check(gaussians)
    sh, log_scales = np.asarray(gaussians.sh), np.asarray(gaussians.log_scales)
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(gaussians.num, 3 * (sh.shape[1] - 1))
    names = [name for name in ATTRIBUTES if name not in SH_REST[rest.shape[1] :]]
    if third is not None:
        names.insert(names.index(SCALES[-1]) + 1, THIRD_SCALE)
        log_scales = np.concatenate([log_scales, third], axis=1)
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
    start = f"ply\nformat {ENCODING} 1.0\ncomment {FLAT_MARK}\nelement vertex {gaussians.num}\n"
    return f"{start}{properties}end_header\n".encode("ascii") + np.concatenate(columns, 1).astype("<f4").tobytes()


def _as_plain(model: Model, keeps_shapes: bool) -> Gaussians:
    """Return the Gaussians of a model, opaque by themselves, with all spherical harmonics that they have."""
    shown = model.gaussians, model.params, model.layout
    gaussians = dataclasses.replace(model.gaussians, sh=jnp.asarray(model.sh))
    shapes = model.appearance.shapes(model.params)
    if shapes is not None and not keeps_shapes:
        gaussians = nearest_gaussians(gaussians, np.asarray(shapes))
    if model.appearance.has_own_opacities:
        return gaussians
    opacities = jnp.clip(model.appearance.opacities(*shown), LEAST_OPACITY, LARGEST_OPACITY)
    return dataclasses.replace(gaussians, logit_opacities=logit(opacities))


def load_ply(path: str | os.PathLike[str]) -> Gaussians:
    """Read Gaussians from a PLY file of 2DGS, of a program that uses its attribute names, or as SuperSplat packs it.

    Text and binary files of either byte order are read, and colours red, green, blue where f_dc_* are missing. They
    have the SH degree of the file. Degrees above 3 are left out with a warning, and so are Gaussians with numbers that
    are not finite; further attributes are ignored.
    The third scale (scale_2) of a file that says that its splats are flat is dropped. Any other holds ellipsoids: the
    thinnest axis of each becomes the normal and its scale is dropped, with a warning if that is more than a thousandth
    of the others.

    Returns:
      float32 Gaussians in the world of the file.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if it is no PLY, is cut off, lacks an attribute, or has no Gaussian of finite numbers.
    """
    check_suffix(path, "load_ply")
    path = Path(path)
    if not is_regular(path):
        raise FileNotFoundError(f"{path}: no such PLY file")
    with open_regular(path) as file:
        return decode_ply(file, path)


def decode_ply(file: BinaryIO, path: Path, *, is_flat: bool = False) -> Gaussians:
    """Read Gaussians from an open PLY file.

    Args:
      file: at its beginning.
      path: the name for messages.
      is_flat: whether the splats are known to be flat; if not, the header may say so.
    """
    vertices = read_packed(file, path) if is_packed(file, path) else _read_vertices(file, path)
    has_third = THIRD_SCALE in (vertices.dtype.names or ()) and not (is_flat or _is_marked(file, path))
    log_scales = _columns(vertices, (*SCALES, THIRD_SCALE) if has_third else SCALES)
    means, quats = _columns(vertices, MEANS), _columns(vertices, QUATS)
    logits, sh = _logits_of(vertices), _sh_of(vertices, path)
    kept = whole_rows(str(path), log_scales, means, quats, logits, sh)
    quats, log_scales = quats[kept], log_scales[kept]
    if has_third:
        quats, log_scales = flattened(quats, log_scales, str(path))
    gaussians = Gaussians(*(jnp.asarray(rows) for rows in (means[kept], quats, log_scales, logits[kept], sh[kept])))
    try:
        _check(gaussians)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return gaussians


def _is_marked(file: BinaryIO, path: Path) -> bool:
    """Return whether the header of a PLY says that the splats are flat."""
    file.seek(0)
    lines = [" ".join(words[1:]).lower() for words in header_lines(file, path) if words[:1] == ["comment"]]
    return FLAT_MARK.lower() in lines


def _check(gaussians: Gaussians) -> None:
    """Raise ValueError unless Gaussians can be rendered; of numbers that are not finite it tells field and rows."""
    for field in dataclasses.fields(gaussians):
        rows = np.asarray(getattr(gaussians, field.name))
        bad = np.flatnonzero(~np.isfinite(rows).all(axis=tuple(range(1, rows.ndim))))
        if len(bad):
            raise ValueError(
                f"gaussians.{field.name} must be finite; {len(bad):,} of {gaussians.num:,} rows have NaN or infinite "
                f"numbers, the first is row {bad[0]:,} (from 0)"
            )
    check_model(Model(gaussians))


def _read_vertices(file: BinaryIO, path: Path) -> np.ndarray:
    """Return the vertices, structured, with the attributes that 2DGS gives them."""
    header = read_vertex_header(file, path)
    has_colors = set(COLORS) <= set(header.fields) and not set(SH_DEGREE0) & set(header.fields)
    header.require((*MEANS, *(COLORS if has_colors else SH_DEGREE0), "opacity", *SCALES, *QUATS), "a PLY of Gaussians")
    vertices = header.read(file)
    if not has_colors:
        return vertices
    colors = np.stack([vertices[name].astype(np.float64) for name in COLORS], axis=1)
    kind = np.dtype(header.fields[COLORS[0]])
    if kind.kind != "f":
        colors /= np.iinfo(kind).max
    elif np.max(colors, initial=0.0, where=np.isfinite(colors)) > 1:
        colors /= 255  # Floats of 0 to 255, as some programs write them.
    return append_fields(vertices, SH_DEGREE0, ((colors - 0.5) / SH_C0).T, usemask=False)


def _logits_of(vertices: np.ndarray) -> np.ndarray:
    """Return the logits [N] of opacities. Infinite ones of opacities 0 and 1, as programs write them, become finite."""
    given = vertices["opacity"]
    most = np.where(given > 0, -np.log(LEAST_OPACITY), np.log(LEAST_OPACITY))
    return np.where(np.isinf(given), most, given).astype(np.float32)


def _sh_of(vertices: np.ndarray, path: Path) -> np.ndarray:
    """Return the spherical harmonics [N, K, 3] of a structured array of vertices."""
    found = {name for name in vertices.dtype.names or () if name.startswith("f_rest_")}
    rest = [f"f_rest_{i}" for i in range(len(found))]
    if len(rest) not in NUM_REST or found != set(rest):
        raise ValueError(f"{path}: has {len(rest)} attributes f_rest_*; SH of degree 0 to 4 have 0, 9, 24, 45 or 72")
    num_bases = NUM_BASES[degree_to_read(NUM_REST.index(len(rest)), str(path))]
    sh = np.zeros((len(vertices), num_bases, 3), np.float32)
    sh[:, 0] = _columns(vertices, SH_DEGREE0)
    if rest:
        per_channel = _columns(vertices, rest).reshape(len(vertices), 3, len(rest) // 3)
        sh[:, 1:] = per_channel[:, :, : num_bases - 1].transpose(0, 2, 1)
    return sh


def _columns(vertices: np.ndarray, wanted: Iterable[str]) -> np.ndarray:
    """Return attributes of vertices as columns, float32."""
    with np.errstate(over="ignore"):  # What is too large becomes infinite, and is refused then.
        return np.stack([vertices[name].astype(np.float32) for name in wanted], axis=-1)
