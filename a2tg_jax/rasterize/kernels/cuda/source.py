"""Source text of the GPU kernels of one spec: constants, a dialect, the functions of a pixel, and tiles.c."""

import functools
from importlib import resources
from typing import Any, Literal

import jax.numpy as jnp

from a2tg_jax.core import bilinear
from a2tg_jax.core.bilinear import Corner, TextureRegion
from a2tg_jax.rasterize.kernels.cuda.printing import Argument, c_function
from a2tg_jax.rasterize.kernels.jaxprs import CUTOFF_SLACK, PixelFunctions, example, trace
from a2tg_jax.rasterize.splats import KernelSpec

Dialect = Literal["cuda", "opencl"]
MOST_THREADS = 256
WARP = 32


def block_threads(tile_size: int) -> int:
    """Return the threads of a block: a warp or more, and at most 256."""
    return min(MOST_THREADS, -(-(tile_size**2) // WARP) * WARP)


def num_parts(tile_size: int) -> int:
    """Return the blocks that share a tile, for each thread has one pixel."""
    return -(-(tile_size**2) // block_threads(tile_size))


@functools.cache
def source(spec: KernelSpec, dialect: Dialect) -> str:
    """Return the kernels `forward` and `backward` of a spec as text.

    Raises:
      Untranslatable: if the appearance uses a primitive or a dtype that has no translation.
    """
    functions = PixelFunctions(spec)
    constants = _constants(spec, functions.num_planes)
    defines = "".join(f"#define {name} {value}\n" for name, value in constants.items())
    real = f"typedef {'float' if spec.dtype == 'float32' else 'double'} real;\n"
    folder = resources.files(__package__)
    header, kernels = (folder.joinpath(name).read_text(encoding="utf-8") for name in (f"{dialect}.h", "tiles.c"))
    if dialect == "opencl" and spec.dtype == "float64":
        real = "#pragma OPENCL EXTENSION cl_khr_fp64 : enable\n" + real
    return "\n".join([defines + real, header, *_pixel_functions(spec, functions, constants["COUNT"]), kernels])


def _constants(spec: KernelSpec, num_planes: int) -> dict[str, Any]:
    num_numbers = spec.num_floats - 1
    # Sums of a splat over pixels: its planes stand for the nine numbers of M, and the statistic has three. In NUM_SUMS
    # follow the number of pixels and, for textures of one texel, that texel.
    count = num_planes + num_numbers - 9 + (3 if spec.statistic else 0)
    return {
        "TILE_SIZE": spec.tile_size,
        "NUM_PIXELS": spec.tile_size**2,
        "THREADS": block_threads(spec.tile_size),
        "PARTS": num_parts(spec.tile_size),
        # Splats that a block copies to shared memory at a time.
        "BATCH": 64 if spec.dtype == "float32" else 32,
        "NUM_NUMBERS": num_numbers,
        "NUM_PLANES": num_planes,
        "NUM_COLUMNS": spec.num_columns,
        "NUM_CHANNELS": spec.num_channels,
        "COUNT": count,
        "NUM_SUMS": count + 1 + spec.num_columns,
        "HAS_STATISTIC": int(bool(spec.statistic)),
        "IS_FLOAT": int(spec.dtype == "float32"),
        "CUTOFF_SLACK": CUTOFF_SLACK,
    }


def _pixel_functions(spec: KernelSpec, functions: PixelFunctions, count: int) -> list[str]:
    """Return the functions that tiles.c calls; `blend_vjp` writes `count` sums."""
    num_columns, has_texture = spec.num_columns, spec.num_columns > 0
    planes, numbers = Argument("planes", functions.num_planes), Argument("numbers", spec.num_floats - 1)
    M, tile = Argument("numbers", 9), (Argument("tile_x"), Argument("tile_y"))
    region, position = Argument("region", 3 if has_texture else 0, "int"), Argument("position", 2 * has_texture)
    sample = Argument("sample", num_columns)
    pixel = Argument("x"), Argument("y"), Argument("transmittance"), Argument("is_live", kind="int")
    state = Argument("transmittance_after"), Argument("is_live_after", kind="int")
    channels, after = Argument("channels", spec.num_channels), Argument("channels_after", spec.num_channels)
    printed = [
        c_function("prepare", functions.prepare, [M, *tile], [planes]),
        c_function("prepare_vjp", functions.prepare_vjp, [M, *tile, planes], [Argument("d_M", 9)]),
        c_function("reach", functions.reach, [planes, region, *pixel[:2]], [Argument("rho"), position]),
        c_function("blend", functions.forward, [planes, numbers, sample, *pixel, channels], [*state, after]),
        c_function(
            "blend_vjp",
            functions.backward,
            [
                *(planes, numbers, region, Argument("sample", 3 * num_columns), *pixel, Argument("suffix_sum")),
                *(Argument("g", spec.num_channels), Argument("center", 2), Argument("jacobian", 9)),
            ],
            [
                *(*state, Argument("suffix_sum_after"), Argument("contributes", kind="int")),
                *(Argument("d_values", num_columns), Argument("sums", count)),
            ],
        ),
    ]
    return [*printed, *(_texture_functions(spec, region, position) if has_texture else [])]


def _texture_functions(spec: KernelSpec, region: Argument, position: Argument) -> list[str]:
    number, integer = example(spec.dtype), example(jnp.int32)
    place = TextureRegion(integer, integer, integer)
    empty = spec.static.functions.empty

    def corners(region: TextureRegion, x: Any, y: Any) -> Any:
        texels, *weights = zip(*bilinear.corners_of(region, x, y), strict=True)
        return texels, weights

    def interpolate(region: TextureRegion, weights: Any, texels: Any) -> Any:
        around = tuple(Corner(*numbers) for numbers in zip([None] * 4, *weights, strict=True))
        return bilinear.or_empty(bilinear.interpolate(around, texels), region, empty)

    weights, at_corners = ((number,) * 4,) * 3, ((number,) * spec.num_columns,) * 4
    found = [Argument("texel", 4, "int"), Argument("weights", 12)]
    given = [region, Argument("weights", 12), Argument("at_corners", 4 * spec.num_columns)]
    sample = Argument("sample", 3 * spec.num_columns)
    return [
        c_function("corners", trace(corners, place, number, number)[0], [region, position], found),
        c_function("interpolate", trace(interpolate, place, weights, at_corners)[0], given, [sample]),
    ]
