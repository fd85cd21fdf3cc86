"""Evaluation of a run's finished models: metrics, pictures, figures, point cloud, report."""

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from a2tg_jax.core.origin import Color
from a2tg_jax.data import Scene, View, view_image
from a2tg_jax.host.atomic import replacing
from a2tg_jax.host.regular_files import sha256_of
from a2tg_jax.io.model_file import load_model
from a2tg_jax.io.ply import save_ply
from a2tg_jax.io.web_scene import encode_web_scene, is_viewable
from a2tg_jax.measure.evaluation import Evaluation, evaluate
from a2tg_jax.model import Model
from a2tg_jax.rasterize.render_types import RenderSettings
from a2tg_jax.renderer import Renderer
from a2tg_jax.results.checks import check_held_out
from a2tg_jax.results.corrected_metrics import measure_corrected, write_corrections
from a2tg_jax.results.folder import RunFolder, read_json, resuming_command, write_json
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
from a2tg_jax.results.plan import RunPlan
from a2tg_jax.results.record import HeldOut, read_record
from a2tg_jax.results.report import Comparison, ShownComparison, write_report
from a2tg_jax.results.run_figures import write_figures
from a2tg_jax.results.summary import ModelResult, RunResult, metrics_json, per_view_json
from a2tg_jax.training import System
from a2tg_jax.web.page import viewer_html_with

REPORTED_VIEWS = 4


def evaluate_run(
    run: RunFolder, scene: Scene | None = None, *, lpips_weights: str | os.PathLike[str] | None = None
) -> RunResult:
    """Measure the finished models of a run, and write the run folder's metrics, pictures and report.

    Args:
      run: an opened run folder with one finished stage at least.
      scene: its scene, if it is loaded already.
      lpips_weights: a weights file for LPIPS; None keeps what was measured of the same models earlier, if anything.

    Raises:
      FileNotFoundError: as `finished_stages` does, or if the scene or the weights are missing.
      ValueError: if a model was trained on views that the scene holds out.
    """
    record = read_record(run)
    plan = record.plan
    models = {name: load_model(run.model(name)) for name in finished_stages(run, plan)}
    scene = scene or record.scene.load()
    for name, model in models.items():
        check_held_out(model, scene, run.model(name))
    measured = {
        name: dataclasses.replace(
            _measure(model, scene, plan, plan[name].system, _seconds(run, name), lpips_weights, record.scene.held_out),
            sha256=sha256_of(run.model(name)),
        )
        for name, model in models.items()
    }
    if lpips_weights is None:
        measured = with_kept_lpips(run, measured)
    result = RunResult(scene.name, record, plan, measured, is_lpips_kept=lpips_weights is None)
    write_json(run.own(run.metrics), metrics_json(result))
    write_json(run.own(run.per_view), per_view_json(result))
    for name, model in models.items():
        write_corrections(run, name, model)
    main = models[result.main]
    save_ply(run.own(run.point_cloud), main)
    _write_viewer(run, main, f"{scene.name} · {result.main}")
    histories = {name: read_history(run.history(name)) for name in models}
    starts = {name: plan.first_iteration(name) for name in models}
    camera = (*scene.test, *scene.train)[0].camera
    figures = write_figures(run, main, camera, settings_of(plan[result.main].system), histories, starts)
    write_report(run, result, _write_pictures(run, result, models, scene), figures)
    return result


def finished_stages(run: RunFolder, plan: RunPlan) -> list[str]:
    """Return the names of the stages that have their models.

    Raises:
      FileNotFoundError: if there are none, or a model is missing from which a later stage was trained.
    """
    names = [name for name in plan.names if run.model(name).is_file()]
    if not names:
        raise FileNotFoundError(f"{run.path} has no finished stage yet; continue with: {resuming_command(run)}")
    needed = {plan.main[0], *(plan[name].start for name in names)}
    for name in plan.names:
        if name in needed and name not in names:
            again = f"put it back, or train it again with: {resuming_command(run)}"
            raise FileNotFoundError(f"{run.model(name)} is missing, and a later model of the run is there: {again}")
    return names


def _write_viewer(run: RunFolder, model: Model, title: str) -> None:
    """Write viewer.html, if browsers can show the model."""
    if is_viewable(model.appearance):
        with replacing(run.own(run.viewer)) as temporary:
            temporary.write_text(viewer_html_with(encode_web_scene(model, title=title)), encoding="utf-8")


def settings_of(system: System) -> RenderSettings:
    """Return the render settings of a system's models."""
    return RenderSettings(tile_size=system.tile_size)


def _seconds(run: RunFolder, name: str) -> float:
    """Return the training time of a stage."""
    return read_history(run.history(name)).last_seconds


def _measure(
    model: Model,
    scene: Scene,
    plan: RunPlan,
    system: System,
    seconds: float,
    lpips_weights: str | os.PathLike[str] | None,
    held_out: HeldOut,
) -> ModelResult:
    views = (*scene.test, *scene.train)
    found = evaluate(views, model, settings=settings_of(system), lpips_weights=lpips_weights)
    return ModelResult(
        train=found[len(scene.test) :],
        test=found[: len(scene.test)] if scene.test else None,
        num_gaussians=model.num,
        num_texels=0 if model.textures is None else model.textures.num_texels,
        num_bytes=model.num_bytes,
        num_published_bytes=model.num_published_bytes,
        num_padding_bytes=model.num_padding_bytes,
        seconds=seconds,
        corrected=measure_corrected(model, scene, plan, settings_of(system), lpips_weights, held_out),
        held_out=held_out,
    )


def _write_pictures(
    run: RunFolder, result: RunResult, models: Mapping[str, Model], scene: Scene
) -> list[ShownComparison]:
    """Write a sheet of each view, and return some for the report. Memory holds the pictures of one view at a time."""
    views, names = scene.test or scene.train, [*(result.compared or result.before), result.main]
    renderers = {name: _renderer(models[name], scene, result.plan[name].system) for name in names}
    files = picture_names(view.name for view in views)
    reported = []
    for index, view in enumerate(views):
        comparison = _compare(view, renderers, models[result.main].background)
        _write_sheet(run.test / files[view.name], run, comparison)
        if index % -(-len(views) // REPORTED_VIEWS) == 0:
            reported.append(ShownComparison.of(comparison))
    return reported


def _renderer(model: Model, scene: Scene, system: System) -> Renderer:
    """Return the renderer that `evaluate` uses, so that nothing is compiled anew."""
    cameras = [view.camera for view in (*scene.test, *scene.train)]
    return Renderer(model, cameras=cameras, settings=settings_of(system), has_geometry=False)


def _compare(view: View, renderers: Mapping[str, Renderer], background: Color) -> Comparison:
    """Return one view as photographed, as rendered by the models to compare with, and by the main model."""
    truth = to_uint8(view_image(view, background))
    renders = [to_uint8(renderer(view.camera).color) for renderer in renderers.values()]
    crop = largest_gain(truth, renders[0], renders[-1]) if len(renders) > 1 else None
    return Comparison(view.name, [truth, *renders], ["photograph", *renderers], crop)


def _write_sheet(path: Path, run: RunFolder, comparison: Comparison) -> None:
    """Write the photograph, the renders and the error of the last render side by side."""
    error = error_picture(comparison.images[-1], comparison.images[0])
    sheet = side_by_side([*comparison.images, error], [*comparison.captions, f"error, {ERROR_GAIN} times"])
    save_picture(run.own(path), sheet)


def with_kept_lpips(run: RunFolder, measured: Mapping[str, ModelResult]) -> dict[str, ModelResult]:
    """Return the metrics with the LPIPS of metrics.json for every model file that has not changed since."""
    try:
        metrics, per_view = read_json(run.metrics), read_json(run.per_view)
        network, models = metrics["lpips_network"], metrics["models"]
        unchanged = {name for name, found in measured.items() if models.get(name, {}).get("sha256") == found.sha256}
        return {
            name: _with_lpips(found, per_view[name], network) if network and name in unchanged else found
            for name, found in measured.items()
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return dict(measured)  # none was measured, or it cannot be read


def _with_lpips(found: ModelResult, kept: Mapping[str, Any], network: str) -> ModelResult:
    test = None if found.test is None else _merged(found.test, kept[found.held_out], network)
    corrected = {key: _merged(evaluation, kept[key], network) for key, evaluation in found.corrected.items()}
    train = _merged(found.train, kept["train"], network)
    return dataclasses.replace(found, train=train, test=test, corrected=corrected)


def _merged(found: Evaluation, kept: Mapping[str, Any], network: str) -> Evaluation:
    per_view = tuple(dataclasses.replace(view, lpips=float(kept[view.name]["lpips"])) for view in found.per_view)
    return dataclasses.replace(found, per_view=per_view, lpips_network=network)
