"""Base class of appearances whose parameters are `Textures`: moving rows, and arrays for files.

`Textured` and `Billboards` derive from it; `texture` manages the buckets.
"""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance.base import Appearance
from a2tg_jax.core.spread_arrays import rows_moved
from a2tg_jax.texture import (
    MAX_SIDE,
    AtlasLayout,
    Textures,
    first_textures,
    packed_textures,
    texture_arrays,
    textures_from_arrays,
)


@dataclasses.dataclass(frozen=True)
class Bucketed(Appearance):
    """Image for each splat: `params` are `Textures`, `layout` is their `AtlasLayout`."""

    def gather(self, params: Textures, layout: AtlasLayout, rows: Array) -> Textures:
        (bucket,) = self.only(params)
        spare = jnp.arange(len(rows), len(bucket), dtype=jnp.int32)
        return Textures((rows_moved(bucket, jnp.concatenate([jnp.asarray(rows, jnp.int32), spare])),))

    def clear(self, params: Textures, layout: AtlasLayout, is_cleared: Array) -> Textures:
        (bucket,) = self.only(params)
        is_cleared = jnp.pad(is_cleared, (0, bucket.shape[0] - is_cleared.shape[0]))
        return Textures((jnp.where(is_cleared[:, None, None, None], jnp.zeros_like(bucket), bucket),))

    def first_rows(self, params: Textures, layout: AtlasLayout, num: int) -> tuple[Textures, AtlasLayout]:
        return packed_textures(params, layout) if num == layout.num else first_textures(params, layout, num)

    def take_rows(self, params: Textures, layout: AtlasLayout, rows: np.ndarray) -> tuple[Textures, AtlasLayout]:
        arrays = texture_arrays(params, layout)
        return textures_from_arrays([arrays[row] for row in rows])

    def joined(self, parts: Sequence[tuple[Textures, AtlasLayout]]) -> tuple[Textures, AtlasLayout]:
        return textures_from_arrays([array for part in parts for array in texture_arrays(*part)])

    def textures(self, params: Textures, layout: AtlasLayout) -> tuple[Textures, AtlasLayout]:
        return params, layout

    def with_textures(
        self, params: Textures, layout: AtlasLayout, textures: Textures, atlas: AtlasLayout
    ) -> tuple[Textures, AtlasLayout]:
        return textures, atlas

    def arrays(self, params: Textures, layout: AtlasLayout) -> dict[str, np.ndarray]:
        """Return `sizes` [N, 2] as (Tv, Tu), and `texels` [M, 4], texture after texture, row by row."""
        texels = [array.reshape(-1, 4) for array in texture_arrays(params, layout)]
        return {"sizes": layout.sizes, "texels": np.concatenate(texels) if texels else np.zeros((0, 4), np.float32)}

    def from_arrays(self, arrays: dict[str, np.ndarray]) -> tuple[Textures, AtlasLayout]:
        missing = [name for name in ("sizes", "texels") if name not in arrays]
        if missing:
            raise ValueError(f"the array {missing[0]} of textures is missing")
        sizes, texels = arrays["sizes"], arrays["texels"]
        is_size = sizes.ndim == 2 and sizes.shape[1] == 2 and np.issubdtype(sizes.dtype, np.integer)
        if not is_size or (sizes.size and not 0 <= sizes.min() <= sizes.max() <= MAX_SIDE):
            raise ValueError(f"sizes must be integers [N, 2] in 0..{MAX_SIDE}; got {sizes.dtype} {sizes.shape}")
        if texels.shape != (int(np.prod(sizes, axis=1).sum()), 4):
            raise ValueError(f"sizes [N, 2] and texels [M, 4] disagree; got {sizes.shape} and {texels.shape}")
        pieces = np.split(texels, np.cumsum(sizes.prod(axis=1))[:-1]) if len(sizes) else []
        return textures_from_arrays([piece.reshape(*size, 4) for piece, size in zip(pieces, sizes, strict=True)])

    def only(self, params: Textures) -> tuple[Array]:
        """Return the one bucket of images of one size. Raise ValueError if there are several sizes."""
        if len(params.buckets) != 1:
            raise ValueError(
                f"textures of {len(params.buckets)} sizes cannot change rows: densify and prune before they grow"
            )
        return params.buckets
