"""The commands for finished runs and models: `a2tg eval`, `finish`, `render`, `mesh`, `view`, `export`, `convert`,
`edit`, `mask`, `compress` and `info`.

Each imports what it works with when it runs: JAX takes a second, which a mistyped option should not cost.
"""

import dataclasses
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from a2tg_jax.base.text import counted
from a2tg_jax.cli.arguments import (
    FLAGS,
    EditFile,
    LastModel,
    LpipsWeights,
    RunFolderPath,
    RunOrFile,
    defaulting_to,
    open_browser,
    print_now,
)
from a2tg_jax.results.folder import RunFolder, json_text, open_run, opened, runs_in
from a2tg_jax.results.options import (
    FRAMES_PER_SECOND,
    MAX_LOSS,
    STILLS,
    TEXTURED_FACES,
    BakeOptions,
    CameraPath,
    CompressOptions,
    EditOptions,
    FinishOptions,
    MeshOptions,
    PlacementOptions,
)
from a2tg_jax.results.output_paths import check_apart, check_export, check_not_source, check_output
from a2tg_jax.web.server import LOOPBACK, serve

FLAGS[CompressOptions] = {
    "max_loss": (defaulting_to(f"{MAX_LOSS:g}", "DB"),),
    "file_budget": (defaulting_to("--max-loss decides", "SIZE"),),
}
FLAGS[EditOptions] = {
    "crop": (arg(metavar="LOW:HIGH"),),
    "upright": (arg(metavar="PHOTOGRAPH"),),
    "background": (arg(metavar="COLOR"),),
}
FLAGS[MeshOptions] = {
    "resolution": (defaulting_to("512, or fewer for small photographs", "N"),),
    "voxel": (defaulting_to("radius / resolution", "LENGTH"),),
    "radius": (defaulting_to("twice the cameras' median distance from it", "LENGTH"),),
    "faces": (defaulting_to(f"all, or {TEXTURED_FACES:,} with a texture", "N"),),
    "max_memory": (defaulting_to("half of the free memory", "SIZE"),),
}


@dataclasses.dataclass(frozen=True)
class Eval:
    """Evaluate the finished stages of a run again.

    Rewrites metrics, pictures and report.

    Example:
      a2tg eval runs/fox --lpips-weights lpips_alex.npz
    """

    folder: RunFolderPath
    lpips_weights: Annotated[Path | None, arg(metavar="FILE")] = None
    """Weights file (.npz) for LPIPS with AlexNet or SqueezeNet. Without it, the LPIPS in metrics.json is kept if the
    models are the same."""
    json: bool = False
    """Print metrics.json, for programs, instead of a table."""

    def run(self) -> None:
        from a2tg_jax.cli.training import print_result
        from a2tg_jax.results.report import metrics_json
        from a2tg_jax.results.run_evaluation import check_weights, evaluate_run

        check_weights(self.lpips_weights)
        with opened(self.folder) as run:
            result = evaluate_run(run, lpips_weights=self.lpips_weights)
            if self.json:
                print(json_text(metrics_json(result)))
            else:
                print_result(result, self.folder)


@dataclasses.dataclass(frozen=True)
class Finish:
    """Shrink and polish the model of a finished run, in a new run folder.

    Textures become smaller where that loses next to nothing on the training views. Then colours and texels are solved
    for the least squared error on these views. The new run is evaluated; the old one does not change.

    Example:
      a2tg finish runs/fox --out runs/fox-finished
    """

    folder: RunFolderPath
    out: Path
    """New run folder."""
    options: Annotated[FinishOptions, arg(name="")] = FinishOptions()
    lpips_weights: LpipsWeights = None

    def run(self) -> None:
        from a2tg_jax.results.finishing import finish_run
        from a2tg_jax.results.run_evaluation import check_weights

        check_weights(self.lpips_weights)
        check_apart(self.out, self.folder)
        check_output(self.out)
        print(finish_run(open_run(self.folder), self.out, self.options, lpips_weights=self.lpips_weights))
        print(f"report: {RunFolder(self.out).report}")


@dataclasses.dataclass(frozen=True)
class Render:
    """Render frames of a finished run as PNG files.

    A flight also becomes a video: MP4 if ffmpeg is installed, and otherwise an animated WebP. The photographs are not
    needed.

    Examples:
      a2tg render runs/fox --frames 240 --fps 60
      a2tg render runs/fox --size 1920x1080
      a2tg render runs/fox --path orbit --frames 240 --out fox-orbit
      a2tg render runs/fox --path front
      a2tg render runs/fox --path test --out fox-test
      a2tg render runs/fox --path path.json --out fox-flight
    """

    folder: RunFolderPath
    path: CameraPath | Path = "smooth"
    """Camera path: smooth (a flight past the cameras), orbit (a turntable around the subject), front (one frame, at
    which the viewer opens), test (the test views), or a file (*.json) saved in a2tg view."""
    frames: int = 120
    """Number of frames of the flight."""
    fps: float = FRAMES_PER_SECOND
    """Frames per second of the video."""
    size: Annotated[
        str | None,
        arg(metavar="WxH"),
        defaulting_to("as many pixels as 1280x720, in the photographs' aspect"),
    ] = None
    """Width and height of the frames in pixels, such as 1920x1080; test views keep theirs by default. In another aspect
    views are whole, with more at two sides. An orbit shows the whole subject in any."""
    supersample: int = 1
    """Factor k by which frames are drawn larger and averaged: without aliasing where frames are smaller than the
    photographs, at k² times the cost."""
    out: Annotated[Path | None, defaulting_to("RUN/frames")] = None
    """Output folder."""
    model: LastModel = None
    edit: EditFile = None
    overwrite: bool = False
    """Replace files that exist. Files of earlier renders are always replaced, and frames of a longer flight deleted."""

    def run(self) -> None:
        from a2tg_jax.results.frames import FrameFolder, check_rate, parse_size, render_frames, video_name, write_video

        run = open_run(self.folder)
        out = self.out or run.path / "frames"
        check_rate(self.fps)
        # Fields of the class are the defaults.
        is_flight = self.path not in STILLS
        if not is_flight and (self.frames, self.fps) != (Render.frames, Render.fps):
            raise ValueError(f"--frames and --fps have no effect on --path {self.path}: leave them out")
        size = None if self.size is None else parse_size(self.size)
        if self.supersample < 1:
            raise ValueError(f"--supersample must be at least 1; got {self.supersample}")
        check_output(out)
        if is_flight:
            # Before minutes of rendering.
            FrameFolder(out).check([video_name()], overwrite=self.overwrite)
        paths = render_frames(
            run,
            out,
            route=self.path,
            num_frames=self.frames,
            name=self.model,
            size=size,
            supersample=self.supersample,
            edit=self.edit,
            overwrite=self.overwrite,
        )
        print(f"wrote {counted(len(paths), 'frame')} to {out}/")
        if is_flight:
            video = write_video(paths, frames_per_second=self.fps)
            if video.suffix != ".mp4":
                print("no video: ffmpeg is not installed; install it for MP4 (apt install ffmpeg, brew install ffmpeg)")
            print(f"{'video' if video.suffix == '.mp4' else 'animation'}: {video}")


@dataclasses.dataclass(frozen=True)
class MeshCommand:
    """Write the surface of a trained scene as triangles, by fusion of rendered depths.

    GLB files are upright and in the units of the original world; PLY and OBJ are in the original world. Photographs are
    needed for textures only. For the best surfaces, train with --system gaussians-2d --preset surfaces.

    Examples:
      a2tg mesh runs/fox
      a2tg mesh runs/fox --out fox.ply --resolution 1024
      a2tg mesh runs/fox --texture photographs
      a2tg mesh runs/street --unbounded
    """

    source: Annotated[Positional[Path], arg(metavar="RUN_OR_MODEL")]
    """Run folder, or model with cameras (*.npz or *.a2tgz)."""
    out: Annotated[Path | None, defaulting_to("RUN/mesh.glb, or NAME-mesh.glb next to the model", "FILE")] = None
    """Output file, *.glb, *.ply or *.obj."""
    options: Annotated[MeshOptions, arg(name="")] = MeshOptions()
    model: LastModel = None
    edit: EditFile = None
    overwrite: bool = False
    """Replace files that exist. A run's mesh.glb, once a2tg mesh has written it, is always replaced."""

    def run(self) -> None:
        from a2tg_jax.mesh.files import mesh_files
        from a2tg_jax.results.meshing import check_options, write_mesh
        from a2tg_jax.results.model_source import open_source

        is_run = self.source.is_dir()
        default = self.source / "mesh.glb" if is_run else self.source.with_name(f"{self.source.stem}-mesh.glb")
        out = self.out or default
        check_options(self.options, out)
        files = mesh_files(out, has_texture=self.options.texture != "none")
        check_not_source(files, self.source, "--out")
        check_output(out)
        for file in files:
            check_export(file, default, "--out", overwrite=self.overwrite)
        source = open_source(self.source, self.model, self.edit)
        if is_run and out.resolve() == default.resolve():
            # Listed, so that the next a2tg mesh may replace it (check_export).
            RunFolder(self.source).own(default)
        print(write_mesh(source, out, self.options, print_now))


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
    edit: EditFile = None
    host: str = LOOPBACK
    """Address to listen on. 0.0.0.0 opens the page to the network, for a phone on the same Wi-Fi. Anyone who has the
    printed address, which contains a random token, can see the scene; the connection is not encrypted."""
    port: int = 0
    """Port at that address; 0: any free one."""
    open: bool = True
    """Open a browser if the machine has a display."""

    def run(self) -> None:
        from a2tg_jax.results.model_source import open_source
        from a2tg_jax.results.viewing import routes_of

        source = open_source(self.source, self.model, self.edit)
        serve(routes_of(source), host=self.host, port=self.port, on_start=self._started)

    def _started(self, address: str) -> None:
        print(f"{address} shows {self.source}; press Ctrl-C to stop", flush=True)
        if self.open:
            open_browser(address)


@dataclasses.dataclass(frozen=True)
class Export:
    """Write a page that shows a scene in any browser.

    The page is a folder for a web server, or one HTML file that opens without one. a2tg convert writes files for other
    programs.

    Examples:
      a2tg export runs/fox --web site/fox
      a2tg export runs/fox --web fox.html
    """

    source: RunOrFile
    web: Path
    """Output folder of the page, or one HTML file, if the name ends in .html."""
    single_file: bool = False
    """Write one HTML file, whatever its name."""
    photographs: bool = False
    """Add the photographs of the run's cameras to the page."""
    title: str | None = None
    """Title of the page, instead of the name of the scene."""
    model: LastModel = None
    edit: EditFile = None
    overwrite: bool = False
    """Replace the page if it exists."""

    def run(self) -> None:
        from a2tg_jax.results.model_source import open_source
        from a2tg_jax.results.page_export import check_page, export_web

        page = {"single_file": self.single_file, "photographs": self.photographs, "overwrite": self.overwrite}
        check_output(self.web)
        check_not_source(check_page(self.web, **page), self.source, "--web")
        source = open_source(self.source, self.model, self.edit)
        titled = source if self.title is None else dataclasses.replace(source, title=self.title)
        print(export_web(titled, self.web, **page))


@dataclasses.dataclass(frozen=True)
class Compare:
    """Write a page that shows two runs or models of one scene with a divider between them.

    Example:
      a2tg compare runs/fox runs/small --out compare.html
    """

    first: RunOrFile
    second: RunOrFile
    out: Annotated[Path, arg(metavar="FILE")] = Path("compare.html")
    """Output file, *.html."""
    overwrite: bool = False
    """Replace the output file."""

    def run(self) -> None:
        from a2tg_jax.results.model_source import open_source
        from a2tg_jax.results.page_export import export_comparison

        check_output(self.out)
        sources = [open_source(self.first), open_source(self.second)]
        print(export_comparison(sources, self.out, overwrite=self.overwrite))


@dataclasses.dataclass(frozen=True)
class Convert:
    """Convert splats between formats, chosen by the suffixes of the files.

    Reads and writes *.npz, *.a2tgz, *.ply, *.compressed.ply, *.spz, *.sog, *.splat, *.ksplat, *.glb, *.gltf, *.usda,
    *.usdc and *.usdz. Also writes checkpoints of gsplat (*.pt, *.pth) and Nerfstudio (*.ckpt). Gaussians of 3DGS are
    flattened along their thinnest axis. Files of other programs are upright, with the original units.

    Other programs support no textures, and no kernels but Gaussians. --bake turns a textured splat into plain ones, as
    many as its texels or fewer, and trains them on pictures of the model from its training cameras. The photographs
    are not needed.

    Examples:
      a2tg convert runs/fox fox.sog --bake
      a2tg convert runs/fox fox-edited.npz --edit edit.json
      a2tg convert scene.spz scene.npz
    """

    source: RunOrFile
    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """Output file."""
    model: LastModel = None
    edit: EditFile = None
    baking: Annotated[BakeOptions, arg(name="")] = BakeOptions()
    placement: Annotated[PlacementOptions, arg(name="")] = PlacementOptions()
    overwrite: bool = False
    """Replace the output file."""

    def run(self) -> None:
        from a2tg_jax.results.conversion import convert

        print(
            convert(
                self.source,
                self.out,
                self.model,
                edit=self.edit,
                baking=self.baking,
                placement=self.placement,
                overwrite=self.overwrite,
            )
        )


@dataclasses.dataclass(frozen=True)
class EditCommand:
    """Crop and turn a model, remove floaters or all but the subject, and set the background, without a browser.

    --out is an edit for --edit of other commands, as a2tg view saves it (*.json), or the edited model in any format of
    a2tg convert.

    Examples:
      a2tg edit runs/fox --out fox.sog --crop 35:65 35:65 0:100 --floaters 40
      a2tg edit runs/toy --out toy.glb --subject
      a2tg edit runs/fox --out edit.json --upright IMG_0012.jpg --background white
    """

    source: RunOrFile
    out: Annotated[Path, arg(metavar="FILE")]
    """Output file."""
    options: Annotated[EditOptions, arg(name="")] = EditOptions()
    model: LastModel = None
    overwrite: bool = False
    """Replace the output file."""

    def run(self) -> None:
        from a2tg_jax.results.editing import write_edit

        print(write_edit(self.source, self.out, self.options, self.model, overwrite=self.overwrite))


@dataclasses.dataclass(frozen=True)
class MaskCommand:
    """Write masks of the photographs from a first, short training, to train the subject alone.

    A mask is white where at least half of the light comes from the subject. Training reads masks from the folder masks
    next to images; with --mask-as background, black pixels become empty.

    Examples:
      a2tg mask runs/toy --out scenes/toy/masks
      a2tg mask runs/toy --out scenes/toy/masks --edit edit.json
    """

    folder: RunFolderPath
    out: Path
    """Output folder."""
    edit: Annotated[Path | None, arg(metavar="FILE")] = None
    """Edit (*.json), as a2tg view saves it; the masks show what it keeps, such as a crop box, instead of the
    subject."""
    model: LastModel = None
    overwrite: bool = False
    """Replace masks that exist."""

    def run(self) -> None:
        from a2tg_jax.results.masking import write_masks

        print(write_masks(open_run(self.folder), self.out, self.edit, self.model, overwrite=self.overwrite))


@dataclasses.dataclass(frozen=True)
class Compress:
    """Write the smallest file of a model within a given loss of PSNR, or the best one within given bytes.

    The loss is measured on at most 16 training views. If the photographs are missing, it is estimated from renders, for
    a model of 30 dB. This takes minutes on a CPU. With --tune-iterations the model is trained further while its numbers
    are rounded, so that fewer bits suffice.

    Examples:
      a2tg compress runs/fox
      a2tg compress runs/fox --tune-iterations 1000
      a2tg compress runs/fox --file-budget 60kB --tune-iterations 1000
      a2tg compress scene.npz --out scene.a2tgz --max-loss 0.02
    """

    source: Annotated[Positional[Path], arg(metavar="RUN_OR_MODEL")]
    """Model file (*.npz), or run folder, whose last model is taken."""
    out: Annotated[Path | None, defaulting_to("NAME.a2tgz next to the model", "FILE")] = None
    """Output file, *.a2tgz."""
    options: Annotated[CompressOptions, arg(name="")] = CompressOptions()
    overwrite: bool = False
    """Replace the output file. A file that a2tg compress wrote into a run folder is always replaced."""
    verbose: bool = False
    """Print a table of the loss and the bytes of each choice of bits."""

    def run(self) -> None:
        from a2tg_jax.results.compression import compress

        print(
            compress(
                self.source, self.out, self.options, overwrite=self.overwrite, verbose=self.verbose, on_note=print_now
            )
        )


@dataclasses.dataclass(frozen=True)
class Info:
    """Print the scene, the progress of each stage, the models, metrics and disk use of a run, a line for each run in a
    folder, or what a file of splats holds.

    Examples:
      a2tg info runs/fox --json
      a2tg info runs
      a2tg info scene.sog
    """

    folder: RunOrFile
    json: bool = False
    """Print JSON, for programs."""

    def run(self) -> None:
        from a2tg_jax.base.regular_files import is_regular
        from a2tg_jax.io.formats import splats_at
        from a2tg_jax.results import info

        path = splats_at(self.folder)
        if is_regular(path):
            print(json_text(info.file_facts(path)) if self.json else info.describe_file(path))
            return
        runs = [] if RunFolder(self.folder).record.is_file() else runs_in(self.folder)
        if runs:
            print(
                json_text([info.facts_or_damage(run) for run in runs])
                if self.json
                else info.describe_runs(runs, self.folder)
            )
            return
        run = open_run(self.folder)
        print(json_text(info.run_facts(run)) if self.json else info.describe_run(run))
