"""The command `a2tg make`: from photographs to a page, by the commands that do each step."""

import dataclasses
import os
import shlex
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from a2tg_jax.base.json_text import read_object
from a2tg_jax.base.regular_files import expanded, is_regular, sha256_of
from a2tg_jax.base.text import first_names
from a2tg_jax.cli.arguments import defaulting_to, open_browser, print_now
from a2tg_jax.cli.main import parsed
from a2tg_jax.results.folder import MADE, RunFolder, write_json
from a2tg_jax.results.output_paths import check_apart, check_output

NUM_FRAMES = 60
"""Number of frames of the flight."""
PHOTOGRAPHS = ".a2tg-photographs.json"
CAMERAS = ".a2tg-cameras.json"
LISTS = {PHOTOGRAPHS: ("photographs", "of another size"), CAMERAS: ("cameras", "changed")}
"""Files in the output folder with the names of photographs and their bytes, and of files with cameras and their
checksums, by which changes are noticed. For messages: what is listed, and what a difference means."""
MOST_NAMED = 3
"""Largest number of photographs that a message names for each change."""


@dataclasses.dataclass(frozen=True)
class Make:
    """Make a page that shows a scene, from photographs or a video, in about as many minutes as you give.

    Finds the cameras, chooses the size of the photographs, the bytes and the iterations that this machine can train in
    the time, trains, and writes a page, a picture and a flight, a turntable if cameras surround the subject. Every step
    is a command, which is printed. After an interruption, the same command continues, unless photographs or cameras
    changed.

    Examples:
      a2tg make photos/
      a2tg make clip.mp4 --minutes 20 --out runs/fox
      a2tg make scenes/fox --minutes 5
    """

    sources: Annotated[Positional[tuple[Path, ...]], arg(metavar="PHOTOS", help_behavior_hint="")]
    """Folders of photographs, photographs, or videos of one scene; or a scene folder, whose cameras are known."""
    minutes: float = 10.0
    """Time for all steps. The larger, the larger the photographs in training, and the more iterations."""
    out: Annotated[Path | None, defaulting_to("runs/NAME", "FOLDER")] = None
    """Output folder: the scene, the run, NAME.html, NAME.png, and the folder flight."""
    open: bool = True
    """Open the page if the machine has a display."""

    def run(self) -> None:
        from a2tg_jax.base.checks import check_number
        from a2tg_jax.data.capture_geometry import SURROUNDED
        from a2tg_jax.data.load import camera_files, is_scene
        from a2tg_jax.results.frames import FRONT_NAME, unseen_angle
        from a2tg_jax.results.minutes import choose_training
        from a2tg_jax.results.model_source import open_source
        from a2tg_jax.results.record import is_finished, read_record

        if not self.sources:
            raise ValueError("PHOTOS is missing: a folder of photographs, photographs, a video, or a scene folder")
        check_number("minutes", self.minutes, above=0)
        started = time.monotonic()
        sources = list(map(expanded, self.sources))
        first = sources[0]
        place = first.resolve()
        name = place.stem if place.is_file() else place.name
        out = self.out or Path("runs") / name
        for source in sources:
            if not source.exists():
                raise FileNotFoundError(f"{source}: no such file or folder")
            check_apart(out, source)
        check_output(out)
        out.mkdir(parents=True, exist_ok=True)

        run = RunFolder(out / MADE)
        page = out / f"{name}.html"
        picture = out / f"{name}.png"
        flight = out / "flight"
        is_new = not is_regular(run.record)
        for path in (page, picture, flight):
            if is_new and path.exists():
                raise FileExistsError(f"{path} exists, and was made from no run in {out}: choose another `out`")
        has_cameras = len(sources) == 1 and is_scene(first)
        scene = first if has_cameras else out / "scene"
        lists: dict[str, Mapping[str, object]] = {PHOTOGRAPHS: photograph_sizes(sources)}
        if has_cameras:
            lists[CAMERAS] = {name_in(folder_of(first), file): sha256_of(file) for file in camera_files(place)}
        is_made = not is_new or (not has_cameras and is_scene(scene))
        for file_name, found in lists.items():
            if is_made:
                check_unchanged(found, out, file_name)
            else:
                write_json(out / file_name, found)
        if not is_scene(scene):
            # The next step follows, so that no advice how to continue is needed.
            run_step("sfm", [*map(str, sources), "--out", str(scene)], lambda command: command.find_cameras())
        if is_new:
            left = 60 * self.minutes - (time.monotonic() - started)
            training = choose_training(scene, left)
            print_now(training.text)
            run_step("train", [str(scene), "--out", str(run.path), *training.flags, "--yes"])
        elif not is_finished(run, read_record(run)):
            run_step("train", ["--out", str(run.path), "--resume"])
        else:
            print_now(f"{run.path} is trained already; for another training, give another --out")

        run_step("export", [str(run.path), "--web", str(page), "--title", name, "--overwrite"])
        run_step("render", [str(run.path), "--path", "front", "--out", str(flight), "--overwrite"])
        print_now(f"$ {shlex.join(['cp', str(flight / FRONT_NAME), str(picture)])}")
        shutil.copyfile(flight / FRONT_NAME, picture)
        origin = open_source(run.path).model.origin
        route = "orbit" if origin is not None and unseen_angle(origin) <= SURROUNDED else "smooth"
        frames = ["--frames", str(NUM_FRAMES), "--out", str(flight), "--overwrite"]
        run_step("render", [str(run.path), "--path", route, *frames])
        minutes, seconds = divmod(round(time.monotonic() - started), 60)
        print_now(f"made in {minutes}:{seconds:02} minutes\npage: {page}\npicture: {picture}\nflight: {flight}/")
        if self.open:
            open_browser(page.resolve().as_uri())


def photograph_sizes(sources: Sequence[Path]) -> dict[str, list[int]]:
    """Return the sizes in bytes of photographs and videos by name, such as fox/0.jpg for 0.jpg of the folder fox.

    A name has several sizes if folders at different places have the same name.
    """
    from a2tg_jax.data.photo_folder import listed_photos

    sizes: dict[str, list[int]] = {}
    for source in sources:
        place = source.resolve()
        for file in listed_photos(place) if place.is_dir() else [place]:
            sizes.setdefault(name_in(folder_of(source), file), []).append(file.stat().st_size)
    return {name: sorted(sizes[name]) for name in sorted(sizes)}


def folder_of(source: Path) -> Path:
    """Return the full path of a source's folder, which may be itself."""
    place = source.resolve()
    return place if place.is_dir() else place.parent


def name_in(folder: Path, file: Path) -> str:
    """Return a file's path from the folder's name on, such as fox/0.jpg."""
    # Names may hold bytes that are not UTF-8.
    return os.fsencode(file.relative_to(folder.parent).as_posix()).decode(errors="backslashreplace")


def check_unchanged(found: Mapping[str, object], out: Path, file_name: str) -> None:
    """Raise ValueError, naming a few, if the files found, with their sizes or checksums, are not those in a list of an
    output folder, one of `LISTS`."""
    if not is_regular(out / file_name):
        return  # Earlier versions wrote no list.
    listed = read_object(out / file_name)
    what, differing = LISTS[file_name]
    changes = {
        "new": [name for name in found if name not in listed],
        "removed": [name for name in listed if name not in found],
        differing: [name for name, value in found.items() if listed.get(name, value) != value],
    }
    counts = [f"{len(names)} {kind} ({first_names(names, MOST_NAMED)})" for kind, names in changes.items() if names]
    if counts:
        raise ValueError(
            f"the {what} changed since {out} was made from them: {', '.join(counts)}; give another `out`, or "
            f"remove {out} to begin again"
        )


def run_step(name: str, words: Sequence[str], run: Callable[[Any], object] = lambda command: command.run()) -> None:
    """Print a command and run it, by a function of the parsed command."""
    print_now(f"$ {shlex.join(['a2tg', name, *words])}")
    run(parsed(name, words))
