"""Options of the commands for trained models. They need no JAX, so that a mistyped option costs no time."""

import dataclasses
import math
from typing import Literal

MAX_LOSS = 0.05
"""Default of `CompressOptions.max_loss`."""
TEXTURED_FACES = 100_000
"""Default number of faces of a mesh with a texture."""
FRAMES_PER_SECOND = 30
CameraPath = Literal["smooth", "orbit", "front", "test"]
STILLS = ("front", "test")
"""Camera paths that are single views."""
TextureSource = Literal["none", "renders", "photographs"]


@dataclasses.dataclass(frozen=True)
class FinishOptions:
    """Options of a finishing."""

    max_loss: float = 0.02
    """Largest loss of PSNR in dB by smaller textures, on training views; 0 leaves textures unchanged."""
    polish_steps: int = 5
    """Steps of least squares, each of which draws every training view; too many overfit these views, and 0 leaves
    colours unchanged."""

    def check(self) -> None:
        """Raise ValueError if a number is out of range."""
        if not 0 <= self.max_loss < math.inf:
            raise ValueError(f"max_loss must be at least 0 dB; got {self.max_loss}")
        if self.polish_steps < 0:
            raise ValueError(f"polish_steps must be at least 0; got {self.polish_steps}")


@dataclasses.dataclass(frozen=True)
class CompressOptions:
    """Aim of a compression: a loss, or bytes."""

    max_loss: float | None = None
    """Largest loss of PSNR in dB."""
    file_budget: float | str | None = None
    """Largest size of the file, such as 60kB, instead of --max-loss."""
    tune_iterations: int = 0
    """Iterations of training with rounding, which makes up for fewer bits; 1000 is a good number. The model is
    tuned up to 4 times, each time for other bits: first for bits that lose 0.5 dB, or twice --max-loss if that is more.
    With --file-budget it is tuned until the file fits, mostly once. 0: numbers are only rounded."""

    @property
    def most_loss(self) -> float:
        """Largest loss in dB."""
        return MAX_LOSS if self.max_loss is None else self.max_loss

    def check(self) -> None:
        """Raise ValueError, naming the option, if one is invalid."""
        if self.file_budget is not None and self.max_loss is not None:
            raise ValueError("`max_loss` and `file_budget` exclude each other: give one of them")
        if not 0 <= self.most_loss < math.inf:
            raise ValueError(f"max_loss must be at least 0 dB; got {self.most_loss}")
        if self.tune_iterations < 0:
            raise ValueError(f"tune_iterations must be at least 0; got {self.tune_iterations}")


@dataclasses.dataclass(frozen=True)
class BakeOptions:
    """Baking of textured splats into plain ones."""

    bake: bool = False
    """Turn splats with textures, or with kernels of other shapes, into plain ones."""
    bake_growth: float = 2.0
    """Largest ratio of the numbers' bytes after --bake to the bytes before."""
    bake_iterations: int = 500
    """Iterations of training in --bake; each draws one view. 0 leaves training out."""

    def check(self) -> None:
        """Raise ValueError, naming the option, if one is out of range, or has no effect."""
        if not self.bake and self != BakeOptions():
            raise ValueError("`bake_growth` and `bake_iterations` have no effect without `bake`: add it")
        if not 1 <= self.bake_growth < math.inf:
            raise ValueError(f"bake_growth must be a finite number of at least 1; got {self.bake_growth}")
        if self.bake_iterations < 0:
            raise ValueError(f"bake_iterations must be at least 0; got {self.bake_iterations}")


@dataclasses.dataclass(frozen=True)
class PlacementOptions:
    """Positions and axes in files for other programs."""

    float64: bool = False
    """Write the positions of a PLY as float64, so that map coordinates keep their precision."""
    world: Literal["upright", "original"] = "upright"
    """Axes of files of other programs. upright: turned until +y is down, as these programs expect; map coordinates are
    kept. original: as the capture has them."""


@dataclasses.dataclass(frozen=True)
class EditOptions:
    """Changes to a model, with the percentages of the viewer's sliders."""

    crop: tuple[str, str, str] | None = None
    """Upright box to keep: from and to along width, depth and height, in percent of the largest box; 50 is the middle
    of the scene, and 0 and 100 cut nothing. Such as 35:65 35:65 0:100."""
    floaters: float = 0.0
    """Strictness in percent with which floaters are removed; 0 removes none."""
    subject: bool = False
    """Keep only what the cameras look at, without its floor and background. The command prints
    how sure that is."""
    upright: str | None = None
    """The vertical: the name of a photograph that was held level, or an axis of the original world that is up, such as
    y; write --upright=-y for one with a minus."""
    background: str | None = None
    """Colour behind the scene, such as white or #ff8000."""


@dataclasses.dataclass(frozen=True)
class MeshOptions:
    """Options of a mesh; lengths are in units of the original world."""

    resolution: int | None = None
    """Voxels along the radius."""
    voxel: float | None = None
    """Side of a voxel in units of the original world."""
    radius: float | None = None
    """Radius around the point that the cameras look at, in units of the original world."""
    unbounded: bool = False
    """Continue beyond the radius, with voxels that grow with the distance."""
    fill_holes: bool = True
    """Fill the surface by larger voxels where it is uncertain. Without, there are holes, and the rest is a little more
    accurate."""
    clusters: int = 50
    """Largest number of connected parts to keep; smaller ones are floaters."""
    faces: int | None = None
    """Largest number of faces. Needs pip install 'a2tg-jax[mesh]'."""
    texture: TextureSource = "none"
    """Fill a texture atlas from renders or photographs of the training views (GLB and OBJ). Needs xatlas (pip install
    'a2tg-jax[mesh]')."""
    texture_size: int = 2048
    """Side of the atlas in texels."""
    max_memory: str | None = None
    """Memory budget of the voxels, such as 4GB."""

    @property
    def most_faces(self) -> int | None:
        """Largest number of faces, None without a limit."""
        return TEXTURED_FACES if self.faces is None and self.texture != "none" else self.faces
