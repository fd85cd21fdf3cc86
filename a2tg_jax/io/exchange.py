"""Models as files of other programs hold them: activated numbers of ellipsoids, and a world that stands upright.

A model's own world has +z up, and lengths in which its cameras are 1 away. A file's world has the lengths of the
original one, and the up axis that its format asks for; the model lies where it does in its own.
"""

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np

from a2tg_jax.core.gaussians import LARGEST_OPACITY, Gaussians
from a2tg_jax.core.origin import Origin
from a2tg_jax.core.sh import NUM_BASES
from a2tg_jax.core.similarity import Similarity, check_similarity
from a2tg_jax.host.text import shortened
from a2tg_jax.io.flattening import flattened, third_log_scales, whole_rows
from a2tg_jax.io.model_file import LONGEST_REASON, origin_arrays, origin_of, origin_to_dict
from a2tg_jax.io.number_ranges import offset_for, origin_at
from a2tg_jax.io.ply import LEAST_OPACITY, plain_gaussians
from a2tg_jax.model import Model, concatenate

Up = Literal["y", "z"]
UPRIGHT: Mapping[Up, np.ndarray] = {
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "z": np.eye(3),
}
"""Rotation from a world of +z up to one of another axis."""
LEAST_SCALE = 1e-30
SAME_PLACE = 1e-5
"""Largest difference of the numbers of two similarities that are taken for one."""
SAME_SCALE = 1e-3
"""Largest difference of the scales of the axes of a transform, relative to the largest."""
ORIGIN_KINDS = {"sizes": np.int64, "is_test": bool}
Result = TypeVar("Result")


class Ellipsoids(NamedTuple):
    """N ellipsoids as a renderer wants them; float32 on the host."""

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


def splats_of(model: Model, *, keeps_shapes: bool = False) -> Ellipsoids:
    """Return the splats of a model of which all rows exist, with a third axis of a thousandth of the shorter.

    If splats have degrees of their own, coefficients go up to the highest of these. `keeps_shapes` is as in
    `plain_gaussians`.
    """
    gaussians = plain_gaussians(model, keeps_shapes=keeps_shapes)
    quats = np.asarray(gaussians.quats, np.float64)
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    units = np.where(norms > 0, quats / np.maximum(norms, LEAST_SCALE), [1.0, 0.0, 0.0, 0.0])
    logits = np.clip(np.asarray(gaussians.logit_opacities, np.float64), -80, 80)
    log_scales = np.asarray(gaussians.log_scales, np.float64)
    scales = np.exp(np.concatenate([log_scales, third_log_scales(log_scales)], axis=1))
    sh = gaussians.sh[:, : NUM_BASES[model.degrees.max(initial=0)]]
    numbers = (gaussians.means, units, scales, 1 / (1 + np.exp(-logits)), sh)
    return Ellipsoids(*(np.asarray(values, np.float32) for values in numbers))


def whole_splats(splats: Ellipsoids, path: str | os.PathLike[str]) -> Ellipsoids:
    """Return the splats whose numbers are finite; the others are counted in a warning that names the file."""
    kept = whole_rows(os.fspath(path), splats.scales, splats.means, splats.quats, splats.opacities, splats.sh)
    return Ellipsoids(*(values[kept] for values in splats))


def gaussians_of(splats: Ellipsoids, path: str | os.PathLike[str], *, is_flat: bool) -> Gaussians:
    """Return the Gaussians of splats.

    Args:
      splats: the splats.
      path: their file, for the warning if some are not flat.
      is_flat: the third axis is the normal; else the thinnest is.
    """
    with np.errstate(invalid="ignore"):
        log_scales = np.log(np.maximum(splats.scales, LEAST_SCALE))
    quats, log_scales = (
        (splats.quats, log_scales[:, :2]) if is_flat else flattened(splats.quats, log_scales, os.fspath(path))
    )
    opacities = np.clip(splats.opacities.astype(np.float64), LEAST_OPACITY, LARGEST_OPACITY)
    logits = np.log(opacities) - np.log1p(-opacities)
    numbers = (splats.means, quats, log_scales, logits, splats.sh)
    return Gaussians(*(jnp.asarray(values, jnp.float32) for values in numbers))


def linear_colors(colors: np.ndarray) -> np.ndarray:
    """Return linear colours of sRGB colours in [0, 1]."""
    return np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)


# Worlds


def upright(origin: Origin | None, up: Up) -> Similarity:
    """Return the similarity from a model's world to that of a file with this axis up."""
    return upright_from(1.0 if origin is None else float(origin.transform.scale), up)


def upright_from(scale: float, up: Up) -> Similarity:
    """Return the same, given the factor of lengths from the original world to the model's."""
    return Similarity(1.0 / scale, UPRIGHT[up], np.zeros(3))


def matrix_of(similarity: Similarity) -> np.ndarray:
    """Return a similarity as a matrix [4, 4] for columns."""
    matrix = np.eye(4)
    matrix[:3, :3] = similarity.scale * similarity.rotation
    matrix[:3, 3] = similarity.translation
    return matrix


def similarity_of(matrix: np.ndarray, what: str) -> Similarity:
    """Return the similarity that a matrix [4, 4] for columns is.

    Raises:
      ValueError: naming it `what`, if it mirrors, shears, or scales axes differently.
    """
    scales = np.linalg.norm(matrix[:3, :3], axis=0)
    largest = float(scales.max())
    if not np.isfinite(matrix).all() or not 0 < largest < np.inf:
        raise ValueError(f"{what} must be finite, and must not scale by 0")
    if np.ptp(scales) > SAME_SCALE * largest or not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise ValueError(f"{what} scales its axes differently; apply it to the splats in another program first")
    rotation = matrix[:3, :3] / largest
    u, _, v = np.linalg.svd(rotation)
    check_similarity(Similarity(largest, rotation, matrix[:3, 3]), what)
    return Similarity(largest, u @ v, matrix[:3, 3])


def joined_parts(parts: Sequence[tuple[Model, Similarity]], up: Up) -> Model:
    """Return the parts of a file as one model in its own world, which has +z up (host).

    A part stays as it is where its file places it as it was written. Else it moves, and its origin along. Positions
    that float32 would round too far there, as in map coordinates, are relative to an offset, which the origin of a
    model without one then has.

    Args:
      parts: at least one model as the file holds it, and the similarity from there to the world of the file.
      up: the axis that is up there.
    """
    origin, offset, models = None, None, list[Model]()
    for model, world in parts:
        origin = origin or model.origin
        move = world.then(upright(origin, up).inverse())
        if is_same := np.allclose(matrix_of(move), np.eye(4), rtol=0, atol=SAME_PLACE):
            move = Similarity(1.0, np.eye(3), np.zeros(3))
        check_similarity(move, "its transform")
        if offset is None:
            means, log_scales = np.asarray(model.gaussians.means, np.float64), np.asarray(model.gaussians.log_scales)
            offset = offset_for("ply", move.apply(means), log_scales + np.log(move.scale))
        if offset.any():
            move = dataclasses.replace(move, translation=move.translation - offset)
        models.append(model if is_same and not offset.any() else model.transform(move))
    if offset is not None and models[0].origin is None:
        models[0] = dataclasses.replace(models[0], origin=origin_at(offset))
    return models[0] if len(models) == 1 else concatenate(models)


# Origins as text


def origin_to_json(origin: Origin) -> dict[str, Any]:
    """Return an origin as lists of numbers and texts, without the corrections."""
    return origin_to_dict(origin) | {name: array.tolist() for name, array in origin_arrays(origin).items()}


def origin_from_json(data: Mapping[str, Any]) -> Origin:
    """Return the origin that `origin_to_json` was given. ValueError: it is damaged."""
    shapes = {"viewmats": (-1, 4, 4), "Ks": (-1, 3, 3), "sizes": (-1, 2)}
    arrays = {}
    for name in ("viewmats", "Ks", "sizes", "is_test", "scale", "rotation", "translation"):
        kind = ORIGIN_KINDS.get(name, np.float64)
        array = np.asarray(data[name])
        if array.dtype.kind not in "biuf" or (array.size and np.dtype(kind).kind == "b" != array.dtype.kind):
            raise ValueError(f"origin/{name} must be numbers; got {shortened(data[name])}")
        arrays[name] = array.astype(kind).reshape(shapes.get(name, array.shape))
    return origin_of(data, arrays)


# Errors


def reading(path: str | os.PathLike[str], read: Callable[[], Result]) -> Result:
    """Return what `read` returns. Errors in what a file says become one ValueError that names it."""
    where = os.fspath(path)
    try:
        return read()
    except (KeyError, TypeError, IndexError, AttributeError, OverflowError, RecursionError) as error:
        raise ValueError(f"{where}: is damaged or of another version ({shortened(repr(error))})") from error
    except ValueError as error:
        raise ValueError(f"{where}: {shortened(str(error).removeprefix(f'{where}: '), LONGEST_REASON)}") from error
