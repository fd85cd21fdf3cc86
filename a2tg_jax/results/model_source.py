"""Models to show, export, mesh, render or compress: a run's last model or another stage's, or a file; and splats of a
file as the first stage of a run."""

import dataclasses
import functools
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from a2tg_jax import (
    Checkpoint,
    History,
    Model,
    RenderSettings,
    Scene,
    System,
    load_checkpoint,
    load_model,
    save_model,
    transform_gaussians,
)
from a2tg_jax.base.regular_files import is_regular
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.data.load import is_scene
from a2tg_jax.data.other_runs import model_hint
from a2tg_jax.io.edit_file import apply_edit, load_edit
from a2tg_jax.io.formats import FORMATS, format_of, load_splats, splats_at
from a2tg_jax.io.sog import HEADER
from a2tg_jax.io.web_scene import encode_web_scene
from a2tg_jax.model import plain_gaussians
from a2tg_jax.results.commands import first_training_command, resuming_command
from a2tg_jax.results.folder import RunFolder, iteration_of, open_run
from a2tg_jax.results.history import write_history
from a2tg_jax.results.plan import PlannedStage, RunPlan
from a2tg_jax.results.record import RunRecord, read_record
from a2tg_jax.training.start import left_out, new_appearance, with_degree

READABLE = [suffix for suffix, format in FORMATS.items() if format.load is not None]
SHOWN = f"a run folder, or a file *{', *'.join(READABLE)}"


@dataclasses.dataclass(frozen=True)
class Source:
    """Model with its title, file, render settings and photographs."""

    model: Model
    title: str
    note: str = ""
    """Note that the viewer shows."""
    settings: RenderSettings = RenderSettings()
    load_scene: Callable[[], Scene | None] = lambda: None
    """Loader of the photographs; None if they are missing. Raises ValueError or OSError if they cannot be read."""
    path: Path = Path()
    """Its file."""
    system: System | None = None
    """System that trained the model of a run; None for a file."""

    @functools.cached_property
    def near_plane(self) -> float:
        """Distance of the near plane; small for files of unknown scale."""
        if (self.model.origin is not None and self.model.origin.names) or not self.model.num:
            return self.settings.near_plane
        means = np.asarray(self.model.live.gaussians.means, np.float64)
        # The radius that contains three quarters of the Gaussians.
        radius = np.quantile(np.linalg.norm(means - np.median(means, axis=0), axis=1), 0.75)
        # 2 % of the scene: the default 0.2 is made for worlds with cameras at 1.
        return min(self.settings.near_plane, 0.02 * float(max(radius, 1e-6)))

    @functools.cached_property
    def encoded(self) -> bytes:
        """Scene for browsers. Raises ValueError if it cannot be shown there."""
        return encode_web_scene(self.model, title=self.title, note=self.note, near_plane=self.near_plane)

    def load_scene_or_warn(self) -> Scene | None:
        """Return the scene; None if the photographs are missing or, with a warning, unreadable."""
        try:
            return self.load_scene()
        except (OSError, ValueError) as error:
            warn(f"the photographs are left out: {error}")
            return None


def finished_stage(run: RunFolder) -> tuple[RunRecord, PlannedStage]:
    """Return the record of a run and its main system's last stage. Raises FileNotFoundError if it is not finished."""
    record = read_record(run)
    planned = record.plan[record.plan.main[-1]]
    if not is_regular(run.model(planned.name)):
        raise FileNotFoundError(f"{run.path} has no finished {planned.name}; continue with: {resuming_command(run)}")
    return record, planned


def chosen_stage(run: RunFolder, plan: RunPlan, name: str | None = None) -> tuple[PlannedStage, str]:
    """Return the stage whose model commands take, and a note unless it is finished and the one that is expected.

    It is the stage of this name, or else the last finished one of the main system, or else the one that was trained
    last. Raises ValueError if the run has no such stage, and FileNotFoundError if nothing of it was kept yet.
    """
    wanted = plan.main[-1] if name is None else plan[name].name
    names = plan.main if name is None else (wanted,)
    kept = [each for each in names if run.newest(each) is not None]
    finished = [each for each in kept if is_regular(run.model(each))]
    if not kept:
        raise FileNotFoundError(
            f"{run.path} has no finished {wanted}, and no checkpoint; continue with: {resuming_command(run)}"
        )
    planned = plan[(finished or kept)[-1]]
    if planned.name not in finished:
        iteration = iteration_of(run.checkpoints(planned.name)[-1])
        progress = f"after iteration {iteration:,} of {planned.stage.iterations:,}"
        return planned, f"{planned.name} is not finished: this is its checkpoint {progress}"
    if planned.name == wanted:
        return planned, ""
    return planned, f"{wanted} is not finished: this is {planned.name}, the last finished model"


def trained_model(run: RunFolder, planned: PlannedStage, load_scene: Callable[[], Scene | None]) -> Model:
    """Return the model of a stage of which something was kept. A checkpoint has no cameras, so that the scene is read.
    Raises FileNotFoundError if the scene is missing, and ValueError if no file can be read."""
    if is_regular(run.model(planned.name)):
        return load_model(run.model(planned.name))
    scene = load_scene()
    if scene is None:
        newest = run.checkpoints(planned.name)[-1]
        raise FileNotFoundError(f"{newest} has no cameras, and the scene that has them is missing")
    return readable_checkpoint(run, planned)[1].model_in(scene)


def readable_checkpoint(run: RunFolder, planned: PlannedStage) -> tuple[Path, Checkpoint]:
    """Return the newest checkpoint of a stage, and its file. If it is damaged, the one before is taken, with a warning.
    Raises ValueError if neither can be read."""
    *older, newest = run.checkpoints(planned.name)
    try:
        return newest, load_checkpoint(newest, system=type(planned.system))
    except ValueError as error:
        if not older:
            raise
        warn(f"{error}; {older[-1].name} is taken instead")
        return older[-1], load_checkpoint(older[-1], system=type(planned.system))


def open_source(path: Path, name: str | None = None, edit: Path | None = None) -> Source:
    """Open a run folder or a file of any format that `load_splats` reads.

    Args:
      path: the folder or file.
      name: model of a run, as `a2tg info` prints it; None: as `chosen_stage`, with a warning unless that is the last
        one of its main system.
      edit: file of an edit that is applied to the model.

    Raises:
      FileNotFoundError: if there is no such file, or nothing of the run's stage was kept.
      ValueError: if it cannot be read.
    """
    change = None if edit is None else load_edit(edit)  # Before a large model is read.
    path = splats_at(path)
    if path.is_dir():
        source = _source_of_run(_run_at(path), name)
    elif not is_regular(path):
        raise FileNotFoundError(f"{path}: no such file or folder")
    elif name is not None:
        raise ValueError(f"`model` needs a run folder; {path} is not a folder")
    elif not path.name.lower().endswith(tuple(FORMATS)):
        raise ValueError(f"{path}: is not a scene to show; give {SHOWN}")
    else:
        source = _source_of_file(path)
    if change is None:
        return source
    return dataclasses.replace(source, model=apply_edit(source.model, change))


def _source_of_run(run: RunFolder, name: str | None) -> Source:
    record = read_record(run)
    planned, note = chosen_stage(run, record.plan, name)

    @functools.cache
    def load_scene() -> Scene | None:
        try:
            return record.scene.load()
        except FileNotFoundError:  # A run is worth showing without its photographs.
            return None

    model = trained_model(run, planned, load_scene)
    is_finished = is_regular(run.model(planned.name))
    if note:
        advice = "; `model` NAME takes another one's newest checkpoint" if is_finished else ""
        warn(f"{note}{advice}")
    return Source(
        model=model,
        title=record.scene.name,
        note="" if is_finished else note,
        settings=settings_of(planned.system),
        load_scene=load_scene,
        path=run.newest(planned.name) or run.model(planned.name),
        system=planned.system,
    )


def _source_of_file(path: Path) -> Source:
    # Warnings of the reader are shown in the viewer as well.
    with warnings.catch_warnings(record=True) as caught:
        # A warning that was shown once in this process would not be recorded.
        warnings.simplefilter("always")
        model = load_splats(path)
    notes = [str(warning.message).removeprefix(f"{path}: ") for warning in caught]
    for note in notes:
        warn(f"{path}: {note}")
    title = path.parent.resolve().name if path.name.lower() == HEADER else path.stem
    return Source(model, title, ". ".join(notes), path=path)


def settings_of(system: System) -> RenderSettings:
    """Return the render settings of a system's models."""
    return RenderSettings(tile_size=system.tile_size)


def _run_at(folder: Path) -> RunFolder:
    """Return the run folder, or raise FileNotFoundError with what the folder is instead."""
    # A scene folder is a likely mistake.
    if not is_regular(RunFolder(folder).record) and is_scene(folder):
        raise FileNotFoundError(f"{folder} is a scene that must be trained first: {first_training_command(folder)}")
    return open_run(folder, f"give {SHOWN}")


# Splats of a file instead of the first stage of a run


def check_init(file: Path, out: Path, system: System) -> Model:
    """Return a file's splats to replace the first stage of a run, with a warning about what is dropped.

    The file is of any format that `load_splats` reads: plain splats in the photographs' original world, or a model.
    Raises ValueError if there is no such file, the folder holds a run, or the splats exceed the system's budget.
    """
    file = splats_at(file)
    if not is_regular(file):
        raise ValueError(f"init: there is no file {file}{model_hint(file)}")
    format_of(file)
    if RunFolder(out).is_begun:
        raise ValueError(f"init begins a new run, and {out} holds one: choose another `out`")
    splats = load_splats(file)
    try:
        system.check_given_number(splats.num)
    except ValueError as error:
        raise ValueError(f"init: {file}: {error}") from error
    # The first stage begins with its own appearance.
    lost = left_out(splats, system.initial_sh_degree, system.stages()[0].appearance)
    if lost:
        warn(f"`init` {file} leaves out {' and '.join(lost)}")
    return splats


def write_first_stage(run: RunFolder, record: RunRecord, splats: Model, scene: Scene) -> None:
    """Write splats as the model of the first stage of the main system, in the scene's normalised world, with an empty
    history."""
    plan = record.plan
    planned = plan[plan.main[0]]
    system = planned.system
    template = planned.stage.appearance
    splats = splats.live
    has_shapes = splats.appearance.exponents is not None and template.exponents is not None
    # File → original world → the scene's normalised one.
    to_scene = scene.transform
    if splats.origin is not None:
        to_scene = splats.origin.transform.inverse().then(scene.transform)
    shapes = splats.appearance.shapes if has_shapes else None
    gaussians = transform_gaussians(plain_gaussians(splats, keeps_shapes=shapes is not None), to_scene)
    gaussians = with_degree(gaussians, system.initial_sh_degree)
    appearance = new_appearance(template, gaussians, system)
    if shapes is not None:
        appearance = appearance.with_shapes(shapes)
    model = Model(gaussians, appearance, background=system.background_color, origin=scene.origin)
    # No system in the header: none trained it, so that resuming has no options to compare.
    save_model(run.own(run.model(planned.name)), model, {"init": record.init})
    write_history(run.own(run.history(planned.name)), History.empty())
