"""Sessions: shapes that several trainings of one process share, so that they compile less."""

from collections.abc import Callable, Hashable

from a2tg_jax.texture import Shape


def _nothing() -> None:
    pass


class Session:
    """Shapes that steps are compiled for. Trainings of one session prefer them; no result depends on it.

    `fit` makes a session of its own unless you pass one. Pass the same session to all trainings of a sweep.
    """

    def __init__(self, after_compiling: Callable[[], object] = _nothing):
        """Args:
        after_compiling: called after a step was compiled, such as `host.memory.tidy_memory`.
        """
        self.after_compiling = after_compiling
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
