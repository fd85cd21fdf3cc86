"""Checks that a file holds a valid model: shapes, dtypes, ranges, finite numbers. On the host, with numpy.

Native loops rely on the layout of their arrays, so all loaded models and checkpoints pass these checks first.
"""

import contextlib
import math
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from a2tg_jax.appearance.base import check_appearance
from a2tg_jax.core.cameras import MAX_SKEW, check_calibration
from a2tg_jax.core.checks import LARGEST_NUMBER, check_floats, check_shape, dtype_of
from a2tg_jax.core.gaussians import check_gaussians
from a2tg_jax.core.origin import Origin
from a2tg_jax.core.similarity import check_similarity
from a2tg_jax.host.regular_files import MOST_ARRAY_BYTES, is_regular, read_regular
from a2tg_jax.host.text import shortened
from a2tg_jax.model import Model, check_is_model

LARGEST_LOG_SCALE = math.log(LARGEST_NUMBER)
LARGEST_FLOAT = float(np.finfo(np.float32).max)
LONGEST_REASON = 500
"""Largest number of characters of an error that quotes a file."""
FUNCTIONS = {
    ".npz": "model", ".a2tgz": "compact", ".ply": "ply", ".glb": "gltf", ".gltf": "gltf",
    ".usdz": "usd", ".usdc": "usd", ".usda": "usd", ".usd": "usd",
}  # fmt: skip
"""Names of public functions, without save_ and load_, by file suffix."""


def check_suffix(path: str | os.PathLike[str], function: str) -> None:
    """Raise ValueError if a file has the suffix of another format than the function's, such as "save_ply"."""
    verb, _, format = function.partition("_")
    format_of_suffix = FUNCTIONS.get(Path(path).suffix.lower(), format)
    if format_of_suffix != format:
        suffix = next(suffix for suffix, name in FUNCTIONS.items() if name == format)
        does = "writes" if verb == "save" else "reads"
        raise ValueError(
            f"{shortened(os.fspath(path))}: {function} {does} *{suffix} files; call {verb}_{format_of_suffix} instead"
        )


def live_model(path: str | os.PathLike[str], model: Model, function: str) -> Model:
    """Return the live rows of a model for a function such as "save_gltf". ValueError: the suffix is of another format,
    or the model is invalid."""
    check_suffix(path, function)
    check_is_model(model)
    check_gaussians(model.gaussians, "model.gaussians")
    model = model.live
    check_model(model)
    return model


def check_exists(path: str | os.PathLike[str], what: str) -> None:
    """Raise FileNotFoundError, calling it `what`, unless there is a regular file."""
    if not is_regular(path):
        raise FileNotFoundError(f"{os.fspath(path)}: no such {what}")


def existing_bytes(path: str | os.PathLike[str], what: str) -> bytes:
    """Return the bytes of a regular file. FileNotFoundError, calling it `what`: there is none."""
    check_exists(path, what)
    return read_regular(path, MOST_ARRAY_BYTES)


def numbers_of(values: object, count: int | None, name: str, *, null: float | None = None) -> np.ndarray:
    """Return a list of numbers in JSON as float64 [n].

    Args:
      values: the list.
      count: its length; None: at least 1.
      name: what errors call it.
      null: the number that null stands for; None: null is an error.

    Raises:
      ValueError: if it is anything else, or a number is beyond the range of float32.
    """

    def is_number(value: object) -> bool:
        if value is None:
            return null is not None
        # Not isinstance, because JSON's true is an int in Python.
        return type(value) in (int, float) and abs(value) <= LARGEST_FLOAT  # type: ignore[arg-type]

    if (
        not isinstance(values, list)
        or count not in (None, len(values))
        or not values
        or not all(map(is_number, values))
    ):
        wanted = f"{count or 'a list of'} finite numbers{'' if null is None else ' or null'}"
        raise ValueError(f"{name} must be {wanted}; got {shortened(values)}")
    return np.array([null if value is None else value for value in values], np.float64)


@contextlib.contextmanager
def reading(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn errors about a file's content into one ValueError that names it."""
    where = os.fspath(path)
    try:
        yield
    except KeyError as error:
        raise ValueError(f"{where}: lacks {shortened(str(error))}; it is damaged or of another version") from error
    # What JSON of another shape than expected raises on access.
    except (TypeError, IndexError, AttributeError, OverflowError, RecursionError) as error:
        raise ValueError(f"{where}: is damaged or of another version ({shortened(repr(error))})") from error
    except ValueError as error:
        reason = shortened(str(error), LONGEST_REASON)
        # Inner readers may have named the file already.
        raise ValueError(reason if reason.startswith(where) else f"{where}: {reason}") from error


def check_model(model: Model) -> None:
    """Raise ValueError, naming the field, unless a model can be rendered and trained.

    All fields have their shapes and one dtype, all numbers are finite, the appearance has a row for each Gaussian, and
    rows of textures and coefficients are within their tables.
    """
    gaussians = model.gaussians
    check_gaussians(gaussians)
    check_appearance(model.appearance, gaussians)
    check_bounded("gaussians", gaussians)
    check_bounded("appearance", model.appearance)
    if not (np.abs(model.background) <= LARGEST_NUMBER).all():  # False for NaN.
        raise ValueError(f"background must be finite, within ±{LARGEST_NUMBER:g}; got {model.background}")
    largest = np.asarray(gaussians.log_scales).max(initial=-np.inf)
    if largest > LARGEST_LOG_SCALE:
        raise ValueError(
            f"gaussians.log_scales must be logarithms of finite scales, up to {LARGEST_LOG_SCALE:.2f}, of scales up to "
            f"{LARGEST_NUMBER:g}; got {largest:g}"
        )
    if model.num_live is not None:
        check_count("num_live", model.num_live, gaussians.num)
    if model.origin is not None:
        check_origin(model.origin)


def check_origin(origin: Origin) -> None:
    """Raise ValueError, naming the field, unless the cameras and the transform of an origin are valid."""
    cameras = zip(origin.names, origin.viewmats, origin.Ks, origin.sizes.tolist(), strict=True)
    for name, viewmat, K, (width, height) in cameras:
        check_calibration(viewmat, K, width, height, f"origin, camera {shortened(name)}")
    check_similarity(origin.transform, "origin.transform")
    if origin.up is not None:
        check_shape("origin.up", origin.up, (3,))
        if not abs(np.linalg.norm(origin.up) - 1) < MAX_SKEW:
            raise ValueError(f"origin.up must have unit length; got {np.asarray(origin.up).tolist()}")
    for name, rows in origin.corrections.items():
        check_floats(f"origin.corrections.{name}", rows, (len(origin.names), *np.shape(rows)[1:]))
        check_bounded(f"origin.corrections.{name}", rows)


def check_finite(name: str, tree: object, *, is_signed: bool = True) -> None:
    """Raise ValueError, naming the leaf, if a float of a pytree is NaN or infinite or, unsigned, NaN or negative."""
    for leaf, values in _float_rows(name, tree):
        # `values >= 0` is False for NaN.
        is_good: np.ndarray = np.all(np.isfinite(values) if is_signed else values >= 0, axis=1)
        if not is_good.all():
            wanted = "finite" if is_signed else "at least 0"
            unwanted = "NaN or infinite" if is_signed else "negative or NaN"
            bad = np.flatnonzero(~is_good)
            raise ValueError(
                f"{leaf} must be {wanted}; {len(bad):,} of {len(is_good):,} rows have {unwanted} numbers, the first is "
                f"row {bad[0]:,} (from 0)"
            )


def check_bounded(name: str, tree: object) -> None:
    """Raise ValueError, naming the leaf and the number, if a float is not finite or too large."""
    check_finite(name, tree)
    for leaf, values in _float_rows(name, tree):
        is_large = np.abs(values) > LARGEST_NUMBER
        if is_large.any():
            row, column = np.argwhere(is_large)[0]
            raise ValueError(
                f"{leaf} must be within ±{LARGEST_NUMBER:g}; got {values[row, column]:g} in row {row:,} (from 0)"
            )


def _float_rows(name: str, tree: object) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the name and the numbers [N, C] of each leaf of floats; a scalar is one row."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        values = np.atleast_1d(np.asarray(leaf))
        if np.issubdtype(values.dtype, np.floating):
            yield f"{name}{jax.tree_util.keystr(path)}", values.reshape(len(values), math.prod(values.shape[1:]))


def check_count(name: str, value: object, most: int) -> None:
    """Raise ValueError unless a value is one integer in 0..most."""
    number = np.asarray(value)
    if number.shape or number.dtype.kind not in "iu" or not 0 <= int(number) <= most:
        raise ValueError(f"{name} must be a whole number in 0..{most}; got {shortened(repr(value))}")


def check_like(name: str, tree: object, wanted: object) -> None:
    """Raise ValueError, naming the leaf, unless two pytrees of the same structure have equal shapes and dtypes."""
    pairs: Iterable[Any] = zip(jax.tree_util.tree_leaves_with_path(tree), jax.tree.leaves(wanted), strict=True)
    for (path, leaf), like in pairs:
        label = f"{name}{jax.tree_util.keystr(path)}"
        check_shape(label, leaf, tuple(like.shape))
        if dtype_of(leaf) != like.dtype:
            raise ValueError(f"{label} must be {like.dtype}; got {dtype_of(leaf)}")
