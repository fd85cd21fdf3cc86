"""A model: Gaussians and what they show, as one value that is trained, rendered, counted, moved and saved."""

import dataclasses
from typing import Any

import jax
import numpy as np
from jax import Array

from a2tg_jax.appearance import Appearance, AppearanceRule, Plain
from a2tg_jax.appearance.base import BYTES_PER_FLOAT
from a2tg_jax.gaussians import Gaussians


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

    @property
    def rule(self) -> AppearanceRule:
        """What the renderer is given."""
        return self.appearance.rule(self.params, self.layout)

    @property
    def num(self) -> int:
        """Gaussians that exist (host)."""
        return self.gaussians.num if self.num_live is None else int(self.num_live)

    @property
    def live(self) -> "Model":
        """The rows that exist alone (host)."""
        if self.num_live is None:
            return self
        params, layout = self.appearance.first_rows(self.params, self.layout, self.num)
        return Model(self.gaussians[: self.num], params, layout, appearance=self.appearance)

    @property
    def num_bytes(self) -> int:
        """Bytes of the trained floats of the Gaussians that exist, padding left out (host)."""
        return BYTES_PER_FLOAT * self.appearance.num_floats(self.layout, self.num)

    @property
    def num_published_bytes(self) -> int:
        """Bytes as the method's authors count them (host)."""
        return BYTES_PER_FLOAT * self.appearance.num_published_floats(self.layout, self.num)

    @property
    def num_padding_bytes(self) -> int:
        """Bytes that exist in the buffers only (host)."""
        allocated = sum(np.asarray(leaf.shape).prod() * leaf.dtype.itemsize for leaf in jax.tree.leaves(self.params))
        return int(allocated) + BYTES_PER_FLOAT * 58 * self.num - self.num_bytes
