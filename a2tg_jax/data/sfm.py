"""Structure from motion for plain photographs: COLMAP's features, matching and mapping, through pycolmap."""

import os
import shutil
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

from a2tg_jax.data.colmap_library import pycolmap
from a2tg_jax.data.decoding import check_picture
from a2tg_jax.data.images import map_in_threads

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
MAX_EXHAUSTIVE = 200
"""Largest number of photographs of which every pair is matched; beyond it, only neighbours by name."""
MIN_REGISTERED = 3


class SfmSummary(NamedTuple):
    """Result of `run_sfm`."""

    num_photos: int
    num_registered: int
    """Number of photographs with a pose."""
    num_points: int


def run_sfm(
    photos: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    seed: int = 0,
    camera_model: str = "SIMPLE_RADIAL",
    progress: bool = True,
) -> SfmSummary:
    """Estimate poses and points, and write a scene folder that `load_scene` reads.

    Every pair of photographs is matched, or neighbours by name if there are more than 200. Photographs of one size
    share one camera. The largest model found is kept and undistorted. It runs on the CPU with the seed wherever COLMAP
    takes one, and maps in one thread, so that runs reproduce.

    Args:
      photos: folder of photographs of one scene; subfolders are searched.
      out: new folder for `images` and `sparse/0`.
      seed: of COLMAP's random choices, at least 0.
      camera_model: COLMAP's name of the camera model to estimate.
      progress: show a progress bar.

    Returns:
      Counts of photographs, registered ones and points.

    Raises:
      FileNotFoundError: if there is no such folder of photographs.
      FileExistsError: if `out` holds a scene already.
      ValueError: if there are fewer than 3 photographs, or fewer than 3 could be registered, or one cannot be read.
    """
    photos, out = Path(photos), Path(out)
    names = find_photos(photos)
    for existing in (out / "images", out / "sparse"):
        if existing.exists():
            raise FileExistsError(f"{existing}: exists already; choose another output folder or remove it")
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out, prefix="sfm-") as folder, _quiet():
        work = Path(folder)
        bar = tqdm(total=len(names), unit="photo", disable=not progress)
        with bar:
            _match(photos, names, work / "database.db", seed, camera_model, bar)
            model = _map(photos, work, seed, bar)
        _check_model(model, len(names), photos)
        _write_scene(model, photos, work, out)
    return SfmSummary(len(names), model.num_reg_images(), model.num_points3D())


def find_photos(folder: Path) -> list[str]:
    """Return paths of the photographs below a folder, relative to it, sorted.

    Raises:
      FileNotFoundError: if there is no such folder.
      ValueError: if it holds fewer than 3 photographs, or one that cannot be opened.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder of photographs")
    files = [file for file in folder.rglob("*") if file.is_file() and file.suffix.lower() in PHOTO_SUFFIXES]
    if len(files) < MIN_REGISTERED:
        raise ValueError(f"{folder}: holds {len(files)} photographs; at least {MIN_REGISTERED} are needed")
    return sorted(file.relative_to(folder).as_posix() for file in files)


def _match(photos: Path, names: list[str], database: Path, seed: int, camera_model: str, bar: tqdm) -> None:
    """Extract features of the photographs and matches between them into the database."""
    colmap = pycolmap()
    colmap.set_random_seed(seed)
    mode = colmap.CameraMode.SINGLE if _have_one_size(photos, names) else colmap.CameraMode.AUTO
    reader = colmap.ImageReaderOptions(camera_model=camera_model)
    bar.set_description("features")
    # Listing the images first numbers them by name; otherwise the threads of the extraction do, by chance.
    database.touch()
    listing = {"image_names": names, "camera_mode": mode}
    colmap.import_images(database, photos, options=reader, **listing)
    colmap.extract_features(database, photos, reader_options=reader, device=colmap.Device.cpu, **listing)
    bar.set_description("matching")
    verification = colmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    match = colmap.match_exhaustive if len(names) <= MAX_EXHAUSTIVE else colmap.match_sequential
    match(database, verification_options=verification, device=colmap.Device.cpu)


def _map(photos: Path, work: Path, seed: int, bar: tqdm) -> Any:
    """Return the largest reconstruction of the matched photographs, or None."""
    colmap = pycolmap()
    options = colmap.IncrementalPipelineOptions(
        random_seed=seed, num_threads=1, min_model_size=MIN_REGISTERED, ba_use_gpu=False
    )
    options.mapper.random_seed = options.triangulation.random_seed = seed
    options.mapper.num_threads = 1
    bar.set_description("mapping")
    models = colmap.incremental_mapping(
        work / "database.db",
        photos,
        work,
        options=options,
        initial_image_pair_callback=lambda: bar.update(2),
        next_image_callback=lambda: bar.update(1),
    )
    return max(models.values(), key=lambda model: model.num_reg_images(), default=None)


def _check_model(model: Any, num_photos: int, photos: Path) -> None:
    """Raise ValueError without a usable model, and warn if many photographs have no pose."""
    num_registered = 0 if model is None else model.num_reg_images()
    advice = "sharp photographs that overlap by two thirds, from different places, work best"
    message = f"{photos}: only {num_registered} of {num_photos} photographs could be placed; {advice}"
    if num_registered < MIN_REGISTERED:
        raise ValueError(message)
    if num_registered < num_photos / 2:
        warnings.warn(message, stacklevel=3)


def _write_scene(model: Any, photos: Path, work: Path, out: Path) -> None:
    """Undistort the photographs of the model, and move images and sparse model to their places."""
    chosen, undistorted = work / "chosen", work / "undistorted"
    chosen.mkdir()
    model.write(chosen)
    pycolmap().undistort_images(undistorted, chosen, photos)
    (out / "sparse").mkdir()
    shutil.move(undistorted / "sparse", out / "sparse" / "0")
    shutil.move(undistorted / "images", out / "images")


def _have_one_size(photos: Path, names: list[str]) -> bool:
    """Return whether all photographs have the same size, as those of one camera have.

    Raises:
      ValueError: naming the first unreadable or too large photograph, because COLMAP's own reader has no bounds.
    """
    return len(set(map_in_threads(lambda name: check_picture(photos / name), names))) == 1


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep COLMAP's log to errors for a while."""
    logging = pycolmap().logging
    level, logging.minloglevel = logging.minloglevel, logging.ERROR.value
    try:
        yield
    finally:
        logging.minloglevel = level
