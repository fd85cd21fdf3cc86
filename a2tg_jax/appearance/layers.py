"""Names of appearances and of what they wrap, for messages."""

from collections.abc import Callable, Sequence

from a2tg_jax.appearance.base import Appearance


def layers_in_words(layers: Sequence[Appearance]) -> str:
    """Return the classes of wrappers and of what they wrap, as in "Banded and Shaped around Textured"."""
    *wrappers, innermost = (type(layer).__name__ for layer in layers)
    return f"{' and '.join(wrappers)} around {innermost}" if wrappers else innermost


def layer_without(appearance: Appearance, has: Callable[[Appearance], bool]) -> str:
    """Return in words the innermost layer that lacks a capability, with what it wraps; the innermost if none does."""
    layers = appearance.layers
    at = max((index for index, layer in enumerate(layers) if not has(layer)), default=len(layers) - 1)
    return layers_in_words(layers[at:])
