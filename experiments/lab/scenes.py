"""Scenes of a grid: folders at a size, named by `grids/scales.toml`, by a grid's own file, or on the command line."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from a2tg_jax.host.text import did_you_mean
from a2tg_jax.results.record import SYNTHETIC


@dataclasses.dataclass(frozen=True)
class SceneAt:
    """A scene at a size."""

    label: str
    """DATASET/NAME, or a name without a data set."""
    path: str
    downscale: int = 1
    held_out: bool = False
    """Mark of a scene on which no choice may be made."""
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict, hash=False)
    """Options of every system, such as its background."""

    @property
    def dataset(self) -> str:
        return self.label.rpartition("/")[0]


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


def read_scenes(table: Mapping[str, Mapping[str, Any]], place: str, folder: Path | None) -> dict[str, SceneAt]:
    """Return the scenes of a table by label.

    Args:
      table: entries of a TOML file.
      place: name of the file, for messages.
      folder: folder that relative paths start from; None: that of --scenes.

    Raises:
      ValueError: if an entry lacks its path, has an unknown key, or a downscale that is not at least 1.
    """
    known = [field.name for field in dataclasses.fields(SceneAt) if field.name != "label"]
    for label, entry in table.items():
        for key in entry:
            if key not in known:
                raise ValueError(f"{place}: scene {label!r} has {key!r}, which is none of {', '.join(known)}")
        if "path" not in entry:
            raise ValueError(f"{place}: scene {label!r} has no path")
        downscale = entry.get("downscale", 1)
        if not isinstance(downscale, int) or downscale < 1:
            raise ValueError(f"{place}: the downscale of scene {label!r} must be at least 1; got {downscale!r}")
    return {
        label: SceneAt(label, **{**entry, "path": _placed(entry["path"], folder)}) for label, entry in table.items()
    }


def _placed(path: str, folder: Path | None) -> str:
    """Return the path of a scene, absolute if it starts from a given folder."""
    if folder is None or path == SYNTHETIC:
        return path
    return (folder / Path(path).expanduser()).resolve().as_posix()


def chosen_scenes(
    scenes: Mapping[str, SceneAt], block: Mapping[str, Any], wanted: Sequence[str] | None, held_out: bool, place: str
) -> list[SceneAt]:
    """Return the scenes of a block, or the wanted ones, at the block's downscale if it has one.

    Raises:
      ValueError: if a wanted scene is unknown.
    """
    labels = block.get("only", scenes) if wanted is None else wanted
    for label in labels:
        if label not in scenes:
            hint = did_you_mean(label, scenes) or f"; there are {', '.join(scenes)}"
            raise ValueError(f"{place}: there is no scene {label!r} at this scale{hint}")
    found = [scenes[label] for label in labels]
    found = [dataclasses.replace(scene, downscale=block.get("downscale", scene.downscale)) for scene in found]
    return [scene for scene in found if held_out or not scene.held_out]
