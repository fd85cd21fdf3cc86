"""Compression of a model to the smallest compact file within a loss, or the best one within some bytes, with a table of
the choices tried."""

import functools
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from a2tg_jax import Model, RenderSettings, Scene, System
from a2tg_jax.base.atomic import write_whole
from a2tg_jax.base.even_spacing import evenly_chosen
from a2tg_jax.base.text import budget_in_bytes, in_bytes, shortened
from a2tg_jax.finish.compaction import (
    ASSUMED_PSNR,
    LADDER,
    Loss,
    TooMuchLostError,
    Trial,
    best_within,
    check_fits,
    loss_beside_renders,
    loss_on_views,
    measure_choices,
    smallest_within,
    try_choices,
)
from a2tg_jax.finish.tuning import (
    MOST_TUNINGS,
    TUNED_LADDER,
    Tune,
    Tuned,
    TunedFiles,
    best_tuned,
    smallest_tuned,
    tune_compact,
)
from a2tg_jax.io.compact import GROUPS, CompactChoices, encode_model
from a2tg_jax.io.formats import FORMATS
from a2tg_jax.io.model_rows import check_encodable
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.model_source import open_source
from a2tg_jax.results.options import CompressOptions
from a2tg_jax.results.output_paths import check_export, check_output
from a2tg_jax.results.report import aligned, loss_text
from a2tg_jax.results.run_evaluation import refined_views

SUFFIX = ".a2tgz"
MOST_VIEWS = 16
"""Largest number of views of a kind, training or test, that are measured, evenly chosen."""


def compress(
    source: Path,
    out: Path | None,
    options: CompressOptions,
    *,
    overwrite: bool = False,
    verbose: bool = False,
    scene: Scene | None = None,
    progress: bool = True,
    on_note: Callable[[str], object] = lambda line: None,
) -> str:
    """Write the smallest compact file of a model within a given loss, or the best one within given bytes, and return a
    line about it.

    Losses are in PSNR on a run's training views. Without photographs they are estimated from renders, for a model of
    `ASSUMED_PSNR`.

    Args:
      source: a run folder, for its last model; or a model, *.npz.
      out: the file, *.a2tgz; None: next to the model. Files that this function did not write into the run's folder
        need `overwrite`.
      options: the loss or the bytes, and tuning (`finish.tuning.smallest_tuned`, `best_tuned`).
      verbose: return a table of the choices tried before that line.
      scene: the run's photographs, if they are loaded already.
      progress: show progress bars.
      on_note: function that receives a line before the minutes of trials.

    Raises:
      ValueError, OSError: if the model or the photographs for tuning are missing, the file exists, a compact file
        cannot hold the model, no file is within the loss or the bytes, or an option is invalid.
    """
    name = source.name.lower()
    if not source.is_dir() and name.endswith(tuple(FORMATS)) and not name.endswith(".npz"):
        hint = ", which is compressed already" if name.endswith(SUFFIX) else ""
        raise ValueError(f"a2tg compress reads a run folder or *.npz; got {shortened(str(source))}{hint}")
    options.check()
    max_bytes = budget_in_bytes(options.file_budget, "file_budget")
    num_iterations = options.tune_iterations
    if out is not None and out.suffix.lower() != SUFFIX:
        raise ValueError(f"out must be the path of a file that ends in {SUFFIX}; got {out}")
    opened = open_source(source)
    model = opened.model
    default = opened.path.with_suffix(SUFFIX)
    out = default if out is None else out
    check_output(out)
    check_export(out, default, "`out`", overwrite=overwrite)
    # Before the photographs are loaded, and minutes of trials.
    check_encodable(model.appearance)
    ladder = TUNED_LADDER if num_iterations else LADDER
    if max_bytes is not None:
        check_fits(model, max_bytes, ladder)
    scene = scene or opened.load_scene()
    tune = None
    if num_iterations:
        if opened.system is None:
            raise ValueError(f"tune_iterations needs the photographs of a run folder; {source} is a file")
        if scene is None:
            raise FileNotFoundError(f"tune_iterations needs the photographs of {source}, which are missing")
        tune = functools.partial(_tuned, scene, opened.system, num_iterations, progress)
    losses = loss_measures(model, scene, opened.settings)
    if not losses:
        raise ValueError(
            "the model has no cameras to measure a loss with: a2tg convert writes *.a2tgz with the usual bits, and "
            "save_compact in Python with others"
        )
    measures = list(losses.values())
    num_ways = sum(map(len, ladder.values()))
    tunings = f", then training up to {MOST_TUNINGS} times" if tune else ""
    on_note(f"trying up to {num_ways} ways to round the model's numbers{tunings}; on a CPU this takes minutes")
    trials = measure_choices(model, measures, ladder, progress=progress)
    untuned, tuned = _search(model, measures, options.most_loss, max_bytes, trials, tune)
    chosen, data = _better(model, untuned, tuned, options.most_loss, max_bytes)
    # Only the default path is listed in the marker: any other file is the user's.
    if source.is_dir() and out == default:
        RunFolder(source).own(out)
    write_whole(out, data)
    lines = _table(trials, tuned, chosen, losses) if verbose else []
    share = f"1/{model.num_bytes / chosen.num_bytes:.1f} of the model's numbers"
    result = f"{out}: {in_bytes(chosen.num_bytes)} on disk, {share}, {loss_text(chosen.losses[0])}"
    return "\n".join([*lines, *_notes(tuned, max_bytes), result])


def _notes(tuned: TunedFiles, max_bytes: int | None) -> list[str]:
    """Return lines about a tuning that did not lead to the file."""
    lines = []
    if tuned.diverged:
        lines.append(f"tuning ended early, what was found before is kept: {tuned.diverged}")
    if max_bytes is not None and tuned.tried and tuned.chosen is None:
        best = f"the best of {len(tuned.tried)} has {in_bytes(min(trial.num_bytes for trial in tuned.tried))}"
        lines.append(f"no tuned file is small enough, {best}: the untuned one is kept")
    return lines


def _search(
    model: Model, measures: Sequence[Loss], max_loss: float, max_bytes: int | None, trials: Sequence[Trial],
    tune: Tune | None,
) -> tuple[Trial | None, TunedFiles]:  # fmt: skip
    """Return the best file without tuning, and tuned ones; within bytes if they are given, or else within a loss."""
    tuned = TunedFiles([])
    if max_bytes is not None:
        untuned = try_choices(model, best_within(model, max_bytes, trials), measures)
        if tune is not None:
            tuned = best_tuned(model, measures, max_bytes, trials, tune)
        return untuned, tuned
    within = None
    try:
        within = smallest_within(model, measures, max_loss, trials)
    except TooMuchLostError:
        # Rounding alone may lose too much. With tuning, that is no error yet.
        if tune is None:
            raise
    if tune is not None:
        tuned = smallest_tuned(model, measures, max_loss, trials, tune)
    return within, tuned


def _table(trials: Sequence[Trial], tuned: TunedFiles, chosen: Trial, measures: Iterable[str]) -> list[str]:
    """Return lines: a table of all choices tried, then the bits of the tuned files and the chosen one."""
    files = {f"tuned {number}": trial for number, trial in enumerate(tuned.tried, 1)} | {"chosen": chosen}
    names = [f"{trial.group} {trial.precision}" for trial in trials]
    rows = [("kept as", "bytes", *(f"dB lost, {measure}" for measure in measures))]
    for name, trial in zip([*names, *files], [*trials, *files.values()], strict=True):
        rows.append((name, f"{trial.num_bytes:,}", *(f"{loss:.3f}" for loss in trial.losses)))
    lines = aligned(list(zip(*rows, strict=True)))
    tried = {trial.group for trial in trials}
    groups = [group for group in GROUPS if group in tried]
    for name, trial in files.items():
        lines.append(f"{name}: " + ", ".join(f"{group} {getattr(trial.choices, group)}" for group in groups))
    return lines


def _better(
    model: Model, untuned: Trial | None, files: TunedFiles, max_loss: float, max_bytes: int | None
) -> tuple[Trial, bytes]:
    """Return the untuned or the tuned file: the one that loses less if bytes are given, or else the smaller one. Raises
    TooMuchLostError if there is neither."""

    def rank(trial: Trial) -> float:
        return trial.num_bytes if max_bytes is None else trial.losses[0]

    chosen = files.chosen
    if chosen is not None and files.tuned is not None and (untuned is None or rank(chosen) < rank(untuned)):
        return chosen, files.tuned.data
    if untuned is not None:
        return untuned, encode_model(model, untuned.choices)
    best = ""
    if files.tried:
        best = f"; the best tuned file loses {min(trial.losses[0] for trial in files.tried):.3f} dB"
    ended = f"; tuning ended early: {files.diverged}" if files.diverged else ""
    raise TooMuchLostError(f"max_loss must be larger: no file, tuned or not, is within it; got {max_loss}{best}{ended}")


def _tuned(
    scene: Scene, system: System, iterations: int, progress: bool, model: Model, choices: CompactChoices, number: int
) -> Tuned:
    title = f"tuning {number} of up to {MOST_TUNINGS}"
    return tune_compact(model, scene, system, choices, iterations=iterations, progress=progress, title=title)


def loss_measures(model: Model, scene: Scene | None, settings: RenderSettings) -> dict[str, Loss]:
    """Return measures of loss by name, in at most `MOST_VIEWS` views each; `compress` decides by the first. Empty
    without photographs and cameras."""
    if scene is not None:
        # Held-out views are measured as well, but never decide.
        views_by_name = {"training views": refined_views(scene.train, model), "test views": scene.test}
        measures = {}
        for name, views in views_by_name.items():
            if views:
                measures[name] = loss_on_views(model, evenly_chosen(views, MOST_VIEWS), settings=settings)
        return measures
    if model.origin is None or not model.origin.names:
        return {}
    cameras = evenly_chosen(model.origin.training_cameras, MOST_VIEWS)
    return {f"for a model of {ASSUMED_PSNR:g} dB": loss_beside_renders(model, cameras, settings=settings)}
