"""Appearance: what splats show. One pytree of arrays and static options, which the renderer draws and training changes.

Each of N splats may own a texture of one or more texels among all texels [T, C], and K numbers. At (u, v), in standard
deviations, an appearance gives the position of the texture lookup (`texel_position`). From the C interpolated values
and the K numbers it computes a colour residual, an alpha factor and a colour factor, the tint (`shade`):

    residual, factor, tint = shade(numbers, texture interpolated at texel_position(region, u, v), u, v)
    α = min(max_alpha, peak opacity · falloff(numbers, ρ) · factor),  colour = SH colour · tint + residual

`Appearance()` is plain 2DGS. Its optional parts are a texture, exponents of the kernels, and bands of spherical
harmonics. A subclass adds its own arrays and overrides what differs; the parts work with it as well.

An appearance whose arrays are None is a template, such as the one of a stage: it has the options only, and
`allocate_appearance` makes the arrays for some Gaussians. A plain array of a subclass has a row for each Gaussian,
unless its field is `shared()`.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Self, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance.parts import (
    Bands,
    Coefficients,
    Exponents,
    Part,
    Shading,
    Texture,
    TextureOptions,
    curves_of,
    reach_of,
)
from a2tg_jax.base.checks import FLOATS, check_kind, check_shape, described
from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.core.bilinear import TextureRegion
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import Gaussians, logit, share
from a2tg_jax.core.geometry import homographies_of
from a2tg_jax.core.numerics import Integer, at_least, where_rows
from a2tg_jax.core.pytree import is_shared, partition, pytree, static
from a2tg_jax.core.sh import sh_sum
from a2tg_jax.core.table import Table, check_places, check_table, is_held, is_whole, map_rows, rows_moved
from a2tg_jax.texture import Textures, check_textures

T = TypeVar("T")

MAX_ALPHA = 0.99  # as in 3DGS


@pytree(kw_only=True)
class Appearance(NamedFields):
    """Plain 2D Gaussians with optional parts, and base class of other appearances."""

    texture: Texture | None = None
    """Colour residual and alpha factor from a texture of each splat; None: no textures."""
    exponents: Exponents | None = None
    """Shapes of the kernels; None: all are Gaussians."""
    bands: Bands | None = None
    """Spherical harmonics with a degree per Gaussian, above the degree that all Gaussians have; None: none."""
    given_colors: Array | None = None
    """[N, 3] colours instead of spherical harmonics, for rendering; None otherwise."""
    features: Array | None = None
    """[N, D] numbers to show instead of all colour, residuals of textures included, D >= 1, of either sign; None
    otherwise."""
    max_alpha: float | None = static(default=None)
    """Upper limit of alpha, in (0, 1); None: the limit in the texture's options, or 0.99."""

    # For subclasses: class attributes.

    has_low_pass = True
    """Whether the low-pass filter of 2DGS shows splats that are edge-on or smaller than a pixel. Without it, ρ is
    u² + v² at the hit of the pixel's ray, and a splat without a hit is invisible."""
    num_colors = 3
    """Number D of colours of a splat: red, green and blue, or other features."""
    empty: ClassVar[tuple[float, ...]] = ()
    """C values of a splat without a texture, whose region has no texels; () if all splats have one."""
    replaced_floats = 0
    """Number of floats of a Gaussian that are not trained, such as an opacity that the appearance does not use."""

    def __post_init__(self) -> None:
        """Check that only Gaussian kernels have exponents; normalise the default limit of alpha to None."""
        if self.exponents is not None and type(self).falloff is not Appearance.falloff:
            raise ValueError(f"exponents replace a Gaussian falloff, and {type(self).__name__} has another one")
        # Equal appearances have one form, so that systems share stages, and models compiled programs.
        if self.texture is None and self.max_alpha == MAX_ALPHA:
            object.__setattr__(self, "max_alpha", None)

    # What the renderer draws. A subclass overrides some of these.

    def numbers(self, gaussians: Gaussians, camera: Camera) -> Array:
        """Return the differentiable numbers [N, K] of `shade` and `falloff`, which may depend on the view.

        The renderer calls it once per view, and JAX differentiates it. Gradients of invisible rows are zero. What all
        Gaussians share becomes columns as well, by `jnp.broadcast_to(weights, (gaussians.num, len(weights)))`.
        """
        return jnp.zeros((gaussians.num, 0), gaussians.means.dtype)

    def numbers_at(self, gaussians: Gaussians, camera: Camera, degree: Integer) -> Array:
        """Return `numbers`. Override this method instead if they depend on the highest active degree of spherical
        harmonics, an integer that may be traced."""
        return self.numbers(gaussians, camera)

    def homographies(self, gaussians: Gaussians, camera: Camera) -> tuple[Array, Array]:
        """Return the homographies M [N, 3, 3] from (u, v, 1) to pixels, and normals [N, 3] in the world.

        M[:, 2, 2] is the depth by which splats are sorted.
        """
        return homographies_of(gaussians, camera)

    def peak_opacities(self, gaussians: Gaussians) -> Array:
        """Return the peak opacities [N], before falloff and alpha factor."""
        return gaussians.opacities

    def own_colors(self, gaussians: Gaussians, camera: Camera, degree: Integer) -> Array:
        """Return the colours [N, D] in this view.

        By default, D = 3 of spherical harmonics up to `degree`, which may be traced.
        """
        sums = color_sums(self, gaussians, camera, degree)
        # Not `jnp.maximum`, which halves the gradient of colours at exactly 0.
        return at_least(sums + 0.5, 0.0)

    def atlas(self) -> tuple[Array, TextureRegion | None]:
        """Return the texels [T, C] of all splats, T >= 1, and the N places of the splats' textures among them; None
        without textures."""
        return (jnp.zeros((1, 0), jnp.float32), None) if self.texture is None else self.texture.atlas()

    def texel_position(self, region: TextureRegion, u: Array, v: Array) -> tuple[Array, Array]:
        """Return the lookup position (x, y) in texels, clamped to [0, width − 1] and [0, height − 1].

        Element-wise, on scalars or on arrays that broadcast, as `shade` and `falloff`. These three can use static
        fields only: return differentiated values, and values that differ between splats, from `numbers` or `atlas`.
        """
        if self.texture is None:
            raise NotImplementedError(f"{type(self).__name__} has textures, but no method texel_position")
        return self.texture.position(region, u, v)

    def shade(self, numbers: tuple[Array, ...], values: tuple[Array, ...], u: Array, v: Array) -> Shading:
        """Return colour residual and alpha factor at (u, v), from the K numbers and the C values of the texture.

        An optional third result is the tint: D factors of the splat's own colours, or None.
        """
        return (None, None) if self.texture is None else self.texture.shade(values, u, v)

    def falloff(self, numbers: tuple[Array, ...], rho: Array) -> Array:
        """Return the kernel at squared distance rho; exp(−rho/2) for a Gaussian."""
        return jnp.exp(-0.5 * rho)

    def cutoff(self, opacities: Array) -> Array:
        """Return the squared distance rho [N] beyond which alpha is below 1/255; not positive if it always is.

        A bound without gradient: one that is too large costs time, one that is too small cuts the splat off.
        """
        return gaussian_cutoff(opacities if self.texture is None else opacities * self.texture.peaks())

    # What training changes. A subclass overrides some of these.

    def allocate(self, key: Array, gaussians: Gaussians) -> Self:
        """Return the appearance with initial arrays of the subclass for N Gaussians; parts have theirs already
        (host)."""
        return self

    def project(self) -> Self:
        """Return the appearance with arrays of the subclass projected onto their ranges after an update; traceable."""
        return self

    def rates(self, rate: object) -> Any:
        """Return Adam's learning rates, a prefix of the tree of floats, from the rates of a stage.

        A number holds for all floats. A mapping has rates by field; a field that it lacks does not learn.
        """
        if not isinstance(rate, Mapping):
            return rate
        names = [name for name in array_fields(self) if getattr(self, name) is not None]
        unknown = [*rate.keys() - names]
        if unknown:
            raise ValueError(f"rates must be by the fields {', '.join(names)}; got {unknown[0]!r}")
        rates = {}
        for name in names:
            part = getattr(self, name)
            rate_of_part = rate.get(name, 0.0)
            rates[name] = part.rates(rate_of_part) if isinstance(part, Part) else rate_of_part
        return dataclasses.replace(self, **rates)

    def opacities(self, gaussians: Gaussians) -> Array:
        """Return the opacities [N] that densification compares with its thresholds; traceable."""
        return gaussians.opacities

    def share(self, gaussians: Gaussians, num_shares: Array) -> tuple[Gaussians, Self]:
        """Return each row as one of num_shares [N] coincident copies that together look like it; traceable."""
        logits, log_scales = share(gaussians.logit_opacities, gaussians.log_scales, num_shares)
        return dataclasses.replace(gaussians, logit_opacities=logits, log_scales=log_scales), self

    def limit_opacities(self, gaussians: Gaussians, most: Array) -> tuple[Gaussians, Self]:
        """Return Gaussians and appearance of splats no more opaque than `most`; traceable."""
        limited = jnp.minimum(gaussians.logit_opacities, logit(jnp.asarray(most, gaussians.means.dtype)))
        return dataclasses.replace(gaussians, logit_opacities=limited), self

    def check_arrays(self, gaussians: Gaussians) -> None:
        """Raise ValueError unless arrays of the subclass, with a row for each Gaussian, fit its options (host)."""

    def num_published_floats(self, num: int) -> int:
        """Return the floats of `num` Gaussians besides their own, as the method's authors count them (host)."""
        return count_floats(self, num)

    # Facts

    @property
    def alpha_limit(self) -> float:
        """Upper limit of alpha."""
        if self.max_alpha is not None:
            return self.max_alpha
        return MAX_ALPHA if self.texture is None else self.texture.options.max_alpha

    @property
    def is_portable(self) -> bool:
        """Whether Gaussians and parts define the appearance completely.

        Compact files, web scenes and `shrink_textures` need this.
        """
        return type(self) is Appearance

    @property
    def is_linear(self) -> bool:
        """Whether a picture is linear in spherical harmonics and in the RGB of the textures."""
        return type(self) is Appearance and (self.texture is None or self.texture.options.rgb == "signed")

    @property
    def has_own_opacities(self) -> bool:
        """Whether splats are exactly as opaque as their Gaussians."""
        return type(self).opacities is Appearance.opacities

    @property
    def texture_options(self) -> TextureOptions | None:
        """How textures are read; None without the part `texture`."""
        return None if self.texture is None else self.texture.options

    @property
    def textures(self) -> Textures | None:
        """Textures of the splats; None without."""
        return None if self.texture is None else self.texture.texels

    @property
    def coefficients(self) -> Coefficients | None:
        """Spherical harmonics above the degree that all Gaussians have; None without."""
        return None if self.bands is None else self.bands.coefficients

    @property
    def shapes(self) -> Array | None:
        """[N] shapes of the kernels; None if all are Gaussians."""
        return None if self.exponents is None else self.exponents.shapes

    @property
    def template(self) -> Self:
        """The appearance without its arrays: its options."""
        return without_arrays(self, lambda path: None)

    @property
    def description(self) -> str:
        """Class and parts in words, such as "Gaussians with texture and bands" or "plain Gaussians"."""
        kind = "Gaussians" if type(self) is Appearance else type(self).__name__
        parts = " and ".join(", ".join(_parts_of(self)).rsplit(", ", 1))
        if parts:
            return f"{kind} with {parts}"
        return "plain Gaussians" if kind == "Gaussians" else kind

    def with_textures(self, textures: Textures) -> Self:
        """Return the appearance with other textures. ValueError: it has none, or another number of rows."""
        if self.texture is None:
            raise ValueError(
                f"no textures to replace in {self.description}: build a model with "
                "Appearance(texture=Texture(textures))"
            )
        check_textures(textures, self._num_rows)
        return dataclasses.replace(self, texture=dataclasses.replace(self.texture, texels=textures))

    def with_coefficients(self, coefficients: Coefficients) -> Self:
        """Return the appearance, which has bands, with other coefficients. ValueError: it has another number of
        rows."""
        check_table(coefficients, self._num_rows, "coefficients")
        return dataclasses.replace(self, bands=Bands(coefficients))

    def with_shapes(self, shapes: Array) -> Self:
        """Return the appearance, which has exponents, with other shapes. ValueError: it has another number of rows."""
        check_shape("shapes", shapes, ("N" if self._num_rows is None else self._num_rows,))
        return dataclasses.replace(self, exponents=Exponents(shapes))

    @property
    def _num_rows(self) -> int | None:
        """Number of Gaussians that the arrays of the parts are for; None for a template."""
        for table in (self.textures, self.coefficients):
            if table is not None:
                return table.num
        return None if self.shapes is None else int(self.shapes.shape[0])


PARTS = ("texture", "exponents", "bands")


def array_fields(node: Any) -> list[str]:
    """Return the names of the fields of an appearance, or of a part, that are not static."""
    return [field.name for field in dataclasses.fields(node) if not field.metadata.get("static")]


def added_fields(appearance: Any) -> list[str]:
    """Return the names of the array fields that a subclass adds."""
    inherited = {field.name for field in dataclasses.fields(Appearance)}
    return [name for name in array_fields(appearance) if name not in inherited]


def gaussian_cutoff(peak: Array) -> Array:
    """Return r² = 2·ln(255·peak), at which peak·exp(−r²/2) = 1/255; negative if the peak is not positive."""
    # A peak of 0 has no logarithm; its bound must be finite and negative.
    return 2 * jnp.log(jnp.maximum(255 * peak, 1e-6))


# The composition of an appearance with its parts, for the renderer


def color_sums(appearance: Appearance, gaussians: Gaussians, camera: Camera, degree: Integer) -> Array:
    """Return the sums of spherical harmonics [N, 3], from which 0.5 leads to colours; linear in the coefficients."""
    bands = appearance.bands
    above = None if bands is None else bands.color_sums(gaussians, camera.center, degree)
    sums = sh_sum(gaussians.sh, gaussians.means, camera.center, degree)
    return sums if above is None else sums + above


def colors_in_view(appearance: Appearance, gaussians: Gaussians, camera: Camera, degree: Integer) -> Array:
    """Return the colours [N, D], or the features, of the splats in a view."""
    if appearance.features is not None:
        return appearance.features
    if appearance.given_colors is not None:
        return appearance.given_colors
    return appearance.own_colors(gaussians, camera, degree)


def numbers_in_view(appearance: Appearance, gaussians: Gaussians, camera: Camera, degree: Integer) -> Array:
    """Return the numbers [N, K] of the splats in a view, followed by the curves of kernels with exponents."""
    numbers = appearance.numbers_at(gaussians, camera, degree)
    shapes = appearance.shapes
    return numbers if shapes is None else jnp.concatenate([numbers, jnp.stack(curves_of(shapes), axis=1)], axis=1)


def cutoff_of(appearance: Appearance, opacities: Array) -> Array:
    """Return the squared distance [N] beyond which alpha is below 1/255, of kernels with their exponents."""
    bound = appearance.cutoff(opacities).astype(opacities.dtype)
    shapes = appearance.shapes
    # The bound is for a Gaussian's falloff; kernels reach the same falloff elsewhere.
    return bound if shapes is None else reach_of(curves_of(shapes), bound)


def num_colors_of(appearance: Appearance) -> int:
    """Return the number of colours of a splat, or of features."""
    return appearance.num_colors if appearance.features is None else int(appearance.features.shape[1])


# Templates and arrays

A = TypeVar("A", bound=Appearance)


def without_arrays(node: Any, instead: Callable[[str], Any], name: str = "") -> Any:
    """Return an appearance or a part with a value, made of the field's path such as "texture.texels", for each array
    field that is not None."""
    changes = {}
    for field in array_fields(node):
        value = getattr(node, field)
        path = f"{name}.{field}" if name else field
        if isinstance(value, Part):
            changes[field] = without_arrays(value, instead, path)
        elif value is not None:
            changes[field] = instead(path)
    return dataclasses.replace(node, **changes) if changes else node


def _parts_of(appearance: Appearance) -> dict[str, Part]:
    parts = {name: getattr(appearance, name) for name in PARTS}
    return {name: part for name, part in parts.items() if part is not None}


def allocate_appearance(template: A, key: Array, gaussians: Gaussians) -> A:
    """Return an appearance of the options of a template, with initial arrays for N Gaussians (host).

    Args:
      template: an appearance without arrays, such as `Appearance(texture=Texture())`.
      key: a random key, for appearances with random initial arrays.
      gaussians: N Gaussians.

    Returns:
      An appearance of the same class, with a row for each Gaussian.

    Raises:
      ValueError: if it is no appearance, or makes arrays that do not fit its options.
    """
    check_kind("template", template, Appearance)
    parts: Any = {name: part.allocate(gaussians) for name, part in _parts_of(template).items()}
    return dataclasses.replace(template, **parts).allocate(key, gaussians)


def project_appearance(appearance: A) -> A:
    """Return the appearance with all numbers projected onto their ranges; call it after each update. Traceable.

    A texture's alpha factors, for example, are clamped to [0, 1].

    Args:
      appearance: an appearance with its arrays, such as `model.appearance`.

    Returns:
      An appearance of the same class, with arrays of the same shapes.

    Raises:
      ValueError: if it is no appearance, or has no arrays yet.
    """
    check_kind("appearance", appearance, Appearance)
    check_arrays_given(appearance)
    parts: Any = {name: part.project() for name, part in _parts_of(appearance).items()}
    return dataclasses.replace(appearance, **parts).project()


def count_floats(appearance: Appearance, num: int) -> int:
    """Return the trained floats of the appearance of the first `num` Gaussians, without padding (host). An opacity that
    is not trained counts as −1. Arrays that Gaussians share count once, even for 0 Gaussians."""
    total = -appearance.replaced_floats * num
    for leaf in jax.tree.leaves(appearance, is_leaf=is_whole):
        if is_shared(leaf):
            total += sum(int(array.size) for array in jax.tree.leaves(leaf))
        elif isinstance(leaf, Table):
            total += leaf.count_floats(num)
        else:
            total += int(np.prod(leaf.shape[1:], dtype=int)) * num
    return total


def check_appearance(appearance: Appearance, gaussians: Gaussians) -> None:
    """Raise ValueError, naming the field, unless the arrays of an appearance exist and fit the Gaussians (host)."""
    kind = type(appearance).__name__
    dtypes = " or ".join(FLOATS)
    check_arrays_given(appearance)
    for path, leaf in jax.tree_util.tree_leaves_with_path(partition(appearance)[0]):
        if str(leaf.dtype) not in FLOATS:
            raise ValueError(f"{kind}{jax.tree_util.keystr(path)} must be floats, {dtypes}; got {leaf.dtype}")
    added = added_fields(appearance)
    for name in added:
        if hasattr(Appearance, name):
            raise ValueError(f"{kind}.{name} must have another name: it replaces Appearance.{name}")
    for part_name, part in _parts_of(appearance).items():
        part.check(gaussians)
        for name in set(added).intersection(part.names_in_files):
            raise ValueError(f"{kind}.{name} must have another name: files have {name} of the part {part_name}")
    for path, leaf in jax.tree_util.tree_leaves_with_path(appearance, is_leaf=is_whole):
        name = kind + jax.tree_util.keystr(path)
        if path[0].name in PARTS:
            continue  # Checked above.
        if isinstance(leaf, Table):
            check_table(leaf, gaussians.num, name)
            check_places(leaf, name)
        elif not is_shared(leaf) and leaf.shape[:1] != (gaussians.num,):
            raise ValueError(
                f"{name} must have a row for each Gaussian; got {described(leaf)} for {gaussians.num:,} of them: "
                "declare the field by a2tg_jax.shared() if all Gaussians share it"
            )
    appearance.check_arrays(gaussians)


def check_arrays_given(appearance: Appearance) -> None:
    """Raise ValueError if a subclass or a part is a template without its arrays."""
    added = added_fields(appearance)
    missing = added[:1] if all(getattr(appearance, name) is None for name in added) else []
    for name, part in _parts_of(appearance).items():
        missing += [f"{name}.{field}" for field in array_fields(part) if getattr(part, field) is None]
    if missing:
        raise ValueError(
            f"model.appearance.{missing[0]} is None: this appearance is a template, without arrays; use "
            "Model(gaussians, allocate_appearance(appearance, key, gaussians))"
        )


# Rows of Gaussians and appearances: an array has a row for each Gaussian, a table a block; what is shared has neither


def clear_rows(tree: T, is_cleared: Array) -> T:
    """Return moments with the rows of marked Gaussians [N] at zero; traceable. Tables must have their places."""
    return map_rows(
        lambda array: where_rows(is_cleared, jnp.zeros_like(array), array), lambda table: table.clear(is_cleared), tree
    )


def take_rows(tree: T, rows: np.ndarray) -> T:
    """Return the rows of some Gaussians, which may repeat; tables in buckets as small as they need (host)."""
    return map_rows(lambda array: rows_moved(array, rows), lambda table: table.take(rows), tree)


def join_rows(trees: Sequence[T]) -> T:
    """Concatenate the rows of several trees, which have the same structure except for their tables (host).

    Raises:
      ValueError: if what Gaussians share differs.
    """

    def check_shared(path: Any, first: object, *others: object) -> None:
        arrays = jax.tree.leaves(first) if is_shared(first) else []
        for other in others if arrays else ():
            other_arrays = jax.tree.leaves(other)
            if len(other_arrays) != len(arrays) or not all(map(np.array_equal, arrays, other_arrays)):
                name = jax.tree_util.keystr(path).rpartition("].")[-1]
                raise ValueError(f"{name} must be equal in all models, because all Gaussians share it")

    def joined(*arrays: Array) -> Array:
        # On the host, where nothing is compiled for their numbers.
        return jax.device_put(np.concatenate(arrays)) if all(map(is_held, arrays)) else jnp.concatenate(arrays)

    jax.tree_util.tree_map_with_path(check_shared, *trees, is_leaf=is_whole)
    return map_rows(joined, lambda *tables: type(tables[0]).joined(tables), *trees)
