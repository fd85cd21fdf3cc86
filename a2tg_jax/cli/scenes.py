"""The commands that show scenes in a browser, or write them for other programs: `a2tg view`, `export`, `convert`."""

import dataclasses
import webbrowser
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from a2tg_jax.cli.arguments import LastModel, RunOrFile
from a2tg_jax.data import Scene
from a2tg_jax.host.operating_system import has_display
from a2tg_jax.results.conversion import BakeOptions, check_ply, convert, export_ply
from a2tg_jax.results.folder import check_apart, check_new, check_not_source, check_output
from a2tg_jax.results.model_source import open_source
from a2tg_jax.results.viewing import check_page, export_web, routes_of, shown_live
from a2tg_jax.training.loop import Watch
from a2tg_jax.web.server import LOOPBACK, serve


@dataclasses.dataclass(frozen=True)
class ViewCommand:
    """Show a scene in a browser on this machine.

    Other machines cannot connect without --host. A run is shown with its photographs. Gaussians of 3DGS (PLY) are
    flattened along their thinnest axis.

    Examples:
      a2tg view runs/fox
      a2tg view scene.ply --port 8080 --no-open
      a2tg view runs/fox --host 0.0.0.0
    """

    source: RunOrFile
    model: LastModel = None
    host: str = LOOPBACK
    """Address to listen on. 0.0.0.0 opens the page to the network, for a phone on the same Wi-Fi. Anyone who has the
    printed address, which contains a random token, can see the scene; the connection is not encrypted."""
    port: int = 0
    """Port at that address; 0 takes a free one."""
    open: bool = True
    """Open a browser if the machine has a display."""

    def run(self) -> None:
        routes = routes_of(open_source(self.source, self.model))
        serve(routes, host=self.host, port=self.port, on_start=self._started)

    def _started(self, address: str) -> None:
        print(f"{address} shows {self.source}; press Ctrl-C to stop", flush=True)
        if self.open:
            _open(address)


@dataclasses.dataclass(frozen=True)
class Export:
    """Write a page that shows a scene in any browser, or a PLY file for other programs.

    The page is a folder for a web server, or one HTML file that opens from the disk. The PLY file holds the Gaussians
    in the original world as programs for 3DGS read them, flat, without textures.

    Examples:
      a2tg export runs/fox --web site/fox
      a2tg export runs/fox --web fox.html
      a2tg export runs/fox --ply fox.ply
    """

    source: RunOrFile
    web: Path | None = None
    """Output folder of the page; a name that ends in .html is one HTML file that needs no other."""
    ply: Annotated[Path | None, arg(metavar="FILE")] = None
    """Output file of the Gaussians."""
    float64: bool = False
    """Write the positions of --ply as float64, so that map coordinates stay whole."""
    single_file: bool = False
    """Write one HTML file, whatever its name."""
    photographs: bool = False
    """Add the photographs of the run's cameras to the page."""
    model: LastModel = None
    overwrite: bool = False
    """Replace what --web and --ply name."""

    def run(self) -> None:
        if self.web is None and (self.ply is None or self.single_file or self.photographs):
            raise ValueError("give --web PATH for a page, or --ply FILE for other programs")
        if self.float64 and self.ply is None:
            raise ValueError("--float64 has no effect without --ply: add it")
        if self.ply is not None:
            self._check_ply(self.ply)
        if self.web is not None:
            self._check_web(self.web)
        source = open_source(self.source, self.model)
        if self.web is not None:
            summary = export_web(
                source,
                self.web,
                single_file=self.single_file,
                photographs=self.photographs,
                overwrite=self.overwrite,
            )
            print(summary)
        if self.ply is not None:
            print(export_ply(source, self.ply, float64=self.float64))

    def _check_ply(self, ply: Path) -> None:
        check_output(ply)
        check_ply(ply)
        check_not_source([ply], self.source, "--ply")
        check_new(ply, "--ply", overwrite=self.overwrite)

    def _check_web(self, web: Path) -> None:
        check_output(web)
        files = check_page(web, single_file=self.single_file, photographs=self.photographs, overwrite=self.overwrite)
        if self.ply is not None:
            check_apart(files[0], self.ply)  # A PLY file may be in the folder of a page.
        check_not_source(files, self.source, "--web")


def in_browser(scene: Scene) -> AbstractContextManager[Watch]:
    """Show the training of a scene in a browser."""

    def started(address: str) -> None:
        print(f"{address} shows the training", flush=True)
        _open(address)

    return shown_live(scene, scene.name, started)


def _open(address: str) -> None:
    """Open a browser if there is a display."""
    if has_display():
        webbrowser.open(address)


@dataclasses.dataclass(frozen=True)
class Convert:
    """Convert splats between formats, chosen by the suffixes of the files.

    Reads and writes *.npz, *.a2tgz, *.ply, *.compressed.ply, *.spz, *.sog, *.splat, *.ksplat, *.glb, *.gltf, *.usda,
    *.usdc and *.usdz. Reads checkpoints of gsplat, Nerfstudio, 3DGS and 2DGS (*.pt, *.pth, *.ckpt), too. Gaussians of
    3DGS are flattened along their thinnest axis. Files of other programs hold the original world.

    Other programs support no textures, and no kernels but Gaussians. --bake turns a textured splat into plain ones, as
    many as its texels or fewer, and trains them on pictures of the model from its training cameras. The photographs
    are not needed.

    Examples:
      a2tg convert runs/fox fox.sog --bake
      a2tg convert scene.spz scene.npz
    """

    source: RunOrFile
    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """Output file."""
    model: LastModel = None

    bake: bool = False
    """Turn splats with textures, or with kernels of other shapes, into plain ones."""
    bake_growth: float = BakeOptions.growth
    """Largest ratio of bytes of the numbers after --bake to those before."""
    bake_iterations: int = BakeOptions.iterations
    """Iterations of training in --bake; each draws one view. 0 leaves training out."""

    float64: bool = False
    """Write the positions of a PLY as float64, so that map coordinates stay whole."""

    overwrite: bool = False
    """Replace the output file."""

    def run(self) -> None:
        options = BakeOptions(self.bake_growth, self.bake_iterations)
        if not self.bake and options != BakeOptions():
            raise ValueError("--bake-growth and --bake-iterations have no effect without --bake: add it")
        baking = options if self.bake else None
        baking = options if self.bake else None
        text = convert(self.source, self.out, self.model, baking=baking, float64=self.float64, overwrite=self.overwrite)
        print(text)
