"""Appearances in files: named arrays, and whether the portable formats can hold them."""

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from a2tg_jax.core.checks import FLOATS
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.texture import AtlasLayout, Textures, check_places, check_textures


class StoredArrays:
    """Parameters and layout as named arrays. The defaults suit parameters with one row per Gaussian and no layout."""

    array_prefix: str = ""
    """Prefix of the array names of `texture_options`' textures."""
    shapes_name: str | None = None
    """Name of the array of the shapes of kernels; None if all are Gaussians."""
    max_alpha: float = 0.99
    """Upper limit of a splat's alpha."""
    has_low_pass: bool = True
    """Whether a low-pass filter shows splats that are smaller than a pixel (`AppearanceRule.has_low_pass`)."""

    @property
    def is_portable(self) -> bool:
        """Whether Gaussians, degrees, shapes, textures and `max_alpha` define the appearance completely.

        Compact files, web scenes and `shrink_textures` need this. A subclass of a portable class is not portable.
        """
        return False

    def arrays(self, params: Any, layout: Any) -> dict[str, np.ndarray]:
        """Return named arrays without padding, which `from_arrays` turns into parameters and layout (host)."""
        leaves = jax.tree_util.tree_flatten_with_path(params)[0]
        return {_name(path): np.asarray(leaf) for path, leaf in leaves}

    def from_arrays(self, arrays: dict[str, np.ndarray]) -> tuple[Any, Any]:
        """Return the parameters and layout of `arrays` (host).

        Raises:
          ValueError: if an array is missing or its shape does not fit the others.
        """
        shapes, layout = parameter_shapes(self)
        leaves, treedef = jax.tree_util.tree_flatten_with_path(shapes)
        names = [_name(path) for path, _ in leaves]
        missing = [name for name in names if name not in arrays]
        if missing:
            raise ValueError(f"the array {missing[0]} of {type(self).__name__} is missing")
        for name, (_, leaf) in zip(names, leaves, strict=True):
            if arrays[name].shape[1:] != leaf.shape[1:]:
                raise ValueError(f"{name} must be [N, …] with rows {leaf.shape[1:]}; got {arrays[name].shape}")
        return jax.tree.unflatten(treedef, [jnp.asarray(arrays[name]) for name in names]), layout

    def first_rows(self, params: Any, layout: Any, num: int) -> tuple[Any, Any]:
        """Return parameters, or moments of them, and layout of the first `num` rows (host).

        Buffers have the sizes that `from_arrays` gives them.
        """
        return jax.tree.map(lambda x: x[:num], params), layout

    def take_rows(self, params: Any, layout: Any, rows: np.ndarray) -> tuple[Any, Any]:
        """Return the parameters and layout of the given rows, indices of Gaussians that may repeat (host)."""
        self._check_no_layout(layout)
        return jax.tree.map(lambda x: x[rows], params), layout

    def joined(self, parts: Sequence[tuple[Any, Any]]) -> tuple[Any, Any]:
        """Return the parameters and layout of several, given as (params, layout), one after the other (host)."""
        for _, layout in parts:
            self._check_no_layout(layout)
        return jax.tree.map(lambda *x: jnp.concatenate(x), *(params for params, _ in parts)), parts[0][1]

    def _check_no_layout(self, layout: Any) -> None:
        if jax.tree.leaves(layout):
            raise NotImplementedError(f"{type(self).__name__} has a layout: it must define take_rows and joined itself")

    def check(self, params: Any, layout: Any, gaussians: Gaussians) -> None:
        """Raise ValueError unless parameters and layout fit the Gaussians (host)."""
        num, kind = gaussians.num, type(self).__name__
        for leaf in jax.tree.leaves(params):
            if str(leaf.dtype) not in FLOATS:
                raise ValueError(f"the parameters of {kind} must be floats, {' or '.join(FLOATS)}; got {leaf.dtype}")
        has_rows = not jax.tree.leaves(layout)
        found = {leaf.shape[0] for leaf in jax.tree.leaves(params)} if has_rows else {getattr(layout, "num", num)}
        if found - {num}:
            raise ValueError(f"{kind} has {min(found - {num})} rows, but there are {num} Gaussians")
        if isinstance(params, Textures) and isinstance(layout, AtlasLayout):
            check_textures(params, layout, num)
            check_places(params, layout)


def parameter_shapes(appearance: Any) -> tuple[Any, Any]:
    """Return the shapes of the parameters, and the layout, that an appearance allocates for one Gaussian."""

    def row(*shape: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((1, *shape), jnp.float32)

    gaussians: Any = Gaussians(row(3), row(4), row(2), row(), row(16, 3))  # type: ignore[arg-type]
    shapes: tuple[Any, Any] = jax.eval_shape(appearance.allocate, jax.eval_shape(lambda: jax.random.key(0)), gaussians)
    return shapes


def check_given(appearance: Any, params: Any) -> None:
    """Raise ValueError if there are no parameters, `()`, of an appearance that has some."""
    if type(params) is tuple and not params and _has_parameters(appearance):
        kind = type(appearance).__name__
        raise ValueError(
            f"model.params must be those of the appearance {kind}; got (): say params, layout = appearance.allocate("
            f"key, gaussians), and Model(gaussians, params, layout, appearance=appearance)"
        )


def _has_parameters(appearance: Any) -> bool:
    """Return whether an appearance allocates parameters; False if that cannot be told without values."""
    try:
        return _allocates(appearance)
    except Exception:  # `allocate` of a class of one's own may raise anything, and a field may have no hash.
        return False


@functools.lru_cache(maxsize=64)
def _allocates(appearance: Any) -> bool:
    return str(jax.tree.structure(parameter_shapes(appearance)[0])) != str(jax.tree.structure(()))


def _name(path: tuple[Any, ...]) -> str:
    """Return a leaf's name in a file, such as "kernels.centers"."""
    return jax.tree_util.keystr(path, simple=True, separator=".")
