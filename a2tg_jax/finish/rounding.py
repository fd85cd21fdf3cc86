"""Rounding of a model's numbers to the grids of a compact file, within training.

It does what writing and reading the file does (`io.compact`), but it can be traced, and rows keep their order.

Rounding all numbers in each step, with gradients that pass straight through, helps little: numbers whose optimum lies
between two steps jump from one to the other until the end. Here more and more numbers stay rounded. Those that are not
yet rounded follow exact gradients and make up for it.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.appearance.parts import LARGEST_LOG_EXPONENT, MAX_DEGREE, MOST_SHARE
from a2tg_jax.core.gaussians import Gaussians, logit
from a2tg_jax.core.numerics import normalize
from a2tg_jax.core.optim import AdamState
from a2tg_jax.core.pytree import combine, partition, pytree
from a2tg_jax.core.sh import NUM_BASES
from a2tg_jax.events import Change, Now, StepEvent
from a2tg_jax.io.columns import LEAST_OPACITY
from a2tg_jax.io.compact import CompactChoices, Grids
from a2tg_jax.model import Model

LAST_ROUNDED = 0.95
"""Share of a training after which all numbers are rounded."""
KEY_OF_TIMES = 0x6121D


class Steps(NamedTuple):
    """Even steps from the first one on."""

    first: Any
    size: Any
    last: Any
    """Number of the last step, from 0."""

    @classmethod
    def between(cls, ends: Sequence[float], bits: int) -> Self:
        """Return 2^bits steps between two ends, or one if the ends are equal."""
        low, high = ends
        last = (1 << bits) - 1
        return cls(low, (high - low) / last, last) if high > low else cls(low, 1.0, 0)

    def nearest(self, values: Array) -> Array:
        """Return the nearest step to each number."""
        steps = jnp.round(jnp.clip((values - self.first) / self.size, 0, self.last))
        nearest: Array = (self.first + steps * self.size).astype(values.dtype)
        return nearest


class ContractedSteps(NamedTuple):
    """Even steps of asinh((x − centre) / spread), for an axis of the means (`io.columns.AxisSteps`)."""

    centre: Any
    spread: Any
    steps: Steps

    def nearest(self, values: Array) -> Array:
        """Return the nearest step to each number."""
        contracted = self.steps.nearest(jnp.arcsinh((values - self.centre) / self.spread))
        nearest: Array = (self.centre + self.spread * jnp.sinh(contracted)).astype(values.dtype)
        return nearest


@pytree
class GridRounding:
    """Rounding to the grids of a compact file, for models that `half_turned` made: no splat is turned again."""

    steps: dict[str, Any]
    """Steps by the name of the part of the file; a part kept as floats has none. Means have those of each axis."""

    @classmethod
    def to(cls, grids: Grids, choices: CompactChoices) -> Self:
        """Return the rounding to given grids (host).

        Args:
          grids: ends of the groups that are kept in bits (`io.compact.grids_of`).
          choices: the bits.
        """
        return cls({name: _steps_of(name, ends, choices) for name, ends in grids.items()})

    def __call__(self, model: Model) -> Model:
        """Return the model that the file holds, its rows in their order; traced."""
        model = dataclasses.replace(model, gaussians=self._gaussians(model.gaussians))
        shown = model.appearance
        if (table := shown.coefficients) is not None:
            buckets = tuple(self._bands(blocks, model.gaussians.sh_degree + 1) for blocks in table.buckets)
            shown = shown.with_coefficients(dataclasses.replace(table, buckets=buckets))
        if (textures := shown.textures) is not None:
            buckets = tuple(map(self._texels, textures.buckets))
            shown = shown.with_textures(dataclasses.replace(textures, buckets=buckets))
        if shown.shapes is not None and "shapes" in self.steps:
            shown = shown.with_shapes(self._shapes(shown.shapes))
        return dataclasses.replace(model, appearance=shown)

    def _bands(self, blocks: Array, first: int) -> Array:
        """Return blocks [M, K, 3] of the bands from degree `first` on."""
        rounded, start = [blocks[:, :0]], 0
        for degree in range(first, MAX_DEGREE + 1):
            if start < blocks.shape[1]:
                rounded.append(self._nearest(f"sh_{degree}", blocks[:, start : start + 2 * degree + 1]))
                start += 2 * degree + 1
        return jnp.concatenate(rounded, axis=1)

    def _nearest(self, name: str, values: Array) -> Array:
        return self.steps[name].nearest(values) if name in self.steps else values

    def _gaussians(self, gaussians: Gaussians) -> Gaussians:
        degrees = range(gaussians.sh_degree + 1)
        bands = [gaussians.sh[:, NUM_BASES[d] - 2 * d - 1 : NUM_BASES[d]] for d in degrees]
        means = gaussians.means
        if "means" in self.steps:
            means = jnp.stack([steps.nearest(means[:, axis]) for axis, steps in enumerate(self.steps["means"])], 1)
        return Gaussians(
            means=means,
            quats=self._quats(gaussians.quats),
            log_scales=self._nearest("log_scales", gaussians.log_scales),
            logit_opacities=self._logits(gaussians.logit_opacities),
            sh=jnp.concatenate([self._nearest(f"sh_{d}", band) for d, band in zip(degrees, bands, strict=True)], 1),
        )

    def _quats(self, quats: Array) -> Array:
        if "quats" not in self.steps:
            return quats
        return _with_w(self._nearest("quats", _xyz(quats)))

    def _logits(self, logits: Array) -> Array:
        if "opacities" not in self.steps:
            return logits
        return logit(jnp.clip(self._nearest("opacities", jax.nn.sigmoid(logits)), LEAST_OPACITY, 1 - LEAST_OPACITY))

    def _shapes(self, shapes: Array) -> Array:
        shares = self._nearest("shapes", LARGEST_LOG_EXPONENT * jnp.tanh(shapes)) / LARGEST_LOG_EXPONENT
        return jnp.arctanh(jnp.clip(shares, -MOST_SHARE, MOST_SHARE))

    def _texels(self, texels: Array) -> Array:
        parts = self._nearest("texel_colors", texels[..., :3]), self._nearest("texel_alphas", texels[..., 3:])
        return jnp.concatenate(parts, axis=-1)


def _steps_of(name: str, ends: tuple[float, ...], choices: CompactChoices) -> Any:
    """Return the steps of a part of the file, for the means those of each axis."""
    bits = choices.of_part(name)
    assert isinstance(bits, int)
    if name != "means":
        return Steps.between(ends, bits)
    axes = [ends[4 * axis : 4 * axis + 4] for axis in range(3)]
    return tuple(ContractedSteps(centre, spread, Steps.between(own, bits)) for centre, spread, *own in axes)


def _xyz(quats: Array) -> Array:
    """Return the last three numbers [N, 3] of rotations as unit quaternions of which no w is negative."""
    unit = normalize(quats)
    return unit[:, 1:] * jnp.where(unit[:, :1] < 0, -1, 1)


def _with_w(xyz: Array) -> Array:
    """Return unit quaternions [N, 4] from their last three numbers (`io.columns.with_w`)."""
    w = jnp.sqrt(jnp.maximum(1 - jnp.sum(xyz**2, axis=1, keepdims=True), 0))
    return normalize(jnp.concatenate([w, xyz], axis=1))


@pytree
class GradualRounding(StepEvent):
    """Rounding of more and more numbers, each from a random time on, until all of them are rounded.

    A number is rounded after every later iteration too, so that it leaves its step of the grid only if an update is
    larger than half a step.
    """

    rounding: GridRounding

    num_keys = 0

    def init(self, model: Model) -> Model:
        """Return the time of each number, as a share of the iterations before all are rounded."""
        leaves, tree = jax.tree.flatten(partition(model)[0])
        keys = jax.random.split(jax.random.key(KEY_OF_TIMES), len(leaves))
        times = [jax.random.uniform(key, leaf.shape) for key, leaf in zip(keys, leaves, strict=True)]
        of_numbers: Model = jax.tree.unflatten(tree, times)
        return of_numbers

    def apply(self, now: Now, model: Model, moments: AdamState, state: Model) -> Change:
        share = now.iteration.astype(float) / (LAST_ROUNDED * now.num_iterations.astype(float))
        is_rounded = jax.tree.map(lambda time: time < share, state)
        return Change(partly_rounded(self.rounding, model, is_rounded), moments, state)


def partly_rounded(rounding: GridRounding, model: Model, is_rounded: Model) -> Model:
    """Return the model with some numbers rounded; traced.

    Args:
      rounding: of all numbers.
      model: as `half_turned` gives it, with numbers that may have changed since.
      is_rounded: bool, in the shapes of the model's floats; w of a quaternion follows from its other numbers.
    """
    (rounded, _), (before, rest) = partition(rounding(model)), partition(model)
    chosen: Model = jax.tree.map(jnp.where, is_rounded, rounded, before)
    if "quats" in rounding.steps:
        pair = _xyz(rounded.gaussians.quats), _xyz(before.gaussians.quats)
        quats = _with_w(jnp.where(is_rounded.gaussians.quats[:, 1:], *pair))
        chosen = dataclasses.replace(chosen, gaussians=dataclasses.replace(chosen.gaussians, quats=quats))
    return combine(chosen, rest)
