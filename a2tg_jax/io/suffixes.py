"""Suffixes of the files of models, and the functions that write and read them."""

import os
from pathlib import Path

from a2tg_jax.host.text import shortened
from a2tg_jax.model import check_is_model

FORMATS = {
    ".npz": "model", ".a2tgz": "compact", ".ply": "ply", ".glb": "gltf", ".gltf": "gltf",
    ".usdz": "usd", ".usdc": "usd", ".usda": "usd", ".usd": "usd",
}  # fmt: skip
"""Formats by suffix; `save_` and `load_` stand before the names of their functions."""


def check_suffix(path: str | os.PathLike[str], function: str) -> None:
    """Raise ValueError if a file has the suffix of another format than the function's, such as "save_ply"."""
    verb, _, own = function.partition("_")
    found = FORMATS.get(Path(path).suffix.lower(), own)
    if found != own:
        suffix = next(suffix for suffix, name in FORMATS.items() if name == own)
        does = "writes" if verb == "save" else "reads"
        raise ValueError(
            f"{shortened(os.fspath(path))}: {function} {does} *{suffix} files; call {verb}_{found} instead"
        )


def check_saved(path: str | os.PathLike[str], model: object, function: str) -> None:
    """Raise ValueError unless a value is a model, and the suffix is not that of another format."""
    check_suffix(path, function)
    check_is_model(model)
