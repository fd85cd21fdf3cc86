"""Structure from motion for plain photographs, videos and panoramas: COLMAP's features, matching and mapping."""

import itertools
import math
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext, suppress
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from a2tg_jax.base.checks import check_literal
from a2tg_jax.base.regular_files import expanded
from a2tg_jax.base.text import counted, first_names
from a2tg_jax.base.threads import num_threads
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.core.origin import vertical_of
from a2tg_jax.data.capture_geometry import upright_rotation
from a2tg_jax.data.colmap_cameras import ColmapCamera
from a2tg_jax.data.colmap_library import pycolmap
from a2tg_jax.data.decoding import picture_size, read_pixels
from a2tg_jax.data.image_files import map_in_threads
from a2tg_jax.data.lenses import Lens
from a2tg_jax.data.photo_folder import LEAST_PHOTOS
from a2tg_jax.data.photo_reading import HALF, MASKS
from a2tg_jax.data.sfm_options import DEFAULT_FRAMES, CameraModel, Matching, Panorama
from a2tg_jax.data.staging import Staged, directions, stage
from a2tg_jax.data.video import sharpness
from a2tg_jax.host.progress_bars import clock, counting, ticking

MAX_EXHAUSTIVE = 200
"""Number of photographs beyond which "auto" matches only neighbours in name order."""
MIN_REGISTERED = 3
PHOTOS_PER_CORE = 2
"""Photographs of which features are extracted together, so that the progress bar moves."""
ADVICE = "take more, sharp and closer together: they should overlap by two thirds and show texture, unlike blank walls"
NO_DEPTH = "photographs that match show no depth, as if taken from one spot or of a flat surface: walk between them"
MOSTLY_FLAT = 0.9
"""Share of matching pairs without depth from which a warning follows. In six captures it is at most 0.71."""
SHARPNESS_SIDE = 640
"""Longer side in pixels of the greyscale copies on which sharpness is measured."""
SHARP_QUANTILE = 0.75
BLURRED = 0.4
"""A photograph is blurred if its sharpness is below this share of the quantile of all. In seven captures sharp ones
have 0.5 at least, and ones blurred by 0.25 % of their width 0.1 to 0.5."""
ANOTHER_SUBJECT = 1 / 3
"""Size of a part, as a share of the largest, from which it may be another subject."""
MOST_NAMED = 24
MOST_GAPS = 5
"""Largest numbers of photographs, and of gaps between photographs, that a message names."""
FLAT = ("PLANAR", "PANORAMIC", "PLANAR_OR_PANORAMIC")
"""COLMAP's names of the relations between two photographs that show no depth."""


class SfmSummary(NamedTuple):
    """Result of `run_sfm`."""

    num_photos: int
    """Number of photographs: files, frames of videos, and views of panoramas."""
    num_registered: int
    """Number of photographs with a pose."""
    num_points: int
    """Number of points of the reconstruction."""
    mean_error: float
    """Mean reprojection error of the points, in pixels."""
    longest_side: int
    """Larger of width and height of the largest photograph with a pose, in pixels."""


def run_sfm(
    photos: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    *,
    masks: str | os.PathLike[str] | None = None,
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
    model found is kept, turned until −y is up, and undistorted, with alpha channels. It runs on the CPU with the seed
    wherever COLMAP takes one, and maps in one thread, so that runs reproduce.

    Args:
      photos: folder of photographs of one scene, whose subfolders are searched, or a video, or several of these or of
        single photographs.
      out: new folder for `images`, `sparse/0` and `masks`, if any.
      masks: folder of masks of the photographs, NAME.EXT.png or NAME.png for NAME.EXT, black at excluded pixels. They
        are undistorted into the folder `masks` of the scene. Cameras are found without the excluded pixels.
      seed: random seed of COLMAP, at least 0.
      camera_model: COLMAP's name of the camera model to estimate; the FISHEYE models are for action cameras.
      matching: pairs of photographs to match; "auto" takes all pairs of up to 200, and neighbours by name of more.
      frames: largest number of frames to take from each video. The sharpest are taken, evenly along the camera path.
      panorama: pictures to cut into perspective views: "auto" takes those twice as wide as high whose metadata
        (GPano) say that they are panoramas, or whose edges join where there is texture, and warns if there is none;
        "yes" takes all that are twice as wide as high.
      progress: show progress bars.
      on_note: function that receives lines about what was found among the photographs.

    Returns:
      Counts of photographs, registered ones and points, and the reprojection error.

    Raises:
      FileNotFoundError: if there is no such folder, photograph or folder of masks.
      FileExistsError: if `out` is a file, or holds a scene already.
      ValueError: if there are fewer than 3 photographs, or fewer than 3 could be registered, or one cannot be read.
    """
    check_literal("matching", matching, Matching)
    check_literal("panorama", panorama, Panorama)
    check_literal("camera_model", camera_model, CameraModel)
    if frames < LEAST_PHOTOS:
        raise ValueError(f"frames must be at least {LEAST_PHOTOS}; got {frames}")
    sources = [expanded(source) for source in ([photos] if isinstance(photos, str | os.PathLike) else photos)]
    out = expanded(out)
    masks = None if masks is None else expanded(masks)
    if masks is not None and not masks.is_dir():
        raise FileNotFoundError(f"{masks}: no such folder of masks")
    for existing in (out / "images", out / "sparse", out / MASKS):
        if existing.exists():
            raise FileExistsError(f"{existing}: exists already; choose another output folder or remove it")
    if out.is_file():
        raise FileExistsError(f"{out} is a file; choose a folder for the scene")
    # The temporary folder is in `out`, so results are moved on one disk, without a copy.
    with _new_folder(out), tempfile.TemporaryDirectory(dir=out, prefix="sfm-") as folder, _quiet():
        work = Path(folder)
        staged = stage(sources, work, masks=masks, frames=frames, panorama=panorama, progress=progress, tell=on_note)
        names = staged.names
        given = first_names([str(source) for source in sources])
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
        blurred = blurred_photos(staged.folder, [name for group in staged.groups for name in group.names])
        _check_models(models, names, given, matching, _read_matches(database), blurred)
        model = models[0]
        _turn_upright(model)
        with clock("undistorting", is_shown=progress):
            chosen = work / "chosen"
            undistorted = work / "undistorted"
            chosen.mkdir()
            model.write(chosen)  # undistort_images takes folders.
            pycolmap().undistort_images(undistorted, chosen, staged.folder)
            _undistort_alpha_and_masks(model, staged.folder, undistorted)
            (out / "sparse").mkdir()
            shutil.move(undistorted / "sparse", out / "sparse" / "0")
            for name in ("images", MASKS):
                if (undistorted / name).exists():
                    shutil.move(undistorted / name, out / name)
    error = model.compute_mean_reprojection_error()
    longest_side = int(max(max(camera.width, camera.height) for camera in model.cameras.values()))
    return SfmSummary(len(names), model.num_reg_images(), model.num_points3D(), error, longest_side)


def _undistort_alpha_and_masks(model: Any, photos: Path, undistorted: Path) -> None:
    """Add the alpha channels, which COLMAP drops, to undistorted images, and write the masks next to them."""
    lenses = {
        number: Lens(ColmapCamera(camera.model.name, camera.width, camera.height, tuple(camera.params)))
        for number, camera in model.cameras.items()
    }

    def undistort(number: int) -> None:
        image = model.image(number)
        lens = lenses[image.camera_id]
        target = undistorted / "images" / image.name
        # Photographs with transparent pixels are staged as PNG.
        if target.suffix.lower() == ".png":
            pixels = read_pixels(photos / image.name)
            if pixels.shape[2] == 4:
                Image.fromarray(lens.view_pixels(pixels)).save(target, "PNG")
        mask = photos.with_name(MASKS) / f"{image.name}.png"
        if mask.exists():
            levels = lens.view_plane(read_pixels(mask)[..., 0].astype(np.float32))
            # COLMAP and `Lens` may round the size of an almost undistorted image differently.
            size = picture_size(target)
            resized = Image.fromarray(levels >= HALF).convert("L").resize(size, Image.Resampling.NEAREST)
            target_mask = undistorted / MASKS / f"{image.name}.png"
            target_mask.parent.mkdir(parents=True, exist_ok=True)
            resized.save(target_mask)

    map_in_threads(undistort, model.reg_image_ids())


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
    masks = folder.with_name(MASKS)
    masked = [name for name in names if (masks / f"{name}.png").exists()]
    # Of photographs without a mask COLMAP would take no features.
    readers = [
        (colmap.ImageReaderOptions(mask_path=masks), masked),
        (colmap.ImageReaderOptions(), sorted(set(names) - set(masked))),
    ]
    with counting("features", len(names), "photo", is_shown=progress) as bar:
        for reader, chosen in readers:
            for start in range(0, len(chosen), together):
                some = chosen[start : start + together]
                colmap.extract_features(database, folder, some, reader_options=reader, device=colmap.Device.cpu)
                bar.update(len(some))


def _match_features(database: Path, num_photos: int, seed: int, matching: Matching, progress: bool) -> None:
    colmap = pycolmap()
    verification = colmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    is_exhaustive = matching == "exhaustive"
    match = colmap.match_exhaustive if is_exhaustive else colmap.match_sequential
    total = num_photos * (num_photos - 1) // 2 if is_exhaustive else None
    with (
        counting("matching", total, "pair", is_shown=progress) as bar,
        # Read by COLMAP's own SQLite: another copy of it in the same process would disturb its locks.
        closing(colmap.Database.open(database)) as opened,
    ):

        def count() -> None:
            more = opened.num_verified_image_pairs() - bar.n
            if more:
                bar.update(more)

        with ticking(count) if progress else nullcontext():
            match(database, verification_options=verification, device=colmap.Device.cpu)
        count()


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


class Matches(NamedTuple):
    """Pairs of photographs that match, and photographs in no such pair."""

    num_pairs: int
    """Number of pairs with matches enough for mapping that fit one motion of the camera."""
    num_flat: int
    """Number of them that show no depth: the camera turned on the spot, or saw one plane."""
    alone: tuple[str, ...]
    """Names of the photographs with features that are in no such pair, sorted."""
    blank: tuple[str, ...]
    """Names of the photographs without features, sorted."""


def _read_matches(database: Path) -> Matches:
    colmap = pycolmap()
    least = colmap.IncrementalPipelineOptions().min_num_matches
    with closing(colmap.Database.open(database)) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        blank = {name for number, name in names.items() if not opened.num_keypoints_for_image(number)}
        pair_ids, geometries = opened.read_two_view_geometries()
    pairs = [
        (colmap.pair_id_to_image_pair(pair_id), colmap.TwoViewGeometryConfiguration(geometry.config).name)
        for pair_id, geometry in zip(pair_ids, geometries, strict=True)
        if len(geometry.inlier_matches) >= least
    ]
    matched = {names[number] for pair, _ in pairs for number in pair}
    alone = set(names.values()) - matched - blank
    return Matches(len(pairs), sum(kind in FLAT for _, kind in pairs), tuple(sorted(alone)), tuple(sorted(blank)))


def blurred_photos(folder: Path, names: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the photographs, of one scene, that are much less sharp than the others, sorted."""

    def contrast(name: str) -> float:
        """Standard deviation of the Laplacian of a small greyscale copy."""
        with Image.open(folder / name) as photo:
            photo.draft("L", (SHARPNESS_SIDE, SHARPNESS_SIDE))
            small = photo.convert("L")
            small.thumbnail((SHARPNESS_SIDE, SHARPNESS_SIDE), Image.Resampling.BOX)
            return math.sqrt(sharpness(np.asarray(small)))

    if not names:
        return ()
    found = np.array(map_in_threads(contrast, names))
    is_blurred = found < BLURRED * np.quantile(found, SHARP_QUANTILE)
    return tuple(sorted(name for name, is_one in zip(names, is_blurred, strict=True) if is_one))


def _check_models(
    models: Sequence[Any],
    names: Sequence[str],
    given: str,
    matching: Matching,
    matches: Matches,
    blurred: Sequence[str] = (),
) -> None:
    """Raise ValueError without a usable model, and warn of the photographs that the largest one leaves out, and of
    blurred ones.

    The models are sorted, the largest first; `given` names the sources in messages.
    """
    placed = {models[0].image(number).name for number in models[0].reg_image_ids()} if models else set()
    left_out = [name for name in names if name not in placed]
    is_scene = len(placed) >= MIN_REGISTERED
    num_pairs, num_flat, alone, blank = matches
    has_no_depth = num_pairs > 1 and num_flat >= MOSTLY_FLAT * num_pairs
    if has_no_depth and is_scene:
        warn(f"{given}: {NO_DEPTH}; their poses are a guess")
    blurred_in = [name for name in blurred if name in placed]
    if blurred_in and is_scene:
        warn(
            f"{given}: {len(blurred_in)} of the photographs are blurred, and so will the scene be: take them again or "
            f"remove them ({first_names(blurred_in, MOST_NAMED)})"
        )
    if not left_out:
        return
    reasons = []
    blurred_out = [name for name in blurred if name not in placed]
    if blurred_out:
        reasons.append(f"{len(blurred_out)} of them are blurred ({first_names(blurred_out, MOST_NAMED)})")
    if blank:
        where = f"in {len(blank)} of them ({first_names(blank, MOST_NAMED)})"
        reasons.append(f"COLMAP finds no features, as in blank or very blurred pictures, {where}")
    if alone and num_pairs:
        reasons.append(
            f"{len(alone)} of them ({first_names(alone, MOST_NAMED)}) match no other: they show something else, are "
            "blurred, or are too far from the others"
        )
    elif alone:
        reasons.append("no two of them match: they show different things, are blurred, or are too far apart")
    if len(models) > 1:
        sizes = ", ".join(str(model.num_reg_images()) for model in models)
        reasons.append(f"they fall into parts of {sizes} that do not connect, and the largest is kept")
        second = sorted(models[1].image(number).name for number in models[1].reg_image_ids())
        if len(second) >= ANOTHER_SUBJECT * len(placed):
            named = first_names(second, MOST_NAMED)
            reasons.append(f"if they show several subjects, give each a folder: the second part is {named}")
    if has_no_depth and not is_scene:
        reasons.append(NO_DEPTH)
    elif len(placed) < len(names) / 2 and len(blank) < len(names):
        reasons.append(ADVICE)
    if len(placed) < len(names) / 2 and matching == "sequential":
        reasons.append(
            "only neighbours by name were matched: name them in the order of taking, or match all pairs "
            "(matching='exhaustive')"
        )
    if not is_scene:
        share = f"only {len(placed)} of" if placed else "none of the"
        pairs = f"{counted(num_pairs, 'pair')} match{'es' if num_pairs == 1 else ''}"
        raise ValueError("; ".join([f"{given}: {share} {len(names)} photographs could be placed ({pairs})", *reasons]))
    gaps = _gaps(names, placed)
    if gaps:
        reasons.append(f"to connect them, take more photographs between {first_names(gaps, MOST_GAPS)}")
    missing = f"{given}: {len(left_out)} of {len(names)} photographs could not be placed and are left out"
    warn("; ".join([f"{missing} ({first_names(left_out, MOST_NAMED)})", *reasons]))


def _gaps(names: Iterable[str], placed: Container[str]) -> list[str]:
    """Return the placed neighbours between which others in their folder are not placed, as "3.jpg and 5.jpg".

    Neighbours are those by name, where 10.jpg follows 9.jpg.
    """

    def by_numbers(name: str) -> tuple[str, list[str | int]]:
        path = PurePosixPath(name)
        # Every second part is a number.
        return str(path.parent), [int(p) if at % 2 else p for at, p in enumerate(re.split(r"(\d+)", path.name))]

    ordered = sorted(names, key=by_numbers)
    known = [(at, PurePosixPath(name)) for at, name in enumerate(ordered) if name in placed]
    gaps = [
        f"{name.name} and {other.name}"
        for (at, name), (after, other) in itertools.pairwise(known)
        if after > at + 1 and name.parent == other.parent
    ]
    return list(dict.fromkeys(gaps))  # Once for all views of a panorama.


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
    level = logging.minloglevel
    logging.minloglevel = logging.FATAL.value
    try:
        yield
    finally:
        logging.minloglevel = level
