"""Grids: methods, scenes and numbers of Gaussians of an experiment, read from files in `grids/`.

A cell is a scene with a number of Gaussians, a seed, and lengths of the stages. Every method of the experiment is one
run in it. A method has the cell's number of splats, or, `at_equal_bytes`, as many as fit into the final bytes of the
cell's reference, which are known once that is trained.
"""

import dataclasses
import itertools
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import a2tg_jax as a2tg
from a2tg_jax.core.budget import BYTES_PER_FLOAT
from a2tg_jax.io.config_json import merged
from a2tg_jax.training.registry import with_changes
from lab.jobs import Job, Record

GRIDS = Path(__file__).resolve().parents[1] / "grids"


@dataclasses.dataclass(frozen=True)
class Method:
    """A system with a name for tables."""

    label: str
    system: str
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict, hash=False)
    floats: int | None = None
    """Floats of a splat; needed for a given number of bytes."""
    most: int | None = None
    """Largest number of Gaussians of the cells that have this method."""


@dataclasses.dataclass(frozen=True)
class SceneAt:
    """A scene at a size."""

    label: str
    """DATASET/NAME, or a name without a data set."""
    path: str
    downscale: int
    held_out: bool = False
    """Mark of a scene on which no choice may be made."""
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict, hash=False)
    """Options of every system, such as its background."""

    @property
    def dataset(self) -> str:
        return self.label.rpartition("/")[0]


@dataclasses.dataclass(frozen=True)
class Cell:
    """Place in which methods are compared."""

    scene: SceneAt
    gaussians: int
    """Number of Gaussians; 0 if there is a budget."""
    seed: int
    iterations: tuple[int, int]
    budget: float | None = None
    """Bytes that every method fills, in MB (10^6 bytes)."""


@dataclasses.dataclass(frozen=True)
class Run:
    """One method in one cell."""

    method: Method
    cell: Cell
    is_at_equal_bytes: bool
    job: Job
    """Job of its last stage."""


@dataclasses.dataclass(frozen=True)
class Grid:
    """All the runs of an experiment at a scale."""

    name: str
    title: str
    scale: str
    preset: str
    cells: tuple[Cell, ...]
    reference: Method
    methods: tuple[Method, ...]
    """Methods at the cell's number of Gaussians."""
    at_equal_bytes: tuple[Method, ...]
    """Methods at the final bytes of the reference."""
    validation: bool = False
    """Whether validation views are held out in place of the test views."""

    def runs(self, records: Mapping[str, Record]) -> Iterator[Run]:
        """Yield every run that can be named already, in the order of the cells."""
        for cell in self.cells:
            for method in dict.fromkeys((self.reference, *self.methods)):
                if method.most is not None and cell.gaussians > method.most:
                    continue
                yield Run(method, cell, False, self._job(method, cell, cell.gaussians))
            reference = self.reference_record(cell, records)
            for method in self.at_equal_bytes if reference else ():
                num = splats_in(reference["mb"], method)
                yield Run(method, cell, True, self._job(method, cell, num))

    def reference_record(self, cell: Cell, records: Mapping[str, Record]) -> Record | None:
        """Return the record of the reference in a cell, or None before it is finished."""
        return records.get(self._job(self.reference, cell, cell.gaussians).key)

    def jobs(self, records: Mapping[str, Record]) -> Iterator[Job]:
        """Return the last job of every run."""
        return (run.job for run in self.runs(records))

    def _job(self, method: Method, cell: Cell, num: int) -> Job:
        first, second = cell.iterations
        system = type(a2tg.find_system(method.system)).preset(self.preset)
        size = {"densify": {"cap": num}} if cell.budget is None else {"memory_budget": cell.budget}
        basis = {"seed": cell.seed, **size, "stage1_iterations": first, "stage2_iterations": second}
        for changes in (basis, cell.scene.options, method.options):
            system = with_changes(system, changes, f"{self.name}: {method.label}")
        return Job(cell.scene.path, cell.scene.downscale, system, len(system.stages()) - 1, self.validation)


def splats_in(mb: float, method: Method) -> int:
    """Return how many splats of a method fit into so many MB (10^6 bytes).

    Raises:
      ValueError: if the floats of its splats are not known.
    """
    if method.floats is None:
        raise ValueError(f"{method.label}: its splats differ in size: a number of bytes does not say how many they are")
    return int(round(1e6 * mb) // (BYTES_PER_FLOAT * method.floats))


def own_scene(path: Path, downscale: int) -> SceneAt:
    """Return a scene of one's own by the path of its folder.

    Raises:
      ValueError: if there is no such folder, or the downscale is not a whole number of at least 1.
    """
    if not path.is_dir():
        raise ValueError(f"there is no scene folder {path}")
    if downscale < 1:
        raise ValueError(f"--downscale must be at least 1; got {downscale}")
    return SceneAt(path.resolve().name, path.resolve().as_posix(), downscale)


def read_grid(
    name: str,
    scale: str,
    *,
    scenes: Sequence[str] | None = None,
    held_out: bool = True,
    own: Sequence[SceneAt] = (),
    validation: bool = False,
) -> Grid:
    """Read an experiment's grid at a scale from `grids/NAME.toml`.

    Args:
      scenes: labels of the wanted scenes; None for those that the file, or else the scale, names.
      held_out: whether held-out scenes count.
      own: scenes that take the place of all these; empty for none.
      validation: whether validation views are held out in place of the test views.

    Raises:
      ValueError: if the file lacks the scale, or a scene or method is unknown.
    """
    file, everywhere = _read(name), _read("scales")
    if scale not in file:
        raise ValueError(f"grids/{name}.toml has no table [{scale}]")
    settings = {**everywhere[scale], **file[scale]}
    methods = _methods({**_read("methods"), **file.get("variants", {})})

    def method(label: str) -> Method:
        if label not in methods:
            raise ValueError(f"grids/{name}.toml: there is no method {label!r}; there are {', '.join(methods)}")
        return methods[label]

    def methods_in(key: str) -> tuple[Method, ...]:
        """Return the methods of an entry of the scale, or else of the file."""
        return tuple(map(method, file[scale].get(key, file.get(key, []))))

    blocks = [{**settings, **block} for block in settings.get("blocks", [{}])]
    cells = [cell for block in blocks for cell in _cells(block, own or _scenes(block, scenes, held_out, name))]
    if not cells:
        raise ValueError(f"grids/{name}.toml: no scene is left")
    return Grid(
        name, file["title"], scale, settings["preset"], tuple(dict.fromkeys(cells)), method(file["reference"]),
        (*methods_in("methods"), *methods_in("variants")), methods_in("at_equal_bytes"),
        validation,
    )  # fmt: skip


def _methods(table: Mapping[str, Mapping[str, Any]]) -> dict[str, Method]:
    """Return methods by label; one that is `like` another inherits its system and options."""
    methods: dict[str, Method] = {}
    for label, values in table.items():
        own = dict(values)
        base = methods[own.pop("like")] if "like" in own else None
        if base is not None:
            own = {"system": base.system, **own, "options": merged(base.options, own.get("options", {}))}
        methods[label] = Method(label, **own)
    return methods


def _cells(block: Mapping, scenes: Sequence[SceneAt]) -> list[Cell]:
    """Return a cell for every number of Gaussians or budget, every seed and every scene of a block."""
    first, second = block["iterations"]
    sizes = (
        [(0, budget) for budget in block["budgets"]] if "budgets" in block else [(n, None) for n in block["gaussians"]]
    )
    pairs = itertools.product(sizes, block["seeds"], scenes)
    return [Cell(scene, num, seed, (first, second), budget) for (num, budget), seed, scene in pairs]


def _read(name: str) -> dict[str, Any]:
    return tomllib.loads((GRIDS / f"{name}.toml").read_text(encoding="utf-8"))


def _scenes(block: Mapping, wanted: Sequence[str] | None, held_out: bool, name: str) -> list[SceneAt]:
    """Return the scenes of a block, or the wanted ones, at the block's downscale if it has one."""
    table = block["scenes"]
    for label in wanted or ():
        if label not in table:
            raise ValueError(f"{name}: there is no scene {label!r} at this scale; there are {', '.join(table)}")
    labels = block.get("only", table) if wanted is None else wanted
    found = [SceneAt(label, **table[label]) for label in labels]
    found = [dataclasses.replace(scene, downscale=block.get("downscale", scene.downscale)) for scene in found]
    return [scene for scene in found if held_out or not scene.held_out]
