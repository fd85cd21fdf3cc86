"""Checks of a rule's element-wise functions before a compositor traces them.

A rule's `shade` and `falloff` are called with scalars: K numbers of the splat, C values of its texture, and u, v. They
return D colours and a factor. The errors name the rule, what it returned and what was wanted.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.extend.core
import jax.numpy as jnp
from jax import Array

from a2tg_jax.appearance.rule import AppearanceRule, Factor, Residual, RuleAround, StaticRule
from a2tg_jax.core.bilinear import TextureRegion
from a2tg_jax.core.checks import check_kind, described
from a2tg_jax.core.pytree import check_pytree, pytree

ODD_SHAPE = (5, 7)
"""Shape of arrays that fits no matrix in a rule by chance."""


def check_rule(rule: AppearanceRule) -> None:
    """Raise ValueError unless a value is a rule, and it and the rules in it are pytrees."""
    check_kind("rule", rule, AppearanceRule)
    check_pytree("rule", rule)


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Numbers and dtype of the arguments of a rule's element-wise functions."""

    num_numbers: int
    """Number K of numbers of a splat."""
    num_values: int
    """Number C of values of a texture; 0 without textures."""
    num_colors: int
    """Number D of colours of a splat."""
    dtype: Any
    """Dtype of all floats."""

    def of(self, shape: tuple[int, ...]) -> dict[str, tuple[Any, ...]]:
        """Return the arguments of each function, as arrays of one shape without values."""
        number: Any = jax.ShapeDtypeStruct(shape, self.dtype)
        integer: Any = jax.ShapeDtypeStruct(shape, jnp.int32)
        numbers = (number,) * self.num_numbers
        functions: dict[str, tuple[Any, ...]] = {
            "shade": (numbers, (number,) * self.num_values, number, number),
            "falloff": (numbers, number),
        }
        if self.num_values:
            functions["texel_position"] = (TextureRegion(integer, integer, integer), number, number)
        return functions


@functools.lru_cache(maxsize=256)
def check_shading(static: StaticRule, arguments: Arguments) -> None:
    """Raise unless the element-wise functions of a rule take scalars and return what the compositor needs.

    Raises:
      ValueError: if a result has another form than it must have.
      Exception: what the rule's own code raises, with a note that names the rule and the arguments.
    """
    name, functions = static.name, arguments.of(())
    shaded = _traced(static, "shade", functions, arguments)
    wanted = f"(residual, factor): {arguments.num_colors} colours that are added, or None, and a factor, or None"
    if not isinstance(shaded, tuple | list) or len(shaded) != 2:
        raise ValueError(f"{name}.shade must return {wanted}; it returned {described(shaded)}")
    residual, factor = shaded
    if residual is not None and _sizes(residual) != ((),) * arguments.num_colors:
        raise ValueError(f"{name}.shade must return {wanted}; the residual is {described(residual)}")
    if factor is not None and _sizes((factor,)) != ((),):
        raise ValueError(f"{name}.shade must return {wanted}; the factor is {described(factor)}")
    weight = _traced(static, "falloff", functions, arguments)
    if _sizes((weight,)) != ((),):
        raise ValueError(f"{name}.falloff must return one number for one rho; it returned {described(weight)}")
    if "texel_position" in functions:
        position = _traced(static, "texel_position", functions, arguments)
        if _sizes(position) != ((), ()):
            raise ValueError(
                f"{name}.texel_position must return (x, y), two numbers; it returned {described(position)}"
            )


def _traced(static: StaticRule, function: str, functions: dict[str, tuple[Any, ...]], arguments: Arguments) -> Any:
    """Return what a function of a rule returns for scalars, without values."""
    try:
        return jax.eval_shape(getattr(static.rule, function), *functions[function])
    except Exception as error:
        error.add_note(
            f"This happened in {static.name}.{function}, which is called with scalars of {arguments.dtype}: "
            f"K = {arguments.num_numbers} numbers, and C = {arguments.num_values} texture values."
        )
        if isinstance(error, jax.errors.TracerBoolConversionError):
            error.add_note("Its numbers have no values yet: use jnp.where in place of if.")
        raise


def _sizes(values: Any) -> tuple[tuple[int, ...], ...] | None:
    """Return the shapes of several numbers, or of the entries of an array of them; None for anything else."""
    if hasattr(values, "shape"):
        return (tuple(values.shape[1:]),) * values.shape[0] if values.shape else None
    if not isinstance(values, tuple | list) or not all(hasattr(value, "shape") for value in values):
        return None
    return tuple(tuple(value.shape) for value in values)


@functools.lru_cache(maxsize=256)
def takes_arrays(static: StaticRule, arguments: Arguments) -> bool:
    """Return whether the element-wise functions of a rule also take arrays, entry by entry.

    A matrix product in `shade` takes scalars only: with arrays of pixels it would contract the pixels.
    """
    functions = arguments.of(ODD_SHAPE)
    return all(_is_elementwise(getattr(static.rule, name), functions[name], arguments) for name in functions)


def _is_elementwise(function: Callable[..., Any], given: tuple[Any, ...], arguments: Arguments) -> bool:
    try:
        results = jax.make_jaxpr(function)(*given).jaxpr.outvars
    except Exception:  # Any error of the rule's code: it has passed with scalars, so it cannot take arrays.
        return False
    shapes = ODD_SHAPE, (arguments.num_colors, *ODD_SHAPE)
    return all(isinstance(result, jax.extend.core.Literal) or result.aval.shape in shapes for result in results)


def elementwise_rule(static: StaticRule, arguments: Arguments) -> Any:
    """Return the rule as its element-wise functions see it, made to take arrays if they take scalars only."""
    return static.rule if takes_arrays(static, arguments) else OneByOne(static.rule)


@pytree
class OneByOne(RuleAround):
    """Rule whose element-wise functions take arrays, though those of `inner` take scalars only."""

    def texel_position(self, region: TextureRegion, u: Array, v: Array) -> tuple[Array, Array]:
        position: tuple[Array, Array] = _mapped(self.inner.texel_position, region, u, v)
        return position

    def shade(
        self, numbers: tuple[Array, ...], values: tuple[Array, ...], u: Array, v: Array
    ) -> tuple[Residual, Factor]:
        def shade(*given: Any) -> tuple[Residual, Factor]:
            residual, factor = self.inner.shade(*given)
            return None if residual is None else tuple(residual), factor

        shaded: tuple[Residual, Factor] = _mapped(shade, numbers, values, u, v)
        return shaded

    def falloff(self, numbers: tuple[Array, ...], rho: Array) -> Array:
        kernel: Array = _mapped(self.inner.falloff, numbers, rho)
        return kernel


def _mapped(function: Callable[..., Any], *given: Any) -> Any:
    """Call a function of scalars for each entry of arrays that broadcast."""
    leaves, structure = jax.tree.flatten(given)
    shape = jnp.broadcast_shapes(*(jnp.shape(leaf) for leaf in leaves))
    flat = [jnp.broadcast_to(leaf, shape).reshape(-1) for leaf in leaves]
    results = jax.vmap(lambda *scalars: function(*jax.tree.unflatten(structure, scalars)))(*flat)
    return jax.tree.map(lambda result: result.reshape(shape), results)
