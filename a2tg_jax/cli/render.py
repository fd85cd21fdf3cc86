"""The command `a2tg render`."""

import dataclasses
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from a2tg_jax.cli.arguments import LastModel, defaulting_to
from a2tg_jax.host.text import counted
from a2tg_jax.results.checks import check_output
from a2tg_jax.results.folder import open_run
from a2tg_jax.results.frames import (
    FRAMES_PER_SECOND,
    FrameFolder,
    Route,
    check_rate,
    parse_size,
    render_frames,
    video_name,
    write_video,
)


@dataclasses.dataclass(frozen=True)
class Render:
    """Render frames of a finished run as PNG files.

    A flight also becomes a video: MP4 if ffmpeg is installed, and otherwise an animated WebP. The photographs are not
    needed.

    Examples:
      a2tg render runs/fox --frames 240 --fps 60
      a2tg render runs/fox --size 1280x720
      a2tg render runs/fox --path orbit --frames 240 --out fox-orbit
      a2tg render runs/fox --path test --out fox-test
      a2tg render runs/fox --path path.json --out fox-flight
    """

    folder: Annotated[Positional[Path], arg(metavar="RUN")]
    """Run folder."""
    path: Route | Path = "smooth"
    """Camera path: smooth (a flight past the cameras), orbit (a turntable around the subject), test (the test views),
    or a file (*.json) saved in a2tg view."""
    frames: int = 120
    """Number of frames of the flight."""
    fps: float = FRAMES_PER_SECOND
    """Frames per second of the video."""
    size: Annotated[str | None, arg(metavar="WxH"), defaulting_to("that of the cameras")] = None
    """Width and height of the frames in pixels, such as 1280x720. Views of another aspect are cropped."""
    supersample: int = 1
    """Factor k by which frames are drawn larger and averaged: without aliasing where frames are smaller than the
    photographs, at k² times the cost."""
    out: Annotated[Path | None, defaulting_to("RUN/frames")] = None
    """Output folder."""
    model: LastModel = None
    """Name of the model, as a2tg info prints it."""
    overwrite: bool = False
    """Replace files that exist. What earlier renders wrote is always replaced, and frames of a longer flight are
    deleted."""

    def run(self) -> None:
        run = open_run(self.folder)
        out = self.out or run.path / "frames"
        check_rate(self.fps)
        if self.path == "test" and (self.frames, self.fps) != (Render.frames, Render.fps):
            raise ValueError("--frames and --fps are of a flight and have no effect on --path test: leave them out")
        size = None if self.size is None else parse_size(self.size)
        if self.supersample < 1:
            raise ValueError(f"--supersample must be at least 1; got {self.supersample}")
        check_output(out)
        if self.path != "test":
            FrameFolder(out).check([video_name()], overwrite=self.overwrite)
        paths = render_frames(
            run,
            out,
            route=self.path,
            num_frames=self.frames,
            name=self.model,
            size=size,
            supersample=self.supersample,
            overwrite=self.overwrite,
        )
        print(f"wrote {counted(len(paths), 'frame')} to {out}/")
        if self.path != "test":
            video = write_video(paths, frames_per_second=self.fps)
            if video.suffix == ".mp4":
                print(f"video: {video}")
                return
            print("no video: ffmpeg is not installed; install it for MP4 (apt install ffmpeg, brew install ffmpeg)")
            print(f"animation: {video}")
