"""Edits as JSON: what the viewer hides, turns and colours, applied to a model for all other files."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from a2tg_jax import Model, Origin, Similarity
from a2tg_jax.base.atomic import write_whole
from a2tg_jax.base.json_text import number_array, number_rows
from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.base.text import shortened
from a2tg_jax.core.origin import Color
from a2tg_jax.core.similarity import check_similarity
from a2tg_jax.io.columns import AxisSteps
from a2tg_jax.io.floaters import floater_scores
from a2tg_jax.io.saved_file import VERSION, load_saved
from a2tg_jax.io.subject import Subject, find_subject

# As in web/src/extent.ts.
PERCENTILES_PER_SPREAD = 1.2
"""Half the range from the 5th to the 95th percentile over the spread, for evenly spread positions."""
REACH = 2.5
"""Half the length of the largest crop box over half the scene's extent."""


@dataclasses.dataclass(frozen=True, eq=False)
class Box(NamedFields):
    """Box of a crop, in the model's world: low ≤ axes · x ≤ high."""

    axes: np.ndarray
    """[3, 3] rotation; its rows are the directions of the sides."""
    low: np.ndarray
    """[3], −inf where nothing is cut."""
    high: np.ndarray
    """[3], inf where nothing is cut."""


@dataclasses.dataclass(frozen=True, eq=False)
class Edit(NamedFields):
    """Changes of a model, in its own world. Those that are None change nothing."""

    crop: Box | None = None
    """Box outside of which Gaussians are removed, by their centres."""
    floaters: float = 0.0
    """Strictness from 0, which keeps all, to 1 with which floaters are removed."""
    up: np.ndarray | None = None
    """[3] unit vertical."""
    background: Color | None = None
    """RGB in [0, 1] behind all splats."""
    subject: bool = False
    """Whether only the subject is kept: what the cameras look at, without its floor and background."""


def load_edit(path: Path) -> Edit:
    """Return the edit of a file that the viewer saved.

    Args:
      path: the file.

    Returns:
      The edit.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if it is invalid, naming the file.
    """
    return load_saved(path, "edit", _edit_of)


def save_edit(path: Path, edit: Edit) -> None:
    """Write an edit as the viewer does, for `load_edit`."""
    changes: dict[str, Any] = {}
    if edit.crop is not None:
        changes["crop"] = {"axes": edit.crop.axes.tolist()}
        for name, ends in (("low", edit.crop.low), ("high", edit.crop.high)):
            # JSON has no infinity.
            changes["crop"][name] = [end if math.isfinite(end) else None for end in ends.tolist()]
    if edit.floaters:
        changes["floaters"] = edit.floaters
    if edit.subject:
        changes["subject"] = True
    if edit.up is not None:
        changes["up"] = edit.up.tolist()
    if edit.background is not None:
        changes["background"] = list(edit.background)
    write_whole(path, json.dumps({"format": "a2tg-jax edit", "version": VERSION, **changes}, indent=1) + "\n")


def crop_box(model: Model, up: np.ndarray, low: np.ndarray, high: np.ndarray) -> Box:
    """Return the upright box of the viewer's crop sliders (web/src/extent.ts).

    Args:
      model: the model to crop.
      up: [3] unit vertical.
      low, high: [3] shares, 0 to 1, of the largest box along width, depth and height; 0 and 1 cut nothing.
    """
    steps = [AxisSteps.of(axis, 16) for axis in np.asarray(model.live.gaussians.means).T]
    centre = np.array([step.centre for step in steps])
    half = np.maximum(PERCENTILES_PER_SPREAD * np.array([step.spread for step in steps]), 1e-6)
    near = np.eye(3)[0 if abs(up[0]) < 0.9 else 1]
    across = near - (near @ up) * up
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(up, across), up])
    middle = axes @ centre
    reach = REACH * np.linalg.norm(axes * half, axis=1)
    begin, end = (middle + (2 * share - 1) * reach for share in (low, high))
    return Box(axes, np.where(low > 0, begin, -math.inf), np.where(high < 1, end, math.inf))


def _edit_of(data: dict[str, Any]) -> Edit:
    unknown = sorted(set(data) - {"format", "version", "crop", "floaters", "subject", "up", "background"})
    if unknown:
        raise ValueError(f"has the unknown entry {shortened(unknown[0])}")
    floaters = data.get("floaters", 0.0)
    if type(floaters) not in (int, float) or not 0 <= floaters <= 1:
        raise ValueError(f"floaters must be a number from 0 to 1; got {shortened(repr(floaters))}")
    subject = data.get("subject", False)
    if type(subject) is not bool:
        raise ValueError(f"subject must be true or false; got {shortened(repr(subject))}")
    crop = data.get("crop")
    if crop is not None:
        crop = _box_of(crop)
    up = data.get("up")
    if up is not None:
        up = number_array(up, 3, "up")
        if not np.linalg.norm(up) > 0:
            raise ValueError("up must not be zero")
        up = up / np.linalg.norm(up)
    background = data.get("background")
    if background is not None:
        red, green, blue = number_array(background, 3, "background").tolist()
        background = (red, green, blue)
        if min(background) < 0 or max(background) > 1:
            raise ValueError(f"background must be numbers from 0 to 1; got {background}")
    return Edit(crop, float(floaters), up, background, subject)


def _box_of(crop: object) -> Box:
    if not isinstance(crop, dict):
        raise ValueError(f"crop must be an object; got {shortened(crop)}")
    axes = number_rows(crop.get("axes", np.eye(3)), 3, "crop.axes")
    check_similarity(Similarity(1.0, axes, np.zeros(3)), "crop.axes")
    low = number_array(crop.get("low"), 3, "crop.low", null=-math.inf)
    high = number_array(crop.get("high"), 3, "crop.high", null=math.inf)
    return Box(axes, low, high)


def scores_of(model: Model) -> np.ndarray:
    """Return `floater_scores` of the Gaussians that exist."""
    gaussians = model.live.gaussians
    origin = model.origin or Origin.of_cameras([])
    numbers = (np.asarray(gaussians.means), np.asarray(gaussians.log_scales))
    return floater_scores(*numbers, origin.viewmats, origin.Ks, origin.sizes)


def apply_edit(model: Model, edit: Edit) -> Model:
    """Return an edited model: without the Gaussians outside the box, the floaters and what is around the subject, with
    another vertical and background (host).

    The vertical changes no number of the model. Files of other programs, meshes, orbits and the viewer are upright by
    it.

    Args:
      model: a model of any appearance.
      edit: the changes.

    Returns:
      The changed model.

    Raises:
      ValueError: if no Gaussian would be left, or the model has no subject.
    """
    return apply_with_subject(model, edit, find_subject(model) if edit.subject else None)


def apply_with_subject(model: Model, edit: Edit, subject: Subject | None) -> Model:
    """Return an edited model as `apply_edit`, given its subject; None: the edit keeps more than that."""
    model = model.live
    is_kept = kept_by(model, edit, subject)
    model = model if is_kept.all() else model[is_kept]
    if edit.up is not None:
        origin = model.origin or Origin.of_cameras([])
        model = dataclasses.replace(model, origin=dataclasses.replace(origin, up=edit.up))
    return model if edit.background is None else dataclasses.replace(model, background=edit.background)


def kept_by(model: Model, edit: Edit, subject: Subject | None) -> np.ndarray:
    """Return [N] bool, True for the live Gaussians that an edit keeps, given the subject; None: it keeps more than
    that. Raises ValueError if no Gaussian would be left."""
    is_kept = np.ones(model.num, bool)
    if edit.floaters > 0:
        is_kept &= scores_of(model) <= largest_score(edit.floaters)
    if subject is not None:
        is_kept &= subject.is_kept
    if edit.crop is not None:
        places = np.asarray(model.live.gaussians.means, np.float64) @ edit.crop.axes.T
        is_kept &= ((places >= edit.crop.low) & (places <= edit.crop.high)).all(axis=1)
    if model.num and not is_kept.any():
        raise ValueError(f"the edit would remove all {model.num:,} Gaussians: widen its crop, or lower its floaters")
    return is_kept


def largest_score(strictness: float) -> int:
    """Return the largest score of a floater that is kept, the same whole number as in web/src/extent.ts."""
    return math.floor(255 * (1 - strictness) + 0.5)
