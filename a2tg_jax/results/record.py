"""Record of a run: the scene, a system with all its options, systems to compare. Kept as run.toml.

A configuration file says the same or less; what it leaves out has the value that the command line gives it:

    scene = "../scenes/fox"              # seen from the file's folder; or s3://bucket/fox, or "synthetic"
    downscale = 2
    system = "a2tg"                      # or package.module:NAME
    preset = "quick"
    compare = ["gaussians-2d-mcmc"]

    [options.texture]                    # options of the system, as nested tables
    cap = 8

    [compare_options.gaussians-2d-mcmc]  # options of a compared system, in place of the main one's
    sh_degree = 0
"""

import dataclasses
import os
import shlex
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import tomli_w

from a2tg_jax.data import Scene, load_scene, synthetic_scene
from a2tg_jax.data.assembly import with_validation_views
from a2tg_jax.data.division import among_processes, sharing_errors
from a2tg_jax.data.lenses import LensUse
from a2tg_jax.data.masks import AlphaMeaning
from a2tg_jax.data.scene import scene_name
from a2tg_jax.host.atomic import replacing
from a2tg_jax.host.json_text import MOST_TOML_BYTES, parse_toml
from a2tg_jax.host.regular_files import is_regular, read_regular
from a2tg_jax.host.remote_files import checked_url, is_url, path_here
from a2tg_jax.host.text import shortened
from a2tg_jax.io.config_json import config_from_dict, config_to_dict, flatten_config, merged
from a2tg_jax.results.finish_options import read_finish
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.plan import RunPlan, plan_run
from a2tg_jax.training import System, find_system, like
from a2tg_jax.training.options import own_options
from a2tg_jax.training.registry import differences, with_changes

SYNTHETIC = "synthetic"
SYNTHETIC_SIZE = (208, 156)
"""Width and height, small enough to train in minutes on two cores."""
DEFAULT_SYSTEM = "a2tg"
LONGEST_REASON = 500
OnNan = Literal["stop", "restore"]
"""Action on divergence: end with an error, or restore the newest checkpoint and reorder the views."""
HeldOut = Literal["test", "validation"]


@dataclasses.dataclass(frozen=True)
class SceneSource:
    """Source of a scene, from which it can be loaded again."""

    path: str
    """Folder with photographs and poses, its URL in object storage, or "synthetic" for the built-in scene."""
    downscale: int = 1
    """Factor k by which images are downscaled."""
    test_every: int = 8
    """Interval k of test views: every k-th view is held out."""
    alpha: AlphaMeaning = "transparency"
    """Meaning of the alpha channel: transparency before a background, or a mask."""
    lens: LensUse = "undistort"
    """Whether photographs of distorted cameras are undistorted, or kept."""
    validation: bool = False
    """Whether every eighth training view is held out for choosing options, in place of the test views."""

    @property
    def held_out(self) -> HeldOut:
        """Kind of the views that are held out."""
        return "validation" if self.validation else "test"

    @property
    def name(self) -> str:
        """Name of the scene in titles."""
        if self.path == SYNTHETIC:
            return SYNTHETIC
        folder = os.path.dirname(self.path) if Path(self.path).suffix == ".json" else self.path
        return scene_name(folder if is_url(folder) else Path(folder))

    def load(self, room: int | None = None, *, is_divided: bool = False) -> Scene:
        """Return the scene in its normalised world.

        Args:
          room: bytes of memory for photographs that are read from files, as in `load_scene`.
          is_divided: whether the processes of a training call this together, as in `load_scene`.

        Raises:
          FileNotFoundError, ValueError: as `load_scene` does.
        """
        division = among_processes() if is_divided else None
        if division is not None:  # `load_scene` compares the other options.
            kind = SYNTHETIC if self.path == SYNTHETIC else "from files"
            with sharing_errors(division):
                division.check_same([f"scene={kind}", f"validation={self.validation}"], "options of the scene")
        every = self.test_every
        if self.path == SYNTHETIC:
            width, height = SYNTHETIC_SIZE
            scene = synthetic_scene(width=width, height=height, downscale=self.downscale, test_every=every)
        else:
            given: Any = {"downscale": self.downscale, "alpha": self.alpha, "lens": self.lens}
            scene = load_scene(self.path, test_every=every, room=room, is_divided=is_divided, **given)
        return with_validation_views(scene) if self.validation else scene


@dataclasses.dataclass(frozen=True)
class RunRecord:
    """Record of a run."""

    scene: SceneSource
    name: str
    """Name of the system, as `find_system` takes it."""
    system: System
    """System with all its options."""
    compare: tuple[str, ...] = ()
    """Names of the systems to compare. They take the main system's options of the same names."""
    preset: str | None = None
    """Preset of the other options of these systems."""
    on_nan: OnNan = "stop"
    """Action if a loss or gradient is not finite, or a loss explodes."""
    init: str | None = None
    """File of splats in place of the main system's first stage."""
    compare_options: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict, compare=False)
    """Options of the compared systems, nested, by name. Those that are left out have the main system's values, or the
    preset's if it lacks them. A record that is written and read again has all that the main system lacks."""

    @property
    def systems(self) -> dict[str, System]:
        """Main system and then those compared with it, by label.

        Raises:
          ValueError: if a system is not found, or two have one label.
        """
        found = {label_of(self.name): self.system}
        for name in self.compare:
            if label_of(name) in found:
                raise ValueError(f"compare: two systems of the run would be called {shortened(label_of(name))!r}")
            beside, given = compared_system(name, self.system, self.preset), self.compare_options.get(name, {})
            found[label_of(name)] = with_changes(beside, given, f"compare_options.{name}")
        return found

    @property
    def plan(self) -> RunPlan:
        """Plan of the stages to train."""
        return plan_run(self.systems)

    def check(self) -> None:
        """Raise if the run cannot be trained.

        Raises:
          ValueError: naming the option, what was wanted and what came.
        """
        for name in self.compare_options:
            if name not in self.compare:
                told = f"compare_options.{shortened(name)}: the run does not compare this system"
                raise ValueError(f"{told}: add it to compare, or remove the table")
        for label, system in self.systems.items():
            try:
                system.check()
            except ValueError as error:
                if system is self.system:
                    raise
                raise ValueError(f"compare {label}, with the options of {self.name}: {error}") from error
        plan = plan_run(self.systems)
        if self.init is not None and len(plan.main) < 2:
            raise ValueError(f"init takes the place of a first stage, and {self.name} has no second one")
        if self.init is not None and self.system.sky_gaussians:
            raise ValueError("init takes the place of a first stage, and sky_gaussians start in one: leave one out")

    def leaves(self) -> dict[str, Any]:
        """Return every option by the name of its flag, without the dashes."""
        scene = {name: value for name, value in flatten_config(self.scene).items() if name != "path"}
        init = {} if self.init is None else {"init": self.init}
        return {"system": self.name, **scene, **init, **flatten_config(self.system)}


@dataclasses.dataclass(frozen=True)
class RunFile:
    """Content of a configuration file."""

    scene: str | None = None
    downscale: int = 1
    test_every: int = 8
    alpha: AlphaMeaning = "transparency"
    lens: LensUse = "undistort"
    validation: bool = False
    system: str = DEFAULT_SYSTEM
    preset: str | None = None
    compare: tuple[str, ...] = ()
    on_nan: OnNan = "stop"
    init: str | None = None
    version: str | None = None
    """Version of a2tg-jax that wrote the file."""
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    compare_options: dict[str, Any] = dataclasses.field(default_factory=dict)

    def chosen(self, where: str) -> System:
        """Return the system with the file's preset and options.

        Raises:
          ValueError: if there is no such system or preset, or an option is unknown or of another type.
        """
        system = chosen_system(self.system, self.preset)
        return with_changes(system, self.options, f"{where}: options")

    def compared(self, main: System, where: str) -> dict[str, Mapping[str, Any]]:
        """Return the options of compared systems, as `RunRecord.compare_options` has them.

        Args:
          main: the system that `chosen` returns.
          where: path of the file, for errors.

        Raises:
          ValueError: naming the option, if it is unknown or of another type.
        """
        found = dict[str, Mapping[str, Any]]()
        for name in dict.fromkeys((*self.compare, *self.compare_options)):
            label, given = f"{where}: compare_options.{name}", self.compare_options.get(name, {})
            try:
                beside = compared_system(name, main, self.preset)
            except ValueError as error:
                if name in self.compare:
                    raise
                raise ValueError(f"{label}: {error}") from error
            if not isinstance(given, Mapping):
                raise ValueError(f"{label} must be a table of options; got {shortened(given)}")
            with_changes(beside, given, label)
            found[name] = given
        return found


def label_of(name: str) -> str:
    """Return the label of a system in a run: its name, or NAME of package.module:NAME."""
    return name.rpartition(":")[2].replace(".", "-")


def chosen_system(name: str, preset: str | None = None) -> System:
    """Return a system by name, with the options of a preset. Options that an instance sets itself take precedence.

    Raises:
      ValueError: if there is no such system or preset.
    """
    found = find_system(name)
    return found if preset is None else with_changes(type(found).preset(preset), differences(found), name)


def compared_system(name: str, other: System, preset: str | None = None) -> System:
    """Return a system by name, with another's options of the same names. Options that an instance sets itself take
    precedence.

    Args:
      name: as `find_system` takes it.
      other: the system that it is compared with.
      preset: preset of its further options, if it has one of that name.

    Raises:
      ValueError: if there is no such system.
    """
    found = find_system(name)
    kind = type(found)
    start = kind() if preset is None else kind.presets().get(preset, kind())
    return with_changes(like(start, other), differences(found), name)


def read_run_file(path: Path) -> RunFile:
    """Read a configuration file. Relative paths in it start from its folder.

    Raises:
      FileNotFoundError: if there is none.
      ValueError: if it is no TOML, or a key is unknown or of another type; key and file are named.
    """
    if not is_regular(path):
        raise FileNotFoundError(f"{path}: no such configuration file")
    data = read_regular(path, MOST_TOML_BYTES)
    try:
        table = parse_toml(data)
    except ValueError as error:
        raise ValueError(f"{path}: is not valid TOML: {shortened(str(error), 200)}") from error
    file = config_from_dict(RunFile, {**config_to_dict(RunFile()), **table}, f"{path}:")
    if file.init is not None:
        file = dataclasses.replace(file, init=os.path.realpath(path.parent / file.init))
    if file.scene is None or file.scene == SYNTHETIC:
        return file
    return dataclasses.replace(file, scene=scene_place(file.scene, path.parent))


def scene_place(scene: str, folder: Path = Path()) -> str:
    """Return the place of a scene as run.toml keeps it: a URL, or a full path without links.

    Args:
      scene: URL or path; file:// is a path.
      folder: folder that a relative path starts from.

    Raises:
      ValueError: if a URL holds a secret, or names no place.
    """
    here = path_here(scene)
    return checked_url(scene) if here is None else os.path.realpath(folder / here)  # Also of links in a circle.


def write_record(run: RunFolder, record: RunRecord) -> None:
    """Write run.toml with every option, so that later versions with other defaults repeat the same run."""
    start = config_to_dict(chosen_system(record.name, record.preset))
    table = {
        "scene": record.scene.path,
        "downscale": record.scene.downscale,
        "test_every": record.scene.test_every,
        "alpha": record.scene.alpha,
        **({} if record.scene.lens == "undistort" else {"lens": record.scene.lens}),
        **({"validation": True} if record.scene.validation else {}),
        "system": record.name,
        **({} if record.preset is None else {"preset": record.preset}),
        "compare": list(record.compare),
        "on_nan": record.on_nan,
        **({} if record.init is None else {"init": record.init}),
        "version": version("a2tg-jax"),
        "options": _without_none(config_to_dict(record.system), start),
        **({"compare_options": _options_beside(record)} if record.compare else {}),
    }
    text = f"# Repeats the run: {repeating_command(run)}\n{_budget_note(record.system)}{tomli_w.dumps(table)}"
    with replacing(run.own(run.record)) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _options_beside(record: RunRecord) -> dict[str, Any]:
    """Return the options of the compared systems by name: all that they do not take from the main one, and those that
    were given."""
    found, systems = {}, record.systems
    for name in record.compare:
        beside = compared_system(name, record.system, record.preset)
        own = own_options(systems[label_of(name)], record.system)
        found[name] = _without_none(merged(own, record.compare_options.get(name, {})), config_to_dict(beside))
    return found


def _budget_note(system: System) -> str:
    """Return a comment that names the options without effect beside a memory budget; empty if there are none."""
    if system.memory_budget is None or not (caps := system.caps()):
        return ""
    return f"# options.memory_budget decides in place of {', '.join(f'options.{name}' for name in caps)}\n"


def read_record(run: RunFolder) -> RunRecord:
    """Read run.toml. If the system is a user's own, its module is imported.

    Raises:
      ValueError: if it is damaged, its system is not found, or an option is unknown, of another type or out of range;
        it is named, and the version that began the run if it is another one.
    """
    try:
        return _checked_record(run)
    except ValueError as error:
        told = str(error) if str(run.record) in str(error) else f"{run.record}: {error}"
        raise ValueError(f"{shortened(told, LONGEST_REASON)}{_of_another_version(run)}") from error


def _checked_record(run: RunFolder) -> RunRecord:
    file = read_run_file(run.record)
    if file.scene is None:
        raise ValueError(f"{run.record}: scene is missing")
    source = SceneSource(file.scene, file.downscale, file.test_every, file.alpha, file.lens, file.validation)
    system = file.chosen(str(run.record))
    compared = file.compared(system, str(run.record))
    record = RunRecord(source, file.system, system, file.compare, file.preset, file.on_nan, file.init, compared)
    record.check()
    return record


def _of_another_version(run: RunFolder) -> str:
    """Return what to do if another version may have begun a run that this one refuses; empty if this one did."""
    try:
        before = parse_toml(read_regular(run.record, MOST_TOML_BYTES)).get("version")
    except ValueError:
        return ""
    now = version("a2tg-jax")
    if before is None:
        return f"; if an earlier version than a2tg-jax {now} began the run, go on with that version"
    told = f"; a2tg-jax {shortened(before)} began the run, and this is {now}: go on with that version"
    return told if before != now else ""


def repeating_command(run: RunFolder) -> str:
    """Return the command line that repeats a run, and its finishing if it was finished."""

    def training(out: str) -> str:
        return shlex.join(["a2tg", "train", "--config", str(run.record), "--out", out])

    if not is_regular(run.finish):
        return training(f"{run.path}-again")
    trained = f"{run.path}-trained"
    finishing = ["a2tg", "finish", trained, "--out", f"{run.path}-again", *read_finish(run).flags]
    return f"{training(trained)} && {shlex.join(finishing)}"


def changed_numbers(asked: RunRecord, kept: RunRecord) -> list[str]:
    """Return the names of the options in which two records of the same scene differ."""
    before = kept.leaves()
    return [name for name, value in asked.leaves().items() if name not in before or value != before[name]]


def changed_compared(asked: RunRecord, kept: RunRecord) -> list[str]:
    """Return the tables `compare_options` of a record that differ from the systems compared by another record."""
    names = [name for name in asked.compare_options if name in kept.compare]
    before, now = kept.systems, dataclasses.replace(asked, compare=kept.compare).systems
    return [f"compare_options.{name}" for name in names if before[label_of(name)] != now[label_of(name)]]


def _without_none(table: dict[str, Any], start: dict[str, Any]) -> dict[str, Any]:
    """Leave out None, which TOML lacks, or write "None", as on the command line, if `start` has another value."""
    told: dict[str, Any] = {}
    for name, value in table.items():
        if isinstance(value, dict):
            told[name] = _without_none(value, start[name])
        elif value is not None or start[name] is not None:
            told[name] = "None" if value is None else value
    return told
