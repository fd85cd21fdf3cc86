"""Scenes of a grid: folders at a size, named by `grids/scales.toml`, by a grid's own file, or on the command line."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import a2tg_jax as a2tg
from a2tg_jax.base.text import did_you_mean
from a2tg_jax.core.sight import Sight, unseeing
from a2tg_jax.data.assembly import GREY, NUM_POINTS, random_points
from a2tg_jax.data.synthetic import BUILT_IN
from lab.grid_file import Block, table_as


@dataclasses.dataclass(frozen=True)
class SceneAt:
    """A scene at a size."""

    label: str
    """DATASET/NAME, or a name without a data set."""
    path: str
    downscale: int = 1
    size: tuple[int, int] | None = None
    """Width and height of its photographs in full, where bytes are given for each pixel."""
    fold: int | None = None
    """Number of the split of its views into few for training and others to score; None: as the scene has them."""
    random_start: bool = False
    """Whether a scene without points starts from random ones, not from those where its photographs agree."""
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict, hash=False)
    """Options of every system, such as its background."""

    @property
    def num_pixels(self) -> int:
        """Number of pixels of a photograph."""
        if self.size is None:
            raise ValueError(f"scene {self.label!r} needs a size, since bytes are given for each pixel")
        width, height = self.size
        return (width // self.downscale) * (height // self.downscale)

    @property
    def dataset(self) -> str:
        return self.label.rpartition("/")[0]


NUM_FOLDS = 5
FEW_VIEWS = 21
MOST_SCORED = 12


def few_views(scene: a2tg.Scene, fold: int) -> a2tg.Scene:
    """Return a scene of at most 21 training views, with others of its views to score.

    A capture of less than 30 views is cut into five folds, each of which scores every fifth view and trains on the
    others. Of a larger one 21 views are kept, evenly spaced and shifted by a fifth of their distance from fold to fold;
    12 views halfway between them are scored.
    """
    views = sorted((*scene.train, *scene.test), key=lambda view: view.name)
    num = len(views)
    if num < 30:
        scored = set(range(fold, num, NUM_FOLDS))
        kept = set(range(num)) - scored
    else:
        spacing = num / FEW_VIEWS
        kept = {int((index + fold / NUM_FOLDS) * spacing) for index in range(FEW_VIEWS)}
        halfway = (int((index + fold / NUM_FOLDS + 0.5) * spacing) % num for index in range(FEW_VIEWS))
        others = [index for index in halfway if index not in kept]
        scored = {others[int(place)] for place in np.linspace(0, len(others) - 1, min(MOST_SCORED, len(others)))}
    train, test = (tuple(views[index] for index in sorted(found)) for found in (kept, scored))
    return dataclasses.replace(scene, train=train, test=test)


def from_random_points(scene: a2tg.Scene) -> a2tg.Scene:
    """Return a scene of one object with random points in a cube around it, as the library made them until November
    2026.

    Raises:
      ValueError: if some view does not show the cube.
    """
    sights = [Sight.of_camera(view.camera) for view in scene.train]
    points = random_points(sights, scene.transform.rotation)[:NUM_POINTS]
    lost = unseeing(points, sights)
    if lost:
        raise ValueError(
            f"{scene.name}: random_start needs views of one object; {scene.train[lost[0]].name} shows none"
        )
    return dataclasses.replace(scene, points=points.astype(np.float32), colors=np.full(points.shape, GREY, np.float32))


def own_scene(path: Path, downscale: int) -> SceneAt:
    """Return a scene of one's own by the path of its folder.

    Raises:
      ValueError: if there is no such folder, or the downscale is not a whole number of at least 1.
    """
    if not path.is_dir():
        raise ValueError(f"there is no scene folder {path}")
    check_downscale("--downscale", downscale)
    return SceneAt(path.resolve().name, path.resolve().as_posix(), downscale)


def read_scenes(tables: Mapping[str, Any], where: str, folder: Path | None) -> dict[str, SceneAt]:
    """Return scenes by label.

    Args:
      tables: a table of a TOML file for each scene.
      where: file and table, for messages.
      folder: folder that relative paths start from; None: that of --scenes.

    Raises:
      ValueError: naming file, scene and key, if a table lacks its path, has an unknown key or one of another type, or a
        downscale that is not at least 1.
    """
    scenes = {label: table_as(SceneAt, table, f"{where}.{label!r}", label=label) for label, table in tables.items()}
    for label, scene in scenes.items():
        check_downscale(f"{where}.{label!r}.downscale", scene.downscale)
    return {label: dataclasses.replace(scene, path=_placed(scene.path, folder)) for label, scene in scenes.items()}


def check_downscale(name: str, downscale: int) -> None:
    """Raise ValueError unless a downscale is at least 1."""
    if downscale < 1:
        raise ValueError(f"{name} must be at least 1; got {downscale}")


def _placed(path: str, folder: Path | None) -> str:
    """Return the path of a scene, absolute if it starts from a given folder."""
    if folder is None or path in BUILT_IN:
        return path
    return (folder / Path(path).expanduser()).resolve().as_posix()


def chosen_scenes(
    scenes: Mapping[str, SceneAt], block: Block, wanted: Sequence[str] | None, place: str
) -> list[SceneAt]:
    """Return the scenes of a block, or the wanted ones, at the block's downscale if it has one.

    Raises:
      ValueError: if a wanted scene is unknown.
    """
    labels = wanted or (scenes if block.only is None else block.only)
    for label in labels:
        if label not in scenes:
            hint = did_you_mean(label, scenes) or f"; there are {', '.join(scenes)}"
            raise ValueError(f"{place}: there is no scene {label!r} at this scale{hint}")
    found = [scenes[label] for label in labels]
    return [dataclasses.replace(scene, downscale=block.downscale or scene.downscale) for scene in found]
