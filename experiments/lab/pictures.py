"""Models changed so that a render shows the effect of textures and the places of large ones."""

import dataclasses

import numpy as np

import a2tg_jax as a2tg
from a2tg_jax.core.gaussians import SH_C0
from a2tg_jax.results.figures import with_flat_colors

SQUARE, OBLONG = (0.15, 0.35, 0.95), (0.9, 0.12, 0.1)
"""The paper's colours: blue for textures of 2×2 and 4×4 texels, red for those that are not square."""


def enlarged(image: np.ndarray, zoom: int) -> np.ndarray:
    """Return an image with each pixel repeated zoom × zoom times."""
    return np.repeat(np.repeat(image, zoom, axis=0), zoom, axis=1)


def without_textures(model: a2tg.Model) -> a2tg.Model:
    """Return the model with RGB textures 0 and alpha textures 1, which shows spherical harmonics only."""
    assert model.textures is not None
    return model.with_textures(a2tg.allocate_textures(model.textures.sizes))


def without_sh(model: a2tg.Model) -> a2tg.Model:
    """Return the model with the Gaussians' own colour 0, which shows textures only."""
    return with_flat_colors(model, np.ones(model.gaussians.num, bool), np.full(3, -0.5 / SH_C0))


def colored_by_shape(model: a2tg.Model) -> a2tg.Model:
    """Return the model with larger square textures in blue, others in red, the rest as they are."""
    assert model.textures is not None
    textures = model.textures
    rows, columns = textures.sizes.T
    buckets = zip(textures.buckets, textures.bucket_sizes, strict=True)
    flat = [bucket if size == (1, 1) else bucket.at[..., :3].set(0.0) for bucket, size in buckets]
    model = model.with_textures(dataclasses.replace(textures, buckets=tuple(flat)))
    for is_chosen, color in (((rows == columns) & (rows > 1), SQUARE), (rows != columns, OBLONG)):
        model = with_flat_colors(model, is_chosen, (np.asarray(color) - 0.5) / SH_C0)
    return model


def learned_textures(model: a2tg.Model, size: tuple[int, int], num: int) -> np.ndarray:
    """Return the textures of one size whose RGB varies most: on top the splat's colour with the RGB residual, seen from
    +z, below the alpha texture.

    Args:
      size: (rows, columns).
      num: largest number of textures.

    Returns:
      uint8 [2·rows + 1, num·(columns + 1) − 1, 3], white between them; without columns where there are none.
    """
    assert model.textures is not None
    chosen = np.flatnonzero((model.textures.sizes == size).all(axis=1))
    textures = a2tg.texture_arrays(model.textures)
    varied = sorted(chosen, key=lambda index: -float(np.std(textures[index][..., :3], axis=(0, 1)).sum()))[:num]
    rows, columns = size
    sheet = np.ones((2 * rows + 1, max(0, len(varied) * (columns + 1) - 1), 3))
    base = np.maximum(0.5 + SH_C0 * np.asarray(model.gaussians.sh[:, 0]), 0)
    for place, index in enumerate(varied):
        left = place * (columns + 1)
        texture = np.asarray(textures[index])
        sheet[:rows, left : left + columns] = base[index] + texture[..., :3]
        sheet[rows + 1 :, left : left + columns] = texture[..., 3:]
    return np.rint(255 * np.clip(sheet, 0, 1)).astype(np.uint8)
