"""One splat at one pixel: the hit of the ray, colour and alpha there, and the transmittance behind it.

Every function here is element-wise: it takes scalars, or arrays that broadcast. This is the one definition of a
rendered image: `kernels.xla` runs it over arrays, the other kernels compile it into loops, and all differentiate it by
`jax.vjp`.

M₀, M₁, M₂ are the rows of the homography, T the transmittance in front of a splat, g the cotangent of the channels, B
(`suffix_sum`) the sum over the splats from here to the last one of their products with g.
"""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance import Elementwise
from a2tg_jax.core.bilinear import Lookup, follow

MIN_ALPHA = 1 / 255
MIN_TRANSMITTANCE = 1e-4

Triple = tuple[Array, Array, Array]
Rows = tuple[Triple, Triple, Triple]
"""Rows of a homography."""
TileNumbers = tuple[Array, ...]
"""Centre (x, y) of a tile, and with rays of its own the four numbers of its frame, row by row."""
State = tuple[Array, Array, Array]
"""Transmittance and liveness behind a splat, and `suffix_sum` of the splats behind it."""
Statistic = Literal["position", "screen", "center"]
"""Statistics of densification, computed in the backward pass (`positional_gradient`)."""


class Splat(NamedTuple):
    """Differentiable numbers of a splat, without its texture."""

    M: Rows  # rows of the homography from (u, v, 1) to pixels
    opacity: Array  # peak opacity, before the falloff
    color: tuple[Array, ...]  # own colours: red, green and blue of the spherical harmonics, or D features
    normal: Triple | None  # normal in the world, facing the camera; None if only colour is composited
    numbers: tuple[Array, ...] = ()  # numbers of its appearance (`Appearance.numbers`)


class Planes(NamedTuple):
    """Splat seen from a tile: p = k × l is linear in the pixel (x, y), relative to the tile's centre."""

    p0: Triple  # coefficients of x, y and 1 in p₀, where u = p₀/p₂
    p1: Triple  # coefficients of p₁, where v = p₁/p₂
    p2: Triple  # coefficients of p₂
    determinant: Array  # det(M); over p₂ it is the depth of the hit
    center_x: Array  # horizontal coordinate of the projected mean, in pixels from the tile's centre
    center_y: Array  # vertical coordinate of the projected mean
    depth: Array  # depth of the mean


class Hit(NamedTuple):
    """Hit of a pixel's ray with a splat."""

    u: Array  # coordinate along the first axis, in standard deviations; 0 without a hit
    v: Array  # coordinate along the second axis
    rho: Array
    """Squared distance for the falloff, min(u² + v², 2·|(x, y) − c|²). Without the low-pass filter, u² + v², and
    infinity without a hit."""
    depth: Array  # depth of the hit, or of the mean if the low-pass filter decides
    is_ray: Array  # whether the hit decides ρ, not the low-pass filter
    inverse: Array  # 1/p₂, finite also where there is no hit


class Shown(NamedTuple):
    """Alpha and channels of a splat at a pixel."""

    alpha: Array  # alpha in [0, max_alpha]; 0 if it would be less than 1/255
    channels: tuple[Array, ...]  # colours; and depth, depth², normal x, y, z if the splat has a normal


def _cross(a: Triple, b: Triple) -> Triple:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _from_center(column: Triple, tile: TileNumbers) -> Triple:
    """Return a column of the homography to pixels counted from the tile's centre, in its frame if it has one."""
    x, y, *frame = tile
    # Before any product: this keeps float32 exact to 1e-4.
    first = column[0] - x * column[2]
    second = column[1] - y * column[2]
    last = column[2]
    if frame:
        xx, xy, yx, yy = frame
        first, second = xx * first + xy * second, yx * first + yy * second
    return first, second, last


def planes_of(M: Rows, tile: TileNumbers) -> Planes:
    """Return the planes of a splat for a tile centred at (x, y): p = [M₁×M₂ | M₂×M₀ | M₀×M₁]·(x, y, 1).

    With a frame, pixels are counted in it (`tile_pixels`).
    """
    columns = [_from_center(column, tile) for column in zip(*M, strict=True)]
    first, second, last = zip(*columns, strict=True)
    # 2DGS: the pixel's ray is the intersection of the planes k = x·M₂ − M₀ and l = y·M₂ − M₁, and p = k × l. It is
    # bilinear: x and y multiply the cross products with the last row, and x·y the one of the last row with itself, 0.
    a = _cross(second, last)
    b = _cross(last, first)
    c = _cross(first, second)
    p0, p1, p2 = ((a[k], b[k], c[k]) for k in range(3))
    determinant = last[0] * c[0] + last[1] * c[1] + last[2] * c[2]
    return Planes(p0, p1, p2, determinant, center_x=first[2] / last[2], center_y=second[2] / last[2], depth=last[2])


def _larger(x: Array, y: Array) -> Array:
    """Return the larger number: one instruction in native loops, where jnp.maximum, which keeps NaN, takes six."""
    return jnp.where(x > y, x, y)


@jax.custom_jvp
def _inverse(x: Array) -> Array:
    """Return 1/x, whose derivative divides no second time."""
    return 1 / x


@_inverse.defjvp
def _inverse_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    inverse = _inverse(primals[0])
    return inverse, -(inverse * inverse) * tangents[0]


def intersect(planes: Planes, x: Array, y: Array, near_plane: float, has_low_pass: bool = True) -> Hit:
    """Return the hit of a pixel's ray, or the low-pass filter's if that is nearer (2DGS, equations 10, 11).

    The hit is (p₀, p₁)/p₂ at depth det(M)/p₂; depths below `near_plane` are no hit.
    """
    p0, p1, p2 = (plane[0] * x + plane[1] * y + plane[2] for plane in planes[:3])
    # Far out on a nearly parallel plane u² would overflow, as would 1/p₂² for the tiniest splats: the divisor is
    # clamped there, with a finite gradient. With |u| <= ∛max, u² and its product with u stay finite.
    far = float(np.cbrt(np.finfo(p2.dtype).max))
    tiny = float(np.sqrt(np.finfo(p2.dtype).tiny))
    q0, q1, q2, determinant = jax.lax.stop_gradient((p0, p1, p2, planes.determinant))
    least = _larger(_larger(jnp.abs(q0), jnp.abs(q1)), jnp.abs(determinant)) * (1 / far)
    least = jnp.maximum(least, tiny)
    is_far = jnp.abs(q2) <= least
    is_parallel = q2 == 0
    inverse = _inverse(jnp.where(is_far, jnp.where(q2 < 0, -least, least), p2))
    depth = planes.determinant * inverse
    is_hit = ~is_parallel & (depth >= near_plane)
    u = jnp.where(is_hit, p0 * inverse, 0.0)
    v = jnp.where(is_hit, p1 * inverse, 0.0)

    rho_ray = u * u + v * v
    if not has_low_pass:
        return Hit(u, v, jnp.where(is_hit, rho_ray, jnp.inf), jnp.where(is_hit, depth, planes.depth), is_hit, inverse)
    dx = x - planes.center_x
    dy = y - planes.center_y
    rho_screen = 2 * (dx * dx + dy * dy)
    is_ray = is_hit & (rho_ray <= rho_screen)
    rho = jnp.where(is_ray, rho_ray, rho_screen)
    depth = jnp.where(is_ray, depth, planes.depth)
    return Hit(u, v, rho, depth, is_ray, inverse)


def values_at(functions: Elementwise, lookup: Lookup | None, hit: Hit, values: tuple[Array, ...]) -> tuple[Array, ...]:
    """Return the values of a lookup, differentiable in themselves and in the hit."""
    if lookup is None:
        return ()
    return follow(lookup.sample._replace(values=values), *functions.texel_position(lookup.region, hit.u, hit.v))


def show(
    functions: Elementwise, splat: Splat, hit: Hit, values: tuple[Array, ...], rho_probe: Array | None = None
) -> Shown:
    """Return α = min(functions.max_alpha, o·falloff(ρ)·T_A), or 0 below 1/255, and the channels that it weighs.

    `values` are interpolated from the splat's texture, and the splat's homography is not read. `rho_probe` is zero,
    added to ρ of the falloff to read the gradient there.
    """
    residual, factor, tint = functions.shade(splat.numbers, values, hit.u, hit.v)
    # The slope of a falloff at infinity may be NaN.
    rho = hit.rho if functions.has_low_pass else jnp.where(hit.is_ray, hit.rho, 0.0)
    rho = rho if rho_probe is None else rho + rho_probe
    a = splat.opacity * functions.falloff(splat.numbers, rho)
    a = a if factor is None else a * factor
    # NaN must stay NaN, here and in `absorb`.
    is_hidden = a < MIN_ALPHA if functions.has_low_pass else (a < MIN_ALPHA) | ~hit.is_ray
    # Not >=: an alpha on its cap has a gradient, so that what starts or is projected there can fade.
    alpha = jnp.where(is_hidden, 0.0, jnp.where(a > functions.max_alpha, functions.max_alpha, a))
    channels: tuple[Array, ...] = splat.color
    if tint is not None:
        channels = tuple(base * scale for base, scale in zip(channels, tint, strict=True))
    if residual is not None:
        channels = tuple(base + extra for base, extra in zip(channels, residual, strict=True))
    if splat.normal is not None:
        channels = (*channels, hit.depth, hit.depth * hit.depth, *splat.normal)
    return Shown(alpha, channels)


def absorb(alpha: Array, transmittance: Array, is_live: Array) -> Triple:
    """Return the weight α·T of a splat, and transmittance and liveness behind it.

    A pixel stops before the splat that would leave a transmittance below 10⁻⁴.
    """
    is_live = is_live & ~(transmittance * (1 - alpha) < MIN_TRANSMITTANCE)
    weight = jnp.where(is_live, alpha * transmittance, 0.0)
    return weight, transmittance - weight, is_live


def absorb_vjp(
    alpha: Array, transmittance: Array, is_live: Array, suffix_sum: Array, g_dot_c: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Return the results of `absorb` and ∂L/∂α, walking front to back.

    B = Σ g·c·α·T over the splats behind + g_T·T_final is linear in 1 − α of this splat, so that
    ∂L/∂α = T·(g·c) − B/(1 − α). Nothing is stored per pixel and splat, and α never reaches 1.

    `suffix_sum` is B with this splat's g·c·α·T still in it. The results are weight, transmittance and liveness behind
    the splat, B of the splats behind it, and ∂L/∂α.
    """
    weight, transmittance_behind, is_live_behind = absorb(alpha, transmittance, is_live)
    suffix_sum = suffix_sum - weight * g_dot_c
    d_alpha = jnp.where(is_live_behind, transmittance * g_dot_c - suffix_sum / (1 - alpha), 0.0)
    return weight, transmittance_behind, is_live_behind, suffix_sum, d_alpha


class Cotangents(NamedTuple):
    """Contribution of one splat at one pixel to the gradient."""

    planes: Planes
    opacity: Array
    color: tuple[Array, ...]
    normal: Triple | None
    numbers: tuple[Array, ...]
    values: tuple[Array, ...]  # cotangents of the values of the splat's texture
    rho: Array | None  # ∂L/∂ρ through the falloff, if requested


def blend(
    functions: Elementwise, near_plane: float, planes: Planes, splat: Splat, values: tuple[Array, ...], x: Array,
    y: Array, transmittance: Array, is_live: Array,
) -> tuple[tuple[Array, ...], Array, Array]:  # fmt: skip
    """Return the contribution of one splat at one pixel to the channels, and transmittance and liveness behind it."""
    shown = show(functions, splat, intersect(planes, x, y, near_plane, functions.has_low_pass), values)
    weight, transmittance, is_live = absorb(shown.alpha, transmittance, is_live)
    return tuple(weight * channel for channel in shown.channels), transmittance, is_live


def blend_vjp(
    functions: Elementwise, near_plane: float, planes: Planes, splat: Splat, lookup: Lookup | None, x: Array, y: Array,
    transmittance: Array, is_live: Array, suffix_sum: Array, g: Sequence[Array], has_rho: bool,
    only_colors: bool,
) -> tuple[State, Array, Cotangents]:  # fmt: skip
    """Differentiate `blend`, with `suffix_sum` as for `absorb_vjp` and the cotangents g of the channels.

    Returns (transmittance, is_live, suffix_sum) behind the splat, its weight, and its Cotangents. These are valid only
    if the weight is positive; elsewhere they may not even be finite. With `only_colors`, only the colours have
    any that are not zero, and nothing depends on `suffix_sum`.
    """

    def of_floats(
        planes: Planes, opacity: Array, color: Triple, normal: Triple | None, numbers: tuple[Array, ...],
        values: tuple[Array, ...], rho_probe: Array | None,
    ) -> Shown:  # fmt: skip
        if only_colors:
            planes, opacity, normal, numbers, values = jax.lax.stop_gradient((planes, opacity, normal, numbers, values))
        hit = intersect(planes, x, y, near_plane, functions.has_low_pass)
        values = values_at(functions, lookup, hit, values)
        return show(functions, Splat(splat.M, opacity, color, normal, numbers), hit, values, rho_probe)

    rho_probe = jnp.zeros_like(transmittance) if has_rho else None
    values = () if lookup is None else lookup.sample.values
    floats = planes, splat.opacity, splat.color, splat.normal, splat.numbers, values, rho_probe
    shown, pull_back = jax.vjp(of_floats, *floats)
    g_dot_c: Any = sum(g_k * channel for g_k, channel in zip(g, shown.channels, strict=True))
    weight, transmittance, is_live, suffix_sum, d_alpha = absorb_vjp(
        shown.alpha, transmittance, is_live, suffix_sum, g_dot_c
    )
    cotangents = Cotangents(*pull_back(Shown(d_alpha, tuple(weight * g_k for g_k in g))))
    return (transmittance, is_live, suffix_sum), weight, cotangents


def positional_gradient(
    statistic: Statistic, M: Rows, hit: Hit, x: Array, y: Array, tile: TileNumbers, d_rho: Array,
    jacobian: Sequence[Sequence[Array]] | Array,
) -> Triple:  # fmt: skip
    """Return a pixel's contribution to a statistic of densification, through the falloff only; zero where `d_rho` is.

    "position": |∂L/∂μ| per world component (A²TG).
    "screen": |∂L/∂c| per pixel axis of the projected mean c if the low-pass filter decides, else 0 (gsplat's `absgrad`
    of 2D Gaussians). With a frame, it is by pixels of the image.
    "center": ∂L/∂M₀₂·M₂₂ and ∂L/∂M₁₂·M₂₂, signed, if the hit decides, else 0 (2DGS); likewise.

    `d_rho` is ∂L/∂ρ through the falloff, `jacobian` has the rows of ∂M[:, 2]/∂μ = K·Rc.
    """

    # Only the third column of M moves with the mean, by the jacobian. k₀, k₁, l₀, l₁ and p₂ = k₀·l₁ − k₁·l₀ do not.
    def ray(column: Triple) -> tuple[Array, Array]:
        first, second, last = _from_center(column, tile)
        return x * last - first, y * last - second

    k0, l0 = ray((M[0][0], M[1][0], M[2][0]))
    k1, l1 = ray((M[0][1], M[1][1], M[2][1]))
    mean = tuple(jnp.broadcast_to(row[2], jnp.shape(d_rho)) for row in M)
    (first, second, last), pull_back = jax.vjp(lambda mean: _from_center(mean, tile), mean)
    inverse = 1 / last  # The same at all pixels: native loops divide once a splat.
    center_x = first * inverse
    center_y = second * inverse
    # u = (k₁·l₂ − k₂·l₁)/p₂ and v = (k₂·l₀ − k₀·l₂)/p₂; of the low-pass filter, (k₂, l₂)/M₂₂ leads from the centre.
    factor = d_rho * jnp.where(hit.is_ray, 2 * hit.inverse, 4 * inverse)
    d_k2 = factor * jnp.where(hit.is_ray, hit.v * l0 - hit.u * l1, x - center_x)
    d_l2 = factor * jnp.where(hit.is_ray, hit.u * k1 - hit.v * k0, y - center_y)
    d_last = d_k2 * jnp.where(hit.is_ray, x, center_x) + d_l2 * jnp.where(hit.is_ray, y, center_y)
    (d_mean,) = pull_back((-d_k2, -d_l2, d_last))
    if statistic == "position":
        components = [sum(d_mean[i] * jacobian[i][axis] for i in range(3)) for axis in range(3)]
        return tuple(jnp.abs(component) for component in components)  # type: ignore[return-value]
    # c = (M₀₂, M₁₂)/M₂₂, so that this is ∂L/∂c if the low-pass filter decides.
    dx = d_mean[0] * mean[2]
    dy = d_mean[1] * mean[2]
    if len(tile) == 6:
        # ∂L/∂place = Fᵀ·∂L/∂pixel for pixel = F·place: this solves for ∂L/∂pixel.
        _, _, xx, xy, yx, yy = tile
        inverse = 1 / (xx * yy - xy * yx)
        dx, dy = (yy * dx - yx * dy) * inverse, (xx * dy - xy * dx) * inverse
    if statistic == "center":
        dx = jnp.where(hit.is_ray, dx, 0.0)
        dy = jnp.where(hit.is_ray, dy, 0.0)
    else:
        dx = jnp.where(hit.is_ray, 0.0, jnp.abs(dx))
        dy = jnp.where(hit.is_ray, 0.0, jnp.abs(dy))
    return dx, dy, jnp.zeros_like(dx)
