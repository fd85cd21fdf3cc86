"""PLY files of Gaussians with the attribute names of 2DGS, and a third scale for programs made for 3DGS.

Files have x y z nx ny nz f_dc_0..2 f_rest_0..44 opacity scale_0 scale_1 scale_2 rot_0..3, little-endian float32:
opacities as logits, scales as logarithms, quaternions wxyz. f_rest lists the coefficients of degree 1 to 3 channel by
channel: all of red, then green, then blue. scale_2 belongs to the axis along the normal; files of 2DGS lack it. The
comment "SplatRenderMode: 2dgs" says that splats are flat. The format has no place for other appearances: textures,
movable kernels and billboards, with their colours and opacities, are lost; `save_model` keeps all. Positions that
float32 would round too far, such as map coordinates, are relative to an offset: "comment offset X Y Z". A file that was
turned upright says how: "comment rotation W X Y Z", the quaternion from the original world.

SuperSplat packs a Gaussian into sixteen bytes, within the bounds of its chunk of 256. Elements: `chunk` (float: bounds
of positions, log-scales and, in newer files, colours), `vertex` (four uint: position and scale in 11, 10 and 11 bits;
rotation as the index of its largest number and the three others in 10 bits; colour and opacity in 8), and perhaps `sh`
(uchar: spherical harmonics above degree 0).
"""

import os
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import BinaryIO

import jax.numpy as jnp
import numpy as np
from numpy.lib.recfunctions import append_fields
from scipy.spatial.transform import Rotation

from a2tg_jax.core.gaussians import SH_C0, Gaussians, rotation_matrices
from a2tg_jax.core.sh import NUM_BASES
from a2tg_jax.core.similarity import Similarity
from a2tg_jax.data.other_runs import model_hint
from a2tg_jax.data.ply import OFFSET, RGB, ROTATION, SH_DEGREE0, PlyFile, largest_color
from a2tg_jax.host.atomic import write_whole
from a2tg_jax.host.regular_files import expanded, is_regular, open_regular
from a2tg_jax.io import other_programs as others
from a2tg_jax.io.validate import check_model, check_suffix, reading
from a2tg_jax.model import Model

MEANS, NORMALS = ("x", "y", "z"), ("nx", "ny", "nz")
SH_REST = tuple(f"f_rest_{i}" for i in range(45))
SCALES, QUATS = ("scale_0", "scale_1"), tuple(f"rot_{i}" for i in range(4))
ATTRIBUTES = (*MEANS, *NORMALS, *SH_DEGREE0, *SH_REST, "opacity", *SCALES, *QUATS)
NUM_REST = (0, 9, 24, 45, 72)
"""Number of attributes f_rest_* by degree of the spherical harmonics; some programs write degree 4."""
THIRD_SCALE = "scale_2"
UNSEEN = {*NORMALS, *RGB, "alpha"}
"""Attributes that change nothing that Gaussians show."""
ANCHORS = "f_anchor_feat_0"
"""Attribute of files of Scaffold-GS, whose networks make the splats."""
FLAT_MARK = "SplatRenderMode: 2dgs"
"""Comment in the header that marks flat splats."""


def save_ply(
    path: str | os.PathLike[str],
    gaussians: Gaussians | Model,
    transform: Similarity | None = None,
    *,
    third_scale: bool = True,
    float64: bool = False,
    world: others.World = "original",
) -> None:
    """Write Gaussians with the attributes of 2DGS, normals along the splats' own, and a third scale.

    If float32 would round positions in the original world, as in map coordinates, they are relative to whole numbers
    near the scene's middle, which a warning and the comment "offset X Y Z" in the file name.

    Args:
      path: the file; an existing one is replaced once the new one is complete.
      gaussians: N Gaussians; or a model, whose live Gaussians are written, without their appearance;
        their opacities are `Appearance.opacities`, for movable kernels and billboards have their own. Kernels of other
        shapes become the nearest Gaussians.
      transform: `scene.transform`, from the original world to the Gaussians' world; they are written in the original
        world, SH rotated. None leaves Gaussians unchanged; a model with an origin is written in its original world.
      third_scale: write scale_2, a thousandth of the shorter scale, which programs for 3DGS need. False omits it, as
        2DGS does.
      float64: write x, y and z as float64, and never relative to an offset.
      world: "upright" turns a model with cameras until −y is up, as programs for 3DGS expect. Map coordinates are not
        turned.

    Raises:
      ValueError: if a field of the Gaussians has the wrong shape, or a number that is not finite or too large.

    Examples:
      >>> a2tg.save_ply("scene.ply", model)
      >>> a2tg.load_ply("scene.ply").num
      200
    """
    check_suffix(path, "save_ply")
    path = expanded(path)
    found = others.world_gaussians(gaussians, transform, world=world)
    third = others.third_log_scales(np.asarray(found.gaussians.log_scales)) if third_scale else None
    means, offset = (found.means, np.zeros(3)) if float64 else (None, found.offset)
    write_whole(path, encode_ply(found.gaussians, third, place_comments(offset, found.turn), means))
    others.warn_of_offset("ply", offset, path)


def encode_ply(
    gaussians: Gaussians, third: np.ndarray | None, comments: str = "", means: np.ndarray | None = None
) -> bytes:
    """Return a PLY file of Gaussians. ValueError: they are invalid.

    Args:
      gaussians: N Gaussians.
      third: logarithms [N, 1] of third scales; None omits them.
      comments: further lines of the header.
      means: [N, 3] to write as float64 instead of the Gaussians' own.
    """
    # Never write a file that `load_ply` rejects.
    check_model(Model(gaussians))
    sh, log_scales = np.asarray(gaussians.sh), np.asarray(gaussians.log_scales)
    # [N, K, 3] to channel by channel, as 3DGS writes f_rest.
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(gaussians.num, 3 * (sh.shape[1] - 1))
    names = [name for name in ATTRIBUTES if name not in SH_REST[rest.shape[1] :]]
    if third is not None:
        names.insert(names.index(SCALES[-1]) + 1, THIRD_SCALE)
        log_scales = np.concatenate([log_scales, third], axis=1)
    columns = [
        # Normals: the third column of each rotation.
        np.asarray(rotation_matrices(gaussians.quats)[:, :, 2]),
        sh[:, 0],
        rest,
        np.asarray(gaussians.logit_opacities)[:, None],
        log_scales,
        np.asarray(gaussians.quats),
    ]
    kind, positions = ("float", np.asarray(gaussians.means, "<f4")) if means is None else ("double", means)
    properties = "".join(f"property {kind if name in MEANS else 'float'} {name}\n" for name in names)
    comments = f"comment {FLAT_MARK}\n{comments}"
    header = f"ply\nformat binary_little_endian 1.0\n{comments}element vertex {gaussians.num}\n{properties}end_header\n"
    parts = (positions.astype(positions.dtype.newbyteorder("<")), np.concatenate(columns, 1).astype("<f4"))
    # As bytes, since float64 positions and float32 columns share a row.
    rows = np.concatenate([np.ascontiguousarray(part).view(np.uint8) for part in parts], axis=1)
    return header.encode("ascii") + rows.tobytes()


def place_marks(offset: np.ndarray, turn: np.ndarray) -> dict[str, np.ndarray]:
    """Return what leads from a file back to the original world, by its word: the offset [3] of positions, and the
    rotation [3, 3] as a quaternion (wxyz), if there are any."""
    marks = {OFFSET: offset} if offset.any() else {}
    if not np.array_equal(turn, np.eye(3)):
        marks[ROTATION] = Rotation.from_matrix(turn).as_quat(scalar_first=True)
    return marks


def place_comments(offset: np.ndarray, turn: np.ndarray) -> str:
    """Return `place_marks` as header lines."""
    marks = place_marks(offset, turn).items()
    return "".join(f"comment {word} {' '.join(others.number_words(numbers))}\n" for word, numbers in marks)


def load_ply(path: str | os.PathLike[str]) -> Gaussians:
    """Read Gaussians from a PLY file of 2DGS, of a program that uses its attribute names, or as SuperSplat packs it.

    Positions of map coordinates (`save_ply`), and float64 positions that float32 would round too far, are relative to
    whole numbers that a warning names; `load_splats` keeps these in the model's origin.

    Text and binary files of either byte order are read, and colours red, green, blue where f_dc_* are missing. SH
    keep the file's degree. Degrees above 3 are dropped with a warning, and so are Gaussians with numbers that are not
    finite or too large to draw. filter_3D of Mip-Splatting widens the scales and lowers the opacities, as that program
    draws them; a warning names other attributes, but for normals and further colours.
    The third scale (scale_2) of a file that marks its splats as flat is dropped. Other files have ellipsoids: the
    thinnest axis of each becomes the normal and its scale is dropped, with a warning if that is more than a thousandth
    of the others.

    Args:
      path: the file.

    Returns:
      float32 Gaussians in the world of the file.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if it is not a PLY, is cut off, lacks an attribute, or has no finite Gaussian.

    Examples:
      >>> a2tg.save_ply("scene.ply", gaussians)
      >>> a2tg.load_ply("scene.ply").sh_degree
      1
    """
    check_suffix(path, "load_ply")
    model = load_ply_model(path)
    if model.origin is not None and model.origin.transform.translation.any():
        offset = ", ".join(others.number_words(-model.origin.transform.translation))
        warnings.warn(f"{path}: positions are relative to ({offset}); load_splats keeps this offset", stacklevel=2)
    return model.gaussians


def load_ply_model(path: str | os.PathLike[str]) -> Model:
    """Return the Gaussians of `load_ply` as a model, with the offset of the positions, if any, in its origin."""
    path = expanded(path)
    if not is_regular(path):
        raise FileNotFoundError(f"{path}: no such PLY file{model_hint(path)}")
    with open_regular(path) as file:
        return decode_ply(file, path)


def decode_ply(file: BinaryIO, path: Path, *, is_flat: bool = False) -> Model:
    """Read Gaussians from an open PLY file, as `load_ply_model` does; messages name the path.

    Splats are flat if `is_flat` or the header says so.
    """
    ply = PlyFile(file, path)
    # A packed file begins with its chunks.
    vertices = unpacked_vertices(ply) if [*ply.counts][:1] == ["chunk"] else _vertices(ply)
    is_flat |= any(" ".join(words).lower() == FLAT_MARK.lower() for words in ply.comments)
    has_third = THIRD_SCALE in (vertices.dtype.names or ()) and not is_flat
    log_scales = _columns(vertices, (*SCALES, THIRD_SCALE) if has_third else SCALES)
    # float64 until the offset is subtracted: float32 would round map coordinates.
    means, quats = np.stack([vertices[name].astype(np.float64) for name in MEANS], axis=-1), _columns(vertices, QUATS)
    logits = _columns(vertices, ("opacity",))[:, 0]
    if others.FILTER in (vertices.dtype.names or ()):
        log_scales, logits = others.filtered(log_scales, logits, vertices[others.FILTER])
    sh = _sh_of(vertices, path)
    means, quats, log_scales, logits, sh = others.flat_rows(str(path), means, quats, log_scales, logits, sh)
    inside = others.offset_for("ply", means, log_scales)  # Zeros where the file has float32.
    with np.errstate(over="ignore"):  # What is too large becomes infinite, which fails the checks.
        means = (means - inside).astype(np.float32)
    gaussians = Gaussians(*(jnp.asarray(rows) for rows in (means, quats, log_scales, logits, sh)))
    with reading(path):
        check_model(Model(gaussians))
        return Model(gaussians, origin=others.origin_at(inside + ply.offset, ply.turn))


def _vertices(ply: PlyFile) -> np.ndarray:
    """Return the vertices, structured, with 2DGS's attributes."""
    fields = ply.fields.get("vertex", {})
    # Some programs write colours instead of f_dc_*.
    has_colors = set(RGB) <= set(fields) and not set(SH_DEGREE0) & set(fields)
    wanted = (*MEANS, *(RGB if has_colors else SH_DEGREE0), "opacity", *SCALES, *QUATS)
    of_networks = "; its networks make splats of these anchors: export them" if ANCHORS in fields else ""
    ply.require_vertices(wanted, f"a PLY of Gaussians{of_networks}")
    vertices = ply.read("vertex")
    others.warn_of_unread({*fields} - {*wanted, THIRD_SCALE, others.FILTER, *UNSEEN}, ply.path)
    if not has_colors:
        return vertices
    colors = np.stack([vertices[name].astype(np.float64) for name in RGB], axis=1)
    if len(colors):
        colors /= largest_color(np.nan_to_num(colors), is_float=fields[RGB[0]].startswith("f"))
    return append_fields(vertices, SH_DEGREE0, ((colors - 0.5) / SH_C0).T, usemask=False)


def _sh_of(vertices: np.ndarray, path: Path) -> np.ndarray:
    """Return the spherical harmonics [N, K, 3] of a structured array of vertices."""
    found = {name for name in vertices.dtype.names or () if name.startswith("f_rest_")}
    rest = [f"f_rest_{i}" for i in range(len(found))]
    # Gaps in the numbering would shift the channels.
    if len(rest) not in NUM_REST or found != set(rest):
        raise ValueError(f"{path}: has {len(rest)} attributes f_rest_*; SH of degree 0 to 4 have 0, 9, 24, 45 or 72")
    num_bases = NUM_BASES[others.degree_to_read(NUM_REST.index(len(rest)), str(path))]
    sh = np.zeros((len(vertices), num_bases, 3), np.float32)
    sh[:, 0] = _columns(vertices, SH_DEGREE0)
    if rest:
        # Channel by channel: the degree to read is cut from each channel.
        per_channel = _columns(vertices, rest).reshape(len(vertices), 3, len(rest) // 3)
        sh[:, 1:] = per_channel[:, :, : num_bases - 1].transpose(0, 2, 1)
    return sh


def _columns(vertices: np.ndarray, wanted: Iterable[str]) -> np.ndarray:
    """Return attributes of vertices as columns, float32."""
    with np.errstate(over="ignore"):  # What is too large becomes infinite, which fails the checks.
        return np.stack([vertices[name].astype(np.float32) for name in wanted], axis=-1)


# Files that SuperSplat packed

CHUNK = 256
AXES, CHANNELS = "xyz", "rgb"
BOUNDS = tuple(f"{end}_{what}{axis}" for what in ("", "scale_") for end in ("min", "max") for axis in AXES)
COLOR_BOUNDS = tuple(f"{end}_{channel}" for end in ("min", "max") for channel in CHANNELS)
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
SH_RANGE = 8.0
"""Range of the coefficients that a byte encodes."""


def unpacked_vertices(ply: PlyFile) -> np.ndarray:
    """Return the vertices of a packed PLY, structured, with the attribute names of 3DGS; float32."""
    path, names = ply.path, list(ply.counts)
    if names not in (["chunk", "vertex"], ["chunk", "vertex", "sh"]):
        raise ValueError(f"{path}: a packed PLY has the elements chunk, vertex and sh; this one has {names}")
    if ply.encoding != "binary_little_endian":
        raise ValueError(f"{path}: is a packed PLY in {ply.encoding}; binary_little_endian is expected")
    for name, wanted in {"chunk": BOUNDS, "vertex": PACKED, "sh": ()}.items():
        ply.require(name, wanted, "a PLY as SuperSplat packs it")
    num, types = ply.counts["vertex"], [ply.fields["vertex"][name] for name in PACKED]
    if set(types) != {"u4"}:
        raise ValueError(f"{path}: packed attributes must be uint; got {types}")
    if ply.counts["chunk"] != -(-num // CHUNK):
        raise ValueError(f"{path}: has {ply.counts['chunk']} chunks for {num} vertices; {CHUNK} are in each")
    if "sh" in names and (ply.counts["sh"] != num or set(ply.fields["sh"].values()) - {"u1"}):
        raise ValueError(f"{path}: sh must be uchar of each of the {num} vertices; got {ply.counts['sh']}")
    chunks, vertices, *rest = (ply.read(name) for name in names)
    # The last chunk may be partially filled.
    chunks = np.repeat(chunks, CHUNK)[:num]

    def within(what: str, axes: str, shares: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return columns scaled between their bounds."""
        ends = [(chunks[f"min_{what}{axis}"], chunks[f"max_{what}{axis}"]) for axis in axes]
        return [low * (1 - share) + high * share for (low, high), share in zip(ends, shares, strict=True)]

    columns = dict(zip(AXES, within("", AXES, _unpacked(vertices["packed_position"], (11, 10, 11))), strict=True))
    scales = within("scale_", AXES, _unpacked(vertices["packed_scale"], (11, 10, 11)))
    columns |= {f"scale_{k}": scale for k, scale in enumerate(scales)}
    # The highest bits of a rotation hold the index of its largest number, which follows from the smaller.
    packed = vertices["packed_rotation"]
    smaller = np.stack(
        # Numbers other than the largest of a unit quaternion are within ±1/√2.
        [(share - 0.5) * np.sqrt(2) for share in _unpacked(packed & np.uint32((1 << 30) - 1), (10,) * 3)],
        axis=1,
    )
    quats = others.with_largest(smaller, packed >> np.uint32(30))
    columns |= {f"rot_{k}": quats[:, k] for k in range(4)}
    *colors, opacity = _unpacked(vertices["packed_color"], (8,) * 4)
    # Older files have colours in [0, 1] without bounds.
    if set(COLOR_BOUNDS) <= set(ply.fields["chunk"]):
        colors = within("", CHANNELS, colors)
    columns |= {f"f_dc_{k}": (color - 0.5) / SH_C0 for k, color in enumerate(colors)}
    # Bytes 0 and 255 have no finite logit.
    opacity = np.clip(opacity, others.LEAST_OPACITY, 1 - others.LEAST_OPACITY)
    columns["opacity"] = np.log(opacity) - np.log1p(-opacity)
    for name in ply.fields["sh"] if rest else ():
        codes = rest[0][name].astype(np.float64)
        # Centres of 256 bins, except at the ends, as SuperSplat decodes them.
        shares = np.where(codes == 0, 0.0, np.where(codes == 255, 1.0, (codes + 0.5) / 256))
        columns[name] = (shares - 0.5) * SH_RANGE
    found = np.empty(num, [(name, "<f4") for name in columns])
    for name, values in columns.items():
        found[name] = values
    return found


def _unpacked(packed: np.ndarray, bits: tuple[int, ...]) -> list[np.ndarray]:
    """Return numbers in [0, 1] of unsigned integers packed into one, the first highest."""
    found, shift = [], sum(bits)
    for num in bits:
        shift -= num
        found.append(((packed >> np.uint32(shift)) & np.uint32((1 << num) - 1)) / ((1 << num) - 1))
    return found


def _packed(shares: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Return numbers [N, C] in [0, 1] packed into one unsigned integer, as `_unpacked` reads them."""
    packed = np.zeros(len(shares), np.uint32)
    for column, num in zip(shares.T, bits, strict=True):
        steps = np.uint32((1 << num) - 1)
        packed = packed << np.uint32(num) | np.rint(np.clip(column, 0, 1) * steps).astype(np.uint32)
    return packed


def encode_packed_ply(placed: others.PlacedSplats) -> bytes:
    """Return splats as a PLY as SuperSplat packs it."""
    splats = placed.splats
    num = len(splats.means)
    starts = np.arange(0, num, CHUNK)
    colors = 0.5 + SH_C0 * splats.sh[:, 0]
    bounds = []
    shares = []
    for values in (splats.means, np.log(splats.scales), colors):
        # As float32, so that readers divide by the same bounds.
        values = values.astype(np.float32)
        low = np.minimum.reduceat(values, starts)
        high = np.maximum.reduceat(values, starts)
        bounds += [low, high]
        chunks = np.arange(num) // CHUNK
        width = (high - low).astype(np.float64)[chunks]
        shares.append((values - low[chunks]) / np.where(width > 0, width, 1.0))
    positions, scales, shares_of_colors = shares
    largest, smaller = others.without_largest(splats.quats)
    rotations = largest.astype(np.uint32) << np.uint32(30) | _packed(smaller / np.sqrt(2) + 0.5, (10,) * 3)
    # In the order of PACKED.
    vertices = np.stack(
        [
            _packed(positions, (11, 10, 11)),
            rotations,
            _packed(scales, (11, 10, 11)),
            _packed(np.concatenate([shares_of_colors, splats.opacities[:, None]], axis=1), (8,) * 4),
        ],
        axis=1,
    )
    # Channel by channel; a byte is one of 256 bins.
    rest = splats.sh[:, 1:].transpose(0, 2, 1).reshape(num, -1)
    codes = np.floor(np.clip((rest / SH_RANGE + 0.5) * 256, 0, 255)).astype(np.uint8)
    elements = [
        ("chunk", len(starts), "float", (*BOUNDS, *COLOR_BOUNDS)),
        ("vertex", num, "uint", PACKED),
        ("sh", num, "uchar", SH_REST[: rest.shape[1]]),
    ]
    header = f"ply\nformat binary_little_endian 1.0\ncomment {FLAT_MARK}\n{place_comments(placed.offset, placed.turn)}"
    for name, count, kind, attributes in elements:
        if attributes:
            header += f"element {name} {count}\n" + "".join(f"property {kind} {each}\n" for each in attributes)
    columns = (np.concatenate(bounds, axis=1).astype("<f4"), vertices.astype("<u4"), codes)
    return f"{header}end_header\n".encode("ascii") + b"".join(column.tobytes() for column in columns)
