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
LONGEST_REASON = 500
"""Largest number of characters of an error that quotes a file."""
FUNCTIONS = {
    ".npz": "model", ".a2tgz": "compact", ".ply": "ply", ".glb": "gltf", ".gltf": "gltf",
    ".usdz": "usd", ".usdc": "usd", ".usda": "usd", ".usd": "usd",
}  # fmt: skip
"""Names of public functions, without save_ and load_, by file suffix."""


def check_suffix(path: str | os.PathLike[str], function: str) -> None:
    """Raise ValueError if a file has the suffix of another format than the function's, such as "save_ply"."""
    verb, _, own = function.partition("_")
    found = FUNCTIONS.get(Path(path).suffix.lower(), own)
    if found != own:
        suffix = next(suffix for suffix, name in FUNCTIONS.items() if name == own)
        does = "writes" if verb == "save" else "reads"
        raise ValueError(
            f"{shortened(os.fspath(path))}: {function} {does} *{suffix} files; call {verb}_{found} instead"
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


def existing_bytes(path: str | os.PathLike[str], what: str) -> bytes:
    """Return the bytes of a regular file. FileNotFoundError, calling it `what`: there is none."""
    if not is_regular(path):
        raise FileNotFoundError(f"{os.fspath(path)}: no such {what}")
    return read_regular(path, MOST_ARRAY_BYTES)


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
    if (largest := np.asarray(gaussians.log_scales).max(initial=-np.inf)) > LARGEST_LOG_SCALE:
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
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        values = np.asarray(leaf)
        if not np.issubdtype(values.dtype, np.floating):
            continue
        # `values >= 0` is False for NaN.
        is_good = np.atleast_1d(np.isfinite(values) if is_signed else values >= 0)
        if not is_good.all():
            wanted, found = ("finite", "NaN or infinite") if is_signed else ("at least 0", "negative or NaN")
            bad = np.flatnonzero(~is_good.all(axis=tuple(range(1, is_good.ndim))))
            raise ValueError(
                f"{name}{jax.tree_util.keystr(path)} must be {wanted}; {len(bad):,} of {len(is_good):,} rows have "
                f"{found} numbers, the first is row {bad[0]:,} (from 0)"
            )


def check_bounded(name: str, tree: object) -> None:
    """Raise ValueError, naming the leaf and the number, if a float is not finite or too large."""
    check_finite(name, tree)
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        values = np.asarray(leaf)
        if not np.issubdtype(values.dtype, np.floating):
            continue
        # Scalars count as one row.
        is_large = np.atleast_1d(np.abs(values) > LARGEST_NUMBER)
        if is_large.any():
            row = np.flatnonzero(is_large.any(axis=tuple(range(1, is_large.ndim))))[0]
            raise ValueError(
                f"{name}{jax.tree_util.keystr(path)} must be within ±{LARGEST_NUMBER:g}; got "
                f"{np.atleast_1d(values)[is_large][0]:g} in row {row:,} (from 0)"
            )


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
