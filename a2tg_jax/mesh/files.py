"""Files of meshes: PLY, OBJ and GLB, a binary glTF 2.0 (host)."""

import io
import os
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from a2tg_jax import Origin, Similarity
from a2tg_jax.base.atomic import replacing, write_whole
from a2tg_jax.base.config_json import config_to_dict
from a2tg_jax.base.regular_files import expanded
from a2tg_jax.data.ply import RGB
from a2tg_jax.io.gltf import OWN
from a2tg_jax.io.gltf_container import Builder, scene_of_one
from a2tg_jax.io.other_programs import linear_colors, matrix_of, upright
from a2tg_jax.io.ply import ply_header
from a2tg_jax.mesh.triangles import Mesh, far_middle

SUFFIXES = (".glb", ".ply", ".obj")
JPEG_QUALITY = 92


def check_mesh_suffix(path: Path, name: str = "path") -> None:
    """Raise ValueError unless a path ends in a suffix of meshes."""
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{name} must end in {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}; got {path}")


def mesh_files(path: Path, *, has_texture: bool) -> list[Path]:
    """Return the files that `save_mesh` writes for a path, the path first."""
    beside = (".mtl", ".png") if has_texture and path.suffix.lower() == ".obj" else ()
    return [path, *(path.with_suffix(suffix) for suffix in beside)]


def save_mesh(path: str | os.PathLike[str], mesh: Mesh, transform: Similarity | Origin | None = None) -> list[Path]:
    """Write a mesh as GLB, PLY or OBJ, by the suffix of the path.

    GLB holds the texture or linear vertex colours, unlit, as in the photographs. PLY holds vertex colours and no
    texture. OBJ has its texture in NAME.png and its material in NAME.mtl. PLY and OBJ files are in the original world,
    with exact map coordinates. GLB is upright, with +y up and the original lengths, like splats of `save_gltf`; for map
    coordinates, its node's extras have the transform.

    Args:
      path: the file; an existing one is replaced once the new one is complete.
      mesh: a mesh.
      transform: transform from the original world to the mesh's world, or the origin with it, such as `model.origin`,
        whose chosen vertical counts for GLB. None writes the mesh unchanged, in each format.

    Returns:
      The files written, the given one first.

    Raises:
      ValueError: if the path has another suffix.

    Examples:
      >>> vertices, faces = np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32)
      >>> mesh = a2tg.Mesh(vertices, faces, colors=np.full((3, 3), 128, np.uint8))
      >>> len(a2tg.save_mesh("triangle.obj", mesh))
      1
    """
    path = expanded(path)
    check_mesh_suffix(path)
    suffix = path.suffix.lower()
    if suffix == ".glb":
        _save_glb(path, mesh, transform)
        return [path]
    # Mesh.transform returns float64, which map coordinates need.
    if isinstance(transform, Origin):
        transform = transform.transform
    if transform is not None:
        mesh = mesh.transform(transform.inverse())
    if suffix == ".obj":
        return _save_obj(path, mesh)
    kind = "<f8" if _needs_doubles(mesh.vertices) else "<f4"
    word = "float" if kind == "<f4" else "double"
    fields: list[Any] = [("positions", kind, 3)]
    properties = [(word, axis) for axis in "xyz"]
    if mesh.colors is not None:
        fields.append(("colors", "u1", 3))
        properties += [("uchar", channel) for channel in RGB]
    rows = np.empty(mesh.num_vertices, fields)
    rows["positions"] = mesh.vertices
    if mesh.colors is not None:
        rows["colors"] = mesh.colors
    # A list property is a count, then as many indices.
    faces = np.empty(mesh.num_faces, [("number", "u1"), ("corners", "<i4", 3)])
    faces["number"] = 3
    faces["corners"] = mesh.faces
    corners = [("list uchar int", "vertex_indices")]
    header = ply_header([("vertex", mesh.num_vertices, properties), ("face", mesh.num_faces, corners)])
    write_whole(path, header + rows.tobytes() + faces.tobytes())
    return [path]


def _needs_doubles(vertices: np.ndarray) -> bool:
    """Return whether float32 would round positions by more than 1e-5 of their extent, such as far from the origin."""
    largest = np.abs(vertices).max(initial=0)
    extent = np.ptp(vertices, axis=0).max() if len(vertices) else 0
    return bool(largest * np.finfo(np.float32).eps > 1e-5 * extent)


def _save_obj(path: Path, mesh: Mesh) -> list[Path]:
    """Write an OBJ file, with a material and a picture if there is a texture."""
    lines = ["# triangles"]
    written = mesh_files(path, has_texture=mesh.texture is not None)
    if mesh.texture is not None:
        _, material, picture = written
        lines += [f"mtllib {material.name}", "usemtl texture"]
        # Picture and material first, so that the mesh never names a missing file.
        with replacing(picture) as temporary:
            Image.fromarray(mesh.texture).save(temporary, "PNG")
        # Ka and Kd 1, illum 0: colours of the picture, without lights.
        write_whole(material, f"newmtl texture\nKa 1 1 1\nKd 1 1 1\nillum 0\nmap_Kd {picture.name}\n")
    with replacing(path) as temporary, open(temporary, "w", encoding="utf-8", newline="\n") as file:
        file.write("\n".join(lines) + "\n")
        rows = mesh.vertices
        if mesh.colors is not None and mesh.texture is None:
            rows = np.hstack([rows, mesh.colors / 255])
        # 15 and 9 digits bring a float64 (nearly) and a float32 back.
        number = " %.15g" if _needs_doubles(mesh.vertices) else " %.9g"
        np.savetxt(file, rows, "v" + number * 3 + " %.4g" * (rows.shape[1] - 3))
        if mesh.uv is not None:
            np.savetxt(file, mesh.uv, "vt %.6f %.6f")
            # OBJ counts from 1; positions and texture coordinates have the same numbers.
            np.savetxt(file, np.repeat(mesh.faces + 1, 2, axis=1), "f %d/%d %d/%d %d/%d")
        else:
            np.savetxt(file, mesh.faces + 1, "f %d %d %d")
    return written


def _save_glb(path: Path, mesh: Mesh, origin: Similarity | Origin | None) -> None:
    """Write a GLB file of a mesh, unlit."""
    # With a transform, the node maps to the upright world of `save_gltf`, and its extras have the transform if the
    # original world is far from there. Without one, positions far from the origin are relative to the node's
    # translation.
    transform = origin.transform if isinstance(origin, Origin) else origin
    if not mesh.num_faces:
        raise ValueError("the mesh has no faces, and a GLB file needs one at least: write a PLY or OBJ file")
    builder = Builder()
    node: dict[str, Any] = {"name": "mesh", "mesh": 0}
    middle = far_middle(mesh.vertices) if transform is None else np.zeros(3)
    if transform is not None:
        node["matrix"] = matrix_of(upright(origin, "y")).T.ravel().tolist()
        if far_middle(mesh.transform(transform.inverse()).vertices).any():
            node["extras"] = {OWN: config_to_dict(transform)}
    elif middle.any():
        node["translation"] = middle.tolist()
    attributes = {"POSITION": builder.add((mesh.vertices - middle).astype(np.float32), has_bounds=True)}
    surface: dict[str, Any] = {"metallicFactor": 0, "roughnessFactor": 1}
    if mesh.texture is not None and mesh.uv is not None:
        # The origin of glTF's textures is the upper left corner.
        attributes["TEXCOORD_0"] = builder.add((mesh.uv * (1, -1) + (0, 1)).astype(np.float32))
        surface["baseColorTexture"] = {"index": 0}
    elif mesh.colors is not None:
        # RGBA: attributes of uint16 are aligned to 4 bytes, which three columns are not.
        opaque = np.full((mesh.num_vertices, 1), 65535)
        # 16 bits: linear colours in 8 bits show steps in the dark.
        rows = np.hstack([np.rint(65535 * linear_colors(mesh.colors / 255)), opaque])
        attributes["COLOR_0"] = builder.add(rows.astype(np.uint16), normalized=True)
    indices = builder.add(mesh.faces.astype(np.uint32).reshape(-1), is_attribute=False)
    unlit = {"pbrMetallicRoughness": surface, "extensions": {"KHR_materials_unlit": {}}, "doubleSided": True}
    described = scene_of_one(node, {"attributes": attributes, "indices": indices, "material": 0})
    described |= {"materials": [unlit], "extensionsUsed": ["KHR_materials_unlit"]}
    if mesh.texture is not None:
        file = io.BytesIO()
        Image.fromarray(mesh.texture).save(file, "JPEG", quality=JPEG_QUALITY, subsampling=0)
        described["images"] = [{"bufferView": builder.add_bytes(file.getvalue()), "mimeType": "image/jpeg"}]
        # Linear, mipmaps between levels, and clamped edges, in OpenGL's numbers.
        described["samplers"] = [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}]
        described["textures"] = [{"source": 0, "sampler": 0}]
    builder.save(path, described)
