"""Scenes with a transforms.json, of nerfstudio or instant-ngp, or of Blender with one file per split.

Poses are camera-to-world in OpenGL's camera frame (x right, y up, z backward). nerfstudio's `applied_transform` is the
change of COLMAP's world before the file was written. Poses and points of `ply_file_path` have both gone through it, so
both are in the file's own world, which is the original world here.
"""

import logging
import warnings
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from a2tg_jax.core.cameras import LONGEST_SIDE
from a2tg_jax.data.assembly import PointCloud, Shot, assemble_scene, rigid_viewmat
from a2tg_jax.data.colmap_library import pycolmap
from a2tg_jax.data.decoding import picture_size
from a2tg_jax.data.depth_files import find_depths
from a2tg_jax.data.division import Division
from a2tg_jax.data.images import inside, locate_image, map_in_threads, num_readers
from a2tg_jax.data.lenses import Lens, LensUse, checked_lens
from a2tg_jax.data.mask_files import check_masks, find_mask, mask_to_read
from a2tg_jax.data.photo_reading import PhotoFiles, Reading, read_photos
from a2tg_jax.data.photo_store import Shelf
from a2tg_jax.data.ply_points import read_ply_points
from a2tg_jax.data.scene import Scene, scene_name
from a2tg_jax.data.smaller_copies import SmallerCopies, find_copies
from a2tg_jax.data.splits import every_kth
from a2tg_jax.host.json_text import MOST_BYTES, parse_json
from a2tg_jax.host.regular_files import is_regular, read_regular
from a2tg_jax.host.remote_files import is_remote
from a2tg_jax.host.text import shortened

NERFSTUDIO_FILE = "transforms.json"
BLENDER_FILES = ("transforms_train.json", "transforms_test.json")
POINT_FILES = ("sparse_pc.ply", "points3d.ply", "points3D.ply")
"""Names of the points of nerfstudio and of 3DGS beside a transforms file, in order of preference."""
OPENCV_KEYS = ("k1", "k2", "p1", "p2")
FISHEYE_KEYS = ("k1", "k2", "k3", "k4")
PRISM_KEYS = ("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1")
FILE_KEYS = ("file_path", "mask_path", "depth_file_path", "ply_file_path")
SPLIT_KEYS = ("train_filenames", "test_filenames", "val_filenames")
PERSPECTIVE_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV")

logger = logging.getLogger(__name__)


def load_transforms(
    file: Path, *, downscale: int, test_every: int, room: int | None = None, lens: LensUse = "undistort",
    division: Division | None = None,
) -> Scene:  # fmt: skip
    """Read a nerfstudio or instant-ngp scene.

    The lists train_filenames, test_filenames and val_filenames decide the split if the file has them (val is the test
    split without a test list); otherwise test_every does. A warning counts frames that the lists leave out.

    Args:
      file: path of transforms.json.
      downscale, test_every, room, lens: as in `load_scene`.
      division: processes that call this together; None: one.

    Raises:
      FileNotFoundError: if an image or the point file is missing.
      ValueError: if the JSON, a frame, an image or a pose is invalid, a list names what is no frame, or the views make
        no scene (`assemble_scene`).
    """
    meta = _read_json(file)
    (shots,) = read_shots([(file, meta)], downscale, Shelf(room), lens, division)
    listed = {key: _names(meta[key]) for key in SPLIT_KEYS if key in meta}
    train, test = _listed_split(file, shots, listed) if listed else every_kth(shots, test_every)
    cloud = _points_beside(file, meta)
    return assemble_scene(scene_name(file.resolve().parent), train, test, cloud, source=str(file))


def load_blender(
    folder: Path, *, downscale: int, test_every: int, room: int | None = None, lens: LensUse = "undistort",
    division: Division | None = None,
) -> Scene:  # fmt: skip
    """Read a Blender scene in the format of NeRF: transforms_train.json, transforms_test.json, images with alpha.

    Most such scenes have no points, and start from random ones in a cube around what all cameras look at. Without a
    test file, every test_every-th training view is a test view.

    Args:
      folder: the scene folder.
      downscale, test_every, room, lens: as in `load_scene`.
      division: processes that call this together; None: one.

    Raises:
      FileNotFoundError, ValueError: as `load_transforms`.
    """
    train_file, test_file = (folder / name for name in BLENDER_FILES)
    files = [train_file, test_file] if is_regular(test_file) else [train_file]
    metas = [_read_json(file) for file in files]
    groups = read_shots(list(zip(files, metas, strict=True)), downscale, Shelf(room), lens, division)
    train, test = groups if len(groups) == 2 else every_kth(groups[0], test_every)
    cloud = _points_beside(train_file, *metas)
    logger.info("%s: a Blender scene, starting from %s points", folder, "random" if cloud is None else "its")
    return assemble_scene(scene_name(folder), train, test, cloud, source=str(folder), is_object=True)


def _points_beside(file: Path, *metas: dict[str, Any]) -> PointCloud | None:
    """Return the points that transforms files of a folder name, or else those in one of `POINT_FILES`, or None."""
    named = [meta["ply_file_path"] for meta in metas if meta.get("ply_file_path")]
    usual = [name for name in POINT_FILES if not named and is_regular(file.parent / name)]
    return next((read_ply_points(_beside(file, name)) for name in (*named, *usual)), None)


def _listed_split(file: Path, shots: Sequence[Shot], listed: dict[str, set[str]]) -> tuple[list[Shot], list[Shot]]:
    """Return (train, test) of lists by their keys. Warn of frames that they leave out.

    Raises:
      ValueError: if a list names what is no frame.
    """
    names = {shot.name for shot in shots}
    for key, own in listed.items():
        if unknown := sorted(own - names):
            raise ValueError(
                f"{file}: {key} names {shortened(unknown[0])}, which is no frame; write names as file_path has them, "
                f"such as {shots[0].name}"
            )
    test_names = listed.get("test_filenames") or listed.get("val_filenames") or set()
    train_names = listed.get("train_filenames", names) - test_names
    if unused := sorted(names - train_names - test_names):
        only = "; val_filenames count only without test_filenames" if listed.get("val_filenames") else ""
        message = f"{file}: {len(unused)} of {len(names)} frames are in no list that is used, such as {unused[0]}{only}"
        warnings.warn(message, stacklevel=3)
    return [shot for shot in shots if shot.name in train_names], [shot for shot in shots if shot.name in test_names]


def _read_json(file: Path) -> dict[str, Any]:
    """Return the JSON object in a file. It has a non-empty list `frames` of objects, and file names that are texts."""
    data = read_regular(file, MOST_BYTES)
    try:
        meta = parse_json(data, allow_nan=True)  # Numbers are looked at where they are used.
    except ValueError as error:
        raise ValueError(f"{file}: cannot be read as JSON ({error})") from None
    check_meta(file, meta)
    checked: dict[str, Any] = meta
    return checked


def check_meta(file: Path, meta: object) -> None:
    """Raise ValueError unless there is a non-empty list `frames` of objects, and file names are texts."""
    if not isinstance(meta, dict) or not isinstance(meta.get("frames"), list) or not meta["frames"]:
        raise ValueError(f"{file}: lists no frames; a nerfstudio or Blender transforms file is expected")
    for number, frame in enumerate(meta["frames"]):
        if not isinstance(frame, dict):
            raise ValueError(f"{file}: frame {number} must be an object; got {shortened(frame)}")
        _check_texts(file, frame)
    _check_texts(file, meta)


def _check_texts(file: Path, values: dict[str, Any]) -> None:
    """Make file names relative to the scene folder. Raise ValueError unless they are texts, or lists of texts."""
    for key in FILE_KEYS:
        name = values.get(key)
        if ((key == "file_path" and key in values) or name) and not (isinstance(name, str) and name):
            raise ValueError(f"{file}: {key} must be the name of a file; got {shortened(name)}")
        if name:
            values[key] = inside(file.parent, name)
    for key in SPLIT_KEYS:
        names = values.get(key, [])
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise ValueError(f"{file}: {key} must be a list of names; got {shortened(names)}")
        if names:
            values[key] = [inside(file.parent, name) for name in names]


def read_shots(
    files: Sequence[tuple[Path, dict[str, Any]]], downscale: int, shelf: Shelf, use: LensUse,
    division: Division | None = None,
) -> list[list[Shot]]:  # fmt: skip
    """Return the frames of each transforms file of a scene, downscaled, in the file's order.

    Args:
      files: with their contents, which `check_meta` has checked.
      downscale, shelf, use, division: as `load_transforms` has them.
    """
    frames = [(file, {**meta, **frame}) for file, meta in files for frame in meta["frames"]]
    place = files[0][0]
    copies = find_copies(_named_files(frames, downscale), downscale, place.parent)
    photos = map_in_threads(lambda item: _photo(*item, copies, use), frames, num_readers(place))
    found = iter(read_photos(photos, shelf, division, place))
    groups = []
    for file, meta in files:
        group = [_shot(file, {**meta, **frame}, next(found)) for frame in meta["frames"]]
        check_masks(group, str(file))
        groups.append(group)
    return groups


def _named_files(frames: Sequence[tuple[Path, dict[str, Any]]], downscale: int) -> list[tuple[Path, str]]:
    """Return folder and name of the photographs and masks of all frames."""
    files: list[tuple[Path, str] | None] = []
    for file, frame in frames:
        if "file_path" not in frame or "transform_matrix" not in frame:
            raise ValueError(f"{file}: a frame lacks file_path or transform_matrix")
        image = _beside(file, frame["file_path"])
        files += [(image.parent, image.name), _find_mask(file, frame, image, downscale)]
    return [each for each in files if each is not None]


def _photo(file: Path, frame: dict[str, Any], copies: SmallerCopies, use: LensUse) -> PhotoFiles:
    """Return the files of one frame; `frame` also holds the file's global values, which the frame's own override."""
    path, downscale = _beside(file, frame["file_path"]), copies.downscale
    name = Path(frame["file_path"]).as_posix()
    folder, still_to_downscale = copies.of(path.parent)
    image_file = locate_image(folder, path.name)

    def lens_of(stored: tuple[int, int]) -> Lens:
        has_size = frame.get("w") and frame.get("h")
        is_reduced = still_to_downscale < downscale
        full = _full_size(path, stored, downscale) if is_reduced and not has_size else stored
        return _lens(frame, full, f"{file}: {name}", use)

    return PhotoFiles(
        name, image_file, still_to_downscale, lens_of,
        error_message=lambda error: f"{file}: {name}: its camera model {error}",
        mask=mask_to_read(_find_mask(file, frame, path, downscale), copies, is_named=bool(frame.get("mask_path"))),
        depths=_find_depths(file, frame, path),
    )  # fmt: skip


def _full_size(path: Path, stored: tuple[int, int], downscale: int) -> tuple[int, int]:
    """Return the (width, height) of the full image of a reduced one, to which the intrinsics belong.

    It is that of the full image's file, or `downscale` times the size `stored` of the reduced one if that file is
    missing or in object storage.
    """
    if not is_remote(path):
        with suppress(FileNotFoundError):
            return picture_size(locate_image(path.parent, path.name))
    return downscale * stored[0], downscale * stored[1]


def _shot(file: Path, frame: dict[str, Any], read: Reading) -> Shot:
    """Return one frame whose photograph is read."""
    name = Path(frame["file_path"]).as_posix()
    viewmat = _viewmat(frame["transform_matrix"], f"{file}: {name}")
    return Shot(name, viewmat, read.K, read.picture, read.facts.mask, read.rays, read.depth)


def _beside(file: Path, name: str) -> Path:
    """Return the path of a file that a scene names from the folder of its own file."""
    return file.parent / Path(name).as_posix()


def _find_depths(file: Path, frame: dict[str, Any], image: Path) -> Path | None:
    """Return the depth map that a frame names, or else that of its image in the folder `depths` beside `images`."""
    if frame.get("depth_file_path"):
        return _beside(file, frame["depth_file_path"])
    images = file.parent / "images"
    return find_depths(images, str(image.relative_to(images))) if image.is_relative_to(images) else None


def _find_mask(file: Path, frame: dict[str, Any], image: Path, downscale: int) -> tuple[Path, str] | None:
    """Return folder and name of the mask that a frame names, or of the one for its image in `masks` beside `images`."""
    if frame.get("mask_path"):
        path = _beside(file, frame["mask_path"])
        return path.parent, path.name
    images = file.parent / "images"
    return find_mask(images, str(image.relative_to(images)), downscale) if image.is_relative_to(images) else None


def _viewmat(transform_matrix: Any, what: str) -> np.ndarray:
    """Return world to camera (OpenCV) from camera to world (OpenGL)."""
    try:
        pose = np.asarray(transform_matrix, np.float64)
    except (TypeError, ValueError, OverflowError):
        pose = np.empty(0)
    if pose.shape not in ((3, 4), (4, 4)):
        raise ValueError(f"{what}: its transform_matrix must be 4x4 numbers; got shape {pose.shape}")
    camera_to_world = np.eye(4)
    camera_to_world[:3] = pose[:3] * [1.0, -1.0, -1.0, 1.0]
    return np.linalg.inv(rigid_viewmat(camera_to_world, what))


def _lens(frame: dict[str, Any], full: tuple[int, int], what: str, use: LensUse) -> Lens:
    """Return the camera of a frame; its size defaults to the full image's, the principal point to the centre."""
    width, height = _side(frame, "w", full[0], what), _side(frame, "h", full[1], what)
    fx, fy = _focal_lengths(frame, width, height, what)
    model, distortion = _distortion(frame, what)
    params = [fx, fy, _number(frame, "cx", width / 2, what), _number(frame, "cy", height / 2, what), *distortion]
    return checked_lens(pycolmap().Camera(model=model, width=width, height=height, params=params), what, use)


def _number(frame: dict[str, Any], key: str, default: float, what: str) -> float:
    """Return a number of a frame. Raise ValueError for anything else."""
    value = frame.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{what}: {key} must be a number; got {shortened(value)}")
    return float(value)


def _side(frame: dict[str, Any], key: str, default: int, what: str) -> int:
    """Return a side of the image in pixels; 0 and null stand for the image's own."""
    side = _number(frame, key, default, what) if frame.get(key) else default
    if not 1 <= side <= LONGEST_SIDE:  # False for NaN.
        raise ValueError(f"{what}: {key} must lie in 1..{LONGEST_SIDE} pixels; got {side:g}")
    return int(side)


def _focal_lengths(frame: dict[str, Any], width: int, height: int, what: str) -> tuple[float, float]:
    """Return (fx, fy) in pixels, from fl_x and fl_y or from the angles of view; one stands for both if alone."""
    lengths = {}
    for axis, size in (("x", width), ("y", height)):
        if f"fl_{axis}" in frame:
            lengths[axis] = _number(frame, f"fl_{axis}", 0.0, what)
        elif f"camera_angle_{axis}" in frame:
            angle = _number(frame, f"camera_angle_{axis}", 0.0, what)
            lengths[axis] = size / (2 * np.tan(angle / 2)) if 0 < angle < np.pi else 0.0
    if not lengths or not min(lengths.values()) > 0:
        raise ValueError(f"{what}: has no focal length; give fl_x above 0, or camera_angle_x between 0 and pi")
    return lengths.get("x", lengths.get("y", 0.0)), lengths.get("y", lengths.get("x", 0.0))


def _distortion(frame: dict[str, Any], what: str) -> tuple[str, list[float]]:
    """Return COLMAP's camera model and its distortion parameters; nerfstudio's have the same names and meaning."""
    model = "OPENCV_FISHEYE" if frame.get("is_fisheye") else frame.get("camera_model", "OPENCV")
    values = {key: _number(frame, key, 0.0, what) for key in PRISM_KEYS}
    if model == "OPENCV_FISHEYE":
        return model, [values[key] for key in FISHEYE_KEYS]
    if model == "THIN_PRISM_FISHEYE":
        return model, [values[key] for key in PRISM_KEYS]
    if model not in PERSPECTIVE_MODELS:
        wanted = "a perspective one, OPENCV_FISHEYE or THIN_PRISM_FISHEYE"
        raise ValueError(f"{what}: has the camera_model {shortened(model)}; {wanted} is expected")
    if values["k4"] != 0:
        raise ValueError(f"{what}: has k4 with a perspective camera; only k1, k2, k3, p1 and p2 are known there")
    return "FULL_OPENCV", [*(values[key] for key in OPENCV_KEYS), values["k3"], 0.0, 0.0, 0.0]


def _names(file_names: list[str]) -> set[str]:
    """Return the file names of a split, written like the shots' names."""
    return {Path(name).as_posix() for name in file_names}
