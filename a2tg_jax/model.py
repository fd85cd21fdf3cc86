"""A model: Gaussians and their appearance, as one value that is trained, rendered, counted, moved and saved."""

import dataclasses
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance import Appearance, AppearanceRule, Plain, PlainRule
from a2tg_jax.appearance.layers import layers_in_words
from a2tg_jax.appearance.sh_bands import BandLayout, Bands, dense_sh, split_sh
from a2tg_jax.appearance.stored import check_given
from a2tg_jax.core.budget import BYTES_PER_FLOAT
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.checks import check_kind, check_unmasked, short_repr
from a2tg_jax.core.display import counted, html_table, in_bytes, short_tuple_repr
from a2tg_jax.core.forks import check_process
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.origin import BLACK, Origin
from a2tg_jax.core.pytree import pytree
from a2tg_jax.core.similarity import Similarity
from a2tg_jax.core.transform import transform_gaussians
from a2tg_jax.rasterize.render_types import RenderOutput, RenderSettings
from a2tg_jax.render import render_appearance, with_features
from a2tg_jax.texture import AtlasLayout, Textures, check_textures

SAME_PLACE = 1e-5
"""Largest distance of two models' origins that are taken for one."""


class Parameters(NamedTuple):
    """The floats of a model, or gradients of them."""

    gaussians: Gaussians
    """Floats of the Gaussians."""
    params: Any
    """Floats of the appearance."""

    def __repr__(self) -> str:
        return short_tuple_repr(self)


@pytree
class Model:
    """Gaussians, their appearance with its parameters, and their origin.

    Methods marked "(host)" read numbers of the device, and cannot be called under jit.
    """

    gaussians: Gaussians
    """Allocated rows, of which the first `num_live` exist."""
    params: Any = ()
    """Parameters of the appearance."""
    layout: Any = ()
    """Integers of the appearance beside its parameters, not differentiable."""
    num_live: Array | None = None
    """int32 number of rows that exist; None if all do."""
    appearance: Appearance = dataclasses.field(default_factory=Plain, metadata={"static": True})
    """Kind of appearance, with its options."""
    origin: Origin | None = dataclasses.field(default=None, metadata={"static": True})
    """Training cameras and world; None if unknown."""

    def __post_init__(self) -> None:
        """Refuse other values of this library in place of Gaussians; transformations put values of their own there."""
        is_ours = type(self.gaussians).__module__.startswith("a2tg_jax.")
        if is_ours or isinstance(self.gaussians, str):
            check_kind("gaussians", self.gaussians, Gaussians)

    @property
    def rule(self) -> AppearanceRule:
        """Appearance rule for the renderer."""
        check_process()
        check_given(self.appearance, self.params)
        if isinstance(self.params, Textures):
            check_textures(self.params, self.layout, self.gaussians.num, "model.params")
        return PlainRule() if self.gaussians.num == 0 else self.appearance.rule(self.params, self.layout)

    @property
    def live(self) -> "Model":
        """Model of only the rows that exist (host)."""
        check_given(self.appearance, self.params)
        if self.num_live is None:
            return self
        params, layout = self.appearance.first_rows(self.params, self.layout, self.num)
        return dataclasses.replace(
            self, gaussians=self.gaussians[: self.num], params=params, layout=layout, num_live=None
        )

    def __getitem__(self, rows: Any) -> "Model":
        """Return the model of some of the Gaussians that exist (host).

        Args:
          rows: a mask [N] of bool, indices [M], which may repeat, or a slice.

        Raises:
          ValueError: if it is none of these, or an index is out of range.
        """
        model = self.live
        indices = _indices(rows, model.num)
        params, layout = model.appearance.take_rows(model.params, model.layout, indices)
        return dataclasses.replace(model, gaussians=model.gaussians[indices], params=params, layout=layout)

    @property
    def parameters(self) -> Parameters:
        """All floats of the model, which training differentiates and changes."""
        return Parameters(self.gaussians, self.params)

    def with_parameters(self, parameters: Parameters) -> "Model":
        """Return the same model with other floats, of the same shapes."""
        hint = "say model.parameters._replace(gaussians=gaussians)" if isinstance(parameters, Gaussians) else ""
        check_kind("parameters", parameters, Parameters, hint)
        return dataclasses.replace(self, gaussians=parameters.gaussians, params=parameters.params)

    @property
    def num(self) -> int:
        """Number of Gaussians that exist (host)."""
        return self.gaussians.num if self.num_live is None else int(self.num_live)

    @property
    def live_count(self) -> Array:
        """Number of Gaussians that exist, [] int32; may be traced."""
        return jnp.asarray(self.gaussians.num if self.num_live is None else self.num_live, jnp.int32)

    @property
    def num_bytes(self) -> int:
        """Bytes of the trained floats of the Gaussians that exist, padding left out (host)."""
        return self.bytes_of(self.num)

    @property
    def num_published_bytes(self) -> int:
        """Bytes as the method's authors count them (host)."""
        own = self.gaussians.floats_per_row * self.num
        return BYTES_PER_FLOAT * (own + self.appearance.num_published_floats(self.layout, self.num))

    def bytes_of(self, num: int) -> int:
        """Return the bytes of the trained floats of the first `num` Gaussians and their appearance (host)."""
        check_given(self.appearance, self.params)
        return BYTES_PER_FLOAT * (self.gaussians.floats_per_row * num + self.appearance.num_floats(self.layout, num))

    @property
    def num_padding_bytes(self) -> int:
        """Bytes of padding in the buffers (host)."""
        allocated = sum(np.asarray(leaf.shape).prod() * leaf.dtype.itemsize for leaf in jax.tree.leaves(self.params))
        return int(allocated) + BYTES_PER_FLOAT * self.gaussians.floats_per_row * self.num - self.num_bytes

    @property
    def textures(self) -> tuple[Textures, AtlasLayout] | None:
        """Textures and their layout; None without textures."""
        return self.appearance.textures(self.params, self.layout)

    def with_textures(self, textures: Textures, layout: AtlasLayout) -> "Model":
        """Return the same model with other textures.

        Raises:
          ValueError: if the model has none; the message says how to build one that has.
        """
        check_given(self.appearance, self.params)
        params, layout = self.appearance.with_textures(self.params, self.layout, textures, layout)
        return dataclasses.replace(self, params=params, layout=layout)

    @property
    def bands(self) -> tuple[Bands, BandLayout] | None:
        """Spherical harmonics beyond those of the Gaussians, and their owners; None without degrees per Gaussian."""
        return self.appearance.bands(self.params, self.layout)

    def with_bands(self, bands: Bands, owners: BandLayout) -> "Model":
        """Return the same model with other spherical harmonics beyond those of the Gaussians.

        Raises:
          ValueError: if the model has no degrees per Gaussian; the message says how to build one that has.
        """
        check_given(self.appearance, self.params)
        params, layout = self.appearance.with_bands(self.params, self.layout, bands, owners)
        return dataclasses.replace(self, params=params, layout=layout)

    @property
    def sh(self) -> np.ndarray:
        """[N, K, 3] all spherical harmonics, with zeros above the degree of a Gaussian (host)."""
        own = np.asarray(self.gaussians.sh)
        return own if self.bands is None else dense_sh(own, *self.bands)

    def with_sh(self, sh: np.ndarray) -> "Model":
        """Return the same model with other spherical harmonics, as `sh` gives them; degrees stay (host)."""
        own = jnp.asarray(sh[:, : self.gaussians.sh.shape[1]], self.gaussians.sh.dtype)
        model = dataclasses.replace(self, gaussians=dataclasses.replace(self.gaussians, sh=own))
        if self.bands is None:
            return model
        _, owners = self.bands
        bands, _ = split_sh(sh, owners.degrees, owners.base_degree)
        return model.with_bands(bands, owners)

    @property
    def background(self) -> tuple[float, float, float]:
        """RGB behind all splats: that of the origin, or black."""
        return BLACK if self.origin is None else self.origin.background

    def render(
        self,
        camera: Camera,
        *,
        features: Any = None,
        background: Any = None,
        settings: RenderSettings = RenderSettings(),  # noqa: B008 - frozen
    ) -> RenderOutput:
        """Render the view of a camera, as `render_appearance` does, from the rows that exist.

        Args:
          camera: the view.
          features: [N, D] numbers to show in place of colours (`render_image`), one row for each allocated Gaussian.
          background: [3] colour, or [D] features; None is the model's own, or 0 behind features.
          settings: static options; `texture` is not used, for the appearance has options of its own. Under jit they
            need a capacity: `plan_render(model, cameras)`.
        """
        background = self.background if background is None and features is None else background
        rule = with_features(self.rule, features, self.gaussians)
        return render_appearance(
            self.gaussians, camera, rule, background=background, settings=settings, num_live=self.num_live
        )

    def transform(self, similarity: Similarity) -> "Model":
        """Return the same model in the world that `similarity` leads to, with its cameras (host).

        View dependence turns with the world; all other parameters of the appearance stay.

        Lengths of the settings are in units of the world: `near_plane` is 0.2 of the new units too. Scale it along for
        the same image, which else may lack or show splats close to the camera:

            moved = model.transform(similarity)
            moved.render(moved.origin.cameras[0], settings=settings.transform(similarity))
        """
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
        """Return what a reader asks about a model, by name (host)."""
        degree = self.gaussians.sh_degree
        facts = [
            ("Gaussians", counted(self.num, "Gaussian")),
            ("view dependence", f"SH degrees {degree} to 3" if self.appearance.has_degrees else f"SH degree {degree}"),
            ("appearance", layers_in_words(self.appearance.layers)),
            ("memory", in_bytes(self.num_bytes)),
        ]
        return facts if self.origin is None else [*facts, ("origin", repr(self.origin))]


def _indices(rows: Any, num: int) -> np.ndarray:
    """Return the indices of the rows that a mask, indices or a slice choose of `num`."""
    if isinstance(rows, int | np.integer) and not isinstance(rows, bool):
        if not -num <= rows < num:
            raise ValueError(f"rows must choose among {num} Gaussians; got {rows}")
        end = f"{rows + 1}" if rows != -1 else ""
        raise ValueError(f"rows must be a mask [{num}], indices or a slice; for one Gaussian say model[{rows}:{end}]")
    check_unmasked("rows", rows)
    chosen = rows if isinstance(rows, slice) else np.asarray(rows)
    if not isinstance(chosen, slice) and (chosen.ndim != 1 or (chosen.size and chosen.dtype.kind not in "biu")):
        raise ValueError(f"rows must be a mask [{num}], indices or a slice; got {chosen.dtype} {[*chosen.shape]}")
    try:
        return np.arange(num)[chosen if isinstance(chosen, slice) or chosen.size else slice(0)]
    except IndexError as error:
        raise ValueError(f"rows must choose among {num} Gaussians: {error}") from None


def check_is_model(model: Any, name: str = "model") -> None:
    """Raise ValueError unless a value is a model."""
    check_kind(name, model, Model, "say Model(gaussians)" if isinstance(model, Gaussians) else "")


def concatenate(models: Sequence[Model]) -> Model:
    """Return the Gaussians of several models as one model, in their order.

    The models lie in one world: move them first (`Model.transform`). A warning names a model that was read relative to
    another offset than the first. Spherical harmonics of lower degrees are filled up with zeros.

    Args:
      models: at least one, of the same appearance with the same options.

    Returns:
      The model of all Gaussians that exist; its origin is that of the first model.

    Raises:
      ValueError: if there are no models, or they differ in their appearance or dtype.
    """
    if not isinstance(models, Sequence) or not models:
        raise ValueError("concatenate needs at least one model, in a list")
    for index, model in enumerate(models):
        check_kind(f"models[{index}]", model, Model)
    models = [model.live for model in models]
    first = models[0]
    if kinds := [type(m.appearance).__name__ for m in models if m.appearance != first.appearance]:
        own = type(first.appearance).__name__
        why = f"{own} and {kinds[0]}" if kinds[0] != own else f"{own} of different options"
        raise ValueError(f"models must have one appearance; got {why}")
    if dtypes := [
        str(m.gaussians.means.dtype) for m in models if m.gaussians.means.dtype != first.gaussians.means.dtype
    ]:
        raise ValueError(f"models must have one dtype; got {first.gaussians.means.dtype} and {dtypes[0]}")
    for index, model in enumerate(models[1:], 1):
        if first.origin is not None and model.origin is not None and not model.origin.names:
            apart = model.origin.transform.inverse().then(first.origin.transform).apply(np.zeros(3))
            if np.abs(apart).max() > SAME_PLACE:
                move = f"models[{index}].origin.transform.inverse().then(models[0].origin.transform)"
                warnings.warn(f"models[{index}] is relative to another offset; transform it by {move}", stacklevel=2)
    highest = max(model.gaussians.sh.shape[1] for model in models)
    several = [_with_bases(model.gaussians, 0 if first.appearance.has_degrees else highest) for model in models]
    if len({gaussians.sh_degree for gaussians in several}) > 1:
        raise ValueError(f"models must have one degree below their bands; got {[g.sh_degree for g in several]}")
    params, layout = first.appearance.joined([(model.params, model.layout) for model in models])
    gaussians = jax.tree.map(lambda *x: jnp.concatenate(x), *several)
    return dataclasses.replace(first, gaussians=gaussians, params=params, layout=layout)


def _with_bases(gaussians: Gaussians, num: int) -> Gaussians:
    """Return Gaussians with at least `num` spherical harmonics, new ones zero."""
    missing = max(0, num - gaussians.sh.shape[1])
    return dataclasses.replace(gaussians, sh=jnp.pad(gaussians.sh, ((0, 0), (0, missing), (0, 0))))
