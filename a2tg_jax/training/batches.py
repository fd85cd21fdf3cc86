"""Batches of views: the order of a training, and photographs on their way to the device."""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh
from numpy.typing import DTypeLike

from a2tg_jax.base.machine import default_device
from a2tg_jax.base.threads import num_threads
from a2tg_jax.parallel import any_process, everywhere, of_views, views_here
from a2tg_jax.scene import Kind, View, kinds_of, ray_bytes

CPU_ROOM = 2**30
"""Largest size in bytes of photographs that all stay on the device, if it is a CPU."""
DEVICE_SHARE = 0.25
"""The same on a GPU, as a share of its memory."""
ROOM_AHEAD = 2**28
"""Largest size of prepared batches in bytes."""
MOST_AHEAD = 10
"""Largest number of prepared batches."""

LEAST_HALVED = 128
"""Least width and height of photographs that are halved in a stage's first iterations, in pixels."""
BYTES_PER_DEPTH = 4
ALIGNMENT = 64
"""Alignment in bytes of memory that XLA adopts."""


def can_halve(size: tuple[int, int]) -> bool:
    """Return whether photographs of a height and width are halved in a stage's first iterations; small ones are not."""
    return min(size) >= LEAST_HALVED


class Photographs(NamedTuple):
    """V views of one image size and lens."""

    viewmats: Array
    """[V, 4, 4]."""
    Ks: Array
    """[V, 3, 3]."""
    images: Array
    """[V, H, W, 3] uint8; floats from 0 to 255 once they are halved."""
    alphas: Array | None
    """[V, H, W] as the images, or None if they are opaque."""
    masks: Array | None = None
    """[V, H, W] bool, True at pixels that count; None if all do."""
    depths: Array | None = None
    """[V, H, W] float32 depth maps, NaN where unknown; None unless a loss term reads them."""
    rays: Array | None = None
    """[H, W, 2] rays of the lens (`Camera.rays`); None of a pinhole."""

    def of(self, views: Array | np.ndarray | None, dtype: np.dtype | None = None) -> "Photographs":
        """Return the views of some indices, or all; with a dtype, cameras and depths are converted to it."""
        batch = self
        if views is not None:
            # Rays are of the lens and have no axis of views.
            batch = jax.tree.map(lambda x: x[views], self._replace(rays=None))._replace(rays=self.rays)
        if dtype is None:
            return batch
        batch = batch._replace(viewmats=batch.viewmats.astype(dtype), Ks=batch.Ks.astype(dtype))
        if batch.depths is not None:
            batch = batch._replace(depths=batch.depths.astype(dtype))
        return batch

    def halved(self) -> "Photographs":
        """Return the views at half the width and height, in floats; traced.

        A pixel is the mean of four, weighed by their opacities; it counts if all four do, and has the depth of the
        first, because a mean at an edge is no surface's. A last odd row or column is left out.
        """
        height, width = (side // 2 for side in self.images.shape[1:3])
        dtype = self.Ks.dtype

        def fours(x: Array) -> Array:
            """Return the four pixels of each pixel along the third and fifth axes [V, H/2, 2, W/2, 2, ...]."""
            return x[:, : 2 * height, : 2 * width].reshape(len(x), height, 2, width, 2, *x.shape[3:])

        def means(x: Array) -> Array:
            return jnp.mean(fours(x.astype(dtype)), axis=(2, 4))

        images = means(self.images)
        alphas = None
        if self.alphas is not None:
            alphas = means(self.alphas)
            weights = self.alphas.astype(dtype)[..., None]
            images = means(weights * self.images.astype(dtype)) / jnp.maximum(alphas, np.finfo(dtype).tiny)[..., None]
        masks = None if self.masks is None else jnp.all(fours(self.masks), axis=(2, 4))
        depths = None if self.depths is None else fours(self.depths)[:, :, 0, :, 0]
        rays = None if self.rays is None else means(self.rays[None])[0] / 2
        Ks = self.Ks * jnp.asarray([[[0.5], [0.5], [1.0]]], dtype)
        return Photographs(self.viewmats, Ks, images, alphas, masks, depths, rays)


def over_background(image: Array, alpha: Array | None, background: Array) -> Array:
    """Return a photograph [H, W, 3] with its opacity [H, W], both from 0 to 255, over a colour [3]: floats in [0, 1],
    of the colour's dtype; traced."""
    photograph = image.astype(background.dtype) / 255
    if alpha is None:
        return photograph
    weight = alpha.astype(photograph.dtype)[..., None] / 255
    return weight * photograph + (1 - weight) * background[None, None, :]


class BatchOrder:
    """Batches of views of one image size and lens, in shuffled epochs. The order depends on the seed and the iteration
    alone, so a resumed run has the same one."""

    def __init__(self, views: tuple[View, ...], batch_size: int, seed: int, number: int = 0):
        """`number` selects one of the orders of a seed, from 0."""
        self.kinds = kinds_of(views)
        """Image size and lens of each view."""
        self._batch_size = batch_size
        self._seeds = (seed, number) if number else (seed,)
        self._epoch = 0
        self._batches = self._draw(0)

    def indices(self, iteration: int) -> tuple[int, ...]:
        """Return the views of an iteration (from 1)."""
        epoch, position = divmod(iteration - 1, len(self._batches))
        if epoch != self._epoch:
            self._epoch = epoch
            self._batches = self._draw(epoch)
        return self._batches[position]

    def _draw(self, epoch: int) -> list[tuple[int, ...]]:
        """Return one epoch: every view once. The last batch of a kind is filled from the start of its order."""
        # Seeded by epoch, so that a resumed run need not draw the earlier ones.
        rng = np.random.default_rng([*self._seeds, epoch])
        by_kind: dict[Kind, list[int]] = {}
        for index in rng.permutation(len(self.kinds)):
            by_kind.setdefault(self.kinds[index], []).append(int(index))
        batches = []
        for _, order in sorted(by_kind.items()):
            for start in range(0, len(order), self._batch_size):
                batches.append(tuple(order[(start + k) % len(order)] for k in range(self._batch_size)))
        return [batches[index] for index in rng.permutation(len(batches))]


class BatchPlan(NamedTuple):
    """Where the photographs are kept during training."""

    is_resident: bool
    """All of them stay on the device, with the rays of their lenses."""
    keeps_rays: bool
    """The rays of all lenses stay on the device. Otherwise each batch brings its own."""
    batch_bytes: int
    """Bytes of the largest batch."""
    num_ahead: int
    """Number of batches prepared ahead, if the photographs do not all stay on the device."""


def plan_batches(views: tuple[View, ...], batch_size: int, room: float | None = None, *, has_depths: bool) -> BatchPlan:
    """Return where photographs are during training. Arguments as of `PhotoStore`."""
    sizes = [view_bytes(view, has_depths=has_depths) for view in views]
    of_rays = ray_bytes(views)
    room = device_room() if room is None else room
    batch_bytes = batch_size * max(sizes)
    num_ahead = max(1, min(MOST_AHEAD, int(ROOM_AHEAD // max(batch_bytes, 1))))
    is_resident = sum(sizes) + of_rays <= room and all(view.picture.is_held for view in views)
    return BatchPlan(is_resident, of_rays <= room, batch_bytes, num_ahead)


def view_bytes(view: View, *, has_depths: bool) -> int:
    """Return the bytes of a photograph, and of its depth map if that is loaded with it."""
    depths = BYTES_PER_DEPTH * math.prod(view.picture.size) if has_depths else 0
    return view.picture.nbytes + depths


class PhotoStore:
    """Photographs of a stage's iterations. They stay on the device if all of them fit; otherwise threads prepare
    batches ahead of the step. Several processes decide together. Close it when the stage is over."""

    def __init__(
        self,
        views: tuple[View, ...],
        order: BatchOrder,
        last: int,
        mesh: Mesh | None = None,
        has_depths: bool = False,
        room: float | None = None,
    ):
        """Args:
        views: all training views.
        order: views of each iteration.
        last: the stage's last iteration.
        mesh: devices that draw the views of an iteration; None: one. Photographs that stay there are on each of them.
        has_depths: whether depth maps are loaded with the photographs.
        room: largest number of bytes on the device; None: `device_room()`.
        """
        self._views = views
        self._order = order
        self._last = last
        self._mesh = mesh
        self._has_depths = has_depths
        plan = plan_batches(views, len(order.indices(1)), room, has_depths=has_depths)
        self._keeps_rays = plan.keeps_rays
        self.num_ahead = plan.num_ahead
        self._rays: dict[Kind, Array] = {}
        self._ahead = Ahead(self._read, self.num_ahead)
        # All processes must launch the same program, so one without room makes all stream.
        self.is_resident = not any_process(mesh, not plan.is_resident)
        self._stacks: dict[Kind, Photographs] = {}
        """All photographs of each kind, if they stay on the device."""
        self._places: dict[int, int] = {}
        """Place of each view in the stack of its kind."""
        if self.is_resident:
            of_kind: dict[Kind, list[int]] = {}
            for index, kind in enumerate(order.kinds):
                alike = of_kind.setdefault(kind, [])
                self._places[index] = len(alike)
                alike.append(index)
            for kind, alike in of_kind.items():
                self._stacks[kind] = self._placed(kind, self._read(alike))
        self._here = views_here(mesh, len(order.indices(1)))
        """Places in a batch of the views that this process draws."""

    def batch(self, iteration: int) -> tuple[Photographs, Array | np.ndarray | None]:
        """Return photographs of one kind, and the int32 indices of the iteration's among them; None if all are the
        iteration's.

        Raises:
          ValueError, OSError: if a photograph that was not copied has gone, has changed or cannot be read.
        """
        indices = self._indices_here(iteration)
        kind = self._order.kinds[indices[0]]
        if not self.is_resident:
            following = range(iteration, min(iteration + self.num_ahead, self._last) + 1)
            batch = self._ahead.first({later: self._indices_here(later) for later in following})
            return self._placed(kind, batch), None
        places = [self._places[index] for index in indices]
        return self._stacks[kind], of_views(self._mesh, np.asarray(places, np.int32))

    def _indices_here(self, iteration: int) -> tuple[int, ...]:
        """Return the views of an iteration that this process draws."""
        indices = self._order.indices(iteration)
        return tuple(indices[place] for place in self._here)

    def _placed(self, kind: Kind, batch: Photographs) -> Photographs:
        """Return photographs of a kind on the devices, with the rays of their lens, which stay there if the rays of
        all lenses fit."""
        rays = self._rays.get(kind, batch.rays)
        if rays is not None and kind not in self._rays:
            rays = everywhere(self._mesh, rays)
            if self._keeps_rays:
                self._rays[kind] = rays
        batch = batch._replace(rays=None)
        placed = everywhere(self._mesh, batch) if self.is_resident else of_views(self._mesh, batch)
        return placed._replace(rays=rays)

    def _read(self, indices: Sequence[int]) -> Photographs:
        return stack_views([self._views[index] for index in indices], self._views, has_depths=self._has_depths)

    def close(self) -> None:
        """End the threads."""
        self._ahead.close()


class Ahead:
    """Threads that prepare the next batches in order."""

    def __init__(self, load: Callable[[tuple[int, ...]], Photographs], num_ahead: int):
        """`load` makes the batch of some views; its errors are raised where that batch is taken. Up to `num_ahead` are
        ready before they are needed."""
        self._load = load
        self._pool = ThreadPoolExecutor(min(num_ahead, num_threads()), thread_name_prefix="photographs")
        self._batches: dict[int, Future[Photographs]] = {}

    def first(self, following: dict[int, tuple[int, ...]]) -> Photographs:
        """Return the first of the following batches, by iteration, and prepare the others."""
        for iteration in self._batches.keys() - following.keys():
            self._batches.pop(iteration).cancel()
        for iteration, indices in following.items():
            if iteration not in self._batches:
                self._batches[iteration] = self._pool.submit(self._load, indices)
        return self._batches[next(iter(following))].result()

    def close(self) -> None:
        """End the threads when their present batches are done."""
        self._pool.shutdown(cancel_futures=True)


def device_room() -> float:
    """Return the bytes of the default device that photographs may take."""
    stats = default_device().memory_stats()
    return DEVICE_SHARE * stats["bytes_limit"] if stats and "bytes_limit" in stats else CPU_ROOM


def stack_views(views: list[View], among: tuple[View, ...] | None = None, *, has_depths: bool = False) -> Photographs:
    """Return views of one image size and lens, stacked in numpy arrays.

    Args:
      views: the views to stack.
      among: views that decide the structure: if one of that size has opacities or a mask, every stack of that size has
        them. None: `views`.
      has_depths: whether depth maps are loaded with the photographs; NaN where a view has none.
    """
    size = views[0].picture.size
    alike = [view for view in among or views if view.picture.size == size]
    pixels = [view.picture.read() for view in views]

    def stacked(arrays: Sequence[Any], dtype: DTypeLike = np.uint8, channels: tuple[int, ...] = ()) -> Any:
        # Aligned so that `jax.device_put` adopts them on CPUs.
        shape = (len(views), *size, *channels)
        num_bytes = math.prod(shape) * np.dtype(dtype).itemsize
        room = np.zeros(num_bytes + ALIGNMENT, np.uint8)
        start = -room.ctypes.data % ALIGNMENT
        stack = room[start : start + num_bytes].view(dtype).reshape(shape)
        for place, array in enumerate(arrays):
            stack[place] = array
        return stack

    alphas = masks = depths = None
    if any(view.has_alpha for view in alike):
        opaque = np.full(size, 255, np.uint8)
        alphas = stacked([picture[..., 3] if picture.shape[2] == 4 else opaque for picture in pixels])
    if any(view.mask is not None for view in alike):
        whole = np.ones(size, bool)
        masks = stacked([whole if view.mask is None else view.mask.read() for view in views], bool)
    if has_depths:
        unknown = np.full(size, np.nan, np.float32)
        depths = stacked([unknown if view.depth is None else view.depth.read() for view in views], np.float32)
    viewmats: Any = np.stack([np.asarray(view.camera.viewmat) for view in views])
    Ks: Any = np.stack([np.asarray(view.camera.K) for view in views])
    images = stacked([picture[..., :3] for picture in pixels], channels=(3,))
    rays: Any = views[0].camera.rays
    return Photographs(viewmats, Ks, images, alphas, masks, depths, rays)
