"""Compression of a model: the smallest compact file within a loss, and a table of the choices tried."""

import dataclasses
import math
from collections.abc import Callable, Collection, Sequence
from pathlib import Path

from a2tg_jax.data import Scene
from a2tg_jax.finish.compaction import (
    ASSUMED_PSNR,
    LADDER,
    Ladder,
    Loss,
    TooMuchLostError,
    Trial,
    loss_beside_renders,
    loss_on_views,
    measure_choices,
    smallest_within,
)
from a2tg_jax.finish.tuning import MOST_TUNINGS, TUNED_LADDER, Tune, Tuned, TunedFiles, smallest_tuned, tune_compact
from a2tg_jax.host.atomic import replacing
from a2tg_jax.host.regular_files import is_regular
from a2tg_jax.host.text import in_bytes
from a2tg_jax.io.compact import GROUPS, CompactChoices, encode_model
from a2tg_jax.io.model_file import load_model
from a2tg_jax.io.model_rows import check_encodable
from a2tg_jax.model import Model
from a2tg_jax.rasterize.render_types import RenderSettings
from a2tg_jax.results.folder import RunFolder, open_run, resuming_command
from a2tg_jax.results.record import read_record
from a2tg_jax.results.run_evaluation import refined_views, settings_of
from a2tg_jax.results.summary import aligned
from a2tg_jax.results.web_export import loss_told

SUFFIX = ".a2tgz"
PARTS = (
    "all", "half", "one third", "one quarter", "one fifth", "one sixth", "one seventh", "one eighth", "one ninth",
    "one tenth",
)  # fmt: skip
"""Names of 1/1, 1/2, 1/3, …"""
MOST_VIEWS = 16
"""Largest number of training views measured, evenly chosen."""


@dataclasses.dataclass(frozen=True)
class Compressed:
    """Compact file, and how it was chosen."""

    path: Path
    model: Model
    """Model before compression."""
    trials: Sequence[Trial]
    """Trial of each group at each precision."""
    chosen: Trial
    measures: tuple[str, ...]
    """Names of the loss measures of the trials."""
    tuned: Sequence[Trial] = ()
    """Files of tuned models, in the order of trial."""
    diverged: str | None = None
    """Error that ended the search for tuned files; None: there was none."""


def default_output(source: Path) -> Path:
    """Return the file that `compress` writes beside the model of a run folder, or beside a model's file.

    Raises:
      FileNotFoundError: if there is no such model.
    """
    if source.is_dir():
        return _last_model(open_run(source))[0].with_suffix(SUFFIX)
    if not is_regular(source):
        raise FileNotFoundError(f"{source}: no such file or folder")
    return source.with_suffix(SUFFIX)


def check_compact(out: Path) -> None:
    """Raise ValueError if `out` is a folder or has another suffix than a2tgz."""
    if out.is_dir() or out.suffix.lower() != SUFFIX:
        raise ValueError(f"out must be the path of a file that ends in {SUFFIX}; got {out}")


def compress(
    source: Path,
    out: Path | None = None,
    *,
    max_loss: float = 0.05,
    tune_iterations: int = 0,
    on_start: Callable[[str], None] = lambda _: None,
) -> Compressed:
    """Write the smallest compact file of a model within a given loss.

    Losses are those of PSNR on the training views of a run. If the photographs are missing, or a model's file is
    given, they are estimated from renders, for a model with `ASSUMED_PSNR`.

    Args:
      source: a run folder, of which the last model is taken; or a model, *.npz.
      out: the file, *.a2tgz; None is beside the model.
      max_loss: in dB.
      tune_iterations: iterations of training with rounding for each choice of bits that is tried so
        (`finish.tuning.smallest_tuned`); 0: the model's numbers are only rounded.
      on_start: called with how much there is to try, once the arguments are checked.

    Raises:
      FileNotFoundError: if there is no such model, or no photographs to tune it with.
      ValueError: if a compact file cannot hold it, nothing loses so little, `out` is a folder or has another suffix
        than a2tgz, or a model's file is to be tuned.
    """
    run = open_run(source) if source.is_dir() else None
    path, settings = (source, RenderSettings()) if run is None else _last_model(run)
    model = load_model(path)
    check_encodable(model.appearance)
    out = path.with_suffix(SUFFIX) if out is None else out
    if not 0 <= max_loss < math.inf:
        raise ValueError(f"max_loss must be at least 0 dB; got {max_loss}")
    check_compact(out)
    scene = None if run is None else _scene_of(run)
    tune = _tune(source, run, scene, tune_iterations) if tune_iterations else None
    losses = _losses(model, scene, settings)
    ladder, measures = LADDER if tune is None else TUNED_LADDER, list(losses.values())
    on_start(_plan_told(ladder, tune_iterations))
    trials = measure_choices(model, measures, ladder)
    untuned = _untuned(model, measures, max_loss, trials, may_fail=tune is not None)
    found = TunedFiles([]) if tune is None else smallest_tuned(model, measures, max_loss, trials, tune)
    chosen, data = _smaller(model, untuned, found, max_loss)
    if run is not None and out == path.with_suffix(SUFFIX):
        run.own(out)
    with replacing(out) as temporary:
        temporary.write_bytes(data)
    return Compressed(out, model, trials, chosen, tuple(losses), found.tried, found.diverged)


def _untuned(
    model: Model, losses: Sequence[Loss], max_loss: float, trials: Sequence[Trial], *, may_fail: bool
) -> Trial | None:
    """Return the smallest file without tuning; None if there is none within the loss, and that may be."""
    try:
        return smallest_within(model, losses, max_loss, trials)
    except TooMuchLostError:
        if may_fail:
            return None
        raise


def _smaller(model: Model, untuned: Trial | None, found: TunedFiles, max_loss: float) -> tuple[Trial, bytes]:
    """Return the smaller of two files, the one without tuning and the tuned one, either of which may be missing.

    Raises:
      TooMuchLostError: if both are missing.
    """
    tuned = found.chosen
    if found.tuned is not None and tuned is not None and (untuned is None or tuned.num_bytes < untuned.num_bytes):
        return tuned, found.tuned.data
    if untuned is not None:
        return untuned, encode_model(model, untuned.choices)
    least = min((trial.losses[0] for trial in found.tried), default=None)
    told = "" if least is None else f"; the best tuned file loses {least:.3f} dB"
    ended = f"; tuning ended early: {found.diverged}" if found.diverged else ""
    raise TooMuchLostError(f"max_loss must be larger: no file, tuned or not, is within it; got {max_loss}{told}{ended}")


def _plan_told(ladder: Ladder, tune_iterations: int) -> str:
    """Return what there is to try, in words."""
    tunings = f", then training up to {MOST_TUNINGS} times" if tune_iterations else ""
    ways = f"up to {sum(map(len, ladder.values()))} ways to round the model's numbers"
    return f"trying {ways}{tunings}; on a CPU this takes minutes"


def _tune(source: Path, run: RunFolder | None, scene: Scene | None, iterations: int) -> Tune:
    """Return the function that tunes the model of a run.

    Raises:
      FileNotFoundError: if the run's photographs are missing.
      ValueError: if there is no run, or the iterations are negative.
    """
    if iterations < 0:
        raise ValueError(f"tune_iterations must be at least 0; got {iterations}")
    if run is None:
        raise ValueError(f"tune_iterations needs the photographs of a run folder; {source} is a file")
    if scene is None:
        raise FileNotFoundError(f"tune_iterations needs the photographs of {source}, which are missing")
    plan = read_record(run).plan
    system = plan[plan.main[-1]].system

    def tune(model: Model, choices: CompactChoices, number: int) -> Tuned:
        title = f"tuning {number} of up to {MOST_TUNINGS}"
        return tune_compact(model, scene, system, choices, iterations=iterations, progress=True, title=title)

    return tune


def _last_model(run: RunFolder) -> tuple[Path, RenderSettings]:
    """Return the path and render settings of the main system's last model."""
    plan = read_record(run).plan
    planned = plan[plan.main[-1]]
    path = run.model(planned.name)
    if not is_regular(path):
        raise FileNotFoundError(f"{run.path} has no finished {planned.name}; continue with: {resuming_command(run)}")
    return path, settings_of(planned.system)


def _scene_of(run: RunFolder) -> Scene | None:
    """Return the scene, or None if its photographs are missing."""
    try:
        return read_record(run).scene.load()
    except FileNotFoundError:
        return None


def _losses(model: Model, scene: Scene | None, settings: RenderSettings) -> dict[str, Loss]:
    """Return loss measures by name; the first decides."""
    if scene is not None:
        train = refined_views(scene.train[:: -(-len(scene.train) // MOST_VIEWS)], model)
        losses = {"training views": loss_on_views(model, train, settings=settings)}
        return losses | ({"test views": loss_on_views(model, scene.test, settings=settings)} if scene.test else {})
    if model.origin is None or not model.origin.names:
        raise ValueError(
            "the model has no cameras to measure a loss with; use save_compact in Python with your own choices"
        )
    pairs = zip(model.origin.cameras, model.origin.is_test, strict=True)
    cameras = [camera for camera, is_test in pairs if not is_test]
    cameras = cameras[:: -(-len(cameras) // MOST_VIEWS) or 1]
    return {f"if {ASSUMED_PSNR:g} dB": loss_beside_renders(model, cameras, settings=settings)}


def compression_text(result: Compressed) -> str:
    """Return a table of all choices tried, the bits of the tuned files, and at the end a line about the file."""
    chosen, model = result.chosen, result.model
    groups = dict.fromkeys(trial.group for trial in result.trials)
    rows = [[f"{trial.group} {trial.precision}", *_figures(trial)] for trial in result.trials]
    columns = zip(
        ["kept as", "bytes", *(f"dB lost, {measure}" for measure in result.measures)],
        *rows,
        *([f"tuned {number}", *_figures(trial)] for number, trial in enumerate(result.tuned, 1)),
        ["chosen", *_figures(chosen)],
        strict=True,
    )
    bits = [f"tuned {number}: {_kept(trial, groups)}" for number, trial in enumerate(result.tuned, 1)]
    ended = [f"tuning ended early, what was found before is kept: {result.diverged}"] if result.diverged else []
    share = f"{part_told(model.num_bytes / chosen.num_bytes)} of the model's numbers"
    told = f"{result.path}: {in_bytes(chosen.num_bytes)} on disk, {share}, {loss_told(chosen.losses[0])}"
    return "\n".join([*aligned(list(columns)), *bits, *ended, f"chosen: {_kept(chosen, groups)}", told])


def _kept(trial: Trial, groups: Collection[str]) -> str:
    """Return the bits of those of the groups that a model has."""
    return ", ".join(f"{group} {getattr(trial.choices, group)}" for group in GROUPS if group in groups)


def part_told(ratio: float) -> str:
    """Return "one eighth" for a ratio near 8, and "1/14" for one that has no short name."""
    whole = round(ratio)
    return PARTS[whole - 1] if 1 <= whole <= len(PARTS) else f"1/{whole}"


def _figures(trial: Trial) -> list[str]:
    return [f"{trial.num_bytes:,}", *(f"{loss:.3f}" for loss in trial.losses)]
