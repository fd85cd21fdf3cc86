"""COLMAP scenes: a sparse model (.bin or .txt) beside a folder of images."""

import logging
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from a2tg_jax.core.similarity import camera_centers
from a2tg_jax.data.assembly import PointCloud, Shot, assemble_scene, rigid_viewmat
from a2tg_jax.data.colmap_binary import RECORDS, check_binary
from a2tg_jax.data.colmap_library import pycolmap
from a2tg_jax.data.colmap_text import check_text
from a2tg_jax.data.depth_files import find_depths
from a2tg_jax.data.division import Division
from a2tg_jax.data.images import locate_image, map_in_threads, num_readers
from a2tg_jax.data.lenses import KeptLens, Lens, LensUse, checked_lens
from a2tg_jax.data.mask_files import FOLDER, check_masks, find_mask, mask_to_read
from a2tg_jax.data.observations import ObservedPoints, before_camera, observed_points
from a2tg_jax.data.photo_reading import PhotoFiles, Reading, read_photos
from a2tg_jax.data.photo_store import Shelf
from a2tg_jax.data.ply_points import read_ply_points
from a2tg_jax.data.scene import Scene, scene_name
from a2tg_jax.data.smaller_copies import SmallerCopies, find_copies
from a2tg_jax.data.splits import every_kth
from a2tg_jax.host.regular_files import is_folder, is_regular, open_regular
from a2tg_jax.host.remote_files import is_remote

MODEL_FOLDERS = ("sparse/0", "sparse", "", "0")
"""Folders of the model below a scene folder, in order of preference."""
EMPTY_POINTS = {".bin": bytes(8), ".txt": b""}
"""A points3D file with no points in it."""
POINTS_PLY = "points3D.ply"
"""Points of models without COLMAP's points3D."""
SAME_PLACE = 1e-3
"""Largest distance between the cameras of a panorama, in units of the distance between neighbouring frames."""

logger = logging.getLogger(__name__)


def find_model(path: Path) -> Path | None:
    """Return the folder of the sparse model of a scene folder, or None."""
    folders = [path / folder if folder else path for folder in MODEL_FOLDERS]
    return next((folder for folder in folders if _model_suffix(folder) is not None), None)


def _model_of(path: Path) -> Path:
    """Return the folder of the sparse model of a scene folder, or raise FileNotFoundError."""
    model = find_model(path)
    if model is None:
        raise FileNotFoundError(f"{path}: has no sparse model; expected sparse/0 with cameras, images and points3D")
    return model


def load_colmap(
    path: Path, *, downscale: int, test_every: int, room: int | None = None, lens: LensUse = "undistort",
    division: Division | None = None,
) -> Scene:  # fmt: skip
    """Read a COLMAP scene: every registered image as a view, and the sparse points.

    Args:
      path: the scene folder, or the folder of the model itself. The folder `images` (or `images_k`) may be in it,
        beside the model, or up to two folders above.
      downscale, test_every, room, lens: as in `load_scene`.
      division: processes that call this together; None: one.

    Raises:
      FileNotFoundError: if there is no model, no folder of images, or an image of the model is missing.
      ValueError: if the model or an image cannot be read, the aspects of an image and its camera differ, a camera
        cannot be undistorted, or the views make no scene (`assemble_scene`).
    """
    model = _model_of(path)
    reconstruction = _read_model(model)
    images_folder = _find_images_folder(path, model, downscale)
    cameras = reconstruction.cameras.items()
    lenses = {key: checked_lens(camera, f"{model}: camera {key}", lens) for key, camera in cameras}
    registered = [reconstruction.images[key] for key in reconstruction.reg_image_ids()]
    _log_unregistered(images_folder, len(registered))
    reach = SAME_PLACE * spacing(registered)

    masks = {image.name: find_mask(images_folder, image.name, downscale) for image in registered}
    files = [*((images_folder, name) for name in masks), *(mask for mask in masks.values() if mask is not None)]
    copies = find_copies(files, downscale, images_folder.parent)

    def photo(image: Any) -> PhotoFiles:
        mask = mask_to_read(masks[image.name], copies)
        return _photo(image, lenses[image.camera_id], images_folder, copies, mask)

    photos = map_in_threads(photo, registered, num_readers(path))
    found = read_photos(photos, Shelf(room), division, path)
    ids, cloud = np.array(sorted(reconstruction.points3D), np.uint64), read_points(reconstruction)

    def shot(image: Any, read: Reading) -> Shot:
        viewmat, mask, panorama = viewmat_of(image), read.facts.mask, panorama_of(image, reach)
        points = _observed_points(image, viewmat, ids, cloud.points, lenses[image.camera_id], read)
        return Shot(image.name, viewmat, read.K, read.picture, mask, read.rays, read.depth, panorama, points)

    shots = [shot(image, read) for image, read in zip(registered, found, strict=True)]
    check_masks(shots, str(path), images_folder.with_name(FOLDER))
    train, test = every_kth(shots, test_every)
    name = scene_name(images_folder.parent)
    return assemble_scene(name, train, test, _start_cloud(model, cloud), source=str(path))


def _start_cloud(model: Path, cloud: PointCloud) -> PointCloud:
    """Return the points to start from: a model's own, or the PLY file that networks of depth write in their place."""
    ply = model / POINTS_PLY
    has_own = any(is_regular(model / f"points3D{suffix}") for suffix in EMPTY_POINTS)
    return read_ply_points(ply) if not has_own and is_regular(ply) else cloud


def read_cameras_and_points(path: Path) -> tuple[np.ndarray, PointCloud]:
    """Return world-to-camera matrices [V, 4, 4] by name of the image, and the points, without reading images.

    Raises:
      FileNotFoundError, ValueError: as `load_colmap`.
    """
    model = _model_of(path)
    reconstruction = _read_model(model)
    images = sorted(
        (reconstruction.images[key] for key in reconstruction.reg_image_ids()), key=lambda image: image.name
    )
    return np.stack([viewmat_of(image) for image in images]), _start_cloud(model, read_points(reconstruction))


def read_points(reconstruction: Any) -> PointCloud:
    """Return the points of a pycolmap.Reconstruction, in the order of their ids."""
    points = [reconstruction.points3D[key] for key in sorted(reconstruction.points3D)]
    return PointCloud(
        np.array([point.xyz for point in points]).reshape(-1, 3),
        np.array([point.color for point in points], np.uint8).reshape(-1, 3),
    )


def viewmat_of(image: Any) -> np.ndarray:
    """Return the world-to-camera matrix [4, 4] of a registered pycolmap.Image (a method since pycolmap 4, before a
    property)."""
    pose = image.cam_from_world
    viewmat = np.eye(4)
    viewmat[:3] = (pose() if callable(pose) else pose).matrix()
    return rigid_viewmat(viewmat, image.name)


def _photo(
    image: Any, lens: Lens, images_folder: Path, copies: SmallerCopies, mask: tuple[Path, int] | None
) -> PhotoFiles:
    """Return the files and the lens of one registered image."""
    folder, still_to_downscale = copies.of(images_folder)
    file = locate_image(folder, image.name)

    def error_message(error: Exception) -> str:
        if isinstance(lens, KeptLens):
            return f"{file}: its camera model {error}"
        return f"{file}: its camera model {error}; undistort the scene with COLMAP first"

    return PhotoFiles(
        image.name, file, still_to_downscale, lambda _: lens, error_message,
        mask=mask, depths=find_depths(images_folder, image.name),
    )  # fmt: skip


def _observed_points(
    image: Any, viewmat: np.ndarray, ids: np.ndarray, positions: np.ndarray, lens: Lens, read: Reading
) -> ObservedPoints | None:
    """Return the points that a registered image observed, in units of the original world; None if it observed none.

    Args:
      image: of the reconstruction.
      viewmat: its world-to-camera matrix [4, 4].
      ids: [P] uint64 ids of all points, in ascending order.
      positions: [P, 3].
      lens: of its photograph.
      read: the photograph.
    """
    own = np.array([feature.point3D_id for feature in image.get_observation_points2D()], np.uint64)
    own = own[np.isin(own, ids)]
    if not len(own):
        return None
    points, size = before_camera(positions[np.searchsorted(ids, own)], viewmat), read.picture.size
    return observed_points(lens.projected(points, read.K, size[::-1]), points[:, 2], size)


def spacing(images: Sequence[Any]) -> float:
    """Return the median distance of a frame of images (pycolmap.Image) to the nearest other one; 0 of one frame."""
    viewmats = {image.frame_id: viewmat_of(image) for image in images}
    if len(viewmats) < 2:
        return 0.0
    centers = camera_centers(np.stack(list(viewmats.values())))
    distances, _ = cKDTree(centers).query(centers, k=2)
    return float(np.median(distances[:, 1]))


def panorama_of(image: Any, reach: float = 0.0) -> int | None:
    """Return the number of the frame of a pycolmap.Image whose rig looks around from one point; None of others.

    Args:
      image: a registered image.
      reach: largest distance of a camera from the rig's origin, for what a refinement of the rig leaves of zero.
    """
    rig = image.frame.rig
    if rig.num_sensors() < 2:
        return None
    poses = rig.non_ref_sensors.values()
    is_one_point = all(pose is not None and np.linalg.norm(pose.translation) <= reach for pose in poses)
    return int(image.frame_id) if is_one_point else None


def _model_suffix(folder: Path) -> str | None:
    """Return ".bin" or ".txt", the format of the model in a folder (COLMAP prefers .bin), or None."""
    for suffix in EMPTY_POINTS:
        if all(is_regular(folder / f"{name}{suffix}") for name in ("cameras", "images")):
            return suffix
    return None


def _read_model(model: Path) -> Any:
    """Return the pycolmap.Reconstruction in a folder; without a points3D file, it has no points."""
    suffix = _model_suffix(model) or ".bin"
    check = check_binary if suffix == ".bin" else check_text
    with _on_disk(model, suffix) as on_disk:
        for name in (f"{kind}{suffix}" for kind in RECORDS):
            if is_regular(on_disk / name):
                check(model / name, on_disk / name)
        try:
            with _with_points_file(on_disk, suffix) as folder:
                return pycolmap().Reconstruction(str(folder))
        except Exception as error:  # whatever pycolmap makes of C++'s
            reason = " ".join(str(error).split())
            raise ValueError(f"{model}: cannot be read as a COLMAP model ({reason}); export it again") from None


@contextmanager
def _on_disk(model: Path, suffix: str) -> Iterator[Path]:
    """Return the model's folder, or a temporary copy of a remote one."""
    if not is_remote(model):
        yield model
        return
    with tempfile.TemporaryDirectory() as folder:
        for file in (model / f"{kind}{suffix}" for kind in RECORDS):
            if is_regular(file):
                with open_regular(file) as source, open(Path(folder) / file.name, "wb") as target:
                    shutil.copyfileobj(source, target)
        yield Path(folder)


@contextmanager
def _with_points_file(model: Path, suffix: str) -> Iterator[Path]:
    """Return the model's folder, or a temporary copy with an empty points3D if that file is missing."""
    if is_regular(model / f"points3D{suffix}"):
        yield model
        return
    with tempfile.TemporaryDirectory() as folder:
        for file in (model / f"{kind}{suffix}" for kind in RECORDS):
            if file.is_file():
                (Path(folder) / file.name).write_bytes(file.read_bytes())
        (Path(folder) / f"points3D{suffix}").write_bytes(EMPTY_POINTS[suffix])
        yield Path(folder)


def _find_images_folder(path: Path, model: Path, downscale: int) -> Path:
    """Return the folder `images` of the model's scene; it need not exist if `images_k` does."""
    model = model.resolve()
    for base in (path.resolve(), model, *model.parents[:2]):
        if is_folder(base / "images") or (downscale > 1 and is_folder(base / f"images_{downscale}")):
            return base / "images"
    raise FileNotFoundError(f"{path}: has no folder 'images'; put the model's photographs there")


def _log_unregistered(images_folder: Path, num_registered: int) -> None:
    """Log the number of files in a folder of this machine that are not registered images."""
    if not is_remote(images_folder) and images_folder.is_dir():
        others = sum(file.is_file() for file in images_folder.rglob("*")) - num_registered
        if others > 0:
            logger.info("%s: %d files have no pose in the model and are not used", images_folder, others)
