"""The command `a2tg sfm`."""

import dataclasses
import shlex
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from a2tg_jax.data import run_sfm
from a2tg_jax.data.sfm import Matching
from a2tg_jax.results.forecast import quick_downscale, quick_flags
from a2tg_jax.results.output import check_output
from a2tg_jax.results.preflight import check_apart


@dataclasses.dataclass(frozen=True)
class Sfm:
    """Find camera poses and sparse points for plain photographs.

    COLMAP extracts features, matches them and maps the scene. Frames of a video are photographs too:
    ffmpeg -i fox.mp4 -vf fps=2 -q:v 2 photos/fox/%04d.jpg

    Example:
      a2tg sfm photos/fox scenes/fox && a2tg train scenes/fox --out runs/fox --preset quick --downscale 4
    """

    photos: Annotated[Positional[Path], arg(metavar="PHOTOS")]
    """Folder of photographs of one scene."""
    out: Annotated[Positional[Path], arg(metavar="SCENE")]
    """New scene folder for the images and the sparse model, ready for a2tg train."""
    matching: Matching = "auto"
    """Pairs of photographs to match. auto: all pairs up to 200 photographs, neighbours by name beyond. exhaustive: all
    pairs. sequential: neighbours by name, for many photographs named in the order of taking."""

    def run(self) -> None:
        check_apart(self.out, self.photos)
        check_output(self.out)
        found = run_sfm(self.photos, self.out, matching=self.matching)
        print(f"{found.num_registered} of {found.num_photos} photographs registered, {found.num_points:,} points")
        run = ["a2tg", "train", str(self.out), "--out", f"runs/{self.out.resolve().name}"]
        command = shlex.join([*run, *quick_flags(quick_downscale(found.longest_side))])
        print(f"scene: {self.out}; continue with: {command}")
