"""Suffixes of files, and the public functions that read and write them."""

import os
from pathlib import Path

from a2tg_jax.base.regular_files import expanded
from a2tg_jax.base.text import shortened

FUNCTIONS = {
    ".npz": "model", ".a2tgz": "compact", ".ply": "ply", ".glb": "gltf", ".gltf": "gltf",
    ".usdz": "usd", ".usdc": "usd", ".usda": "usd", ".usd": "usd",
}  # fmt: skip
"""Names of public functions, without save_ and load_, by file suffix."""


def checked_path(path: str | os.PathLike[str], function: str) -> Path:
    """Return a path of the user (`expanded`). ValueError: it has the suffix of another format than the function's, such
    as "save_ply"."""
    path = expanded(path)
    verb, _, format = function.partition("_")
    format_of_suffix = FUNCTIONS.get(path.suffix.lower(), format)
    if format_of_suffix != format:
        suffix = next(suffix for suffix, name in FUNCTIONS.items() if name == format)
        does = "writes" if verb == "save" else "reads"
        raise ValueError(
            f"{shortened(str(path))}: {function} {does} *{suffix} files; call {verb}_{format_of_suffix} instead"
        )
    return path
