"""Record of a run: scene, system with all its options, systems to compare.

It is kept as run.toml. A configuration file has the same keys; missing ones have the command line's defaults:

    scene = "../scenes/fox"              # relative to the file's folder; or built in: "cells"
    downscale = 2
    system = "a2tg"                      # or package.module:NAME
    preset = "quick"
    compare = ["gaussians-2d-mcmc"]

    [options.texture]                    # options of the system, as nested tables
    cap = 8

    [compare_options.gaussians-2d-mcmc]  # options of a compared system, instead of the main one's
    sh_degree = 0

    [shortened_at]                       # iterations from which stages are shortened, because you finished them early
    gaussians = 1200

In a file with `version`, as a run's has, missing options are as in the preset "paper": it has all of its version's.
"""

import dataclasses
import os
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import tomli_w

from a2tg_jax import Bytewise, System, find_system, like
from a2tg_jax.base.atomic import write_whole
from a2tg_jax.base.config_json import changed_config, config_from_dict, config_to_dict, flatten_config, merged
from a2tg_jax.base.json_text import read_toml
from a2tg_jax.base.regular_files import expanded, is_regular
from a2tg_jax.base.text import MEGABYTE, budget_in_bytes, did_you_mean, megabytes_of, shortened
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.data.load import SceneSource
from a2tg_jax.io.model_rows import check_encodable
from a2tg_jax.results.commands import repeating_command
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.plan import RunPlan, plan_run
from a2tg_jax.training.options import own_options

DEFAULT_SYSTEM = "bytewise"
LONGEST_REASON = 500
MEMORY_OF_FILE = 7.0
"""Bytes of a model for each byte of a compact file with tuned numbers."""
OnNan = Literal["stop", "restore"]
"""Action on divergence: end with an error, or restore the newest checkpoint and reorder the views."""
PLAIN = ("gaussians-2d", "gaussians-2d-mcmc")
"""Systems without textures, which are baselines of the others."""


@dataclasses.dataclass(frozen=True)
class RunRecord:
    """Scene, system and options of a run: what `a2tg train` parses, and what run.toml keeps."""

    scene: SceneSource
    system: str = DEFAULT_SYSTEM
    """System to train: a name listed by a2tg --help, or your own as package.module:NAME. Its options follow below."""
    options: System = dataclasses.field(default_factory=Bytewise)
    compare: tuple[str, ...] = ()
    """System to train for comparison; may be repeated. It takes every option above and below that it has."""
    preset: str | None = None
    """Preset of the options below: paper, quick (minutes on two cores) or smoke (half a minute); a2tg also has official
    (the conventions of the authors' program), gaussians-2d also has surfaces (for a2tg mesh)."""
    on_nan: OnNan = "stop"
    """Action if training diverges (a loss or gradient is not finite, or the loss explodes): stop, or restore the newest
    checkpoint and continue with the views in another order."""
    init: str | None = None
    """File of splats (PLY, SPZ, SOG, a model of this program, ...) instead of the first stage, in the world of the
    scene folder."""
    file_budget: float | str | None = None
    """Largest size of a compact file (*.a2tgz), such as 60kB. It is written when training is over, as by a2tg compress
    --tune-iterations 1000. Without a memory_budget the model gets 7 times as many bytes in memory."""
    compare_options: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict, compare=False)
    """Options of the compared systems, nested, by name. Missing ones take the main system's values, or the preset's if
    it lacks them. run.toml keeps all those that the main system lacks."""

    shortened_at: Mapping[str, int] = dataclasses.field(default_factory=dict, compare=False)
    """Iterations from which stages are shortened (`Session.is_shortened`), by the stage's name; run.toml keeps them."""

    def __post_init__(self) -> None:
        """Convert the file budget to a number of MB."""
        object.__setattr__(self, "file_budget", megabytes_of(self.file_budget, "file_budget"))

    @property
    def systems(self) -> dict[str, System]:
        """Main system and then the compared ones, by label. Raises ValueError if a system is not found, two have the
        same label, or a compared one's option is invalid."""
        systems = {label_of(self.system): self.options}
        for name in self.compare:
            label = label_of(name)
            if label in systems:
                raise ValueError(f"compare: two systems of the run would be called {shortened(label)!r}")
            usual = compared_system(name, self.options, self.preset)
            systems[label] = changed_config(usual, self.compare_options.get(name, {}), f"compare_options.{name}")
        return systems

    @property
    def plan(self) -> RunPlan:
        """Plan of the stages to train."""
        return plan_run(self.systems)

    def check(self) -> None:
        """Raise ValueError if the run cannot be trained, naming the option."""
        # The table of a system that is not compared would have no effect.
        for name in self.compare_options:
            if name not in self.compare:
                reason = f"compare_options.{shortened(name)}: the run does not compare this system"
                raise ValueError(f"{reason}: add it to compare, or remove the table")
        for label, system in self.systems.items():
            try:
                system.check()
            except ValueError as error:
                if system is self.options:
                    raise
                raise ValueError(f"compare {label}, with the options of {self.system}: {error}") from error
        if self.file_budget is not None:
            check_encodable(self.options.stages()[-1].appearance, "the file of file_budget", "leave it out")
        if self.init is not None and len(self.plan.main) < 2:
            raise ValueError(f"init replaces a first stage, and {self.system} has no second one")
        for name, iteration in self.shortened_at.items():
            plan = self.plan
            if name not in plan.names or not 0 <= iteration <= plan[name].stage.iterations:
                raise ValueError(
                    f"shortened_at.{shortened(name)} must be an iteration of a stage of the run "
                    f"({', '.join(plan.names)}); got {iteration}: remove it to train the stage as planned"
                )

    @property
    def file_bytes(self) -> int | None:
        """File budget in bytes; None without one."""
        return budget_in_bytes(self.file_budget, "file_budget")

    def budgeted(self) -> "RunRecord":
        """Return the record with the memory budget that goes with its file budget, unless it has another."""
        if self.file_bytes is None or self.options.memory_budget is not None:
            return self
        return self.with_options(memory_budget=round(MEMORY_OF_FILE * self.file_bytes) / MEGABYTE)

    def unbudgeted(self) -> "RunRecord":
        """Return the record without the memory budget that `budgeted` adds."""
        plain = self.with_options(memory_budget=None)
        return plain if plain.budgeted() == self else self

    def shortened_from(self, name: str, iteration: int) -> "RunRecord":
        """Return the record in which a stage is shortened from an iteration on, and all later ones from their start."""
        names = self.plan.names
        later = dict.fromkeys(names[names.index(name) + 1 :], 0)
        return dataclasses.replace(self, shortened_at={**self.shortened_at, name: iteration, **later})

    def with_options(self, **changes: Any) -> "RunRecord":
        """Return the record with some options changed."""
        return dataclasses.replace(self, options=dataclasses.replace(self.options, **changes))

    def placed(self, folder: Path = Path()) -> "RunRecord":
        """Return the record with full paths; relative ones start from a folder. Warns if a folder has the name of a
        built-in scene. Raises as `scene_place`."""
        path = self.scene.path
        if self.scene.is_built_in and (folder / path).exists():
            warn(f"{path} is the built-in scene; give ./{path} for the folder of that name")
        if path and not self.scene.is_built_in:
            path = scene_place(path, folder)
        init = None if self.init is None else scene_place(self.init, folder)
        return dataclasses.replace(self, scene=dataclasses.replace(self.scene, path=path), init=init)

    def with_system(self, name: str, preset: str | None) -> "RunRecord":
        """Return the record with another system or preset. Raises ValueError if there is no such system or preset."""
        options = chosen_system(name, preset)
        return dataclasses.replace(self, system=name, preset=preset, options=options, compare_options={})


SCENE_KEYS = {"scene": "path"} | {field.name: field.name for field in dataclasses.fields(SceneSource)[1:]}
"""Names of the fields of a scene's source by their keys in run.toml."""
KEYS = (*SCENE_KEYS, *(field.name for field in dataclasses.fields(RunRecord)[1:]), "version")


def label_of(name: str) -> str:
    """Return the label of a system in a run: its name, or NAME of package.module:NAME."""
    return name.rpartition(":")[2].replace(".", "-")


def chosen_system(name: str, preset: str | None = None) -> System:
    """Return a system by name, with the options of a preset. Options set by an instance take precedence.
    Raises ValueError if there is no such system or preset."""
    system = find_system(name)
    if preset is None:
        return system
    kind = type(system)
    return changed_config(kind.preset(preset), own_options(system, kind()), name)


def compared_system(name: str, other: System, preset: str | None = None) -> System:
    """Return a system by name, with another's options where names match and its own preset's otherwise, if it has that
    preset. Plain Gaussians take the degree that the other starts from: with degree 0 they are strongest in the bytes of
    `bytewise`. Options set by an instance take precedence. Raises ValueError if there is no such system."""
    system = find_system(name)
    kind = type(system)
    usual = kind() if preset is None else kind.presets().get(preset, kind())
    alike = like(usual, other)
    if name in PLAIN:
        alike = dataclasses.replace(alike, sh_degree=other.initial_sh_degree)
    return changed_config(alike, own_options(system, kind()), name)


def scene_place(scene: str, folder: Path = Path()) -> str:
    """Return the place of a scene as in run.toml: a full path without links. Relative paths start from a folder.
    Raises ValueError for a URL."""
    # Unlike Path.resolve, realpath accepts circular links.
    return os.path.realpath(folder / expanded(scene))


def read_run_file(path: Path) -> RunRecord:
    """Read a configuration file, which may lack the scene. Relative paths in it start from its folder. Raises
    FileNotFoundError if there is no such file, and ValueError, naming file and key, if it is not TOML, or a key is
    unknown or of another type."""
    if not is_regular(path):
        raise FileNotFoundError(f"{path}: no such configuration file")
    where = f"{path}:"
    table = read_toml(path)
    for key in table:
        if key not in KEYS:
            raise ValueError(f"{where} {shortened(key)} is an unknown key{did_you_mean(key, KEYS)}")
    if not isinstance(table.get("scene", ""), str):
        raise ValueError(f"{where} scene must be str; got {shortened(table['scene'])}")
    # Errors name the version that reads the file, not this one.
    is_of_run = table.pop("version", None) is not None
    source = {name: table.pop(key) for key, name in SCENE_KEYS.items() if key in table}
    scene = config_from_dict(SceneSource, source, where)
    # The options' class depends on system and preset, so they are read last.
    options = table.pop("options", {})
    record = config_from_dict(RunRecord, table, where, given={"scene": scene, "options": Bytewise()})
    _check_table("options", options, where)
    for name, given in record.compare_options.items():
        _check_table(f"compare_options.{name}", given, where)
    start = chosen_system(record.system, record.preset)
    compared = dict(record.compare_options)
    if is_of_run:
        # A run's file has every option but None. Presets may have other values since, so that what is missing is as in
        # the preset "paper", where options of later versions change nothing.
        start = chosen_system(record.system)
    system = changed_config(start, options, f"{path}: options")
    if is_of_run:
        for name in record.compare:
            usual = own_options(compared_system(name, system), system)
            compared[name] = merged(usual, compared.get(name, {}))
    return dataclasses.replace(record, options=system, compare_options=compared).placed(path.parent)


def _check_table(key: str, value: object, where: str) -> None:
    if not isinstance(value, Mapping):
        raise ValueError(f"{where} {shortened(key)} must be a table of options; got {shortened(value)}")


def write_record(run: RunFolder, record: RunRecord) -> None:
    """Write run.toml with every option, so that later versions with other defaults repeat the same run."""
    scene = config_to_dict(record.scene)
    table: dict[str, Any] = {key: scene[name] for key, name in SCENE_KEYS.items()}
    for name in ("system", "preset", "compare", "on_nan", "init", "file_budget"):
        value = getattr(record, name)
        if value is not None:
            table[name] = value
    table["version"] = version("a2tg-jax")
    options = config_to_dict(record.unbudgeted().options)
    table["options"] = _without_none(options, config_to_dict(chosen_system(record.system)))
    compared = {}
    for name in record.compare:
        # Options that are not taken from the main system, and given ones.
        kept = own_options(record.systems[label_of(name)], record.options)
        kept = merged(kept, record.compare_options.get(name, {}))
        compared[name] = _without_none(kept, config_to_dict(compared_system(name, record.options)))
    if compared:
        table["compare_options"] = compared
    if record.shortened_at:
        table["shortened_at"] = dict(record.shortened_at)
    text = f"# Repeats the run: {repeating_command(run)}\n"
    caps = record.options.caps()
    if caps and record.options.memory_budget is not None:
        text += f"# options.memory_budget decides instead of {', '.join(f'options.{name}' for name in caps)}\n"
    write_whole(run.own(run.record), text + tomli_w.dumps(table))


def _without_none(table: dict[str, Any], usual: dict[str, Any]) -> dict[str, Any]:
    """Drop None, which TOML lacks, but write "None", as on the command line, if the usual value is another."""
    kept: dict[str, Any] = {}
    for name, value in table.items():
        if isinstance(value, dict):
            kept[name] = _without_none(value, usual[name])
        elif value is not None:
            kept[name] = value
        elif usual[name] is not None:
            kept[name] = "None"
    return kept


def read_record(run: RunFolder) -> RunRecord:
    """Read run.toml. The module of a custom system is imported. Raises ValueError if it is damaged or of another
    version, its system is not found, or an option is invalid."""
    try:
        record = read_run_file(run.record).budgeted()
        if not record.scene.path:
            raise ValueError(f"{run.record}: scene is missing")
        record.check()
        return record
    except ValueError as error:
        reason = str(error) if str(run.record) in str(error) else f"{run.record}: {error}"
        other = f" (if another version than a2tg-jax {version('a2tg-jax')} began the run, use that version)"
        raise ValueError(f"{shortened(reason, LONGEST_REASON)}{other}") from error


def contradictions(wanted: RunRecord, kept: RunRecord) -> list[str]:
    """Return the options, named as in run.toml, in which a record differs from the run to resume. The scene's path, the
    systems to compare and `on_nan` may differ."""
    before = _comparable(kept)
    now = _comparable(wanted)
    return [name for name in now if name not in before or before[name] != now[name]]


def _comparable(record: RunRecord) -> dict[str, Any]:
    values = {"system": record.system, "preset": record.preset, "init": record.init}
    values |= flatten_config(record.scene)
    values |= flatten_config(record.options)
    del values["path"]
    return values


def is_finished(run: RunFolder, record: RunRecord) -> bool:
    """Return whether all stages of a run have their models."""
    return all(is_regular(run.model(name)) for name in record.plan.names)
