"""Splats from a file instead of the first stage of a run."""

import dataclasses
import warnings
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from a2tg_jax.appearance import Appearance
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.sh import NUM_BASES
from a2tg_jax.core.similarity import transform_gaussians
from a2tg_jax.data import Scene
from a2tg_jax.data.scene import origin_of_scene
from a2tg_jax.host.regular_files import is_regular
from a2tg_jax.host.text import in_bytes
from a2tg_jax.io.formats import format_of, load_splats
from a2tg_jax.io.model_file import save_model
from a2tg_jax.io.other_programs import plain_gaussians
from a2tg_jax.model import Model
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.history import write_history
from a2tg_jax.results.record import RunRecord
from a2tg_jax.training import History, System
from a2tg_jax.training.fitting import BACKGROUNDS
from a2tg_jax.training.start import new_appearance


def check_init(file: Path, out: Path, system: System) -> Model:
    """Return the splats of a file that can take the place of the first stage of a run. What the stage cannot take over
    is warned of.

    Args:
      file: of any format that `load_splats` reads; plain splats in the original world of the photographs, or a model.
      out: the run folder.
      system: the system that continues with them.

    Raises:
      ValueError: if there is no such file, the folder holds a run, or the splats exceed the system's memory budget.
    """
    if not is_regular(file):
        raise ValueError(f"init: there is no file {file}")
    format_of(file)
    if RunFolder(out).is_begun:
        raise ValueError(f"init begins a new run, and {out} holds one: choose another --out")
    splats, degree = load_splats(file), system.initial_sh_degree
    needed, budget = splats.num * system.initial_bytes, system.budget_bytes
    if budget is not None and needed > budget:
        raise ValueError(
            f"init: {file} holds {splats.num:,} Gaussians, {in_bytes(needed)} at degree {degree}, which is more than "
            f"the memory_budget of {in_bytes(budget)}: raise it, or leave it out"
        )
    shown, lost = splats.appearance, []
    if shown.exponents is not None and not _are_shapes_taken(splats, system.stages()[0].appearance):
        lost.append("the shapes of its kernels (the nearest Gaussians take their place)")
    if not shown.is_portable or shown.texture is not None:
        lost.append("what its splats show besides " + ("kernels" if shown.exponents is not None else "Gaussians"))
    if splats.sh.shape[1] > NUM_BASES[degree]:
        lost.append(f"its spherical harmonics above degree {degree}")
    if lost:
        warnings.warn(f"--init {file} leaves out {' and '.join(lost)}", stacklevel=2)
    return splats


def write_first_stage(run: RunFolder, record: RunRecord, splats: Model, scene: Scene) -> None:
    """Write splats as the model of the first stage of the main system, in the scene's normalised world, with an empty
    history."""
    plan = record.plan
    planned = plan[plan.main[0]]
    splats, appearance, system = splats.live, planned.stage.appearance, planned.system
    shapes = splats.appearance.shapes if _are_shapes_taken(splats, appearance) else None
    to_scene = scene.transform if splats.origin is None else splats.origin.transform.inverse().then(scene.transform)
    gaussians = transform_gaussians(plain_gaussians(splats, keeps_shapes=shapes is not None), to_scene)
    gaussians = _of_degree(gaussians, system.initial_sh_degree)
    appearance = new_appearance(appearance, gaussians, system)
    if shapes is not None:
        appearance = appearance.with_shapes(shapes)
    model = Model(gaussians, appearance, background=BACKGROUNDS[system.background], origin=origin_of_scene(scene))
    save_model(run.own(run.model(planned.name)), model, {"init": record.init})
    write_history(run.own(run.history(planned.name)), History.empty())


def _are_shapes_taken(splats: Model, appearance: Appearance) -> bool:
    """Return whether splats have shapes of kernels that a stage with this appearance takes over."""
    return splats.appearance.exponents is not None and appearance.exponents is not None


def _of_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """Return Gaussians with spherical harmonics of a degree, cut off or filled with zeros."""
    sh = np.zeros((gaussians.num, NUM_BASES[degree], 3), np.float32)
    num = min(sh.shape[1], gaussians.sh.shape[1])
    sh[:, :num] = np.asarray(gaussians.sh)[:, :num]
    return dataclasses.replace(gaussians, sh=jnp.asarray(sh))
