"""Which views an iteration trains on: shuffled epochs that depend on the seed and the iteration alone."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.data.scene import View

HOST_SHARE = 2**30
DEVICE_SHARE = 0.25
"""Photographs stay on the device while they take no more than this share of its memory; on a CPU, 1 GiB."""


class Photographs(NamedTuple):
    """V views of one image size."""

    viewmats: Array
    """[V, 4, 4]."""
    Ks: Array
    """[V, 3, 3]."""
    images: Array
    """[V, H, W, 3] uint8."""
    alphas: Array | None
    """[V, H, W] uint8, or None where the images are opaque."""


class BatchOrder:
    """Batches of views of one image size. Any iteration can be asked for, so a resumed run sees the same order."""

    def __init__(self, views: tuple[View, ...], batch_size: int, seed: int):
        self._views, self._batch_size, self._seed = views, batch_size, seed
        self._epoch, self._batches = -1, self._draw(0)

    def indices(self, iteration: int) -> tuple[int, ...]:
        """The views of an iteration (from 1)."""
        epoch, position = divmod(iteration - 1, len(self._batches))
        if epoch != self._epoch:
            self._epoch, self._batches = epoch, self._draw(epoch)
        return self._batches[position]

    def _draw(self, epoch: int) -> list[tuple[int, ...]]:
        """One epoch: every view once; the last batch of a size is filled up from the start of its order."""
        rng = np.random.default_rng([self._seed, epoch])
        by_size: dict[tuple[int, int], list[int]] = {}
        for index in rng.permutation(len(self._views)):
            by_size.setdefault(self._views[index].image.shape[:2], []).append(int(index))  # type: ignore[arg-type]
        batches = []
        for _, order in sorted(by_size.items()):
            for start in range(0, len(order), self._batch_size):
                batches.append(tuple(order[(start + k) % len(order)] for k in range(self._batch_size)))
        return [batches[index] for index in rng.permutation(len(batches))]


class PhotoStore:
    """The photographs, on the device while all of them fit there, else brought to it batch by batch."""

    def __init__(self, views: tuple[View, ...], room: float | None = None):
        """Args:
        views: of one scene.
        room: bytes of the device that they may take; None: `DEVICE_SHARE` of it.
        """
        self._views = views
        num_bytes = sum(view.image.nbytes + (0 if view.alpha is None else view.alpha.nbytes) for view in views)
        self.is_resident = num_bytes <= (device_room() if room is None else room)
        self._stacks: dict[tuple[int, ...], tuple[Photographs, dict[int, int]]] = {}
        self._latest = functools.lru_cache(maxsize=2)(lambda indices: stack_views([views[i] for i in indices]))

    def batch(self, indices: tuple[int, ...]) -> tuple[Photographs, np.ndarray]:
        """Photographs among which those of `indices`, all of one image size, are; and where among them, int32."""
        if not self.is_resident:
            return self._latest(indices), np.arange(len(indices), dtype=np.int32)
        size = self._views[indices[0]].image.shape[:2]
        if size not in self._stacks:
            found = [index for index, view in enumerate(self._views) if view.image.shape[:2] == size]
            stack = jax.tree.map(jnp.asarray, stack_views([self._views[index] for index in found]))
            self._stacks[size] = stack, {index: place for place, index in enumerate(found)}
        stack, places = self._stacks[size]
        return stack, np.asarray([places[index] for index in indices], np.int32)


def check_views(views: tuple[View, ...]) -> None:
    """Raises ValueError, naming the view, unless there are photographs, [H, W, 3] uint8, of their cameras' sizes."""
    if not views:
        raise ValueError("scene.train must hold at least one view; got none")
    for view in views:
        size = view.camera.height, view.camera.width
        named = {"image": (view.image, (*size, 3)), "alpha": (view.alpha, size)}
        for name, (array, wanted) in named.items():
            if array is not None and (array.shape, array.dtype) != (wanted, np.uint8):
                raise ValueError(
                    f"{name} of view {view.name} must be uint8 {list(wanted)}, as large as its camera says; "
                    f"got {array.dtype} {list(array.shape)}"
                )


def device_room() -> float:
    """Bytes of the default device that photographs may take."""
    stats = jax.local_devices()[0].memory_stats()
    return DEVICE_SHARE * stats["bytes_limit"] if stats and "bytes_limit" in stats else HOST_SHARE


def stack_views(views: list[View]) -> Photographs:
    """Views of one image size, stacked on the host."""
    alphas = None
    if any(view.alpha is not None for view in views):
        opaque = np.full(views[0].image.shape[:2], 255, np.uint8)
        alphas = np.stack([opaque if view.alpha is None else view.alpha for view in views])
    return Photographs(
        viewmats=np.stack([np.asarray(view.camera.viewmat) for view in views]),  # type: ignore[arg-type]
        Ks=np.stack([np.asarray(view.camera.K) for view in views]),  # type: ignore[arg-type]
        images=np.stack([view.image for view in views]),  # type: ignore[arg-type]
        alphas=alphas,  # type: ignore[arg-type]
    )
