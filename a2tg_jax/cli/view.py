"""What shows scenes in browsers: the commands view and export, and a training that is looked at."""

import dataclasses
import os
import sys
import webbrowser
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from a2tg_jax.data import Scene
from a2tg_jax.results.live import shown_live
from a2tg_jax.results.viewing import open_source, routes_of
from a2tg_jax.results.web_export import export_web, exported_text
from a2tg_jax.training.loop import Watch
from a2tg_jax.web.server import serve


@dataclasses.dataclass(frozen=True)
class View:
    """Show a scene in a browser, from this machine for this machine alone.

    Of a run its photographs are shown, too. Gaussians of 3DGS (PLY) are shown flat: the thinnest axis of each is left
    out.

    Examples:
      a2tg view runs/fox
      a2tg view scene.ply --port 8080 --no-open
    """

    source: Annotated[Positional[Path], arg(metavar="RUN_OR_FILE")]
    """Run folder, model (*.npz), compact scene (*.a2tgz) or point cloud of Gaussians (*.ply)."""
    model: str | None = None
    """Which model of a run, by the name that a2tg info tells (default: the last of the run's main system)."""
    port: int = 0
    """Port on 127.0.0.1; 0 is a free one."""
    open: bool = True
    """Open a browser, where the machine has a screen."""

    def run(self) -> None:
        serve(routes_of(open_source(self.source, self.model)), port=self.port, on_start=self._started)

    def _started(self, address: str) -> None:
        print(f"{address} shows {self.source}; Ctrl-C ends it", flush=True)
        if self.open:
            _open(address)


@dataclasses.dataclass(frozen=True)
class Export:
    """Write a page that shows a scene in any browser: a folder for a web server, or one file.

    Examples:
      a2tg export runs/fox --web site/fox
      a2tg export runs/fox --web fox.html --single-file
    """

    source: Annotated[Positional[Path], arg(metavar="RUN_OR_FILE")]
    """Run folder, model (*.npz), compact scene (*.a2tgz) or point cloud of Gaussians (*.ply)."""
    web: Path
    """The folder; with --single-file the HTML file."""
    single_file: bool = False
    """One HTML file that opens from the disk and needs no other."""
    photographs: bool = False
    """Put the photographs of the run's cameras beside the page."""
    model: str | None = None
    """Which model of a run, by the name that a2tg info tells (default: the last of the run's main system)."""

    def run(self) -> None:
        source = open_source(self.source, self.model)
        result = export_web(source, self.web, single_file=self.single_file, photographs=self.photographs)
        print(exported_text(result))
        print(f"page: {result.path}")


def in_browser(scene: Scene) -> AbstractContextManager[Watch]:
    """Somebody who looks at the training of a scene in a browser."""

    def started(address: str) -> None:
        print(f"{address} shows the training", flush=True)
        _open(address)

    return shown_live(scene, scene.name, started)


def _open(address: str) -> None:
    """Opens a browser where one can show itself: on Linux, where there is an X or Wayland display."""
    has_display = bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    if has_display or sys.platform in ("win32", "darwin"):
        webbrowser.open(address)
