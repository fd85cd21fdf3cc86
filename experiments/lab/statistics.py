"""Statistics of PROTOCOL.md: differences of two methods by scene, with intervals, p-values and Holm's correction.

A pair is one seed and one fold of a scene in which both methods were run. The value of a scene is the mean over its
pairs of the mean over views.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from lab.jobs import Record
from lab.tables import CONFIDENCE, QUALITY, Result, SceneMean, grouped, over_scenes

NUM_DRAWS = 10_000
LEVEL = 1 - CONFIDENCE
"""Level of p-values."""
Differences = Mapping[str, Sequence[np.ndarray]]
"""Differences of the views of every pair [V], by scene."""


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Mean difference of two methods over scenes; what too few scenes leave open is NaN."""

    by_scene: Mapping[str, float]
    over_scenes: SceneMean
    """Mean over scenes, with its t interval."""
    p_value: float
    """p-value of the exact sign-flip test over scenes."""

    @property
    def is_decided(self) -> bool:
        """Whether the t interval excludes 0, and the p-value is below the level."""
        return abs(self.over_scenes.mean) > self.over_scenes.half_width and self.p_value < LEVEL

    @property
    def num_won(self) -> int:
        """Number of scenes in which the first method has the higher figure."""
        return sum(value > 0 for value in self.by_scene.values())


def differences(results: Sequence[Result], label: str, other: str, figure: str) -> dict[str, list[np.ndarray]]:
    """Return a figure of one method − that of another for every view of every pair, by scene.

    Records from before the protocol have no views: their mean counts as one.

    Raises:
      ValueError: if the methods of a pair were scored on different views.
    """
    place = QUALITY.index(figure)  # Records have the figures of a view in this order.
    found: dict[str, list[np.ndarray]] = {}
    for cell, block in grouped(results, lambda result: result.run.cell):
        views = {result.label: _by_view(result.record) for result in block if result.label in (label, other)}
        if len(views) < 2:
            continue
        own = views[label]
        base = views[other]
        if own.keys() != base.keys():
            raise ValueError(f"{label} and {other} were scored on different views of {cell.scene.label}")
        pair = [np.array([figures[name][place] for name in own], float) for figures in (own, base)]  # None is NaN.
        found.setdefault(cell.scene.label, []).append(pair[0] - pair[1])
    return found


def _by_view(record: Record) -> Mapping[str, Sequence[float]]:
    """Return the figures of a run by view."""
    found: Mapping[str, Sequence[float]] = record.get("per_view") or {"mean": [record[figure] for figure in QUALITY]}
    return found


def compare(found: Differences) -> Comparison:
    """Return the mean over scenes of some differences."""
    by_scene = {scene: float(np.mean([pair.mean() for pair in pairs])) for scene, pairs in found.items()}
    values = np.array(list(by_scene.values()))
    return Comparison(by_scene, over_scenes(values), sign_flip(values) if len(values) > 1 else float("nan"))


def sign_flip(values: np.ndarray) -> float:
    """Return the two-sided p-value of a mean of 0 if each value's sign were a coin's, over all 2^n signs."""
    sums = np.zeros(1)
    for value in values:
        sums = np.concatenate([sums + value, sums - value])
    return float(np.mean(np.abs(sums) >= abs(values.sum()) * (1 - 1e-12)))


def bootstrap(found: Differences) -> tuple[float, float]:
    """Return the percentile interval of the mean over scenes if scenes, pairs of each scene and views of each pair are
    drawn with replacement; NaN of less than two scenes."""
    if len(found) < 2:
        return float("nan"), float("nan")
    rng = np.random.default_rng(0)
    # Each scene's mean is drawn as often as all scenes together need it: draws of one scene are independent.
    draws = np.array([_scene_means(pairs, NUM_DRAWS * len(found), rng) for pairs in found.values()])
    draws = draws.reshape(len(found), NUM_DRAWS, len(found))
    chosen = rng.integers(len(found), size=(NUM_DRAWS, len(found)))
    means = draws[chosen, np.arange(NUM_DRAWS)[:, None], np.arange(len(found))].mean(axis=1)
    low, high = np.quantile(means, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(low), float(high)


def _scene_means(pairs: Sequence[np.ndarray], num: int, rng: np.random.Generator) -> np.ndarray:
    """Return means [num] of a scene whose pairs, and the views of each, are drawn with replacement."""
    drawn = np.array([pair[rng.integers(len(pair), size=(len(pairs), num, len(pair)))].mean(axis=2) for pair in pairs])
    chosen = rng.integers(len(pairs), size=(len(pairs), num))
    return drawn[chosen, np.arange(len(pairs))[:, None], np.arange(num)].mean(axis=0)


def holm(p_values: Mapping[str, float]) -> dict[str, float]:
    """Return p-values corrected for their number by Holm's step-down procedure."""
    corrected = {}
    highest = 0.0
    for index, (name, p_value) in enumerate(sorted(p_values.items(), key=lambda item: item[1])):
        highest = max(highest, min(1.0, (len(p_values) - index) * p_value))
        corrected[name] = highest
    return {name: corrected[name] for name in p_values}
