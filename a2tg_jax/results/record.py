"""What a run was asked to do: the scene, every number, the phases. Kept as config.json."""

import dataclasses
import shlex
from pathlib import Path
from typing import Any

from a2tg_jax.config import TrainConfig
from a2tg_jax.data import Scene, load_scene, synthetic_scene
from a2tg_jax.io.config_json import config_from_dict, config_to_dict, flatten_config
from a2tg_jax.results.folder import Phase, RunFolder, read_json, write_json

SYNTHETIC = "synthetic"
SYNTHETIC_SIZE = (208, 156)
"""Small enough for two cores to train on in minutes."""


@dataclasses.dataclass(frozen=True)
class SceneSource:
    """Where the scene comes from, so that it can be loaded again."""

    path: str
    """A folder with photographs and poses, or "synthetic": the built-in scene."""
    downscale: int = 1
    """Use the images at 1/k of their size."""
    test_every: int = 8
    """Every k-th view is a test view."""

    def load(self) -> Scene:
        """The scene in its normalised world.

        Raises:
          FileNotFoundError, ValueError: as `load_scene` does.
        """
        if self.path == SYNTHETIC:
            width, height = SYNTHETIC_SIZE
            return synthetic_scene(width=width, height=height, downscale=self.downscale, test_every=self.test_every)
        return load_scene(self.path, downscale=self.downscale, test_every=self.test_every)


@dataclasses.dataclass(frozen=True)
class RunRecord:
    """One run's task."""

    source: SceneSource
    config: TrainConfig
    baseline: bool = False
    """Also train a second stage of the same length without textures, to compare with."""

    @property
    def phases(self) -> tuple[Phase, ...]:
        """The phases in order."""
        return ("stage1", "stage2", "baseline") if self.baseline else ("stage1", "stage2")

    def phase_config(self, phase: Phase) -> TrainConfig:
        """The numbers of one phase; the baseline's differ in having no textures."""
        if phase != "baseline":
            return self.config
        return dataclasses.replace(self.config, texture=dataclasses.replace(self.config.texture, is_enabled=False))

    def label(self, phase: Phase) -> str:
        """What tables and captions call a phase."""
        if phase == "stage1":
            return "stage 1"
        is_textured = self.phase_config(phase).texture.is_enabled
        return "stage 2, textured" if is_textured else "stage 2, untextured"

    def command(self, out: Path) -> str:
        """The command line that repeats the run."""
        words = ["a2tg", "train", self.source.path, "--out", str(out)]
        words += _flags(self.source, SceneSource(self.source.path))
        words += ["--baseline"] if self.baseline else []
        return shlex.join(words + _flags(self.config, TrainConfig.paper()))


def write_record(run: RunFolder, record: RunRecord) -> None:
    """Writes config.json."""
    write_json(run.own(run.config), config_to_dict(record))


def read_record(run: RunFolder) -> RunRecord:
    """Reads config.json.

    Raises:
      ValueError: if it is damaged or of another version; the field is named.
    """
    return config_from_dict(RunRecord, read_json(run.config), where=str(run.config))


def changed_fields(asked: Any, default: Any, kept: Any) -> list[str]:
    """Dotted names of the leaves that were asked for (they differ from `default`) and differ from `kept`."""
    kept_leaves, default_leaves = flatten_config(kept), flatten_config(default)
    return [
        name
        for name, value in flatten_config(asked).items()
        if value != default_leaves[name] and value != kept_leaves[name]
    ]


def _flags(value: Any, default: Any) -> list[str]:
    """Command-line flags for the leaves in which a dataclass differs from `default`."""
    default_leaves, words = flatten_config(default), []
    for name, leaf in flatten_config(value).items():
        if leaf == default_leaves[name]:
            continue
        if isinstance(leaf, bool):
            group, _, last = name.replace("_", "-").rpartition(".")
            words.append("--" + (f"{group}." if group else "") + ("" if leaf else "no-") + last)
        else:
            values = leaf if isinstance(leaf, tuple) else (leaf,)
            words += ["--" + name.replace("_", "-"), *(str(item) for item in values)]
    return words
