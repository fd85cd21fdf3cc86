"""Order of the views that iterations train on: shuffled epochs that depend on the seed and the iteration alone."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import jax
import numpy as np
from jax import Array

from a2tg_jax.data.scene import View
from a2tg_jax.host.cores import num_threads

HOST_SHARE = 2**30
DEVICE_SHARE = 0.25
"""Photographs stay on the device while they take no more than this share of its memory; on a CPU, 1 GiB."""
ROOM_AHEAD = 2**28
MOST_AHEAD = 10
"""Batches that are made ready before they are wanted: so many, as long as they take no more bytes than that."""

ALIGNMENT = 64
"""Bytes, of memory that XLA takes over."""


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
    masks: Array | None = None
    """[V, H, W] bool, which pixels count; None where all of them do."""


class BatchOrder:
    """Batches of views of one image size. Any iteration can be asked for, so a resumed run sees the same order."""

    def __init__(self, views: tuple[View, ...], batch_size: int, seed: int, number: int = 0):
        """Args:
        views: of one scene.
        batch_size: views of an iteration.
        seed: of the order.
        number: which of the orders of this seed, from 0.
        """
        self._views, self._batch_size = views, batch_size
        self._seeds = (seed, number) if number else (seed,)
        self._epoch, self._batches = -1, self._draw(0)

    def indices(self, iteration: int) -> tuple[int, ...]:
        """Return the views of an iteration (from 1)."""
        epoch, position = divmod(iteration - 1, len(self._batches))
        if epoch != self._epoch:
            self._epoch, self._batches = epoch, self._draw(epoch)
        return self._batches[position]

    def _draw(self, epoch: int) -> list[tuple[int, ...]]:
        """One epoch: every view once; the last batch of a size is filled up from the start of its order."""
        rng = np.random.default_rng([*self._seeds, epoch])
        by_size: dict[tuple[int, int], list[int]] = {}
        for index in rng.permutation(len(self._views)):
            by_size.setdefault(self._views[index].picture.size, []).append(int(index))
        batches = []
        for _, order in sorted(by_size.items()):
            for start in range(0, len(order), self._batch_size):
                batches.append(tuple(order[(start + k) % len(order)] for k in range(self._batch_size)))
        return [batches[index] for index in rng.permutation(len(batches))]


class BatchPlan(NamedTuple):
    """Plan of how the photographs come to the device."""

    is_resident: bool
    """All of them stay there."""
    batch_bytes: int
    """Bytes of the largest batch."""
    num_ahead: int
    """Batches that are made ready before they are wanted, where not all stay."""


def plan_batches(views: tuple[View, ...], batch_size: int, room: float | None = None) -> BatchPlan:
    """Return whether photographs stay on the device, or how many batches are prepared. Arguments as `PhotoStore`."""
    fits = sum(view.picture.nbytes for view in views) <= (device_room() if room is None else room)
    batch_bytes = batch_size * max(view.picture.nbytes for view in views)
    num_ahead = max(1, min(MOST_AHEAD, int(ROOM_AHEAD // max(batch_bytes, 1))))
    return BatchPlan(fits and all(view.picture.is_held for view in views), batch_bytes, num_ahead)


class PhotoStore:
    """The photographs of a stage's iterations: on the device while all of them fit there, else brought to it batch by
    batch, made ready by threads that know the order. Close it when the stage is over."""

    def __init__(self, views: tuple[View, ...], order: BatchOrder, last: int, room: float | None = None):
        """Args:
        views: of one scene.
        order: which of them each iteration wants.
        last: the stage's last iteration.
        room: bytes of the device that they may take; None: `DEVICE_SHARE` of it.
        """
        self._views, self._order, self._last = views, order, last
        plan = plan_batches(views, len(order.indices(1)), room)
        self.is_resident, self.num_ahead = plan.is_resident, plan.num_ahead
        self._stacks: dict[tuple[int, int], tuple[Photographs, dict[int, int]]] = {}
        self._ahead = Ahead(lambda indices: stack_views([views[index] for index in indices], views), self.num_ahead)

    def batch(self, iteration: int) -> tuple[Photographs, np.ndarray]:
        """Photographs among which those of an iteration, all of one size, are; and where among them, int32.

        Raises:
          ValueError: if a photograph that was left on disk is not there any more, or is another.
        """
        indices = self._order.indices(iteration)
        if not self.is_resident:
            following = range(iteration, min(iteration + self.num_ahead, self._last) + 1)
            batch = self._ahead.first({key: self._order.indices(key) for key in following})
            return batch, np.arange(len(indices), dtype=np.int32)
        stack, places = self._stack(self._views[indices[0]].picture.size)
        return stack, np.asarray([places[index] for index in indices], np.int32)

    def _stack(self, size: tuple[int, int]) -> tuple[Photographs, dict[int, int]]:
        """Return all photographs of a size on the device, and the place of each view's."""
        if size not in self._stacks:
            found = [index for index, view in enumerate(self._views) if view.picture.size == size]
            stack = jax.device_put(stack_views([self._views[index] for index in found]))
            self._stacks[size] = stack, {index: place for place, index in enumerate(found)}
        return self._stacks[size]

    def close(self) -> None:
        """Ends the threads."""
        self._ahead.close()


class Ahead:
    """Makes batches ready in threads, those that are wanted next first."""

    def __init__(self, load: Callable[[tuple[int, ...]], Photographs], num_ahead: int):
        """Args:
        load: makes the batch of some views; its errors reach who waits for that batch.
        num_ahead: how many batches may be ready before they are wanted.
        """
        self._load = load
        self._pool = ThreadPoolExecutor(min(num_ahead, num_threads()), thread_name_prefix="photographs")
        self._batches: dict[int, Future[Photographs]] = {}

    def first(self, wanted: dict[int, tuple[int, ...]]) -> Photographs:
        """Return the first of the wanted batches, by iteration; the others, and no more, are prepared."""
        for iteration in self._batches.keys() - wanted.keys():
            self._batches.pop(iteration).cancel()
        for iteration, indices in wanted.items():
            if iteration not in self._batches:
                self._batches[iteration] = self._pool.submit(self._load, indices)
        return self._batches[next(iter(wanted))].result()

    def close(self) -> None:
        """Ends the threads, once what they are at is done."""
        self._pool.shutdown(cancel_futures=True)


def check_views(views: tuple[View, ...]) -> None:
    """Raise ValueError, naming the view, unless there are photographs, uint8, of their cameras' sizes."""
    if not views:
        raise ValueError("scene.train must hold at least one view; got none")
    for view in views:
        height, width, picture = view.camera.height, view.camera.width, view.picture
        if picture.shape not in ((height, width, 3), (height, width, 4)) or picture.dtype != np.uint8:
            raise ValueError(
                f"picture of view {view.name} must be uint8 {[height, width, 3]}, as large as its camera says, or have "
                f"an opacity as 4th channel; got {np.dtype(picture.dtype)} {list(picture.shape)}"
            )
        if view.mask is not None and view.mask.shape != (height, width):
            raise ValueError(
                f"mask of view {view.name} must be {[height, width]}, as large as its camera says; "
                f"got {list(view.mask.shape)}"
            )


def device_room() -> float:
    """Return the bytes of the default device that photographs may take."""
    stats = jax.local_devices()[0].memory_stats()
    return DEVICE_SHARE * stats["bytes_limit"] if stats and "bytes_limit" in stats else HOST_SHARE


def stack_views(views: list[View], among: tuple[View, ...] | None = None) -> Photographs:
    """Views of one image size, stacked on the host.

    Args:
      views: those to stack.
      among: all the views; where one of that size has opacities or a mask the stack has, so that every stack of it is
        of one structure. None: `views`.
    """
    alike = [view for view in among or views if view.picture.size == views[0].picture.size]
    pixels = [view.picture.read() for view in views]
    alphas = None
    if any(view.has_alpha for view in alike):
        opaque = np.full(views[0].picture.size, 255, np.uint8)
        alphas = _stacked([own[..., 3] if own.shape[2] == 4 else opaque for own in pixels])
    masks = None
    if any(view.mask is not None for view in alike):
        whole = np.ones(views[0].picture.size, bool)
        masks = _stacked([whole if view.mask is None else view.mask.read() for view in views])
    return Photographs(
        viewmats=np.stack([np.asarray(view.camera.viewmat) for view in views]),  # type: ignore[arg-type]
        Ks=np.stack([np.asarray(view.camera.K) for view in views]),  # type: ignore[arg-type]
        images=_stacked([own[..., :3] for own in pixels]),  # type: ignore[arg-type]
        alphas=alphas,  # type: ignore[arg-type]
        masks=masks,  # type: ignore[arg-type]
    )


def _stacked(arrays: list[np.ndarray]) -> np.ndarray:
    """`np.stack` in memory that `jax.device_put` takes over on CPUs as it stands; `jnp.asarray` would copy it twice."""
    shape, dtype = (len(arrays), *arrays[0].shape), arrays[0].dtype
    num_bytes = int(np.prod(shape)) * dtype.itemsize
    room = np.empty(num_bytes + ALIGNMENT, np.uint8)
    start = -room.ctypes.data % ALIGNMENT
    return np.stack(arrays, out=room[start : start + num_bytes].view(dtype).reshape(shape))
