"""Record of a run (scene, system with all its options, systems to compare), and the plan of its stages.

The record is kept as run.toml. A configuration file has the same keys; missing ones have the command line's defaults:

    scene = "../scenes/fox"              # relative to the file's folder; or s3://bucket/fox, or built in: "cells"
    downscale = 2
    system = "a2tg"                      # or package.module:NAME
    preset = "quick"
    compare = ["gaussians-2d-mcmc"]

    [options.texture]                    # options of the system, as nested tables
    cap = 8

    [compare_options.gaussians-2d-mcmc]  # options of a compared system, instead of the main one's
    sh_degree = 0

In a file with `version`, as a run's has, missing options are as in the preset "paper": it has all of its version's.
"""

import dataclasses
import math
import os
import shlex
import warnings
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import numpy as np
import tomli_w
from tyro.conf import Fixed, Suppress, UseAppendAction, arg

from a2tg_jax.core.budget import MEGABYTE, budget_in_bytes, megabytes_of
from a2tg_jax.data.load import SceneSource
from a2tg_jax.host.atomic import write_whole
from a2tg_jax.host.json_text import MOST_TOML_BYTES, parse_toml, read_json
from a2tg_jax.host.regular_files import expanded, is_regular, read_regular
from a2tg_jax.host.text import did_you_mean, shortened
from a2tg_jax.io.config_json import changed_config, config_from_dict, config_to_dict, flatten_config, merged
from a2tg_jax.io.model_rows import check_encodable
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.systems.bytewise import Bytewise
from a2tg_jax.training import Stage, System, find_system, like
from a2tg_jax.training.options import own_options

DEFAULT_SYSTEM = "bytewise"
LONGEST_REASON = 500
MEMORY_OF_FILE = 7.0
"""Bytes of a model for each byte of a compact file with tuned numbers."""
OnNan = Literal["stop", "restore"]
"""Action on divergence: end with an error, or restore the newest checkpoint and reorder the views."""
LONGEST_WITHOUT_CHECKPOINT = 500
"""Largest number of iterations between checkpoints."""
STAGE_OPTIONS = ("loss", "rates", "memory_budget", "exposure", "refine_poses", "corrections", "more")
"""Options of every system that affect training only through its stages."""


@dataclasses.dataclass(frozen=True)
class RunRecord:
    """Scene, system and options of a run: what `a2tg train` parses, and what run.toml keeps."""

    scene: Annotated[SceneSource, arg(name="")]
    system: Annotated[str, arg(metavar="NAME")] = DEFAULT_SYSTEM
    """System to train: a name listed by a2tg --help, or your own as package.module:NAME. Its options follow below."""
    options: Annotated[System, arg(name="")] = dataclasses.field(default_factory=Bytewise)
    compare: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME")] = ()
    """System to train for comparison; may be repeated. It takes every option above and below that it has."""
    preset: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="(default: paper)")] = None
    """Preset of the options below: paper, quick (minutes on two cores) or smoke (half a minute); a2tg also has official
    (the conventions of the authors' program), gaussians-2d also has surfaces (for a2tg mesh)."""
    on_nan: OnNan = "stop"
    """Action if training diverges (a loss or gradient is not finite, or the loss explodes): stop, or restore the newest
    checkpoint and continue with the views in another order."""
    init: Annotated[str | None, arg(metavar="FILE")] = None
    """File of splats (PLY, SPZ, SOG, a checkpoint of gsplat, ...) instead of the first stage, in the world of the
    scene folder."""
    file_budget: Annotated[float | str | None, arg(metavar="SIZE")] = None
    """Largest size of a compact file (*.a2tgz), such as 60kB. It is written when training is over, as by a2tg compress
    --tune-iterations 1000. Without a memory_budget the model gets 7 times as many bytes in memory."""
    compare_options: Annotated[Mapping[str, Mapping[str, Any]], Fixed, Suppress] = dataclasses.field(
        default_factory=dict, compare=False
    )
    """Options of the compared systems, nested, by name. Missing ones take the main system's values, or the preset's if
    it lacks them. run.toml keeps all those that the main system lacks."""

    def __post_init__(self) -> None:
        """Convert the file budget to a number of MB."""
        object.__setattr__(self, "file_budget", megabytes_of(self.file_budget, "file_budget"))

    @property
    def systems(self) -> dict[str, System]:
        """Main system and then the compared ones, by label. Raises ValueError if a system is not found, two have the
        same label, or a compared one's option is invalid."""
        found = {label_of(self.system): self.options}
        for name in self.compare:
            if label_of(name) in found:
                raise ValueError(f"compare: two systems of the run would be called {shortened(label_of(name))!r}")
            other, given = compared_system(name, self.options, self.preset), self.compare_options.get(name, {})
            found[label_of(name)] = changed_config(other, given, f"compare_options.{name}")
        return found

    @property
    def plan(self) -> "RunPlan":
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

    @property
    def file_bytes(self) -> int | None:
        """File budget in bytes; None without one."""
        return budget_in_bytes(self.file_budget, "file_budget")

    def budgeted(self) -> "RunRecord":
        """Return the record with the memory budget that goes with its file budget, unless it has another."""
        if self.file_bytes is None or self.options.memory_budget is not None:
            return self
        budget = round(MEMORY_OF_FILE * self.file_bytes) / MEGABYTE
        return dataclasses.replace(self, options=dataclasses.replace(self.options, memory_budget=budget))

    def unbudgeted(self) -> "RunRecord":
        """Return the record without the memory budget that `budgeted` adds."""
        plain = dataclasses.replace(self, options=dataclasses.replace(self.options, memory_budget=None))
        return plain if plain.budgeted() == self else self

    def placed(self, folder: Path = Path()) -> "RunRecord":
        """Return the record with full paths; relative ones start from a folder. Warns if a folder has the name of a
        built-in scene. Raises as `scene_place`."""
        path = self.scene.path
        if self.scene.is_built_in and (folder / path).exists():
            warnings.warn(f"{path} is the built-in scene; give ./{path} for the folder of that name", stacklevel=2)
        path = path if path == "" or self.scene.is_built_in else scene_place(path, folder)
        init = None if self.init is None else os.path.realpath(folder / os.path.expanduser(self.init))
        return dataclasses.replace(self, scene=dataclasses.replace(self.scene, path=path), init=init)

    def with_system(self, name: str, preset: str | None) -> "RunRecord":
        """Return the record with another system or preset. Raises ValueError if there is no such system or preset."""
        options = chosen_system(name, preset)
        return dataclasses.replace(self, system=name, preset=preset, options=options, compare_options={})


PLAIN = ("gaussians-2d", "gaussians-2d-mcmc")
"""Systems without textures, which are baselines of the others."""
SCENE_KEYS = {"scene": "path"} | {field.name: field.name for field in dataclasses.fields(SceneSource)[1:]}
"""Names of the fields of a scene's source by their keys in run.toml."""
KEYS = (*SCENE_KEYS, *(field.name for field in dataclasses.fields(RunRecord)[1:]), "version")


def label_of(name: str) -> str:
    """Return the label of a system in a run: its name, or NAME of package.module:NAME."""
    return name.rpartition(":")[2].replace(".", "-")


def chosen_system(name: str, preset: str | None = None) -> System:
    """Return a system by name, with the options of a preset. Options set by an instance take precedence.
    Raises ValueError if there is no such system or preset."""
    found = find_system(name)
    if preset is None:
        return found
    return changed_config(type(found).preset(preset), own_options(found, type(found)()), name)


def compared_system(name: str, other: System, preset: str | None = None) -> System:
    """Return a system by name, with another's options where names match and its own preset's otherwise, if it has that
    preset. Plain Gaussians take the degree that the other starts from: with degree 0 they are strongest in the bytes of
    `bytewise`. Options set by an instance take precedence. Raises ValueError if there is no such system."""
    found = find_system(name)
    kind = type(found)
    system = like(kind() if preset is None else kind.presets().get(preset, kind()), other)
    if name in PLAIN:
        system = dataclasses.replace(system, sh_degree=other.initial_sh_degree)
    return changed_config(system, own_options(found, kind()), name)


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
    data, where = read_regular(path, MOST_TOML_BYTES), f"{path}:"
    try:
        table = parse_toml(data)
    except ValueError as error:
        raise ValueError(f"{path}: is not valid TOML: {shortened(str(error), 200)}") from error
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
    tables = {"options": options, **{f"compare_options.{key}": value for key, value in record.compare_options.items()}}
    for key, value in tables.items():
        if not isinstance(value, Mapping):
            raise ValueError(f"{where} {shortened(key)} must be a table of options; got {shortened(value)}")
    start = chosen_system(record.system, record.preset)
    if not is_of_run:
        system = changed_config(start, options, f"{path}: options")
        return dataclasses.replace(record, options=system).placed(path.parent)
    # A run's file has every option but None. Presets may have other values since, so that what is missing is as in the
    # preset "paper", where options of later versions change nothing.
    system = changed_config(chosen_system(record.system), options, f"{path}: options")
    compared = dict(record.compare_options)
    for name in record.compare:
        own = own_options(compared_system(name, system), system)
        compared[name] = merged(own, compared.get(name, {}))
    return dataclasses.replace(record, options=system, compare_options=compared).placed(path.parent)


def write_record(run: RunFolder, record: RunRecord) -> None:
    """Write run.toml with every option, so that later versions with other defaults repeat the same run."""
    usual, scene, compared = chosen_system(record.system), config_to_dict(record.scene), {}
    for name in record.compare:  # Options not taken from the main system, and given ones.
        start = compared_system(name, record.options)
        own = own_options(record.systems[label_of(name)], record.options)
        compared[name] = _without_none(merged(own, record.compare_options.get(name, {})), config_to_dict(start))
    table = {
        **{key: scene[name] for key, name in SCENE_KEYS.items()},
        "system": record.system,
        **({} if record.preset is None else {"preset": record.preset}),
        "compare": list(record.compare),
        "on_nan": record.on_nan,
        **({} if record.init is None else {"init": record.init}),
        **({} if record.file_budget is None else {"file_budget": record.file_budget}),
        "version": version("a2tg-jax"),
        "options": _without_none(config_to_dict(record.unbudgeted().options), config_to_dict(usual)),
        **({"compare_options": compared} if compared else {}),
    }
    text = f"# Repeats the run: {repeating_command(run)}\n"
    if record.options.memory_budget is not None and (caps := record.options.caps()):
        text += f"# options.memory_budget decides instead of {', '.join(f'options.{name}' for name in caps)}\n"
    write_whole(run.own(run.record), text + tomli_w.dumps(table))


def _without_none(table: dict[str, object], start: dict[str, Any]) -> dict[str, Any]:
    """Drop None, which TOML lacks, but write "None", as on the command line, if `start` has another value."""
    kept: dict[str, Any] = {}
    for name, value in table.items():
        if isinstance(value, dict):
            kept[name] = _without_none(value, start[name])
        elif value is not None or start[name] is not None:
            kept[name] = "None" if value is None else value
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


def contradictions(asked: RunRecord, kept: RunRecord) -> list[str]:
    """Return the options, named as in run.toml, in which a record differs from the run to resume. The scene's path, the
    systems to compare and `on_nan` may differ."""
    before, now = (
        {"system": one.system, "preset": one.preset, "init": one.init, **flatten_config(one.scene)}
        | flatten_config(one.options)
        for one in (kept, asked)
    )
    return [name for name, value in now.items() if name != "path" and (name not in before or before[name] != value)]


def is_finished(run: RunFolder, record: RunRecord) -> bool:
    """Return whether all stages of a run have their models."""
    return all(is_regular(run.model(name)) for name in record.plan.names)


def training_command(run: RunFolder, out: str, *flags: str) -> str:
    """Return the command line that trains with the options of a run, into another folder."""
    return shlex.join(["a2tg", "train", "--config", str(run.record), *flags, "--out", out])


def repeating_command(run: RunFolder) -> str:
    """Return the command line that repeats a run, and its finishing, if any."""
    is_finished, again = is_regular(run.finish), f"{run.path}-again"
    trained = f"{run.path}-trained" if is_finished else again
    training = training_command(run, trained)
    if not is_finished:
        return training
    flags = [f"--{name.replace('_', '-')}={value}" for name, value in config_to_dict(read_finish(run)).items()]
    return f"{training} && {shlex.join(['a2tg', 'finish', trained, '--out', again, *flags])}"


# Finishing


@dataclasses.dataclass(frozen=True)
class FinishOptions:
    """Options of `a2tg finish`, as in a finished run's finish.json."""

    max_loss: float = 0.02
    """Largest loss of PSNR in dB by smaller textures, on training views; 0 leaves textures unchanged."""
    polish_steps: int = 5
    """Steps of least squares, each of which draws every training view; too many overfit these views, and 0 leaves
    colours unchanged."""

    def check(self) -> None:
        """Raise ValueError if a number is out of range."""
        if not 0 <= self.max_loss < math.inf:
            raise ValueError(f"max_loss must be at least 0 dB; got {self.max_loss}")
        if self.polish_steps < 0:
            raise ValueError(f"polish_steps must be at least 0; got {self.polish_steps}")


def read_finish(run: RunFolder) -> FinishOptions:
    """Return the options with which a run was finished. Raises ValueError if finish.json is damaged or of another
    version."""
    data = read_json(run.finish)
    names = [field.name for field in dataclasses.fields(FinishOptions)]
    own = {name: data[name] for name in names if name in data} if isinstance(data, dict) else data
    return config_from_dict(FinishOptions, own, f"{run.finish}:")


# Plan


@dataclasses.dataclass(frozen=True)
class PlannedStage:
    """Stage of a system, shared by all systems with the same beginning."""

    name: str
    """Name of its files, columns and captions, unique in the run."""
    system: System
    """First system that has the stage."""
    index: int
    """Index of the stage in its system, from 0."""
    start: str | None
    """Name of the stage whose model it starts from; None for a first stage."""
    stage: Stage = dataclasses.field(repr=False, compare=False)

    @property
    def checkpoint_every(self) -> int:
        """Number of iterations between its checkpoints."""
        # At least ten in a stage, so that a killed short one loses a tenth at most.
        return max(1, min(LONGEST_WITHOUT_CHECKPOINT, self.stage.iterations // 10))


@dataclasses.dataclass(frozen=True)
class RunPlan:
    """The stages of a run in the order in which they are trained."""

    stages: tuple[PlannedStage, ...]
    chains: Mapping[str, tuple[str, ...]]
    """The stages of each system, by its label; the main system's first."""

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(planned.name for planned in self.stages)

    @property
    def main(self) -> tuple[str, ...]:
        """The stages of the main system."""
        return next(iter(self.chains.values()))

    @property
    def kept_states(self) -> tuple[str, ...]:
        """The stages whose state at the end is kept: each system's last, and those that another one continues."""
        ends = {chain[-1] for chain in self.chains.values()}
        continued = {planned.start for planned in self.stages if planned.stage.continues}
        return tuple(name for name in self.names if name in ends | continued)

    def __getitem__(self, name: str) -> PlannedStage:
        """Return the stage of this name. Raises ValueError if there is none."""
        for planned in self.stages:
            if planned.name == name:
                return planned
        raise ValueError(f"the run has the models {', '.join(self.names)}; got {name!r}")

    def first_iteration(self, name: str) -> int:
        """Return the number of iterations in the stages before a stage."""
        start = self[name].start
        return 0 if start is None else self.first_iteration(start) + self[start].stage.iterations


def plan_run(systems: Mapping[str, System]) -> RunPlan:
    """Return the stages of systems by label, the main one first. Two systems share their stages up to the first that
    differs. Raises ValueError if two stages would have the same name."""
    planned: list[PlannedStage] = []
    chains: dict[str, tuple[str, ...]] = {}
    for label, system in systems.items():
        chain: list[str] = []
        stages = system.all_stages()
        for index, stage in enumerate(stages):
            # Further stages leave the options of the ones before as they were.
            num_more = max(0, index + 1 - len(stages) + len(system.more))
            own = system if num_more == len(system.more) else dataclasses.replace(system, more=system.more[:num_more])
            wanted = PlannedStage(f"{label}-{stage.name}", own, index, chain[-1] if chain else None, stage)
            # Training both would give the same model, bit for bit.
            shared = next(
                (
                    known
                    for known in planned
                    if (known.index, known.start) == (wanted.index, wanted.start)
                    and common_options(known.system) == common_options(system)
                    and is_equal(known.stage, stage)
                ),
                None,
            )
            if shared is None:
                if wanted.name in {known.name for known in planned}:
                    raise ValueError(f"two stages of the run are called {wanted.name!r}")
                planned.append(wanted)
            chain.append((shared or wanted).name)
        chains[label] = tuple(chain)
    return RunPlan(tuple(planned), chains)


def common_options(system: System) -> list[Any]:
    """Return the options that training reads from the system directly."""
    return [getattr(system, each.name) for each in dataclasses.fields(System) if each.name not in STAGE_OPTIONS]


def is_equal(a: Stage, b: Stage) -> bool:
    """Return whether two stages are equal in everything, arrays and classes included."""
    (leaves, structure), (others, other) = jax.tree.flatten(a), jax.tree.flatten(b)
    # jax.tree compares classes and static fields; arrays are leaves, which == does not reduce to one bool.
    if structure != other:  # type: ignore[operator]
        return False
    return all(np.array_equal(np.asarray(x), np.asarray(y)) for x, y in zip(leaves, others, strict=True))
