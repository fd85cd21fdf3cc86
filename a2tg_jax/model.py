"""A model: Gaussians and what they show, as one value that is trained, rendered, counted, moved and saved."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance import Appearance, AppearanceRule, Plain, PlainRule
from a2tg_jax.core.budget import BYTES_PER_FLOAT
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.checks import short_repr
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.origin import BLACK, Origin
from a2tg_jax.core.similarity import Similarity
from a2tg_jax.core.transform import transform_gaussians
from a2tg_jax.render import RenderOutput, RenderSettings, render_appearance
from a2tg_jax.texture import AtlasLayout, Textures


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Model:
    """What is trained, saved, loaded, rendered and counted in bytes."""

    gaussians: Gaussians
    """Rows allocated, of which the first `num_live` exist."""
    params: Any = ()
    """Parameters of what the splats show."""
    layout: Any = ()
    """Integers beside them, not differentiable."""
    num_live: Array | None = None
    """int32; None where all rows exist."""
    appearance: Appearance = dataclasses.field(default_factory=Plain, metadata={"static": True})
    """What the splats show."""
    origin: Origin | None = dataclasses.field(default=None, metadata={"static": True})
    """Where it was trained; None where that is not known."""

    @property
    def rule(self) -> AppearanceRule:
        """What the renderer is given."""
        return PlainRule() if self.gaussians.num == 0 else self.appearance.rule(self.params, self.layout)

    @property
    def live(self) -> "Model":
        """The model of the rows that exist, and no others (host)."""
        if self.num_live is None:
            return self
        params, layout = self.appearance.first_rows(self.params, self.layout, self.num)
        return dataclasses.replace(
            self, gaussians=self.gaussians[: self.num], params=params, layout=layout, num_live=None
        )

    @property
    def num(self) -> int:
        """Gaussians that exist (host)."""
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
        """Bytes of the trained floats of the first `num` Gaussians and of what they show (host)."""
        return BYTES_PER_FLOAT * (self.gaussians.floats_per_row * num + self.appearance.num_floats(self.layout, num))

    @property
    def num_padding_bytes(self) -> int:
        """Bytes that exist in the buffers only (host)."""
        allocated = sum(np.asarray(leaf.shape).prod() * leaf.dtype.itemsize for leaf in jax.tree.leaves(self.params))
        return int(allocated) + BYTES_PER_FLOAT * self.gaussians.floats_per_row * self.num - self.num_bytes

    @property
    def textures(self) -> tuple[Textures, AtlasLayout] | None:
        """Textures and their layout; None where splats show none."""
        return self.appearance.textures(self.params, self.layout)

    def with_textures(self, textures: Textures, layout: AtlasLayout) -> "Model":
        """The same model with other textures."""
        params, layout = self.appearance.with_textures(self.params, self.layout, textures, layout)
        return dataclasses.replace(self, params=params, layout=layout)

    @property
    def background(self) -> tuple[float, float, float]:
        """RGB behind everything: the origin's, or black."""
        return BLACK if self.origin is None else self.origin.background

    def render(
        self,
        camera: Camera,
        *,
        background: Any = None,
        settings: RenderSettings = RenderSettings(),  # noqa: B008 - frozen
    ) -> RenderOutput:
        """What a camera sees; as `render_appearance`, of the rows that exist.

        Args:
          camera: the view.
          background: [3] colour; None is the model's own.
          settings: static choices; how textures are read is the appearance's, not theirs.
        """
        background = self.background if background is None else background
        return render_appearance(
            self.gaussians, camera, self.rule, background=background, settings=settings, num_live=self.num_live
        )

    def transform(self, similarity: Similarity) -> "Model":
        """The same model in the world that `similarity` leads to, its cameras carried along (host).

        View dependence turns with the world; what the splats show besides is theirs and stays as it is.
        """
        sh = self.appearance.sh(self.gaussians, self.params, self.layout)
        turned = transform_gaussians(dataclasses.replace(self.gaussians, sh=jnp.asarray(sh)), similarity)
        own = turned.sh[:, : self.gaussians.sh.shape[1]]
        return dataclasses.replace(
            self,
            gaussians=dataclasses.replace(turned, sh=own),
            params=self.appearance.with_sh(np.asarray(turned.sh), self.params, self.layout),
            origin=None if self.origin is None else self.origin.moved(similarity),
        )

    def __repr__(self) -> str:
        return short_repr(self)
