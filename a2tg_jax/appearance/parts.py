"""Optional parts of an appearance: a texture, the exponents of kernels, bands of spherical harmonics.

The base class `Part`, then the texture of A²TG, kernels with an exponent per Gaussian (and the Gaussian nearest to
each), and spherical harmonics with a degree per Gaussian.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any, ClassVar, Literal, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike, DTypeLike

from a2tg_jax.base.checks import check_fields, check_shape
from a2tg_jax.base.config_json import check_config
from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.core.bilinear import TextureRegion
from a2tg_jax.core.gaussians import LARGEST_OPACITY, Gaussians, logit
from a2tg_jax.core.numerics import Integer, within
from a2tg_jax.core.pytree import pytree, static
from a2tg_jax.core.sh import NUM_BASES, directions_from, sh_basis
from a2tg_jax.core.table import Places, Size, Table, check_places, check_table
from a2tg_jax.texture import NEUTRAL_TEXEL, Textures, allocate_textures, check_textures


class Part(NamedFields):
    """Part of an appearance: static options, and arrays with a row for each Gaussian, None until they are allocated."""

    names_in_files: ClassVar[tuple[str, ...]]
    """Names of its arrays in files (`appearance.files`)."""

    def allocate(self, gaussians: Gaussians) -> Self:
        """Return the part with initial arrays for N Gaussians (host)."""
        raise NotImplementedError

    def project(self) -> Self:
        """Return the part with its numbers projected onto their ranges after an update; traceable."""
        return self

    def rates(self, rate: object) -> Any:
        """Return Adam's learning rates, a prefix of the part's tree of floats."""
        return rate

    def check(self, gaussians: Gaussians) -> None:
        """Raise ValueError unless the arrays fit the Gaussians (host)."""


Residual = tuple[Array, ...] | None
"""Added to the D colours; None: 0."""
Factor = Array | None
"""Multiplies alpha; None: 1."""
Tint = tuple[Array, ...] | None
"""Multiplies the splat's own D colours, before the residual is added; None: 1."""
Shading = tuple[Residual, Factor] | tuple[Residual, Factor, Tint]
"""Result of `Appearance.shade`."""


# The texture of A²TG: where (u, v) is in a splat's texture, and how its RGB and alpha change the splat. `texture`
# stores textures, `core.bilinear` interpolates them. The renderer gets all of them one after the other as texels
# [T, 4], each row by row.

LEAST_EXTENT = 1e-3
"""Least half side of a texture, for which float32 still keeps lookups exact."""
MOST_EXTENT = 1e3
"""Largest half side of a texture, wider than any kernel."""


@dataclasses.dataclass(frozen=True)
class TextureOptions(NamedFields):
    """Conventions of textures. The defaults follow the paper's text, `official()` the authors' program."""

    uv: Literal["texel-centre", "align-corners"] = "texel-centre"
    """Place of the texels: centres at half-texel offsets over ±extent, or the outer ones exactly at ±extent."""
    outside: Literal["clamp", "identity"] = "clamp"
    """Texture beyond ±extent: the edge texel continues, or nothing shows (RGB 0, alpha 1)."""
    rgb: Literal["signed", "unit"] = "signed"
    """RGB residuals of either sign, or clipped to [0, 1]."""
    uv_gradient: bool = True
    """Whether gradients flow through the lookup position into the geometry."""
    initial_rgb: float = 0.0
    """Initial RGB."""
    alpha: Literal["projected", "global-maximum"] = "projected"
    """Alpha factors clamped to [0, 1] after each update; or any numbers, divided by the largest of all textures and
    clipped to [0, 1] when shown."""
    max_alpha: float = 0.99
    """Upper limit of a splat's alpha."""
    extent: float = 3.0
    """Half the side of a texture in standard deviations, 0.001 to 1000; the paper's is 3."""

    def __post_init__(self) -> None:
        """Check the conventions and the extent."""
        check_config(self)
        check_fields(self, "extent", least=LEAST_EXTENT, most=MOST_EXTENT)

    def check_options(self) -> None:
        """Raise ValueError, beginning with the name of the field, if a number is out of range."""
        check_fields(self, "initial_rgb", least=-1, most=1)
        check_fields(self, "max_alpha", least=1e-3, most=0.9999)

    @staticmethod
    def official() -> "TextureOptions":
        """Return the conventions of the authors' program."""
        return TextureOptions("align-corners", "identity", "unit", False, 0.1, "global-maximum", max_alpha=0.999)


class TexelRates(NamedTuple):
    """Learning rates of texels by the size of their texture."""

    larger: Any
    """Rate of textures of more than one texel."""
    single: Any
    """Rate of textures of one texel, which only change the colour and opacity of their Gaussian."""


@pytree
class Texture(Part):
    """RGB residual and alpha factor from a texture of each splat."""

    texels: Textures | None = None
    """Textures of N Gaussians; None until allocated."""
    start: tuple[int, int] = static(default=(1, 1))
    """Initial (Tv, Tu) of every texture, each 1 to 16; (0, 0): no textures until they grow."""
    options: TextureOptions = static(default=TextureOptions())
    """Conventions of the textures."""

    names_in_files = ("sizes", "texels")

    def allocate(self, gaussians: Gaussians) -> "Texture":
        sizes = np.broadcast_to(np.asarray(self.start, np.int64), (gaussians.num, 2))
        texels = allocate_textures(sizes, rgb=self.options.initial_rgb, dtype=gaussians.means.dtype)
        return dataclasses.replace(self, texels=texels)

    def check(self, gaussians: Gaussians) -> None:
        assert self.texels is not None
        check_textures(self.texels, gaussians.num)
        check_places(self.texels)

    def rates(self, rate: object) -> Any:
        """Return one rate for all texels, or `TexelRates`."""
        if not isinstance(rate, TexelRates):
            return rate
        assert self.texels is not None
        is_single = [size == (1, 1) for size in self.texels.bucket_sizes]
        buckets = tuple(rate.single if single else rate.larger for single in is_single)
        return dataclasses.replace(self, texels=dataclasses.replace(self.texels, buckets=buckets))

    def project(self) -> "Texture":
        """Return textures with alpha factors clamped to [0, 1], and RGB as well if it is unsigned."""
        # Clips what `shown` clips, which changes no image: gradients are 0 beyond the bounds, and texels could not
        # return. Alpha that is divided by its maximum has no upper bound.
        options = self.options
        most_alpha = jnp.inf if options.alpha == "global-maximum" else 1.0
        least, most = (0.0, 1.0) if options.rgb == "unit" else (-jnp.inf, jnp.inf)
        assert self.texels is not None
        bounds = jnp.asarray([[least] * 3 + [0.0], [most] * 3 + [most_alpha]], self.texels.buckets[0].dtype)
        buckets = tuple(jnp.clip(texels, *bounds[:, None, None, None]) for texels in self.texels.buckets)
        return dataclasses.replace(self, texels=dataclasses.replace(self.texels, buckets=buckets))

    def shown(self) -> Textures:
        """Return RGB residuals and alpha factors as they are shown. Buckets and rows out of range are clamped."""
        assert self.texels is not None
        textures = self.texels.nearest_places()
        options = self.options
        if options.rgb == "signed" and options.alpha == "projected":
            return textures
        divisor = None
        if options.alpha == "global-maximum":
            # The largest alpha without padding; 1 if all textures are empty. Several equal maxima share the gradient.
            alphas = [] if any(bucket.size for bucket in textures.buckets) else [jnp.ones(1, textures.buckets[0].dtype)]
            for index, bucket in enumerate(textures.buckets):
                num_used = jnp.sum(textures.bucket == index, dtype=jnp.int32)
                is_used = jnp.arange(bucket.shape[0], dtype=jnp.int32) < num_used
                alphas.append(jnp.where(is_used[:, None, None], bucket[..., 3], -jnp.inf).reshape(-1))
            divisor = jnp.max(jnp.concatenate(alphas)) + 1e-6

        def shown(texels: Array) -> Array:
            rgb = texels[..., :3]
            alpha = texels[..., 3:]
            rgb = within(rgb, 0.0, 1.0) if options.rgb == "unit" else rgb
            alpha = alpha if divisor is None else within(alpha / divisor, 0.0, 1.0)
            return jnp.concatenate([rgb, alpha], axis=-1)

        return dataclasses.replace(textures, buckets=tuple(map(shown, textures.buckets)))

    def atlas(self) -> tuple[Array, TextureRegion]:
        """Return all texels [T, 4], and the N places of the textures among them; an empty texture has no texels."""
        textures = self.shown()
        # Buckets follow each other; a texture begins at its bucket's start plus its row times the area.
        areas = [height * width for height, width in textures.bucket_sizes]
        capacities = [bucket.shape[0] for bucket in textures.buckets]
        starts = np.cumsum([0] + [capacity * area for capacity, area in zip(capacities, areas, strict=True)])[:-1]
        bucket_starts = jnp.asarray(starts, jnp.int32)
        bucket_areas = jnp.asarray(areas, jnp.int32)
        sizes = jnp.asarray(textures.bucket_sizes, jnp.int32)[textures.bucket]
        offsets = bucket_starts[textures.bucket] + textures.row * bucket_areas[textures.bucket]
        texels = [bucket.reshape(-1, 4) for bucket in textures.buckets if bucket.size]
        none = jnp.asarray([NEUTRAL_TEXEL], textures.buckets[0].dtype)
        return jnp.concatenate(texels or [none]), TextureRegion(offsets, sizes[:, 0], sizes[:, 1])

    def peaks(self) -> Array:
        """Return the largest alpha factor [N] of each splat; only for bounds, without gradient."""
        textures = self.shown()
        most = max(map(len, textures.buckets))
        columns = []
        for bucket in textures.buckets:  # 1 of an empty texture, 0 past the capacity.
            largest = jnp.max(bucket[..., 3], axis=(1, 2)) if bucket.size else jnp.ones(most, bucket.dtype)
            columns.append(jnp.pad(largest, (0, most - len(largest))))
        peaks = jnp.stack(columns)
        peaks = jax.lax.stop_gradient(peaks[textures.bucket, textures.row])
        # Outside a texture with this option the factor is 1.
        return jnp.maximum(peaks, 1.0) if self.options.outside == "identity" else peaks

    # Element-wise, without the texels

    def position(self, region: TextureRegion, u: Array, v: Array) -> tuple[Array, Array]:
        """Return the lookup position (x, y) in texels, clamped to [0, width − 1] and [0, height − 1]."""
        if not self.options.uv_gradient:
            u, v = jax.lax.stop_gradient((u, v))
        width = region.width.astype(u.dtype)
        height = region.height.astype(v.dtype)
        return texel_coordinates(u, width, self.options), texel_coordinates(v, height, self.options)

    def shade(self, values: tuple[Array, ...], u: Array, v: Array) -> tuple[Residual, Factor]:
        """Return colour residual and alpha factor at (u, v), from the four values looked up there."""
        red, green, blue, alpha = values
        if self.options.outside == "identity":
            extent = self.options.extent
            is_inside = (jnp.abs(u) <= extent) & (jnp.abs(v) <= extent)
            red, green, blue = (jnp.where(is_inside, channel, 0.0) for channel in (red, green, blue))
            alpha = jnp.where(is_inside, alpha, 1.0)
        return (red, green, blue), alpha


def texel_coordinates(u: Array, size: Array, options: TextureOptions) -> Array:
    """Return the position of u, in standard deviations, among the `size` texels of its axis, in [0, size − 1]."""
    unit = (u * (1 / options.extent) + 1) * 0.5
    x = unit * (size - 1) if options.uv == "align-corners" else unit * size - 0.5
    return jnp.clip(x, 0.0, size - 1)


# Kernels with an exponent per Gaussian, instead of the Gaussian falloff. A generalised Gaussian has an exponent β:
# β = 1 is the Gaussian, a larger one is flat in the middle and ends at an edge, a smaller one is peaked and has long
# tails (GES, Hamdi et al., 2024). At squared distance ρ, in standard deviations, the falloff is
#
#     exp(−((ρ + δ)^β − δ^β) / ((2 + δ)^β − δ^β)),   δ = 0.02
#
# which is 1 at the centre and 1/e at ρ = 2 for every β, as a Gaussian's is. δ keeps the slope at the centre finite.

OFFSET = 0.02
"""δ, in squared standard deviations."""
MOST_TANH = 1 - 1e-7
"""Largest tanh of a shape that is inverted, so that the shape is finite."""
LARGEST_RHO = 1e6
"""Squared distance beyond which the falloff is 0 in any case; its powers stay finite up to there."""


@pytree
class Exponents(Part):
    """Shapes of the kernels."""

    shapes: Array | None = None
    """[N] shapes s of the exponents exp(tanh s); 0 is a Gaussian. None until allocated."""

    names_in_files = ("shapes",)

    @staticmethod
    def of_logarithms(logarithms: Array) -> "Exponents":
        """Return the part with exponents of given logarithms, cut to ±1; traceable."""
        return Exponents(shapes_of(logarithms))

    @property
    def logarithms(self) -> Array:
        """[N] logarithms of the exponents, within ±1."""
        assert self.shapes is not None
        return jnp.tanh(self.shapes)

    def falloff(self, rho: Array) -> Array:
        """Return kernels at squared distances, which broadcast with the shapes."""
        assert self.shapes is not None
        return falloff_of(curves_of(self.shapes), rho)

    def allocate(self, gaussians: Gaussians) -> "Exponents":
        return dataclasses.replace(self, shapes=jnp.zeros(gaussians.num, gaussians.means.dtype))

    def check(self, gaussians: Gaussians) -> None:
        check_shape("shapes", self.shapes, (gaussians.num,))


class Curve(NamedTuple):
    """The exponent of the falloff as a function of ρ: scale·((ρ + δ)^β − start)."""

    exponents: Array  # β [N].
    scales: Array  # [N] inverse of its increase from ρ = 0 to 2, so that it is 1 there.
    starts: Array  # [N] δ^β.


def shapes_of(logarithms: Array) -> Array:
    """Return the shapes of exponents of given logarithms, cut to ±1."""
    return jnp.arctanh(jnp.clip(logarithms, -MOST_TANH, MOST_TANH))


def curves_of(shapes: Array) -> Curve:
    """Return the curves of shapes s [N], of exponents β = exp(tanh s) in (1/e, e)."""
    exponents = jnp.exp(jnp.tanh(shapes))
    # Logarithms of Python: with 64-bit floats on, NumPy's would make float64 of float32.
    starts = jnp.exp(exponents * math.log(OFFSET))
    return Curve(exponents, 1 / (jnp.exp(exponents * math.log(2 + OFFSET)) - starts), starts)


def falloff_of(curve: Curve, rho: Array) -> Array:
    """Return kernels at squared distances, which broadcast with the numbers of the curve."""
    # Unlike jnp.minimum, whose derivative halves ties by a division.
    rho = jnp.where(rho > LARGEST_RHO, LARGEST_RHO, rho)
    return jnp.exp(-curve.scales * (_power(rho + OFFSET, curve.exponents) - curve.starts))


@jax.custom_jvp
def _power(x: Array, exponent: Array) -> Array:
    """Return positive x to a power; its derivatives divide by nothing, unlike the ones of jnp.power and log."""
    return x * jnp.exp((exponent - 1) * jnp.log(x))


@_power.defjvp
def _power_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    x, exponent = primals
    d_x, d_exponent = tangents
    logarithm = jnp.log(x)
    one_less = jnp.exp((exponent - 1) * logarithm)
    power = x * one_less
    return power, exponent * one_less * d_x + power * logarithm * d_exponent


def reach_of(curve: Curve, bound: Array) -> Array:
    """Return the squared distance [N] at which kernels are as small as a Gaussian is at `bound`; not positive where
    the bound is not."""
    reach = jnp.maximum(bound, 0.0) / (2 * curve.scales) + curve.starts
    return jnp.where(bound > 0, jnp.exp(jnp.log(reach) / curve.exponents) - OFFSET, bound)


# Spherical harmonics with a degree per Gaussian, beyond the degree that all Gaussians have. Band l holds the 2l + 1
# coefficients of degree l. All Gaussians have the bands of `Gaussians.sh`. One of a higher degree has a block of all
# bands between in a `core.table.Table`; one without takes no bytes there.

MAX_DEGREE = 3


@pytree(repr=False)
class Coefficients(Table):
    """Blocks [K, 3] of the coefficients that each Gaussian has beyond the common ones; K is 0 without any."""

    owners: tuple[Array, ...] = ()
    """[capacity] int32 Gaussian of each row of each bucket; N for a row of padding."""

    num_axes: ClassVar[int] = 1
    padding: ClassVar[tuple[float, ...]] = (0.0, 0.0, 0.0)

    @classmethod
    def placed(cls, buckets: Sequence[Any], places: Places) -> Self:
        bucket = np.asarray(places.bucket)
        row = np.asarray(places.row)
        num = places.bucket.shape[0]
        owners = []
        for index, blocks in enumerate(buckets):
            # N is out of range, so that scatters drop padding.
            owner = np.full(len(blocks), num, np.int32)
            owner[row[bucket == index]] = np.flatnonzero(bucket == index)
            owners.append(jax.device_put(owner))
        return dataclasses.replace(super().placed(buckets, places), owners=tuple(owners))

    @staticmethod
    def resized(blocks: np.ndarray, size: Size) -> np.ndarray:
        """Return blocks [M, K, 3] with other numbers of coefficients: kept ones stay, new ones are 0 (host)."""
        missing = max(0, size[0] - blocks.shape[1])
        return np.pad(blocks, ((0, 0), (0, missing), (0, 0)))[:, : size[0]]


@pytree
class Bands(Part):
    """View dependence of a degree per Gaussian."""

    coefficients: Coefficients | None = None
    """Coefficients of N Gaussians; None until allocated."""

    names_in_files = ("degrees", "base_degree", "band_1", "band_2", "band_3")

    def allocate(self, gaussians: Gaussians) -> "Bands":
        degrees = np.full(gaussians.num, gaussians.sh_degree)
        return dataclasses.replace(self, coefficients=empty_bands(degrees, gaussians.sh_degree, gaussians.means.dtype))

    def check(self, gaussians: Gaussians) -> None:
        assert self.coefficients is not None
        check_table(self.coefficients, gaussians.num, "bands.coefficients")
        check_places(self.coefficients, "bands.coefficients")
        possible = {number - NUM_BASES[gaussians.sh_degree] for number in NUM_BASES[gaussians.sh_degree :]}
        unknown = {size for (size,) in self.coefficients.bucket_sizes} - possible
        if unknown:
            raise ValueError(
                f"bands.coefficients have blocks of {min(unknown)} coefficients, which no degree above "
                f"{gaussians.sh_degree}, the degree of the Gaussians, has"
            )

    def color_sums(self, gaussians: Gaussians, center: Array, degree: Integer) -> Array:
        """Return the sums [N, 3] that the bands add to Σ Y_l·sh_l, before 0.5 is added and negatives are cut off.

        The camera's centre is [3]; the highest degree may be traced.
        """
        table = self.coefficients
        base = gaussians.sh_degree
        means = gaussians.means
        assert table is not None
        total = jnp.zeros(means.shape, jnp.result_type(means, center, *table.buckets))
        for blocks, owners in zip(table.buckets, table.owners, strict=True):
            if not blocks.size:
                continue
            # Padding reads the last Gaussian here, and is dropped below.
            directions = directions_from(center, means[jnp.minimum(owners, table.num - 1)])
            bases = sh_basis(directions, blocks.shape[1] + NUM_BASES[base])
            colors = jnp.zeros((len(blocks), 3), total.dtype)
            for band in range(base + 1, MAX_DEGREE + 1):
                first = NUM_BASES[band - 1]
                last = NUM_BASES[band]
                # Blocks have all bands up to a degree.
                if blocks.shape[1] < last - NUM_BASES[base]:
                    break
                basis = jnp.where(jnp.asarray(degree) >= band, bases[:, first:last], 0.0)
                coefficients = blocks[:, first - NUM_BASES[base] : last - NUM_BASES[base]]
                colors = colors + jnp.sum(basis[:, :, None] * coefficients, axis=1)
            total = total.at[owners].add(colors, mode="drop")
        return total


def floats_of_band(degree: int) -> int:
    """Return the floats of a band of one Gaussian: 9, 15 and 21 for degree 1, 2 and 3."""
    return 3 * (2 * degree + 1)


def sizes_of_degrees(degrees: np.ndarray, base_degree: int) -> np.ndarray:
    """Return the sizes [N, 1] of the blocks of Gaussians of the given degrees. ValueError: a degree is out of range."""
    if degrees.size and not base_degree <= degrees.min() <= degrees.max() <= MAX_DEGREE:
        raise ValueError(f"degrees must be in {base_degree}..3; got {degrees.min()}..{degrees.max()}")
    sizes: np.ndarray = np.asarray(NUM_BASES)[degrees] - NUM_BASES[base_degree]
    return sizes[:, None]


def degrees_of_sizes(sizes: np.ndarray, base_degree: int) -> np.ndarray:
    """Return the degrees [N] of Gaussians with blocks of the given sizes [N, 1]."""
    return np.searchsorted(NUM_BASES, sizes[:, 0] + NUM_BASES[base_degree])


def empty_bands(degrees: ArrayLike, base_degree: int, dtype: DTypeLike = jnp.float32) -> Coefficients:
    """Return coefficients of zero for Gaussians of the given degrees [N] (host)."""
    return Coefficients.allocate(sizes_of_degrees(np.asarray(degrees), base_degree), Coefficients.padding, dtype)


def dense_bands(coefficients: Coefficients, base_degree: int) -> np.ndarray:
    """Return all coefficients above the base degree [N, K, 3], zeros above a Gaussian's degree; K is for degree 3
    (host)."""
    num_above = NUM_BASES[MAX_DEGREE] - NUM_BASES[base_degree]
    dense = np.zeros((coefficients.num, num_above, 3), coefficients.dtype)
    for ids, blocks in coefficients.groups():
        dense[ids, : blocks.shape[1]] = blocks
    return dense


def bands_of_dense(dense: np.ndarray, degrees: np.ndarray, base_degree: int) -> Coefficients:
    """Invert `dense_bands`, given the degrees [N]: coefficients above a Gaussian's degree are dropped (host)."""
    dense = np.asarray(dense)
    table = empty_bands(degrees, base_degree, dense.dtype)
    return Coefficients.of_groups((ids, dense[ids, : blocks.shape[1]]) for ids, blocks in table.groups())


# The Gaussian nearest to a kernel, for files that have Gaussians only. Of all Gaussians a·exp(−ρ/2k) it has the least
# squared difference from the kernel over the plane: for a given k, the best a is ⟨f, g⟩/⟨g, g⟩ with g = exp(−ρ/2k) and
# ⟨g, g⟩ = k, and the best k maximises ⟨f, g⟩²/k. Both are tabulated over the logarithm of the exponent.

LEAST_OPACITY = 1e-6
NUM_SHAPES = 41
NUM_SCALES = 121
NUM_PLACES = 2001
LARGEST_PLACE = 12.0
"""Distance, in standard deviations, up to which kernels are compared."""
LEAST_LOG_SCALE = -0.3
"""Least logarithm of √k."""
MOST_LOG_SCALE = 0.9


def nearest_gaussians(gaussians: Gaussians, shapes: np.ndarray) -> Gaussians:
    """Return the Gaussians nearest to kernels of the given shapes [N]: other scales and opacities (host)."""
    tabulated, peaks, log_scales = _table()
    log_exponents = np.tanh(np.asarray(shapes, np.float64))
    opacities = np.asarray(gaussians.opacities, np.float64) * np.interp(log_exponents, tabulated, peaks)
    dtype = gaussians.means.dtype
    limited = jnp.asarray(np.clip(opacities, LEAST_OPACITY, LARGEST_OPACITY), dtype)
    larger = np.asarray(gaussians.log_scales) + np.interp(log_exponents, tabulated, log_scales)[:, None]
    return dataclasses.replace(gaussians, logit_opacities=logit(limited), log_scales=jnp.asarray(larger, dtype))


@functools.cache
def _table() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return logarithms of exponents in order, and of the nearest Gaussian of each a and the logarithm of √k."""
    log_exponents = np.linspace(-1.0, 1.0, NUM_SHAPES)
    radii = np.linspace(0, LARGEST_PLACE, NUM_PLACES)
    shapes = np.arctanh(np.clip(log_exponents, -MOST_TANH, MOST_TANH))
    curves = curves_of(jnp.asarray(shapes)[:, None])
    kernels = np.asarray(falloff_of(curves, jnp.asarray(radii**2)[None]), np.float64)
    log_scales = np.linspace(LEAST_LOG_SCALE, MOST_LOG_SCALE, NUM_SCALES)
    squares = np.exp(2 * log_scales)
    # ⟨f, g⟩ in units of π: ∫ f·g·2r dr in steps of radii[1].
    weighted = np.exp(-0.5 * radii**2 / squares[:, None]) * radii * (2 * radii[1])
    products = kernels @ weighted.T
    best = np.argmax(products**2 / squares, axis=1)
    return log_exponents, products[np.arange(NUM_SHAPES), best] / squares[best], log_scales[best]
