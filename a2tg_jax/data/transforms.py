"""Scenes with a transforms.json, of nerfstudio or instant-ngp, or of Blender with one file per split.

Readers of other programs make `Frames` of the same form.

Poses are camera-to-world in OpenGL's camera frame (x right, y up, z backward). nerfstudio's `applied_transform` is the
change of COLMAP's world before the file was written. Poses and points of `ply_file_path` have both gone through it, so
both are in the file's own world, which is the original world here. Points of its COLMAP model have not, and are moved.
"""

import functools
import itertools
import os
from collections.abc import Callable, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from a2tg_jax import Scene
from a2tg_jax.base.json_text import lenient_number, read_json
from a2tg_jax.base.regular_files import is_regular, names_in
from a2tg_jax.base.text import first_names, shortened
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.core.cameras import LONGEST_SIDE
from a2tg_jax.data.assembly import PointCloud, Shot, assemble_scene, every_kth, rigid_motion, scene_name
from a2tg_jax.data.colmap import points_in_world_of
from a2tg_jax.data.colmap_cameras import ColmapCamera
from a2tg_jax.data.image_files import inside
from a2tg_jax.data.lenses import Lens, LensUse, checked_lens
from a2tg_jax.data.photo_reading import Counted, Photo, SceneOptions, read_photos
from a2tg_jax.data.photo_store import Shelf
from a2tg_jax.data.ply import read_ply_points

NERFSTUDIO_FILE = "transforms.json"
BLENDER_FILES = ("transforms_train.json", "transforms_test.json")
POINT_FILES = ("sparse_pc.ply", "points3d.ply", "points3D.ply")
"""Names of point files of nerfstudio and 3DGS next to a transforms file, in order of preference."""
FILE_KEYS = ("file_path", "mask_path", "depth_file_path", "ply_file_path")
SPLIT_KEYS = ("train_filenames", "test_filenames", "val_filenames")
PRISM_KEYS = ("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1")
DISTORTION_KEYS = {"OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"), "THIN_PRISM_FISHEYE": PRISM_KEYS}
"""Parameters of fisheyes, in COLMAP's order."""
PERSPECTIVE_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV")


class Frames(NamedTuple):
    """Frames as in `transforms.json`, made from another program's files."""

    file: Path
    """File that messages name; paths of images start from its folder."""
    frames: list[dict[str, Any]]
    cloud: PointCloud | None = None
    counted: Counted | None = None


class Cameras(NamedTuple):
    """Cameras of another program that were found in a folder."""

    file: Path
    """Their file or folder, which messages name."""
    read: Callable[[], Frames]
    """Function that reads them."""
    files: Sequence[Path] = ()
    """All files with cameras, if there are several."""


def load_transforms(file: Path, options: SceneOptions, shelf: Shelf) -> Scene:
    """Read a nerfstudio or instant-ngp scene.

    The lists train_filenames, test_filenames and val_filenames decide the split if the file has them (val is the test
    split without a test list); otherwise test_every does. A warning counts frames that the lists leave out.
    """
    meta = _read_meta(file)
    (shots,) = _read_shots({file: meta}, options, shelf)
    lists = {key: set(meta[key]) for key in SPLIT_KEYS if key in meta}
    if lists:
        train, test = _split_by_lists(file, shots, lists)
    else:
        train, test = every_kth(shots, options.test_every)
    cloud = _points_beside(file, [meta], shots)
    return assemble_scene(scene_name(file.resolve().parent), train, test, cloud, source=str(file))


def _split_by_lists(file: Path, shots: Sequence[Shot], lists: dict[str, set[str]]) -> tuple[list[Shot], list[Shot]]:
    """Return the shots to train and to test on, as the lists of names in a transforms file say."""
    names = {shot.name for shot in shots}
    for key, listed in lists.items():
        unknown = sorted(listed - names)
        if unknown:
            raise ValueError(
                f"{file}: {key} names {shortened(unknown[0])}, which is no frame; write names as file_path has "
                f"them, such as {shots[0].name}"
            )
    val_names = lists.get("val_filenames", set())
    test_names = lists.get("test_filenames") or val_names
    train_names = lists.get("train_filenames", names) - test_names
    unused = sorted(names - train_names - test_names)
    if unused:
        only = "; val_filenames count only without test_filenames" if val_names else ""
        warn(f"{file}: {len(unused)} of {len(names)} frames are in no list that is used, such as {unused[0]}{only}")
    train = [shot for shot in shots if shot.name in train_names]
    return train, [shot for shot in shots if shot.name in test_names]


def load_blender(folder: Path, options: SceneOptions, shelf: Shelf) -> Scene:
    """Read a Blender scene in the format of NeRF: transforms_train.json, transforms_test.json, images with alpha.

    Most such scenes have no points, and start where their photographs agree. Without a test file, every test_every-th
    training view is a test view.
    """
    train_file, test_file = (folder / name for name in BLENDER_FILES)
    warn_of_others(train_file, transforms_in(folder))
    files = [train_file, test_file] if is_regular(test_file) else [train_file]
    metas = {file: _read_meta(file) for file in files}
    train, *test_files = _read_shots(metas, options, shelf)
    cloud = _points_beside(train_file, list(metas.values()), train)
    if test_files:
        test = test_files[0]
    else:
        train, test = every_kth(train, options.test_every)
    return assemble_scene(scene_name(folder), train, test, cloud, source=str(folder), is_object=True)


def load_frames(cameras: Sequence[Cameras], options: SceneOptions, shelf: Shelf) -> Scene:
    """Make a scene of the first of some cameras of another program, with a warning that names the others."""
    chosen = cameras[0]
    warn_of_others(chosen.file, [each.file for each in cameras])
    frames = chosen.read()
    (shots,) = _read_shots({frames.file: {"frames": frames.frames}}, options, shelf, frames.counted)
    name = scene_name(frames.file.resolve().parent)
    train, test = every_kth(shots, options.test_every)
    return assemble_scene(name, train, test, frames.cloud, source=str(frames.file))


def warn_of_others(chosen: Path, files: Sequence[Path]) -> None:
    """Warn of further files of cameras than the one that is read, such as a second export next to it."""
    others = [os.path.relpath(file, chosen.parent) for file in files if file != chosen]
    if others:
        warn(
            f"{chosen.parent}: {chosen.name} is read, and not {first_names(others)}; to read another, give that file, "
            "or a folder without the others"
        )


def load_folder(folder: Path, options: SceneOptions, shelf: Shelf) -> Scene:
    """Read the transforms.json of a folder, with a warning if others are next to it."""
    warn_of_others(folder / NERFSTUDIO_FILE, transforms_in(folder))
    return load_transforms(folder / NERFSTUDIO_FILE, options, shelf)


def transforms_in(folder: Path) -> list[Path]:
    """Return transforms.json and files of similar names in a folder, such as "transforms (1).json"; no splits."""
    names = [name for name in names_in(folder) if fnmatchcase(name.lower(), "transforms*.json")]
    return [folder / name for name in names if name not in (*BLENDER_FILES, "transforms_val.json")]


def check_images(file: Path, frames: Sequence[object], lacking: Sequence[str], nothing: str) -> None:
    """Raise ValueError(nothing) if there are no frames, and warn of the cameras `lacking` an image."""
    if not frames:
        raise ValueError(nothing)
    if lacking:
        warn(
            f"{file}: {len(lacking)} of {len(frames) + len(lacking)} cameras have no image beside them, such as "
            f"{shortened(lacking[0])}: not used"
        )


def _points_beside(file: Path, metas: Sequence[dict[str, Any]], shots: Sequence[Shot]) -> PointCloud | None:
    """Return the points that transforms files of a folder name, or else those in one of `POINT_FILES`, or else of
    nerfstudio's COLMAP model, or None."""
    names = [meta["ply_file_path"] for meta in metas if meta.get("ply_file_path")]
    names += [name for name in POINT_FILES if is_regular(file.parent / name)]
    if names:
        return read_ply_points(file.parent / names[0])
    return points_in_world_of(file.parent / "colmap", {shot.name: shot.viewmat for shot in shots})


def _read_meta(file: Path) -> dict[str, Any]:
    """Return the content of a transforms file, with names of files relative to its folder.

    Raise ValueError unless there is a non-empty list `frames` of objects, and file names are texts.
    """
    meta = read_json(file)  # Numbers are checked where they are used.
    if not isinstance(meta, dict) or not isinstance(meta.get("frames"), list) or not meta["frames"]:
        raise ValueError(f"{file}: lists no frames; a nerfstudio or Blender transforms file is expected")
    for number, values in enumerate([*meta["frames"], meta]):
        if not isinstance(values, dict):
            raise ValueError(f"{file}: frame {number} must be an object; got {shortened(values)}")
        for key in FILE_KEYS:
            name = values.get(key)
            # All but images may be empty or null, which means none.
            if not name and (key != "file_path" or key not in values):
                continue
            if not name or not isinstance(name, str):
                raise ValueError(f"{file}: {key} must be the name of a file; got {shortened(name)}")
            values[key] = inside(file.parent, name)
        for key in SPLIT_KEYS:
            names = values.get(key, [])
            if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
                raise ValueError(f"{file}: {key} must be a list of names; got {shortened(names)}")
            if names:
                values[key] = [inside(file.parent, name) for name in names]
    return meta


def names_masks(file: Path) -> bool:
    """Return whether a transforms file names a mask."""
    meta = _read_meta(file)
    return any(values.get("mask_path") for values in (meta, *meta["frames"]))


def _read_shots(
    metas: Mapping[Path, dict[str, Any]], options: SceneOptions, shelf: Shelf, counted: Counted | None = None
) -> list[list[Shot]]:
    """Return the frames of each transforms file of a scene, downscaled, in the file's order.

    The contents of the files are as from `_read_meta`. Values of a frame override the file's.
    """
    photos = []
    for file, meta in metas.items():
        without_focal = {key: value for key, value in meta.items() if not key.startswith("fl_")}
        for frame in meta["frames"]:
            # The file's focal length would be preferred to the frame's angle.
            shared = without_focal if {"camera_angle_x", "camera_angle_y"} & frame.keys() else meta
            photos.append(_photo(file, {**shared, **frame}, options.lens, counted))
    place = next(iter(metas))
    read = read_photos(photos, options, shelf, place, place.parent, lambda name: f"remove its frame from {place}")
    shots = iter(read)
    return [list(itertools.islice(shots, len(meta["frames"]))) for meta in metas.values()]


def _photo(file: Path, frame: dict[str, Any], use: LensUse, counted: Counted | None) -> Photo:
    """Return the photograph of a frame of a transforms file, with its camera."""
    if "file_path" not in frame or "transform_matrix" not in frame:
        raise ValueError(f"{file}: a frame lacks file_path or transform_matrix")
    name = frame["file_path"]
    what = f"{file}: {name}"
    path = file.parent / name
    images = file.parent / "images"
    return Photo(
        name,
        _viewmat(frame["transform_matrix"], what),
        (path.parent, path.name),
        (images, path.relative_to(images).as_posix()) if path.is_relative_to(images) else None,
        # Without a size in the frame, the lens needs the full image's, once that is found.
        functools.partial(_lens, frame, what, use),
        what,
        mask=file.parent / frame["mask_path"] if frame.get("mask_path") else None,
        depths=file.parent / frame["depth_file_path"] if frame.get("depth_file_path") else None,
        counted=counted,
    )


def _viewmat(matrix: object, what: str) -> np.ndarray:
    """Return the world-to-camera matrix [4, 4] (OpenCV) of a transform_matrix."""
    try:
        pose = np.asarray(matrix, np.float64)
    except (TypeError, ValueError, OverflowError):
        pose = np.empty(0)
    if pose.shape not in ((3, 4), (4, 4)):
        got = f"shape {pose.shape}" if pose.size else shortened(matrix)
        raise ValueError(f"{what}: its transform_matrix must be 4x4 numbers; got {got}")
    camera_to_world = np.eye(4)
    camera_to_world[:3] = pose[:3] * [1.0, -1.0, -1.0, 1.0]  # from OpenGL's camera to OpenCV's
    return np.linalg.inv(rigid_motion(camera_to_world, what))


def _lens(frame: dict[str, Any], what: str, use: LensUse, full: tuple[int, int]) -> Lens:
    """Return the camera of a frame; its size defaults to the full image's, the principal point to the centre."""

    def number(key: str, default: float) -> float:
        return lenient_number(frame.get(key, default), f"{what}: {key}")

    def side(key: str, default: int) -> int:
        given = number(key, default) if frame.get(key) else 0
        length = given or default  # 0 and null mean the image's.
        if not 1 <= length <= LONGEST_SIDE:  # False for NaN.
            raise ValueError(f"{what}: {key} must be in 1..{LONGEST_SIDE} pixels; got {length:g}")
        return int(length)

    width = side("w", full[0])
    height = side("h", full[1])
    focal = {}
    for axis, size in (("x", width), ("y", height)):
        if f"fl_{axis}" in frame:
            focal[axis] = number(f"fl_{axis}", 0.0)
        elif f"camera_angle_{axis}" in frame:
            angle = number(f"camera_angle_{axis}", 0.0)
            focal[axis] = size / (2 * np.tan(angle / 2)) if 0 < angle < np.pi else 0.0
    if not focal or not min(focal.values()) > 0:
        raise ValueError(f"{what}: has no focal length; give fl_x above 0, or camera_angle_x between 0 and pi")
    # nerfstudio's parameters of distortion have COLMAP's names and meaning.
    is_fisheye = str(frame.get("is_fisheye")).lower() in ("true", "1")  # It may be a text.
    model = "OPENCV_FISHEYE" if is_fisheye else frame.get("camera_model", "OPENCV")
    terms = {key: number(key, 0.0) for key in PRISM_KEYS}
    if model in tuple(DISTORTION_KEYS):  # A model may be no text, and then no key.
        distortion = [terms[key] for key in DISTORTION_KEYS[model]]
    elif model not in PERSPECTIVE_MODELS:
        wanted = "a perspective one, OPENCV_FISHEYE or THIN_PRISM_FISHEYE"
        raise ValueError(f"{what}: has the camera_model {shortened(model)}; {wanted} is expected")
    elif terms["k4"] != 0:
        raise ValueError(f"{what}: has k4 with a perspective camera; only k1, k2, k3, p1 and p2 are read there")
    else:
        model = "FULL_OPENCV"
        # Its k4 to k6 are in a denominator, which is 1 with zeros.
        distortion = [*(terms[key] for key in PRISM_KEYS[:5]), 0.0, 0.0, 0.0]
    fx = focal.get("x") or focal["y"]
    fy = focal.get("y") or fx
    params = (fx, fy, number("cx", width / 2), number("cy", height / 2), *distortion)
    return checked_lens(ColmapCamera(model, width, height, params), what, use)
