"""Splats from a file in place of the first stage of a run."""

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from a2tg_jax.appearance import Appearance
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.sh import NUM_BASES
from a2tg_jax.core.transform import transform_gaussians
from a2tg_jax.data import Scene
from a2tg_jax.data.scene import origin_of_scene
from a2tg_jax.io.formats import load_splats
from a2tg_jax.io.model_file import number_in_file, save_model
from a2tg_jax.io.ply import plain_gaussians
from a2tg_jax.model import Model
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.history import write_history
from a2tg_jax.results.plan import PlannedStage
from a2tg_jax.results.record import RunRecord
from a2tg_jax.training import History
from a2tg_jax.training.fitting import BACKGROUNDS
from a2tg_jax.training.start import new_appearance


class GivenSplats:
    """Splats of a file in place of a first stage. The file is read once: for checks, the forecast and that stage."""

    def __init__(self, file: Path):
        """Args:
        file: of any format that `load_splats` reads; plain splats in the original world of the photographs, or a model.
        """
        self.file = file
        self._splats: Model | None = None
        self._is_taken = False

    @property
    def splats(self) -> Model:
        """The splats of the file. Reading them after `taken` is an error."""
        if self._is_taken:
            raise RuntimeError(f"the splats of {self.file} were taken already")
        if self._splats is None:
            self._splats = load_splats(self.file)
        return self._splats

    def taken(self) -> Model:
        """Return the splats, and release them."""
        splats, self._splats, self._is_taken = self.splats, None, True
        return splats


def given_splats(record: RunRecord) -> GivenSplats | None:
    """Return the splats in place of a run's first stage; None if it is trained."""
    return None if record.init is None else GivenSplats(Path(record.init))


def number_given(run: RunFolder, record: RunRecord, given: GivenSplats | None) -> int | None:
    """Return the number of Gaussians in place of the first stage of a run that was begun; None if it is trained.

    Args:
      run, record: the run folder, and its record.
      given: its splats, which are read only if the run has not taken them yet.
    """
    first = run.model(record.plan.main[0])
    if given is None:
        return None
    return number_in_file(first) if first.is_file() else given.splats.num


def write_first_stage(run: RunFolder, planned: PlannedStage, given: GivenSplats, scene: Scene) -> None:
    """Write the splats of a file as the model of a first stage, in the scene's normalised world, without a history.

    Args:
      run: the run folder.
      planned: the first stage of the main system.
      given: the splats, which are released.
      scene: the scene of the run.
    """
    splats, appearance, system = given.taken().live, planned.stage.appearance, planned.system
    shapes = splats.appearance.shapes if are_shapes_taken(splats, appearance) else None
    to_scene = scene.transform if splats.origin is None else splats.origin.transform.inverse().then(scene.transform)
    gaussians = transform_gaussians(plain_gaussians(splats, keeps_shapes=shapes is not None), to_scene)
    gaussians = _of_degree(gaussians, system.initial_sh_degree)
    appearance = new_appearance(appearance, gaussians, system)
    if shapes is not None:
        appearance = appearance.with_shapes(shapes)
    model = Model(gaussians, appearance, background=BACKGROUNDS[system.background], origin=origin_of_scene(scene))
    save_model(run.own(run.model(planned.name)), model, {"init": str(given.file)})
    write_history(run.own(run.history(planned.name)), History.empty())


def are_shapes_taken(splats: Model, appearance: Appearance) -> bool:
    """Return whether splats have shapes of kernels that a stage with this appearance takes over."""
    return splats.appearance.exponents is not None and appearance.exponents is not None


def _of_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """Return Gaussians with spherical harmonics of a degree, cut off or filled with zeros."""
    sh = np.zeros((gaussians.num, NUM_BASES[degree], 3), np.float32)
    num = min(sh.shape[1], gaussians.sh.shape[1])
    sh[:, :num] = np.asarray(gaussians.sh)[:, :num]
    return dataclasses.replace(gaussians, sh=jnp.asarray(sh))
