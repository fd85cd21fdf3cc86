"""`jax.jit` that tells programs apart by the classes of their arguments.

JAX (0.10 to 0.12) considers the tree structures of two registered dataclasses equal if only their classes differ, such
as a rule and a subclass that overrides `shade`. Their hashes differ, but `jax.jit` compares only seven bits of them, so
that one such pair in 128 would run each other's program.
"""

from collections.abc import Callable
from typing import Any, Generic, ParamSpec, TypeVar

import jax

from a2tg_jax.core.forks import check_process

P = ParamSpec("P")
R = TypeVar("R")


def classes_of(tree: Any) -> tuple[type, ...]:
    """Return the classes of a pytree's inner nodes, outermost first."""
    classes: list[type] = []
    ahead: list[Any] = [jax.tree.structure(tree)]
    while ahead:
        structure = ahead.pop()
        if data := structure.node_data():
            classes.append(data[0])
            ahead.extend(structure.children())
    return tuple(classes)


class Jitted(Generic[P, R]):
    """Function under `jax.jit`, compiled anew for other classes of arguments."""

    def __init__(
        self,
        function: Callable[P, R],
        *,
        static_argnums: tuple[int, ...] = (),
        donate_argnums: tuple[int, ...] = (),
    ):
        def of_classes(classes: tuple[type, ...], /, *args: P.args, **kwargs: P.kwargs) -> R:
            return function(*args, **kwargs)

        of_classes.__name__ = of_classes.__qualname__ = function.__name__  # shown in profiles
        self._jitted: Any = jax.jit(
            of_classes,
            static_argnums=(0, *(number + 1 for number in static_argnums)),
            donate_argnums=tuple(number + 1 for number in donate_argnums),
        )

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        check_process()
        result: R = self._jitted(classes_of((args, kwargs)), *args, **kwargs)
        return result

    def num_compiled(self) -> int:
        """Return the number of compiled programs of this function in this process."""
        return int(self._jitted._cache_size())

    def clear_cache(self) -> None:
        """Forget the compiled programs."""
        self._jitted.clear_cache()
