"""Evaluation of a run's finished models: metrics, pictures, figures, point cloud, report.

A photograph's exposure and exact camera pose cannot be learned from other photographs. Runs that learn them for the
training views are therefore scored twice: directly, and up to exposure and pose. `color_fit`: each render's colours are
mapped to the photograph's by least squares (affine). `aligned`: test cameras move to where the model looks most like
the photograph (`measure.alignment.align_poses`), training cameras to their learned poses.
"""

import dataclasses
import functools
import math
from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from a2tg_jax import (
    Evaluation,
    Model,
    Origin,
    Renderer,
    Scene,
    System,
    View,
    align_poses,
    evaluate,
    load_lpips,
    load_model,
    view_image,
)
from a2tg_jax.base.atomic import write_whole
from a2tg_jax.base.json_text import read_json
from a2tg_jax.base.regular_files import sha256_of
from a2tg_jax.data.assembly import every_kth
from a2tg_jax.data.load import HeldOut, SceneSource
from a2tg_jax.io.ply import save_ply
from a2tg_jax.io.web_scene import encode_web_scene
from a2tg_jax.results.commands import resuming_command
from a2tg_jax.results.figures import write_figures
from a2tg_jax.results.folder import RunFolder, drop_old, write_json
from a2tg_jax.results.history import read_history
from a2tg_jax.results.images import (
    ERROR_GAIN,
    error_picture,
    largest_gain,
    picture_names,
    save_picture,
    side_by_side,
    to_uint8,
)
from a2tg_jax.results.model_source import chosen_stage, readable_checkpoint, settings_of
from a2tg_jax.results.plan import RunPlan
from a2tg_jax.results.record import is_finished, read_record
from a2tg_jax.results.report import Comparison, ModelResult, RunResult, metrics_json, per_view_json, write_report
from a2tg_jax.results.stage_training import check_held_out
from a2tg_jax.web.page import viewer_html_with

REPORTED_VIEWS = 4
MOST_READABLE = 100
"""Largest number of numbers of a correction in corrections.json."""


def evaluate_run(run: RunFolder, scene: Scene | None = None, *, lpips_weights: Path | None = None) -> RunResult:
    """Measure the finished models of a run, or else its newest checkpoint, and write the run folder's metrics, pictures
    and report. A replaced run is deleted once all stages are trained.

    Without `lpips_weights`, a weights file, earlier values of the same models are kept. Raises FileNotFoundError as
    `chosen_stage` and `finished_stages`, or if scene or weights are missing, and ValueError as `check_held_out`.
    """
    record = read_record(run)
    plan = record.plan
    planned, note = chosen_stage(run, plan)
    finished = finished_stages(run, plan)
    scene = scene or record.scene.load()
    files = {name: run.model(name) for name in finished}
    models = {name: load_model(files[name]) for name in finished}
    histories = {}
    if not finished:
        files[planned.name], checkpoint = readable_checkpoint(run, planned)
        models[planned.name] = checkpoint.model_in(scene)
        histories[planned.name] = checkpoint.history
    # Before minutes of measuring.
    for name, model in models.items():
        check_held_out(model, scene, files[name])
    histories |= {name: read_history(run.history(name)) for name in finished}
    results = {}
    for name, model in models.items():
        results[name] = ModelResult(
            splits=_evaluations(model, scene, plan, plan[name].system, lpips_weights, record.scene.held_out),
            num_gaussians=model.num,
            num_texels=0 if model.textures is None else model.textures.num_texels,
            num_bytes=model.num_bytes,
            num_published_bytes=model.num_published_bytes,
            num_padding_bytes=model.num_padding_bytes,
            seconds=histories[name].last_seconds,
            sha256=sha256_of(files[name]),
        )
    if lpips_weights is None:
        results = _with_kept_lpips(run, results)
    result = RunResult(scene.name, record, plan, results, is_lpips_kept=lpips_weights is None, note=note)
    write_json(run.own(run.metrics), metrics_json(result))
    write_json(run.own(run.per_view), per_view_json(result))
    for name, model in models.items():
        if model.origin is not None and model.origin.corrections:  # exposure [3, 4] = [A | b] and pose [6] by view
            write_json(run.own(run.corrections(name)), learned_corrections(model.origin))
    main = models[result.main]
    save_ply(run.own(run.point_cloud), main, world="upright")
    # Browsers cannot show subclasses of Appearance.
    if main.appearance.is_portable:
        data = encode_web_scene(main, title=scene.name)
        write_whole(run.own(run.viewer), viewer_html_with(data))
    camera = (*scene.test, *scene.train)[0].camera
    starts = {name: plan[name].first_iteration for name in models}
    figures = write_figures(run, main, camera, settings_of(plan[result.main].system), histories, starts)
    comparisons = _write_sheets(run, result, models, scene)
    write_report(run, result, comparisons, figures, is_split_by_number=is_split_by_number(record.scene, scene))
    # Until then, the replaced run is the only one with all its models.
    if is_finished(run, record):
        drop_old(run)
    return result


def is_split_by_number(source: SceneSource, scene: Scene) -> bool:
    """Return whether every k-th view is held out for testing, and not views that the scene lists."""
    if source.validation or not scene.test:
        return False
    _, held_out = every_kth([*scene.test, *scene.train], source.test_every)
    return {view.name for view in held_out} == {view.name for view in scene.test}


def check_weights(lpips_weights: Path | None) -> None:
    """Raise ValueError or FileNotFoundError unless these are LPIPS weights, or None."""
    if lpips_weights is not None:
        load_lpips(lpips_weights)


def finished_stages(run: RunFolder, plan: RunPlan) -> list[str]:
    """Return the names of the stages with models. Raises FileNotFoundError if the model from which a later stage was
    trained is missing."""
    names = [name for name in plan.names if run.model(name).is_file()]
    needed = {plan.main[0]} if names else set()
    for name in names:
        start = plan[name].start
        if start is not None:
            needed.add(start.name)
    for name in plan.names:
        if name in needed and name not in names:
            again = f"put it back, or train it again with: {resuming_command(run)}"
            raise FileNotFoundError(f"{run.model(name)} is missing, and a later model of the run is there: {again}")
    return names


def refined_views(views: tuple[View, ...], model: Model) -> tuple[View, ...]:
    """Return training views with the cameras learned in training."""
    if model.origin is None:
        return views
    viewmats = dict(zip(model.origin.names, model.origin.viewmats, strict=True))
    refined = []
    for view in views:
        if view.name in viewmats:
            viewmat = jnp.asarray(np.asarray(viewmats[view.name], np.float32))
            view = dataclasses.replace(view, camera=dataclasses.replace(view.camera, viewmat=viewmat))
        refined.append(view)
    return tuple(refined)


def _evaluations(
    model: Model, scene: Scene, plan: RunPlan, system: System, lpips_weights: Path | None, held_out: HeldOut
) -> dict[str, Evaluation]:
    """Return the metrics of a model by split. All models of a run get metrics up to exposure and pose if any of its
    systems learns them."""
    settings = settings_of(system)
    measure = functools.partial(evaluate, settings=settings, lpips_weights=lpips_weights)
    # Together, so that each image size compiles once.
    both = measure((*scene.test, *scene.train), model)
    splits: dict[str, Evaluation] = {}
    if scene.test:
        splits[held_out] = both[: len(scene.test)]
    splits["train"] = both[len(scene.test) :]
    has_exposure = any(planned.system.exposure for planned in plan.stages)
    has_poses = any(planned.system.refine_poses for planned in plan.stages)
    for split in list(splits):
        views = scene.train if split == "train" else scene.test
        if has_exposure:
            splits[f"{split}_color_fit"] = measure(views, model, fit_colors=True)
        if has_poses:
            aligned = refined_views(views, model) if split == "train" else align_poses(views, model, settings=settings)
            splits[f"{split}_aligned"] = measure(aligned, model)
            if has_exposure:
                splits[f"{split}_aligned_color_fit"] = measure(aligned, model, fit_colors=True)
    return splits


def _with_kept_lpips(run: RunFolder, results: Mapping[str, ModelResult]) -> dict[str, ModelResult]:
    """Return the results with the LPIPS of metrics.json for every model file that is unchanged."""
    kept = dict(results)
    try:
        metrics = read_json(run.metrics)
        per_view = read_json(run.per_view)
        network = metrics["lpips_network"]
        for name, result in results.items():
            # LPIPS belongs to the bytes of a model, not to its name.
            if network and metrics["models"].get(name, {}).get("sha256") == result.sha256:
                splits = {}
                for split, evaluation in result.splits.items():
                    splits[split] = _with_lpips(evaluation, per_view[name][split], network)
                kept[name] = dataclasses.replace(result, splits=splits)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return dict(results)  # Never measured, or unreadable.
    return kept


def _with_lpips(evaluation: Evaluation, values: Mapping[str, Mapping[str, float]], network: str) -> Evaluation:
    """Return an evaluation with the LPIPS of each view from per_view.json."""
    views = [dataclasses.replace(view, lpips=float(values[view.name]["lpips"])) for view in evaluation.per_view]
    return dataclasses.replace(evaluation, per_view=tuple(views), lpips_network=network)


def _write_sheets(run: RunFolder, result: RunResult, models: Mapping[str, Model], scene: Scene) -> list[Comparison]:
    """Write a sheet of photograph, renders and error for each view, and return some for the report. Only one view's
    pictures are in memory at a time."""
    views = scene.test or scene.train
    # The cameras of `evaluate`, so that nothing compiles again.
    cameras = [view.camera for view in (*scene.test, *scene.train)]
    renderers = {}
    for name in (*(result.compared or result.before), result.main):
        settings = settings_of(result.plan[name].system)
        renderers[name] = Renderer(models[name], cameras=cameras, settings=settings, has_geometry=False)
    files = picture_names(view.name for view in views)
    captions = ["photograph", *renderers]
    every = math.ceil(len(views) / REPORTED_VIEWS)
    reported = []
    for index, view in enumerate(views):
        photograph = to_uint8(view_image(view, models[result.main].background))
        renders = [to_uint8(renderer(view.camera).color) for renderer in renderers.values()]
        images = [photograph, *renders]
        error = error_picture(renders[-1], photograph)
        sheet = side_by_side([*images, error], [*captions, f"error, {ERROR_GAIN} times"])
        save_picture(run.own(run.test / files[view.name]), sheet)
        if index % every == 0:
            # Where the main model gains most over the first of the others.
            crop = largest_gain(photograph, renders[0], renders[-1]) if len(renders) > 1 else None
            reported.append(Comparison.of(view.name, images, captions, crop))
    return reported


def learned_corrections(origin: Origin) -> Mapping[str, Mapping[str, list[float]]]:
    """Return the corrections of each training photograph, as lists of numbers: name → correction → row.

    Rows of more than `MOST_READABLE` numbers are left out.
    """
    readable = {name: rows for name, rows in origin.corrections.items() if rows[0].size <= MOST_READABLE}
    by_photograph = {}
    for index, name in enumerate(origin.names):
        if not origin.is_test[index]:
            by_photograph[name] = {correction: rows[index].tolist() for correction, rows in readable.items()}
    return by_photograph
