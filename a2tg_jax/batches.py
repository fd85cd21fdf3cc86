"""Which views an iteration trains on: shuffled epochs that depend on the seed and the iteration alone."""

import numpy as np

from a2tg_jax.data.scene import View
from a2tg_jax.step import Batch


class BatchOrder:
    """Batches of views of one image size. Any iteration can be asked for, so a resumed run sees the same order."""

    def __init__(self, views: tuple[View, ...], batch_size: int, seed: int):
        if batch_size < 1:
            raise ValueError(f"batch_size must be at least 1; got {batch_size}")
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


def make_batch(views: tuple[View, ...], indices: tuple[int, ...]) -> Batch:
    """The chosen views, stacked; all of one image size."""
    chosen = [views[index] for index in indices]
    alphas = None
    if any(view.alpha is not None for view in views):
        opaque = np.full(chosen[0].image.shape[:2], 255, np.uint8)
        alphas = np.stack([opaque if view.alpha is None else view.alpha for view in chosen])
    return Batch(
        viewmats=np.stack([np.asarray(view.camera.viewmat) for view in chosen]),  # type: ignore[arg-type]
        Ks=np.stack([np.asarray(view.camera.K) for view in chosen]),  # type: ignore[arg-type]
        images=np.stack([view.image for view in chosen]),  # type: ignore[arg-type]
        alphas=alphas,  # type: ignore[arg-type]
    )
