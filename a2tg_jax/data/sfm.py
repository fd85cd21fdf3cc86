"""Structure from motion for plain photographs, videos and panoramas: COLMAP's features, matching and mapping."""

import os
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from a2tg_jax.core.checks import check_literal
from a2tg_jax.data.colmap_library import pycolmap
from a2tg_jax.data.photo_folder import LEAST_PHOTOS
from a2tg_jax.data.progress import clock
from a2tg_jax.data.sfm_database import (
    CameraModel,
    Matching,
    extract_features,
    featureless,
    known_cameras,
    match_features,
    num_matched_pairs,
)
from a2tg_jax.data.staging import Panorama, Staged, stage
from a2tg_jax.data.video import DEFAULT_FRAMES
from a2tg_jax.host.progress_bars import counting
from a2tg_jax.host.text import counted, first_names

MAX_EXHAUSTIVE = 200
"""Number of photographs beyond which "auto" matches only neighbours in name order."""
MIN_REGISTERED = 3
ADVICE = "take more, sharp and closer together: they should overlap by two thirds and show texture, unlike blank walls"

NO_DEPTH = "photographs match, but show no depth: walk between them; "
NO_FEATURES = "COLMAP finds no features, as in blank or very blurred pictures,"


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
    camera_model: CameraModel = "SIMPLE_RADIAL",
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
      camera_model: COLMAP's name of the camera model to estimate; those of FISHEYE are for action cameras.
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

    Warns of photographs that could not be placed, and of files that are not taken for photographs.
    """
    check_literal("matching", matching, Matching)
    check_literal("panorama", panorama, Panorama)
    check_literal("camera_model", camera_model, CameraModel)
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
        extract_features(staged, names, database, seed, camera_model, progress)
        match_features(database, len(names), seed, matching, progress)
        models = _map(staged, work, seed, progress)
        _check_models(models, names, told, matching, num_matched_pairs(database), featureless(database))
        model = models[0]
        with clock("undistorting", progress):
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


def _map(staged: Staged, work: Path, seed: int, progress: bool) -> list[Any]:
    """Return the reconstructions of the matched photographs, the largest first."""
    colmap = pycolmap()
    options = colmap.IncrementalPipelineOptions(
        random_seed=seed, num_threads=1, min_model_size=MIN_REGISTERED, ba_use_gpu=False
    )
    options.mapper.random_seed = options.triangulation.random_seed = seed
    options.mapper.num_threads = 1
    if staged.rigs:
        options.ba_refine_sensor_from_rig = False
        options.constant_cameras = known_cameras(work / "database.db", staged)
    with counting("mapping", staged.num_places, "photo", is_shown=progress) as bar:
        models = colmap.incremental_mapping(
            work / "database.db",
            staged.folder,
            work,
            options=options,
            initial_image_pair_callback=lambda: bar.update(2),
            next_image_callback=lambda: bar.update(1),
        )
    return sorted(models.values(), key=lambda model: -model.num_reg_images())


def _check_models(
    models: Sequence[Any], names: Sequence[str], told: str, matching: Matching, num_matched: int, blank: Sequence[str]
) -> None:
    """Raise ValueError without a usable model, and warn of the photographs that the largest leaves out.

    Args:
      models: the reconstructions, the largest first.
      names: of all photographs.
      told: name of the sources in messages.
      matching: how pairs were chosen.
      num_matched: number of pairs that match.
      blank: names of the photographs without features.
    """
    placed = {models[0].image(number).name for number in models[0].reg_image_ids()} if models else set()
    left_out = [name for name in names if name not in placed]
    if not left_out:
        return
    has_no_depth = len(placed) < MIN_REGISTERED and num_matched >= len(names)
    advice = (NO_DEPTH if has_no_depth else "") + ADVICE
    if matching == "sequential":
        advice += "; only neighbours by name were matched: name them in the order of taking, or choose --matching "
        advice += "exhaustive"
    reasons = []
    if blank:
        reasons.append(f"{NO_FEATURES} in {len(blank)} of them ({first_names(blank)})")
    if len(models) > 1:
        sizes = ", ".join(str(model.num_reg_images()) for model in models)
        reasons.append(f"they fall into parts of {sizes} that do not connect, and the largest is kept")
    if len(placed) < len(names) / 2 and len(blank) < len(names):
        reasons.append(advice)
    if len(placed) < MIN_REGISTERED:
        found = f"only {len(placed)} of" if placed else "none of the"
        pairs = counted(num_matched, "pair")
        raise ValueError(
            "; ".join([f"{told}: {found} {len(names)} photographs could be placed ({pairs} match)", *reasons])
        )
    missing = f"{told}: {len(left_out)} of {len(names)} photographs could not be placed and are left out"
    warnings.warn("; ".join([f"{missing} ({first_names(left_out)})", *reasons]), stacklevel=3)


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
