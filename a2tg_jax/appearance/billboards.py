"""The appearance of BBSplat: flat RGBA pictures, whose alpha takes the place of opacity and Gaussian.

A picture of S × S texels covers u and v from −1 to 1, in standard deviations: texel (x, y) lies at u = 2x/(S − 1) − 1,
v likewise, the outer ones on the border. It is looked up bilinearly among zeros, so that it fades out over one texel
beyond the border:

    α = min(max_alpha, A(u, v)),   colour = SH colour + RGB(u, v) − initial RGB

There is no low-pass filter. RGB is the sigmoid of the trained numbers. The authors lower the first SH coefficient so
that the initial colours stay; here the rule subtracts the initial RGB, and the Gaussians stay unchanged.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance.bucketed import Bucketed
from a2tg_jax.appearance.rule import AppearanceRule, Factor, Residual
from a2tg_jax.core.bilinear import TextureRegion
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.numerics import safe_divide
from a2tg_jax.core.pytree import pytree
from a2tg_jax.texture import MAX_SIDE, AtlasLayout, Textures, allocate_textures, nearest_places

INITIAL_PEAK, INITIAL_SIGMA = 0.5, 0.3
"""Peak and σ, in units of u, of the initial alpha picture; it falls to an invisible 0.002 at the border."""
LEAST_PEAK = 0.999 / 255


@pytree
class BillboardRule(AppearanceRule):
    """Appearance rule: RGB residual and alpha from each splat's own picture."""

    texels: Array
    """[T, 4] texels of all pictures, RGB in (0, 1) and alpha."""
    first: Array
    """[N] first texel of each picture."""
    peaks: Array
    """[N] largest alpha of each picture; only for bounds, without gradient."""
    side: int = dataclasses.field(metadata={"static": True})
    """Side S of a picture in texels."""
    initial_rgb: float = dataclasses.field(metadata={"static": True})
    """Initial RGB, which is subtracted."""
    max_alpha: float = dataclasses.field(default=0.99, metadata={"static": True})
    has_low_pass: bool = dataclasses.field(default=False, metadata={"static": True})

    @property
    def regions(self) -> TextureRegion:  # type: ignore[override]
        side = jnp.full_like(self.first, self.side)
        return TextureRegion(self.first, side, side)

    def opacities(self, gaussians: Gaussians) -> Array:
        return jnp.ones(gaussians.num, gaussians.means.dtype)

    def texel_position(self, region: TextureRegion, u: Array, v: Array) -> tuple[Array, Array]:
        return jnp.clip(self._place(u), 0.0, self.side - 1.0), jnp.clip(self._place(v), 0.0, self.side - 1.0)

    def shade(
        self, numbers: tuple[Array, ...], values: tuple[Array, ...], u: Array, v: Array
    ) -> tuple[Residual, Factor]:
        *rgb, alpha = values
        inside = self._inside(u) * self._inside(v)
        red, green, blue = (inside * channel - self.initial_rgb for channel in rgb)
        return (red, green, blue), inside * alpha

    def falloff(self, numbers: tuple[Array, ...], rho: Array) -> Array:
        return jnp.ones_like(rho)

    def cutoff(self, opacities: Array) -> Array:
        """Return the circle around the picture, border included."""
        half_side = 1 + 2 / (self.side - 1)
        return jnp.where(opacities * self.peaks >= LEAST_PEAK, 2 * half_side * half_side, -1.0)

    def _place(self, u: Array) -> Array:
        """Return the position of u along an axis, in texels."""
        return (u + 1) * ((self.side - 1) / 2)

    def _inside(self, u: Array) -> Array:
        """Return the factor that makes a clamped lookup one among zeros: 1 up to the outer texels, 0 from one texel
        beyond."""
        x = self._place(u)
        return jnp.clip(1 - jnp.maximum(-x, x - (self.side - 1.0)), 0.0, 1.0)


@dataclasses.dataclass(frozen=True)
class Billboards(Bucketed):
    """Picture for each splat: `params` are `Textures` of one size, raw RGB and alpha; `layout` is their layout."""

    side: int = 16
    """Side S of a picture in texels, 2 to 16."""
    initial_rgb: float = 0.1
    """Initial RGB, in (0, 1)."""
    max_alpha: float = 0.99
    """Upper limit of alpha."""
    has_low_pass = False

    def __post_init__(self) -> None:
        if not 2 <= self.side <= MAX_SIDE:
            raise ValueError(f"side must lie in 2..{MAX_SIDE}; got {self.side}")
        if not 0 < self.initial_rgb < 1:
            raise ValueError(f"initial_rgb must lie in (0, 1); got {self.initial_rgb}")

    def allocate(self, key: Array, gaussians: Gaussians) -> tuple[Textures, AtlasLayout]:
        """Return pictures of a Gaussian, half opaque in the middle, that do not change the splats' colour."""
        textures, layout = allocate_textures(np.full((gaussians.num, 2), self.side), dtype=gaussians.means.dtype)
        along = np.exp(-0.5 * (np.linspace(-1, 1, self.side) / INITIAL_SIGMA) ** 2)
        picture = np.full((self.side, self.side, 4), np.log(self.initial_rgb / (1 - self.initial_rgb)))
        picture[..., 3] = INITIAL_PEAK * np.outer(along, along)
        filled = lambda texels: jnp.broadcast_to(jnp.asarray(picture, texels.dtype)[None], texels.shape)  # noqa: E731
        return jax.tree.map(filled, textures), layout

    def rule(self, params: Textures, layout: AtlasLayout) -> BillboardRule:
        (bucket,) = self.only(params)
        layout = nearest_places(params, layout)
        shown = jnp.concatenate([jax.nn.sigmoid(bucket[..., :3]), bucket[..., 3:]], axis=-1)
        peaks = jax.lax.stop_gradient(jnp.max(bucket[..., 3], axis=(1, 2)))[layout.row]
        first = layout.row * jnp.int32(self.side**2)
        return BillboardRule(shown.reshape(-1, 4), first, peaks, self.side, self.initial_rgb, self.max_alpha)

    def project(self, params: Textures) -> Textures:
        """Return pictures with alpha clamped to [0, `max_alpha`]: above it nothing would ever fade again."""
        return self._with_alpha(params, lambda alpha: jnp.clip(alpha, 0.0, self.max_alpha))

    def rates(self, rate: tuple[float, float], params: Textures) -> Array:
        """Return the rates of RGB and alpha, given as a pair."""
        rgb, alpha = rate
        return jnp.full((1, 1, 1, 4), rgb).at[..., 3].set(alpha)

    def num_floats(self, layout: AtlasLayout, num: int) -> int:
        """Return 4·S² − 1 per splat, beside the Gaussian's own: its opacity is not trained."""
        return (4 * self.side**2 - 1) * num

    def opacities(self, gaussians: Gaussians, params: Textures, layout: AtlasLayout) -> Array:
        """Return the mean alpha [N] of the texels."""
        return self._means(params)[: gaussians.num]

    def limit_opacities(
        self, gaussians: Gaussians, params: Textures, layout: AtlasLayout, most: Array
    ) -> tuple[Gaussians, Textures]:
        """Fade pictures whose mean alpha is larger than `most`, by one factor each."""
        fading = jnp.minimum(safe_divide(jnp.asarray(most, params.buckets[0].dtype), self._means(params), 1.0), 1.0)
        return gaussians, self._with_alpha(params, lambda alpha: alpha * fading[:, None, None])

    def share(
        self, gaussians: Gaussians, params: Textures, layout: AtlasLayout, num_shares: Array
    ) -> tuple[Gaussians, Textures]:
        """Return texels such that n coincident pictures are as opaque as one was; scales stay unchanged."""
        (bucket,) = self.only(params)
        num_shares = jnp.pad(num_shares, (0, bucket.shape[0] - gaussians.num), constant_values=1)
        exponents = (1 / num_shares.astype(bucket.dtype))[:, None, None]
        return gaussians, self._with_alpha(params, lambda alpha: 1 - (1 - alpha) ** exponents)

    def from_arrays(self, arrays: dict[str, np.ndarray]) -> tuple[Textures, AtlasLayout]:
        params, layout = super().from_arrays(arrays)
        if not np.all(layout.sizes == self.side):
            raise ValueError(f"sizes must all be ({self.side}, {self.side}); got {layout.resolutions}")
        return params, layout

    def _means(self, params: Textures) -> Array:
        """Return the mean alphas [capacity]."""
        return jnp.mean(self.only(params)[0][..., 3], axis=(1, 2))

    def _with_alpha(self, params: Textures, change: Callable[[Array], Array]) -> Textures:
        (bucket,) = self.only(params)
        return Textures((bucket.at[..., 3].set(change(bucket[..., 3])),))
