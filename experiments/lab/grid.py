"""Grids: methods, scenes and numbers of Gaussians of an experiment, read from files in `grids/`.

A cell is a scene with a number of Gaussians, a seed, and lengths of the stages. Every method of the experiment is one
run in it. A method has the cell's number of Gaussians, or, `at_equal_bytes`, as many as fit into the final bytes of the
cell's reference, which are known once that is trained; a method whose Gaussians differ in size has them as its budget.
"""

import dataclasses
import functools
import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import a2tg_jax as a2tg
from a2tg_jax.base.config_json import changed_config, merged
from a2tg_jax.base.json_text import read_json, read_toml
from a2tg_jax.base.text import MEGABYTE, did_you_mean
from a2tg_jax.core.budget import BYTES_PER_FLOAT
from lab.grid_file import (
    GRIDS,
    SIZES,
    SUFFIX,
    GridFile,
    MethodTable,
    Scale,
    blocks_of,
    method_tables,
    read_grid_file,
    shared_scale,
)
from lab.jobs import Job, Record
from lab.scenes import SceneAt, chosen_scenes, read_scenes

REHEARSAL = 100
"""Factor by which a rehearsal is shorter."""


@dataclasses.dataclass(frozen=True)
class Method:
    """A system with a name for tables."""

    label: str
    system: str
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict, hash=False)
    floats: int | None = None
    """Floats of a Gaussian; None if Gaussians differ in size, so that the system must take a memory budget."""
    most: int | None = None
    """Largest number of Gaussians of the cells that have this method."""
    by_number: bool = False
    """Whether bytes are given as a number of Gaussians, `floats` being about those of a Gaussian with its texture."""
    choices: Mapping[str, "Method"] | None = dataclasses.field(default=None, hash=False)
    """Methods by scene, of which the method is the one of its scene."""

    def is_chosen_for(self, scene: SceneAt) -> bool:
        """Return whether it is a method for a scene, which one that is chosen for each scene may not be yet."""
        return self.choices is None or scene.label in self.choices


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

    @property
    def size(self) -> str:
        """Number of Gaussians, or budget, for tables."""
        return f"{self.gaussians:,}" if self.budget is None else f"{self.budget:g} MB"


@dataclasses.dataclass(frozen=True)
class Run:
    """One method in one cell."""

    method: Method
    cell: Cell
    equal: str
    """What the run shares with the reference beyond the cell: "", "bytes" (its final ones) or "time"."""
    job: Job
    """Job of its last stage."""

    @property
    def label(self) -> str:
        """Label of the method, unique within its cell."""
        return f"{self.method.label}, equal {self.equal}" if self.equal else self.method.label


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
    at_equal_time: tuple[Method, ...] = ()
    """Methods with as many iterations as take the time of the reference."""
    validation: bool = False
    """Whether validation views are held out in place of the test views."""
    table: str = "quality"
    """Kind of its tables."""

    def check_choices(self) -> None:
        """Raise ValueError if a method is to be chosen for each scene and one has no choice."""
        for cell, method in itertools.product(self.cells, (self.reference, *self.methods)):
            if not method.is_chosen_for(cell.scene):
                place = f"{self.name}{SUFFIX}: {method.label!r}"
                raise ValueError(f"{place} has no choice for {cell.scene.label!r}: run choose_plain --validation first")

    def runs(self, records: Mapping[str, Record]) -> Iterator[Run]:
        """Yield every run that can be named already, in the order of the cells."""
        for cell in self.cells:
            for method in dict.fromkeys((self.reference, *self.methods)):
                if (method.most is not None and cell.gaussians > method.most) or not method.is_chosen_for(cell.scene):
                    continue
                yield Run(method, cell, "", self._job(method, cell))
            reference = self.reference_job(cell)
            record = records.get(reference.key)
            for method in self.at_equal_bytes if record else ():
                yield Run(method, cell, "bytes", self._job_in(method, cell, record["mb"]))
            wanted = seconds_of(reference, records)
            for method in self.at_equal_time if wanted else ():
                if not method.is_chosen_for(cell.scene):
                    continue
                taken = seconds_of(self._job(method, cell), records)
                if taken:
                    first, second = (max(1, round(count * wanted / taken)) for count in cell.iterations)
                    longer = dataclasses.replace(cell, iterations=(first, second))
                    yield Run(method, cell, "time", self._job(method, longer))

    def reference_job(self, cell: Cell) -> Job:
        """Return the last job of the reference in a cell."""
        return self._job(self.reference, cell)

    def jobs(self, records: Mapping[str, Record]) -> Iterator[Job]:
        """Return the last job of every run."""
        return (run.job for run in self.runs(records))

    def _job_in(self, method: Method, cell: Cell, mb: float) -> Job:
        """Return the job of a method in so many MB: a budget, which growth fills, or the Gaussians that fit."""
        if method.floats is None or cell.budget is not None:
            return self._job(method, dataclasses.replace(cell, budget=mb))
        return self._job(method, dataclasses.replace(cell, budget=None, gaussians=splats_in(mb, method)))

    def _job(self, method: Method, cell: Cell) -> Job:
        scene = cell.scene
        place = f"{self.name}{SUFFIX}: {method.label!r}"
        if method.choices is not None:
            method = method.choices[scene.label]
        if method.by_number and cell.budget is not None:
            cell = dataclasses.replace(cell, budget=None, gaussians=splats_in(cell.budget, method))
        system = _system(place, self.preset, method, cell)
        return Job(
            scene.path, scene.downscale, system, len(system.stages()) - 1, validation=self.validation, fold=scene.fold,
            random_start=scene.random_start,
        )  # fmt: skip


@functools.lru_cache(maxsize=10_000)
def _system(place: str, preset: str, method: Method, cell: Cell) -> a2tg.System:
    """Return the system of a method in a cell."""
    first, second = cell.iterations
    system = type(a2tg.find_system(method.system)).preset(preset)
    size = {"densify": {"cap": cell.gaussians}} if cell.budget is None else {"memory_budget": cell.budget}
    basis = {"seed": cell.seed, **size, "stage1_iterations": first, "stage2_iterations": second}
    wording = {"": basis, f" options on {cell.scene.label!r}": cell.scene.options, " options": method.options}
    for part, changes in wording.items():
        system = changed_config(system, changes, f"{place}{part}")
    return system


def seconds_of(job: Job, records: Mapping[str, Record]) -> float | None:
    """Return the training time of all stages up to a job; None if one has not been timed.

    Records from before E6 have the time of their steps, without what happens between them.
    """
    total = 0.0
    for stage in job.chain:
        record = records.get(stage.key, {})
        seconds = record.get("training_seconds", record.get("step_seconds"))
        if seconds is None:
            return None
        total += seconds
    return total


def splats_in(mb: float, method: Method) -> int:
    """Return how many Gaussians of a method fit into so many MB (10^6 bytes).

    Raises:
      ValueError: if the floats of its Gaussians are not known.
    """
    if method.floats is None:
        raise ValueError(f"{method.label}: its Gaussians differ in size, so that a number of bytes does not fix theirs")
    return int(round(1e6 * mb) // (BYTES_PER_FLOAT * method.floats))


def read_grid(
    name: str,
    scale: str,
    *,
    scenes: Sequence[str] | None = None,
    own: Sequence[SceneAt] = (),
    validation: bool = False,
    rehearsal: bool = False,
) -> Grid:
    """Read an experiment's grid at a scale from `grids/NAME.toml`, or from a file of one's own.

    Args:
      name: name of a grid, or the path of a file that ends in .toml.
      scenes: labels of the wanted scenes; None for those that the file, or else the scale, names.
      own: scenes that take the place of all these; empty for none.
      validation: whether validation views are held out in place of the test views.
      rehearsal: whether only the first cell is run, at a hundredth of the iterations.

    Raises:
      ValueError: if the file lacks the scale or has a mistake, or a scene or a method is unknown.
    """
    path = grid_path(name)
    file = read_grid_file(path)
    place = path.name
    own_table = file.scale(scale, place)
    settings, known_scenes = _settings(own_table, scale, path)
    methods = _methods(file, place)

    def methods_in(key: str) -> tuple[Method, ...]:
        """Return the methods of an entry of the scale, or else of the file."""
        labels = getattr(own_table, key)
        return tuple(_found(label, methods, place) for label in (getattr(file, key) if labels is None else labels))

    reference = _found(file.reference, methods, place)
    others = dict.fromkeys((*methods_in("methods"), *methods_in("variants")))
    others.pop(reference, None)
    cells = [
        cell
        for block in blocks_of(settings, f"{place}: {scale}")
        for cell in _cells(block, own or chosen_scenes(known_scenes, block, scenes, place), place)
    ]
    if not cells:
        raise ValueError(f"{place}: no scene is left")
    if rehearsal:
        cells = [_shortened(cells[0])]
    return Grid(
        path.stem, file.title, scale, settings.preset, tuple(dict.fromkeys(cells)), reference, tuple(others),
        methods_in("at_equal_bytes"), methods_in("at_equal_time"), validation, file.table,
    )  # fmt: skip


def has_scale(name: str, scale: str) -> bool:
    """Return whether a grid has a scale."""
    return scale in read_grid_file(grid_path(name)).scales


def grid_path(name: str) -> Path:
    """Return the file of a grid by its name or path."""
    return Path(name).expanduser() if name.endswith(SUFFIX) else GRIDS / f"{name}{SUFFIX}"


def _settings(own: Scale, scale: str, path: Path) -> tuple[Scale, dict[str, SceneAt]]:
    """Return the settings of a grid at a scale, and its scenes; scenes of its own take the place of the scale's."""
    shared = shared_scale(scale)
    if own.scenes is None:
        return shared.changed(own), read_scenes(shared.scenes, f"scales.toml: {scale}.scenes", None)
    everywhere = dataclasses.replace(shared, only=None)
    return everywhere.changed(own), read_scenes(own.scenes, f"{path.name}: {scale}.scenes", path.parent)


def _methods(file: GridFile, place: str) -> dict[str, Method]:
    """Return all methods by label; one that is `like` another inherits its system and options."""
    tables = method_tables(read_toml(GRIDS / "methods.toml"), "methods.toml: ")
    tables |= method_tables(file.variants, f"{place}: variants.")
    methods: dict[str, Method] = {}
    for label, table in tables.items():
        base = None
        if table.like is not None:
            missing = f"{label!r} is like {table.like!r}, which is no method above it"
            base = _found(table.like, methods, place, missing)
        methods[label] = _method(label, table, base, place)
        if table.chosen_in is not None:
            path = GRIDS / table.chosen_in
            choices = read_json(path) if path.is_file() else {}
            found = {scene: _found(choice, methods, path.name) for scene, choice in choices.items()}
            methods[label] = dataclasses.replace(methods[label], choices=found)
    return methods


def _method(label: str, table: MethodTable, base: Method | None, place: str) -> Method:
    system = table.system
    options = table.options
    if base is not None:
        system = system or base.system
        options = merged(base.options, options)
    if system is None:
        raise ValueError(f"{place}: method {label!r} has neither a system nor a method that it is like")
    return Method(label, system, options, table.floats, table.most, table.by_number)


def _found(label: str, methods: Mapping[str, Method], place: str, missing: str | None = None) -> Method:
    """Return a method by its label; `missing` is the error's text in place of the usual one."""
    if label not in methods:
        hint = did_you_mean(label, methods) or f"; there are {', '.join(methods)}"
        raise ValueError(f"{place}: {missing or f'there is no method {label!r}'}{hint}")
    return methods[label]


def _cells(block: Scale, scenes: Sequence[SceneAt], place: str) -> list[Cell]:
    """Return a cell for every number of Gaussians or budget, every seed and every scene of a block."""
    if all(getattr(block, name) is None for name in SIZES):
        raise ValueError(f"{place}: a scale needs {', '.join(SIZES[:-1])} or {SIZES[-1]}")
    sizes = [(name, value) for name in SIZES for value in getattr(block, name) or ()]
    cells = []
    for (kind, value), seed, scene, fold in itertools.product(sizes, block.seeds, scenes, block.folds or (None,)):
        num, budget = (value, None) if kind == "gaussians" else (0, value)
        if kind == "bytes_per_pixel":
            budget = value * scene.num_pixels / MEGABYTE
        cells.append(Cell(dataclasses.replace(scene, fold=fold), num, seed, block.iterations, budget))
    return cells


def _shortened(cell: Cell) -> Cell:
    """Return a cell at a hundredth of its iterations."""
    first, second = cell.iterations
    return dataclasses.replace(cell, iterations=(max(1, first // REHEARSAL), second // REHEARSAL))
