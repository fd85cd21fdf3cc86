"""Moves of texels between the buckets of two layouts, on the host, for `adapt.reallocate`."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from a2tg_jax.core.spread_arrays import on_host
from a2tg_jax.texture import AtlasLayout, Textures


class Move(NamedTuple):
    """Textures that go from one bucket to another."""

    old_bucket: int
    new_bucket: int
    old_rows: np.ndarray
    new_rows: np.ndarray


def plan_moves(old: AtlasLayout, new: AtlasLayout, is_moved: np.ndarray | None = None) -> list[Move]:
    """Return one move for each pair of buckets that some Gaussian, among the marked ones [N] if given, connects."""
    chosen = slice(None) if is_moved is None else is_moved
    num_new = len(new.resolutions)
    pairs = on_host(old.bucket)[chosen].astype(np.int64) * num_new + on_host(new.bucket)[chosen]
    order = np.argsort(pairs, kind="stable")
    codes, starts = np.unique(pairs[order], return_index=True)
    old_rows, new_rows = on_host(old.row)[chosen][order], on_host(new.row)[chosen][order]
    stops = [*starts[1:], len(order)][: len(starts)]
    return [
        Move(int(code) // num_new, int(code) % num_new, old_rows[start:stop], new_rows[start:stop])
        for code, start, stop in zip(codes, starts, stops, strict=True)
    ]


def moved_texels(
    old: Textures, shapes: Sequence[tuple[int, ...]], moves: list[Move], padding: tuple[float, ...]
) -> list[np.ndarray]:
    """Return new buckets of these shapes, filled with `padding` and then with the moved texels.

    Each old bucket is read once, one after the other.
    """
    dtype = old.buckets[0].dtype if old.buckets else np.float32
    targets = [np.broadcast_to(np.asarray(padding, dtype), shape).copy() for shape in shapes]
    for index, bucket in enumerate(old.buckets):
        own = [move for move in moves if move.old_bucket == index]
        source = on_host(bucket) if own and bucket.size else np.zeros(0)
        for move in own if source.size else ():
            target = targets[move.new_bucket]
            v, u = (_nearest(source.shape[axis], target.shape[axis]) for axis in (1, 2))
            target[move.new_rows] = source[np.ix_(move.old_rows, v, u)]
    return targets


def _nearest(old: int, new: int) -> np.ndarray:
    """Return [new] indices of the old texels nearest to the new ones along a side, ⌊(j + 1/2)·old/new⌋, in integers."""
    return (2 * np.arange(new) + 1) * old // (2 * new)
