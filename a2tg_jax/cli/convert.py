"""The command `a2tg convert`."""

import dataclasses
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from a2tg_jax.cli.arguments import LastModel
from a2tg_jax.results.conversion import BakeOptions, convert


@dataclasses.dataclass(frozen=True)
class Convert:
    """Convert splats between formats, chosen by the suffixes of the files.

    Reads and writes *.npz, *.a2tgz, *.ply, *.compressed.ply, *.spz, *.sog, *.splat, *.ksplat, *.glb, *.gltf, *.usda,
    *.usdc and *.usdz. Reads checkpoints of gsplat, Nerfstudio, 3DGS and 2DGS (*.pt, *.pth, *.ckpt), too. Gaussians of
    3DGS are flattened along their thinnest axis. Files of other programs hold the original world.

    Other programs know no textures, and no kernels but Gaussians. --bake turns a textured splat into plain ones, as
    many as its texels or fewer, and trains them on pictures of the model from its training cameras. The photographs
    are not needed.

    Examples:
      a2tg convert runs/fox fox.sog --bake
      a2tg convert scene.spz scene.npz
    """

    source: Annotated[Positional[Path], arg(metavar="RUN_OR_FILE")]
    """Run folder or file of splats."""
    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """Output file."""
    model: LastModel = None
    """Name of a run's model, as a2tg info prints it."""

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
        told = convert(self.source, self.out, self.model, baking=baking, float64=self.float64, overwrite=self.overwrite)
        print(told)
