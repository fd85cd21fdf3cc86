"""Programs that know the classes of what they are given.

JAX (0.10 to 0.12) holds the tree structures of two registered dataclasses for equal where only the classes differ: a
rule and another that overrides its `shade`, say. Their hashes differ, but `jax.jit` looks, before it compares, at seven
bits of them, so that one such pair in 128 would run each other's program.
"""

from collections.abc import Callable
from typing import Any

import jax


def classes_of(tree: Any) -> tuple[type, ...]:
    """The classes of a pytree's inner nodes, outermost first."""
    classes: list[type] = []
    ahead: list[Any] = [jax.tree.structure(tree)]
    while ahead:
        structure = ahead.pop()
        if data := structure.node_data():
            classes.append(data[0])
            ahead.extend(structure.children())
    return tuple(classes)


class jit:
    """`jax.jit` of a function, compiled anew for other classes among its arguments."""

    def __init__(
        self,
        function: Callable,
        *,
        static_argnums: tuple[int, ...] = (),
        donate_argnums: tuple[int, ...] = (),
    ):
        def of_classes(classes, /, *args, **kwargs):
            return function(*args, **kwargs)

        of_classes.__name__ = of_classes.__qualname__ = function.__name__  # which profiles and compiled programs bear
        self._jitted: Any = jax.jit(
            of_classes,
            static_argnums=(0, *(number + 1 for number in static_argnums)),
            donate_argnums=tuple(number + 1 for number in donate_argnums),
        )

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self._jitted(classes_of((args, kwargs)), *args, **kwargs)

    def num_compiled(self) -> int:
        """Programs that this process holds for it."""
        return self._jitted._cache_size()

    def clear_cache(self) -> None:
        """Forgets them."""
        self._jitted.clear_cache()
