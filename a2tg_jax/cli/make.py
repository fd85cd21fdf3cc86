"""The command `a2tg make`: from photographs to a page, by the commands that do each step."""

import dataclasses
import shlex
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from a2tg_jax.base.regular_files import is_regular
from a2tg_jax.cli.arguments import defaulting_to, open_browser, print_now
from a2tg_jax.cli.main import parsed
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.output_paths import check_apart, check_output

NUM_FRAMES = 60
"""Number of frames of the flight."""


@dataclasses.dataclass(frozen=True)
class Make:
    """Make a page that shows a scene, from photographs or a video, in about as many minutes as you give.

    Finds the cameras, chooses the size of the photographs, the bytes and the iterations that this machine can train in
    the time, trains, and writes a page, a picture and a flight, a turntable if cameras surround the subject. Every step
    is a command, which is printed. After an interruption, the same command continues.

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
        first = self.sources[0]
        name = first.resolve().stem if first.suffix else first.resolve().name
        out = self.out or Path("runs") / name
        for source in self.sources:
            check_apart(out, source)
        check_output(out)
        out.mkdir(parents=True, exist_ok=True)

        run = RunFolder(out / "run")
        page = out / f"{name}.html"
        picture = out / f"{name}.png"
        flight = out / "flight"
        is_new = not is_regular(run.record)
        for path in (page, picture, flight):
            if is_new and path.exists():
                raise FileExistsError(f"{path} exists, and was made from no run in {out}: choose another `out`")
        scene = first
        if len(self.sources) > 1 or not is_scene(first):
            scene = out / "scene"
            if not is_scene(scene):
                run_step("sfm", [*map(str, self.sources), "--out", str(scene)])
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
        shutil.copyfile(flight / FRONT_NAME, picture)
        origin = open_source(run.path).model.origin
        route = "orbit" if origin is not None and unseen_angle(origin) <= SURROUNDED else "smooth"
        frames = ["--frames", str(NUM_FRAMES), "--out", str(flight), "--overwrite"]
        run_step("render", [str(run.path), "--path", route, *frames])
        minutes, seconds = divmod(round(time.monotonic() - started), 60)
        print_now(f"made in {minutes}:{seconds:02} minutes\npage: {page}\npicture: {picture}\nflight: {flight}/")
        if self.open:
            open_browser(page.resolve().as_uri())


def run_step(name: str, words: Sequence[str]) -> None:
    """Print a command and run it."""
    print_now(f"$ {shlex.join(['a2tg', name, *words])}")
    parsed(name, words).run()
