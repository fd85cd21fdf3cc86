"""Trained models: Gaussians and their textures in one archive, without padding."""

import dataclasses
import os
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from a2tg_jax.gaussians import Gaussians
from a2tg_jax.io.archive import read_archive, write_archive
from a2tg_jax.texture import AtlasLayout, Textures, texture_arrays, textures_from_arrays

FORMAT = "a2tg-jax model"
FIELDS = tuple(field.name for field in dataclasses.fields(Gaussians))


@dataclasses.dataclass(frozen=True)
class Model:
    """What a training stage leaves behind, live Gaussians only, in the normalised world."""

    gaussians: Gaussians
    """N Gaussians."""
    textures: Textures | None = None
    """Their textures; None for plain 2D Gaussians."""
    layout: AtlasLayout | None = None
    """Where the texture of each Gaussian lies; None exactly where `textures` is."""


def save_model(path: str | os.PathLike, model: Model, header: Mapping[str, Any] | None = None) -> None:
    """Writes a model: the five arrays of the Gaussians, and, if textured, `sizes` [N, 2] and `texels` [M, 4].

    `texels` holds the textures one after the other, each row by row. `header` is kept along (JSON-able values).
    """
    arrays = {name: np.asarray(getattr(model.gaussians, name)) for name in FIELDS}
    if model.textures is not None and model.layout is not None:
        texels = [array.reshape(-1, 4) for array in texture_arrays(model.textures, model.layout)]
        arrays |= {"sizes": model.layout.sizes, "texels": np.concatenate(texels)}
    write_archive(path, header or {}, arrays, format=FORMAT)


def load_model(path: str | os.PathLike) -> Model:
    """The model that `save_model` wrote.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if it is not a model, is damaged, or is of another version.
    """
    _, arrays = read_archive(path, format=FORMAT)
    missing = [name for name in FIELDS if name not in arrays]
    if missing or ("sizes" in arrays) != ("texels" in arrays):
        raise ValueError(f"{path}: lacks the array {', '.join(missing) or 'sizes or texels'}")
    gaussians = Gaussians(**{name: jnp.asarray(arrays[name]) for name in FIELDS})
    if "sizes" not in arrays:
        return Model(gaussians)
    sizes = arrays["sizes"]
    pieces = np.split(arrays["texels"], np.cumsum(sizes.prod(axis=1))[:-1])
    textures, layout = textures_from_arrays(
        [piece.reshape(*size, 4) for piece, size in zip(pieces, sizes, strict=True)]
    )
    return Model(gaussians, textures, layout)
