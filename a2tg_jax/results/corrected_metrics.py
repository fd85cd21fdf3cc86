"""Metrics of runs that learn exposures or poses, beside those of the photographs as given.

A photograph's exposure and the exact pose of its camera are not the model's to know. Runs that learn those of the
training views are therefore scored twice: as they are, and up to them. `color_fit`: each render's colours are mapped to
the photograph's by the affine map of least squares. `aligned`: test cameras are moved to where the model looks most
like the photograph (`measure.alignment.align_poses`), training cameras to where training moved them.
"""

import dataclasses
import functools
import os

import jax.numpy as jnp
import numpy as np

from a2tg_jax.data import Scene, View
from a2tg_jax.measure.alignment import align_poses
from a2tg_jax.measure.evaluation import Evaluation, evaluate
from a2tg_jax.model import Model
from a2tg_jax.rasterize.render_types import RenderSettings
from a2tg_jax.results.folder import RunFolder, write_json
from a2tg_jax.results.plan import RunPlan
from a2tg_jax.training.corrections import learned

TITLES = {
    "color_fit": "colours fitted",
    "aligned": "poses aligned",
    "aligned_color_fit": "poses aligned, colours fitted",
}
"""Titles by the suffix of a split in `metrics.json`: test_color_fit, …"""


def measure_corrected(
    model: Model,
    scene: Scene,
    plan: RunPlan,
    settings: RenderSettings,
    lpips_weights: str | os.PathLike[str] | None,
    held_out: str = "test",
) -> dict[str, Evaluation]:
    """Return the further figures of a model, by split and way, if any system of its run learns exposures or poses.

    All models of a run are scored alike, those of systems that learn neither included.
    """
    has_exposure = any(planned.system.exposure for planned in plan.stages)
    has_poses = any(planned.system.refine_poses for planned in plan.stages)
    measure = functools.partial(evaluate, settings=settings, lpips_weights=lpips_weights)
    found: dict[str, Evaluation] = {}
    for split, views in ((held_out, scene.test), ("train", scene.train)):
        if not views:
            continue
        if has_exposure:
            found[f"{split}_color_fit"] = measure(views, model, fit_colors=True)
        if has_poses:
            moved = refined_views(views, model) if split == "train" else align_poses(views, model, settings=settings)
            found[f"{split}_aligned"] = measure(moved, model)
            if has_exposure:
                found[f"{split}_aligned_color_fit"] = measure(moved, model, fit_colors=True)
    return found


def refined_views(views: tuple[View, ...], model: Model) -> tuple[View, ...]:
    """Return training views with the cameras learned in training."""
    origin = model.origin
    if origin is None:
        return views
    viewmats = dict(zip(origin.names, origin.viewmats, strict=True))

    def moved(view: View) -> View:
        viewmat = jnp.asarray(np.asarray(viewmats[view.name], np.float32))
        return dataclasses.replace(view, camera=dataclasses.replace(view.camera, viewmat=viewmat))

    return tuple(moved(view) if view.name in viewmats else view for view in views)


def write_corrections(run: RunFolder, name: str, model: Model) -> None:
    """Write corrections/NAME.json if corrections were learned: view → exposure [3, 4] = [A | b], pose [6]."""
    if model.origin is not None and model.origin.corrections:
        write_json(run.own(run.corrections(name)), learned(model.origin))


def corrected_title(key: str) -> str:
    """Return the table title of a key of corrected metrics in `metrics.json`."""
    split, _, way = key.partition("_")
    return f"{split}, {TITLES[way]}"
