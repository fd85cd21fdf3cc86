"""COLMAP scenes: a sparse model (.bin or .txt) next to a folder of images."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from a2tg_jax import Scene, Similarity
from a2tg_jax.base.regular_files import is_regular, names_in
from a2tg_jax.base.text import counted
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.data.assembly import PointCloud, assemble_scene, every_kth, rigid_viewmat, scene_name
from a2tg_jax.data.capture_geometry import camera_centers
from a2tg_jax.data.colmap_cameras import ColmapCamera
from a2tg_jax.data.colmap_files import KINDS, POINT, ImageRecord, num_images, read_file
from a2tg_jax.data.image_files import inside, on_disk, warn_of_unposed
from a2tg_jax.data.lenses import checked_lens
from a2tg_jax.data.photo_reading import Photo, SceneOptions, read_photos
from a2tg_jax.data.photo_store import Shelf
from a2tg_jax.data.ply import read_ply_points

SUFFIXES = (".bin", ".txt")
"""Suffixes of a model's files, in COLMAP's order of preference."""
IMAGES = "images"
"""Folder of photographs in a scene folder."""
TRIED_NAMES = 10
"""Number of photographs to look for before giving up on a folder."""
POINTS_PLY = "points3D.ply"
"""Points of models without COLMAP's points3D, as depth networks write them."""
LARGEST_MISFIT = 0.02
"""Largest distance between the places of a camera in two reconstructions, in units of the cameras' extent."""
SAME_PLACE = 1e-4
"""Largest distance between the cameras of a panorama, in units of the median distance of all cameras from their median.
Cameras of a refined rig differ by about a tenth of that."""


class SparseModel(NamedTuple):
    """Sparse model."""

    cameras: dict[int, ColmapCamera]
    """Cameras by id."""
    images: list[ImageRecord]
    points: np.ndarray
    """[P] `POINT`, by id."""

    @property
    def viewmats(self) -> np.ndarray:
        """World-to-camera matrices [V, 4, 4] of the images."""
        return np.array([viewmat_of(image) for image in self.images]).reshape(-1, 4, 4)  # [0, 4, 4] without images.


def find_models(path: Path) -> list[Path]:
    """Return the folders of sparse models in a scene folder, first the folder itself, then as COLMAP numbers them."""
    sparse = path / "sparse"
    folders = [path, *_numbered_in(sparse), sparse, *_numbered_in(path)]
    return [folder for folder in folders if model_files(folder)]


def _numbered_in(folder: Path) -> list[Path]:
    """Return the files and folders in a folder whose names are numbers, in their order."""
    return [folder / name for name in sorted(filter(str.isdecimal, names_in(folder)), key=int)]


def _model_of(path: Path) -> Path:
    """Return the folder of the sparse model of a scene folder: itself, or of several the one with the most images.

    A warning names the others.
    """
    models = find_models(path)
    if not models:
        raise FileNotFoundError(f"{path}: has no sparse model; expected sparse/0 with cameras, images and points3D")
    if len(models) == 1:
        return models[0]
    counts = {model: num_images(model_files(model)["images"]) for model in models}
    # A model's own folder, if given, is the user's choice.
    chosen = path if path in models else max(models, key=lambda model: counts[model])

    def described(model: Path) -> str:
        place = model.relative_to(path).as_posix()
        return f"{'its own' if place == '.' else place} ({counted(counts[model], 'image')})"

    others = [model for model in models if model != chosen]
    warn(
        f"{path}: has {len(models)} COLMAP models; {described(chosen)} is read, and not "
        f"{', '.join(map(described, others))}; to read another, give its folder, such as {others[0]}"
    )
    return chosen


def load_colmap(path: Path, options: SceneOptions, shelf: Shelf) -> Scene:
    """Read a COLMAP scene: every registered image as a view, and the sparse points.

    The path is the scene folder, or the folder of the model itself. The folder `images` (or `images_k`) may be in it,
    next to the model, or up to two folders above. Views that share a place, as of a panorama, count as one.
    """
    model = _model_of(path)
    contents = _read_model(model)
    scene, folder = _find_photos(path, model, contents.images, options.downscale)
    images = [image._replace(name=inside(folder, image.name)) for image in contents.images]
    used = sorted({image.camera_id for image in images})
    lenses = {key: checked_lens(contents.cameras[key], f"{model}: camera {key}", options.lens) for key in used}
    # Folders in the scene folder itself may hold other pictures.
    warn_of_unposed(folder, [image.name for image in images], is_deep=folder != scene)
    viewmats = contents.viewmats
    photos = []
    for image, viewmat, panorama in zip(images, viewmats, _panoramas(viewmats), strict=True):
        file = (folder, image.name)
        below_images = (scene / IMAGES, image.name)
        lens = lenses[image.camera_id]
        photos.append(Photo(image.name, viewmat, file, below_images, lens, str(folder / image.name), panorama=panorama))

    def how_to_remove(name: str) -> str:
        file = model_files(model)["images"]
        if file.suffix.lower() == ".txt":
            return f"delete its two lines in {file}"
        return (
            f"remove it from the model in Python: import pycolmap; model = pycolmap.Reconstruction({str(model)!r}); "
            f"model.deregister_frame(model.find_image_with_name({name!r}).frame_id); model.write({str(model)!r})"
        )

    shots = read_photos(photos, options, shelf, path, scene, how_to_remove)
    train, test = every_kth(shots, options.test_every)
    return assemble_scene(scene_name(scene), train, test, _start_cloud(model, contents), source=str(path))


def _start_cloud(model: Path, contents: SparseModel) -> PointCloud:
    """Return the points to start from: the model's, or else those in `POINTS_PLY`."""
    ply = None if len(contents.points) else on_disk(model, POINTS_PLY)
    return PointCloud(contents.points["position"], contents.points["color"]) if ply is None else read_ply_points(ply)


def read_cameras_and_points(path: Path) -> tuple[np.ndarray, PointCloud]:
    """Return world-to-camera matrices [V, 4, 4] by name of the image, and the points, without reading images."""
    model = _model_of(path)
    contents = _read_model(model)
    return contents.viewmats[np.argsort([image.name for image in contents.images])], _start_cloud(model, contents)


def points_in_world_of(path: Path, viewmats: Mapping[str, np.ndarray]) -> PointCloud | None:
    """Return the points of a COLMAP model in the world of other poses [4, 4] of its photographs, by name.

    Programs turn, scale and move COLMAP's world, and not all of them write down how, so the poses decide. None, with a
    warning, if they do not fit; None if there is no model.
    """
    if not find_models(path):
        return None
    model = _model_of(path)
    contents = _read_model(model)
    names = [_plain_name(image.name) for image in contents.images]
    poses = dict(zip(names, contents.viewmats, strict=True))
    others = {_plain_name(name): viewmat for name, viewmat in viewmats.items()}
    shared = sorted(poses.keys() & others.keys())
    to_world = None
    if shared:
        to_world = _between(np.stack([poses[name] for name in shared]), np.stack([others[name] for name in shared]))
    if to_world is None:
        warn(f"{model}: has other photographs or poses than the scene: its points are not used")
        return None
    cloud = _start_cloud(model, contents)
    return PointCloud(to_world.apply(cloud.points), cloud.colors)


def _plain_name(name: str) -> str:
    """Return the path of a photograph below its folder `images` or `images_k`, without suffix."""
    return re.sub(r"^images(_\d+)?/", "", PurePosixPath(name.replace("\\", "/")).with_suffix("").as_posix())


def _between(viewmats: np.ndarray, others: np.ndarray) -> Similarity | None:
    """Return the similarity from the world of poses [V, 4, 4] to the world of other poses of the same cameras; None if
    there is none."""
    # A camera has the same axes in both: Rᵀ of the others is rotation·Rᵀ.
    left, _, right = np.linalg.svd(np.einsum("vji,vjk->ik", others[:, :3, :3], viewmats[:, :3, :3]))
    rotation = left @ right
    centers = camera_centers(viewmats) @ rotation.T
    wanted = camera_centers(others)
    around = centers - centers.mean(axis=0)
    wanted_around = wanted - wanted.mean(axis=0)
    if not around.any():
        return None
    scale = float((around * wanted_around).sum() / (around**2).sum())
    misfit = np.linalg.norm(scale * around - wanted_around, axis=1).max()
    if np.linalg.det(rotation) < 0 or not misfit <= LARGEST_MISFIT * np.linalg.norm(wanted_around, axis=1).max():
        return None
    return Similarity(scale, rotation, wanted.mean(axis=0) - scale * centers.mean(axis=0))


def viewmat_of(image: ImageRecord) -> np.ndarray:
    """Return the world-to-camera matrix [4, 4] of an image. Its quaternion may have any length but 0."""
    viewmat = np.eye(4)
    viewmat[:3, 3] = image.pose[4:]
    quaternion = np.array(image.pose[:4])
    length = np.linalg.norm(quaternion)
    if length == 0:
        raise ValueError(f"{image.name}: its pose has a quaternion of zeros; remove it from the model")
    viewmat[:3, :3] = np.nan  # rigid_viewmat reports it.
    if np.isfinite(length):
        viewmat[:3, :3] = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    return rigid_viewmat(viewmat, image.name)


def _panoramas(viewmats: np.ndarray) -> list[int | None]:
    """Return for each view [V, 4, 4] a number of its place, if other views share it (`SAME_PLACE`), or None."""
    if not len(viewmats):
        return []
    centers = camera_centers(viewmats)
    distances = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
    reach = SAME_PLACE * float(np.median(distances))
    tree = cKDTree(centers)
    places: dict[int, int] = {}
    for view, center in enumerate(centers):
        if view not in places:
            here = tree.query_ball_point(center, reach)
            if len(here) > 1:
                places.update(dict.fromkeys(here, view))
    return [places.get(view) for view in range(len(centers))]


def model_files(folder: Path) -> dict[str, Path]:
    """Return the files of the model in a folder by kind, whatever their capitals; none if it has no model."""
    names = {name.lower(): name for name in names_in(folder)}
    for suffix in SUFFIXES:
        files = {}
        for kind in KINDS:
            name = names.get(f"{kind}{suffix}".lower())
            if name is not None and is_regular(folder / name):
                files[kind] = folder / name
        if "cameras" in files and "images" in files:
            return files
    return {}


def _read_model(model: Path) -> SparseModel:
    """Return the model in a folder; without a points3D file, it has no points."""
    files = model_files(model)
    records = {kind: read_file(file, kind) for kind, file in files.items()}
    cameras = dict(records["cameras"])
    if len(cameras) < len(records["cameras"]):
        raise ValueError(f"{files['cameras']}: has two cameras of one number; give each its own, in the images too")
    images = records["images"]
    text = on_disk(model, "images.txt") if files["images"].suffix.lower() == ".bin" else None
    num_in_text = len(images) if text is None else num_images(text)
    if num_in_text != len(images):
        warn(
            f"{model}: is read from its .bin files, with {counted(len(images), 'image')}, and not from its "
            f".txt files, with {num_in_text}; to read those, move the .bin files away"
        )
    for image in images:
        if image.camera_id not in cameras:
            raise ValueError(
                f"{files['images']}: {image.name} has the camera {image.camera_id}, which is not in "
                f"{files['cameras'].name}; export the model again"
            )
    points = records.get("points3D", np.empty(0, POINT))
    # Files have points in any order; by id, a model starts alike from its binary and its text files.
    points = points[np.argsort(points["id"], kind="stable")]
    return SparseModel(cameras, images, points)


def _find_photos(path: Path, model: Path, images: Sequence[ImageRecord], downscale: int) -> tuple[Path, Path]:
    """Return a model's scene folder, and the folder that its image names start from.

    That is `images`, which need not exist if `images_k` does, or else the scene folder itself, with the photographs
    next to the model or named with their folder.
    """
    model = model.resolve()
    bases = [path.resolve(), model, *model.parents[:2]]  # sparse/0 is two below the scene.
    bases += [base.parent for base in bases if base.name == "colmap"]  # nerfstudio's colmap/sparse/0

    def holds_some(folder: Path) -> bool:
        return any(on_disk(folder, image.name.replace("\\", "/")) for image in images[:TRIED_NAMES])

    for base in bases:
        names = sorted((name for name in names_in(base) if name.lower() == IMAGES), reverse=True)  # "images" first
        folder = next((base / name for name in names if (base / name).is_dir()), None)
        if folder is not None:
            # A folder `images` may be another program's, or be part of the names.
            return base, base if holds_some(base) and not holds_some(folder) else folder
        if downscale > 1 and (base / f"{IMAGES}_{downscale}").is_dir():
            return base, base / IMAGES
    for base in bases:
        if holds_some(base):
            return base, base
    raise FileNotFoundError(f"{path}: has no folder 'images'; put the model's photographs there")
