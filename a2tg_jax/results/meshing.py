"""A mesh of a run or a model, written as a file."""

import dataclasses
import time
from pathlib import Path

from a2tg_jax.core.budget import bytes_of, megabytes_of
from a2tg_jax.core.display import counted, in_bytes
from a2tg_jax.host.memory import memory_limit
from a2tg_jax.mesh.blocks import GridFullError
from a2tg_jax.mesh.extract import MeshResult, extract_mesh
from a2tg_jax.mesh.files import check_mesh_suffix, save_mesh
from a2tg_jax.model import Model
from a2tg_jax.results.viewing import Source

GRID_SHARE = 0.5
"""Share of the free memory that voxels may take by default."""


@dataclasses.dataclass(frozen=True)
class MeshOptions:
    """Options of a mesh; lengths are in units of the original world."""

    resolution: int | None = None
    voxel: float | None = None
    radius: float | None = None
    unbounded: bool = False
    clusters: int = 50
    max_memory: str | float | None = None

    def check(self, out: Path) -> None:
        """Raise ValueError before anything is computed if an option or the output is invalid."""
        check_mesh_suffix(out, "--out")
        megabytes_of(self.max_memory, "max_memory")


def write_mesh(source: Source, out: Path, options: MeshOptions) -> str:
    """Extract the mesh of a model, write it in the original world, and return a summary.

    Raises:
      ValueError: if the model has no cameras or no surface, or the voxels need too much memory.
    """
    start = time.perf_counter()
    if source.model.origin is None:
        raise ValueError(f"{source.title} has no cameras to fuse depths from; give a run folder, or a model of a run")
    result = _extracted(source, source.model, options)
    files = save_mesh(out, result.mesh, source.model.origin.transform)
    return _summary(source.model, result, files, time.perf_counter() - start)


def _extracted(source: Source, model: Model, options: MeshOptions) -> MeshResult:
    scale = 1.0 if model.origin is None else model.origin.transform.scale
    megabytes = megabytes_of(options.max_memory, "max_memory")
    try:
        return extract_mesh(
            model,
            resolution=options.resolution,
            voxel=None if options.voxel is None else options.voxel * scale,
            radius=None if options.radius is None else options.radius * scale,
            unbounded=options.unbounded,
            most_clusters=options.clusters,
            max_bytes=int(GRID_SHARE * memory_limit()) if megabytes is None else bytes_of(megabytes),
            settings=source.settings,
            progress=True,
        )
    except GridFullError as error:
        told = str(error).partition(": ")[0]
        raise ValueError(f"{told}: lower --resolution or --radius, or raise --max-memory") from None


def _summary(model: Model, result: MeshResult, files: list[Path], seconds: float) -> str:
    """Return what was made, in lines."""
    mesh = result.mesh
    scale = 1.0 if model.origin is None else model.origin.transform.scale
    size = in_bytes(sum(file.stat().st_size for file in files))
    lines = [
        f"fused {counted(result.num_views, 'view')} at voxels of {result.voxel / scale:.3g}, within "
        f"{result.radius / scale:.3g} of the centre ({in_bytes(result.num_bytes)} of voxels)",
        f"left out {counted(result.num_dropped, 'small part')}",
        f"mesh: {mesh.num_vertices:,} vertices, {mesh.num_faces:,} faces, {size}, {seconds:.0f} s",
        f"file: {', '.join(map(str, files))}",
    ]
    return "\n".join(lines)
