"""Checks before anything is trained or written: options, weights, folders, room on the disk."""

import os
import shutil
import warnings
from pathlib import Path

from a2tg_jax.core.sh import NUM_BASES
from a2tg_jax.data import Scene
from a2tg_jax.host.regular_files import is_regular
from a2tg_jax.host.text import counted, in_bytes
from a2tg_jax.host.urls import is_url
from a2tg_jax.io.formats import format_of
from a2tg_jax.measure.metrics import load_lpips
from a2tg_jax.model import Model
from a2tg_jax.results.first_stage import GivenSplats, are_shapes_taken
from a2tg_jax.results.folder import KEPT_CHECKPOINTS, RunFolder, check_free
from a2tg_jax.results.forecast import quicker_text, room_for_photographs, tell_forecast
from a2tg_jax.results.output_checks import check_output
from a2tg_jax.results.plan import PlannedStage
from a2tg_jax.results.record import SYNTHETIC, RunRecord
from a2tg_jax.training import System
from a2tg_jax.training.start import check_loss_data, check_start, initial_number, num_rows

STATE_SIZE = 3
"""Arrays per parameter in a checkpoint: its value and two moments."""


def check_new_run(
    record: RunRecord,
    out: Path,
    *,
    given: GivenSplats | None,
    overwrite: bool,
    lpips_weights: Path | None,
    max_memory: int | None = None,
    num_devices: int = 1,
) -> Scene:
    """Return the scene of a run that can be trained in a folder. What the run will need is printed.

    Args:
      record: what is trained.
      out: the folder.
      given: splats in place of its first stage; None: it is trained.
      overwrite, lpips_weights, max_memory: as in `begin_run`.
      num_devices: devices that train together.

    Raises:
      ValueError, OSError: naming what is wrong: an option, the weights, the folder, the scene, the disk, the memory.
    """
    record.check()
    check_weights(lpips_weights)
    if record.scene.path != SYNTHETIC and not is_url(record.scene.path):
        check_apart(out, Path(record.scene.path))
    check_free(out, overwrite=overwrite)
    if given is not None:
        check_init(given, out, record.system)
    num_given = None if given is None else given.splats.num
    check_output(out)
    scene = record.scene.load(room_for_photographs(max_memory), is_divided=True)
    for system in record.systems.values():
        check_loss_data(scene.train, system.stages())
        check_start(scene, system, num_given if system is record.system else None)
    check_room(record, scene, out, num_given)
    warn_of_small_budget(record.system)
    tell_forecast(scene, record.plan, max_memory, num_devices, num_given)
    quicker = quicker_text(scene, record, num_given)
    if quicker:
        print(quicker, flush=True)
    return scene


def check_init(given: GivenSplats, out: Path, system: System) -> None:
    """Raise ValueError unless a file of splats can take the place of the first stage of a run in a folder. What the
    stage cannot take of it is warned of."""
    file = given.file
    if not is_regular(file):
        raise ValueError(f"init: there is no file {file}")
    format_of(file)
    if RunFolder(out).is_begun:
        raise ValueError(f"init begins a new run, and {out} holds one: choose another --out")
    splats, degree = given.splats, system.initial_sh_degree
    needed, budget = splats.num * system.initial_bytes, system.budget_bytes
    if budget is not None and needed > budget:
        raise ValueError(
            f"init: {file} holds {splats.num:,} Gaussians, {in_bytes(needed)} at degree {degree}, which is more than "
            f"the memory_budget of {in_bytes(budget)}: raise it, or leave it out"
        )
    lost = _left_out(splats, system)
    if lost:
        warnings.warn(f"--init {file} leaves out {' and '.join(lost)}", stacklevel=2)


def _left_out(splats: Model, system: System) -> list[str]:
    """Return, in words, what a first stage cannot take of splats."""
    shown, degree, lost = splats.appearance, system.initial_sh_degree, []
    if shown.exponents is not None and not are_shapes_taken(splats, system.stages()[0].appearance):
        lost.append("the shapes of its kernels (the nearest Gaussians take their place)")
    if not shown.is_portable or shown.texture is not None:
        lost.append("what its splats show besides " + ("kernels" if shown.exponents is not None else "Gaussians"))
    if splats.sh.shape[1] > NUM_BASES[degree]:
        lost.append(f"its spherical harmonics above degree {degree}")
    return lost


def warn_of_small_budget(system: System) -> None:
    """Warn of a memory budget for so few Gaussians that they cannot show a scene."""
    if system.small_budget:
        warnings.warn(f"{system.small_budget}; it is in bytes of the model, such as 20MB", stacklevel=2)


def check_weights(lpips_weights: Path | None) -> None:
    """Raise ValueError or FileNotFoundError unless these are LPIPS weights, or None."""
    if lpips_weights is not None:
        load_lpips(lpips_weights)


def check_apart(out: Path, source: Path) -> None:
    """Raise ValueError if one of two folders, one to read and one to write, lies in the other."""
    written, read = out.resolve(), source.resolve()
    if written.is_relative_to(read) or read.is_relative_to(written):
        raise ValueError(f"{out} and {source} overlap: choose an output folder outside it")


def check_room(record: RunRecord, scene: Scene, out: Path, num_given: int | None = None) -> None:
    """Raise ValueError unless the disk has room for what will surely be written.

    Models and checkpoints of the Gaussians that there will be, with what the first stage begins to show of them.
    """
    plan = record.plan
    nums = {name: num_given if plan.begins_like_main(name) else None for name in plan.names}
    stages = [(planned, gaussian_bytes(planned, scene, nums[planned.name])) for planned in plan.stages]
    largest = max(num_bytes for _, num_bytes in stages)
    needed = sum(num_bytes for _, num_bytes in stages) + STATE_SIZE * (KEPT_CHECKPOINTS + 1) * largest
    free = shutil.disk_usage(_existing(out)).free
    if needed > free:
        raise ValueError(
            f"{out} needs {needed / 1e9:.1f} GB for models and checkpoints, but the disk has "
            f"{free / 1e9:.1f} GB: make room, or choose another --out, fewer Gaussians or fewer --compare"
        )


def gaussian_bytes(planned: PlannedStage, scene: Scene, num_given: int | None = None) -> int:
    """Return the largest number of bytes of Gaussians that a system's first stage, or a file in its place, can
    leave."""
    system, first = planned.system, planned.system.stages()[0]
    num = num_rows(first, initial_number(scene, system, first)) if num_given is None else num_given
    if system.budget_bytes is not None:
        return system.budget_bytes
    return int(num * system.initial_bytes)


def _existing(path: Path) -> Path:
    """Return the folder, or the nearest above it that there is."""
    path = Path(os.path.abspath(path))
    return next(folder for folder in (path, *path.parents) if folder.is_dir())


def check_held_out(model: Model, scene: Scene, path: Path) -> None:
    """Raise ValueError if a model was trained on views that its scene holds out: their figures would be too good.

    Args:
      model: a model of a run; without an origin its views are unknown, and it passes.
      scene: the scene of the run, as it is read now.
      path: the file of the model.
    """
    if model.origin is None:
        return
    trained = {name for name, is_test in zip(model.origin.names, model.origin.is_test, strict=True) if not is_test}
    leaked = sorted(trained & {view.name for view in scene.test} - {view.name for view in scene.train})
    if leaked:
        raise ValueError(
            f"{path} was trained on {counted(len(leaked), 'view')} that {scene.name} now holds out, such as "
            f"{leaked[0]}: the photographs have changed, or views of panoramas, which are held out together since, are "
            "among them; train in a new folder"
        )
