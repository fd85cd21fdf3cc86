"""Source text of the GPU kernels of one kind of pass: constants, a dialect, the functions of a pixel, and tiles.c.

The functions are scalar JAX functions, printed as C in the dialect that CUDA C++ and OpenCL C share. A function, and
its derivative, is defined once, in JAX, and traced once to a jaxpr. Each primitive becomes a line.
Native loops (`native.lanes`) translate the same primitives, plus a few of their own formulas.

Operands are names of variables or literals. Flags are `int`, 0 or 1. Integers behave as XLA's: x / 0 = −1. Functions
that are spelled `a2tg_…` are defined in `cuda.h` and `opencl.h`.
"""

import functools
from collections.abc import Callable, Sequence
from importlib import resources
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.extend import core
from jax.typing import ArrayLike, DTypeLike

from a2tg_jax.core import bilinear
from a2tg_jax.core.bilinear import Corner, TextureRegion
from a2tg_jax.rasterize.kernels.jaxprs import (
    CUTOFF_SLACK,
    Equation,
    PixelFunctions,
    Untranslatable,
    example,
    make_code,
    operand_dtype,
    result_dtype,
    trace,
)
from a2tg_jax.rasterize.splats import PassSettings

Dialect = Literal["cuda", "opencl"]
MOST_THREADS = 256
WARP = 32
C_TYPES = {"float32": "float", "float64": "double", "bool": "int", "int32": "int", "int64": "long"}
Emitter = Callable[[list[str], Equation], str]
"""(operands, equation) to an expression."""


def block_threads(tile_size: int) -> int:
    """Return the threads of a block: a warp or more, and at most 256."""
    return min(MOST_THREADS, -(-(tile_size**2) // WARP) * WARP)


def num_parts(tile_size: int) -> int:
    """Return the blocks that share a tile, for each thread has one pixel."""
    return -(-(tile_size**2) // block_threads(tile_size))


@functools.cache
def source(kernel: PassSettings, dialect: Dialect) -> str:
    """Return the kernels `forward` and `backward` as text.

    Raises:
      Untranslatable: if the appearance uses a primitive or a dtype that has no translation.
    """
    functions = PixelFunctions(kernel)
    tile_size = kernel.grid.tile_size
    num_numbers = kernel.num_floats - 1
    # Sums of a splat over pixels: its planes replace the nine numbers of M, and the statistic has three. NUM_SUMS also
    # counts the number of pixels and, for textures of one texel, that texel.
    count = functions.num_planes + num_numbers - 9 + (3 if kernel.statistic else 0)
    constants: dict[str, Any] = {
        "TILE_SIZE": tile_size,
        "NUM_PIXELS": kernel.num_pixels,
        "THREADS": block_threads(tile_size),
        "PARTS": num_parts(tile_size),
        # Splats that a block copies to shared memory at a time.
        "BATCH": 64 if kernel.dtype == "float32" else 32,
        "NUM_NUMBERS": num_numbers,
        "NUM_PLANES": functions.num_planes,
        "NUM_VALUES": kernel.num_values,
        "NUM_CHANNELS": kernel.num_channels,
        "COUNT": count,
        "NUM_SUMS": count + 1 + kernel.num_values,
        "HAS_STATISTIC": int(bool(kernel.statistic)),
        "IS_FLOAT": int(kernel.dtype == "float32"),
        "CUTOFF_SLACK": CUTOFF_SLACK,
    }
    defines = "".join(f"#define {name} {value}\n" for name, value in constants.items())
    real = f"typedef {'float' if kernel.dtype == 'float32' else 'double'} real;\n"
    folder = resources.files(__package__)
    header = folder.joinpath(f"{dialect}.h").read_text(encoding="utf-8")
    kernels = folder.joinpath("tiles.c").read_text(encoding="utf-8")
    if dialect == "opencl" and kernel.dtype == "float64":
        real = "#pragma OPENCL EXTENSION cl_khr_fp64 : enable\n" + real
    return "\n".join([defines + real, header, *_pixel_functions(kernel, functions, count), kernels])


class Argument(NamedTuple):
    """A parameter of a C function: `num` numbers of a C type, or a scalar."""

    name: str
    num: int | None = None
    kind: str = "real"

    def entries(self) -> list[str]:
        """Return its numbers as C expressions; a scalar that is written is `*name`."""
        return [self.name] if self.num is None else [f"{self.name}[{k}]" for k in range(self.num)]


def _pixel_functions(kernel: PassSettings, functions: PixelFunctions, count: int) -> list[str]:
    """Return the functions that tiles.c calls; `blend_vjp` writes `count` sums."""
    num_values = kernel.num_values
    has_texture = kernel.num_values > 0
    planes = Argument("planes", functions.num_planes)
    numbers = Argument("numbers", kernel.num_floats - 1)
    M = Argument("numbers", 9)
    tile = (Argument("tile_x"), Argument("tile_y"))
    region = Argument("region", 3 if has_texture else 0, "int")
    position = Argument("position", 2 * has_texture)
    sample = Argument("sample", num_values)
    pixel = Argument("x"), Argument("y"), Argument("transmittance"), Argument("is_live", kind="int")
    state = Argument("transmittance_after"), Argument("is_live_after", kind="int")
    channels = Argument("channels", kernel.num_channels)
    channels_after = Argument("channels_after", kernel.num_channels)
    printed = [
        c_function("prepare", functions.prepare, [M, *tile], [planes]),
        c_function("prepare_vjp", functions.prepare_vjp, [M, *tile, planes], [Argument("d_M", 9)]),
        c_function("reach", functions.reach, [planes, region, *pixel[:2]], [Argument("rho"), position]),
        c_function("blend", functions.forward, [planes, numbers, sample, *pixel, channels], [*state, channels_after]),
        c_function(
            "blend_vjp",
            functions.backward,
            [
                *(planes, numbers, region, Argument("sample", 3 * num_values), *pixel, Argument("suffix_sum")),
                *(Argument("g", kernel.num_channels), Argument("center", 2), Argument("jacobian", 9)),
            ],
            [
                *(*state, Argument("suffix_sum_after"), Argument("contributes", kind="int")),
                *(Argument("d_values", num_values), Argument("sums", count)),
            ],
        ),
    ]
    return [*printed, *(_texture_functions(kernel, region, position) if has_texture else [])]


def _texture_functions(kernel: PassSettings, region: Argument, position: Argument) -> list[str]:
    number = example(kernel.dtype)
    integer = example(jnp.int32)
    place = TextureRegion(integer, integer, integer)
    empty = kernel.static.functions.empty

    def corners(region: TextureRegion, x: Any, y: Any) -> Any:
        texels, *weights = zip(*bilinear.corners_of(region, x, y), strict=True)
        return texels, weights

    def interpolate(region: TextureRegion, weights: Any, texels: Any) -> Any:
        around = tuple(Corner(*numbers) for numbers in zip([None] * 4, *weights, strict=True))
        return bilinear.or_empty(bilinear.interpolate(around, texels), region, empty)

    weights = ((number,) * 4,) * 3
    at_corners = ((number,) * kernel.num_values,) * 4
    texel = Argument("texel", 4, "int")
    weight = Argument("weights", 12)
    at_corner = Argument("at_corners", 4 * kernel.num_values)
    sample = Argument("sample", 3 * kernel.num_values)
    return [
        c_function("corners", trace(corners, place, number, number)[0], [region, position], [texel, weight]),
        c_function(
            "interpolate",
            trace(interpolate, place, weights, at_corners)[0],
            [region, weight, at_corner],
            [sample],
        ),
    ]


def c_function(name: str, closed: core.ClosedJaxpr, inputs: Sequence[Argument], outputs: Sequence[Argument]) -> str:
    """Return a C function that evaluates a jaxpr of scalars; Untranslatable if a primitive or a dtype cannot be.

    The inputs hold the jaxpr's arguments, one number each, in order; the outputs receive its results.
    """
    lines: list[str] = []

    def variable(dtype: DTypeLike, value: str) -> str:
        lines.append(f"{_c_type(dtype)} v{len(lines)} = {value};")
        return f"v{len(lines) - 1}"

    def assign(emit: Emitter, operands: list[str], equation: Equation) -> str:
        return variable(result_dtype(equation), emit(operands, equation))

    entries = [entry for argument in inputs for entry in argument.entries()]
    # Copied, because a result may have the same address as an argument.
    copies = [variable(aval.dtype, entry) for aval, entry in zip(closed.in_avals, entries, strict=True)]
    primitives = {name: functools.partial(assign, emit) for name, emit in PRIMITIVES.items()}
    results = make_code(closed, copies, literal, primitives, "GPU kernels")
    places = [entry if a.num is not None else f"*{entry}" for a in outputs for entry in a.entries()]
    parameters = [f"{a.kind} {a.name}" if a.num is None else f"const {a.kind} *{a.name}" for a in inputs]
    parameters += [f"{a.kind} *{a.name}" for a in outputs]
    stores = [f"{place} = {result};" for place, result in zip(places, results, strict=True)]
    body = "\n".join(f"  {line}" for line in [*lines, *stores])
    return f"INLINE void {name}({', '.join(parameters)}) {{\n{body}\n}}\n"


def _c_type(dtype: DTypeLike) -> str:
    name = np.dtype(dtype).name
    if name not in C_TYPES:
        raise Untranslatable(f"GPU kernels have no numbers of type {name}")
    return C_TYPES[name]


def literal(value: ArrayLike, dtype: DTypeLike) -> str:
    """Return a number as a C literal, exact to the last bit."""
    kind = _c_type(dtype)
    dtype = np.dtype(dtype)
    if dtype.kind in "bi":
        number = int(value)  # type: ignore[arg-type]
        suffix = "l" if dtype.itemsize == 8 else ""
        # C reads −2³¹ as minus a number that does not fit.
        is_least = dtype.kind == "i" and number == np.iinfo(dtype).min
        return f"({number + 1}{suffix} - 1)" if is_least else f"({number}{suffix})"
    real = float(value)  # type: ignore[arg-type]
    if real != real:
        return f"a2tg_nan_{kind}()"
    if abs(real) == np.inf:
        return f"({'-' if real < 0 else ''}a2tg_inf_{kind}())"
    # Hexadecimal floats are read without rounding.
    return f"({real.hex()}{'f' if dtype.itemsize == 4 else ''})"


def _is_float(equation: Equation) -> bool:
    return operand_dtype(equation).kind == "f"


def _infix(symbol: str) -> Emitter:
    return lambda x, _: f"{x[0]} {symbol} {x[1]}"


def _call(name: str) -> Emitter:
    return lambda x, _: f"{name}({', '.join(x)})"


def _extreme(symbol: str) -> Emitter:
    """Make an emitter of the larger or smaller of two numbers; NaN if one is NaN."""

    def emit(x: list[str], equation: Equation) -> str:
        or_nan = f" || {x[0]} != {x[0]}" if _is_float(equation) else ""
        return f"({x[0]} {symbol} {x[1]}{or_nan}) ? {x[0]} : {x[1]}"

    return emit


def _divide(x: list[str], equation: Equation) -> str:
    if _is_float(equation):
        return f"{x[0]} / {x[1]}"
    # Processors may trap at the least integer over −1.
    return f"{x[1]} == 0 ? -1 : {x[1]} == -1 ? -{x[0]} : {x[0]} / {x[1]}"


def _convert(x: list[str], equation: Equation) -> str:
    source = operand_dtype(equation)
    target = result_dtype(equation)
    if target == np.bool_:
        return f"{x[0]} != 0"
    cast = f"({_c_type(target)}){x[0]}"
    if source.kind == "f" and target.kind == "i":
        info = np.iinfo(target)
        # The floats at and beyond which a conversion gives the least and the largest integer.
        low = literal(float(info.min), source)
        high = literal(float(source.type(info.max)), source)
        least = literal(info.min, target)
        most = literal(info.max, target)
        return f"{x[0]} != {x[0]} ? 0 : {x[0]} <= {low} ? {least} : {x[0]} >= {high} ? {most} : {cast}"
    return cast


def _select(x: list[str], equation: Equation) -> str:
    index, first, *others = x
    if operand_dtype(equation) == np.bool_:
        return f"{index} ? {others[0]} : {first}"
    cases = [f"{index} <= {k} ? {value} : " for k, value in enumerate([first, *others[:-1]])]
    return "".join(cases) + (others[-1] if others else first)


PRIMITIVES: dict[str, Emitter] = {
    **{name: _call(name) for name in ("ceil", "cos", "exp", "floor", "log", "pow", "sin", "sqrt", "tanh")},
    **{"add": _infix("+"), "add_any": _infix("+"), "sub": _infix("-"), "mul": _infix("*")},
    **{"eq": _infix("=="), "ne": _infix("!="), "lt": _infix("<"), "le": _infix("<="), "gt": _infix(">")},
    **{"ge": _infix(">="), "and": _infix("&"), "or": _infix("|"), "max": _extreme(">"), "min": _extreme("<")},
    "abs": lambda x, equation: f"fabs({x[0]})" if _is_float(equation) else f"({x[0]} < 0 ? -{x[0]} : {x[0]})",
    "convert_element_type": _convert,
    "div": _divide,
    "neg": lambda x, _: f"-{x[0]}",
    "not": lambda x, equation: f"!{x[0]}" if operand_dtype(equation) == np.bool_ else f"~{x[0]}",
    "select_n": _select,
    "stop_gradient": lambda x, _: x[0],
}
"""Emitters by the name of the primitive; `jaxprs.FORMULAS` has the others."""
