"""The command `a2tg mesh`."""

import dataclasses
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from a2tg_jax.cli.arguments import LastModel, defaulting_to
from a2tg_jax.mesh.files import mesh_files
from a2tg_jax.results.checks import check_export, check_not_source, check_output
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.meshing import TEXTURED_FACES, MeshOptions, TextureSource, write_mesh
from a2tg_jax.results.model_source import open_source


@dataclasses.dataclass(frozen=True)
class MeshCommand:
    """Write the surface of a trained scene as triangles, by fusion of rendered depths.

    GLB stands upright with the lengths of the original world, PLY and OBJ are in the original world. Photographs are
    read for a texture only. Surfaces are best if the scene was trained with --system gaussians-2d --preset surfaces.

    Examples:
      a2tg mesh runs/fox
      a2tg mesh runs/fox --out fox.ply --resolution 1024
      a2tg mesh runs/fox --texture photographs
      a2tg mesh runs/street --unbounded
    """

    source: Annotated[Positional[Path], arg(metavar="RUN_OR_MODEL")]
    """Run folder, or model with cameras (*.npz or *.a2tgz)."""
    out: Annotated[Path | None, defaulting_to("RUN/mesh.glb, or NAME-mesh.glb beside the model", "FILE")] = None
    """Output file, *.glb, *.ply or *.obj."""
    resolution: Annotated[int | None, defaulting_to("512, unless --voxel is given", "N")] = None
    """Voxels along the radius."""
    voxel: Annotated[float | None, defaulting_to("radius / resolution", "LENGTH")] = None
    """Side of a voxel in units of the original world."""
    radius: Annotated[float | None, defaulting_to("twice the cameras' median distance from it", "LENGTH")] = None
    """Radius around the point that the cameras look at, in units of the original world."""
    unbounded: bool = False
    """Go on beyond the radius, with voxels that grow with the distance."""
    clusters: int = MeshOptions.clusters
    """Largest number of connected parts to keep; smaller ones are floaters."""
    faces: Annotated[int | None, defaulting_to(f"all, or {TEXTURED_FACES:,} with a texture", "N")] = None
    """Largest number of faces. Needs pip install 'a2tg-jax[mesh]'."""
    texture: TextureSource = "none"
    """Fill a texture atlas from renders or photographs of the training views (GLB and OBJ). Needs the same."""
    texture_size: int = MeshOptions.texture_size
    """Side of the atlas in texels."""
    max_memory: Annotated[str | None, defaulting_to("half of the free memory", "SIZE")] = None
    """Memory budget of the voxels, such as 4GB."""
    model: LastModel = None
    """Name of a run's model, as a2tg info prints it."""
    overwrite: bool = False
    """Replace files that exist. The default of a run is always replaced once a2tg mesh has written it."""

    def run(self) -> None:
        is_run = self.source.is_dir()
        default = self.source / "mesh.glb" if is_run else self.source.with_name(f"{self.source.stem}-mesh.glb")
        out = self.out or default
        options = MeshOptions(**{field.name: getattr(self, field.name) for field in dataclasses.fields(MeshOptions)})
        options.check(out)
        files = mesh_files(out, has_texture=options.texture != "none")
        check_not_source(files, self.source, "--out")
        source = open_source(self.source, self.model)
        check_output(out)
        for file in files:
            check_export(file, default, "--out", overwrite=self.overwrite)
        print(write_mesh(source, out, options))
        if is_run and out.resolve() == default.resolve():
            RunFolder(self.source).own(default)
