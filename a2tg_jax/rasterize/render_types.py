"""Options of a rendering and its images: what `render_image` takes and returns."""

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jax import Array

from a2tg_jax.appearance import TextureOptions
from a2tg_jax.core.checks import check_int, check_kind, check_number
from a2tg_jax.core.display import as_bytes, enlarged, png, short_tuple_repr
from a2tg_jax.core.pixel_sizes import NEAR_PLANE
from a2tg_jax.core.similarity import Similarity
from a2tg_jax.rasterize.exchange import Exchange
from a2tg_jax.rasterize.kernels.choice import MAX_TILE_SIZE
from a2tg_jax.rasterize.splats import Wanted

IMAGES = ("color", "alpha", "depth", "normal", "distortion")
"""Fields of `RenderOutput` that are images."""
GEOMETRY = IMAGES[2:]
"""Images that are rendered on demand (`has_geometry`)."""


@dataclasses.dataclass(frozen=True)
class RenderSettings:
    """Static options of a rendering; hashable, so that jit can close over them or take them as static."""

    tile_size: int = 8
    """Side of a tile in pixels, 1 to 64; it does not change the image."""
    near_plane: float = NEAR_PLANE
    """Least depth of visible splats and hits, in units of the world; positive. If you scale the world, scale near_plane
    by the same factor (`transform`)."""
    sh_degree: int = 3
    """Highest degree of spherical harmonics used, 0 to 3."""
    texture: TextureOptions = dataclasses.field(default_factory=TextureOptions)
    """Texture options for Gaussians and textures given apart (`render_image`, `plan_render`, `evaluate`).

    A `Model` and a rule have their own options; this field is then not used."""
    capacity: int | None = None
    """Largest number of (splat, tile) pairs, at least 1, as `plan_render` finds it. None: an eager call finds it, jit
    raises. If it is too small, the image is only the background and `overflow` is True; an eager call then warns."""
    compositor: Wanted = "auto"
    """Native loops (CPUs, with llvmlite), CUDA kernels (NVIDIA GPUs) or XLA. "auto" takes the first available one,
    and XLA with a warning if the others do not support the appearance rule. These are differentiated once, in reverse
    mode; "autodiff", slower and by XLA, in any mode and to any order."""
    tile_batch: int | None = None
    """Number of tiles that XLA composites at once; 0: all. None: 1 on CPUs, 4096 elsewhere."""
    supersample: int = 1
    """Factor k by which views are drawn larger; each pixel is the mean over k × k. It lets a model be seen much smaller
    than it was trained without aliasing, at k² times the cost."""
    exchange: Exchange | None = None
    """Devices that render together, an image or several at once (`exchange_among`); None: one."""

    def __post_init__(self) -> None:
        """Refuse numbers out of range; convert numpy's integers to Python's, which are static for jit."""
        check_number("near_plane", self.near_plane, above=0)
        check_kind("texture", self.texture, TextureOptions)
        if self.exchange is not None:
            check_kind("exchange", self.exchange, Exchange)
        for name, least, most in (("tile_size", 1, MAX_TILE_SIZE), ("sh_degree", 0, 3), ("supersample", 1, None)):
            check_int(name, getattr(self, name), least, most)
        for name, least in (("capacity", 1), ("tile_batch", 0)):
            if getattr(self, name) is not None:
                check_int(name, getattr(self, name), least, otherwise=", or None")
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.integer):
                object.__setattr__(self, field.name, int(value))

    def transform(self, similarity: Similarity) -> "RenderSettings":
        """Return settings that show a model in the world of `similarity` as these show it in its own."""
        return dataclasses.replace(self, near_plane=self.near_plane * similarity.scale)

    @staticmethod
    def official() -> "RenderSettings":
        """Return settings with the texture conventions of the authors' program."""
        return RenderSettings(texture=TextureOptions.official())


class NotRenderedError(ValueError, AttributeError):
    """Depth, normal or distortion of a render without geometry was read; for `hasattr` there is no such attribute."""


class RenderOutput(NamedTuple):
    """Images of a view. Depth and normal are weighted sums, not divided by alpha, without the background.

    A render with `has_geometry=False` has None in place of depth, normal and distortion, and reading them raises
    `NotRenderedError`, a ValueError.
    """

    color: Array
    """[H, W, 3], background included, not clipped; or [H, W, D] features."""
    alpha: Array
    """[H, W] in [0, 1], 1 − the final transmittance."""
    depth: Array
    """[H, W] Σ z·α·T."""
    normal: Array
    """[H, W, 3] Σ n·α·T, in the world, facing the camera."""
    overflow: Array
    """Whether the capacity was too small; the image is then only the background and must not be used. Eager calls
    warn of it (`CapacityWarning`), jitted ones cannot."""
    distortion: Array
    """[H, W] the depth distortion of 2DGS, Σ_ij w_i w_j (z_i − z_j)² / 2, in world units squared."""

    def __getattribute__(self, name: str) -> Any:
        value = tuple.__getattribute__(self, name)
        if value is None and name in GEOMETRY:
            raise NotRenderedError(
                f"{name} was not rendered: say has_geometry=True, as in Term(function, has_geometry=True) for a loss "
                "term of your own"
            )
        return value

    def __repr__(self) -> str:
        return short_tuple_repr(self)

    def _repr_png_(self) -> bytes | None:
        """Return the colour as a PNG file for notebooks; None for several views, or under a transformation."""
        pixels = as_bytes(self.color)
        return None if pixels is None else png(enlarged(pixels))
