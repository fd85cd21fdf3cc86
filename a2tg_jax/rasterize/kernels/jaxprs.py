"""The scalar functions that kernels apply, as jaxprs: traced once, then evaluated equation by equation.

`native` and `cuda` make code of the same jaxprs. A value stands for a number in the code that is being made.
"""

import concurrent.futures
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.extend import core
from jax.typing import ArrayLike, DTypeLike

from a2tg_jax.core.bilinear import Lookup, Sample, TextureRegion
from a2tg_jax.core.geometry import Outline
from a2tg_jax.rasterize import pixel
from a2tg_jax.rasterize.splats import PassSettings
from a2tg_jax.rasterize.tiles import outline_touches

Equation = core.JaxprEqn
V = TypeVar("V")
"""What stands for a number in the code that is being made."""
CALLS = {
    *("jit", "pjit", "closed_call", "core_call", "call", "remat", "remat2", "checkpoint"),
    *("custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr"),
}
"""Primitives that run their jaxpr once, by their names in all versions of JAX from 0.10 on."""
CUTOFF_SLACK = 1e-3
"""Margin of the squared distance within which kernels evaluate a pixel; what it then shows is exact."""


class Untranslatable(ValueError):
    """Error of a function that cannot become a kernel; the message names the obstacle."""

    primitive: str | None = None
    """Name of the primitive that has no translation, if it is one."""


def example(dtype: DTypeLike) -> Any:
    """Return an abstract scalar as an example for `trace`."""
    return jax.ShapeDtypeStruct((), dtype)


def trace(function: Callable[..., object], *examples: object) -> tuple[core.ClosedJaxpr, Any]:
    """Return the jaxpr of a function of scalars, and the tree structure of its result.

    The jaxpr does not depend on what is being traced around it, such as the axes of a `shard_map` or a mesh. The
    examples are pytrees of `example`, one per argument.
    """
    closed, shape = in_clean_context(lambda: jax.make_jaxpr(function, return_shape=True)(*examples))
    return closed, jax.tree.structure(shape)


def in_clean_context(work: Callable[[], object]) -> Any:
    """Return work(), called on a new thread, where JAX traces nothing else, with the caller's dtype rules."""
    config: Any = jax.config
    is_x64 = config.jax_enable_x64
    promotion = config.jax_numpy_dtype_promotion

    def with_rules() -> Any:
        with jax.enable_x64(is_x64), jax.numpy_dtype_promotion(promotion):
            return work()

    # The caller waits: nothing runs at the same time.
    with concurrent.futures.ThreadPoolExecutor(1, thread_name_prefix="a2tg-trace") as pool:
        return pool.submit(with_rules).result()


def _whole_power(x: Array, y: int) -> Array:
    """Return x^y by repeated squaring: bits of |y| from the lowest on, as the power runs through x, x², x⁴, …"""
    power = x
    bits = abs(y)
    result = None
    while bits:
        if bits & 1:
            result = power if result is None else result * power
        bits >>= 1
        power = power * power if bits else power
    result = jnp.ones_like(x) if result is None else result
    return 1 / result if y < 0 else result


FORMULAS: dict[str, Callable[..., Array]] = {
    "integer_pow": _whole_power,
    "logistic": lambda x: 1 / (1 + jnp.exp(-x)),
    # Zeros keep their sign, and NaN stays NaN.
    "sign": lambda x: jnp.where(x > 0, jnp.ones_like(x), jnp.where(x < 0, -jnp.ones_like(x), x)),
    "square": lambda x: x * x,
}
"""Primitives that are made of others, by name; they take the parameters of the equation."""


@functools.cache
def _formula(name: str, dtype: str, **parameters: Any) -> core.ClosedJaxpr:
    return trace(functools.partial(FORMULAS[name], **parameters), example(dtype))[0]


def make_code(
    jaxpr: Any, arguments: Sequence[V], literal: Callable[[ArrayLike, DTypeLike], V],
    primitives: Mapping[str, Callable[[list[V], Equation], V]], target: str,
) -> list[V]:  # fmt: skip
    """Make code of a jaxpr of scalars; return the values of its results.

    Args:
      jaxpr: the jaxpr, closed or without constants.
      arguments: values of its arguments.
      literal: function of a number and its dtype that returns the number's value.
      primitives: by the name of a primitive, the function of operands and equation that returns the result's value.
      target: kind of kernels, for errors.

    Raises:
      Untranslatable: if a primitive has no translation, or a number is an array.
    """
    inner: core.Jaxpr = getattr(jaxpr, "jaxpr", jaxpr)
    values: dict[core.Var, V] = dict(zip(inner.invars, arguments, strict=True))
    constants = dict(zip(inner.constvars, getattr(jaxpr, "consts", ()), strict=True))

    def read(atom: Any) -> V:
        if not isinstance(atom, core.Literal) and atom not in constants:
            return values[atom]
        number: Any = atom.val if isinstance(atom, core.Literal) else constants[atom]
        if np.shape(number):
            # Such as a table: kernels keep numbers in registers, which cannot be indexed.
            raise Untranslatable(f"{target} take functions of scalars; a constant has shape {np.shape(number)}")
        return literal(number, atom.aval.dtype)

    for equation in inner.eqns:
        name = equation.primitive.name
        operands = [read(atom) for atom in equation.invars]
        if name in CALLS:
            called = equation.params["jaxpr"] if "jaxpr" in equation.params else equation.params["call_jaxpr"]
            results = make_code(called, operands, literal, primitives, target)
        elif name in FORMULAS:
            parameters = {"y": equation.params["y"]} if name == "integer_pow" else {}
            formula = _formula(name, operand_dtype(equation).name, **parameters)
            results = make_code(formula, operands, literal, primitives, target)
        elif name in primitives:
            results = [primitives[name](operands, equation)]
        else:
            error = Untranslatable(f"{target} have no translation for the primitive '{name}'")
            error.primitive = name
            raise error
        values.update(zip(equation.outvars, results, strict=True))
    return [read(atom) for atom in inner.outvars]


def operand_dtype(equation: Equation) -> np.dtype:
    return np.dtype(equation.invars[0].aval.dtype)  # type: ignore[attr-defined]


def result_dtype(equation: Equation) -> np.dtype:
    return np.dtype(equation.outvars[0].aval.dtype)  # type: ignore[attr-defined]


class PixelFunctions:
    """Jaxprs of scalars for the settings of a kernel.

    `prepare` and `prepare_vjp` run once per splat and tile; `reach`, `forward` and `backward` run at every pixel.
    """

    def __init__(self, settings: PassSettings):
        self.settings = settings
        self._functions = settings.static.functions
        number = example(settings.dtype)
        integer = example(jnp.int32)
        flag = example(jnp.bool_)
        triple = (number,) * 3
        normal = triple if settings.has_geometry else None
        numbers = (number,) * settings.num_own_numbers
        splat = pixel.Splat((triple,) * 3, number, (number,) * settings.num_colors, normal, numbers)
        values = (number,) * settings.num_values
        region = TextureRegion(integer, integer, integer) if values else None
        lookup = Lookup(region, Sample(values, values, values)) if region else None

        tile = (number,) * (6 if settings.has_rays else 2)
        self.num_tile_numbers = len(tile)
        self.prepare, structure = trace(pixel.planes_of, splat.M, tile)
        self.num_planes = structure.num_leaves
        planes = jax.tree.unflatten(structure, [number] * structure.num_leaves)
        outline = Outline._make([number] * (len(Outline._fields) - 1) + [flag])
        self.touches, _ = trace(outline_touches, outline, *(number,) * 4)
        self.reach, _ = trace(self._reach, planes, region, number, number)
        at_pixel = (number, number, number, flag)
        channels = (number,) * settings.num_channels
        self._of_vjp = splat.M, tile, planes
        self._of_forward = planes, splat, values, *at_pixel, channels
        self._of_backward = planes, splat, lookup, *at_pixel, number, channels, tile, (triple,) * 3

    # Of these a pass uses one or two.
    @functools.cached_property
    def prepare_vjp(self) -> core.ClosedJaxpr:
        return trace(_planes_vjp, *self._of_vjp)[0]

    @functools.cached_property
    def forward(self) -> core.ClosedJaxpr:
        return trace(self._forward, *self._of_forward)[0]

    @functools.cached_property
    def backward(self) -> core.ClosedJaxpr:
        return trace(self._backward, *self._of_backward)[0]

    def _reach(
        self, planes: pixel.Planes, region: TextureRegion | None, x: Array, y: Array
    ) -> tuple[Array, tuple[Array, ...]]:
        """Return the squared distance ρ of the pixel, and the position of the texture lookup."""
        hit = pixel.intersect(planes, x, y, self.settings.near_plane, self._functions.has_low_pass)
        return hit.rho, () if region is None else self._functions.texel_position(region, hit.u, hit.v)

    def _forward(
        self, planes: pixel.Planes, splat: pixel.Splat, values: tuple[Array, ...], x: Array, y: Array,
        transmittance: Array, is_live: Array, channels: tuple[Array, ...],
    ) -> tuple[Array, Array, tuple[Array, ...]]:  # fmt: skip
        """Return transmittance and liveness behind the splat, and the channels with it."""
        at_pixel = planes, splat, values, x, y, transmittance, is_live
        added, transmittance, is_live = pixel.blend(self._functions, self.settings.near_plane, *at_pixel)
        return transmittance, is_live, tuple(total + more for total, more in zip(channels, added, strict=True))

    def _backward(
        self, planes: pixel.Planes, splat: pixel.Splat, lookup: Lookup | None, x: Array, y: Array,
        transmittance: Array, is_live: Array, suffix_sum: Array, g: tuple[Array, ...], tile: pixel.TileNumbers,
        jacobian: pixel.Rows,
    ) -> tuple[pixel.State, Array, tuple[Array, ...], Any]:  # fmt: skip
        """Return the state behind the splat, whether it contributes, the cotangents of the values, and all others."""
        near_plane = self.settings.near_plane
        statistic = self.settings.statistic
        functions = self._functions
        at_pixel = planes, splat, lookup, x, y, transmittance, is_live, suffix_sum, g
        state, weight, d = pixel.blend_vjp(
            functions, near_plane, *at_pixel, statistic is not None, self.settings.only_colors
        )
        added: tuple[Array, ...] = ()
        if statistic and d.rho is not None:
            hit = pixel.intersect(planes, x, y, near_plane, functions.has_low_pass)
            added = pixel.positional_gradient(statistic, splat.M, hit, x, y, tile, d.rho, jacobian)
        # Without weight the cotangents may be anything, NaN included; kernels leave them out.
        return state, weight != 0, d.values, (d.planes, d.opacity, d.color, d.normal, d.numbers, added)


def _planes_vjp(M: pixel.Rows, tile: pixel.TileNumbers, d_planes: pixel.Planes) -> pixel.Rows:
    return jax.vjp(lambda M: pixel.planes_of(M, tile), M)[1](d_planes)[0]


def refusal_of(settings: PassSettings, translate: Callable[[PassSettings], object]) -> str | None:
    """Return why a kind of kernels cannot be made for settings; None if `translate` makes them."""
    try:
        translate(settings)
    except Untranslatable as error:
        return str(error) + (_place_of(error.primitive, settings) if error.primitive else "")
    return None


def _place_of(primitive: str, settings: PassSettings) -> str:
    """Return in which function of an appearance a primitive occurs, as in " in MyRule.shade"; "" if in none."""

    def gradient(*arguments: Any) -> Any:
        results, pull_back = jax.vjp(function, *arguments)
        return pull_back(results)

    for name, examples in settings.arguments.of(()).items():
        function = getattr(settings.static.functions, name)
        if primitive in _primitives(trace(function, *examples)[0]):
            return f" in {settings.static.name}.{name}"
        # Texture regions are integers, which have no gradient.
        if name != "texel_position" and primitive in _primitives(trace(gradient, *examples)[0]):
            return f" in the gradient of {settings.static.name}.{name}"
    return ""


def _primitives(jaxpr: Any) -> set[str]:
    """Return the names of the primitives of a jaxpr and of the jaxprs within it."""
    names: set[str] = set()
    for equation in getattr(jaxpr, "jaxpr", jaxpr).eqns:
        inner = [leaf for leaf in jax.tree.leaves(tuple(equation.params.values())) if hasattr(leaf, "eqns")]
        names |= {equation.primitive.name}.union(*map(_primitives, inner))
    return names
