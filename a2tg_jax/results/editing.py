"""Edits without the viewer: crop, floaters, subject, vertical and background from options, as the viewer saves them."""

import re
import time
from pathlib import Path

import numpy as np
from PIL import ImageColor

from a2tg_jax import Model, Origin
from a2tg_jax.base.text import did_you_mean
from a2tg_jax.core.origin import Color
from a2tg_jax.io.edit_file import Edit, apply_with_subject, crop_box, save_edit
from a2tg_jax.io.subject import find_subject
from a2tg_jax.results.conversion import check_conversion, write_converted
from a2tg_jax.results.model_source import open_source
from a2tg_jax.results.options import EditOptions, PlacementOptions
from a2tg_jax.results.output_paths import check_new, check_output

AXES = dict(zip("xyz", np.eye(3), strict=True))
AXES |= {f"-{name}": -axis for name, axis in AXES.items()}
"""Directions by their names on the command line."""


def edit_of(options: EditOptions, model: Model) -> Edit:
    """Return the edit of a model. Raises ValueError, naming the option, if one is invalid or none is given."""
    if options == EditOptions():
        raise ValueError("nothing to change: give `crop`, `floaters`, `subject`, `upright` or `background`")
    if not 0 <= options.floaters <= 100:
        raise ValueError(f"`floaters` must be a percentage from 0 to 100; got {options.floaters:g}")
    up = None if options.upright is None else _vertical(options.upright, model)
    crop = None
    if options.crop is not None:
        low, high = np.array([_shares(text) for text in options.crop]).T
        # Like the sliders, upright by the vertical that the edit leads to.
        vertical = _origin_of(model).vertical if up is None else up
        crop = crop_box(model, vertical, low, high)
    background = None if options.background is None else _color(options.background)
    return Edit(crop, options.floaters / 100, up, background, options.subject)


def write_edit(
    source: Path, out: Path, options: EditOptions, name: str | None = None, *, overwrite: bool = False
) -> str:
    """Write an edit as *.json, or a source's edited model in any format that `convert` writes, and return a summary.
    Arguments and errors otherwise as in `convert`."""
    start = time.perf_counter()
    is_edit = out.suffix.lower() == ".json"
    if is_edit:
        check_output(out)
        check_new(out, "`out`", overwrite=overwrite)
    else:
        check_conversion(source, out, PlacementOptions(), overwrite=overwrite, option="`out`")
    opened = open_source(source, name)
    edit = edit_of(options, opened.model)
    subject = find_subject(opened.model) if edit.subject else None
    edited = apply_with_subject(opened.model, edit, subject)
    note = "" if subject is None else f"\nsubject: {subject.words}"
    if not is_edit:
        return write_converted(opened.path, edited, out, start, PlacementOptions()) + note
    save_edit(out, edit)
    kept = f"{edited.num:,} of {opened.model.num:,} Gaussians"
    return f"{out}: an edit that keeps {kept}; --edit {out} applies it{note}"


def _shares(text: str) -> tuple[float, float]:
    """Return the ends of a range such as 35:65 as shares."""
    low = 1.0
    high = 0.0
    match = re.fullmatch(r"(\d+(?:\.\d+)?):(\d+(?:\.\d+)?)", text)
    if match:
        low = float(match[1])
        high = float(match[2])
    if not 0 <= low < high <= 100:
        raise ValueError(
            "`crop` must be LOW:HIGH for width, depth and height, percentages from 0 to 100, LOW below HIGH; got "
            f"{text!r}"
        )
    return low / 100, high / 100


def _origin_of(model: Model) -> Origin:
    return model.origin or Origin.of_cameras([])


def _vertical(text: str, model: Model) -> np.ndarray:
    """Return the vertical [3] in a model's world that an axis of the original world or a photograph names."""
    origin = _origin_of(model)
    if text in AXES:
        return origin.transform.rotation @ AXES[text]
    if text in origin.names:
        return _level_vertical(origin.viewmats[origin.names.index(text)], origin.vertical)
    hint = did_you_mean(text, origin.names)
    if not hint and origin.names:
        hint = f"; the first is {origin.names[0]}"
    raise ValueError(f"`upright` must be x, -x, y, -y, z, -z or a photograph of the model; got {text!r}{hint}")


def _color(text: str) -> Color:
    try:
        red, green, blue = ImageColor.getrgb(text)[:3]
    except ValueError:
        raise ValueError(f"`background` must be a colour such as white or #ff8000; got {text!r}") from None
    return red / 255, green / 255, blue / 255


def _level_vertical(viewmat: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the vertical [3] against which a camera is level, at the pitch that it has against the vertical `up`
    [3]; as in web/src/vertical.ts."""
    _, down, forward = viewmat[:3, :3]
    pitch = np.clip(forward @ up, -0.99, 0.99)
    return np.asarray(pitch * forward - np.sqrt(1 - pitch**2) * down)
