"""Precisions for a compact file: the smallest file within a loss, or the file of a given size that loses least.

A loss is a function of a model that returns how many dB it is below the original model. It is measured on photographs
or, without them, estimated from differences between renders.
"""

import bisect
import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from a2tg_jax import Camera, Model, Renderer, RenderSettings, View, view_image
from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.core.origin import Color
from a2tg_jax.host.progress_bars import progress_over
from a2tg_jax.io.columns import Precision
from a2tg_jax.io.compact import CompactChoices, decode_model, encode_model
from a2tg_jax.model import check_is_model
from a2tg_jax.scene import check_are_views

Loss = Callable[[Model], float]
Ladder = Mapping[str, tuple[Precision, ...]]

LADDER: Ladder = MappingProxyType(
    {
        "means": (10, 11, 12, 13, 14, 16),
        "log_scales": (4, 5, 6, 7, 8, 10),
        "quats": (5, 6, 7, 8, 10),
        "opacities": (3, 4, 5, 6, 8, 10),
        "sh_0": (4, 5, 6, 7, 8, 10),
        "sh_rest": (2, 3, 4, 5, 6, 8, 10),
        "texels": (3, 4, 5, 6, 7, 8, 10),
        "shapes": (3, 4, 5, 6, 8, 10),
    }
)
"""Candidate precisions of each group, from coarse to fine."""
ASSUMED_PSNR = 30.0
"""Assumed PSNR in dB of a model on missing photographs."""
LEAST_LOSS = 1e-4
"""Smaller differences in dB are noise and count as this one."""


@dataclasses.dataclass(frozen=True)
class Trial(NamedFields):
    """A file, measured."""

    choices: CompactChoices
    """Precisions of the file."""
    num_bytes: int
    """Size on disk."""
    losses: tuple[float, ...]
    """Loss in dB, by each measure of loss."""
    group: str = ""
    """Group that is coarser than the rest, if any."""

    @property
    def precision(self) -> Precision:
        """Precision of its group."""
        return getattr(self.choices, self.group)


def loss_on_views(
    model: Model,
    views: Sequence[View],
    *,
    background: Color | None = None,
    settings: RenderSettings = RenderSettings(),  # noqa: B008 - frozen
) -> Loss:
    """Return a measure of loss: PSNR of a model − PSNR of another, as a mean over photographs.

    Args:
      model: the model that others are compared with.
      views: views with photographs, such as the training views.
      background: [3] colour; None is the model's own.
      settings: static options, without a capacity.

    Returns:
      A function of another model that returns the loss in dB.

    Raises:
      ValueError: if there are no views, or an argument is of another kind.
    """
    check_is_model(model)
    check_are_views(views, "loss_on_views(model, scene.train)")
    background = model.background if background is None else background
    draw = _drawing(model, [view.camera for view in views], background, settings)

    def psnr(other: Model) -> float:
        decibels = []
        for view, image in zip(views, draw(other), strict=True):
            # `...` selects all pixels.
            counts = ... if view.mask is None else view.mask.read()
            error = _squared_error(image[counts], np.clip(view_image(view, background), 0, 1)[counts])
            # At most 120 dB: equal images would be infinite.
            decibels.append(-10 * math.log10(max(error, 1e-12)))
        return float(np.mean(decibels))

    psnr_of_model = psnr(model)
    return lambda other: psnr_of_model - psnr(other)


def loss_beside_renders(
    model: Model,
    cameras: Sequence[Camera],
    *,
    assumed_psnr: float = ASSUMED_PSNR,
    settings: RenderSettings = RenderSettings(),  # noqa: B008 - frozen
) -> Loss:
    """Return an estimate of the same loss without photographs, from renders of both models.

    10·log10(1 + e/E): e is the mean squared difference of two renders, E the error that the PSNR implies.
    Uncorrelated errors add up this way.

    Args:
      model: the model that others are compared with.
      cameras: the views to render.
      assumed_psnr: PSNR of the model on photographs, in dB.
      settings: static options, without a capacity.

    Returns:
      A function of another model that returns the loss in dB.

    Raises:
      ValueError: if there are no cameras, or the model is of another kind.
    """
    check_is_model(model)
    draw = _drawing(model, cameras, model.background, settings)
    renders = list(draw(model))
    assumed_error = 10 ** (-assumed_psnr / 10)

    def loss(other: Model) -> float:
        errors = (_squared_error(*pair) for pair in zip(draw(other), renders, strict=True))
        return float(np.mean([10 * math.log10(1 + error / assumed_error) for error in errors]))

    return loss


def _drawing(
    model: Model, cameras: Sequence[Camera], background: ArrayLike | None, settings: RenderSettings
) -> Callable[[Model], Iterator[np.ndarray]]:
    """Return a function that renders models like the given one for cameras, clipped to [0, 1]."""
    if not cameras:
        raise ValueError("there are no views to measure a loss on")
    options: dict[str, Any] = {"background": background, "settings": settings, "has_geometry": False}
    capacities = Renderer(model, cameras=cameras, **options).capacities

    def draw(other: Model) -> Iterator[np.ndarray]:
        renderer = Renderer(other, capacities=capacities, **options)
        return (np.clip(np.asarray(renderer(camera).color), 0, 1) for camera in cameras)

    return draw


def _squared_error(image: np.ndarray, target: np.ndarray) -> float:
    return float(np.mean((np.asarray(image, np.float64) - target) ** 2))


def try_choices(model: Model, choices: CompactChoices, losses: Sequence[Loss], group: str = "") -> Trial:
    """Return the size of a file, and the loss of the model in it by each measure (host)."""
    return trial_of(encode_model(model, choices), choices, losses, group)


def trial_of(data: bytes, choices: CompactChoices, losses: Sequence[Loss], group: str = "") -> Trial:
    """Return the size of a file, given as bytes, and the loss of the model in it by each measure (host)."""
    # Measured on what the file gives back, not on a simulation of it.
    model = decode_model(data)
    return Trial(choices, len(data), tuple(loss(model) for loss in losses), group)


def finest_choices(ladder: Ladder = LADDER) -> CompactChoices:
    """Return the last step of each group."""
    return CompactChoices().keeping({group: steps[-1] for group, steps in ladder.items()})


def measure_choices(
    model: Model, losses: Sequence[Loss], ladder: Ladder = LADDER, *, progress: bool = False
) -> list[Trial]:
    """Return sizes and losses of each step of each group, with the other groups at their finest (host).

    Args:
      model: the model.
      losses: measures of loss.
      ladder: steps of groups, from coarse to fine.
      progress: show a progress bar.

    Returns:
      Files tried, each with its `choices`, `num_bytes` and `losses` in dB, from coarse to fine, for each group that the
      model has.
    """
    finest = finest_choices(ladder)
    most_bytes = len(encode_model(model, finest))
    tried: list[tuple[str, Precision]] = []
    for group, steps in ladder.items():
        coarsest = finest.keeping({group: steps[0]})
        # Groups without numbers, such as texels of a model without textures, do not change the size.
        if len(encode_model(model, coarsest)) < 0.999 * most_bytes:
            tried += [(group, step) for step in steps]
    shown = progress_over(tried, "rounding", "way", is_shown=progress)
    return [try_choices(model, finest.keeping({group: step}), losses, group) for group, step in shown]


class TooMuchLostError(ValueError):
    """No file is within the allowed loss."""


def smallest_within(model: Model, losses: Sequence[Loss], max_loss: float, trials: Sequence[Trial]) -> Trial:
    """Return the smallest file within a loss by the first measure, by greedy search (host).

    Start from the finest choices. Take the step with the most bytes saved per loss while the sum of the separate losses
    stays within the limit. Then undo the last steps until the file itself is within it, and finally try single steps.

    Args:
      model: the model.
      losses: measures of loss.
      max_loss: in dB.
      trials: results of `measure_choices`.

    Returns:
      The file, with its `choices`, `num_bytes` and `losses`.

    Raises:
      ValueError: if the finest choices lose more.
    """
    by_size = _by_size(trials)
    finest = {group: steps[-1].precision for group, steps in by_size.items()}
    # The sum of separate losses is only an estimate: coarser groups may interact.
    for chosen in [*reversed(_descent(by_size, max_loss)), finest]:
        best = try_choices(model, finest_choices().keeping(chosen), losses)
        if best.losses[0] <= max_loss:
            break
    else:
        least = f"{best.losses[0]:.4f} dB or more"
        raise TooMuchLostError(f"max_loss must be {least}: the finest choices lose that; got {max_loss}")

    def next_step(group: str) -> tuple[int, Precision]:
        """Return the bytes that a group's next smaller step saves, and its precision; 0 if there is none."""
        steps = by_size[group]
        at = [trial.precision for trial in steps].index(getattr(best.choices, group))
        smaller = steps[max(at - 1, 0)]
        return steps[at].num_bytes - smaller.num_bytes, smaller.precision

    for group in sorted(by_size, key=lambda group: -next_step(group)[0]):  # Largest savings first.
        saved, precision = next_step(group)
        if saved:
            tried = try_choices(model, best.choices.keeping({group: precision}), losses)
            if tried.losses[0] <= max_loss and tried.num_bytes < best.num_bytes:
                best = tried
    return best


class TooLargeError(ValueError):
    """No file is within the allowed bytes."""

    def __init__(self, least: int):
        """`least` is the size of the smallest file."""
        kilobytes = math.ceil(least / 10) / 100
        super().__init__(f"file_budget must be at least {kilobytes} kB, the size of the smallest file")


def check_fits(model: Model, max_bytes: int, ladder: Ladder = LADDER) -> None:
    """Raise TooLargeError if the file with the coarsest steps of all groups takes more bytes (host)."""
    coarsest = CompactChoices().keeping({group: steps[0] for group, steps in ladder.items()})
    least = len(encode_model(model, coarsest))
    if least > max_bytes:
        raise TooLargeError(least)


def best_within(model: Model, max_bytes: int, trials: Sequence[Trial]) -> CompactChoices:
    """Return the choices of a file of at most this many bytes that loses least, by greedy search (host).

    Start from the finest choices. Take the step with the most bytes saved per loss, until the file is small enough.
    Then take finer steps back, those that gain most first, while it stays so.

    Args:
      model: the model.
      max_bytes: largest size of the file.
      trials: results of `measure_choices`, of this model or of a similar one.

    Raises:
      ValueError: if the coarsest choices take more bytes.
    """
    by_size = _by_size(trials)

    def size_of(kept: Mapping[str, Precision]) -> int:
        return len(encode_model(model, finest_choices().keeping(kept)))

    path = [{group: steps[-1].precision for group, steps in by_size.items()}, *_descent(by_size, math.inf)]
    at = bisect.bisect_left(range(len(path)), True, key=lambda index: size_of(path[index]) <= max_bytes)
    if at == len(path):
        raise TooLargeError(size_of(path[-1]))
    chosen = path[at]
    while True:
        gains: list[tuple[float, Trial]] = []
        for steps in by_size.values():
            for coarser, finer in itertools.pairwise(steps):
                gain = coarser.losses[0] - finer.losses[0]
                if coarser.precision == chosen[coarser.group] and gain > 0:
                    gains.append((gain, finer))
        for _, finer in sorted(gains, key=lambda pair: -pair[0]):
            tried = chosen | {finer.group: finer.precision}
            if size_of(tried) <= max_bytes:
                chosen = tried
                break
        else:
            return finest_choices().keeping(chosen)


def _by_size(trials: Sequence[Trial]) -> dict[str, list[Trial]]:
    """Return the trials of each group from small to large: coders decide, and a finer step may take fewer bytes."""
    by_group: dict[str, list[Trial]] = {}
    for trial in trials:
        by_group.setdefault(trial.group, []).append(trial)
    return {group: sorted(alike, key=lambda trial: trial.num_bytes) for group, alike in by_group.items()}


def _descent(by_group: Mapping[str, Sequence[Trial]], max_loss: float) -> list[dict[str, Precision]]:
    """Return the precisions after each step down, given the groups' trials from small to large."""
    at = {group: trials[-1] for group, trials in by_group.items()}
    path: list[dict[str, Precision]] = []

    def lost_by(trial: Trial) -> float:
        # Negative losses are noise, and must not pay for others.
        return max(trial.losses[0], 0.0)

    # Greedy, as for a knapsack: bytes saved per loss. A step may skip precisions that save little.
    while True:
        predicted = sum(map(lost_by, at.values()))
        most_saved = 0.0
        for group, trials in by_group.items():
            for trial in trials:
                lost = lost_by(trial) - lost_by(at[group])
                saved = (at[group].num_bytes - trial.num_bytes) / max(lost, LEAST_LOSS)
                if saved > most_saved and predicted + lost <= max_loss:
                    most_saved = saved
                    best = trial
        if not most_saved:
            return path
        at[best.group] = best
        path.append({group: trial.precision for group, trial in at.items()})
