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
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import DTypeLike
from scipy.spatial.transform import Rotation

from a2tg_jax import Gaussians, Model, Similarity
from a2tg_jax.appearance.parts import LEAST_OPACITY
from a2tg_jax.base.atomic import write_whole
from a2tg_jax.base.regular_files import check_exists, open_regular, reading
from a2tg_jax.base.suffixes import checked_path
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.core.sh import NUM_BASES, SH_C0
from a2tg_jax.data.other_runs import model_hint
from a2tg_jax.data.ply import OFFSET, RGB, ROTATION, SH_DEGREE0, PlyFile, largest_color
from a2tg_jax.io.columns import logits_of
from a2tg_jax.io.other_programs import (
    FILTER,
    FileRows,
    PlacedSplats,
    World,
    degree_to_read,
    filtered,
    flat_rows,
    number_words,
    offset_for,
    origin_at,
    pack_bits,
    third_log_scales,
    unpack_bits,
    warn_of_offset,
    warn_of_unread,
    with_largest,
    without_largest,
    world_gaussians,
)
from a2tg_jax.model import check_model

MEANS = ("x", "y", "z")
NORMALS = ("nx", "ny", "nz")
SH_REST = tuple(f"f_rest_{i}" for i in range(45))
SCALES = ("scale_0", "scale_1")
QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
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
    world: World = "original",
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
    path = checked_path(path, "save_ply")
    placed = world_gaussians(gaussians, transform, world=world)
    third = third_log_scales(np.asarray(placed.gaussians.log_scales)) if third_scale else None
    offset = np.zeros(3) if float64 else placed.offset
    comments = place_comments(offset, placed.turn)
    write_whole(path, encode_ply(placed.gaussians, third, comments, placed.means if float64 else None))
    warn_of_offset("ply", offset, path)


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
    sh = np.asarray(gaussians.sh)
    log_scales = np.asarray(gaussians.log_scales)
    # [N, K, 3] to channel by channel, as 3DGS writes f_rest.
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(gaussians.num, 3 * (sh.shape[1] - 1))
    names = [name for name in ATTRIBUTES if name not in SH_REST[rest.shape[1] :]]
    if third is not None:
        names.insert(names.index(SCALES[-1]) + 1, THIRD_SCALE)
        log_scales = np.concatenate([log_scales, third], axis=1)
    columns = [
        # Normals: the third column of each rotation.
        np.asarray(gaussians.rotations[:, :, 2]),
        sh[:, 0],
        rest,
        np.asarray(gaussians.logit_opacities)[:, None],
        log_scales,
        np.asarray(gaussians.quats),
    ]
    kind = "float" if means is None else "double"
    properties = [(kind if name in MEANS else "float", name) for name in names]
    positions = np.asarray(gaussians.means, "<f4") if means is None else np.asarray(means, "<f8")
    parts = (positions, np.concatenate(columns, axis=1).astype("<f4"))
    # As bytes, since float64 positions and float32 columns share a row.
    rows = np.concatenate([np.ascontiguousarray(part).view(np.uint8) for part in parts], axis=1)
    header = ply_header([("vertex", gaussians.num, properties)], f"comment {FLAT_MARK}\n{comments}")
    return header + rows.tobytes()


def ply_header(elements: Iterable[tuple[str, int, Iterable[tuple[str, str]]]], comments: str = "") -> bytes:
    """Return the header of a binary file, given name, number of rows, and types and names of the properties of each
    element."""
    lines = ["ply", "format binary_little_endian 1.0", *comments.splitlines()]
    for element, num, properties in elements:
        lines.append(f"element {element} {num}")
        lines += [f"property {kind} {name}" for kind, name in properties]
    return "\n".join([*lines, "end_header\n"]).encode("ascii")


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
    return "".join(f"comment {word} {' '.join(number_words(numbers))}\n" for word, numbers in marks)


def load_ply(path: str | os.PathLike[str]) -> Gaussians:
    """Read Gaussians from a PLY file of 2DGS, of a program that uses its attribute names, or as SuperSplat packs it.

    Positions of map coordinates (`save_ply`), and float64 positions that float32 would round too far, are relative to
    whole numbers that a warning names; `load_splats` keeps these in the model's origin.

    Text and binary files of either byte order are read, and colours red, green, blue where f_dc_* are missing. SH
    keep the file's degree. Degrees above 3 are dropped with a warning, and so are Gaussians with numbers that are not
    finite or too large to draw. filter_3D of Mip-Splatting widens the scales and lowers the opacities, as that program
    draws them. A warning names other attributes that are not read, except normals and additional colours.
    The third scale (scale_2) of a file that marks its splats as flat is dropped. Other files have ellipsoids: the
    thinnest axis of each becomes the normal and its scale is dropped, with a warning if that is more than a thousandth
    of the shorter other scale.

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
    path = checked_path(path, "load_ply")
    model = load_ply_model(path)
    if model.origin is not None and model.origin.transform.translation.any():
        offset = ", ".join(number_words(-model.origin.transform.translation))
        warn(f"{path}: positions are relative to ({offset}); load_splats keeps this offset")
    return model.gaussians


def load_ply_model(path: Path) -> Model:
    """Return the Gaussians of `load_ply` as a model, with the offset of the positions, if any, in its origin."""
    check_exists(path, f"PLY file{model_hint(path)}")
    with open_regular(path) as file:
        return decode_ply(file, path)


def decode_ply(file: BinaryIO, path: Path) -> Model:
    """Read Gaussians from an open PLY file, as `load_ply_model` does; messages name the path."""
    ply = PlyFile(file, path)
    # A packed file begins with its chunks.
    columns = unpacked_vertices(ply) if [*ply.counts][:1] == ["chunk"] else _vertices(ply)
    is_flat = any(" ".join(words).lower() == FLAT_MARK.lower() for words in ply.comments)
    log_scales = _stacked(columns, SCALES if is_flat or THIRD_SCALE not in columns else (*SCALES, THIRD_SCALE))
    logits = _stacked(columns, ("opacity",))[:, 0]
    if FILTER in columns:
        log_scales, logits = filtered(log_scales, logits, columns[FILTER])
    # float64 until the offset is subtracted: float32 would round map coordinates.
    means = _stacked(columns, MEANS, np.float64)
    rows = FileRows(means, _stacked(columns, QUATS), log_scales, logits, _sh_of(columns, path))
    rows = flat_rows(str(path), rows)
    inside = offset_for("ply", rows.means, rows.log_scales)  # Zeros where the file has float32.
    gaussians = rows._replace(means=rows.means - inside).gaussians
    with reading(path):
        check_model(Model(gaussians))
        return Model(gaussians, origin=origin_at(inside + ply.offset, ply.turn))


def _vertices(ply: PlyFile) -> dict[str, np.ndarray]:
    """Return the attributes of the vertices by name, among them all of 2DGS."""
    fields = ply.fields.get("vertex", {})
    # Some programs write colours instead of f_dc_*.
    has_colors = set(RGB) <= set(fields) and not set(SH_DEGREE0) & set(fields)
    wanted = (*MEANS, *(RGB if has_colors else SH_DEGREE0), "opacity", *SCALES, *QUATS)
    of_networks = "; its networks make splats of these anchors: export them" if ANCHORS in fields else ""
    ply.require_vertices(wanted, f"a PLY of Gaussians{of_networks}")
    vertices = ply.read("vertex")
    columns = {name: vertices[name] for name in fields}
    warn_of_unread({*fields} - {*wanted, THIRD_SCALE, FILTER, *UNSEEN}, ply.path)
    if has_colors:
        colors = _stacked(columns, RGB, np.float64)
        if len(colors):
            colors /= largest_color(np.nan_to_num(colors), is_float=fields[RGB[0]].startswith("f"))
        columns |= zip(SH_DEGREE0, ((colors - 0.5) / SH_C0).T, strict=True)
    return columns


def _sh_of(columns: Mapping[str, np.ndarray], path: Path) -> np.ndarray:
    """Return the spherical harmonics [N, K, 3] of vertices with these attributes."""
    names = {name for name in columns if name.startswith("f_rest_")}
    rest = [f"f_rest_{i}" for i in range(len(names))]
    # Gaps in the numbering would shift the channels.
    if len(rest) not in NUM_REST or names != set(rest):
        raise ValueError(f"{path}: has {len(rest)} attributes f_rest_*; SH of degree 0 to 4 have 0, 9, 24, 45 or 72")
    num_bases = NUM_BASES[degree_to_read(NUM_REST.index(len(rest)), str(path))]
    constant = _stacked(columns, SH_DEGREE0)
    if not rest:
        return constant[:, None]
    # Channel by channel: the degree to read is cut from each channel.
    per_channel = _stacked(columns, rest).reshape(len(constant), 3, len(rest) // 3)
    return np.concatenate([constant[:, None], per_channel[:, :, : num_bases - 1].transpose(0, 2, 1)], axis=1)


def _stacked(columns: Mapping[str, np.ndarray], names: Iterable[str], dtype: DTypeLike = np.float32) -> np.ndarray:
    """Return attributes of vertices as the columns of an array."""
    with np.errstate(over="ignore"):  # What is too large becomes infinite, which fails the checks.
        return np.stack([columns[name].astype(dtype) for name in names], axis=-1)


# Files that SuperSplat packed

CHUNK = 256
AXES = "xyz"
CHANNELS = "rgb"
BOUNDS = tuple(f"{end}_{axis}" for end in ("min", "max", "min_scale", "max_scale") for axis in AXES)
COLOR_BOUNDS = tuple(f"{end}_{channel}" for end in ("min", "max") for channel in CHANNELS)
PACKED = {
    "packed_position": (11, 10, 11), "packed_rotation": (2, 10, 10, 10), "packed_scale": (11, 10, 11),
    "packed_color": (8, 8, 8, 8),
}  # fmt: skip
"""Attributes of a packed vertex, with the bits of the numbers in each."""
SH_RANGE = 8.0
"""Range of the coefficients that a byte encodes."""


def unpacked_vertices(ply: PlyFile) -> dict[str, np.ndarray]:
    """Return the attributes of the vertices of a packed PLY, by their names in 3DGS; float32."""
    path = ply.path
    names = list(ply.counts)
    if names not in (["chunk", "vertex"], ["chunk", "vertex", "sh"]):
        raise ValueError(f"{path}: a packed PLY has the elements chunk, vertex and sh; this one has {names}")
    if ply.encoding != "binary_little_endian":
        raise ValueError(f"{path}: is a packed PLY in {ply.encoding}; binary_little_endian is expected")
    for name, wanted in {"chunk": BOUNDS, "vertex": (*PACKED,), "sh": ()}.items():
        ply.require(name, wanted, "a PLY as SuperSplat packs it")
    num = ply.counts["vertex"]
    types = [ply.fields["vertex"][name] for name in PACKED]
    if set(types) != {"u4"}:
        raise ValueError(f"{path}: packed attributes must be uint; got {types}")
    if ply.counts["chunk"] != -(-num // CHUNK):
        raise ValueError(f"{path}: has {ply.counts['chunk']} chunks for {num} vertices; {CHUNK} are in each")
    if "sh" in names and (ply.counts["sh"] != num or set(ply.fields["sh"].values()) - {"u1"}):
        raise ValueError(f"{path}: sh must be uchar of each of the {num} vertices; got {ply.counts['sh']}")
    chunks, vertices, *rest = (ply.read(name) for name in names)
    # The last chunk may be partially filled.
    chunks = np.repeat(chunks, CHUNK)[:num]
    positions, rotations, scales, colors = (_shares(vertices[name], bits) for name, bits in PACKED.items())

    def within(what: str, axes: str, shares: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return columns scaled between their bounds."""
        scaled = []
        for axis, share in zip(axes, shares, strict=True):
            scaled.append(chunks[f"min_{what}{axis}"] * (1 - share) + chunks[f"max_{what}{axis}"] * share)
        return scaled

    columns = dict(zip(AXES, within("", AXES, positions), strict=True))
    columns |= zip((*SCALES, THIRD_SCALE), within("scale_", AXES, scales), strict=True)
    # Two bits are the index of a rotation's largest number, which follows from the others. These are within ±1/√2.
    largest, *smaller = rotations
    quats = with_largest((np.stack(smaller, axis=1) - 0.5) * np.sqrt(2), np.rint(3 * largest).astype(np.int64))
    columns |= zip(QUATS, quats.T, strict=True)
    *colors, opacity = colors
    # Older files have colours in [0, 1] without bounds.
    if set(COLOR_BOUNDS) <= set(ply.fields["chunk"]):
        colors = within("", CHANNELS, colors)
    columns |= {name: (color - 0.5) / SH_C0 for name, color in zip(SH_DEGREE0, colors, strict=True)}
    # Bytes 0 and 255 have no finite logit.
    opacity = np.clip(opacity, LEAST_OPACITY, 1 - LEAST_OPACITY)
    columns["opacity"] = logits_of(opacity)
    for name in ply.fields["sh"] if rest else ():
        codes = rest[0][name].astype(np.float64)
        # Centres of 256 bins, except at the ends, as SuperSplat decodes them.
        shares = np.where(codes == 0, 0.0, np.where(codes == 255, 1.0, (codes + 0.5) / 256))
        columns[name] = (shares - 0.5) * SH_RANGE
    return {name: values.astype(np.float32) for name, values in columns.items()}


def _shares(packed: np.ndarray, bits: tuple[int, ...]) -> list[np.ndarray]:
    """Return numbers in [0, 1] of unsigned integers packed into one, the first highest."""
    return [column / ((1 << num) - 1) for column, num in zip(unpack_bits(packed, bits), bits, strict=True)]


def _packed(shares: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Return numbers [N, C] in [0, 1] packed into one unsigned integer, as `_shares` reads them."""
    steps = np.asarray([(1 << num) - 1 for num in bits])
    return pack_bits(np.rint(np.clip(shares, 0, 1) * steps).T, bits)


def encode_packed_ply(placed: PlacedSplats) -> bytes:
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
    largest, smaller = without_largest(splats.quats)
    # The largest number of a rotation is an index from 0 to 3.
    rotations = np.concatenate([largest[:, None] / 3, smaller / np.sqrt(2) + 0.5], axis=1)
    shares_of_colors = np.concatenate([shares_of_colors, splats.opacities[:, None]], axis=1)
    columns = zip((positions, rotations, scales, shares_of_colors), PACKED.values(), strict=True)
    vertices = np.stack([_packed(column, bits) for column, bits in columns], axis=1)
    # Channel by channel; a byte is one of 256 bins.
    rest = splats.sh[:, 1:].transpose(0, 2, 1).reshape(num, -1)
    codes = np.floor(np.clip((rest / SH_RANGE + 0.5) * 256, 0, 255)).astype(np.uint8)
    names = {"chunk": (*BOUNDS, *COLOR_BOUNDS), "vertex": (*PACKED,), "sh": SH_REST[: rest.shape[1]]}
    counts = {"chunk": len(starts), "vertex": num, "sh": num}
    kinds = {"chunk": "float", "vertex": "uint", "sh": "uchar"}
    elements = []
    for element, attributes in names.items():
        if attributes:
            elements.append((element, counts[element], [(kinds[element], name) for name in attributes]))
    header = ply_header(elements, f"comment {FLAT_MARK}\n{place_comments(placed.offset, placed.turn)}")
    return header + np.concatenate(bounds, axis=1).astype("<f4").tobytes() + vertices.tobytes() + codes.tobytes()
