"""COLMAP's database: photographs with their cameras and rigs, features and matches."""

from contextlib import closing
from pathlib import Path
from typing import Literal

import numpy as np

from a2tg_jax.data.colmap_library import pycolmap
from a2tg_jax.data.progress import clock
from a2tg_jax.data.staging import CameraGroup, Rig, Staged
from a2tg_jax.host.machine import num_threads
from a2tg_jax.host.progress_bars import counting

Matching = Literal["auto", "exhaustive", "sequential"]
"""Pairs of photographs to match: all of them (exhaustive), neighbours by name (sequential), or by their number."""
CameraModel = Literal[
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE", "OPENCV_FISHEYE",
]  # fmt: skip
"""COLMAP's names of camera models that can be estimated from photographs."""
PHOTOS_PER_CORE = 2
"""Photographs of which features are extracted together, so that the progress bar moves."""


def extract_features(
    staged: Staged, names: list[str], database: Path, seed: int, camera_model: str, progress: bool
) -> None:
    """Extract features of the photographs into the database, a few photographs at a time."""
    colmap = pycolmap()
    colmap.set_random_seed(seed)
    # Listing the images first numbers them by name; otherwise the threads of the extraction do, by chance.
    database.touch()
    for group in (*staged.groups, *(group for rig in staged.rigs for group in rig.groups)):
        list_images(database, staged.folder, group, camera_model)
    for rig in staged.rigs:
        join_rig(database, rig)
    together = PHOTOS_PER_CORE * num_threads()
    with counting("features", len(names), "photo", is_shown=progress) as bar:
        for start in range(0, len(names), together):
            some = names[start : start + together]
            colmap.extract_features(database, staged.folder, some, device=colmap.Device.cpu)
            bar.update(len(some))


def list_images(database: Path, folder: Path, group: CameraGroup, camera_model: str) -> None:
    """Write photographs of one camera into the database."""
    colmap = pycolmap()
    reader = colmap.ImageReaderOptions(camera_model=camera_model)
    if group.focal is not None:
        reader.camera_model = "PINHOLE"
        reader.camera_params = f"{group.focal},{group.focal},{group.size[0] / 2},{group.size[1] / 2}"
    names = list(group.names)
    colmap.import_images(database, folder, options=reader, image_names=names, camera_mode=colmap.CameraMode.SINGLE)


def join_rig(database: Path, rig: Rig) -> None:
    """Tell the database that views of one panorama have one place and known directions."""
    colmap = pycolmap()
    cameras = [
        colmap.RigConfigCamera(
            ref_sensor=index == 0,
            image_prefix=f"{rig.folder}/{direction.name}/",
            cam_from_rig=colmap.Rigid3d(colmap.Rotation3d(direction.rotation), np.zeros(3)) if index else None,
        )
        for index, direction in enumerate(rig.directions)
    ]
    with closing(colmap.Database.open(database)) as opened:
        colmap.apply_rig_config([colmap.RigConfig(cameras=cameras)], opened)


def match_features(database: Path, num_photos: int, seed: int, matching: Matching, progress: bool) -> None:
    """Match features of pairs of photographs into the database."""
    colmap = pycolmap()
    verification = colmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    is_exhaustive = matching == "exhaustive"
    match = colmap.match_exhaustive if is_exhaustive else colmap.match_sequential
    pairs = f"{num_photos * (num_photos - 1) // 2:,} pairs" if is_exhaustive else "neighbours by name"
    with clock(f"matching {pairs}", progress):
        match(database, verification_options=verification, device=colmap.Device.cpu)


def featureless(database: Path) -> list[str]:
    """Return the names of the photographs in which no feature was found, sorted."""
    with closing(pycolmap().Database.open(database)) as opened:
        images = opened.read_all_images()
        return sorted(image.name for image in images if not opened.num_keypoints_for_image(image.image_id))


def num_matched_pairs(database: Path) -> int:
    """Return the number of pairs of photographs with verified matches."""
    with closing(pycolmap().Database.open(database)) as opened:
        return int(opened.num_verified_image_pairs())


def known_cameras(database: Path, staged: Staged) -> set[int]:
    """Return the numbers of the cameras of views of panoramas, whose calibration is exact."""
    groups = [group for rig in staged.rigs for group in rig.groups]
    with closing(pycolmap().Database.open(database)) as opened:
        return {opened.read_image_with_name(group.names[0]).camera_id for group in groups}
