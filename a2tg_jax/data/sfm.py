"""Structure from motion for plain photographs, videos and panoramas: COLMAP's features, matching and mapping."""

import os
import shutil
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from tqdm import tqdm

from a2tg_jax.core.display import counted
from a2tg_jax.data.colmap_library import pycolmap
from a2tg_jax.data.photo_folder import LEAST_PHOTOS
from a2tg_jax.data.staging import CameraGroup, Panorama, Rig, Staged, stage
from a2tg_jax.data.video import DEFAULT_FRAMES
from a2tg_jax.host.cores import num_threads

Matching = Literal["auto", "exhaustive", "sequential"]
"""Pairs of photographs to match: all of them (exhaustive), neighbours by name (sequential), or by their number."""
MAX_EXHAUSTIVE = 200
"""Number of photographs beyond which "auto" matches only neighbours in name order."""
MIN_REGISTERED = 3
PHOTOS_PER_CORE = 2
"""Photographs of which features are extracted together, so that the progress bar moves."""
TICK = 0.5
"""Seconds between two readings of the clock of a phase without countable progress."""
ADVICE = "take more, sharp and closer together: they should overlap by two thirds and show texture, unlike blank walls"


class SfmSummary(NamedTuple):
    """Result of `run_sfm`."""

    num_photos: int
    """Number of photographs: files, frames of videos, and views of panoramas."""
    num_registered: int
    """Number of photographs with a pose."""
    num_points: int
    mean_error: float
    """Mean reprojection error of the points, in pixels."""
    longest_side: int
    """Larger of width and height of the largest photograph with a pose, in pixels."""


def run_sfm(
    photos: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    *,
    seed: int = 0,
    camera_model: str = "SIMPLE_RADIAL",
    matching: Matching = "auto",
    frames: int = DEFAULT_FRAMES,
    panorama: Panorama = "auto",
    progress: bool = True,
    on_note: Callable[[str], None] = lambda line: None,
) -> SfmSummary:
    """Estimate poses and points, and write a scene folder that `load_scene` reads.

    Photographs of one source, size and lens share one camera, whose focal length starts from EXIF data. The largest
    model found is kept and undistorted. It runs on the CPU with the seed wherever COLMAP takes one, and maps in one
    thread, so that runs reproduce.

    Args:
      photos: folder of photographs of one scene, whose subfolders are searched, or a video, or several of these.
      out: new folder for `images` and `sparse/0`.
      seed: of COLMAP's random choices, at least 0.
      camera_model: COLMAP's name of the camera model to estimate.
      matching: pairs of photographs to match; "auto" takes all pairs of up to 200, and neighbours by name of more.
      frames: largest number of frames to take from each video. The sharpest are taken, evenly along the camera's way.
      panorama: pictures to cut into perspective views: "auto" takes those twice as wide as high whose edges join,
        "yes" all that are twice as wide as high.
      progress: show progress bars.
      on_note: takes lines about what was found among the photographs.

    Returns:
      Counts of photographs, registered ones and points, and the reprojection error.

    Raises:
      FileNotFoundError: if there is no such folder of photographs.
      FileExistsError: if `out` is a file, or holds a scene already.
      ValueError: if there are fewer than 3 photographs, or fewer than 3 could be registered, or one cannot be read.
    """
    for name, value, known in (("matching", matching, Matching), ("panorama", panorama, Panorama)):
        if value not in get_args(known):
            raise ValueError(f"{name} must be one of {', '.join(get_args(known))}; got {value!r}")
    if frames < LEAST_PHOTOS:
        raise ValueError(f"frames must be at least {LEAST_PHOTOS}; got {frames}")
    sources = [Path(photos)] if isinstance(photos, str | os.PathLike) else [Path(source) for source in photos]
    out = Path(out)
    _check_new(out)
    with _new_folder(out), tempfile.TemporaryDirectory(dir=out, prefix="sfm-") as folder, _quiet():
        work = Path(folder)
        staged = stage(sources, work, frames=frames, panorama=panorama, progress=progress, tell=on_note)
        names, told = staged.names, ", ".join(map(str, sources))
        if len(names) < LEAST_PHOTOS:
            raise ValueError(f"{told}: {len(names)} photographs; at least {LEAST_PHOTOS} are needed")
        if matching == "auto":
            matching = "exhaustive" if len(names) <= MAX_EXHAUSTIVE else "sequential"
        database = work / "database.db"
        _extract(staged, names, database, seed, camera_model, progress)
        _match(database, len(names), seed, matching, progress)
        model = _map(staged, work, seed, progress)
        _check_model(model, len(names), told, matching, _num_matched(database))
        with _clock("undistorting", progress):
            _write_scene(model, staged.folder, work, out)
    error = model.compute_mean_reprojection_error()
    return SfmSummary(len(names), model.num_reg_images(), model.num_points3D(), error, _longest_side(model))


def _check_new(out: Path) -> None:
    """Raise FileExistsError if there is a scene or a file already."""
    for existing in (out / "images", out / "sparse"):
        if existing.exists():
            raise FileExistsError(f"{existing}: exists already; choose another output folder or remove it")
    if out.is_file():
        raise FileExistsError(f"{out} is a file; choose a folder for the scene")


def _extract(staged: Staged, names: list[str], database: Path, seed: int, camera_model: str, progress: bool) -> None:
    """Extract features of the photographs into the database, a few photographs at a time."""
    colmap = pycolmap()
    colmap.set_random_seed(seed)
    # Listing the images first numbers them by name; otherwise the threads of the extraction do, by chance.
    database.touch()
    for group in (*staged.groups, *(group for rig in staged.rigs for group in rig.groups)):
        _list_images(database, staged.folder, group, camera_model)
    for rig in staged.rigs:
        _join(database, rig)
    together = PHOTOS_PER_CORE * num_threads()
    with _bar("features", len(names), progress) as bar:
        for start in range(0, len(names), together):
            some = names[start : start + together]
            colmap.extract_features(database, staged.folder, some, device=colmap.Device.cpu)
            bar.update(len(some))


def _list_images(database: Path, folder: Path, group: CameraGroup, camera_model: str) -> None:
    """Write photographs of one camera into the database."""
    colmap = pycolmap()
    reader = colmap.ImageReaderOptions(camera_model=camera_model)
    if group.focal is not None:
        reader.camera_model = "PINHOLE"
        reader.camera_params = f"{group.focal},{group.focal},{group.size[0] / 2},{group.size[1] / 2}"
    names = list(group.names)
    colmap.import_images(database, folder, options=reader, image_names=names, camera_mode=colmap.CameraMode.SINGLE)


def _join(database: Path, rig: Rig) -> None:
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


def _num_matched(database: Path) -> int:
    """Return the number of pairs of photographs with verified matches."""
    with closing(pycolmap().Database.open(database)) as opened:
        return int(opened.num_verified_image_pairs())


def _match(database: Path, num_photos: int, seed: int, matching: Matching, progress: bool) -> None:
    """Match features of pairs of photographs into the database."""
    colmap = pycolmap()
    verification = colmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    is_exhaustive = matching == "exhaustive"
    match = colmap.match_exhaustive if is_exhaustive else colmap.match_sequential
    pairs = f"{num_photos * (num_photos - 1) // 2:,} pairs" if is_exhaustive else "neighbours by name"
    with _clock(f"matching {pairs}", progress):
        match(database, verification_options=verification, device=colmap.Device.cpu)


def _map(staged: Staged, work: Path, seed: int, progress: bool) -> Any:
    """Return the largest reconstruction of the matched photographs, or None."""
    colmap = pycolmap()
    options = colmap.IncrementalPipelineOptions(
        random_seed=seed, num_threads=1, min_model_size=MIN_REGISTERED, ba_use_gpu=False
    )
    options.mapper.random_seed = options.triangulation.random_seed = seed
    options.mapper.num_threads = 1
    if staged.rigs:
        options.ba_refine_sensor_from_rig = False
        options.constant_cameras = _camera_ids(work / "database.db", staged)
    with _bar("mapping", staged.num_places, progress) as bar:
        models = colmap.incremental_mapping(
            work / "database.db",
            staged.folder,
            work,
            options=options,
            initial_image_pair_callback=lambda: bar.update(2),
            next_image_callback=lambda: bar.update(1),
        )
    return max(models.values(), key=lambda model: model.num_reg_images(), default=None)


def _camera_ids(database: Path, staged: Staged) -> set[int]:
    """Return the numbers of the cameras of views of panoramas, whose calibration is exact."""
    groups = [group for rig in staged.rigs for group in rig.groups]
    with closing(pycolmap().Database.open(database)) as opened:
        return {opened.read_image_with_name(group.names[0]).camera_id for group in groups}


def _check_model(model: Any, num_photos: int, told: str, matching: Matching, num_matched: int) -> None:
    """Raise ValueError without a usable model, and warn if many photographs have no pose."""
    num_registered = 0 if model is None else model.num_reg_images()
    advice = ADVICE
    if matching == "sequential":
        advice += "; only neighbours by name were matched: name them in the order of taking, or choose --matching "
        advice += "exhaustive"
    placed = f"only {num_registered} of" if num_registered else "none of the"
    message = (
        f"{told}: {placed} {num_photos} photographs could be placed ({counted(num_matched, 'pair')} match); {advice}"
    )
    if num_registered < MIN_REGISTERED:
        raise ValueError(message)
    if num_registered < num_photos / 2:
        warnings.warn(message, stacklevel=3)


def _longest_side(model: Any) -> int:
    return max(int(side) for camera in model.cameras.values() for side in (camera.width, camera.height))


def _write_scene(model: Any, photos: Path, work: Path, out: Path) -> None:
    """Undistort the photographs of the model, and move images and sparse model to their places."""
    chosen, undistorted = work / "chosen", work / "undistorted"
    chosen.mkdir()
    model.write(chosen)
    pycolmap().undistort_images(undistorted, chosen, photos)
    (out / "sparse").mkdir()
    shutil.move(undistorted / "sparse", out / "sparse" / "0")
    shutil.move(undistorted / "images", out / "images")


@contextmanager
def _new_folder(folder: Path) -> Iterator[None]:
    """Make a folder. If the block fails, remove what was made, as far as it is empty."""
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        with suppress(OSError):
            for path in made:
                path.rmdir()
        raise


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep COLMAP's log to what ends the process for a while; errors are told by exceptions."""
    logging = pycolmap().logging
    level, logging.minloglevel = logging.minloglevel, logging.FATAL.value
    try:
        yield
    finally:
        logging.minloglevel = level


def _bar(phase: str, num_photos: int, progress: bool) -> tqdm:
    """Return a progress bar that counts photographs."""
    return tqdm(total=num_photos, desc=phase, unit="photo", disable=not progress)


@contextmanager
def _clock(phase: str, progress: bool) -> Iterator[None]:
    """Show a phase that tells no progress with the time since its start."""
    ended = threading.Event()
    with tqdm(desc=phase, bar_format="{desc}: {elapsed}", disable=not progress) as bar:

        def tick() -> None:
            while not ended.wait(TICK):
                bar.refresh()

        ticking = threading.Thread(target=tick, daemon=True)
        ticking.start()
        try:
            yield
        finally:
            ended.set()
            ticking.join()
