"""The command `a2tg make`: from photographs to a page, by the commands that do each step."""

import dataclasses
import os
import shlex
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from a2tg_jax.base.json_text import read_object
from a2tg_jax.base.regular_files import expanded, is_regular
from a2tg_jax.base.text import first_names
from a2tg_jax.cli.arguments import defaulting_to, open_browser, print_now
from a2tg_jax.cli.main import parsed
from a2tg_jax.results.folder import MADE, RunFolder, write_json
from a2tg_jax.results.output_paths import check_apart, check_output

NUM_FRAMES = 60
"""Number of frames of the flight."""
LISTED = ".a2tg-photographs.json"
"""File in the output folder with the names of the photographs and their bytes, by which changes are noticed."""
MOST_NAMED = 3
"""Largest number of photographs that a message names for each change."""


@dataclasses.dataclass(frozen=True)
class Make:
    """Make a page that shows a scene, from photographs or a video, in about as many minutes as you give.

    Finds the cameras, chooses the size of the photographs, the bytes and the iterations that this machine can train in
    the time, trains, and writes a page, a picture and a flight, a turntable if cameras surround the subject. Every step
    is a command, which is printed. After an interruption, the same command continues, unless the photographs changed.

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
        from a2tg_jax.data.load import is_scene
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
        name = first.resolve().stem if first.suffix else first.resolve().name
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
        photographs = photograph_sizes(sources)
        if not is_new or (not has_cameras and is_scene(scene)):
            check_unchanged(photographs, out)
        else:
            write_json(out / LISTED, photographs)
        if not is_scene(scene):
            run_step("sfm", [*map(str, sources), "--out", str(scene)])
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
        folder = place if place.is_dir() else place.parent
        for file in listed_photos(place) if place.is_dir() else [place]:
            # Names may hold bytes that are not UTF-8.
            name = os.fsencode(file.relative_to(folder.parent).as_posix()).decode(errors="backslashreplace")
            sizes.setdefault(name, []).append(file.stat().st_size)
    return {name: sorted(sizes[name]) for name in sorted(sizes)}


def check_unchanged(photographs: dict[str, list[int]], out: Path) -> None:
    """Raise ValueError if the photographs are not those that are listed in an output folder, naming a few."""
    if not is_regular(out / LISTED):
        return  # Earlier versions wrote no list.
    listed = read_object(out / LISTED)
    changes = {
        "new": [name for name in photographs if name not in listed],
        "removed": [name for name in listed if name not in photographs],
        "of another size": [name for name, sizes in photographs.items() if listed.get(name, sizes) != sizes],
    }
    counts = [f"{len(names)} {kind} ({first_names(names, MOST_NAMED)})" for kind, names in changes.items() if names]
    if counts:
        raise ValueError(
            f"the photographs changed since {out} was made from them: {', '.join(counts)}; give another `out`, or "
            f"remove {out} to begin again"
        )


def run_step(name: str, words: Sequence[str]) -> None:
    """Print a command and run it."""
    print_now(f"$ {shlex.join(['a2tg', name, *words])}")
    command = parsed(name, words)
    if name == "sfm":
        command.find_cameras()  # The next step follows, so that no advice how to continue is needed.
    else:
        command.run()
