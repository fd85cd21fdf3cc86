"""Files of other programs' splats by the library gaussforge: SPZ, SOG, compressed PLY and .splat.

They pass through a PLY file in memory. Rows are written in the order of a Z curve, and all with one third scale, the
smallest: formats that round scales by a table then spend one entry on it. What a format can say of flat splats is added
to its file.

gaussforge 0.6 writes the spherical harmonics of compressed PLY in another order than it reads them. Here they have the
order that SuperSplat reads. Its .ksplat files are empty for GaussianSplats3D; `ksplat.py` writes and reads those.
"""

import contextlib
import dataclasses
import importlib
import io
import json
import os
import zipfile
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.data.ply import OFFSET
from a2tg_jax.host.atomic import replacing
from a2tg_jax.host.text import shortened
from a2tg_jax.io.columns import morton
from a2tg_jax.io.other_programs import check_positions, origin_at, third_log_scales, warn_of_offset, world_gaussians
from a2tg_jax.io.ply import FLAT_MARK, decode_ply, encode_ply, offset_comment
from a2tg_jax.io.validate import existing_bytes, reading
from a2tg_jax.model import Model

KINDS = ("compressed.ply", "spz", "sog", "splat")
"""gaussforge's names of formats, which are the suffixes."""
LEAST_LOG_SCALE = -20.0
CURVE_BITS = 16
SOG_HEADER, SOG_FLAT = "meta.json", "2dgs"
MOST_HEADER_BYTES = 1 << 24


def save_by_gaussforge(path: str | os.PathLike[str], model: Gaussians | Model) -> None:
    """Write the Gaussians of a model, in its original world, in the format of the suffix.

    Positions that the format would round too far are relative to whole numbers, which a warning says, and compressed
    PLY and SOG too. If it rounds them by a tenth of a typical scale even so, another warning says this.

    Raises:
      ValueError: if gaussforge is not installed or cannot write them, there are none, or the format cannot hold their
        positions.
    """
    kind = _kind_of(path)
    gaussians, offset, _ = world_gaussians(model, kind=kind)
    if not gaussians.num:
        raise ValueError(f"{path}: the model has no Gaussians; a file of this format has at least one")
    check_positions(kind, gaussians, str(path))
    # In the order of a Z curve through the means.
    means = np.asarray(gaussians.means, np.float64)
    low, high = means.min(axis=0, initial=0.0), means.max(axis=0, initial=0.0)
    codes = ((means - low) / np.maximum(high - low, 1e-30) * (2**CURVE_BITS - 1)).astype(np.int64)
    gaussians = gaussians[np.argsort(morton(codes.T, CURVE_BITS), kind="stable")]
    third = third_log_scales(np.asarray(gaussians.log_scales)).min(axis=0, keepdims=True, initial=0.0)
    if kind == "compressed.ply":
        # gaussforge takes the order channel by channel of SH above degree 0 for the order coefficient by coefficient.
        sh = np.asarray(gaussians.sh)
        rest = sh[:, 1:].transpose(0, 2, 1).reshape(gaussians.num, sh.shape[1] - 1, 3)
        gaussians = dataclasses.replace(gaussians, sh=jnp.asarray(np.concatenate([sh[:, :1], rest], axis=1)))
    ply = encode_ply(gaussians, np.repeat(third.clip(LEAST_LOG_SCALE), gaussians.num, axis=0))
    data = _marked(_converted(ply, "ply", kind, Path(path)), kind, offset)
    with replacing(path) as temporary:
        temporary.write_bytes(data)
    warn_of_offset(kind, offset, path)


def load_by_gaussforge(path: str | os.PathLike[str]) -> Model:
    """Read Gaussians from a file, in its world. Ellipsoids are flattened as `load_ply` does, with a warning.

    If positions of a SOG file are relative to an offset, the model's origin has this.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if gaussforge is not installed or cannot read the file, or a number is not finite.
    """
    kind, path, data = _kind_of(path), Path(path), existing_bytes(path, "file")
    header: dict[str, Any] = {}
    if kind == "sog":
        with (
            contextlib.suppress(zipfile.BadZipFile, KeyError, ValueError, OSError, NotImplementedError, RuntimeError),
            zipfile.ZipFile(io.BytesIO(data)) as archive,
            archive.open(SOG_HEADER) as entry,
        ):
            found = json.loads(entry.read(MOST_HEADER_BYTES))
            header = found if isinstance(found, dict) else {}
    converted = _converted(data, kind, "ply", path)
    gaussians = decode_ply(io.BytesIO(converted), path, is_flat=header.get("model") == SOG_FLAT).gaussians
    with reading(path):
        origin = origin_at(np.array(header.get(OFFSET, (0, 0, 0)), np.float64).reshape(3))
    return Model(gaussians, origin=origin)


def import_gaussforge(path: Path) -> Any:
    """Return the library for a file.

    Raises:
      ValueError: if it is not installed.
    """
    try:
        return importlib.import_module("gaussforge")
    except ImportError as error:
        raise ValueError(f"{path}: needs gaussforge: pip install 'a2tg-jax[formats]'") from error


def _kind_of(path: str | os.PathLike[str]) -> str:
    """Return gaussforge's name of the format of a file."""
    return next(kind for kind in KINDS if Path(path).name.lower().endswith(f".{kind}"))


def _converted(data: bytes, before: str, after: str, path: Path) -> bytes:
    """Return the bytes of one format as another's."""
    result = import_gaussforge(path).GaussForge().convert(data, before, after)
    converted: bytes = result.get("data", b"")
    if not converted:
        reason = shortened(str(result.get("error", "no splats in it")), 200)
        raise ValueError(f"{path}: gaussforge says: {reason}; the file is damaged, or of another format")
    return converted


def _marked(data: bytes, kind: str, offset: np.ndarray) -> bytes:
    """Return a file that says that its splats are flat, and what they are relative to, if its format can."""
    if kind == "compressed.ply":
        return data.replace(b" 1.0\n", f" 1.0\ncomment {FLAT_MARK}\n{offset_comment(offset)}".encode(), 1)
    if kind != "sog":
        return data
    marked = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(marked, "w") as new:
        for entry in old.infolist():
            content = old.read(entry)
            if entry.filename == SOG_HEADER:
                header = {**json.loads(content), "model": SOG_FLAT}
                header |= {OFFSET: offset.tolist()} if offset.any() else {}
                content = json.dumps(header, separators=(",", ":")).encode()
            new.writestr(zipfile.ZipInfo(entry.filename), content)
    return marked.getvalue()
