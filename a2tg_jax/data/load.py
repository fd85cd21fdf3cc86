"""Loading of scenes in any known format."""

import dataclasses
import functools
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

from a2tg_jax import Scene
from a2tg_jax.base.regular_files import expanded, is_regular
from a2tg_jax.base.text import shortened
from a2tg_jax.data.assembly import scene_name, warn_of_lenses, with_validation_views
from a2tg_jax.data.colmap import IMAGES, find_models, load_colmap, model_files
from a2tg_jax.data.lenses import LensUse, forget_rays
from a2tg_jax.data.phone_captures import polycam, record3d
from a2tg_jax.data.photo_folder import capture_hint, holds_photos, is_video
from a2tg_jax.data.photo_reading import AlphaMeaning, MaskMeaning, SceneOptions
from a2tg_jax.data.photo_store import Shelf
from a2tg_jax.data.photogrammetry import metashape, realityscan
from a2tg_jax.data.synthetic import BUILT_IN
from a2tg_jax.data.transforms import (
    BLENDER_FILES,
    NERFSTUDIO_FILE,
    Cameras,
    load_blender,
    load_folder,
    load_frames,
    load_transforms,
    names_masks,
    transforms_in,
)
from a2tg_jax.host.errors import as_argument

HeldOut = Literal["test", "validation"]
OTHER_PROGRAMS: tuple[Callable[[Path], list[Cameras]], ...] = (polycam, record3d, metashape, realityscan)
"""Functions that find the cameras of other programs in a folder or a file, in order of preference."""


@dataclasses.dataclass(frozen=True)
class SceneSource(SceneOptions):
    """Where a scene comes from and how it is read: the options of `a2tg train` on it, which run.toml keeps."""

    validation: bool = False
    """Hold out every eighth training image instead of the test images, to choose options without using these."""

    @property
    def held_out(self) -> HeldOut:
        """Kind of the views that are held out."""
        return "validation" if self.validation else "test"

    @property
    def is_built_in(self) -> bool:
        """Whether the path names a built-in scene and no folder."""
        return self.path in BUILT_IN

    @property
    def name(self) -> str:
        """Name of the scene in titles."""
        if self.is_built_in:
            return self.path
        path = Path(self.path)
        is_file = path.suffix.lower() in (".json", ".xml")
        return scene_name(path.parent if is_file else path)

    def load(self, room: int | None = None) -> Scene:
        """Return the scene, which may be a built-in one. Same arguments and errors as `load_scene`."""
        self.check_options()
        if self.is_built_in:
            scene = BUILT_IN[self.path](downscale=self.downscale, test_every=self.test_every)
        else:
            scene = _read(expanded(self.path), self, room)
        return with_validation_views(scene) if self.validation else scene


def load_scene(
    path: str | os.PathLike[str],
    *,
    downscale: int = 1,
    test_every: int = 8,
    room: int | None = None,
    alpha: AlphaMeaning = "transparency",
    mask_as: MaskMeaning = "ignored",
    lens: LensUse = "undistort",
) -> Scene:
    """Read photographs, cameras and points, and normalise the world.

    Recognised, in this order: a COLMAP model (`sparse/0`, `sparse` or the folder itself, .bin or .txt) with its images,
    nerfstudio's or instant-ngp's `transforms.json`, Blender's `transforms_train.json` (and `transforms_test.json`),
    nerfstudio's `colmap/sparse/0`, Polycam's raw data, Record3D's frames with their metadata, Metashape's cameras
    (.xml), RealityScan's XMP files. Of several COLMAP models, the one with the most images is read.
    Photographs of distorted cameras are undistorted to pinholes unless `lens` keeps them. Images in the folder without
    a pose are ignored. Masks, black at excluded pixels, are in `masks` next to `images`, or at `mask_path`.

    Args:
      path: the scene folder, a transforms.json, or an XML file of Metashape's cameras.
      downscale: k >= 1; images are read from `images_k` if it holds all of them at 1/k of their size, and downscaled
        from the full ones otherwise.
      test_every: every k-th of the name-sorted views, from the first, is a test view; 0 keeps none. The views of a
        panorama count as one. Has no effect if the scene names its own test views.
      room: bytes of memory for photographs, at 3 or 4 a pixel; those beyond it stay on disk and are read when
        needed, which changes no result. None takes a quarter of the process's memory.
      alpha: meaning of the alpha channel: "transparency" before a background, or a "mask", of which only opaque
        pixels count.
      mask_as: meaning of the pixels that masks exclude: "ignored" in training and metrics; or "background", transparent
        as by an alpha channel, which cuts the subject out.
      lens: "undistort" photographs to pinholes, which crops wide angles; or "keep" them and draw through the lens,
        with a ray for each pixel (`Camera.rays`). Pixels more than 80° off the direction of view do not count.

    Returns:
      The scene in its normalised world; `Scene.transform` leads there from the input's.

    Raises:
      FileNotFoundError: if the path, or an image or mask named by the scene, does not exist, or the path is no scene.
      ValueError: if an argument, the model, a pose, an image or a mask is unusable, or fewer than two views are left.

    Examples:
      >>> scene = a2tg.load_scene("scene", downscale=2)  # such as a folder with transforms.json
      >>> len(scene.train), len(scene.test)
      (7, 1)
    """
    options = SceneOptions("", downscale, test_every, alpha, mask_as, lens)
    options.check_options()
    return _read(expanded(path), options, room)


def is_scene(folder: Path) -> bool:
    """Return whether a folder holds a scene in a known format."""
    return _loader(folder) is not None


def camera_files(path: Path) -> list[Path]:
    """Return the files with the cameras and points of a scene folder or file, sorted, in all known formats that are
    there."""
    if is_regular(path):
        return [path]
    files = [path / name for name in BLENDER_FILES if is_regular(path / name)]
    files += transforms_in(path)
    for model in (*find_models(path), *find_models(path / "colmap")):
        files += model_files(model).values()
    for find in OTHER_PROGRAMS:
        for cameras in find(path):
            files += cameras.files or [cameras.file]
    return sorted(set(files))


def names_below_images(path: Path, names: Sequence[str]) -> list[str]:
    """Return the paths of a scene's photographs below its folder `images`, next to which masks are read.

    Raises:
      ValueError: if a photograph is elsewhere, or the scene names masks itself, so that masks there are not read.
    """
    load = _loader(path)
    if load is not None and load.func is load_colmap:
        return list(names)
    for file in [path] if is_regular(path) else transforms_in(path)[:1]:
        if names_masks(file):
            raise ValueError(
                f"{file}: names masks by mask_path, which training reads instead of others: remove mask_path from its "
                "frames"
            )
    others = [name for name in names if not name.startswith(f"{IMAGES}/")]
    if others:
        raise ValueError(
            f"{path}: training reads masks of photographs in the folder {IMAGES} only, and {shortened(others[0])} is "
            f"elsewhere: move the photographs to {IMAGES}, and change their names in the file of the cameras"
        )
    return [name.removeprefix(f"{IMAGES}/") for name in names]


def _read(path: Path, options: SceneOptions, room: int | None) -> Scene:
    """Read the scene at a path, or raise FileNotFoundError that says what is there instead."""
    if room is not None and room < 0:
        raise ValueError(f"room must be at least 0 bytes; got {room}")
    if not path.exists():
        built_in = f"; the built-in scene is {path}_scene()" if str(path) in BUILT_IN else ""
        raise FileNotFoundError(f"{path}: no such scene folder{built_in}")
    if is_video(path):
        command = f"`a2tg sfm {as_argument(path)} SCENE`"
        raise ValueError(f"{path}: is a video; to make a scene of it, run {command} first")
    load = _loader(path)
    if load is None:
        raise FileNotFoundError(f"{path}: {_what_to_give_instead(path)}")
    try:
        scene = load(dataclasses.replace(options, downscale=int(options.downscale)), Shelf(room))
    finally:
        forget_rays()
    warn_of_lenses(scene)
    return scene


def _loader(path: Path) -> functools.partial[Scene] | None:
    """Return the function that loads what is at a path, or None."""
    if is_regular(path):
        # OpenSfM's reconstruction.json is JSON as well, but no transforms file.
        if path.suffix.lower() == ".json" and capture_hint(path) is None:
            return functools.partial(load_transforms, path)
    elif find_models(path):
        return functools.partial(load_colmap, path)
    elif is_regular(path / NERFSTUDIO_FILE):
        return functools.partial(load_folder, path)
    elif is_regular(path / BLENDER_FILES[0]):
        return functools.partial(load_blender, path)
    elif find_models(path / "colmap"):  # nerfstudio's, whose transforms.json is preferred
        return functools.partial(load_colmap, path / "colmap")
    for find in OTHER_PROGRAMS:
        cameras = find(path)
        if cameras:
            return functools.partial(load_frames, cameras)
    return None


def _what_to_give_instead(path: Path) -> str:
    """Return what is at a path that is no scene, and what to give instead or to do first."""
    hint = capture_hint(path)
    if is_regular(path):
        return hint or (
            "is neither a transforms.json nor an XML file of Metashape's cameras (File > Export > Export Cameras); "
            "give one of these, or the scene's folder"
        )
    command = f"a2tg sfm {as_argument(path)} SCENE"
    if hint is not None:
        return f"{hint}; or find cameras again: {command}" if holds_photos(path) else hint
    others = transforms_in(path)
    if others:
        return f"has no {NERFSTUDIO_FILE}, but {others[0].name}: give that file itself"
    for parent in path.resolve().parents[:2]:  # The path may be scene/images, or a folder in it.
        if _loader(parent) is not None:
            return f"is a folder in the scene {parent}; give that folder instead"
    return (
        "has no sparse model (sparse/0) and no transforms.json or transforms_train.json; "
        f"for plain photographs, run `{command}` first"
    )
