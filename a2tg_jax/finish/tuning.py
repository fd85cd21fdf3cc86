"""Training of a finished model while its numbers are rounded to the grids of a compact file: fewer bits then suffice.

Gradually more numbers are rounded, and the others make up for it (`finish.rounding`). The file keeps the grids that
training knew: it holds the tuned model up to the last digit of a float32.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance import in_words, template_of
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.pytree import pytree
from a2tg_jax.data.scene import Scene
from a2tg_jax.finish.compaction import LADDER, Ladder, Loss, TooMuchLostError, Trial, smallest_within
from a2tg_jax.finish.rounding import GradualRounding, GridRounding
from a2tg_jax.io.compact import CompactChoices, Grids, decode_model, encode_model, grids_of, half_turned
from a2tg_jax.io.model_rows import check_encodable
from a2tg_jax.model import Model
from a2tg_jax.training import DivergedError, Stage, System, fit_stage
from a2tg_jax.training.corrections import Correction

ITERATIONS = 1000
RATE_OF_MEANS = 0.3
"""Factor of the means' learning rate, which has decayed by the time a model is finished."""
FIRST_TOLERANCE = 0.5
"""Loss in dB before tuning that is tried first."""
MOST_TUNINGS = 4
"""Largest number of times that a model is tuned."""
COARSER: Mapping[str, tuple[int, ...]] = MappingProxyType(
    {
        "means": (8, 9),
        "log_scales": (3,),
        "quats": (3, 4),
        "opacities": (2,),
        "sh_0": (3,),
        "texels": (2,),
        "shapes": (1, 2),
    }
)
TUNED_LADDER: Ladder = MappingProxyType({group: (*COARSER.get(group, ()), *steps) for group, steps in LADDER.items()})
"""Candidate precisions of each group of a model that is tuned, from coarse to fine."""


@dataclasses.dataclass(frozen=True)
class Tuned:
    """A model whose numbers lie on the grids of a compact file."""

    model: Model
    choices: CompactChoices
    grids: Grids

    @functools.cached_property
    def data(self) -> bytes:
        """The file, as `save_compact` writes it with these choices and grids."""
        return encode_model(self.model, self.choices, self.grids)


Tune = Callable[[Model, CompactChoices, int], Tuned]
"""Tunes a model for choices, given the number of the tuning, from 1."""


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

    Losses, learning rates and corrections are those of the system's last stage; the rates fall to a tenth, and
    corrections stay as they are. Groups kept as floats are trained without rounding.

    Args:
      model: result of the system's last stage, with the corrections that it learned, which a compact file drops.
      scene: its training views are trained on.
      system: which trained the model.
      choices: bits of each group.
      iterations: at least 1; 19 of 20 go by before all numbers are rounded.
      progress: show a progress bar.
      title: of the progress bar; None: "tuning".

    Raises:
      ValueError: if the model shows something else than that stage, or what a compact file cannot hold, or has none of
        the corrections that the stage learned.
      DivergedError: if the loss or a gradient is not finite, or the loss explodes.
    """
    stage = system.stages()[-1]
    _check(model, stage, iterations)
    start = dataclasses.replace(half_turned(model), origin=model.origin)
    grids = grids_of(start, choices)
    rounding = GradualRounding(GridRounding.to(grids, choices))
    tuning = _tuning(system, dataclasses.replace(stage, events=(rounding,), iterations=iterations))
    found = fit_stage(scene, tuning, 0, start, progress=progress, title=title).model
    return Tuned(dataclasses.replace(found, origin=start.origin), choices, grids)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Tuning(System):
    """The options that all systems have, with a given stage."""

    stage: Stage

    def stages(self) -> tuple[Stage, ...]:
        return (self.stage,)

    def check(self) -> None:
        self.stage.check()


def _tuning(system: System, stage: Stage) -> _Tuning:
    """Return the options of a system with a stage whose rates fall and whose corrections stay."""
    rates = dataclasses.replace(stage.rates, means=RATE_OF_MEANS * stage.rates.means)
    corrections = tuple(map(_Constant, stage.corrections))
    stage = dataclasses.replace(
        stage, name="tuning", rates=rates, corrections=corrections, raises_sh_degree=False, cools_down=True
    )
    shared = {field.name: getattr(system, field.name) for field in dataclasses.fields(System)}
    return _Tuning(**shared | {"memory_budget": None}, stage=stage)


@pytree
class _Constant(Correction):
    """A correction that no longer learns."""

    learned: Correction

    @property
    def name(self) -> str:  # type: ignore[override]
        return self.learned.name

    @property
    def bytes_per_pixel(self) -> float:  # type: ignore[override]
        return self.learned.bytes_per_pixel

    @property
    def neutral(self) -> np.ndarray:
        return self.learned.neutral

    def learning_rate(self, progress: Array) -> Array:
        return jnp.zeros_like(progress)

    def camera(self, row: Array, camera: Camera) -> Camera:
        return self.learned.camera(row, camera)

    def color(self, row: Array, color: Array) -> Array:
        return self.learned.color(row, color)


def _check(model: Model, stage: Stage, iterations: int) -> None:
    check_encodable(model.appearance)
    if iterations < 1:
        raise ValueError(f"iterations must be at least 1; got {iterations}")
    if template_of(model.appearance) != stage.appearance:
        wanted, shown = in_words(stage.appearance), in_words(model.appearance)
        shown = f"{shown} with other options" if shown == wanted else shown
        raise ValueError(
            f"model must show what the last stage of the system, {stage.name!r}, trains, {wanted}; it shows {shown}"
        )
    learned = {} if model.origin is None else model.origin.corrections
    if missing := [correction.name for correction in stage.corrections if correction.name not in learned]:
        raise ValueError(
            f"model must have the corrections that training learned, {' and '.join(missing)}, which a compact file "
            "drops: give the model that training saved"
        )


class TunedFiles(NamedTuple):
    """Result of `smallest_tuned`."""

    tried: list[Trial]
    """All files of tuned models."""
    chosen: Trial | None = None
    """The smallest one within the loss; None if there is none."""
    tuned: Tuned | None = None
    """The model of that file."""
    diverged: str | None = None
    """Error that ended the search; None: it came to its end."""


def smallest_tuned(
    model: Model, losses: Sequence[Loss], max_loss: float, trials: Sequence[Trial], tune: Tune
) -> TunedFiles:
    """Search the smallest file of a tuned model within a loss (host).

    Choices that lose more before tuning are tuned for, `MOST_TUNINGS` times. That loss is doubled as long as the tuned
    model stays within `max_loss`; from the first time on that it does not, the loss falls or grows by a factor of √2.
    Each tuning goes on from the one before, so that what was too much once may be tried again. The search ends early if
    a tuning diverges or even the finest choices lose more, and keeps what was found before.

    Args:
      model: the model.
      losses: measures of what is lost.
      max_loss: in dB, by the first measure, of the file of the tuned model beside `model`.
      trials: what `measure_choices` found, as with `TUNED_LADDER`.
      tune: tunes a model for choices.
    """
    found, latest = TunedFiles([]), model
    tolerance, factor = max(FIRST_TOLERANCE, 2 * max_loss), 2.0
    for number in range(1, MOST_TUNINGS + 1):
        try:
            choices = smallest_within(model, losses, tolerance, trials).choices
        except TooMuchLostError:
            break
        if found.chosen is not None and choices == found.chosen.choices:
            break
        try:
            tuned = tune(latest, choices, number)
        except DivergedError as error:
            return found._replace(diverged=str(error))
        trial, latest = _measured(tuned, losses), tuned.model
        found.tried.append(trial)
        if trial.losses[0] > max_loss:
            factor = math.sqrt(2)
            tolerance = max(tolerance / factor, max_loss)
            continue
        if found.chosen is None or trial.num_bytes < found.chosen.num_bytes:
            found = found._replace(chosen=trial, tuned=tuned)
        tolerance *= factor
    return found


def _measured(found: Tuned, losses: Sequence[Loss]) -> Trial:
    """Return size and losses of a tuned model's file."""
    data = found.data
    again = decode_model(data)
    return Trial(found.choices, len(data), tuple(loss(again) for loss in losses))
