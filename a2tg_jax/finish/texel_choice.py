"""Smaller textures of few texels in all, chosen by what each halving changes in pictures.

Each texture has a row of halvings, always along the side where its pairs of texels differ less, weighted by their
visibility. Of all rows together the halvings are taken that change least per texel saved.
"""

from typing import NamedTuple

import numpy as np

from a2tg_jax.texture import NEUTRAL_TEXEL, Textures

Tables = list[tuple[np.ndarray, np.ndarray]]
"""Indices [n] of Gaussians, and their textures [n, Tv, Tu, C]; one table for each size."""
LEAST_WEIGHT = 1e-9


class Halvings(NamedTuple):
    """Halvings of all textures, in rounds."""

    ids: np.ndarray
    rounds: np.ndarray
    costs: np.ndarray
    """Cost per texel saved, not less than in the rounds before."""
    saved: np.ndarray


def fewest_texels(textures: Textures, weights: Textures, most: int) -> Tables:
    """Return textures that have `most` texels at most in all, at least one each (host).

    Args:
      textures: of N Gaussians; empty ones become a neutral texel.
      weights: the visibility of each texel, as `shrinking.texel_weights_of` gives it.
      most: at least N.
    """
    tables = _tables(textures, weights)
    steps = _all_halvings(tables, textures.num)
    order = np.lexsort((steps.rounds, steps.costs))
    total = sum(texels[..., 0].size for _, texels in tables)
    count = int(np.searchsorted(np.cumsum(steps.saved[order]), total - most)) + 1 if total > most else 0
    rounds = np.bincount(steps.ids[order[:count]], minlength=textures.num)
    for index in range(int(rounds.max(initial=0))):
        tables = _merged([part for table in tables for part in _halved_some(table, rounds > index)])
    return [(ids, texels[..., :4]) for ids, texels in tables]


def _tables(textures: Textures, weights: Textures) -> Tables:
    """Return textures [n, Tv, Tu, 5] by size, with the visibility as fifth channel."""
    tables: Tables = []
    for index, size in enumerate(textures.bucket_sizes):
        ids = np.flatnonzero(np.asarray(textures.bucket) == index)
        own = np.tile(np.asarray([*NEUTRAL_TEXEL, LEAST_WEIGHT]), (len(ids), 1, 1, 1))
        if min(size) > 0:
            rows = np.asarray(textures.row)[ids]
            texels, squares = (np.asarray(tree.buckets[index], np.float64)[rows] for tree in (textures, weights))
            own = np.concatenate([texels, squares.sum(axis=-1, keepdims=True) + LEAST_WEIGHT], axis=-1)
        tables.append((ids, own))
    return _merged(tables)


def _merged(tables: Tables) -> Tables:
    """Return the tables with those of one size joined."""
    sizes = sorted({texels.shape[1:3] for ids, texels in tables if len(ids)})
    found = [[table for table in tables if table[1].shape[1:3] == size] for size in sizes]
    return [tuple(np.concatenate(parts) for parts in zip(*own, strict=True)) for own in found]  # type: ignore[misc]


def _all_halvings(tables: Tables, num: int) -> Halvings:
    """Return the halvings of all textures down to one texel."""
    rows, at_least = [], np.zeros(num)
    index = 0
    while any(texels.shape[1] * texels.shape[2] > 1 for _, texels in tables):
        parts: Tables = []
        for ids, texels in tables:
            area = texels.shape[1] * texels.shape[2]
            for chosen, smaller, cost in _halved(ids, texels):
                saved = area - smaller.shape[1] * smaller.shape[2]
                at_least[chosen] = np.maximum(at_least[chosen], cost / max(saved, 1))
                parts.append((chosen, smaller))
                rows.append(
                    Halvings(chosen, np.full(len(chosen), index), at_least[chosen], np.full(len(chosen), saved))
                )
        tables = _merged([part for part in parts if part[1].shape[1] * part[1].shape[2] > 1])
        index += 1
    joined = [np.concatenate(parts) for parts in zip(*rows, strict=True)] if rows else [np.zeros(0, int)] * 4
    return Halvings(*joined)


def _halved_some(table: tuple[np.ndarray, np.ndarray], is_chosen: np.ndarray) -> Tables:
    """Return a table with the chosen Gaussians halved, as two or three tables."""
    ids, texels = table
    own = is_chosen[ids]
    parts = [(chosen, smaller) for chosen, smaller, _ in _halved(ids[own], texels[own])]
    return [(ids[~own], texels[~own]), *parts]


def _halved(ids: np.ndarray, texels: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return textures halved along the side where that costs less, with their indices and costs; by side."""
    choices = [_halved_along(texels, axis) for axis in (1, 2) if texels.shape[axis] > 1]
    if not choices or not len(ids):
        return []
    best = np.argmin([cost for _, cost in choices], axis=0)
    return [
        (ids[best == place], smaller[best == place], cost[best == place])
        for place, (smaller, cost) in enumerate(choices)
        if (best == place).any()
    ]


def _halved_along(texels: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Return textures with weighted means of pairs along an axis, and the cost [n] of each; an odd last texel stays."""
    size = texels.shape[axis]
    starts = np.arange(0, size, 2)
    values, weights = texels[..., :4], texels[..., 4:]
    sums = np.add.reduceat(weights, starts, axis=axis)
    means = np.add.reduceat(weights * values, starts, axis=axis) / sums
    error = weights * (values - np.take(means, np.arange(size) // 2, axis=axis)) ** 2
    return np.concatenate([means, sums], axis=-1), error.sum(axis=(1, 2, 3))
