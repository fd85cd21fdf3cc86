"""Models as files of other programs hold them: ellipsoids in a world with other axes, and numbers of limited range.

A model's world has its cameras at a distance of about 1. A file's world has the original lengths and its format's up
axis; the model keeps its place in it. Positions that a format would round too far, such as map coordinates,
are relative to an offset.
"""

import collections
import dataclasses
import math
import string
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from a2tg_jax import Gaussians, Model, Origin, Similarity, concatenate, transform_gaussians
from a2tg_jax.appearance.parts import LEAST_OPACITY, MAX_DEGREE
from a2tg_jax.base.atomic import write_whole
from a2tg_jax.base.checks import LARGEST_NUMBER, check_literal
from a2tg_jax.base.regular_files import existing_bytes, reading
from a2tg_jax.base.text import counted, first_names, shortened
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.core.gaussians import LARGEST_LOG_SCALE, LARGEST_OPACITY
from a2tg_jax.core.origin import check_origin
from a2tg_jax.core.sh import NUM_BASES, SH_C0
from a2tg_jax.core.similarity import check_similarity
from a2tg_jax.data.capture_geometry import upright_rotation
from a2tg_jax.io.columns import logits_of, morton, opacities_of
from a2tg_jax.model import check_model, plain_gaussians
from a2tg_jax.model_file import origin_arrays, origin_header

Up = Literal["y", "z"]
World = Literal["upright", "original"]
"""World of a file: the original one, or that one turned until −y is up, as other programs show it."""
Kind = str
"""Name of a format: its suffix without the dot, such as "spz"; "ply" means all with float32 positions."""
UPRIGHT: Mapping[Up, np.ndarray] = {
    # (x, y, z) → (x, z, −y): a quarter turn about x.
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "z": np.eye(3),
}
"""Rotation from a world of +z up to one of another axis."""
UNMOVED = Similarity(1.0, np.eye(3), np.zeros(3))
LEVEL = math.cos(math.radians(3))
"""Cosine of the largest angle between the estimated vertical and an axis that counts as the vertical itself."""
LEAST_SCALE = 1e-30
FILTER = "filter_3D"
"""Name of the widths of Mip-Splatting's filter in PLY files."""
LEAST_LENGTH = 1e-9
"""Length of a quaternion below which, and above whose inverse, it is made a unit quaternion."""
LEAST_THIRD_SCALE = math.exp(-20)
CURVE_BITS = 16
THICKNESS = 1e-3
"""Ratio of a flat Gaussian's third scale in a file to its shorter one."""
# Turns by 120° and −120° about (1, 1, 1), and none.
AXES_TO_NORMAL = np.array([[0.5, 0.5, 0.5, 0.5], [0.5, -0.5, -0.5, -0.5], [1.0, 0.0, 0.0, 0.0]], np.float32)
"""Row k: the rotation (wxyz) that permutes the axes so that the k-th becomes the third."""
SAME_PLACE = 1e-5
"""Largest difference of numbers between two similarities that count as equal."""
SAME_SCALE = 1e-3
"""Largest relative difference between the axis scales of a transform."""
MOST_PARTS = 256
"""Largest number of sets of splats in one file."""


# From a model to a file


class Ellipsoids(NamedTuple):
    """N ellipsoids with activated numbers; float32 on the host."""

    means: np.ndarray
    """[N, 3]."""
    quats: np.ndarray
    """Unit quaternions [N, 4], wxyz."""
    scales: np.ndarray
    """Standard deviations [N, 3]."""
    opacities: np.ndarray
    """[N] in [0, 1]."""
    sh: np.ndarray
    """[N, K, 3] coefficients, as in `Gaussians`."""

    @staticmethod
    def of(*columns: ArrayLike) -> "Ellipsoids":
        """Return the ellipsoids of five columns, rounded to float32."""
        return Ellipsoids(*(np.asarray(column, np.float32) for column in columns))


class WorldGaussians(NamedTuple):
    """Plain Gaussians in the world of a file."""

    gaussians: Gaussians
    """Their means are relative to the offset."""
    offset: np.ndarray
    """[3] float64 whole numbers; zeros if the format can hold the positions."""
    means: np.ndarray
    """[N, 3] float64 positions, without the offset."""
    turn: np.ndarray
    """[3, 3] rotation from the original world."""


def world_gaussians(
    gaussians: Gaussians | Model,
    transform: Similarity | None = None,
    kind: Kind = "ply",
    world: World = "original",
) -> WorldGaussians:
    """Return the Gaussians of a model without its appearance, in a file's world; arguments as in `save_ply`."""
    check_literal("world", world, World)
    plain = plain_gaussians(gaussians)
    if transform is None and isinstance(gaussians, Model) and gaussians.origin is not None:
        transform = gaussians.origin.transform
    to_world = UNMOVED if transform is None else transform.inverse()
    turn = upright_turn(gaussians) if world == "upright" and isinstance(gaussians, Model) else np.eye(3)
    if not np.array_equal(turn, np.eye(3)):
        to_world = to_world.then(Similarity(1.0, turn, np.zeros(3)))
    means = to_world.apply(np.asarray(plain.means, np.float64))
    offset = offset_after(kind, plain, to_world)
    # Without a move nothing is computed, so that nothing is rounded.
    if transform is not None or offset.any():
        # The offset is subtracted before means are rounded to float32.
        to_world = dataclasses.replace(to_world, translation=to_world.translation - offset)
        plain = transform_gaussians(plain, to_world)
    return WorldGaussians(plain, offset, means, turn)


def upright_turn(model: Model) -> np.ndarray:
    """Return the rotation [3, 3] from a model's original world to the upright one of files, whose −y is up.

    The vertical is estimated from the cameras; without cameras −y of the model is up, as in files of splats. Map
    coordinates are not turned.
    """
    origin = model.origin
    return np.eye(3) if origin is None or has_map_coordinates(model) else upright_rotation(_vertical_of_files(origin))


def _vertical_of_files(origin: Origin) -> np.ndarray:
    """Return the vertical [3] of all files of other programs, in the original world."""
    up = origin.transform.rotation.T @ origin.vertical
    # Captures that know their vertical keep their axes: the estimate is off by a few degrees.
    return np.rint(up) if origin.up is None and np.abs(up).max() > LEVEL else up


def has_map_coordinates(model: Model) -> bool:
    """Return whether float32 would round a model's positions in its original world too far."""
    if model.origin is None:
        return False
    return bool(offset_after("ply", model.live.gaussians, model.origin.transform.inverse()).any())


def world_line(model: Model, world: World) -> str:
    """Describe the world of a file of a model."""
    if world == "original":
        return "world: the original one, in its units and axes"
    if has_map_coordinates(model):
        return "world: the original one, because of its map coordinates"
    if model.origin is None or (not model.origin.names and model.origin.up is None):
        return "world: as in the source, which has no cameras to find the vertical by"
    degrees = math.degrees(Rotation.from_matrix(upright_turn(model)).magnitude())
    turned = f"the original one turned by {degrees:.1f}°" if degrees else "which is the original one"
    return f"world: upright with +y down, {turned}"


def splats_of(model: Model, *, keeps_shapes: bool = False) -> Ellipsoids:
    """Return the splats of a model without unused rows, with a third axis of a thousandth of the shorter.

    If splats differ in degree, coefficients go up to the highest degree. `keeps_shapes` is as in
    `plain_gaussians`.
    """
    gaussians = plain_gaussians(model, keeps_shapes=keeps_shapes)
    quats = np.asarray(gaussians.quats, np.float64)
    # Other programs expect unit quaternions; here any length is allowed.
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    units = np.where(norms > 0, quats / np.maximum(norms, LEAST_SCALE), [1.0, 0.0, 0.0, 0.0])
    opacities = opacities_of(np.asarray(gaussians.logit_opacities))
    log_scales = np.asarray(gaussians.log_scales, np.float64)
    scales = np.exp(np.concatenate([log_scales, third_log_scales(log_scales)], axis=1))
    # Coefficients above every splat's degree are zeros.
    sh = gaussians.sh[:, : NUM_BASES[model.degrees.max(initial=0)]]
    return Ellipsoids.of(gaussians.means, units, scales, opacities, sh)


def third_log_scales(log_scales: np.ndarray) -> np.ndarray:
    """Return the logarithms [N, 1] of third scales, a thousandth of the shorter of [N, 2]."""
    return log_scales.min(axis=1, keepdims=True) + np.log(THICKNESS)


class PlacedSplats(NamedTuple):
    """Splats as a file of another program holds them: one or more, sorted along a Z curve, all with one third scale."""

    splats: Ellipsoids
    offset: np.ndarray
    """[3], which the positions are relative to."""
    turn: np.ndarray
    """[3, 3] rotation from the original world."""


def writer_as(kind: Kind, encode: Callable[[PlacedSplats], bytes]) -> Callable[..., None]:
    """Return a function that writes the Gaussians of a model in a format.

    It takes a path, a model and a `world`, as `save_ply` does. Positions that the format would round too far are
    relative to whole numbers, which a warning names. It raises ValueError if there are no Gaussians, they are invalid,
    or the format cannot hold their positions.
    """

    def save(path: Path, model: Gaussians | Model, *, world: World = "original") -> None:
        placed = world_gaussians(model, kind=kind, world=world)
        gaussians = placed.gaussians
        if not gaussians.num:
            raise ValueError(f"{path}: the model has no Gaussians; a file of this format has at least one")
        check_model(Model(gaussians))  # Never write a file that would not load.
        check_positions(kind, gaussians, path)
        means = np.asarray(gaussians.means, np.float64)
        above = means - means.min(axis=0)
        # All means may be equal along an axis.
        shares = above / np.maximum(above.max(axis=0), LEAST_SCALE)
        codes = (shares * (2**CURVE_BITS - 1)).astype(np.int64)
        # Stable: equal codes keep their order, so that files repeat.
        splats = splats_of(Model(gaussians[np.argsort(morton(codes.T, CURVE_BITS), kind="stable")]))
        # Formats that round scales by a table then spend one entry on the third.
        splats.scales[:, 2] = max(splats.scales[:, 2].min(), LEAST_THIRD_SCALE)
        write_whole(path, encode(PlacedSplats(splats, placed.offset, placed.turn)))
        warn_of_offset(kind, placed.offset, path)

    return save


def reader_of(decode: Callable[[bytes, Path], Model]) -> Callable[[Path], Model]:
    """Return a function that reads a file by a function of its bytes and its path.

    It raises FileNotFoundError if there is no such file; a ValueError names the file.
    """

    def load(path: Path) -> Model:
        data = existing_bytes(path, "file")
        with reading(path):
            return decode(data, path)

    return load


def to_bytes(values: np.ndarray) -> np.ndarray:
    """Return numbers rounded to bytes; those beyond 0..255 are clipped."""
    return np.rint(np.clip(values, 0, 255)).astype(np.uint8)


def pack_bits(columns: Iterable[np.ndarray], bits: tuple[int, ...]) -> np.ndarray:
    """Return columns of unsigned integers of these bits packed into one of 32 bits, the first highest."""
    packed: Any = np.uint32(0)
    for column, num in zip(columns, bits, strict=True):
        packed = packed << np.uint32(num) | column.astype(np.uint32)
    return np.asarray(packed, "<u4")


def unpack_bits(packed: np.ndarray, bits: tuple[int, ...]) -> list[np.ndarray]:
    """Return the columns that `pack_bits` was given."""
    columns = []
    for num in reversed(bits):
        columns.append(packed & np.uint32((1 << num) - 1))
        packed = packed >> np.uint32(num)
    return columns[::-1]


def without_largest(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the index [N] of the largest number of unit quaternions [N, 4], and the others [N, 3], with the signs that
    they have where the largest is positive."""
    largest = np.argmax(np.abs(quats), axis=1)
    is_largest = np.arange(4) == largest[:, None]
    signs = np.where(quats[is_largest] < 0, -1.0, 1.0)
    return largest, quats[~is_largest].reshape(-1, 3) * signs[:, None]


def with_largest(smaller: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """Return the quaternions [N, 4] that `without_largest` was given, or their negatives."""
    is_largest = np.arange(4) == largest[:, None]
    quats = np.empty(is_largest.shape)
    quats[~is_largest] = smaller.ravel()
    # Rounding may push the squares above 1.
    quats[is_largest] = np.sqrt(np.maximum(1 - np.sum(smaller**2, axis=1), 0.0))
    return quats


def linear_colors(colors: np.ndarray) -> np.ndarray:
    """Return linear colours of sRGB colours in [0, 1]."""
    # IEC 61966-2-1.
    return np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)


# From a file to Gaussians


def gaussians_of(splats: Ellipsoids, path: Path, *, is_flat: bool, keeps_all: bool = False) -> Gaussians:
    """Return the Gaussians of a file's splats, whose third axis is the normal if the file `is_flat`.

    Otherwise the thinnest axis becomes the normal. Splats that cannot be drawn are left out with a warning, unless
    `keeps_all`.
    """
    # A covariance has the squares of the scales, whatever their signs.
    log_scales = np.log(np.maximum(np.abs(splats.scales), LEAST_SCALE))
    if is_flat:
        log_scales = log_scales[:, :2]
    logits = logits_of(np.clip(splats.opacities.astype(np.float64), LEAST_OPACITY, LARGEST_OPACITY))
    rows = FileRows(splats.means, splats.quats, log_scales, logits, splats.sh)
    return flat_rows(str(path), rows, keeps_all=keeps_all).gaussians


def model_of_splats(splats: Ellipsoids, path: Path, *, is_flat: bool = False, **fields: Any) -> Model:
    """Return the model of a file's splats, as `gaussians_of`, with further fields of the model. ValueError: none of the
    splats can be drawn."""
    model = Model(gaussians_of(splats, path, is_flat=is_flat), **fields)
    check_model(model)
    return model


class FileRows(NamedTuple):
    """Numbers of N Gaussians in a file, of any type of floats."""

    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    """[N, 2], or [N, 3] of ellipsoids."""
    logits: np.ndarray
    sh: np.ndarray

    @property
    def gaussians(self) -> Gaussians:
        """The same as float32; numbers that are too large for it become infinite, which fails the checks of a model."""
        with np.errstate(over="ignore"):
            return Gaussians(*(jnp.asarray(np.asarray(column, np.float32)) for column in self))


def flat_rows(name: str, rows: FileRows, *, keeps_all: bool = False) -> FileRows:
    """Return the rows that can be drawn, or all of them if it `keeps_all`, with two log-scales.

    Three log-scales are `flattened`. Quaternions of zeros become unrotated, as the renderer draws them, with a warning;
    infinite logits become finite.
    """
    quats = np.array(rows.quats)
    lengths = np.linalg.norm(quats.astype(np.float64), axis=1)
    unrotated = np.flatnonzero(lengths == 0)
    if len(unrotated):
        warn(
            f"{name}: {counted(len(unrotated), 'Gaussian')} of {len(lengths):,} with the rotation 0 0 0 0, read as "
            f"unrotated; the first is row {unrotated[0]:,} (from 0)"
        )
        quats[unrotated] = [1, 0, 0, 0]
    # The squares of these leave the range of float32.
    is_extreme = ((lengths > 0) & (lengths < LEAST_LENGTH)) | (np.isfinite(lengths) & (lengths > 1 / LEAST_LENGTH))
    quats[is_extreme] /= lengths[is_extreme, None]
    # Some programs write infinite logits for opacities 0 and 1.
    most = np.copysign(np.log(LEAST_OPACITY), rows.logits).astype(rows.logits.dtype)
    rows = rows._replace(quats=quats, logits=np.where(np.isinf(rows.logits), most, rows.logits))
    if not keeps_all:
        is_drawable = drawable_rows(name, rows)
        rows = FileRows(*(column[is_drawable] for column in rows))
    if rows.log_scales.shape[1] == 3:
        quats, log_scales = flattened(rows.quats, rows.log_scales, name)
        rows = rows._replace(quats=quats, log_scales=log_scales)
    return rows


def drawable_rows(name: str, rows: FileRows) -> np.ndarray:
    """Return which rows [N] have finite numbers that float32 can draw. The others are counted in a warning that names
    the file and the first of them.

    If there are none, all are returned, and the checks of a model fail. Of three log-scales the smallest may be −inf:
    `flattened` drops it.
    """
    # NaN is sorted to the end.
    checked = rows._replace(log_scales=np.sort(rows.log_scales, axis=1)[:, -2:])
    num = len(rows.means)
    is_drawable = np.ones(num, bool)
    first = num
    what = ""
    for field, column in checked._asdict().items():
        numbers = column.reshape(num, math.prod(column.shape[1:]))
        # False for NaN.
        is_good = numbers <= (LARGEST_LOG_SCALE if field == "log_scales" else LARGEST_NUMBER)
        is_good &= numbers >= -LARGEST_NUMBER
        bad = np.flatnonzero(~is_good.all(axis=1))
        is_drawable[bad] = False
        if len(bad) and bad[0] < first:
            first = bad[0]
            what = f"{field} of {numbers[first][~is_good[first]][0]:g}"
    if not is_drawable.any():
        return np.ones(num, bool)
    if what:
        warn(
            f"{name}: {counted(num - int(is_drawable.sum()), 'Gaussian')} of {num:,} left out, with numbers that are "
            f"NaN, infinite or too large to draw (beyond ±{LARGEST_NUMBER:g}); the first is row {first:,} (from 0), "
            f"with {what}"
        )
    return is_drawable


def filtered(log_scales: np.ndarray, logits: np.ndarray, widths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return log-scales [N, 2 or 3] and logits [N] as drawn through the 3D filter of Mip-Splatting (Yu et al., 2024).

    A Gaussian of scales s and opacity o is drawn with s' = √(s² + f²) and o·Π s/s', f being its width of the filter.
    """
    log_scales, logits, widths = (values.astype(np.float64) for values in (log_scales, logits, widths))
    with np.errstate(divide="ignore", invalid="ignore"):  # Widths and scales of 0; their rows are replaced below.
        wider = np.logaddexp(2 * log_scales, 2 * np.log(np.abs(widths))[:, None]) / 2
        log_opacities = (log_scales - wider).sum(axis=1) - np.logaddexp(0, -logits)
        log_opacities = np.minimum(log_opacities, np.log(LARGEST_OPACITY))
        fainter = log_opacities - np.log(-np.expm1(log_opacities))
    is_filtered = widths != 0
    log_scales = np.where(is_filtered[:, None], wider, log_scales)
    logits = np.where(is_filtered, fainter, logits)
    return log_scales.astype(np.float32), logits.astype(np.float32)


def flattened(quats: np.ndarray, log_scales: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return quaternions [N, 4] and log-scales [N, 2] of ellipsoids [N, 3], with the thinnest axis as the normal.

    The axes are permuted cyclically, which keeps the rotation proper; of two equally thin axes the later is dropped. A
    warning about ellipsoids that are not flat names the file.
    """
    if len(log_scales):
        # In a file that rounds scales, all flat Gaussians have one third scale, its smallest; most are far wider.
        others = log_scales[:, :2]
        third = log_scales[:, 2]
        if third.min() == third.max() <= others.min() and third[0] < np.median(others) + np.log(0.1):
            return quats, others
    thinnest = 2 - np.argmin(log_scales[:, ::-1], axis=1)  # The last of equal ones.
    # Cyclic order keeps u × v = normal, so that the rotation needs no reflection.
    kept = np.take_along_axis(log_scales, (thinnest[:, None] + np.array([[1, 2]])) % 3, axis=1)
    dropped = np.take_along_axis(log_scales, thinnest[:, None], axis=1)[:, 0]
    # Files of `save_ply` have a third scale of 1 THICKNESS, which must not warn.
    num_thick = np.count_nonzero(dropped > kept.min(axis=1) + np.log(2 * THICKNESS))
    if num_thick:
        warn(f"{name}: holds 3D Gaussians (scale_2), {num_thick} of them not flat; their thinnest axis is dropped")
    # The product of quaternions: the turn of the axes first, then the splat's own rotation.
    w, x, y, z = quats.T
    a, b, c, d = AXES_TO_NORMAL[thinnest].T
    product = (
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    )
    return np.stack(product, axis=-1), kept


def warn_of_unread(names: Iterable[str], path: Path) -> None:
    """Warn of the attributes of a file's Gaussians that are not read, unless there are none; f_rest_* is read."""
    # Many names differ in a number only, and f_offset_9 comes before f_offset_10.
    by_stem: dict[str, list[str]] = collections.defaultdict(list)
    for name in sorted(names, key=lambda name: (len(name), name)):
        by_stem[name.rstrip(string.digits)].append(shortened(name))
    by_stem.pop("f_rest_", None)
    kinds = [alike[0] if len(alike) == 1 else f"{alike[0]} to {alike[-1]}" for alike in by_stem.values()]
    if kinds:
        warn(
            f"{path}: does not read {first_names(kinds)}; if the program that "
            "wrote the file draws by these attributes, its Gaussians look different here"
        )


def degree_to_read(degree: int, name: str) -> int:
    """Return the SH degree to read from a file, at most 3. Warn if the file's is higher."""
    if degree > MAX_DEGREE:
        warn(f"{name}: has SH of degree {degree}; degree {MAX_DEGREE} is read, and what is above it left out")
    return min(degree, MAX_DEGREE)


# Worlds


def upright(origin: Origin | Similarity | None, up: Up) -> Similarity:
    """Return the similarity from a model's world, given its origin or transform, to a file's with this axis up.

    The vertical is the one of `upright_turn`: −y of a model without cameras. With a transform alone, +z is up, as in
    the worlds of scenes.
    """
    if isinstance(origin, Similarity):
        return Similarity(1.0 / float(origin.scale), UPRIGHT[up], np.zeros(3))
    vertical = np.array([0.0, -1.0, 0.0])
    scale = 1.0
    if origin is not None:
        vertical = origin.transform.rotation @ _vertical_of_files(origin)
        scale = 1.0 / float(origin.transform.scale)
    turn = UPRIGHT[up] @ upright_rotation(np.array([0.0, 0.0, 1.0])).T @ upright_rotation(vertical)
    return Similarity(scale, turn, np.zeros(3))


def matrix_of(similarity: Similarity) -> np.ndarray:
    """Return a similarity as a matrix [4, 4] for columns."""
    matrix = np.eye(4)
    matrix[:3, :3] = similarity.scale * similarity.rotation
    matrix[:3, 3] = similarity.translation
    return matrix


def similarity_of(matrix: np.ndarray, what: str) -> Similarity:
    """Return a matrix [4, 4] for columns as a similarity. ValueError, naming it `what`: it mirrors, shears, or scales
    axes differently."""
    # Column norms of s·R are all s.
    scales = np.linalg.norm(matrix[:3, :3], axis=0)
    largest = float(scales.max())
    if not np.isfinite(matrix).all() or not 0 < largest < np.inf:
        raise ValueError(f"{what} must be finite, and must not scale by 0")
    if np.ptp(scales) > SAME_SCALE * largest or not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise ValueError(f"{what} scales its axes differently; apply it to the splats in another program first")
    rotation = matrix[:3, :3] / largest
    u, _, v = np.linalg.svd(rotation)  # u·v is the rotation nearest to a rounded one.
    check_similarity(Similarity(largest, rotation, matrix[:3, 3]), what)
    return Similarity(largest, u @ v, matrix[:3, 3])


def joined_parts(parts: Iterable[tuple[Model, np.ndarray]], up: Up) -> Model:
    """Return the parts of a file as one model in its own world, in which +z is up if its file does not say (host).

    A part that its file places where it was written does not change. Otherwise it moves together with its origin.
    Positions that float32 would round too far, as in map coordinates, are relative to an offset, which becomes the
    origin of a model without one.

    Args:
      parts: models as the file holds them, and the matrices from there to the world of the file.
      up: the axis that is up there.
    """
    models: list[Model] = []
    for model, matrix in parts:
        # A file may refer to one mesh from any number of nodes.
        if len(models) == MOST_PARTS:
            raise ValueError(f"holds more than {MOST_PARTS} sets of splats")
        world = similarity_of(matrix, "the transform of its splats")
        # All parts share a world, so that the first decides.
        if not models:
            placed, is_up_known = _placement(model.origin, world, up)
            offset = offset_after("ply", model.gaussians, _move_between(world, placed))
        move = _move_between(world, placed)
        if move is not UNMOVED or offset.any():
            model = model.transform(dataclasses.replace(move, translation=move.translation - offset))
        models.append(model)
    if not models:
        raise ValueError("holds no splats")
    if models[0].origin is None:
        origin = origin_at(offset)
        if not is_up_known:
            origin = dataclasses.replace(origin or Origin.of_cameras([]), up=np.array([0.0, 0.0, 1.0]))
        models[0] = dataclasses.replace(models[0], origin=origin)
    return models[0] if len(models) == 1 else concatenate(models)


def _placement(origin: Origin | None, world: Similarity, up: Up) -> tuple[Similarity, bool]:
    """Return the similarity by which a writer placed a model in a file's world, and whether it knew what is up."""
    placed = upright(origin, up)
    # In files of version 0.2 and of other programs, +z of the model is up.
    earlier = Similarity(placed.scale, UPRIGHT[up], np.zeros(3))
    is_up_known = origin is not None or _is_same(world, placed)
    return earlier if not is_up_known or _is_same(world, earlier) else placed, is_up_known


def _move_between(world: Similarity, placed: Similarity) -> Similarity:
    """Return the move of a model whose file has it at another place than its writer."""
    move = world.then(placed.inverse())
    # A file written here must come back with the same numbers: rounding in its matrix must not move it.
    if _is_same(move, UNMOVED):
        return UNMOVED
    check_similarity(move, "its transform")
    return move


def _is_same(one: Similarity, other: Similarity) -> bool:
    return np.allclose(matrix_of(one), matrix_of(other), rtol=0, atol=SAME_PLACE)


def origin_to_json(origin: Origin) -> dict[str, Any]:
    """Return an origin as lists of numbers and texts, without the corrections."""
    return origin_header(origin) | {name: array.tolist() for name, array in origin_arrays(origin).items()}


# Ranges and steps of numbers

SPZ_STEP = 2.0**-12  # 24-bit fixed point with 12 fractional bits.
SPZ_REACH = 2048 - SPZ_STEP
"""Largest coordinate of SPZ; larger ones wrap around."""
SOG_LEVELS = 2**16 - 1  # Positions have 16 bits an axis.
MOST_ROUNDING = 0.1
"""Largest rounding of a typical position by a format, in scales of its Gaussian, without a warning."""
MOST_SINGLE_ROUNDING = 0.01
"""Largest rounding of a typical position by float32, in scales of its Gaussian, that keeps the origin."""
SLACK = 1e-3
"""Share of a range by which numbers may exceed it without being counted."""


RANGES = {
    # SPZ: bytes of 0.15·c + 0.5 for degree 0, and of (log-scale + 10)·16.
    "SPZ": (0.5 / 0.15, 1.0, -10.0, 255 / 16 - 10),
    "compressed PLY": (math.inf, 4.0, -math.inf, math.inf),
    ".splat": (0.5 / SH_C0, math.inf, -math.inf, math.inf),
    ".ksplat": (0.5 / SH_C0, math.inf, -math.inf, math.inf),
}
"""Largest coefficients of degree 0 and above, smallest and largest log-scale of a format; others are clipped."""
OFFSET_PLACES = {
    "ply": "the comment 'offset' in the file says so; a2tg convert --float64 keeps world coordinates",
    "compressed.ply": "the comment 'offset' in the file says so",
    "sog": "'offset' in its meta.json says so",
}
"""Where a file has the offset of its positions, by the name of its format."""


def offset_after(kind: Kind, gaussians: Gaussians, move: Similarity) -> np.ndarray:
    """Return the offset of `offset_for` for Gaussians that a move takes to the original world."""
    means = move.apply(np.asarray(gaussians.means, np.float64))
    return offset_for(kind, means, np.asarray(gaussians.log_scales, np.float64) + np.log(move.scale))


def offset_for(kind: Kind, means: np.ndarray, log_scales: np.ndarray) -> np.ndarray:
    """Return whole numbers [3] to subtract from positions [N, 3] so that a format can hold them; zeros if it can.

    Positions are float64, and they and the log-scales [N, 2] are in the original world.
    """
    if not len(means):
        return np.zeros(3)

    def excess(positions: np.ndarray) -> float:
        """Return the rounding of a typical position as a multiple of the largest allowed."""
        single = np.abs(positions - positions.astype(np.float32)).max(axis=1)
        by_format = np.median(_rounding(kind, positions) / scales) / MOST_ROUNDING
        return float(max(np.median(single / scales) / MOST_SINGLE_ROUNDING, by_format))

    with np.errstate(all="ignore"):  # Numbers that are not finite fail the checks later.
        # Whole numbers are exact in float64 and short in text; the median ignores floaters.
        offset: np.ndarray = np.rint(np.median(means, axis=0)) + 0.0  # Not -0.0.
        scales = np.exp(np.asarray(log_scales, np.float64).mean(axis=1))
        before = excess(means)
        after = excess(means - offset)
        is_outside = kind == "spz" and bool(np.abs(means).max() > SPZ_REACH)
    # An offset must at least halve the rounding to be worth a moved origin.
    return offset if is_outside or (before > 1 and after < before / 2) else np.zeros(3)


def origin_at(offset: np.ndarray, turn: np.ndarray = UNMOVED.rotation) -> Origin | None:
    """Return the origin, without cameras, of a model in the world of a file: turned from the original one by a
    rotation [3, 3], and then relative to an offset [3]. None if it is the original one. ValueError: the offset is not
    finite or too large."""
    if not offset.any() and np.array_equal(turn, np.eye(3)):
        return None
    origin = Origin.of_cameras([], transform=Similarity(1.0, turn, -offset))
    check_origin(origin)
    return origin


def warn_of_offset(kind: Kind, offset: np.ndarray, path: Path | str) -> None:
    """Warn that the positions of a file are relative to an offset [3], unless it is zero."""
    if offset.any():
        place = OFFSET_PLACES.get(kind, "the file has no place for this: write it down")
        warn(
            f"{path}: positions are relative to ({', '.join(number_words(offset))}), because the format "
            f"would round such large coordinates too far; {place}"
        )


def number_words(numbers: np.ndarray) -> list[str]:
    """Return numbers as text that reads back to the same float64."""
    return [repr(float(value)).removesuffix(".0") for value in numbers]


def check_positions(kind: Kind, gaussians: Gaussians, path: Path) -> None:
    """Raise ValueError if a format cannot hold the positions of one or more Gaussians; warn if it rounds them too far.

    Messages name the file.
    """
    means = np.asarray(gaussians.means, np.float64)
    farthest = np.abs(means).max()
    if kind == "spz" and farthest > SPZ_REACH:
        raise ValueError(
            f"{path}: SPZ holds positions up to {SPZ_REACH:.0f} units from the origin, but one is {farthest:,.0f} "
            "units away; write *.ply or *.sog, or scale the scene"
        )
    scales = np.exp(np.asarray(gaussians.log_scales, np.float64).mean(axis=1))
    rounding = float(np.median(_rounding(kind, means) / scales))
    if rounding > MOST_ROUNDING:
        advice = "write *.ply or *.sog, or enlarge the scene" if kind == "spz" else "write *.ply"
        warn(f"{path}: positions are rounded by {rounding:.2g} times the scale of a typical Gaussian; {advice}")


def _rounding(kind: Kind, means: np.ndarray) -> np.ndarray:
    """Return the largest rounding [N] by the format of the coordinates of each position."""
    if kind == "spz":
        return np.full(len(means), SPZ_STEP / 2)
    if kind != "sog":
        return np.zeros(len(means))
    # SOG keeps sign(x)·ln(1 + |x|), in even steps or as float32, whichever is coarser; its slope is 1 / (1 + |x|).
    logarithms = np.sign(means) * np.log1p(np.abs(means))
    step = np.ptp(logarithms, axis=0) / SOG_LEVELS
    single = np.spacing(np.abs(logarithms).astype(np.float32))
    return ((1 + np.abs(means)) * np.maximum(step, single) / 2).max(axis=1)


def cut_numbers(name: str, model: Model) -> list[str]:
    """Describe how many Gaussians have colours or scales that a format, by its name, clips."""
    if name not in RANGES:
        return []
    gaussians = world_gaussians(model).gaussians
    first, rest, low, high = RANGES[name]
    sizes = np.abs(np.asarray(gaussians.sh))
    # It has no higher degrees to cut.
    if name == ".splat":
        sizes = sizes[:, :1]
    largest = np.where(np.arange(sizes.shape[1]) == 0, first, rest)[:, None] * (1 + SLACK)
    log_scales = np.asarray(gaussians.log_scales)
    cut = {
        "colours": np.any(sizes > largest, axis=(1, 2)),
        "scales": np.any((log_scales < low - SLACK) | (log_scales > high + SLACK), axis=1),
    }
    return [
        f"{what} of {counted(int(rows.sum()), 'Gaussian')} beyond the format's range (cut)"
        for what, rows in cut.items()
        if rows.any()
    ]
