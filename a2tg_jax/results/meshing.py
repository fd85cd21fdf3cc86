"""Mesh of a run or a model, written as a file."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from a2tg_jax import Origin, Renderer, View, view_image
from a2tg_jax.base.memory import memory_limit
from a2tg_jax.base.text import budget_in_bytes, counted, in_bytes
from a2tg_jax.host.progress_bars import progress_over
from a2tg_jax.mesh.extract import RADII, check_lengths, extract_mesh
from a2tg_jax.mesh.files import check_mesh_suffix, save_mesh
from a2tg_jax.mesh.texturing import Picture, check_texture, texture_mesh
from a2tg_jax.mesh.triangles import check_simplifying, simplify_mesh
from a2tg_jax.results.model_source import Source
from a2tg_jax.results.options import MeshOptions

MUCH_MISSING = 0.05
MANY_HOLES = ": train gaussians-2d with --preset surfaces, or from more photographs, or give a smaller --resolution"
"""Advice for meshes of which more than `MUCH_MISSING` is missing."""
GRID_SHARE = 0.5
"""Default share of the free memory for voxels."""


def check_options(options: MeshOptions, out: Path) -> None:
    """Raise ValueError if an option is invalid or a library is missing, before any computation."""
    check_mesh_suffix(out, "`out`")
    check_lengths(options.resolution, options.voxel, options.radius)
    if options.clusters < 1:
        raise ValueError(f"clusters must be at least 1; got {options.clusters}")
    wanted = budget_in_bytes(options.max_memory, "max_memory")
    most = memory_limit()
    if wanted is not None and wanted > most:
        raise ValueError(f"max_memory must be at most {in_bytes(most)}, the free memory; got {options.max_memory}")
    if options.texture != "none":
        if out.suffix.lower() == ".ply":
            raise ValueError("a PLY file holds no texture: choose `out` NAME.glb or NAME.obj, or `texture` none")
        check_texture(options.texture_size)
    elif options.texture_size != MeshOptions.texture_size:
        raise ValueError("texture_size has no effect without a texture: add `texture` renders or photographs")
    if options.most_faces is not None:
        check_simplifying(options.most_faces)


def write_mesh(
    source: Source, out: Path, options: MeshOptions, on_note: Callable[[str], object] = lambda line: None
) -> str:
    """Extract the mesh of a model, write it as `save_mesh` does, and return a summary. `on_note` receives a line before
    a texture is made.

    Raises:
      ValueError: if the model has no cameras or no surface, the photographs are missing, or the voxels need too much
        memory.
    """
    start = time.perf_counter()
    origin = source.model.origin
    if origin is None or not origin.names:
        raise ValueError(f"{source.title} has no cameras to fuse depths from; give a run folder, or a model of a run")
    # Photographs are checked here, before minutes of fusion; they are read later.
    pictures = _photographs(source, origin) if options.texture == "photographs" else _renders(source, origin)
    scale = origin.transform.scale
    max_bytes = budget_in_bytes(options.max_memory, "max_memory")
    result = extract_mesh(
        source.model,
        resolution=options.resolution,
        # Lengths of the original world times scale are lengths of the model's.
        voxel=None if options.voxel is None else options.voxel * scale,
        radius=None if options.radius is None else options.radius * scale,
        unbounded=options.unbounded,
        fill_holes=options.fill_holes,
        most_clusters=options.clusters,
        max_bytes=int(GRID_SHARE * memory_limit()) if max_bytes is None else max_bytes,
        settings=source.settings,
        progress=True,
    )
    mesh = result.mesh if options.most_faces is None else simplify_mesh(result.mesh, options.most_faces)
    if options.texture != "none":
        on_note(f"unwrapping {counted(mesh.num_faces, 'face')}")
        mesh = texture_mesh(mesh, pictures, size=options.texture_size)
    files = save_mesh(out, mesh, origin)
    size = in_bytes(sum(file.stat().st_size for file in files))
    texture = "" if mesh.texture is None else f", a texture of {mesh.texture.shape[1]} × {mesh.texture.shape[0]}"
    near_radius = result.radius / scale / RADII
    return "\n".join(
        [
            f"fused {counted(result.num_views, 'view')} at voxels of {result.voxel / scale:.3g}, within "
            f"{result.radius / scale:.3g} of the centre ({in_bytes(result.num_bytes)} of voxels)",
            f"left out {counted(result.num_dropped, 'small part')}",
            f"{100 * result.missing:.0f} % of what the views show has no surface, {100 * result.missing_near:.0f} % "
            f"within {near_radius:.3g} of the centre, where the subject is"
            f"{MANY_HOLES if result.missing > MUCH_MISSING else ''}",
            f"mesh: {mesh.num_vertices:,} vertices, {mesh.num_faces:,} faces{texture}, {size}, "
            f"{time.perf_counter() - start:.0f} s",
            f"file: {', '.join(map(str, files))}",
        ]
    )


def _photographs(source: Source, origin: Origin) -> Iterator[Picture]:
    """Return an iterator over the photographs of the training views. Raises ValueError, before iteration, if they are
    missing, or distorted by their lens."""
    scene = source.load_scene()
    if scene is None:
        raise ValueError(
            f"the photographs of {source.title} are missing; choose `texture` renders, or give the run folder while "
            "its scene is in place"
        )
    if any(view.camera.rays is not None for view in scene.train):
        raise ValueError(
            f"the photographs of {source.title} are distorted by their lens (`lens` keep), and a texture needs "
            "pinhole photographs: choose `texture` renders"
        )
    # The model's cameras, which training may have refined, not the scene's.
    cameras = dict(zip(origin.names, origin.cameras, strict=True))
    views = [view for view in scene.train if view.name in cameras]
    background = source.model.background
    return (
        (cameras[view.name], view_image(view, background), _opaque(view))
        for view in progress_over(views, "texture", "view")
    )


def _opaque(view: View) -> np.ndarray | None:
    """Return the mask [H, W] of the pixels of a photograph that count and are opaque; None: all are."""
    masks = [] if view.mask is None else [view.mask.read()]
    alpha = view.alpha
    if alpha is not None:
        masks.append(alpha == 255)
    return np.logical_and.reduce(masks) if masks else None


def _renders(source: Source, origin: Origin) -> Iterator[Picture]:
    cameras = origin.training_cameras
    renderer = Renderer(source.model, cameras=cameras, settings=source.settings, has_geometry=False)
    for camera in progress_over(cameras, "texture", "view"):
        yield camera, np.asarray(renderer(camera).color), None
