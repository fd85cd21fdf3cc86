"""Sources of photographs gathered in one folder as COLMAP needs them: upright, in formats it reads, by camera.

Folders, videos and panoramas may be mixed. Photographs that need no change are linked. Panoramas of 360° × 180°
(equirectangular) are cut into perspective views of one place. A panorama's own camera frame has x to the right, y down
and z towards the middle of the picture. Longitude grows to the right, from -π at the left edge.
"""

import itertools
import os
import shutil
from collections import Counter, defaultdict
from collections.abc import Callable, Container, Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from a2tg_jax.base.regular_files import sha256_of
from a2tg_jax.base.text import counted, first_names
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.data.decoding import PictureFacts, picture_facts, read_pixels, save_upright
from a2tg_jax.data.image_files import map_in_threads, on_disk
from a2tg_jax.data.lenses import sampled
from a2tg_jax.data.panoramas import Projection, projection_of
from a2tg_jax.data.photo_folder import LEAST_PHOTOS, find_photos, is_video
from a2tg_jax.data.photo_reading import HALF, MASKS, mask_names, read_mask, warn_of_grey, warn_of_lacking_masks
from a2tg_jax.data.sfm_options import Panorama
from a2tg_jax.data.video import extract_frames

COLMAP_FORMATS = ("JPEG", "MPO", "PNG", "BMP")
"""Formats that COLMAP reads as Pillow does. TIFF is not among them: with some compressions COLMAP reads black."""
COLMAP_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff")
"""Suffixes of the images that COLMAP can write; it reads by content."""
LOSSLESS_FORMATS = ("PNG", "TIFF", "BMP")
QUALITY = 95
FIELD_OF_VIEW = np.deg2rad(100.0)
"""Field of view of each square view of a panorama; with the headings below no direction is left out."""
AROUND = 6
"""Number of views around the horizon; one view up and one down join them."""


class CameraGroup(NamedTuple):
    """Photographs of one camera."""

    names: tuple[str, ...]
    """Paths below the staging folder, sorted."""
    size: tuple[int, int]
    focal: float | None = None
    """Exact focal length in pixels of a view of a panorama, whose principal point is the middle."""


class Rig(NamedTuple):
    """Views of panoramas of one size: the same directions at each place."""

    folder: str
    """Folder below the staging folder, with one folder per direction."""
    groups: tuple[CameraGroup, ...]
    """One group for each of `directions()`; names below its folder are the panoramas'."""


class Staged(NamedTuple):
    """Photographs ready for structure from motion."""

    folder: Path
    groups: tuple[CameraGroup, ...]
    """Groups of photographs that are no views of panoramas."""
    rigs: tuple[Rig, ...]

    @property
    def all_groups(self) -> list[CameraGroup]:
        """Groups of all photographs."""
        return [*self.groups, *(group for rig in self.rigs for group in rig.groups)]

    @property
    def names(self) -> list[str]:
        """Names of all photographs, sorted."""
        return sorted(name for group in self.all_groups for name in group.names)

    @property
    def num_places(self) -> int:
        """Number of camera positions; the views of a panorama share one."""
        return sum(len(group.names) for group in (*self.groups, *(rig.groups[0] for rig in self.rigs)))


class _Photo(NamedTuple):
    source: int
    file: Path
    name: str
    """Path below the staging folder, before conversion."""
    facts: PictureFacts
    kind: Projection
    mask: Path | None


def stage(
    sources: Sequence[Path], work: Path, *, masks: Path | None = None, frames: int, panorama: Panorama, progress: bool,
    tell: Callable[[str], None],
) -> Staged:  # fmt: skip
    """Gather photographs of folders and videos in the folder `work/photos`, and masks as NAME.png in `work/masks`.

    Photographs with transparent pixels keep them, as PNG.

    Args:
      sources: folders of photographs, videos, and photographs. Names begin with the source's if there are several;
        photographs of one folder are one source.
      work: folder for the gathered photographs.
      masks: folder of masks of the photographs as they are shown; None: without masks.
      frames: largest number of frames to take from each video.
      panorama: which pictures are cut into views.
      progress: show progress bars.
      tell: function that receives lines about what was found.
    """
    folder = work / "photos"
    chosen: dict[Path, list[Path] | None] = {}  # None: all photographs of the folder, or a video.
    for source in sources:
        if is_video(source) or not source.is_file():
            chosen[source] = None
            continue
        of_folder = chosen.setdefault(source.parent, [])
        if of_folder is not None:
            of_folder.append(source)
    least = LEAST_PHOTOS if len(chosen) == 1 else 1
    prefixes = _prefixes(list(chosen))
    files: list[tuple[int, Path, str]] = []  # Number of the source, file, and name below the folder.
    for number, (source, some) in enumerate(chosen.items()):
        place = source
        if is_video(source):
            place = work / f"frames{number}"
            written, num_frames = extract_frames(source, place, frames, progress=progress)
            if written < least:
                raise ValueError(
                    f"{source}: its camera barely moves, so that {written} of {num_frames} frames differ; walk around"
                )
            tell(f"{source}: {written} of {counted(num_frames, 'frame')} taken")
        for name in find_photos(place, least, some):
            files.append((number, place / name, prefixes[number] + name))
    for _, file, name in files:
        try:
            name.encode()
        except UnicodeEncodeError:  # Names have surrogates for bytes that are not UTF-8.
            shown = os.fsencode(file).decode(errors="backslashreplace")
            raise ValueError(f"{shown}: its name is not UTF-8, as COLMAP needs it; rename the photograph") from None

    def look(source: int, file: Path, name: str) -> _Photo:
        facts = picture_facts(file)
        mask = None
        if masks is not None:
            # Names with the source's and without.
            mask = on_disk(masks, *mask_names(name), *mask_names(name.removeprefix(prefixes[source])))
        return _Photo(source, file, name, facts, _kind_of(file, facts, panorama), mask)

    videos = {number for number, source in enumerate(chosen) if is_video(source)}
    photos = _decided(_without_copies(map_in_threads(look, *zip(*files, strict=True))), videos)
    lacking = [photo.name for photo in photos if photo.mask is None]
    if masks is not None:
        if len(lacking) == len(photos):
            raise ValueError(f"{masks}: holds no mask of a photograph, called {lacking[0]}.png for {lacking[0]}")
        warn_of_lacking_masks(masks, lacking, len(photos))
    grey: list[Path] = []
    groups = _stage_flat([photo for photo in photos if photo.kind == "photograph"], folder, grey)
    tops = {name.partition("/")[0] for group in groups for name in group.names}
    rigs = _stage_panoramas([photo for photo in photos if photo.kind == "panorama"], folder, tops, tell, grey)
    warn_of_grey(sorted(grey), [photo.mask for photo in photos if photo.mask is not None])
    num_turned = sum(photo.facts.is_turned for photo in photos)
    if num_turned:
        tell(f"{counted(num_turned, 'photograph')} turned as EXIF says")
    return Staged(folder, groups, rigs)


def _kind_of(file: Path, facts: PictureFacts, panorama: Panorama) -> Projection:
    """Return what a picture is, by its shape, its metadata and, if need be, its pixels."""
    width, height = facts.size
    if panorama == "no" or width != 2 * height:
        return "photograph"
    if panorama == "yes" or facts.is_panorama:
        return "panorama"
    return projection_of(read_pixels(file)) if facts.is_panorama is None else "photograph"


def _without_copies(photos: Sequence[_Photo]) -> list[_Photo]:
    """Return photographs without those whose file has the same bytes as an earlier one's; warn of these."""
    of_size: dict[int, list[Path]] = defaultdict(list)
    for photo in photos:
        of_size[photo.file.stat().st_size].append(photo.file)
    alike = [file for files in of_size.values() if len(files) > 1 for file in files]
    checksums = dict(zip(alike, map_in_threads(sha256_of, alike), strict=True))
    firsts: dict[str, str] = {}
    kept = []
    copies = []
    for photo in photos:
        # A file of another size than all others has no checksum, and is no copy.
        first = firsts.setdefault(checksums.get(photo.file, photo.name), photo.name)
        if first == photo.name:
            kept.append(photo)
        else:
            copies.append(f"{photo.name} of {first}")
    if copies:
        warn(f"left out {counted(len(copies), 'photograph')} with the same bytes as another: {first_names(copies)}")
    return kept


def _decided(photos: Sequence[_Photo], videos: Container[int]) -> list[_Photo]:
    """Return photographs that are panoramas or not: unclear ones, and frames of the sources `videos`, are what most of
    their source and size are. ValueError: some are fisheyes."""
    votes: dict[tuple[int, tuple[int, int]], Counter[Projection]] = defaultdict(Counter)
    for photo in photos:
        if photo.kind == "fisheyes":
            raise ValueError(
                f"{photo.file}: shows two fisheyes side by side, as 360° cameras take them: stitch them first, by "
                "exporting equirectangular files with the camera's program; with `panorama` no they stay whole"
            )
        votes[photo.source, photo.facts.size][photo.kind] += 1
    decided = []
    unclear = []
    for photo in photos:
        kind = photo.kind
        if kind == "unclear" or photo.source in videos:
            alike = votes[photo.source, photo.facts.size]
            kind = "panorama" if alike["panorama"] > alike["photograph"] else "photograph"
        if photo.kind == "unclear" and kind == "photograph":
            unclear.append(photo.name)
        decided.append(photo._replace(kind=kind))
    if unclear:
        warn(
            f"{counted(len(unclear), 'picture')} twice as wide as high, such as {unclear[0]}: nothing at the left and "
            "right edges shows whether they join, so these are taken for photographs; `panorama` yes cuts them as "
            "panoramas of 360° x 180°, `panorama` no leaves them whole without this warning"
        )
    return decided


def _prefixes(sources: Sequence[Path]) -> list[str]:
    """Return the beginning of the names of each source: nothing for a single one, else its own name, made unique."""
    if len(sources) == 1:
        return [""]
    stems = [source.stem if is_video(source) else source.name for source in map(Path.resolve, sources)]
    unique = _made_unique([stem or "photos" for stem in stems])
    return [f"{stem}/" for stem in unique]


def _made_unique(names: Sequence[str], others: Iterable[str] = ()) -> list[str]:
    """Return names with ~2, ~3, … where an earlier one, one of `others` or a folder of any is the same.

    Names that differ in case only are the same, because they are on some disks.
    """
    # No file can have the name of a folder that is needed for another file.
    taken = {str(folder).casefold() for name in names for folder in PurePosixPath(name).parents}
    taken |= {other.casefold() for other in others}
    unique = []
    for name in names:
        path = PurePosixPath(name)
        candidate = name
        for number in itertools.count(2):
            if candidate.casefold() not in taken:
                break
            candidate = str(path.with_name(f"{path.stem}~{number}{path.suffix}"))
        taken.add(candidate.casefold())
        unique.append(candidate)
    return unique


def _mask_levels(photo: _Photo, grey: list[Path]) -> np.ndarray | None:
    """Return the mask [H, W] uint8 of a photograph, 0 or 255, or None; add its file to `grey` if it has grey areas."""
    if photo.mask is None:
        return None
    mask = read_mask(photo.mask, photo.facts.size)
    if mask.has_grey_areas:
        grey.append(photo.mask)
    return np.uint8(255) * mask.counts


def _save_mask(levels: np.ndarray, name: Path, folder: Path) -> None:
    """Save the mask [H, W] uint8 of a photograph below the folder of photographs, black and white."""
    target = folder.with_name(MASKS) / f"{name.relative_to(folder)}.png"
    target.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(levels >= HALF).convert("L").save(target)


def _stage_flat(photos: list[_Photo], folder: Path, grey: list[Path]) -> tuple[CameraGroup, ...]:
    """Link or write again photographs that are no panoramas, and group them by source, size and lens; add masks with
    grey areas to `grey`."""

    def wanted_name(photo: _Photo) -> str:
        """Return a photograph's name in the folder: with another suffix if its own does not suit the file there."""
        facts = photo.facts
        # save_upright writes JPEG and PNG only.
        suits: tuple[str, ...] = (".jpg", ".jpeg", ".png") if facts.is_turned else COLMAP_SUFFIXES
        suits = (".png",) if facts.is_transparent else suits
        if facts.format in COLMAP_FORMATS and Path(photo.name).suffix.lower() in suits:
            return photo.name
        return photo.name + (".png" if facts.is_transparent or facts.format in LOSSLESS_FORMATS else ".jpg")

    def place(photo: _Photo, target: Path) -> None:
        target.parent.mkdir(parents=True, exist_ok=True)
        levels = _mask_levels(photo, grey)
        if levels is not None:
            _save_mask(levels, target, folder)
        if photo.facts.format in COLMAP_FORMATS and not photo.facts.is_turned:
            try:
                # Whether os.link follows symbolic links depends on the system.
                os.link(photo.file.resolve(), target)
            except FileExistsError:  # It is an OSError, but nothing may be replaced.
                raise
            except OSError:  # The file system has no links.
                shutil.copyfile(photo.file, target)
            return
        partial = target.with_name(f".{target.name}")  # A link is replaced, not followed.
        save_upright(photo.file, partial, QUALITY)
        os.replace(partial, target)

    names = _made_unique([wanted_name(photo) for photo in photos])
    map_in_threads(place, photos, [folder / name for name in names])
    grouped: dict[tuple[int, tuple[int, int], tuple[str, ...]], list[str]] = defaultdict(list)
    for photo, name in zip(photos, names, strict=True):
        grouped[photo.source, photo.facts.size, photo.facts.lens].append(name)
    return tuple(CameraGroup(tuple(sorted(members)), key[1]) for key, members in grouped.items())


def _stage_panoramas(
    photos: list[_Photo], folder: Path, tops: Iterable[str], tell: Callable[[str], None], grey: list[Path]
) -> tuple[Rig, ...]:
    """Cut panoramas into views, and return a rig for each of their sizes, in a folder of none of the names `tops`; add
    masks with grey areas to `grey`."""
    by_size: dict[tuple[int, int], list[_Photo]] = defaultdict(list)
    for photo in photos:
        by_size[photo.facts.size].append(photo)

    def cut(photo: _Photo, top: str, view: str) -> None:
        pixels = read_pixels(photo.file)
        levels = _mask_levels(photo, grey)
        for direction in directions():
            target = folder / top / direction.name / view
            target.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(cut_view(pixels, direction)).save(target, quality=QUALITY)
            if levels is not None:
                _save_mask(cut_view(levels[..., None], direction)[..., 0], target, folder)

    rigs = []
    tops = _made_unique([f"panorama{number or ''}" for number in range(len(by_size))], tops)
    for top, (size, members) in zip(tops, by_size.items(), strict=True):
        wanted = []
        for photo in members:
            suffixes = (".png",) if photo.facts.is_transparent else (".jpg", ".jpeg")
            wanted.append(photo.name if photo.name.lower().endswith(suffixes) else photo.name + suffixes[0])
        views = _made_unique(wanted)
        map_in_threads(cut, members, itertools.repeat(top), views)
        side, focal = view_size(size[0])
        groups = []
        for direction in directions():
            names = tuple(f"{top}/{direction.name}/{view}" for view in sorted(views))
            groups.append(CameraGroup(names, (side, side), focal))
        rigs.append(Rig(top, tuple(groups)))
        tell(
            f"{counted(len(members), 'panorama')} of {size[0]}x{size[1]}, each cut into {len(directions())} views of "
            f"{side}x{side}; panorama='no' leaves them whole"
        )
    return tuple(rigs)


class Direction(NamedTuple):
    """A view of a panorama."""

    name: str
    rotation: np.ndarray
    """[3, 3] from the panorama's frame to the view's."""


def directions() -> tuple[Direction, ...]:
    """Return the views that a panorama is cut into, the one towards its middle first."""
    headings = [360.0 * number / AROUND for number in range(AROUND)]
    angles = [(f"heading{heading:03.0f}", heading, 0.0) for heading in headings]
    views = []
    for name, heading, pitch in (*angles, ("up", 0.0, 90.0), ("down", 0.0, -90.0)):
        # A view is turned right by its heading and then up by its pitch.
        turn = Rotation.from_euler("YX", [heading, pitch], degrees=True)
        views.append(Direction(name, turn.as_matrix().T))
    return tuple(views)


def view_size(width: int) -> tuple[int, float]:
    """Return (side, focal length) in pixels of the views of a panorama, which keep its resolution at their middle."""
    # A panorama has width / 2π pixels per radian, the focal length of a view that is as fine in its middle.
    side = 2 * round(width / (2 * np.pi) * np.tan(FIELD_OF_VIEW / 2))
    return side, side / (2 * np.tan(FIELD_OF_VIEW / 2))


def cut_view(panorama: np.ndarray, direction: Direction) -> np.ndarray:
    """Return the square view [side, side, C] uint8 of a panorama [H, W, C] in a direction, sampled bilinearly."""
    height, width = panorama.shape[:2]
    side, focal = view_size(width)
    wrapped = np.concatenate([panorama[:, -1:], panorama, panorama[:, :1]], axis=1)  # Columns continue over the seam.

    def places(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        # Rows times R are Rᵀ times columns: from the view to the panorama.
        rays = np.stack([x - side / 2, y - side / 2, np.full_like(x, focal)], -1) @ direction.rotation
        longitude = np.arctan2(rays[..., 0], rays[..., 2])
        latitude = np.arctan2(-rays[..., 1], np.hypot(rays[..., 0], rays[..., 2]))
        row = (0.5 - latitude / np.pi) * height
        column = (0.5 + longitude / (2 * np.pi)) * width
        return np.stack([row - 0.5, column - 0.5 + 1])  # One more for the wrapped column on the left.

    return np.rint(sampled(wrapped, (side, side), places)).astype(np.uint8)
