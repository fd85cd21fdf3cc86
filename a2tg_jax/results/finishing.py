"""Finishing of a trained run in a new run folder: textures shrink, and colours move towards the least squared error."""

import dataclasses
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from a2tg_jax.data import Scene
from a2tg_jax.finish.polishing import polish
from a2tg_jax.finish.shrinking import can_shrink, shrink_textures
from a2tg_jax.host.atomic import final_of, replacing
from a2tg_jax.host.regular_files import is_regular, sha256_of
from a2tg_jax.io.model_file import load_model, save_model
from a2tg_jax.measure.evaluation import evaluate
from a2tg_jax.model import Model
from a2tg_jax.results.finish_options import FinishOptions
from a2tg_jax.results.folder import RunFolder, check_free, claimed, read_json, resuming_command, write_json
from a2tg_jax.results.plan import PlannedStage
from a2tg_jax.results.record import RunRecord, read_record, write_record
from a2tg_jax.results.run_evaluation import evaluate_run, finished_stages, refined_views, settings_of
from a2tg_jax.results.summary import RunResult, aligned
from a2tg_jax.training.registry import system_to_dict

MOST_VIEWS = 16
"""Largest number of training views that the loss of shrinking is measured on, evenly chosen."""


@dataclasses.dataclass(frozen=True)
class Measured:
    """Bytes and PSNR of a model."""

    num_bytes: int
    train: float
    """PSNR of the training views in dB."""
    test: float | None
    """PSNR of the test views in dB; None without test views."""

    @property
    def column(self) -> tuple[str, ...]:
        """Cells of a table."""
        return f"{self.num_bytes:,}", f"{self.train:.2f}", "" if self.test is None else f"{self.test:.2f}"


@dataclasses.dataclass(frozen=True)
class Finished:
    """Models of a run by the name of each step, and the evaluation of the new run."""

    steps: dict[str, Measured]
    result: RunResult

    @property
    def text(self) -> str:
        """Table of bytes and PSNR, before and after each step."""
        rows = ("", "bytes", "train PSNR (dB)", "held-out PSNR (dB)")
        lines = aligned([rows, *((name, *found.column) for name, found in self.steps.items())])
        kept = kept_step(self.steps)
        is_last = kept == list(self.steps)[-1]
        return "\n".join(lines if is_last else [*lines, f"kept: {kept}, for polishing lost PSNR on the training views"])


def finish_run(source: RunFolder, out: Path, options: FinishOptions, *, lpips_weights: Path | None = None) -> Finished:
    """Finish the last model of a run's main system, and evaluate it in a new run folder.

    Choices are made on training views; held-out views are only measured. If the same finishing was killed in that
    folder, it goes on: with the evaluation if the model was written, otherwise from its beginning.

    Args:
      source: the run; it is not changed.
      out: the new run folder, with the record, the histories and the other models of the run.
      options: what is done.
      lpips_weights: a weights file for LPIPS; None leaves it out.

    Raises:
      FileNotFoundError: if the stage is not finished, or an earlier model or the photographs are missing.
      FileExistsError: if `out` is in use.
      ValueError: if the model has nothing to shrink or polish, or an option is out of range.
    """
    options.check()
    record = read_record(source)
    planned = record.plan[record.plan.main[-1]]
    path = source.model(planned.name)
    if not path.is_file():
        raise FileNotFoundError(
            f"{source.path} has no finished {planned.name}; continue with: {resuming_command(source)}"
        )
    run, told = RunFolder(out), _told(source, planned, options)
    _is_written(run, told)
    model, scene = load_model(path), record.scene.load()
    _check(model, planned, options)
    finished_stages(source, record.plan)
    with claimed(run):
        is_written = _is_written(run, told)  # Another process may have been here meanwhile.
        changed = [("finished", load_model(run.model(planned.name)))] if is_written else _changed(model, scene, options)
        models, steps = {"before": model}, {"before": _measured(model, scene, planned)}
        for name, after in changed:
            models[name], steps[name] = after, _measured(after, scene, planned)
        if not is_written:
            run.clear()
            _write_run(run, source, record, planned, models[kept_step(steps)], told)
        result = evaluate_run(run, scene, lpips_weights=lpips_weights)
    return Finished(steps, result)


def _told(source: RunFolder, planned: PlannedStage, options: FinishOptions) -> dict[str, Any]:
    """Return the content of finish.json: from which model of which run the new one is made, and how."""
    origin = {"source": str(source.path.resolve()), "model": planned.name}
    return {**origin, "sha256": sha256_of(source.model(planned.name)), **dataclasses.asdict(options)}


def _is_written(run: RunFolder, told: Mapping[str, Any]) -> bool:
    """Return whether a process was killed in a folder after it had done the same and written the model.

    Raises:
      FileExistsError: if there is anything in the folder but what such a process left.
    """
    if not _is_begun(run, told):
        check_free(run.path, in_use="is not empty; choose another --out")
        return False
    if run.record.is_file():
        return True
    own = {run.path / name for name in run.written()}
    other = next((path for path in run.path.rglob("*") if path.is_file() and final_of(path) not in own), None)
    if other is not None:
        raise FileExistsError(f"{other} is not of the finishing that was begun there: move it, or choose another --out")
    return False


def _is_begun(run: RunFolder, told: Mapping[str, Any]) -> bool:
    """Return whether a process was killed in a folder while it did the same."""
    if run.report.is_file() or run.finish.name not in run.written() or not is_regular(run.finish):
        return False
    try:
        return bool(read_json(run.finish) == told)
    except ValueError:
        return False


def _changed(model: Model, scene: Scene, options: FinishOptions) -> Iterator[tuple[str, Model]]:
    """Yield the name of each step and the model after it."""
    views = refined_views(scene.train, model)
    if options.max_loss and can_shrink(model):
        some = views[:: -(-len(views) // MOST_VIEWS)]
        model = shrink_textures(model, some, max_loss=options.max_loss)
        yield "shrunk", model
    if options.polish_steps and model.appearance.is_linear:
        yield "polished", polish(model, views, num_steps=options.polish_steps)


def kept_step(steps: Mapping[str, Measured]) -> str:
    """Return the name of the last step, or of the one before if polishing lost PSNR on the training views."""
    *before, last = steps
    is_worse = last == "polished" and steps[last].train < steps[before[-1]].train
    return before[-1] if is_worse else last


def _check(model: Model, planned: PlannedStage, options: FinishOptions) -> None:
    """Raise ValueError if nothing can be done, or photographs of changing exposure would pull at the colours."""
    can_polish = options.polish_steps > 0 and model.appearance.is_linear
    if can_polish and planned.system.exposure:
        raise ValueError("the run learned exposures, which polishing does not know: add --polish-steps 0")
    if not can_polish and not (options.max_loss and can_shrink(model)):
        raise ValueError(f"{planned.name} shows nothing that these options can shrink or polish")


def _measured(model: Model, scene: Scene, planned: PlannedStage) -> Measured:
    psnrs = [
        evaluate(views, model, settings=settings_of(planned.system)).psnr if views else None
        for views in (scene.train, scene.test)
    ]
    assert psnrs[0] is not None
    return Measured(model.num_bytes, psnrs[0], psnrs[1])


def _write_run(
    run: RunFolder,
    source: RunFolder,
    record: RunRecord,
    planned: PlannedStage,
    model: Model,
    told: Mapping[str, Any],
) -> None:
    """Write finish.json, models, histories and record of the new run; the record last, which makes it one."""
    write_json(run.own(run.finish), told)
    for name in record.plan.names:
        for find in (RunFolder.model, RunFolder.history):
            if find(source, name).is_file() and (find is RunFolder.history or name != planned.name):
                with replacing(run.own(find(run, name))) as copy:
                    shutil.copyfile(find(source, name), copy)
    save_model(run.own(run.model(planned.name)), model, {"system": system_to_dict(planned.system)})
    write_record(run, record)
