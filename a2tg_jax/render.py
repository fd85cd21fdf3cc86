"""Images of textured 2D Gaussians: project, list the tiles, composite, with capacities planned on the host.

N splats, H×W pixels. An eager call of `render_image` plans its own capacity. Under jit or vmap, the capacity comes from
the settings, which `plan_render` fills in.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance import (
    Appearance,
    AppearanceRule,
    Features,
    PlainRule,
    TextureOptions,
    appearance_for,
)
from a2tg_jax.core.cameras import Camera, check_camera
from a2tg_jax.core.checks import check_floats, check_kind, check_shape, dtype_of
from a2tg_jax.core.display import as_bytes, enlarged, png, short_tuple_repr
from a2tg_jax.core.gaussians import Gaussians, check_gaussians
from a2tg_jax.core.geometry import homographies, screen_bounds
from a2tg_jax.core.jit import Jitted
from a2tg_jax.core.overflow import OverflowWatch
from a2tg_jax.core.pixel_sizes import NEAR_PLANE
from a2tg_jax.core.similarity import Similarity
from a2tg_jax.rasterize.compositor import Composited, composite, refusal
from a2tg_jax.rasterize.exchange import Exchange, composite_in_bands, rows_to_send
from a2tg_jax.rasterize.kernels.choice import choose, instead_of
from a2tg_jax.rasterize.kernels.native import composite as native
from a2tg_jax.rasterize.pixel import Statistic
from a2tg_jax.rasterize.splats import (
    CompositingSettings,
    Compositor,
    Splats,
    Wanted,
    project_gaussians,
)
from a2tg_jax.rasterize.supersampling import box_mean, finer
from a2tg_jax.rasterize.tile_pixels import TilePixels, tile_pixels
from a2tg_jax.rasterize.tiles import TileGrid, count_pairs, tile_lists
from a2tg_jax.texture import AtlasLayout, Textures, check_textures

HEAD_ROOM = 1.25
IMAGES = ("color", "alpha", "depth", "normal", "distortion")
"""Fields of `RenderOutput` that are images."""
BATCH_ON_ACCELERATOR = 4096


@dataclasses.dataclass(frozen=True)
class RenderSettings:
    """Static options of a rendering; hashable, so that jit can close over them or take them as static."""

    tile_size: int = 8
    """Side of a tile in pixels; it does not change the image."""
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
    """Devices that render each image together (`exchange_among`); None: one."""

    def __post_init__(self) -> None:
        if not self.near_plane > 0:
            raise ValueError(f"near_plane must be positive; got {self.near_plane}")
        if type(self.supersample) is not int or self.supersample < 1:
            raise ValueError(f"supersample must be an int, at least 1; got {self.supersample!r}")
        if isinstance(self.capacity, np.integer):
            object.__setattr__(self, "capacity", int(self.capacity))
        if self.capacity is not None and (type(self.capacity) is not int or self.capacity < 1):
            raise ValueError(f"capacity must be an int, at least 1, or None; got {self.capacity!r}")

    def transform(self, similarity: Similarity) -> "RenderSettings":
        """Return settings that show a model in the world of `similarity` as these show it in its own."""
        return dataclasses.replace(self, near_plane=self.near_plane * similarity.scale)

    @staticmethod
    def official() -> "RenderSettings":
        """Return settings with the texture conventions of the authors' program."""
        return RenderSettings(texture=TextureOptions.official())


class RenderOutput(NamedTuple):
    """Images of a view. Depth and normal are weighted sums, not divided by alpha, without the background."""

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

    def __repr__(self) -> str:
        return short_tuple_repr(self)

    def _repr_png_(self) -> bytes | None:
        """Return the colour as a PNG file for notebooks; None for several views, or under a transformation."""
        pixels = as_bytes(self.color)
        return None if pixels is None else png(enlarged(pixels))


def render_image(
    gaussians: Gaussians,
    camera: Camera,
    textures: Textures | None = None,
    layout: AtlasLayout | None = None,
    *,
    features: Any = None,
    background: Any = None,
    settings: RenderSettings = RenderSettings(),
) -> RenderOutput:
    """Render a view: equations (3) to (6) of A²TG. Differentiable in every float, camera and background included.

    Args:
      gaussians: N Gaussians.
      camera: the view.
      textures, layout: textures of the Gaussians; without both, the splats are plain 2DGS.
      features: [N, D] numbers of each Gaussian to show in place of its colour, D >= 1, of either sign. They are
        weighted as the colour is and not clipped: `color` is [H, W, D]. Of textures they see alpha only.
      background: [3] colour, or [D] features, behind everything; None is 0.
      settings: static options. An eager call, also under `jax.grad`, needs no capacity and never overflows.

    Returns:
      The images of the view. If a visible splat has a mean, rotation, scale, opacity or colour that is not finite, the
      whole image and all gradients are NaN. A NaN texel is NaN in the image where it is visible.

    Raises:
      ValueError: under jit or vmap without a capacity, if only one of textures and layout is given, if the layout
        has another number of Gaussians, or if an argument has a wrong shape.
    """
    check_gaussians(gaussians)
    rule = with_features(rule_of(gaussians, textures, layout, settings), features, gaussians)
    return render_appearance(gaussians, camera, rule, background=background, settings=settings)


def render_appearance(
    gaussians: Gaussians,
    camera: Camera,
    rule: AppearanceRule,
    *,
    background: Any = None,
    settings: RenderSettings = RenderSettings(),
    num_live: Array | int | None = None,
) -> RenderOutput:
    """Render a view as `render_image` does, with an appearance rule; of the first `num_live` rows, if given."""
    check_gaussians(gaussians)
    check_camera(camera)
    background = (0,) * rule.num_colors if background is None else background
    check_background(background, rule.num_colors)
    if num_live is not None:
        check_shape("num_live", num_live, ())
    planned = with_capacity(settings, gaussians, camera, rule, num_live)
    background = jnp.asarray(background, gaussians.means.dtype)
    output, _ = _jitted_render()(gaussians, camera, rule, background, planned, num_live=num_live)
    if settings.capacity is not None:
        kind = settings, camera.width, camera.height, gaussians.num
        _overflow_watch().observe(output.overflow, settings.capacity, kind)
    return output


@functools.cache
def _overflow_watch() -> OverflowWatch:
    return OverflowWatch()


def with_features(rule: AppearanceRule, features: Any, gaussians: Gaussians) -> AppearanceRule:
    """Return the rule that shows features [N, D] in place of colours; the same rule if features is None.

    Raises:
      ValueError: if the features are not floats [N, D] of the Gaussians' dtype, D >= 1.
    """
    if features is None:
        return rule
    check_floats("features", features, (gaussians.num, "D"))
    if dtype_of(features) != gaussians.means.dtype or not np.shape(features)[1]:
        found = f"{dtype_of(features)}{[*np.shape(features)]}"
        raise ValueError(f"features must be {gaussians.means.dtype} as the means are, D >= 1; got {found}")
    return Features(rule, jnp.asarray(features))


def check_rule(rule: AppearanceRule) -> None:
    """Raise ValueError unless a value is a rule, and it and the rules in it are pytrees."""
    check_kind("rule", rule, AppearanceRule)
    for leaf in jax.tree.leaves(rule):
        if isinstance(leaf, AppearanceRule):
            raise ValueError(
                f"{type(leaf).__name__} is not a pytree: decorate it with @jax.tree_util.register_dataclass, above "
                "@dataclasses.dataclass(frozen=True)"
            )


def check_background(background: Any, num_colors: int = 3) -> None:
    """Raise ValueError unless the background is one colour, of `num_colors` numbers."""
    if np.ndim(background) == 3:
        raise ValueError(
            f"background must be one colour [3]; got {[*np.shape(background)]}. To put an image behind the splats, "
            "render on black and add (1 - output.alpha[..., None]) * image"
        )
    if isinstance(background, str):
        raise ValueError(f"background must be [{num_colors}] floats, such as (1, 1, 1) for white; got {background!r}")
    check_shape("background", background, (num_colors,))


@functools.cache
def _jitted_render() -> Jitted[..., tuple[RenderOutput, Array]]:
    return Jitted(render_traced, static_argnums=(4,))


def render_traced(
    gaussians: Gaussians,
    camera: Camera,
    rule: AppearanceRule,
    background: Array,
    settings: RenderSettings,
    *,
    has_geometry: bool = True,
    sh_degree: Any = None,
    num_live: Any = None,
    probe: Array | None = None,
    statistic: Statistic | None = "position",
) -> tuple[RenderOutput, Array]:
    """Return the output, which training differentiates, and the number of pairs of the view for `capacity_for`.

    Args:
      gaussians, camera, rule: as for `render_appearance`.
      background: [3] colour, or as many numbers as the rule has colours.
      settings: static options, with a capacity.
      has_geometry: if False, depth, normal and distortion are zeros and cost nothing.
      sh_degree: replaces that of the settings; may be traced.
      num_live: number of rows that exist; may be traced.
      probe: [N, 4] zeros, at which the gradient is the statistic and the number of pixels (`compositor.composite`).
      statistic: kind of statistic (`rasterize.pixel.positional_gradient`); not used without a probe.

    Raises:
      ValueError: if a probe is given with `settings.supersample`.
    """
    if settings.supersample > 1:
        if probe is not None:
            raise ValueError("supersample must be 1 where statistics of gradients are gathered")
        factor, settings = settings.supersample, dataclasses.replace(settings, supersample=1)
        output, num_pairs = render_traced(
            gaussians, finer(camera, factor), rule, background, settings,
            has_geometry=has_geometry, sh_degree=sh_degree, num_live=num_live,
        )  # fmt: skip
        images = {name: box_mean(getattr(output, name), factor) for name in IMAGES}
        return output._replace(**images), num_pairs
    options: dict[str, Any] = {
        "has_geometry": has_geometry, "sh_degree": sh_degree, "num_live": num_live, "statistic": statistic,
    }  # fmt: skip
    if settings.exchange is None:
        return _rendered(_alone, gaussians, camera, rule, background, settings, probe=probe, **options)
    gaussians, camera, background, probe = jax.tree.map(lambda x: x[None], (gaussians, camera, background, probe))
    views = render_together(gaussians, camera, rule, background, settings, probe=probe, **options)
    only: tuple[RenderOutput, Array] = jax.tree.map(lambda x: x[0], views)
    return only


def render_together(
    gaussians: Gaussians,
    cameras: Camera,
    rule: AppearanceRule,
    backgrounds: Array,
    settings: RenderSettings,
    *,
    has_geometry: bool = True,
    sh_degree: Any = None,
    num_live: Any = None,
    probe: Array | None = None,
    statistic: Statistic | None = "position",
) -> tuple[RenderOutput, Array]:
    """Return what `render_traced` does for each of G views, drawn at once by the devices of an exchange.

    Args:
      gaussians, cameras, backgrounds, probe: as for `render_traced`, [G, ...]: each view has its own copy of the
        Gaussians, so that gradients are of each view.
      rule: shared by the views.
      settings: with a capacity and an exchange, whose number of devices G divides; without supersampling.
      has_geometry, sh_degree, num_live, statistic: as for `render_traced`.
    """
    return _rendered(
        jax.vmap, gaussians, cameras, rule, backgrounds, settings,
        has_geometry=has_geometry, sh_degree=sh_degree, num_live=num_live, probe=probe, statistic=statistic,
    )  # fmt: skip


def _alone(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of one view unchanged, where `jax.vmap` makes it one of several."""
    return function


def _rendered(
    each: Callable[..., Callable[..., Any]], gaussians: Gaussians, camera: Camera, rule: AppearanceRule,
    background: Array, settings: RenderSettings, *, has_geometry: bool, sh_degree: Any, num_live: Any,
    probe: Array | None, statistic: Statistic | None,
) -> tuple[RenderOutput, Array]:  # fmt: skip
    """Return the output of one view, or of several if `each` is `jax.vmap`; other arguments as of `render_traced`."""
    compositor = choose(settings.compositor, settings.tile_size)
    if camera.rays is not None:
        compositor = _for_rays(settings, compositor)
    compositing = _compositing_settings(
        camera, settings, compositor, has_geometry, None if probe is None else statistic, rule.num_colors
    )
    *views, num, _ = gaussians.means.shape
    if num == 0:
        return each(functools.partial(_empty_view, compositing))(background), jnp.zeros(views, jnp.float32)
    degree = settings.sh_degree if sh_degree is None else sh_degree

    def projected(gaussians: Gaussians, camera: Camera) -> tuple[Splats, Array, Array]:
        splats, cutoff = project_gaussians(gaussians, camera, rule, settings.near_plane, degree, num_live)
        return splats, cutoff, jax.lax.stop_gradient(camera.K @ camera.viewmat[:3, :3])

    splats, cutoff, jacobian = each(projected)(gaussians, camera)
    of_one = splats if each is _alone else jax.tree.map(lambda x: x[0], splats)
    if reason := refusal(compositing, rule, of_one):
        settings = dataclasses.replace(settings, compositor=instead_of(settings.compositor, type(rule), reason))
        return _rendered(
            each, gaussians, camera, rule, background, settings,
            has_geometry=has_geometry, sh_degree=sh_degree, num_live=num_live, probe=probe, statistic=statistic,
        )  # fmt: skip
    probe = jnp.zeros((*views, num, 4), splats.M.dtype) if probe is None else probe
    pixels = _pixels_of(camera, settings.tile_size)
    shown = _composited(compositing, settings, splats, rule, cutoff, jacobian, probe, pixels)

    def shaded(shown: Composited, cutoff: Array, background: Array) -> RenderOutput:
        taint = jnp.where(jnp.any(jnp.isnan(cutoff)), jnp.nan, 0.0).astype(shown.channels.dtype)
        channels, transmittance = shown.channels + taint, shown.transmittance + taint
        return _output(compositing, channels, transmittance, background, shown.overflow)

    return each(shaded)(shown, cutoff, background), shown.num_pairs


def _composited(
    compositing: CompositingSettings, settings: RenderSettings, splats: Splats, rule: AppearanceRule, cutoff: Array,
    jacobian: Array, probe: Array, pixels: TilePixels | None,
) -> Composited:  # fmt: skip
    """Return the image without background, of one device; or those of several views, of several devices."""
    capacity = settings.capacity or 0
    if settings.exchange is not None:
        return composite_in_bands(compositing, settings.exchange, capacity, splats, rule, cutoff, jacobian, probe)
    M, near_plane, grid = jax.lax.stop_gradient(splats.M), compositing.near_plane, compositing.grid
    if pixels is None and compositing.compositor == "native":
        lists = native.tile_lists(M, cutoff, near_plane, grid, capacity)
    else:
        lists = tile_lists(M, cutoff, near_plane, grid, capacity, pixels)
    channels, transmittance = composite(compositing, splats, rule, cutoff, lists, jacobian, probe)
    return Composited(channels, transmittance, lists.num_pairs, lists.overflow)


def _for_rays(settings: RenderSettings, compositor: Compositor) -> Compositor:
    """Return the compositor for a camera with a ray for each pixel."""
    if settings.exchange is not None:
        raise ValueError("cameras with rays are rendered on one device: leave out settings.exchange (--devices)")
    if compositor != "cuda":
        return compositor
    if settings.compositor != "auto":
        raise ValueError("compositor='cuda' cannot render cameras with rays: say 'xla', or 'auto'")
    return "xla"


def _pixels_of(camera: Camera, tile_size: int) -> TilePixels | None:
    """Return the pixels of all tiles of a camera with rays; None for a pinhole camera."""
    return None if camera.rays is None else tile_pixels(camera.rays, tile_size)


def _compositing_settings(
    camera: Camera,
    settings: RenderSettings,
    compositor: Compositor,
    has_geometry: bool,
    statistic: Statistic | None,
    num_colors: int,
) -> CompositingSettings:
    grid = TileGrid(camera.width, camera.height, settings.tile_size)
    return CompositingSettings(
        grid=grid,
        near_plane=settings.near_plane,
        has_geometry=has_geometry,
        statistic=statistic,
        compositor=compositor,
        tile_batch=min(_tile_batch(settings) or grid.num, grid.num) if compositor in ("xla", "autodiff") else 1,
        num_colors=num_colors,
        has_rays=camera.rays is not None,
    )


def _empty_view(compositing: CompositingSettings, background: Array) -> RenderOutput:
    """Return the output of a view without Gaussians."""
    grid = compositing.grid
    channels = jnp.zeros((compositing.num_channels, grid.height, grid.width), background.dtype)
    transmittance = jnp.ones((grid.height, grid.width), background.dtype)
    return _output(compositing, channels, transmittance, background, jnp.asarray(False))


def _output(
    compositing: CompositingSettings, channels: Array, transmittance: Array, background: Array, overflow: Array
) -> RenderOutput:
    first = compositing.num_colors
    color = jnp.moveaxis(channels[:first], 0, -1) + transmittance[..., None] * background[None, None, :]
    alpha = 1 - transmittance
    if not compositing.has_geometry:
        nothing = jnp.zeros_like(alpha)
        no_normal = jnp.zeros((*alpha.shape, 3), alpha.dtype)
        return RenderOutput(color, alpha, nothing, no_normal, overflow, nothing)
    depth, squared = channels[first], channels[first + 1]
    normal = jnp.moveaxis(channels[first + 2 :], 0, -1)
    return RenderOutput(color, alpha, depth, normal, overflow, distortion=alpha * squared - depth * depth)


def capacity_for(pairs: int, head_room: float = HEAD_ROOM) -> int:
    """Return a capacity with head room for a number of pairs, rounded up so that few shapes occur."""
    return max(1024, -(-int(pairs * head_room) // 1024) * 1024)


def appearance_of(
    gaussians: Gaussians, textures: Textures | None, layout: AtlasLayout | None, settings: RenderSettings
) -> Appearance:
    """Return the appearance of Gaussians and textures given apart, which `settings.texture` decides.

    Raises:
      ValueError: if only one of textures and layout is given, or they do not fit the Gaussians.
    """
    if (textures is None) != (layout is None):
        raise ValueError("textures and layout belong together: give both or neither")
    if textures is not None and layout is not None:
        check_textures(textures, layout, gaussians.num)
    return appearance_for(settings.texture, has_textures=textures is not None)


def rule_of(
    gaussians: Gaussians, textures: Textures | None, layout: AtlasLayout | None, settings: RenderSettings
) -> AppearanceRule:
    """Return the rule of `appearance_of`; without Gaussians, that of plain 2DGS. Raises as it does."""
    appearance = appearance_of(gaussians, textures, layout, settings)
    return appearance.rule(textures, layout) if gaussians.num else PlainRule(max_alpha=settings.texture.max_alpha)


def pairs_of_view(
    gaussians: Gaussians, camera: Camera, rule: AppearanceRule, settings: RenderSettings, num_live: Any = None
) -> int:
    """Return the (splat, tile) pairs of the first `num_live` rows in a view, before the outline test (host)."""
    check_rule(rule)
    camera = finer(camera, settings.supersample)
    try:
        return int(_jitted_count()(gaussians, camera, rule, settings.tile_size, settings.near_plane, num_live))
    except jax.errors.ConcretizationTypeError as error:
        raise ValueError("capacities are planned on the host: call plan_render outside jit and vmap") from error


def rows_of_view(
    gaussians: Gaussians, camera: Camera, rule: AppearanceRule, settings: RenderSettings, num_live: Any = None
) -> int:
    """Return the rows that a device of `settings.exchange` must be able to send to another one in a view (host)."""
    camera = finer(camera, settings.supersample)
    return int(_jitted_rows()(gaussians, camera, rule, settings, num_live))


@functools.cache
def _jitted_rows() -> Jitted[..., Array]:
    return Jitted(_count_rows, static_argnums=(3,))


def _count_rows(
    gaussians: Gaussians, camera: Camera, rule: AppearanceRule, settings: RenderSettings, num_live: Any
) -> Array:
    M, cutoff = _drawn(gaussians, camera, rule, num_live)
    assert settings.exchange is not None
    grid = TileGrid(camera.width, camera.height, settings.tile_size)
    return rows_to_send(settings.exchange, M, cutoff, settings.near_plane, grid)


@functools.cache
def _jitted_count() -> Jitted[..., Array]:
    return Jitted(_count_pairs, static_argnums=(3, 4))


def _count_pairs(
    gaussians: Gaussians, camera: Camera, rule: AppearanceRule, tile_size: int, near_plane: float, num_live: Any
) -> Array:
    M, cutoff = _drawn(gaussians, camera, rule, num_live)
    pixels = _pixels_of(camera, tile_size)
    bounds = screen_bounds(M, cutoff, near_plane)
    return count_pairs(bounds, TileGrid(camera.width, camera.height, tile_size), pixels)


def _drawn(gaussians: Gaussians, camera: Camera, rule: AppearanceRule, num_live: Any) -> tuple[Array, Array]:
    """Return homographies [N, 3, 3] and squared distances [N] of visibility, not positive for rows that do not
    exist."""
    M, _ = homographies(gaussians, camera)
    cutoff = rule.cutoff(rule.opacities(gaussians))
    if num_live is not None:
        cutoff = jnp.where(jnp.arange(gaussians.num, dtype=jnp.int32) < num_live, cutoff, -1.0)
    return M, cutoff


def with_capacity(
    settings: RenderSettings, gaussians: Gaussians, camera: Camera, rule: AppearanceRule, num_live: Any = None
) -> RenderSettings:
    """Return the settings; if they lack a capacity, with one for this view, which an eager call can find.

    Raises:
      ValueError: under jit or vmap without a capacity.
    """
    check_kind("settings", settings, RenderSettings)
    check_rule(rule)
    if settings.capacity is not None:
        return settings
    gaussians, camera, rule, num_live = jax.tree.map(_primal_value, (gaussians, camera, rule, num_live))
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((gaussians, camera, rule, num_live))):
        raise ValueError(
            "settings.capacity is needed under jit and vmap, where shapes are fixed: "
            "settings = plan_render(model, cameras) outside, then pass settings=settings"
        )
    pairs = pairs_of_view(gaussians, camera, rule, settings, num_live)
    return dataclasses.replace(settings, capacity=capacity_for(pairs))


def _primal_value(x: Any) -> Any:
    """Return the concrete array behind the tracers of `jax.grad`, or the tracer if jit or vmap hides the value."""
    while isinstance(x, jax.core.Tracer):
        try:
            return np.asarray(jax.lax.stop_gradient(x))
        except jax.errors.TracerArrayConversionError:
            inner = getattr(x, "primal", None)
            if inner is None:
                return x
            x = inner
    return x


def _tile_batch(settings: RenderSettings) -> int:
    if settings.tile_batch is None:
        return 1 if jax.default_backend() == "cpu" else BATCH_ON_ACCELERATOR
    return settings.tile_batch
