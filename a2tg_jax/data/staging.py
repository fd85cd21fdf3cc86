"""Sources of photographs gathered in one folder, as COLMAP wants them: upright, in formats it reads, by camera.

Folders, videos and panoramas may be mixed. Photographs that need no change are linked.
"""

import itertools
import os
import shutil
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import Literal, NamedTuple

from PIL import Image

from a2tg_jax.data.decoding import PictureFacts, picture_facts, read_pixels, save_upright
from a2tg_jax.data.image_files import map_in_threads
from a2tg_jax.data.panoramas import cut_view, directions, is_panorama, view_size
from a2tg_jax.data.photo_folder import LEAST_PHOTOS, find_photos, is_video
from a2tg_jax.data.video import extract_frames
from a2tg_jax.host.text import counted

Panorama = Literal["auto", "yes", "no"]
"""Whether pictures twice as wide as high are panoramas: those whose edges join (auto), all of them, or none."""
COLMAP_FORMATS = ("JPEG", "MPO", "PNG", "BMP")
"""Formats that COLMAP reads as Pillow does. TIFF is not among them: with some compressions COLMAP reads black."""
COLMAP_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff")
"""Suffixes of the images that COLMAP can write; it reads by content."""
LOSSLESS_FORMATS = ("PNG", "TIFF", "BMP")
QUALITY = 95
"""JPEG quality of photographs that are written again."""


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
        """Number of places that cameras stood at; the views of a panorama share one."""
        return sum(len(group.names) for group in (*self.groups, *(rig.groups[0] for rig in self.rigs)))


class _Photo(NamedTuple):
    """A photograph of a source."""

    source: int
    file: Path
    name: str
    """Path below the staging folder, before conversion."""
    facts: PictureFacts
    is_panorama: bool


def stage(
    sources: Sequence[Path], work: Path, *, frames: int, panorama: Panorama, progress: bool, tell: Callable[[str], None]
) -> Staged:
    """Gather photographs of folders and videos in the folder `work/photos`.

    Args:
      sources: folders of photographs, and videos. With several, names begin with the source's.
      work: folder for the gathered photographs.
      frames: largest number of frames to take from each video.
      panorama: which pictures are cut into views.
      progress: show progress bars.
      tell: takes lines about what was found.
    """
    folder = work / "photos"
    files: list[tuple[int, Path, str]] = []
    least = LEAST_PHOTOS if len(sources) == 1 else 1
    for number, (source, prefix) in enumerate(zip(sources, _prefixes(sources), strict=True)):
        place = source
        if is_video(source):
            place = work / f"frames{number}"
            written, num_frames = extract_frames(source, place, frames, progress=progress)
            if written < least:
                raise ValueError(
                    f"{source}: its camera hardly moves, so that {written} of {num_frames} frames differ; walk around"
                )
            tell(f"{source}: {written} of {counted(num_frames, 'frame')} taken")
        files += [(number, place / name, prefix + name) for name in find_photos(place, least)]
    for _, file, name in files:
        try:
            name.encode()
        except UnicodeEncodeError:  # Bytes that are no UTF-8 are surrogates in Python's names of files.
            told = os.fsencode(file).decode(errors="backslashreplace")
            raise ValueError(f"{told}: its name is not UTF-8, as COLMAP wants it; rename the photograph") from None

    def look(source: int, file: Path, name: str) -> _Photo:
        facts = picture_facts(file)
        is_double = facts.size[0] == 2 * facts.size[1]
        is_cut = is_double and panorama != "no" and (panorama == "yes" or is_panorama(read_pixels(file)))
        return _Photo(source, file, name, facts, is_cut)

    photos = map_in_threads(look, *zip(*files, strict=True))
    groups = _stage_flat([photo for photo in photos if not photo.is_panorama], folder)
    tops = {name.partition("/")[0] for group in groups for name in group.names}
    rigs = _stage_panoramas([photo for photo in photos if photo.is_panorama], folder, tops, tell)
    num_turned = sum(photo.facts.is_turned for photo in photos)
    if num_turned:
        tell(f"{counted(num_turned, 'photograph')} turned as EXIF says")
    num_transparent = sum(photo.facts.is_transparent for photo in photos)
    if num_transparent:
        message = (
            f"{', '.join(map(str, sources))}: {num_transparent} of {len(photos)} photographs have transparent pixels, "
            "but COLMAP writes the scene's images without alpha; to leave pixels out, put masks of these images into "
            "the scene's folder masks"
        )
        warnings.warn(message, stacklevel=3)
    return Staged(folder, groups, rigs)


def _prefixes(sources: Sequence[Path]) -> list[str]:
    """Return the beginning of the names of each source: nothing for a single one, else its own name, made unique."""
    if len(sources) == 1:
        return [""]
    stems = [source.stem if is_video(source) else source.name for source in map(Path.resolve, sources)]
    return [f"{stem}/" for stem in _made_unique([stem or "photos" for stem in stems])]


def _made_unique(names: Sequence[str], others: Iterable[str] = ()) -> list[str]:
    """Return names with ~2, ~3, … where an earlier one, one of `others` or a folder of any is the same.

    Names that differ in case only are the same, because they are on some disks.
    """
    # A file cannot have the name of a folder in which others are.
    taken = {str(folder).casefold() for name in names for folder in PurePosixPath(name).parents}
    taken |= {other.casefold() for other in others}
    unique = []
    for path in map(PurePosixPath, names):
        tried = (path.with_name(f"{path.stem}~{number}{path.suffix}") for number in itertools.count(2))
        name = next(str(name) for name in itertools.chain([path], tried) if str(name).casefold() not in taken)
        taken.add(name.casefold())
        unique.append(name)
    return unique


def _stage_flat(photos: list[_Photo], folder: Path) -> tuple[CameraGroup, ...]:
    """Link or write again photographs that are no panoramas, and group them by source, size and lens."""

    def wanted_name(photo: _Photo) -> str:
        """Return a photograph's name in the folder: with another suffix if its own does not suit the file there."""
        suits = (".jpg", ".jpeg", ".png") if photo.facts.is_turned else COLMAP_SUFFIXES
        if photo.facts.format in COLMAP_FORMATS and Path(photo.name).suffix.lower() in suits:
            return photo.name
        return photo.name + (".png" if photo.facts.format in LOSSLESS_FORMATS else ".jpg")

    names = _made_unique([wanted_name(photo) for photo in photos])
    map_in_threads(_place, photos, [folder / name for name in names])
    grouped: dict[tuple[int, tuple[int, int], tuple[str, ...]], list[str]] = defaultdict(list)
    for photo, name in zip(photos, names, strict=True):
        grouped[photo.source, photo.facts.size, photo.facts.lens].append(name)
    return tuple(CameraGroup(tuple(sorted(members)), key[1]) for key, members in grouped.items())


def _place(photo: _Photo, target: Path) -> None:
    """Link a photograph to a new place, or write it again if it is turned or COLMAP cannot read it."""
    target.parent.mkdir(parents=True, exist_ok=True)
    if photo.facts.format in COLMAP_FORMATS and not photo.facts.is_turned:
        _link(photo.file, target)
        return
    partial = target.with_name(f".{target.name}")  # No photograph is named so, and a link is replaced, not followed.
    save_upright(photo.file, partial, QUALITY)
    os.replace(partial, target)


def _link(file: Path, target: Path) -> None:
    """Make a file appear at another place, without a copy if the file system can."""
    try:
        os.link(file.resolve(), target)
    except FileExistsError:
        raise
    except OSError:
        shutil.copyfile(file, target)


def _stage_panoramas(
    photos: list[_Photo], folder: Path, tops: Iterable[str], tell: Callable[[str], None]
) -> tuple[Rig, ...]:
    """Cut panoramas into views, and return a rig for each of their sizes, in a folder of none of the names `tops`."""
    by_size: dict[tuple[int, int], list[_Photo]] = defaultdict(list)
    for photo in photos:
        by_size[photo.facts.size].append(photo)
    rigs = []
    tops = _made_unique([f"panorama{number or ''}" for number in range(len(by_size))], tops)
    for top, (size, members) in zip(tops, by_size.items(), strict=True):
        is_jpeg = [Path(photo.name).suffix.lower() in (".jpg", ".jpeg") for photo in members]
        views = _made_unique(
            [photo.name if own else f"{photo.name}.jpg" for photo, own in zip(members, is_jpeg, strict=True)]
        )
        map_in_threads(_cut, [photo.file for photo in members], itertools.repeat(folder / top), views)
        side, focal = view_size(size[0])
        ordered = sorted(views)
        names = [tuple(f"{top}/{direction.name}/{view}" for view in ordered) for direction in directions()]
        rigs.append(Rig(top, tuple(CameraGroup(own, (side, side), focal) for own in names)))
        tell(
            f"{counted(len(members), 'panorama')} of {size[0]}x{size[1]}, each cut into {len(directions())} views of "
            f"{side}x{side}; panorama='no' leaves them whole"
        )
    return tuple(rigs)


def _cut(file: Path, folder: Path, view: str) -> None:
    """Write the views of one panorama."""
    pixels = read_pixels(file)[..., :3]
    for direction in directions():
        target = folder / direction.name / view
        target.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(cut_view(pixels, direction)).save(target, quality=QUALITY)
