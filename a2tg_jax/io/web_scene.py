"""Compact scenes for browsers: decoded by the browser itself, most visible rows first, so that a page draws early.

A page embeds such a file, or reads it while it arrives. This costs bytes: the coder is deflate, numbers have 8 bits and
means 16, and chunks are sorted by visibility. Textures are stored as displayed, not for further training.
"""

import dataclasses

import numpy as np

from a2tg_jax import Model
from a2tg_jax.base.even_spacing import evenly_chosen
from a2tg_jax.data.camera_paths import front_view
from a2tg_jax.data.capture_geometry import camera_centers
from a2tg_jax.io.columns import Choice, opacities_of
from a2tg_jax.io.compact import CompactChoices, encode_model
from a2tg_jax.io.edit_file import scores_of
from a2tg_jax.io.model_rows import check_encodable
from a2tg_jax.io.subject import find_subject
from a2tg_jax.model import checked_live

CHOICES = CompactChoices(
    means=16, log_scales=8, quats=8, opacities=8, sh_0=8, sh_rest=6, texels=8, shapes=8, coder="deflate"
)
MOST_ROWS = 1 << 24
"""Largest number of rows, and of texels, that the viewer takes."""
SCALE_RANGE = 16.0
"""Largest −log of a scale relative to the largest one; smaller scales, below a pixel in any full view, are raised."""
NEAREST = 1e-3
"""Distance from a camera, in units of the median, below which a row does not count for more."""
MOST_CAMERAS = 16
"""Largest number of cameras for ranking rows by visibility."""


def encode_web_scene(
    model: Model,
    *,
    title: str = "",
    note: str = "",
    near_plane: float = 0.2,
    coder: Choice = "deflate",
    finds_subject: bool = True,
) -> bytes:
    """Return the bytes of a compact file that the viewer shows.

    Args:
      model: Gaussians with or without textures, exponents and bands.
      title: title of the page.
      note: text about the scene in the viewer.
      near_plane: distance below which hits are ignored.
      coder: deflate, or none for a scene that is viewed once.
      finds_subject: whether the viewer can show the subject alone; takes about a second for 30,000 Gaussians.

    Raises:
      ValueError: if the model has another appearance, too many rows, or a number that is not finite.
    """
    instead = "save_model keeps any model, and a2tg convert --bake makes plain splats of it"
    check_encodable(model.appearance, "a file for browsers", instead)
    model = checked_live(model)
    # Of the model as `apply_edit` has it.
    marks = {"floaters": scores_of(model)}
    page: dict[str, object] = {"title": title, "note": note, "near_plane": near_plane}
    if finds_subject:
        try:
            subject = find_subject(model)
            marks["subject"] = subject.is_kept.astype(np.uint8)
            page["subject"] = subject.words
        except ValueError as error:
            page["subject"] = str(error)
    texture = model.appearance.texture
    if texture is not None and model.num:
        # Baked into the texels, so that shaders need only one rule for textures.
        seen = dataclasses.replace(texture.options, rgb="signed", alpha="projected")
        texture = dataclasses.replace(texture, texels=texture.shown(), options=seen)
        model = dataclasses.replace(model, appearance=dataclasses.replace(model.appearance, texture=texture))
    num_texels = 0 if model.textures is None else int(np.prod(model.textures.sizes, axis=1).sum())
    if max(model.num, num_texels) > MOST_ROWS:
        raise ValueError(f"model has more Gaussians or texels than the {MOST_ROWS:,} that a web scene may hold")
    # A single tiny splat must not widen the range that all scales share.
    log_scales = np.asarray(model.gaussians.log_scales)
    raised = np.maximum(log_scales, log_scales.max(initial=-np.inf) - SCALE_RANGE)
    model = dataclasses.replace(model, gaussians=dataclasses.replace(model.gaussians, log_scales=raised))
    if model.origin is not None and len(model.origin.names):
        # The viewer opens at the subject's front.
        page["first"] = front_view(model.origin)
    # Stable, so that the same model gives the same file.
    order = np.argsort(-importance(model), kind="stable")
    return encode_model(model, dataclasses.replace(CHOICES, coder=coder), order=order, page=page, marks=marks)


def importance(model: Model) -> np.ndarray:
    """Return [N] opacity times the mean area in the cameras' views; without cameras, times the area itself."""
    gaussians = model.gaussians
    origin = model.origin
    # log s_u + log s_v.
    log_areas = np.asarray(gaussians.log_scales, np.float64).sum(axis=1)
    areas: np.ndarray = opacities_of(np.asarray(gaussians.logit_opacities)) * np.exp(log_areas)
    if origin is None or not len(origin.viewmats):
        return areas
    centers = camera_centers(evenly_chosen(origin.viewmats, MOST_CAMERAS))
    means = np.asarray(gaussians.means)
    squares = np.stack([np.sum((means - center) ** 2, axis=1) for center in centers])
    least = NEAREST * np.median(squares) if squares.size else 1.0
    return areas * np.mean(1 / np.maximum(squares, max(least, 1e-30)), axis=0)
