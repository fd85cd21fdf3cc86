"""Front-to-back compositing of tiles, given any appearance, with an exact gradient in constant memory.

`pixel` defines one pixel. A module of `kernels` computes all: `native` on CPUs, `cuda` on NVIDIA GPUs, or `xla`. Each
has a `forward` and a `backward` with the same arguments and results, and JAX chooses among them when it compiles for a
platform (`kernels.platforms`). The compositor "autodiff" has no gradient of its own.

The backward pass walks front to back too (`rasterize.pixel.absorb_vjp`), so that nothing is stored per pixel and splat.
"""

import functools
import importlib
from typing import Any, NoReturn

import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from a2tg_jax.core.bilinear import TextureRegion, within_texels
from a2tg_jax.rasterize import tiles
from a2tg_jax.rasterize.kernels import xla
from a2tg_jax.rasterize.kernels.platforms import by_platform, choose, cotangent_of, instead_of
from a2tg_jax.rasterize.splats import CompositorChoice, PassInputs, PassSettings, Splats
from a2tg_jax.rasterize.tile_pixels import TilePixels
from a2tg_jax.rasterize.tiles import TileGrid, TileLists

TILES_ON_ACCELERATORS = 4096
"""Number of tiles that XLA composites at once if the settings do not say it; 1 on CPUs."""
ADVICE = (
    "compositor={compositor!r} is differentiated once, in reverse mode (jax.grad, jax.vjp, jax.jacrev). "
    "For forward mode (jax.jvp, jax.jacfwd, jax.linearize) and second derivatives, use "
    "RenderSettings(compositor='autodiff')"
)


def composite(
    settings: PassSettings, splats: Splats, texels: Array, regions: TextureRegion | None, cutoff: Array,
    lists: TileLists, jacobian: Array, probe: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Return channels [D, H, W] (red, green, blue(, depth, depth², normal x, y, z)), without the background, and the
    transmittance [H, W] of what is behind all splats.

    Args:
      settings: static settings of the pass.
      splats, texels, regions, cutoff, lists: fields of `PassInputs`; splats and texels are differentiated.
      jacobian: [3, 3] ∂M[:, 2]/∂μ = K·Rc, used only by the statistic.
      probe: [N, 4] zeros. Its gradient is not the image's: columns 0 to 2 are the statistic, Σ_pixels of
        `rasterize.pixel.positional_gradient`, column 3 the number of pixels in which the splat was composited.
    """
    # Kernels follow regions without checking them.
    regions = None if regions is None else within_texels(regions, texels.shape[0])
    if settings.compositor == "autodiff":
        if settings.statistic:
            raise ValueError("the statistic of densification needs another compositor than 'autodiff'")
        inputs = PassInputs(splats, texels, regions, cutoff, lists)

        def on(platform: str) -> Any:
            return functools.partial(xla.composite_in_any_mode, _batched_on(platform, settings))

        # Not `by_platform`, because JAX differentiates the code itself, and must trace it for all platforms.
        per_platform = {"cpu": on("cpu")} if settings.tile_batch is None else {}
        images = jax.lax.platform_dependent(inputs, default=on("other"), **per_platform)
    else:
        mark = functools.partial(_reverse_only, settings.compositor)
        splats, texels, probe = jax.tree.map(mark, (splats, texels, probe))
        images = _composite_tiles(settings, PassInputs(splats, texels, regions, cutoff, lists), jacobian, probe)
    channels, transmittance = images
    return _assemble(channels, settings.grid), _assemble(transmittance, settings.grid)


def _assemble(tiles: Array, grid: TileGrid) -> Array:
    """Assemble tiles [tiles, ..., P] into one image [..., H, W]."""
    inner = tiles.shape[1:-1]
    size = grid.tile_size
    # [rows, columns, ..., y, x] to [..., rows, y, columns, x]; the last tiles may reach beyond the image.
    blocks = tiles.reshape(grid.rows, grid.columns, *inner, size, size)
    image = jnp.moveaxis(blocks, (0, 1), (-4, -2))
    return image.reshape(*inner, grid.rows * size, grid.columns * size)[..., : grid.height, : grid.width]


def list_tiles(
    compositor: CompositorChoice, M: Array, cutoff: Array, near_plane: float, grid: TileGrid, capacity: int,
    pixels: TilePixels | None = None,
) -> TileLists:  # fmt: skip
    """List the splats that touch each tile, as `tiles.tile_lists` does, by native loops where they run.

    If the tiles have pixels with rays, XLA lists the splats.
    """
    if pixels is not None:
        return tiles.tile_lists(M, cutoff, near_plane, grid, capacity, pixels)
    results = (
        jax.ShapeDtypeStruct((capacity,), jnp.int32),
        jax.ShapeDtypeStruct((grid.num + 1,), jnp.int32),
        jax.ShapeDtypeStruct((), jnp.float32),
        jax.ShapeDtypeStruct((), jnp.bool_),
    )
    return TileLists(*by_platform(_lists_on, (compositor, near_plane, grid, capacity), results, M, cutoff))


def _lists_on(platform: str, compositor: CompositorChoice, near_plane: float, grid: TileGrid, capacity: int) -> Any:
    def lists(M: Array, cutoff: Array) -> tuple[Array, ...]:
        # `cuda` has no function of this name.
        tile_lists = getattr(_kernels(compositor, platform), "tile_lists", tiles.tile_lists)
        return tuple(tile_lists(M, cutoff, near_plane, grid, capacity)[:4])

    return lists


def _forward(settings: PassSettings, inputs: PassInputs, jacobian: Array, probe: Array) -> tuple[Array, Array]:
    """Return channels [tiles, D, P] and transmittance [tiles, P]; jacobian and probe are for the backward pass.

    So is the statistic: without it, training and later renders have one kernel.
    """
    tiles = settings.grid.num
    shapes = (tiles, settings.num_channels, settings.num_pixels), (tiles, settings.num_pixels)
    results = tuple(jax.ShapeDtypeStruct(shape, inputs.splats.M.dtype) for shape in shapes)
    return _by_platform("forward", settings._replace(statistic=None), results, inputs)


_composite_tiles = jax.custom_vjp(_forward, nondiff_argnums=(0,))


def _composite_tiles_fwd(
    settings: PassSettings, inputs: PassInputs, jacobian: Array, probe: Array
) -> tuple[tuple[Array, Array], tuple[Any, ...]]:
    """Return the images, and what the backward pass needs: of the images nothing if only colours are differentiated."""
    M, _, opacities, normals, numbers = inputs.splats
    others: Any = M, opacities, normals, numbers, inputs.texels, probe
    only_colors = not any(leaf.perturbed for leaf in others)
    inputs, jacobian, probe = jax.tree.map(lambda leaf: leaf.value, (inputs, jacobian, probe))
    images = _forward(settings, inputs, jacobian, probe)
    return images, (inputs, jacobian, probe, None if only_colors else images)


def _composite_tiles_bwd(
    settings: PassSettings, residuals: tuple[Any, ...], cotangents: tuple[Array, Array]
) -> tuple[PassInputs, None, Array]:
    inputs, jacobian, probe, images = residuals
    g, g_transmittance = map(_instantiated, cotangents)
    if images is None:
        settings = settings._replace(statistic=None, only_colors=True)
        suffix_sum = jnp.zeros_like(g_transmittance)
    else:
        channels, transmittance = images
        # B of the whole list: Σ g·c·α·T over the splats is g·channels, and what is behind them has weight T.
        suffix_sum = jnp.sum(g * channels, axis=1) + g_transmittance * transmittance
    differentiated = inputs.splats, inputs.texels, probe
    results = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), differentiated)
    gradients = _by_platform("backward", settings, results, inputs, jacobian, probe, g, suffix_sum)
    d_splats, d_texels, d_probe = cotangent_of(differentiated, gradients)
    # None: not differentiated.
    d_inputs: Any = (d_splats, d_texels, None, None, None)
    return PassInputs(*d_inputs), None, d_probe


def _instantiated(cotangent: Any) -> Array:
    is_zero = isinstance(cotangent, SymbolicZero)
    return jnp.zeros(cotangent.shape, cotangent.dtype) if is_zero else cotangent


_composite_tiles.defvjp(_composite_tiles_fwd, _composite_tiles_bwd, symbolic_zeros=True)


def _by_platform(name: str, settings: PassSettings, results: Any, *arrays: object) -> Any:
    """Call the function `forward` or `backward` of the kernels of the platform."""
    advice = ADVICE.format(compositor=settings.compositor)
    return by_platform(_pass_on, (name, settings), results, *arrays, advice=advice)


def _pass_on(platform: str, name: str, settings: PassSettings) -> Any:
    kernels = _kernels(settings.compositor, platform)
    reason = None if kernels is xla else kernels.refusal(name, settings.kernel_settings)
    if reason:
        instead_of(settings.compositor, type(settings.static.appearance), reason)
        kernels = xla
    return functools.partial(getattr(kernels, name), _batched_on(platform, settings))


def _kernels(compositor: CompositorChoice, platform: str) -> Any:
    chosen = choose(compositor, platform)
    # Imported here: `native` needs llvmlite, which may be missing, and programs on CPUs do not use `cuda`.
    return xla if chosen in ("xla", "autodiff") else importlib.import_module(f"{xla.__package__}.{chosen}.composite")


def _batched_on(platform: str, settings: PassSettings) -> PassSettings:
    """Return the settings with the number of tiles that XLA composites at once on a platform."""
    num = settings.tile_batch
    if num is None:
        num = 1 if platform == "cpu" else TILES_ON_ACCELERATORS
    return settings._replace(tile_batch=min(num or settings.grid.num, settings.grid.num))


def _refuse(compositor: str) -> NoReturn:
    raise ValueError(ADVICE.format(compositor=compositor))


# Kernels are differentiated once, in reverse mode. JAX's own errors in other modes name neither the renderer nor a
# remedy. So inputs pass through an identity whose linear map of tangents is this primitive: reverse mode transposes it
# away, and only forward mode runs it. (Under `vmap` of tangents, as in `jax.jacfwd`, JAX's error comes first.)
_tangent_p = Primitive("a2tg_reverse_only")
_tangent_p.def_impl(lambda tangent, *, compositor: _refuse(compositor))
_tangent_p.def_abstract_eval(lambda tangent, *, compositor: tangent)
ad.deflinear2(_tangent_p, lambda cotangent, _, *, compositor: [cotangent])
batching.defvectorized(_tangent_p)
mlir.register_lowering(_tangent_p, lambda _, tangent, *, compositor: _refuse(compositor))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _reverse_only(compositor: str, x: object) -> Any:
    """Return an input of the compositor unchanged; derivatives in forward mode raise ValueError."""
    return x


@_reverse_only.defjvp
def _reverse_only_jvp(compositor: str, primals: tuple[object], tangents: tuple[object]) -> tuple[Any, Any]:
    return primals[0], _tangent_p.bind(tangents[0], compositor=compositor)
