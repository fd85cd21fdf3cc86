"""Appearances: what a model's splats show, as a static value that allocates, projects, counts and moves parameters.

An appearance is hashable and holds options only. Its parameters travel beside it: `params`, a pytree of float arrays
that training differentiates, and `layout`, integers beside them.

    params, layout = appearance.allocate(key, gaussians)
    rule = appearance.rule(params, layout)          # what the renderer is given
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance.copies import share
from a2tg_jax.appearance.rule import AppearanceRule
from a2tg_jax.core.gaussians import Gaussians, logit
from a2tg_jax.texture import AtlasLayout, Textures


@dataclasses.dataclass(frozen=True)
class Appearance:
    """What splats show. The defaults suit an appearance whose parameters have one row per Gaussian and no layout."""

    def allocate(self, key: Array, gaussians: Gaussians) -> tuple[Any, Any]:
        """Initial parameters and layout for N Gaussians (host)."""
        return (), ()

    def rule(self, params: Any, layout: Any) -> AppearanceRule:
        """What the renderer is given; traceable, and differentiable in `params`."""
        raise NotImplementedError(f"{type(self).__name__} must say which appearance rule shows it")

    def project(self, params: Any) -> Any:
        """The parameters moved to where they are allowed, after an update; traceable."""
        return params

    def rates(self, rate: Any, params: Any) -> Any:
        """Adam's learning rates, a prefix of the parameters' tree, given what a stage says of them; traceable."""
        return rate

    def num_floats(self, layout: Any, num: int) -> int:
        """Trained floats of what `num` live Gaussians show, their own and padding left out (host)."""
        per_row = sum(np.prod(leaf.shape[1:], dtype=int) for leaf in jax.tree.leaves(self._shapes(1)[0]))
        return int(per_row) * num

    def num_published_floats(self, layout: Any, num: int) -> int:
        """Floats as the method's authors count them (host)."""
        return self.num_floats(layout, num)

    # What densification asks for: rows change places, share what they show, or fade.

    def gather(self, params: Any, layout: Any, rows: Array) -> Any:
        """Parameters, or moments of them, whose row i is the former row rows[i] of N; traceable."""
        return jax.tree.map(lambda x: x[rows], params)

    def clear(self, params: Any, layout: Any, is_cleared: Array) -> Any:
        """Moments with the marked rows [N] at zero; traceable."""
        zeroed = lambda x: jnp.where(is_cleared.reshape(-1, *[1] * (x.ndim - 1)), jnp.zeros_like(x), x)  # noqa: E731
        return jax.tree.map(zeroed, params)

    def share(self, gaussians: Gaussians, params: Any, layout: Any, num_shares: Array) -> tuple[Gaussians, Any]:
        """Each row as one of num_shares [N] coincident copies that together look like it; traceable."""
        opacities, scales = share(gaussians.logit_opacities, gaussians.log_scales, num_shares)
        return dataclasses.replace(gaussians, logit_opacities=opacities, log_scales=scales), params

    def opacities(self, gaussians: Gaussians, params: Any, layout: Any) -> Array:
        """[N] how opaque densification takes the splats to be; traceable."""
        return gaussians.opacities

    def limit_opacities(self, gaussians: Gaussians, params: Any, layout: Any, most: Array) -> tuple[Gaussians, Any]:
        """Gaussians and parameters of splats that are no more opaque than `most`; traceable."""
        limited = jnp.minimum(gaussians.logit_opacities, logit(jnp.asarray(most, gaussians.means.dtype)))
        return dataclasses.replace(gaussians, logit_opacities=limited), params

    def first_rows(self, params: Any, layout: Any, num: int) -> tuple[Any, Any]:
        """Parameters, or moments of them, and layout of the first `num` rows, in the room that `from_arrays` makes
        (host)."""
        return jax.tree.map(lambda x: x[:num], params), layout

    def sh(self, gaussians: Gaussians, params: Any, layout: Any) -> np.ndarray:
        """[N, K, 3] all spherical-harmonic coefficients, zeros for what a Gaussian lacks (host)."""
        return np.asarray(gaussians.sh)

    def with_sh(self, sh: np.ndarray, params: Any, layout: Any) -> Any:
        """The parameters with other coefficients, as `sh` gives them; those of the Gaussians are not its (host)."""
        return params

    def textures(self, params: Any, layout: Any) -> tuple[Textures, AtlasLayout] | None:
        """Its textures and their layout; None where it has none."""
        return None

    def with_textures(self, params: Any, layout: Any, textures: Textures, atlas: AtlasLayout) -> tuple[Any, Any]:
        """Parameters and layout with other textures."""
        return params, layout

    # Files.

    def arrays(self, params: Any, layout: Any) -> dict[str, np.ndarray]:
        """Named arrays from which `from_arrays` makes parameters and layout again, without padding (host)."""
        leaves = jax.tree_util.tree_flatten_with_path(params)[0]
        return {_name(path): np.asarray(leaf) for path, leaf in leaves}

    def from_arrays(self, arrays: dict[str, np.ndarray]) -> tuple[Any, Any]:
        """What `arrays` was given.

        Raises:
          ValueError: if an array is missing or of another shape than its neighbours.
        """
        shapes, layout = self._shapes(1)
        leaves, treedef = jax.tree_util.tree_flatten_with_path(shapes)
        names = [_name(path) for path, _ in leaves]
        missing = [name for name in names if name not in arrays]
        if missing:
            raise ValueError(f"the array {missing[0]} of {type(self).__name__} is missing")
        for name, (_, leaf) in zip(names, leaves, strict=True):
            if arrays[name].shape[1:] != leaf.shape[1:]:
                raise ValueError(f"{name} must be [N, …] with rows {leaf.shape[1:]}; got {arrays[name].shape}")
        return jax.tree.unflatten(treedef, [jnp.asarray(arrays[name]) for name in names]), layout

    def _shapes(self, num: int) -> tuple[Any, Any]:
        """Shapes of the parameters, and the layout, of `num` Gaussians."""
        row = lambda *shape: jax.ShapeDtypeStruct((num, *shape), jnp.float32)  # noqa: E731
        gaussians: Any = Gaussians(row(3), row(4), row(2), row(), row(16, 3))  # type: ignore[arg-type]
        return jax.eval_shape(self.allocate, jax.eval_shape(lambda: jax.random.key(0)), gaussians)


def _name(path: tuple) -> str:
    """A leaf's name in a file, such as "kernels.centers"."""
    return jax.tree_util.keystr(path, simple=True, separator=".")
