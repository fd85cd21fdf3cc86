"""Structure from motion for plain photographs, videos and panoramas: COLMAP's features, matching and mapping."""

import os
import shutil
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from tqdm import tqdm

from a2tg_jax.core.camera_paths import upright_rotation, vertical_of
from a2tg_jax.core.checks import check_literal
from a2tg_jax.data.colmap_library import pycolmap
from a2tg_jax.data.photo_folder import LEAST_PHOTOS
from a2tg_jax.data.staging import Panorama, Staged, directions, stage
from a2tg_jax.data.video import DEFAULT_FRAMES
from a2tg_jax.host.machine import num_threads
from a2tg_jax.host.progress_bars import counting, has_terminal
from a2tg_jax.host.text import counted, first_names

Matching = Literal["auto", "exhaustive", "sequential"]
"""Pairs of photographs to match: all of them (exhaustive), neighbours by name (sequential), or by their number."""
CameraModel = Literal[
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE", "OPENCV_FISHEYE",
]  # fmt: skip
"""COLMAP's names of camera models that can be estimated from photographs."""
MAX_EXHAUSTIVE = 200
"""Number of photographs beyond which "auto" matches only neighbours in name order."""
MIN_REGISTERED = 3
PHOTOS_PER_CORE = 2
"""Photographs of which features are extracted together, so that the progress bar moves."""
TICK = 0.5
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
    camera_model: CameraModel = "SIMPLE_RADIAL",
    matching: Matching = "auto",
    frames: int = DEFAULT_FRAMES,
    panorama: Panorama = "auto",
    progress: bool = True,
    on_note: Callable[[str], None] = lambda line: None,
) -> SfmSummary:
    """Estimate poses and points, and write a scene folder that `load_scene` reads.

    Photographs of one source, size and lens share one camera, whose focal length starts from EXIF data. The largest
    model found is kept, turned until −y is up, and undistorted. It runs on the CPU with the seed wherever COLMAP takes
    one, and maps in one thread, so that runs reproduce.

    Args:
      photos: folder of photographs of one scene, whose subfolders are searched, or a video, or several of these.
      out: new folder for `images` and `sparse/0`.
      seed: random seed of COLMAP, at least 0.
      camera_model: COLMAP's name of the camera model to estimate; the FISHEYE models are for action cameras.
      matching: pairs of photographs to match; "auto" takes all pairs of up to 200, and neighbours by name of more.
      frames: largest number of frames to take from each video. The sharpest are taken, evenly along the camera path.
      panorama: pictures to cut into perspective views: "auto" takes those twice as wide as high whose edges join,
        "yes" all that are twice as wide as high.
      progress: show progress bars.
      on_note: function that receives lines about what was found among the photographs.

    Returns:
      Counts of photographs, registered ones and points, and the reprojection error.

    Raises:
      FileNotFoundError: if there is no such folder of photographs.
      FileExistsError: if `out` is a file, or holds a scene already.
      ValueError: if there are fewer than 3 photographs, or fewer than 3 could be registered, or one cannot be read.
    """
    check_literal("matching", matching, Matching)
    check_literal("panorama", panorama, Panorama)
    check_literal("camera_model", camera_model, CameraModel)
    if frames < LEAST_PHOTOS:
        raise ValueError(f"frames must be at least {LEAST_PHOTOS}; got {frames}")
    sources = [Path(photos)] if isinstance(photos, str | os.PathLike) else [Path(source) for source in photos]
    out = Path(out)
    for existing in (out / "images", out / "sparse"):
        if existing.exists():
            raise FileExistsError(f"{existing}: exists already; choose another output folder or remove it")
    if out.is_file():
        raise FileExistsError(f"{out} is a file; choose a folder for the scene")
    # The temporary folder is in `out`, so results are moved on one disk, without a copy.
    with _new_folder(out), tempfile.TemporaryDirectory(dir=out, prefix="sfm-") as folder, _quiet():
        work = Path(folder)
        staged = stage(sources, work, frames=frames, panorama=panorama, progress=progress, tell=on_note)
        names, given = staged.names, ", ".join(map(str, sources))
        if len(names) < LEAST_PHOTOS:
            raise ValueError(f"{given}: {len(names)} photographs; at least {LEAST_PHOTOS} are needed")
        if matching == "auto":
            matching = "exhaustive" if len(names) <= MAX_EXHAUSTIVE else "sequential"
        database = work / "database.db"
        pycolmap().set_random_seed(seed)
        list_photos(database, staged, camera_model)
        _extract_features(database, staged.folder, names, progress)
        _match_features(database, len(names), seed, matching, progress)
        models = _map(database, staged, work, seed, progress)
        with closing(pycolmap().Database.open(database)) as opened:
            images, num_matched = opened.read_all_images(), int(opened.num_verified_image_pairs())
            blank = sorted(image.name for image in images if not opened.num_keypoints_for_image(image.image_id))
        _check_models(models, names, given, matching, num_matched, blank)
        model = models[0]
        _turn_upright(model)
        with _clock("undistorting", progress):
            chosen, undistorted = work / "chosen", work / "undistorted"
            chosen.mkdir()
            model.write(chosen)  # undistort_images takes folders.
            pycolmap().undistort_images(undistorted, chosen, staged.folder)
            (out / "sparse").mkdir()
            shutil.move(undistorted / "sparse", out / "sparse" / "0")
            shutil.move(undistorted / "images", out / "images")
    error = model.compute_mean_reprojection_error()
    longest_side = max(int(side) for camera in model.cameras.values() for side in (camera.width, camera.height))
    return SfmSummary(len(names), model.num_reg_images(), model.num_points3D(), error, longest_side)


def _turn_upright(model: Any) -> None:
    """Turn a reconstruction until −y is up, as COLMAP's model_orientation_aligner does and programs for splats
    expect."""
    colmap = pycolmap()
    poses = [model.image(number).cam_from_world().matrix() for number in model.reg_image_ids()]
    turn = upright_rotation(vertical_of(np.stack(poses)))
    model.transform(colmap.Sim3d(1.0, colmap.Rotation3d(turn), np.zeros(3)))


def list_photos(database: Path, staged: Staged, camera_model: str) -> None:
    """Write photographs with their cameras and rigs into COLMAP's database.

    Listing the images first numbers them by name; otherwise the threads of the extraction do, by chance.
    """
    colmap = pycolmap()
    database.touch()  # import_images rejects a path without a file.
    for group in staged.all_groups:
        reader = colmap.ImageReaderOptions(camera_model=camera_model)
        if group.focal is not None:
            reader.camera_model = "PINHOLE"
            reader.camera_params = f"{group.focal},{group.focal},{group.size[0] / 2},{group.size[1] / 2}"
        names = list(group.names)
        colmap.import_images(
            database, staged.folder, options=reader, image_names=names, camera_mode=colmap.CameraMode.SINGLE
        )
    for rig in staged.rigs:  # Views of one panorama have one place and known directions.
        cameras = [
            colmap.RigConfigCamera(
                ref_sensor=index == 0,
                image_prefix=f"{rig.folder}/{direction.name}/",
                cam_from_rig=colmap.Rigid3d(colmap.Rotation3d(direction.rotation), np.zeros(3)) if index else None,
            )
            for index, direction in enumerate(directions())
        ]
        with closing(colmap.Database.open(database)) as opened:
            colmap.apply_rig_config([colmap.RigConfig(cameras=cameras)], opened)


def _extract_features(database: Path, folder: Path, names: list[str], progress: bool) -> None:
    colmap = pycolmap()
    together = PHOTOS_PER_CORE * num_threads()
    with counting("features", len(names), "photo", is_shown=progress) as bar:
        for start in range(0, len(names), together):
            some = names[start : start + together]
            colmap.extract_features(database, folder, some, device=colmap.Device.cpu)
            bar.update(len(some))


def _match_features(database: Path, num_photos: int, seed: int, matching: Matching, progress: bool) -> None:
    colmap = pycolmap()
    verification = colmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    is_exhaustive = matching == "exhaustive"
    match = colmap.match_exhaustive if is_exhaustive else colmap.match_sequential
    pairs = f"{num_photos * (num_photos - 1) // 2:,} pairs" if is_exhaustive else "neighbours by name"
    with _clock(f"matching {pairs}", progress):
        match(database, verification_options=verification, device=colmap.Device.cpu)


def _map(database: Path, staged: Staged, work: Path, seed: int, progress: bool) -> list[Any]:
    """Return the reconstructions of the matched photographs, the largest first."""
    colmap = pycolmap()
    options = colmap.IncrementalPipelineOptions(
        random_seed=seed, num_threads=1, min_model_size=MIN_REGISTERED, ba_use_gpu=False
    )
    options.mapper.random_seed = options.triangulation.random_seed = seed
    options.mapper.num_threads = 1  # The sums of several threads depend on their order.
    if staged.rigs:  # The calibration of a panorama's views is exact.
        options.ba_refine_sensor_from_rig = False
        firsts = [group.names[0] for rig in staged.rigs for group in rig.groups]
        with closing(colmap.Database.open(database)) as opened:
            options.constant_cameras = {opened.read_image_with_name(name).camera_id for name in firsts}
    with counting("mapping", staged.num_places, "photo", is_shown=progress) as bar:
        models = colmap.incremental_mapping(
            database,
            staged.folder,
            work,
            options=options,
            initial_image_pair_callback=lambda: bar.update(2),
            next_image_callback=lambda: bar.update(1),
        )
    return sorted(models.values(), key=lambda model: -model.num_reg_images())


def _check_models(
    models: Sequence[Any], names: Sequence[str], given: str, matching: Matching, num_matched: int, blank: Sequence[str]
) -> None:
    """Raise ValueError without a usable model, and warn of the photographs that the largest one leaves out.

    The models are sorted, the largest first; `given` names the sources in messages; `blank` are the names of the
    photographs without features.
    """
    placed = {models[0].image(number).name for number in models[0].reg_image_ids()} if models else set()
    left_out = [name for name in names if name not in placed]
    if not left_out:
        return
    has_no_depth = len(placed) < MIN_REGISTERED and num_matched >= len(names)
    advice = ("photographs match, but show no depth: walk between them; " if has_no_depth else "") + ADVICE
    if matching == "sequential":
        advice += "; only neighbours by name were matched: name them in the order of taking, or match all "
        advice += "pairs (matching='exhaustive')"
    reasons = []
    if blank:
        found = f"in {len(blank)} of them ({first_names(blank)})"
        reasons.append(f"COLMAP finds no features, as in blank or very blurred pictures, {found}")
    if len(models) > 1:
        sizes = ", ".join(str(model.num_reg_images()) for model in models)
        reasons.append(f"they fall into parts of {sizes} that do not connect, and the largest is kept")
    if len(placed) < len(names) / 2 and len(blank) < len(names):
        reasons.append(advice)
    if len(placed) < MIN_REGISTERED:
        found = f"only {len(placed)} of" if placed else "none of the"
        pairs = counted(num_matched, "pair")
        raise ValueError(
            "; ".join([f"{given}: {found} {len(names)} photographs could be placed ({pairs} match)", *reasons])
        )
    missing = f"{given}: {len(left_out)} of {len(names)} photographs could not be placed and are left out"
    warnings.warn("; ".join([f"{missing} ({first_names(left_out)})", *reasons]), stacklevel=3)


@contextmanager
def _new_folder(folder: Path) -> Iterator[None]:
    """Make a folder. If the block fails, remove the folders that were made, if they are empty."""
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:  # Ctrl-C as well.
        with suppress(OSError):
            for path in made:
                path.rmdir()
        raise


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep COLMAP's log to what ends the process for a while; its errors become exceptions."""
    logging = pycolmap().logging
    level, logging.minloglevel = logging.minloglevel, logging.FATAL.value
    try:
        yield
    finally:
        logging.minloglevel = level


@contextmanager
def _clock(phase: str, progress: bool) -> Iterator[None]:
    """Show the time since the start of a phase whose progress cannot be counted."""
    if progress and not has_terminal():
        print(f"{phase} …", file=sys.stderr, flush=True)
        progress = False
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
