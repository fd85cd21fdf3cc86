"""The command `a2tg convert`."""

import dataclasses
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from a2tg_jax.cli.arguments import LastModel
from a2tg_jax.results.conversion import convert


@dataclasses.dataclass(frozen=True)
class Convert:
    """Convert splats between formats, chosen by the suffixes of the files.

    Reads and writes *.npz, *.a2tgz, *.ply, *.compressed.ply, *.spz, *.sog, *.splat, *.ksplat, *.glb, *.gltf, *.usda,
    *.usdc and *.usdz. Gaussians of 3DGS are flattened along their thinnest axis. Files of other programs hold the
    original world.

    Examples:
      a2tg convert runs/fox fox.sog
      a2tg convert scene.spz scene.npz
    """

    source: Annotated[Positional[Path], arg(metavar="RUN_OR_FILE")]
    """Run folder or file of splats."""
    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """Output file."""
    model: LastModel = None
    """Name of a run's model, as a2tg info prints it."""

    def run(self) -> None:
        print(convert(self.source, self.out, self.model).text)
