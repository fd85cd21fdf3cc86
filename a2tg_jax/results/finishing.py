"""Finishing of a trained run in a new run folder: textures shrink, and colours move to the least squared error."""

import contextlib
import dataclasses
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from a2tg_jax import Model, Scene, evaluate, load_model, save_model
from a2tg_jax.base.atomic import replacing
from a2tg_jax.base.even_spacing import evenly_chosen
from a2tg_jax.base.json_text import read_json
from a2tg_jax.base.regular_files import is_regular, sha256_of
from a2tg_jax.finish.polishing import polish
from a2tg_jax.finish.shrinking import can_shrink, shrink_textures
from a2tg_jax.host.progress_bars import counting
from a2tg_jax.results.folder import RunFolder, check_free, claimed, write_json
from a2tg_jax.results.model_source import finished_stage, settings_of
from a2tg_jax.results.options import FinishOptions
from a2tg_jax.results.plan import PlannedStage
from a2tg_jax.results.record import RunRecord, write_record
from a2tg_jax.results.report import aligned
from a2tg_jax.results.run_evaluation import evaluate_run, finished_stages, refined_views
from a2tg_jax.training.registry import system_to_dict

MOST_VIEWS = 16
"""Largest number of training views for measuring the loss of shrinking, evenly chosen."""


class Measured(NamedTuple):
    """A model and its PSNR."""

    model: Model
    train: float
    """PSNR of the training views in dB."""
    test: float | None
    """PSNR of the test views in dB; None without test views."""


def finish_run(source: RunFolder, out: Path, options: FinishOptions, *, lpips_weights: Path | None = None) -> str:
    """Finish the last model of a run's main system, evaluate it in a new run folder, and return a table of the steps.

    Choices depend on training views only. If the same finishing was killed in that folder, it resumes: with the
    evaluation if the model was written, otherwise from the beginning.

    Raises:
      FileNotFoundError: if the stage is not finished, or an earlier model or the photographs are missing.
      FileExistsError: if `out` is in use.
      ValueError: if the model has nothing to shrink or polish, or an option is out of range.
    """
    options.check()
    record, planned = finished_stage(source)
    name = planned.name
    run = RunFolder(out)
    # The checksum ties finish.json to this model: a run trained again is another source.
    origin = {"source": str(source.path.resolve()), "model": name, "sha256": sha256_of(source.model(name))}
    content = {**origin, **dataclasses.asdict(options)}
    _is_written(run, content)
    model = load_model(source.model(name))
    scene = record.scene.load()
    shrinks = options.max_loss > 0 and can_shrink(model)
    polishes = options.polish_steps > 0 and model.appearance.is_linear
    if polishes and planned.system.exposure:  # Photographs of changing exposure would pull at the colours.
        raise ValueError("the run learned exposures, which polishing does not support: add `polish_steps` 0")
    if not polishes and not shrinks:
        raise ValueError(f"{name} has nothing that these options can shrink or polish")
    # Raises before any work if a model that the evaluation needs is missing.
    finished_stages(source, record.plan)
    # Each change is made and measured; before them the model is measured, and at the end the run.
    num_steps = 2 + 2 * (shrinks + polishes)
    with claimed(run), counting("finish", num_steps, "step") as counter:
        is_written = _is_written(run, content)  # Another process may have been here meanwhile.
        steps = {"before": _measured(model, scene, planned)}
        counter.update()
        changed = iter([("finished", load_model(run.model(name)))]) if is_written else _changed(model, scene, options)
        for step, after in changed:
            counter.update()
            steps[step] = _measured(after, scene, planned)
            counter.update()
        if not is_written:
            # A process that was killed before the record may have left files.
            run.clear()
            write_json(run.own(run.finish), content)
            _copy_other_models(source, run, record)
            kept = steps[kept_step(steps)].model
            save_model(run.own(run.model(name)), kept, {"system": system_to_dict(planned.system)})
            write_record(run, record)  # Last: it makes the folder a run.
        evaluate_run(run, scene, lpips_weights=lpips_weights)
        counter.update()
    return _table(steps)


def _copy_other_models(source: RunFolder, run: RunFolder, record: RunRecord) -> None:
    """Copy the models and histories of a run, which the report compares, except the finished model."""
    copies = [(source.history(name), run.history(name)) for name in record.plan.names]
    copies += [(source.model(name), run.model(name)) for name in record.plan.names if name != record.plan.main[-1]]
    for path, copy in copies:
        if path.is_file():
            with replacing(run.own(copy)) as temporary:
                shutil.copyfile(path, temporary)


def _table(steps: Mapping[str, Measured]) -> str:
    columns = [("", "bytes", "train PSNR (dB)", "held-out PSNR (dB)")]
    for name, measured in steps.items():
        test = "" if measured.test is None else f"{measured.test:.2f}"
        columns.append((name, f"{measured.model.num_bytes:,}", f"{measured.train:.2f}", test))
    lines = aligned(columns)
    kept = kept_step(steps)
    if kept != list(steps)[-1]:
        lines.append(f"kept: {kept}, for polishing lost PSNR on the training views")
    return "\n".join(lines)


def _is_written(run: RunFolder, content: Mapping[str, object]) -> bool:
    """Return whether the same finishing (by finish.json) was killed in a folder after writing its model. Otherwise the
    folder must be free, unless the same finishing was begun there."""
    # A report is the last file of an evaluation: with one, the folder holds a finished run.
    is_begun = not run.report.is_file() and run.finish.name in run.written() and is_regular(run.finish)
    with contextlib.suppress(ValueError):
        if is_begun and read_json(run.finish) == content:
            return run.record.is_file()
    check_free(run.path, in_use="is not empty; choose another `out`")
    return False


def _changed(model: Model, scene: Scene, options: FinishOptions) -> Iterator[tuple[str, Model]]:
    """Yield the name of each step and the model after it."""
    views = refined_views(scene.train, model)
    if options.max_loss and can_shrink(model):
        model = shrink_textures(model, evenly_chosen(views, MOST_VIEWS), max_loss=options.max_loss)
        yield "shrunk", model
    if options.polish_steps and model.appearance.is_linear:
        yield "polished", polish(model, views, num_steps=options.polish_steps)


def kept_step(steps: Mapping[str, Measured]) -> str:
    """Return the name of the last step, or of the one before if polishing lost PSNR on the training views."""
    *before, last = steps
    is_worse = last == "polished" and steps[last].train < steps[before[-1]].train
    return before[-1] if is_worse else last


def _measured(model: Model, scene: Scene, planned: PlannedStage) -> Measured:
    settings = settings_of(planned.system)
    test = evaluate(scene.test, model, settings=settings).psnr if scene.test else None
    return Measured(model, evaluate(scene.train, model, settings=settings).psnr, test)
