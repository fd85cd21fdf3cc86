"""The element-wise functions of an appearance, composed with its parts, as compositors trace and compile them.

They are called with scalars, or with arrays that broadcast: K numbers of the splat, C values of its texture, and u, v.
Errors of `check_shading` name the appearance, its result and the requirement.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, NoReturn

import jax
import jax.extend.core
import jax.numpy as jnp
from jax import Array

from a2tg_jax.appearance.base import Appearance, check_arrays_given, without_arrays
from a2tg_jax.appearance.parts import Curve, Factor, Residual, Tint, falloff_of
from a2tg_jax.base.checks import check_kind, described
from a2tg_jax.core.bilinear import TextureRegion
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.pytree import check_pytree
from a2tg_jax.core.table import check_table, is_table
from a2tg_jax.texture import NEUTRAL_TEXEL

ODD_SIZES = (5, 7)
"""Odd sizes of test arrays, which no matrix in an appearance fits by chance."""
CURVE = len(Curve._fields)


def check_is_appearance(appearance: Any, gaussians: Gaussians | None = None) -> None:
    """Raise ValueError unless a value is an appearance with its arrays, it and the dataclasses in it are pytrees, and
    its tables, such as textures, fit the Gaussians, if given."""
    check_kind("appearance", appearance, Appearance)
    check_pytree("appearance", appearance)
    check_arrays_given(appearance)
    if gaussians is None:
        return
    for path, leaf in jax.tree_util.tree_leaves_with_path(appearance, is_leaf=is_table):
        if is_table(leaf):
            check_table(leaf, gaussians.num, "appearance" + jax.tree_util.keystr(path))


class Elementwise(NamedTuple):
    """Per-pixel methods of an appearance, composed with its parts."""

    texel_position: Callable[[TextureRegion, Array, Array], tuple[Array, Array]]
    shade: Callable[[tuple[Array, ...], tuple[Array, ...], Array, Array], tuple[Residual, Factor, Tint]]
    falloff: Callable[[tuple[Array, ...], Array], Array]
    max_alpha: float
    has_low_pass: bool
    empty: tuple[float, ...]  # Values of a splat without a texture; () if all splats have one.


@dataclasses.dataclass(frozen=True)
class StaticShading:
    """An appearance without its arrays; hashable, so that code can be compiled for it."""

    appearance: Appearance
    """The appearance with a stand-in for each array, every use of which raises."""

    @staticmethod
    def of(appearance: Appearance) -> "StaticShading":
        name = type(appearance).__name__
        return StaticShading(without_arrays(appearance, lambda path: _LeftOut(f"{name}.{path}")))

    @property
    def name(self) -> str:
        """Name of the appearance's class."""
        return type(self.appearance).__name__

    @property
    def functions(self) -> Elementwise:
        """The functions, composed with exponents and features."""
        appearance = self.appearance
        has_curve = appearance.exponents is not None
        has_features = appearance.features is not None

        def shade(numbers: tuple[Array, ...], values: tuple[Array, ...], u: Array, v: Array) -> Any:
            # The curve is last (`numbers_in_view`).
            shaded: Any = appearance.shade(numbers[:-CURVE] if has_curve else numbers, values, u, v)
            if not isinstance(shaded, tuple | list) or len(shaded) not in (2, 3):
                return shaded  # `check_shading` names a result of another form.
            residual, factor, tint = (*shaded, None)[:3]
            # Features replace all colour, residual and tint as well.
            return (None, factor, None) if has_features else (residual, factor, tint)

        def falloff(numbers: tuple[Array, ...], rho: Array) -> Array:
            return falloff_of(Curve(*numbers[-CURVE:]), rho) if has_curve else appearance.falloff(numbers, rho)

        return Elementwise(
            appearance.texel_position,
            shade,
            falloff,
            appearance.alpha_limit,
            appearance.has_low_pass,
            empty=appearance.empty if appearance.texture is None else NEUTRAL_TEXEL,
        )


class _LeftOut:
    """Stand-in for an array of an appearance. Every use raises an error with a remedy."""

    def __init__(self, name: str):
        self._name = name

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _LeftOut) and self._name == other._name

    def __hash__(self) -> int:
        return hash(self._name)

    def __repr__(self) -> str:
        # Without an address: compiled kernels have the same name in every process, for XLA's compilation cache.
        return f"<array {self._name}>"

    def _refuse(self, *_: object) -> NoReturn:
        raise ValueError(
            f"{self._name} is an array, and texel_position, shade and falloff can use only the static fields of an "
            "appearance: return it from numbers(), or put it in the texels of atlas()"
        )

    def __getattr__(self, name: str) -> Any:
        # Python and JAX probe for special methods; only AttributeError says that there is none.
        if name.startswith("__"):
            raise AttributeError(name)
        self._refuse()

    # A property: JAX checks whether there is such a method, and its own error would name neither field nor appearance.
    __jax_array__ = property(_refuse)
    __array__ = __getitem__ = __iter__ = __len__ = __bool__ = __float__ = __int__ = _refuse
    __add__ = __sub__ = __mul__ = __truediv__ = __pow__ = __neg__ = __abs__ = __matmul__ = _refuse
    __radd__ = __rsub__ = __rmul__ = __rtruediv__ = __rpow__ = __rmatmul__ = _refuse
    __lt__ = __le__ = __gt__ = __ge__ = _refuse


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Numbers and dtype of the arguments of an appearance's element-wise functions."""

    num_numbers: int  # K, of a splat.
    num_values: int  # C, of a texture; 0 without textures.
    num_colors: int  # D, of a splat.
    dtype: Any  # Of all floats.

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
def check_shading(static: StaticShading, arguments: Arguments) -> None:
    """Raise unless the element-wise functions of an appearance take scalars and return what the compositor needs.

    Raises:
      ValueError: if a result has the wrong form.
      Exception: what the appearance's own code raises, with a note that names it and the arguments.
    """
    name = static.name
    functions = arguments.of(())
    num_colors = arguments.num_colors

    def traced(function: str) -> Any:
        """Return what a function of an appearance returns for scalars, without values."""
        try:
            return jax.eval_shape(getattr(static.functions, function), *functions[function])
        except Exception as error:
            error.add_note(
                f"This happened in {name}.{function}, which is called with scalars of {arguments.dtype}: "
                f"K = {arguments.num_numbers} numbers, and C = {arguments.num_values} texture values."
            )
            if isinstance(error, jax.errors.TracerBoolConversionError):
                error.add_note("Its numbers have no values yet: use jnp.where instead of if.")
            raise

    shaded = traced("shade")
    must = (
        f"{name}.shade must return (residual, factor): {num_colors} colours that are added, or None, and a factor of "
        f"alpha, or None; or (residual, factor, tint) with {num_colors} factors of the colours"
    )
    if not isinstance(shaded, tuple | list) or len(shaded) != 3:
        raise ValueError(f"{must}; it returned {described(shaded)}")
    residual, factor, tint = shaded
    for part, colors in (("residual", residual), ("tint", tint)):
        if colors is not None and _sizes(colors) != ((),) * num_colors:
            raise ValueError(f"{must}; the {part} is {described(colors)}, of {described(shaded)}")
    if factor is not None and _sizes((factor,)) != ((),):
        raise ValueError(f"{must}; the factor is {described(factor)}")
    weight = traced("falloff")
    if _sizes((weight,)) != ((),):
        raise ValueError(f"{name}.falloff must return one number for one rho; it returned {described(weight)}")
    if "texel_position" not in functions:
        return
    position = traced("texel_position")
    if _sizes(position) != ((), ()):
        raise ValueError(f"{name}.texel_position must return (x, y), two numbers; it returned {described(position)}")


def _sizes(values: object) -> tuple[tuple[int, ...], ...] | None:
    """Return the sizes of several arrays, or of the entries of one; None for anything else."""
    if hasattr(values, "shape"):
        return (tuple(values.shape[1:]),) * values.shape[0] if values.shape else None
    if not isinstance(values, tuple | list) or not all(hasattr(value, "shape") for value in values):
        return None
    return tuple(tuple(value.shape) for value in values)


@functools.lru_cache(maxsize=256)
def takes_arrays(static: StaticShading, arguments: Arguments) -> bool:
    """Return whether the element-wise functions of an appearance also take arrays, entry by entry.

    A matrix product in `shade` takes scalars only: with arrays of pixels it would contract the pixels.
    """
    wanted = ODD_SIZES, (arguments.num_colors, *ODD_SIZES)
    for name, arrays in arguments.of(ODD_SIZES).items():
        try:
            results = jax.make_jaxpr(getattr(static.functions, name))(*arrays).jaxpr.outvars
        except Exception:  # Any error of the user's code: it has passed with scalars, so it cannot take arrays.
            return False
        if not all(isinstance(x, jax.extend.core.Literal) or x.aval.shape in wanted for x in results):
            return False
    return True


def elementwise_functions(static: StaticShading, arguments: Arguments) -> Elementwise:
    """Return the functions of an appearance, made to take arrays if they take scalars only."""
    functions = static.functions
    if takes_arrays(static, arguments):
        return functions

    def shade(*scalars: Any) -> tuple[Residual, Factor, Tint]:
        residual, factor, tint = functions.shade(*scalars)
        return None if residual is None else tuple(residual), factor, None if tint is None else tuple(tint)

    return functions._replace(
        texel_position=functools.partial(_mapped, functions.texel_position),
        shade=functools.partial(_mapped, shade),
        falloff=functools.partial(_mapped, functions.falloff),
    )


def _mapped(function: Callable[..., object], *arrays: object) -> Any:
    """Call a function of scalars for each entry of arrays that broadcast."""
    leaves, structure = jax.tree.flatten(arrays)
    shape = jnp.broadcast_shapes(*(jnp.shape(leaf) for leaf in leaves))
    flat = [jnp.broadcast_to(leaf, shape).reshape(-1) for leaf in leaves]
    results = jax.vmap(lambda *scalars: function(*jax.tree.unflatten(structure, scalars)))(*flat)
    return jax.tree.map(lambda result: result.reshape(shape), results)
