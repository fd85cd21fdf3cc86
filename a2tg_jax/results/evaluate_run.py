"""Everything that is made from a run's finished models: metrics, pictures, figures, point cloud, report."""

import dataclasses
import os
from collections.abc import Mapping

from a2tg_jax.config import TrainConfig
from a2tg_jax.data import Scene, View, view_image
from a2tg_jax.evaluation import evaluate
from a2tg_jax.io.model import load_model
from a2tg_jax.io.ply import save_ply
from a2tg_jax.model import Model
from a2tg_jax.origin import BLACK, Color
from a2tg_jax.renderer import Renderer
from a2tg_jax.results.figures import curves_figure, resolutions_figure, save_figure, sizes_figure
from a2tg_jax.results.folder import PHASES, Phase, RunFolder, write_json
from a2tg_jax.results.history import read_history
from a2tg_jax.results.pictures import (
    ERROR_GAIN,
    colored_by_resolution,
    error_picture,
    largest_gain,
    picture_name,
    save_picture,
    side_by_side,
    texel_levels,
    to_uint8,
)
from a2tg_jax.results.record import RunRecord, read_record
from a2tg_jax.results.report import Comparison, write_report
from a2tg_jax.results.summary import PhaseResult, RunResult, metrics_json, per_view_json
from a2tg_jax.texture import AtlasLayout
from a2tg_jax.training import render_settings

WHITE: Color = (1.0, 1.0, 1.0)
REPORTED_VIEWS = 4


def evaluate_run(
    run: RunFolder, scene: Scene | None = None, *, lpips_weights: str | os.PathLike | None = None
) -> RunResult:
    """Measures the finished phases of a run and writes what stands in its folder beside models and checkpoints.

    Args:
      run: an opened run folder with one finished phase at least.
      scene: its scene, if it is loaded already.
      lpips_weights: a weights file for LPIPS; None leaves it out.

    Raises:
      FileNotFoundError: if no phase is finished, or the scene or the weights are not where they were.
    """
    record = read_record(run)
    models = {phase: load_model(run.model(phase)) for phase in PHASES if run.model(phase).is_file()}
    if not models:
        raise FileNotFoundError(f"{run.path} has no finished stage yet; go on with a2tg train … --resume")
    scene = scene or record.source.load()
    phases = {
        phase: _measure(model, scene, record.phase_config(phase), _seconds(run, phase), lpips_weights)
        for phase, model in models.items()
    }
    result = RunResult(scene.name, record, phases)
    write_json(run.own(run.metrics), metrics_json(result))
    write_json(run.own(run.per_view), per_view_json(result))
    _write_figures(run, record, models, scene)
    last = models.get("stage2") or models["stage1"]
    save_ply(run.own(run.point_cloud), last.gaussians, transform=scene.transform)
    views = scene.test or scene.train
    for index in range(len(views)):
        _write_sheet(run, _compare(views, index, result))
    reported = range(0, len(views), -(-len(views) // REPORTED_VIEWS))
    write_report(run, result, [_compare(views, index, result) for index in reported])
    return result


def background_of(config: TrainConfig) -> Color:
    """The background that test views are rendered on: the training's, or black where that was random."""
    return WHITE if config.background == "white" else BLACK


def _seconds(run: RunFolder, phase: Phase) -> float:
    """Training time of a phase."""
    return float(read_history(run.history(phase)).seconds[-1])


def _measure(model: Model, scene: Scene, config: TrainConfig, seconds: float, lpips_weights) -> PhaseResult:
    found = evaluate(
        (*scene.test, *scene.train),
        model,
        settings=render_settings(config),
        background=background_of(config),
        lpips_weights=lpips_weights,
        num_renders=len(scene.test or scene.train),
    )
    return PhaseResult(
        train=found[len(scene.test) :],
        test=found[: len(scene.test)] if scene.test else None,
        num_gaussians=model.num,
        num_texels=model.layout.num_texels if isinstance(model.layout, AtlasLayout) else 0,
        megabytes=model.num_bytes / 1e6,
        padding_megabytes=model.num_padding_bytes / 1e6,
        seconds=seconds,
    )


def _write_figures(run: RunFolder, record: RunRecord, models: Mapping[Phase, Model], scene: Scene) -> None:
    histories = {phase: read_history(run.history(phase)) for phase in models}
    save_figure(run.own(run.figures / "curves.png"), curves_figure(histories))
    textured = models.get("stage2")
    if textured is None or not isinstance(textured.layout, AtlasLayout):
        return
    save_figure(run.own(run.figures / "sizes.png"), sizes_figure(textured.layout.sizes))
    cameras = [view.camera for view in (*scene.test, *scene.train)]
    gaussians, textures, _ = colored_by_resolution(textured.gaussians, textured.params, textured.layout)
    colored = dataclasses.replace(textured, gaussians=gaussians, params=textures)
    background = background_of(record.config)
    renderer = Renderer(colored, settings=render_settings(record.config), background=background, has_geometry=False)
    picture = to_uint8(renderer(cameras[0]).color)
    num_levels = int(texel_levels(textured.layout).max()) + 1
    save_figure(run.own(run.figures / "resolutions.png"), resolutions_figure(picture, num_levels))


def _compare(views: tuple[View, ...], index: int, result: RunResult) -> Comparison:
    """One view: the photograph, what stage 2 is to be compared with, stage 2."""
    before: Phase = "baseline" if "baseline" in result.phases else "stage1"
    shown = [phase for phase in (before, "stage2") if phase in result.phases]
    truth = to_uint8(view_image(views[index], background_of(result.record.config)))
    renders = [result.phases[phase].shown.renders[index] for phase in shown]
    captions = ["photograph", *(result.record.label(phase) for phase in shown)]
    crop = largest_gain(truth, *renders) if len(renders) == 2 else None
    return Comparison(views[index].name, [truth, *renders], captions, crop)


def _write_sheet(run: RunFolder, comparison: Comparison) -> None:
    """test/NAME.png: photograph, renders, error of the last render."""
    error = error_picture(comparison.images[-1], comparison.images[0])
    sheet = side_by_side([*comparison.images, error], [*comparison.captions, f"error, {ERROR_GAIN} times"])
    save_picture(run.own(run.test / picture_name(comparison.name)), sheet)
