"""The commands that make scene folders: `a2tg sfm` finds cameras, `a2tg download` fetches benchmark data sets."""

import dataclasses
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from a2tg_jax.base.text import did_you_mean
from a2tg_jax.cli.arguments import defaulting_to, print_now
from a2tg_jax.data.download import BENCHMARK_SETS, fetch
from a2tg_jax.data.sfm_options import DEFAULT_FRAMES, CameraModel, Matching, Panorama
from a2tg_jax.host.signals import Stopped
from a2tg_jax.results.output_paths import check_apart, check_output

LEAST_PLACED = 0.5
"""Share of the photographs that must be exceeded by those with a camera, or the command fails."""


@dataclasses.dataclass(frozen=True)
class Sfm:
    """Find camera poses and sparse points for photographs, videos and panoramas.

    COLMAP extracts features, matches them and maps the scene. From a video (pip install 'a2tg-jax[video]') it takes the
    sharpest frames along the camera path. Panoramas of 360° are cut into views. Photographs are rotated as EXIF says.
    The scene folder gets images, sparse points and cameras.png, which shows where the cameras are.

    Examples:
      a2tg sfm photos/fox scenes/fox
      a2tg train scenes/fox --out runs/fox --preset quick --downscale 4
      a2tg sfm fox.mp4 scenes/fox --frames 200
      a2tg sfm photos/phone photos/drone --out scenes/house
      a2tg sfm photos/fox/00*.jpg scenes/fox
    """

    sources: Annotated[Positional[tuple[Path, ...]], arg(metavar="PHOTOS... SCENE", help_behavior_hint="")]
    """Folders of photographs of one scene, single photographs, and videos; then the new scene folder for the images and
    the sparse model, ready for a2tg train, unless --out names it."""
    out: Annotated[Path | None, defaulting_to("the last of PHOTOS... SCENE", "SCENE")] = None
    """New scene folder."""
    masks: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Folder of masks of the photographs, NAME.jpg.png or NAME.png for NAME.jpg, black where a pixel does not count,
    neither for the cameras nor in training. They are undistorted into SCENE/masks."""
    matching: Matching = "auto"
    """Pairs of photographs to match. auto: all pairs up to 200 photographs, neighbours by name beyond. exhaustive: all
    pairs. sequential: neighbours by name, for many photographs named in the order of taking."""
    frames: int = DEFAULT_FRAMES
    """Largest number of frames to take from each video."""
    panorama: Panorama = "auto"
    """Pictures to cut into perspective views. auto: those twice as wide as high whose metadata (GPano) say that they
    are panoramas, or whose left and right edges join where there is texture. yes: all that are twice as wide as high.
    no: none."""

    camera_model: CameraModel = "SIMPLE_RADIAL"
    """Lens to estimate. OPENCV suits wide lenses, OPENCV_FISHEYE action cameras such as GoPro's."""

    def run(self) -> None:
        print(self.find_cameras())

    def find_cameras(self) -> str:
        """Write the scene folder, and return how to continue with it."""
        from a2tg_jax.data.load import is_scene
        from a2tg_jax.data.photo_folder import CAMERA_PICTURE
        from a2tg_jax.data.sfm import run_sfm
        from a2tg_jax.results.commands import first_training_command, quick_flags, quicker_advice
        from a2tg_jax.results.figures import save_camera_picture

        sources, out = self._places()
        if self.masks is not None:
            check_apart(out, self.masks)
        for source in sources:
            check_apart(out, source)
            if is_scene(source):
                print(f"{source} has cameras already, which a2tg train reads; COLMAP finds them again", flush=True)
        check_output(out)
        try:
            summary = run_sfm(
                sources,
                out,
                masks=self.masks,
                camera_model=self.camera_model,
                matching=self.matching,
                frames=self.frames,
                panorama=self.panorama,
                on_note=print_now,
            )
        except KeyboardInterrupt as interrupt:
            stopped = Stopped.of(interrupt)
            stopped.advice = "nothing was kept: the same command begins again"
            raise stopped from None
        save_camera_picture(out, out / CAMERA_PICTURE)
        print(
            f"{summary.num_registered} of {summary.num_photos} photographs registered, {summary.num_points:,} points, "
            f"mean reprojection error {summary.mean_error:.2f} pixels"
        )
        command = first_training_command(out, quick_flags(summary.longest_side))
        if summary.num_registered <= LEAST_PLACED * summary.num_photos:
            raise ValueError(
                f"only {summary.num_registered} of {summary.num_photos} photographs have a camera, so that {out} shows "
                f"less than you photographed; the warnings say what may help. To train it all the same: {command}"
            )
        print(f"cameras: {out / CAMERA_PICTURE}", flush=True)
        quicker = quicker_advice(out, summary.longest_side)
        return f"scene: {out}; continue with: {command}\nquicker: {quicker}"

    def _places(self) -> tuple[list[Path], Path]:
        """Return the sources and the scene folder."""
        from a2tg_jax.data.photo_folder import holds_photos

        if not self.sources:
            raise ValueError("PHOTOS is missing: a folder of photographs, photographs, or a video")
        if self.out is not None:
            return list(self.sources), self.out
        if len(self.sources) < 2:
            raise ValueError("SCENE is missing: the new scene folder comes last, or after --out")
        *sources, out = self.sources
        has_model = (out / "sparse").exists()  # run_sfm reports such a folder.
        what = "is a file" if out.is_file() else "holds photographs"
        if out.is_file() or (holds_photos(out) and not has_model):
            raise ValueError(f"{out} {what}, but the scene folder comes last; name that by --out SCENE")
        return sources, out


@dataclasses.dataclass(frozen=True)
class Download:
    """Download benchmark data sets and unpack them.

    Repeat the command to continue an interrupted download. Sets that exist are skipped. Scenes are unpacked where the
    experiments find them.

    Examples:
      a2tg download --list
      a2tg download mipnerf360 tandt-db --out scenes
    """

    names: Annotated[Positional[tuple[str, ...]], arg(metavar="NAME")] = ()
    """Data sets, as --list names them."""
    out: Annotated[Path, arg(metavar="SCENES")] = Path("scenes")
    """Folder for all scenes."""
    list: bool = False
    """Print names, sizes and contents of the data sets."""

    def run(self) -> None:
        if self.list or not self.names:
            for name, known in BENCHMARK_SETS.items():
                size = known.num_bytes
                print(f"{name:<17} {'      ?' if size is None else f'{size / 1e9:4.1f} GB'}  {known.content}")
            print("The server reports sizes with ? before the download.")
            return
        for name in self.names:  # All names, before the first download.
            if name not in BENCHMARK_SETS:
                near = did_you_mean(name, BENCHMARK_SETS)
                raise ValueError(f"there is no data set {name!r}{near or ';'} they are {', '.join(BENCHMARK_SETS)}")
        for name in self.names:
            archive = BENCHMARK_SETS[name]
            print(f"{name}: {archive.url}", flush=True)
            is_new = fetch(archive, self.out)
            print(f"{name}: {'unpacked' if is_new else 'is there already'} in {self.out / archive.folder}")
