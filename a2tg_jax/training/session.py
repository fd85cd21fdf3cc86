"""Sessions: what several trainings of one process share: compiled shapes, and the devices they use."""

from collections.abc import Callable, Hashable, Sequence

import jax

from a2tg_jax.core.table import Shape
from a2tg_jax.host.machine import Devices
from a2tg_jax.parallel.exchange import exchange_among
from a2tg_jax.parallel.sharded_rows import num_processes


def _nothing() -> None:
    pass


class Session:
    """Shapes that steps are compiled for, which trainings of one session prefer, and the devices that they use.

    `fit` makes a session of its own unless you pass one. Pass the same session to all trainings of a sweep. No result
    depends on the shapes; on several devices sums have another order, so that last digits differ.
    """

    def __init__(self, after_compiling: Callable[[], object] = _nothing, devices: Sequence[jax.Device] | None = None):
        """Args:
        after_compiling: called after a step was compiled, such as `host.machine.tidy_memory`.
        devices: two or more devices that train one scene together, each with a share of the Gaussians and of the
          pixels, such as `jax.devices()`; None: JAX's default device. If they are of several processes, each of these
          makes the same calls.

        Raises:
          ValueError: if there is one device or none.
        """
        if devices is not None and len(devices) < 2:
            raise ValueError(f"devices must be two or more; got {len(devices)}: for one say jax.default_device(device)")
        self.after_compiling = after_compiling
        self.exchange = None if devices is None else exchange_among(devices)
        """Devices that render together; None: one."""
        self.num_devices = 1 if self.exchange is None else self.exchange.num
        self.mesh = None if self.exchange is None else self.exchange.mesh
        """Mesh over which rows are spread; None: one device."""
        processes = num_processes(self.mesh)
        self.devices = Devices(self.num_devices // processes, processes)
        """Their numbers."""
        self.shapes: set[Shape] = set()
        """Shapes of textures."""
        self.capacities: dict[Hashable, set[int]] = {}
        """Capacities of tile lists, by stage and image size."""

    def capacity(self, place: Hashable, needed: int) -> int:
        """Return the largest known capacity up to twice the need, or else a new one.

        Args:
          place: stage and image size.
          needed: pairs that the tile lists must hold, at least 1.
        """
        known = self.capacities.setdefault(place, set())
        power = 2 ** (needed.bit_length() - 1)
        rounded = next(room for room in (power, power + power // 2, 2 * power) if room >= needed)
        # The largest: lists that overflowed in an earlier run will do so again.
        capacity = max((room for room in known if needed <= room <= 2 * needed), default=rounded)
        known.add(capacity)
        return capacity
