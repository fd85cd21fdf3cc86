"""Training of a finished model with its numbers rounded to the grids of a compact file: fewer bits then suffice.

Rounding all numbers in each step, with gradients that pass straight through, helps little: numbers whose optimum is
between two steps jump between them until the end. Here more and more numbers stay rounded, and the others compensate by
exact gradients. The file uses the grids of the training: it holds the tuned model up to the last digit of a float32.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax import (
    AdamState,
    Appearance,
    Change,
    Correction,
    DivergedError,
    Exponents,
    Gaussians,
    Model,
    Now,
    Progress,
    Scene,
    Stage,
    StepEvent,
    System,
    combine,
    fit_stage,
    partition,
    pytree,
)
from a2tg_jax.appearance.parts import MAX_DEGREE
from a2tg_jax.base.checks import check_untraced
from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.core.gaussians import logit
from a2tg_jax.core.numerics import normalize
from a2tg_jax.finish.compaction import (
    LADDER,
    Ladder,
    Loss,
    TooLargeError,
    TooMuchLostError,
    Trial,
    best_within,
    smallest_within,
    trial_of,
)
from a2tg_jax.host.training_bar import ProgressBar
from a2tg_jax.io.columns import LEAST_OPACITY
from a2tg_jax.io.compact import CompactChoices, Grids, encode_model, grids_of, half_turned
from a2tg_jax.io.model_rows import check_encodable

ITERATIONS = 1000
LAST_ROUNDED = 0.95
"""Share of the training after which all numbers are rounded."""
KEY_OF_TIMES = 0x6121D
RATE_OF_MEANS = 0.3
"""Factor of the means' learning rate, which has decayed when a model is finished."""
FIRST_TOLERANCE = 0.5
"""Loss in dB before tuning for the first try."""
MOST_TUNINGS = 4
"""Largest number of tunings."""
TIGHTER = 0.99
"""Factor of the bytes for which a file is tuned, in each try."""
COARSER: Mapping[str, tuple[int, ...]] = {
    "means": (8, 9), "log_scales": (3,), "quats": (3, 4), "opacities": (2,), "sh_0": (3,), "texels": (2,),
    "shapes": (1, 2),
}  # fmt: skip
TUNED_LADDER: Ladder = MappingProxyType({group: (*COARSER.get(group, ()), *steps) for group, steps in LADDER.items()})
"""Candidate precisions of each group of a tuned model, from coarse to fine."""


# Rounding to the grids of a file, as writing and reading it does (`io.compact`), but traced and with rows in order


class Steps(NamedTuple):
    """Even steps from the first one on."""

    first: Any
    size: Any
    last: Any  # Number of the last step, from 0.

    @classmethod
    def between(cls, low: float, high: float, bits: int) -> Self:
        """Return 2^bits steps between two ends, or one if they are equal."""
        last = (1 << bits) - 1
        # Size 1 instead of 0: it divides.
        return cls(low, (high - low) / last, last) if high > low else cls(low, 1.0, 0)

    def nearest(self, values: Array) -> Array:
        """Return the nearest step to each number."""
        nearest: Array = self.first + self.size * jnp.round(jnp.clip((values - self.first) / self.size, 0, self.last))
        return nearest.astype(values.dtype)


class ContractedSteps(NamedTuple):
    """Even steps of asinh((x − centre) / spread) (`io.columns.AxisSteps`)."""

    centre: Any
    spread: Any
    steps: Steps

    def nearest(self, x: Array) -> Array:
        """Return the nearest step to each number."""
        contracted = self.steps.nearest(jnp.arcsinh((x - self.centre) / self.spread))
        nearest: Array = self.centre + self.spread * jnp.sinh(contracted)
        return nearest.astype(x.dtype)


@pytree
class GridRounding:
    """Rounding to the grids of a compact file, for models that `half_turned` made: no splat is turned again."""

    steps: dict[str, Any]
    """Steps by the name of the part of the file; a part kept as floats has none. Means have three `ContractedSteps`."""

    @classmethod
    def to(cls, grids: Grids, choices: CompactChoices) -> Self:
        """Return the rounding to grids, the ends of the groups that are kept in bits (`io.compact.grids_of`) (host)."""
        steps: dict[str, Any] = {}
        for name, ends in grids.items():
            bits = choices.of_part(name)
            assert isinstance(bits, int)
            if name == "means":
                steps[name] = [
                    ContractedSteps(centre, spread, Steps.between(low, high, bits))
                    for centre, spread, low, high in (ends[:4], ends[4:8], ends[8:])
                ]
            else:
                low, high = ends
                steps[name] = Steps.between(low, high, bits)
        return cls(steps)

    def __call__(self, model: Model) -> Model:
        """Return the model in the file, its rows in the given order; traced."""
        gaussians = self._gaussians(model.gaussians)
        return dataclasses.replace(model, gaussians=gaussians, appearance=self._appearance(model))

    def _gaussians(self, gaussians: Gaussians) -> Gaussians:
        means = gaussians.means
        if "means" in self.steps:
            means = jnp.stack([axis.nearest(x) for axis, x in zip(self.steps["means"], means.T, strict=True)], 1)
        quats = gaussians.quats
        if "quats" in self.steps:
            quats = _with_w(self._nearest("quats", _xyz(quats)))
        logits = gaussians.logit_opacities
        if "opacities" in self.steps:
            # The file has steps of opacities, not of logits.
            opacities = self._nearest("opacities", jax.nn.sigmoid(logits))
            logits = logit(jnp.clip(opacities, LEAST_OPACITY, 1 - LEAST_OPACITY))
        log_scales = self._nearest("log_scales", gaussians.log_scales)
        return Gaussians(means, quats, log_scales, logits, self._bands(gaussians.sh, 0))

    def _appearance(self, model: Model) -> Appearance:
        shown = model.appearance
        table = shown.coefficients
        if table is not None:
            buckets = tuple(self._bands(blocks, model.gaussians.sh_degree + 1) for blocks in table.buckets)
            shown = shown.with_coefficients(dataclasses.replace(table, buckets=buckets))
        textures = shown.textures
        if textures is not None:
            rounded = []
            for bucket in textures.buckets:
                colors = self._nearest("texel_colors", bucket[..., :3])
                alphas = self._nearest("texel_alphas", bucket[..., 3:])
                rounded.append(jnp.concatenate([colors, alphas], axis=-1))
            shown = shown.with_textures(dataclasses.replace(textures, buckets=tuple(rounded)))
        if shown.exponents is not None and "shapes" in self.steps:
            # The file has steps of logarithms.
            logarithms = self._nearest("shapes", shown.exponents.logarithms)
            shown = dataclasses.replace(shown, exponents=Exponents.of_logarithms(logarithms))
        return shown

    def _nearest(self, name: str, values: Array) -> Array:
        return self.steps[name].nearest(values) if name in self.steps else values

    def _bands(self, blocks: Array, first: int) -> Array:
        """Round blocks [M, K, 3] of the bands from degree `first` on, each on its own grid."""
        rounded = [blocks[:, :0]]
        for degree in range(first, MAX_DEGREE + 1):
            start = degree**2 - first**2
            rounded.append(self._nearest(f"sh_{degree}", blocks[:, start : start + 2 * degree + 1]))
        return jnp.concatenate(rounded, axis=1)


def _xyz(quats: Array) -> Array:
    """Return x, y, z [N, 3] of rotations as unit quaternions with w ≥ 0."""
    unit = normalize(quats)
    return unit[:, 1:] * jnp.where(unit[:, :1] < 0, -1, 1)


def _with_w(xyz: Array) -> Array:
    """Return unit quaternions [N, 4] from their last three numbers (`io.columns.with_w`)."""
    w = jnp.sqrt(jnp.maximum(1 - jnp.sum(xyz**2, axis=1, keepdims=True), 0))
    return normalize(jnp.concatenate([w, xyz], axis=1))


@pytree
class GradualRounding(StepEvent):
    """Rounding of more and more numbers, each from a random time on, until all are rounded.

    From then on a number is rounded after every iteration, so that it only leaves its step if an update is larger than
    half a step.
    """

    rounding: GridRounding

    # Times come from a fixed key: the event draws nothing later.
    num_keys = 0

    def init(self, model: Model) -> Model:
        """Return the time of each number, as a share of the iterations before all are rounded."""
        leaves, tree = jax.tree.flatten(partition(model)[0])
        keys = jax.random.split(jax.random.key(KEY_OF_TIMES), len(leaves))
        times = [jax.random.uniform(key, leaf.shape) for key, leaf in zip(keys, leaves, strict=True)]
        return jax.tree.unflatten(tree, times)

    def apply(self, now: Now, model: Model, moments: AdamState, state: Model) -> Change:
        share = now.iteration.astype(float) / (LAST_ROUNDED * now.num_iterations.astype(float))
        is_rounded = jax.tree.map(lambda time: time < share, state)
        return Change(partly_rounded(self.rounding, model, is_rounded), moments, state)


def partly_rounded(rounding: GridRounding, model: Model, is_rounded: Model) -> Model:
    """Return a model of `half_turned` with some numbers rounded, given bools in the shapes of its floats; traced. w of
    a quaternion follows from x, y, z."""
    rounded, _ = partition(rounding(model))
    before, rest = partition(model)
    chosen: Model = jax.tree.map(jnp.where, is_rounded, rounded, before)
    # Rounded and exact x, y, z may be mixed in one quaternion: w must follow from the mixture.
    if "quats" in rounding.steps:
        xyz = (_xyz(rounded.gaussians.quats), _xyz(before.gaussians.quats))
        quats = _with_w(jnp.where(is_rounded.gaussians.quats[:, 1:], *xyz))
        chosen = dataclasses.replace(chosen, gaussians=dataclasses.replace(chosen.gaussians, quats=quats))
    return combine(chosen, rest)


# Training with rounding


@dataclasses.dataclass(frozen=True)
class Tuned(NamedFields):
    """A model whose numbers are on the grids of a compact file."""

    model: Model
    """The model."""
    choices: CompactChoices
    """Precision of its numbers."""
    grids: Grids
    """Grids of the groups in bits, for `save_compact`."""

    @functools.cached_property
    def data(self) -> bytes:
        """The file, as `save_compact` writes it with these choices and grids."""
        return encode_model(self.model, self.choices, self.grids)


def tune_compact(
    model: Model,
    scene: Scene,
    system: System,
    choices: CompactChoices,
    *,
    iterations: int = ITERATIONS,
    progress: bool = False,
    title: str | None = None,
) -> Tuned:
    """Train a finished model further while its numbers are rounded to the grids of a compact file.

        tuned = tune_compact(model, scene, system, CompactChoices(quats=5))
        save_compact("scene.a2tgz", tuned.model, choices=tuned.choices, grids=tuned.grids)

    Losses, learning rates and corrections are taken from the system's last stage; the rates fall to a tenth, and
    corrections stay as they are. Groups kept as floats are trained without rounding.

    Args:
      model: result of the system's last stage, with its learned corrections, which a compact file drops.
      scene: scene with the training views.
      system: system that trained the model.
      choices: bits of each group.
      iterations: number of iterations, at least 1; all numbers are rounded in the last twentieth.
      progress: show a progress bar.
      title: title of the progress bar; None: "tuning".

    Returns:
      The tuned model, with what `save_compact` needs to write it.

    Raises:
      ValueError: if the model's appearance is not that stage's or does not fit a compact file, or the stage's learned
        corrections are missing.
      DivergedError: if the loss or a gradient is not finite, or the loss explodes.
    """
    check_untraced("tune_compact")
    stage = system.stages()[-1]
    check_encodable(model.appearance)
    if iterations < 1:
        raise ValueError(f"iterations must be at least 1; got {iterations}")
    if model.appearance.template != stage.appearance:
        wanted = stage.appearance.description
        shown = model.appearance.description
        if shown == wanted:
            shown += " with other options"
        raise ValueError(
            f"model must have what the last stage of the system, {stage.name!r}, trains, {wanted}; it has {shown}"
        )
    learned = {} if model.origin is None else model.origin.corrections
    missing = [correction.name for correction in stage.corrections if correction.name not in learned]
    if missing:
        raise ValueError(
            f"model must have the corrections that training learned, {' and '.join(missing)}, which a compact file "
            "drops: give the model that training saved"
        )
    # `half_turned` goes through a file, which drops corrections: the origin is put back.
    start = dataclasses.replace(half_turned(model), origin=model.origin)
    grids = grids_of(start, choices)
    tuning = dataclasses.replace(
        stage,
        name="tuning",
        iterations=iterations,
        rates=dataclasses.replace(stage.rates, means=RATE_OF_MEANS * stage.rates.means),
        events=(GradualRounding(GridRounding.to(grids, choices)),),
        corrections=tuple(_held(type(each))(**each.__dict__) for each in stage.corrections),  # type: ignore[arg-type]
        # The model has its final degrees.
        raises_sh_degree=False,
        num_coarse=0,
        cools_down=True,
    )
    shared = {field.name: getattr(system, field.name) for field in dataclasses.fields(System)}
    # Tuning changes no sizes, so no budget applies.
    shared |= {"memory_budget": None, "initial_gaussians": None, "sh_degree": start.gaussians.sh_degree}
    one_stage = _OneStage(**shared, stage=tuning)
    tuned = fit_stage(scene, one_stage, 0, start, progress=Progress(ProgressBar if progress else None, title)).model
    return Tuned(dataclasses.replace(tuned, origin=start.origin), choices, grids)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _OneStage(System):
    """The options that all systems have, with a given stage."""

    stage: Stage

    def stages(self) -> tuple[Stage, ...]:
        return (self.stage,)

    def check(self) -> None:
        self.stage.check()


@functools.cache
def _held(kind: type[Correction]) -> type[Correction]:
    """Return a subclass of a correction with constant rows."""

    @pytree
    class Held(kind):  # type: ignore[misc, valid-type]
        # No penalty pulls at the rows, and no average moves them.
        penalty = Correction.penalty
        project = Correction.project

        def learning_rate(self, progress: Array) -> Array:
            return jnp.zeros_like(progress)

    return Held


class TunedFiles(NamedTuple):
    """Result of `smallest_tuned` and `best_tuned`."""

    tried: list[Trial]  # All files of tuned models.
    chosen: Trial | None = None  # The smallest within the loss, or the one within the bytes; None if there is none.
    tuned: Tuned | None = None  # The model of that file.
    diverged: str | None = None  # Error that ended the search; None: the search was completed.


Tune = Callable[[Model, CompactChoices, int], Tuned]
"""Tunes a model for choices, given the number of the tuning, from 1."""


def smallest_tuned(
    model: Model, losses: Sequence[Loss], max_loss: float, trials: Sequence[Trial], tune: Tune
) -> TunedFiles:
    """Search for the smallest file of a tuned model within a loss (host).

    Up to `MOST_TUNINGS` times, choices that lose more before tuning are tuned. That loss doubles while the tuned model
    stays within `max_loss`; after the first failure, it falls or grows by a factor of √2. Each tuning starts from the
    previous one, so that failed choices may be tried again. The search ends early, with the best file so far, if a
    tuning diverges or even the finest choices lose more.

    Losses are in dB, by the first measure, of the tuned model's file against `model`. Trials are results of
    `measure_choices`, such as with `TUNED_LADDER`.
    """
    files = TunedFiles([])
    latest = model
    tolerance = max(FIRST_TOLERANCE, 2 * max_loss)
    factor = 2.0
    for number in range(1, MOST_TUNINGS + 1):
        try:
            choices = smallest_within(model, losses, tolerance, trials).choices
        except TooMuchLostError:
            break
        # These choices were tuned already and are within the loss.
        if files.chosen is not None and choices == files.chosen.choices:
            break
        try:
            tuned = tune(latest, choices, number)
        except DivergedError as error:
            return files._replace(diverged=str(error))
        latest = tuned.model
        trial = _measured(tuned, losses)
        files.tried.append(trial)
        if trial.losses[0] > max_loss:
            factor = math.sqrt(2)
            # A file within max_loss needs no tuning.
            tolerance = max(tolerance / factor, max_loss)
            continue
        if files.chosen is None or trial.num_bytes < files.chosen.num_bytes:
            files = files._replace(chosen=trial, tuned=tuned)
        tolerance *= factor
    return files


def best_tuned(model: Model, losses: Sequence[Loss], max_bytes: int, trials: Sequence[Trial], tune: Tune) -> TunedFiles:
    """Tune a model for a file of at most this many bytes (host); arguments as of `smallest_tuned`.

    Training spreads numbers, so that a file becomes some percent longer. While it is too long, the tuned model is tuned
    again, for bits with which `model` takes fewer bytes, up to `MOST_TUNINGS` times in all.
    """
    files = TunedFiles([])
    latest = model
    target = TIGHTER * max_bytes
    for number in range(1, MOST_TUNINGS + 1):
        try:
            tuned = tune(latest, best_within(model, int(target), trials), number)
        except TooLargeError:
            break
        except DivergedError as error:
            return files._replace(diverged=str(error))
        latest = tuned.model
        trial = _measured(tuned, losses)
        files.tried.append(trial)
        if trial.num_bytes <= max_bytes:
            return files._replace(chosen=trial, tuned=tuned)
        target *= TIGHTER * max_bytes / trial.num_bytes
    return files


def _measured(tuned: Tuned, losses: Sequence[Loss]) -> Trial:
    """Return size and losses of a tuned model's file."""
    return trial_of(tuned.data, tuned.choices, losses)
