"""Structure from motion for plain photographs: COLMAP's features, matching and mapping, through pycolmap."""

import os
import shutil
import tempfile
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

from tqdm import tqdm

from a2tg_jax.data.colmap_library import pycolmap
from a2tg_jax.data.decoding import check_picture
from a2tg_jax.data.images import map_in_threads
from a2tg_jax.data.photo_folder import find_photos
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
    num_registered: int
    """Number of photographs with a pose."""
    num_points: int
    longest_side: int
    """Larger of width and height of the largest photograph with a pose, in pixels."""


def run_sfm(
    photos: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    seed: int = 0,
    camera_model: str = "SIMPLE_RADIAL",
    matching: Matching = "auto",
    progress: bool = True,
) -> SfmSummary:
    """Estimate poses and points, and write a scene folder that `load_scene` reads.

    Photographs of one size share one camera. The largest model found is kept and undistorted. It runs on the CPU with
    the seed wherever COLMAP takes one, and maps in one thread, so that runs reproduce.

    Args:
      photos: folder of photographs of one scene; subfolders are searched.
      out: new folder for `images` and `sparse/0`.
      seed: of COLMAP's random choices, at least 0.
      camera_model: COLMAP's name of the camera model to estimate.
      matching: pairs of photographs to match; "auto" takes all pairs of up to 200, and neighbours by name of more.
      progress: show progress bars.

    Returns:
      Counts of photographs, registered ones and points.

    Raises:
      FileNotFoundError: if there is no such folder of photographs.
      FileExistsError: if `out` is a file, or holds a scene already.
      ValueError: if there are fewer than 3 photographs, or fewer than 3 could be registered, or one cannot be read.
    """
    if matching not in get_args(Matching):
        raise ValueError(f"matching must be one of {', '.join(get_args(Matching))}; got {matching!r}")
    photos, out = Path(photos), Path(out)
    names = find_photos(photos)
    for existing in (out / "images", out / "sparse"):
        if existing.exists():
            raise FileExistsError(f"{existing}: exists already; choose another output folder or remove it")
    if out.is_file():
        raise FileExistsError(f"{out} is a file; choose a folder for the scene")
    with _new_folder(out), tempfile.TemporaryDirectory(dir=out, prefix="sfm-") as folder, _quiet():
        work = Path(folder)
        if matching == "auto":
            matching = "exhaustive" if len(names) <= MAX_EXHAUSTIVE else "sequential"
        _extract(photos, names, work / "database.db", seed, camera_model, progress)
        _match(work / "database.db", len(names), seed, matching, progress)
        model = _map(photos, work, len(names), seed, progress)
        _check_model(model, len(names), photos, matching)
        with _clock("undistorting", progress):
            _write_scene(model, photos, work, out)
    return SfmSummary(len(names), model.num_reg_images(), model.num_points3D(), _longest_side(model))


def _extract(photos: Path, names: list[str], database: Path, seed: int, camera_model: str, progress: bool) -> None:
    """Extract features of the photographs into the database, a few photographs at a time."""
    colmap = pycolmap()
    colmap.set_random_seed(seed)
    mode = colmap.CameraMode.SINGLE if _have_one_size(photos, names) else colmap.CameraMode.AUTO
    reader = colmap.ImageReaderOptions(camera_model=camera_model)
    # Listing the images first numbers them by name; otherwise the threads of the extraction do, by chance.
    database.touch()
    colmap.import_images(database, photos, options=reader, image_names=names, camera_mode=mode)
    together = PHOTOS_PER_CORE * num_threads()
    with _bar("features", len(names), progress) as bar:
        for start in range(0, len(names), together):
            some = names[start : start + together]
            colmap.extract_features(
                database, photos, some, camera_mode=mode, reader_options=reader, device=colmap.Device.cpu
            )
            bar.update(len(some))


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


def _map(photos: Path, work: Path, num_photos: int, seed: int, progress: bool) -> Any:
    """Return the largest reconstruction of the matched photographs, or None."""
    colmap = pycolmap()
    options = colmap.IncrementalPipelineOptions(
        random_seed=seed, num_threads=1, min_model_size=MIN_REGISTERED, ba_use_gpu=False
    )
    options.mapper.random_seed = options.triangulation.random_seed = seed
    options.mapper.num_threads = 1
    with _bar("mapping", num_photos, progress) as bar:
        models = colmap.incremental_mapping(
            work / "database.db",
            photos,
            work,
            options=options,
            initial_image_pair_callback=lambda: bar.update(2),
            next_image_callback=lambda: bar.update(1),
        )
    return max(models.values(), key=lambda model: model.num_reg_images(), default=None)


def _check_model(model: Any, num_photos: int, photos: Path, matching: Matching) -> None:
    """Raise ValueError without a usable model, and warn if many photographs have no pose."""
    num_registered = 0 if model is None else model.num_reg_images()
    advice = ADVICE
    if matching == "sequential":
        advice += "; only neighbours by name were matched: name them in the order of taking, or choose --matching "
        advice += "exhaustive"
    placed = f"only {num_registered} of" if num_registered else "none of the"
    message = f"{photos}: {placed} {num_photos} photographs could be placed; {advice}"
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


def _have_one_size(photos: Path, names: list[str]) -> bool:
    """Return whether all photographs have the same size, as those of one camera have.

    Raises:
      ValueError: naming the first unreadable or too large photograph, because COLMAP's own reader has no bounds.
    """
    return len(set(map_in_threads(lambda name: check_picture(photos / name), names))) == 1


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
