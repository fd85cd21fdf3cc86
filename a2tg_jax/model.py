"""A model: Gaussians and their appearance, as one value that is trained, rendered, counted, moved and saved."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from a2tg_jax.appearance import Appearance, count_floats
from a2tg_jax.appearance.base import check_appearance, check_arrays_given, join_rows, num_colors_of, take_rows
from a2tg_jax.appearance.parts import (
    LEAST_OPACITY,
    MAX_DEGREE,
    bands_of_dense,
    degrees_of_sizes,
    dense_bands,
    nearest_gaussians,
)
from a2tg_jax.base.checks import (
    LARGEST_NUMBER,
    check_bounded,
    check_count,
    check_kind,
    check_shape,
    check_unmasked,
    short_repr,
)
from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.base.text import counted, in_bytes
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.core.budget import BYTES_PER_FLOAT
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import LARGEST_LOG_SCALE, LARGEST_OPACITY, Gaussians, check_gaussians, logit
from a2tg_jax.core.notebook_display import html_table
from a2tg_jax.core.origin import BLACK, Color, Origin, check_origin
from a2tg_jax.core.pytree import beside, pytree, static
from a2tg_jax.core.sh import NUM_BASES
from a2tg_jax.core.similarity import Similarity, transform_gaussians
from a2tg_jax.core.table import map_rows
from a2tg_jax.rasterize.render_types import RenderOutput, RenderSettings
from a2tg_jax.render import render_appearance, with_features
from a2tg_jax.texture import Textures, check_textures

SAME_PLACE = 1e-5
"""Largest distance between two models' origins that count as the same."""


@pytree
class Model(NamedFields):
    """Gaussians and their appearance, N rows each.

    Methods marked "(host)" read numbers of the device, and cannot be called under jit.

    Examples:
      >>> textures = a2tg.allocate_textures(np.full((gaussians.num, 2), 4))
      >>> model = a2tg.Model(gaussians, a2tg.Appearance(texture=a2tg.Texture(textures)))
      >>> model.num, model.num_bytes
      (200, 68800)
      >>> model[model.gaussians.means[:, 2] > 0].num < 200
      True
    """

    gaussians: Gaussians
    """Allocated rows, of which the first `num_live` exist."""
    appearance: Appearance = Appearance()
    """Appearance of the Gaussians; plain by default."""
    num_live: Array | None = None
    """int32 number of rows that exist; None if all do."""
    background: Color = static(default=BLACK)
    """RGB behind all splats."""
    origin: Origin | None = beside(default=None)
    """Training cameras and world; None if unknown. Not part of the pytree: results of jit or `jax.tree.map` have none,
    and models that differ only in it share compiled programs."""

    def __post_init__(self) -> None:
        """Check the types of values of this library; others pass, such as rates instead of arrays."""
        is_ours = type(self.gaussians).__module__.startswith("a2tg_jax.")
        if is_ours or isinstance(self.gaussians, str):
            check_kind("gaussians", self.gaussians, Gaussians)
        if type(self.appearance).__module__.startswith("a2tg_jax."):
            check_kind("appearance", self.appearance, Appearance, "such as Appearance(texture=Texture(textures))")

    @property
    def live(self) -> "Model":
        """Model of only the rows that exist (host)."""
        check_arrays_given(self.appearance)
        if self.num_live is None:
            return self
        return dataclasses.replace(self._taken(np.arange(self.num)), num_live=None)

    def __getitem__(self, rows: ArrayLike | slice) -> "Model":
        """Return the model of some of the Gaussians that exist (host).

        Args:
          rows: a mask [N] of bool, indices [M], which may repeat, or a slice.

        Raises:
          ValueError: if it is none of these, an index is out of range, or the appearance has other rows.
        """
        model = self.live
        check_appearance(model.appearance, model.gaussians)
        return model._taken(_indices(rows, model.num))

    def _taken(self, rows: np.ndarray) -> "Model":
        gaussians, appearance = take_rows((self.gaussians, self.appearance), rows)
        return dataclasses.replace(self, gaussians=gaussians, appearance=appearance)

    @property
    def num(self) -> int:
        """Number of Gaussians that exist (host)."""
        return self.num_rows if self.num_live is None else int(self.num_live)

    @property
    def num_rows(self) -> int:
        """Number of allocated rows, of which the first `num` exist."""
        return self.gaussians.num

    @property
    def live_count(self) -> Array:
        """Number of Gaussians that exist, [] int32; may be traced."""
        return jnp.asarray(self.num_rows if self.num_live is None else self.num_live, jnp.int32)

    @property
    def num_bytes(self) -> int:
        """Bytes of the trained floats of the Gaussians that exist, padding left out (host)."""
        return self.bytes_of(self.num)

    @property
    def num_published_bytes(self) -> int:
        """Bytes as the method's authors count them (host)."""
        num_floats = self.gaussians.floats_per_row * self.num + self.appearance.num_published_floats(self.num)
        return BYTES_PER_FLOAT * num_floats

    def bytes_of(self, num: int) -> int:
        """Return the bytes of the trained floats of the first `num` Gaussians and their appearance (host)."""
        check_arrays_given(self.appearance)
        return BYTES_PER_FLOAT * (self.gaussians.floats_per_row * num + count_floats(self.appearance, num))

    @property
    def num_padding_bytes(self) -> int:
        """Bytes of padding in the buffers (host)."""
        # Places of blocks in tables are not counted.
        arrays = map_rows(lambda array: array, lambda table: table.buckets, self.appearance)
        allocated = sum(leaf.nbytes for leaf in jax.tree.leaves(arrays))
        filled = count_floats(self.appearance, self.num) + self.appearance.replaced_floats * self.num
        return allocated - BYTES_PER_FLOAT * filled

    @property
    def default_background(self) -> tuple[float, ...]:
        """Background of renders that name none: the model's own, or 0 if its splats have other than three numbers."""
        num_colors = num_colors_of(self.appearance)
        return self.background if num_colors == len(self.background) else (0.0,) * num_colors

    @property
    def textures(self) -> Textures | None:
        """Textures of the splats; None without textures."""
        return self.appearance.textures

    def with_textures(self, textures: Textures) -> "Model":
        """Return the same model with other textures.

        Args:
          textures: textures of its allocated Gaussians.

        Returns:
          The model.

        Raises:
          ValueError: if it has none, where the message says how to build one that has, or their numbers differ.
        """
        check_textures(textures, self.num_rows)
        return dataclasses.replace(self, appearance=self.appearance.with_textures(textures))

    @property
    def degrees(self) -> np.ndarray:
        """[N] degrees of the spherical harmonics of each allocated Gaussian (host)."""
        base = self.gaussians.sh_degree
        coefficients = self.appearance.coefficients
        if coefficients is None:
            return np.full(self.num_rows, base)
        return degrees_of_sizes(coefficients.sizes, base)

    @property
    def sh(self) -> np.ndarray:
        """[N, K, 3] all spherical harmonics, with zeros above the degree of a Gaussian; K belongs to the highest degree
        (host)."""
        common = np.asarray(self.gaussians.sh)
        coefficients = self.appearance.coefficients
        if coefficients is None:
            return common
        dense = dense_bands(coefficients, self.gaussians.sh_degree)
        return np.concatenate([common, dense], axis=1, dtype=common.dtype)[:, : self._num_coefficients]

    @property
    def _num_coefficients(self) -> int:
        """Number K of spherical harmonics of the highest degree (host)."""
        return NUM_BASES[int(self.degrees.max(initial=self.gaussians.sh_degree))]

    def with_sh(self, sh: np.ndarray) -> "Model":
        """Return the same model with other spherical harmonics, as `sh` gives them; degrees stay (host). ValueError:
        they have another shape."""
        base = self.gaussians.sh_degree
        check_shape("sh", sh, (self.num_rows, self._num_coefficients, 3))
        common = jnp.asarray(sh[:, : NUM_BASES[base]], self.gaussians.sh.dtype)
        model = dataclasses.replace(self, gaussians=dataclasses.replace(self.gaussians, sh=common))
        if self.appearance.coefficients is None:
            return model
        coefficients = bands_of_dense(sh[:, NUM_BASES[base] :], self.degrees, base)
        return dataclasses.replace(model, appearance=self.appearance.with_coefficients(coefficients))

    def render(
        self,
        camera: Camera,
        *,
        features: ArrayLike | None = None,
        background: Any = None,
        settings: RenderSettings = RenderSettings(),  # noqa: B008 - frozen
    ) -> RenderOutput:
        """Render the view of a camera, as `render_appearance` does, from the rows that exist.

        Args:
          camera: the view.
          features: [N, D] numbers to show instead of colours (`render_image`), one row for each allocated Gaussian.
          background: [3] colour, or [D] features; None is the model's own, or 0 for features and for appearances of
            other than three colours.
          settings: static options; `texture` is ignored, since the appearance has its own options. Under jit they
            need a capacity: `plan_render(model, cameras)`.

        Returns:
          The images of the view.

        Raises:
          ValueError: under jit or vmap without a capacity, or if an argument has a wrong shape.
        """
        appearance = with_features(self.appearance, features, self.gaussians)
        if background is None and features is None:
            background = self.default_background
        return render_appearance(
            self.gaussians, camera, appearance, background=background, settings=settings, num_live=self.num_live
        )

    def transform(self, similarity: Similarity) -> "Model":
        """Return the same model in the world that `similarity` leads to, with its cameras (host).

        View dependence turns with the world; everything else of the appearance stays. Lengths of the settings are in
        units of the world; scale them along, or the image may lack or gain splats close to the camera:

            moved = model.transform(similarity)
            moved.render(moved.origin.cameras[0], settings=settings.transform(similarity))
        """
        # Dense, because a rotation mixes all coefficients of a degree.
        turned = transform_gaussians(dataclasses.replace(self.gaussians, sh=jnp.asarray(self.sh)), similarity)
        model = self.with_sh(np.asarray(turned.sh))
        return dataclasses.replace(
            model,
            gaussians=dataclasses.replace(turned, sh=model.gaussians.sh),
            origin=None if self.origin is None else self.origin.moved(similarity),
        )

    def __repr__(self) -> str:
        try:
            return f"Model({', '.join(text for _, text in self._facts())})"
        # Leaves are not arrays, have no values, or were given to a step.
        except (TypeError, ValueError, AttributeError, IndexError, RuntimeError):
            return short_repr(self)

    def _repr_html_(self) -> str:
        return html_table("Model", self._facts())

    def _facts(self) -> list[tuple[str, str]]:
        """Return the main facts about a model, by name (host)."""
        degree = self.gaussians.sh_degree
        has_bands = self.appearance.bands is not None
        facts = [
            ("Gaussians", counted(self.num, "Gaussian")),
            ("view dependence", f"SH degrees {degree} to {MAX_DEGREE}" if has_bands else f"SH degree {degree}"),
            ("appearance", self.appearance.description),
            ("memory", in_bytes(self.num_bytes)),
        ]
        return facts if self.origin is None else [*facts, ("origin", repr(self.origin))]


def _indices(rows: ArrayLike | slice, num: int) -> np.ndarray:
    """Return the indices of the rows that a mask, indices or a slice choose of `num`."""
    if isinstance(rows, slice):
        return np.arange(num)[rows]
    if isinstance(rows, int | np.integer) and not isinstance(rows, bool):
        if not -num <= rows < num:
            raise ValueError(f"rows must choose among {num} Gaussians; got {rows}")
        end = f"{rows + 1}" if rows != -1 else ""
        raise ValueError(f"rows must be a mask [{num}], indices or a slice; for one Gaussian use model[{rows}:{end}]")
    check_unmasked("rows", rows)
    chosen = np.asarray(rows)
    if chosen.ndim != 1 or (chosen.size and chosen.dtype.kind not in "biu"):
        raise ValueError(f"rows must be a mask [{num}], indices or a slice; got {chosen.dtype} {[*chosen.shape]}")
    try:
        # An empty list becomes an array of floats, which cannot index.
        return np.arange(num)[chosen if chosen.size else slice(0)]
    except IndexError as error:
        raise ValueError(f"rows must choose among {num} Gaussians: {error}") from None


def check_is_model(model: object) -> None:
    """Raise ValueError unless a value is a model."""
    check_kind("model", model, Model, "use Model(gaussians)" if isinstance(model, Gaussians) else "")


def concatenate(models: Sequence[Model]) -> Model:
    """Return the Gaussians of several models as one model, in their order.

    The models must be in one world: move them first (`Model.transform`). A warning names a model that was read relative
    to another offset than the first. Spherical harmonics of lower degrees are filled up with zeros.

    Args:
      models: at least one, of the same appearance with the same options.

    Returns:
      The model of all Gaussians that exist; its origin is the first one.

    Raises:
      ValueError: if there are no models, or they differ in their appearance, the extent of textures or dtype.
    """
    if not isinstance(models, Sequence) or not models:
        raise ValueError("concatenate needs at least one model, in a list")
    for index, model in enumerate(models):
        check_kind(f"models[{index}]", model, Model)
        check_appearance(model.appearance, model.gaussians)
    models = [model.live for model in models]
    first = models[0]
    for model in models:
        options = first.appearance.texture_options
        others = model.appearance.texture_options
        if options is not None and others is not None and options.extent != others.extent:
            raise ValueError(
                f"models must have textures of one extent; got {options.extent:g} and {others.extent:g}: train them "
                "with the same lookup.extent, or convert them to plain Gaussians first"
            )
        if model.appearance.template != first.appearance.template:
            expected = first.appearance.description
            got = model.appearance.description
            why = f"{expected} and {got}" if got != expected else f"{got} of different options"
            raise ValueError(f"models must have one appearance; got {why}")
        if model.gaussians.means.dtype != first.gaussians.means.dtype:
            dtypes = f"{first.gaussians.means.dtype} and {model.gaussians.means.dtype}"
            raise ValueError(f"models must have one dtype; got {dtypes}")
    for index, model in enumerate(models[1:], 1):
        if first.origin is not None and model.origin is not None and not model.origin.names:
            # The other model's zero in the world of the first.
            apart = model.origin.transform.inverse().then(first.origin.transform).apply(np.zeros(3))
            if np.abs(apart).max() > SAME_PLACE:
                move = f"models[{index}].origin.transform.inverse().then(models[0].origin.transform)"
                warn(f"models[{index}] is relative to another offset; transform it by {move}")
    highest = max(model.gaussians.sh.shape[1] for model in models)
    several = [model.gaussians for model in models]
    if first.appearance.bands is None:
        for index, gaussians in enumerate(several):
            missing = highest - gaussians.sh.shape[1]
            sh = jnp.pad(gaussians.sh, ((0, 0), (0, missing), (0, 0)))
            several[index] = dataclasses.replace(gaussians, sh=sh)
    if len({gaussians.sh_degree for gaussians in several}) > 1:
        raise ValueError(f"models must have one degree below their bands; got {[g.sh_degree for g in several]}")
    appearances = [model.appearance for model in models]
    gaussians, appearance = join_rows([*zip(several, appearances, strict=True)])
    return dataclasses.replace(first, gaussians=gaussians, appearance=appearance)


def checked_live(model: Model) -> Model:
    """Return the live rows of a valid model. ValueError: it is invalid."""
    check_is_model(model)
    check_gaussians(model.gaussians, "model.gaussians")
    model = model.live
    check_model(model)
    return model


def check_model(model: Model) -> None:
    """Raise ValueError, naming the field, unless a model can be rendered and trained.

    All fields have their shapes and one dtype, all numbers are finite, the appearance has a row for each Gaussian, and
    rows of textures and coefficients are within their tables.
    """
    gaussians = model.gaussians
    check_gaussians(gaussians)
    check_appearance(model.appearance, gaussians)
    check_bounded("gaussians", gaussians)
    check_bounded("appearance", model.appearance)
    if not (np.abs(model.background) <= LARGEST_NUMBER).all():  # False for NaN.
        raise ValueError(f"background must be finite, within ±{LARGEST_NUMBER:g}; got {model.background}")
    largest = np.asarray(gaussians.log_scales).max(initial=-np.inf)
    if largest > LARGEST_LOG_SCALE:
        raise ValueError(
            f"gaussians.log_scales must be logarithms of finite scales, up to {LARGEST_LOG_SCALE:.2f}, of scales up to "
            f"{LARGEST_NUMBER:g}; got {largest:g}"
        )
    if model.num_live is not None:
        check_count("num_live", model.num_live, gaussians.num)
    if model.origin is not None:
        check_origin(model.origin)


def plain_gaussians(gaussians: Gaussians | Model, *, keeps_shapes: bool = False) -> Gaussians:
    """Return the Gaussians of a model without its appearance, in the model's world.

    They have their own opacities, and all spherical harmonics of the model.

    Args:
      gaussians: Gaussians or a model.
      keeps_shapes: whether the caller keeps the shapes of kernels; otherwise each becomes the nearest Gaussian.
    """
    if isinstance(gaussians, Model):
        model = gaussians.live
        check_appearance(model.appearance, model.gaussians)
        shown = model.appearance
        gaussians = dataclasses.replace(model.gaussians, sh=jnp.asarray(model.sh))
        if shown.shapes is not None and not keeps_shapes:
            gaussians = nearest_gaussians(gaussians, np.asarray(shown.shapes))
        if not shown.has_own_opacities:
            # Logits must be finite.
            opacities = jnp.clip(shown.opacities(model.gaussians), LEAST_OPACITY, LARGEST_OPACITY)
            gaussians = dataclasses.replace(gaussians, logit_opacities=logit(opacities))
    check_gaussians(gaussians)
    return gaussians
