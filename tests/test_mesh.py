"""Meshes: fusion of exact depths, marching cubes over bricks, cleaning, files, distances, and the command."""

import dataclasses
import inspect
import json
import struct
import sys
import types

import jax.numpy as jnp
import numpy as np
import pytest
import surface_quality
from scipy.spatial import cKDTree
from small_values import centers_of

import a2tg_jax as a2tg
from a2tg_jax.data.synthetic import exact_points
from a2tg_jax.io.other_programs import upright
from a2tg_jax.mesh import extract, triangles
from a2tg_jax.mesh.extract import common_sphere, surface_of
from a2tg_jax.mesh.files import mesh_files
from a2tg_jax.mesh.fusion import NOTHING, BlockGrid, RenderedDepth, Space, fill, fuse
from a2tg_jax.mesh.texturing import draw_view
from a2tg_jax.mesh.triangles import largest_clusters
from a2tg_jax.results import meshing
from a2tg_jax.results.model_source import Source
from a2tg_jax.results.options import MeshOptions

SIDE = 48
RADIUS = 0.5
AROUND = np.array([direction for direction in np.ndindex(3, 3, 3) if direction != (1, 1, 1)]) - 1
"""Directions from the middle of a cube to its faces, edges and corners."""


def camera_at(center):
    """A camera that looks at 0."""
    up = (0, 0, 1) if abs(center[2]) < np.hypot(*center[:2]) else (0, 1, 0)
    return a2tg.look_at(center, (0, 0, 0), up=up, width=SIDE, height=SIDE, fov=70)


def rays_of(camera):
    """Origin [3] and directions [H, W, 3] of unit depth."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(np.asarray(camera.K, np.float64)).T
    return np.asarray(camera.center, np.float64), rays @ np.asarray(camera.viewmat, np.float64)[:3, :3]


def sphere_depths(camera, radius=RADIUS):
    """Exact depths of a sphere around 0, coloured by its positions."""
    center, rays = rays_of(camera)
    a = (rays**2).sum(-1)
    b = rays @ center
    c = center @ center - radius**2
    root = b * b - a * c
    depth = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, 0)
    color = np.clip(0.5 + (center + rays * depth[..., None]), 0, 1)
    slant = np.abs(np.sum(rays * (center + rays * depth[..., None]), axis=-1)) / radius
    facing = np.maximum(slant / np.linalg.norm(rays, axis=-1), 0.1)
    arrays = (depth, np.zeros_like(depth), np.clip(slant, 0.1, 1), facing, color)
    return RenderedDepth(camera, *(jnp.asarray(each, jnp.float32) for each in arrays))


def fused_sphere(space, distance=1.2, radius=RADIUS, directions=AROUND):
    grid = BlockGrid(200_000_000)
    for direction in directions:
        fuse(grid, sphere_depths(camera_at(distance * direction / np.linalg.norm(direction)), radius), space)
    return surface_of(grid, space)


@pytest.fixture(scope="module")
def sphere():
    """The sphere, across the corner of eight bricks."""
    return fused_sphere(Space.of(np.array([0.01, 0.02, 0.03]), 1.0, 1 / 60, False))


def test_a_sphere_is_fused_from_exact_depths_without_cracks(sphere):
    error = np.linalg.norm(sphere.vertices, axis=1) - RADIUS
    assert np.abs(error).mean() < 0.1 / 60 and np.abs(error).max() < 1 / 60
    assert sphere.area == pytest.approx(4 * np.pi * RADIUS**2, rel=0.02)
    assert (np.sum(sphere.face_normals * sphere.corners.mean(axis=1), axis=1) > 0).mean() > 0.999
    np.testing.assert_allclose(sphere.colors / 255, np.clip(0.5 + sphere.vertices, 0, 1), atol=0.05)
    edges = np.sort(sphere.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all(), "bricks are welded"


def test_an_unbounded_space_is_even_within_the_radius_and_grows_beyond():
    space = Space.of(np.zeros(3), 1.0, 0.1, True)
    points = jnp.asarray([[0.3, 0, 0], [0, 3.0, 0], [0, 0, 200.0]], jnp.float32)
    np.testing.assert_allclose(space.positions(space.indices(points)), points, rtol=1e-4)
    np.testing.assert_allclose(space.scale(points), [1, 3, 200], rtol=1e-5)
    np.testing.assert_allclose(jnp.linalg.norm(space.indices(points), axis=-1)[0], 3.0, rtol=1e-5)
    assert list(np.asarray(space.contains(2e3 * points))) == [True, False, False]


def test_far_surfaces_are_meshed_in_an_unbounded_space_only():
    far = {"distance": 60.0, "radius": 20.0, "directions": np.eye(3)}
    found = fused_sphere(Space.of(np.zeros(3), 1.0, 0.1, True), **far)
    assert np.median(np.abs(np.linalg.norm(found.vertices, axis=1) - 20)) < 0.2
    assert not fused_sphere(Space.of(np.zeros(3), 1.0, 0.1, False), **far).num_faces


@pytest.mark.parametrize(("most", "least_faces"), [(50, 50), (1, 0)])
def test_small_parts_are_dropped_and_counted(sphere, most, least_faces):
    both = a2tg.Mesh(
        np.concatenate([sphere.vertices, np.eye(3)]),
        np.concatenate([sphere.faces, np.array([[0, 1, 2]], np.int32) + sphere.num_vertices]),
    )
    kept, dropped = largest_clusters(both, most, least_faces)
    assert dropped == 1 and kept.num_faces == sphere.num_faces and kept.num_vertices == sphere.num_vertices


def test_a_drawn_mesh_has_the_depths_that_it_was_fused_from(sphere):
    camera = camera_at(np.array([0.9, -0.6, 0.4]))
    drawn = draw_view(sphere, camera)
    exact = np.asarray(sphere_depths(camera).depth)
    both = (drawn.face >= 0) & (exact > 0)
    assert both.sum() > 0.98 * (exact > 0).sum() > 300
    assert np.abs(drawn.depth - exact)[both].mean() < 0.1 / 60
    np.testing.assert_allclose(drawn.weights[both].sum(axis=-1), 1, rtol=1e-5)


# Distances


def test_distances_of_two_planes():
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    lower = a2tg.Mesh(square, faces)
    upper = a2tg.Mesh(square + np.array([0, 0, 0.1]), faces)
    points = [surface_quality.thinned(a2tg.sample_surface(mesh, 0.01), 0.005) for mesh in (lower, upper)]
    found = a2tg.surface_distance(*points, threshold=0.15)
    assert found.accuracy == pytest.approx(0.1, rel=0.01) and found.completeness == pytest.approx(0.1, rel=0.01)
    assert found.chamfer == pytest.approx(0.1, rel=0.01) and found.f_score == 1
    assert a2tg.surface_distance(*points, threshold=0.05).f_score == 0
    half = points[0][points[0][:, 0] < 0.5]
    found = a2tg.surface_distance(half, points[0], threshold=0.01)
    assert found.precision == 1 and found.recall == pytest.approx(0.51, abs=0.02)
    assert a2tg.surface_distance(half, points[0], threshold=0.01, most=0.02).completeness < 0.001 < found.completeness
    assert a2tg.surface_distance(np.zeros((0, 3)), half, threshold=1.0).chamfer == np.inf


def test_points_are_drawn_in_parts_and_bounded(sphere, monkeypatch):
    whole = a2tg.sample_surface(sphere, 0.05)
    monkeypatch.setattr(triangles, "CHUNK", 100)
    np.testing.assert_array_equal(a2tg.sample_surface(sphere, 0.05), whole)
    assert len(whole) > 1000
    with pytest.raises(ValueError, match=r"spacing 1e-06 takes 3\.\d+e\+12 points"):
        a2tg.sample_surface(sphere, 1e-6)


# Files


def glb_parts(content):
    """JSON and binary of a GLB file."""
    length = struct.unpack("<I", content[12:16])[0]
    return json.loads(content[20 : 20 + length]), content[28 + length :]


@pytest.mark.parametrize("suffix", [".glb", ".ply", ".obj"])
def test_files_are_read_back_by_another_library(sphere, tmp_path, suffix):
    trimesh = pytest.importorskip("trimesh", reason="trimesh reads the files back: pip install trimesh")
    similarity = a2tg.Similarity(2.0, np.eye(3)[[1, 2, 0]], np.array([1.0, 2, 3]))
    (path,) = a2tg.save_mesh(tmp_path / f"mesh{suffix}", sphere, similarity)
    read = trimesh.load(path, force="mesh", process=False)
    np.testing.assert_array_equal(read.faces, sphere.faces)
    placed = upright(similarity, "y").apply(sphere.vertices)
    wanted = placed if suffix == ".glb" else similarity.inverse().apply(sphere.vertices)
    np.testing.assert_allclose(read.vertices, wanted, atol=1e-5)
    if suffix != ".glb":  # trimesh shows no vertex colours of a mesh with a material.
        assert read.visual.kind == "vertex"
        np.testing.assert_array_equal(read.visual.vertex_colors[:, :3], sphere.colors)


def test_colors_of_glb_are_linear_and_far_positions_exact(tmp_path):
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.125]]) + np.array([4e6, -5e6, 10])
    mesh = a2tg.Mesh(corners, np.array([[0, 1, 2]], np.int32), np.array([[0, 188, 255]] * 3, np.uint8))
    root, data = glb_parts(a2tg.save_mesh(tmp_path / "far.glb", mesh)[0].read_bytes())
    at = root["bufferViews"][0]["byteOffset"]
    positions = np.frombuffer(data, "<f4", 9, at).reshape(3, 3) + np.array(root["nodes"][0]["translation"])
    np.testing.assert_allclose(positions, corners, rtol=0, atol=1e-6)
    colors = np.frombuffer(data, "<u2", 4, root["bufferViews"][1]["byteOffset"])
    assert list(colors) == [0, round(65535 * ((188 / 255 + 0.055) / 1.055) ** 2.4), 65535, 65535]
    assert b"property double x" in a2tg.save_mesh(tmp_path / "far.ply", mesh)[0].read_bytes()


def test_the_mesh_and_the_splats_of_a_model_lie_on_each_other(model, tmp_path):
    """Their nodes are equal, and both keep the positions of the model's world."""
    transform = model.origin.transform
    a2tg.save_gltf(tmp_path / "splats.glb", model)
    corners = a2tg.Mesh(np.asarray(model.gaussians.means), np.array([[0, 1, 2]], np.int32))
    a2tg.save_mesh(tmp_path / "mesh.glb", corners, transform)
    (splats, means), (mesh, positions) = (
        glb_parts((tmp_path / name).read_bytes()) for name in ("splats.glb", "mesh.glb")
    )
    assert splats["nodes"][0]["matrix"] == mesh["nodes"][0]["matrix"]
    size = 12 * model.num
    assert splats["bufferViews"][0] == mesh["bufferViews"][0] and means[:size] == positions[:size]


@pytest.mark.parametrize("suffix", [".glb", ".ply", ".obj"])
def test_all_files_of_a_mesh_are_known_before(tmp_path, suffix):
    own = {"uv": np.eye(3)[:, :2], "texture": np.zeros((4, 4, 3), np.uint8)}
    mesh = a2tg.Mesh(np.eye(3), np.array([[0, 1, 2]], np.int32), **own)
    path = tmp_path / f"mesh{suffix}"
    assert a2tg.save_mesh(path, mesh) == mesh_files(path, has_texture=True)
    assert set(tmp_path.iterdir()) == set(mesh_files(path, has_texture=True))


# From a model


@pytest.fixture(scope="module")
def model():
    """Opaque splats on the sphere, seen from around."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(1500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    axis = np.cross((0, 0, 1), normals)
    half = np.stack([1 + normals[:, 2], *axis.T], -1)
    gaussians = a2tg.init_from_points(RADIUS * normals, 0.5 + 0.4 * normals, sh_degree=0)
    gaussians = dataclasses.replace(
        gaussians,
        quats=jnp.asarray(half / np.linalg.norm(half, axis=1, keepdims=True), jnp.float32),
        log_scales=jnp.full((1500, 2), np.log(0.03), jnp.float32),
        logit_opacities=jnp.full((1500,), 3.0, jnp.float32),
    )
    cameras = [camera_at(1.2 * each / np.linalg.norm(each)) for each in AROUND if (each == 0).sum() != 1]
    similarity = a2tg.Similarity(0.1, np.eye(3), np.zeros(3))
    return a2tg.Model(gaussians, origin=a2tg.Origin.of_cameras(cameras, transform=similarity))


def test_a_model_becomes_a_mesh(model):
    result = a2tg.extract_mesh(model, resolution=80)
    assert result.num_views == 14 and result.radius == pytest.approx(2.4, rel=1e-3)
    assert np.median(np.abs(np.linalg.norm(result.mesh.vertices, axis=1) - RADIUS)) < result.voxel
    center, radius = common_sphere(model.origin.viewmats)
    np.testing.assert_allclose(center, 0, atol=1e-6)
    assert radius == pytest.approx(2.4, rel=1e-3)


def test_large_voxels_fill_what_small_ones_do_not_know():
    """One half of a sphere has depths that are too uncertain for small voxels, whose surface there is a hole."""
    voxel = 0.02
    spaces = [Space.of(np.zeros(3), 2.0, voxel * 2**level, False) for level in range(3)]
    grids = [BlockGrid(100_000_000) for _ in spaces]
    for direction in AROUND:
        camera = camera_at(1.5 * direction / np.linalg.norm(direction))
        depths = sphere_depths(camera)
        center, rays = rays_of(camera)
        hits = center + rays * np.asarray(depths.depth)[..., None]
        is_hit = np.asarray(depths.depth) > 0
        depths = depths._replace(
            depth=jnp.where(is_hit, depths.depth, NOTHING),
            spread=jnp.where(is_hit & (hits[..., 0] > 0), 12 * voxel, 0.0).astype(jnp.float32),
        )
        for grid, space in zip(grids, spaces, strict=True):
            fuse(grid, depths, space)

    def half_of(mesh):
        """Vertices at x > 0.1."""
        return mesh.vertices[mesh.vertices[:, 0] > 0.1]

    least = 0.3
    assert len(half_of(surface_of(grids[0], spaces[0], least))) == 0
    known = grids[0].distance.copy()
    is_known = grids[0].weight > least
    fill(grids[1], grids[2], least, least)
    fill(grids[0], grids[1], least, least)
    np.testing.assert_array_equal(grids[0].distance[is_known], known[is_known])
    filled = half_of(surface_of(grids[0], spaces[0], least))
    assert np.abs(np.linalg.norm(filled, axis=1) - RADIUS).max() < 2 * voxel
    # Vertices are everywhere on that half: no direction is farther than three degrees from one.
    exact = np.random.default_rng(0).normal(size=(500, 3))
    exact = RADIUS * exact[exact[:, 0] > 0.3 * np.linalg.norm(exact, axis=1)]
    exact = exact / np.linalg.norm(exact / RADIUS, axis=1, keepdims=True)
    assert cKDTree(filled).query(exact)[0].max() < 2 * voxel


def test_a_mesh_says_how_much_of_the_views_it_lacks(model):
    whole = a2tg.extract_mesh(model, resolution=80)
    assert a2tg.extract_mesh(model, resolution=80, fill_holes=False).num_bytes < whole.num_bytes
    part = a2tg.extract_mesh(model, resolution=80, least_weight=2.0)
    assert whole.missing < 0.01
    assert part.mesh.area < 0.95 * whole.mesh.area
    assert part.missing > 0.02
    # The sphere is within half the radius; within half of a smaller one are depths of its rim, far from its surface.
    assert part.missing_near == part.missing
    around = a2tg.extract_mesh(model, resolution=40, radius=1.5 * RADIUS, least_weight=0.6)
    assert around.missing < 0.2 and around.missing_near > 0.9


def test_a_grid_alone_has_the_whole_budget(model):
    num_bytes = a2tg.extract_mesh(model, resolution=40, fill_holes=False).num_bytes
    fits = a2tg.extract_mesh(model, resolution=40, fill_holes=False, max_bytes=num_bytes)
    assert fits.num_bytes == num_bytes
    with pytest.raises(ValueError, match="takes more than"):
        a2tg.extract_mesh(model, resolution=40, fill_holes=False, max_bytes=num_bytes - 1)


def test_default_voxels_are_no_smaller_than_pixels(model):
    camera = model.origin.cameras[0]
    distance = np.linalg.norm(np.asarray(camera.center))
    found = a2tg.extract_mesh(model).voxel
    assert found == pytest.approx(distance / float(camera.K[0, 0]), rel=0.05)


def test_a_given_centre_and_cameras_of_a_lens(model):
    """The radius is measured from the centre. Depths are rendered by pinholes, whatever the lens of the photographs."""
    cameras = [dataclasses.replace(own, rays=jnp.zeros((own.height, own.width, 2))) for own in model.origin.cameras]
    center = np.array([0.5, 0, 0])
    result = a2tg.extract_mesh(model, cameras, resolution=20, center=center, least_faces=1)
    apart = np.linalg.norm(centers_of(model.origin.viewmats) - center, axis=1)
    assert result.radius == pytest.approx(2 * np.median(apart))
    plain = a2tg.extract_mesh(model, resolution=20, center=center, least_faces=1)
    np.testing.assert_array_equal(result.mesh.vertices, plain.mesh.vertices)
    picture = np.zeros((cameras[0].height, cameras[0].width, 3))
    pytest.importorskip("xatlas")
    with pytest.raises(ValueError, match="pinhole cameras; got one with the rays of a lens"):
        a2tg.texture_mesh(result.mesh, [(cameras[0], picture, None)], size=64)


def test_an_empty_mesh_is_no_glb(tmp_path):
    empty = a2tg.Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    with pytest.raises(ValueError, match=r"has no faces.*: write a PLY or OBJ file"):
        a2tg.save_mesh(tmp_path / "a.glb", empty)
    assert a2tg.save_mesh(tmp_path / "a.ply", empty)


def test_one_camera_looks_at_what_it_sees(model):
    result = a2tg.extract_mesh(model, model.origin.cameras[:1], resolution=60)
    assert 0.3 < np.linalg.norm(result.center) < 0.6 and result.mesh.num_faces > 100


def test_cameras_that_turn_in_one_place_look_at_what_the_first_sees(model):
    """Their axes meet in that place up to rounding."""
    place = np.array([0.7, -1.0, 0.3])
    turned = [a2tg.look_at(place, [0, 0, height], width=SIDE, height=SIDE, fov=70) for height in (0.0, 0.2, -0.2)]
    turned += [a2tg.look_at(place, [across, 0, 0], width=SIDE, height=SIDE, fov=70) for across in (0.2, -0.2)]
    result = a2tg.extract_mesh(model, turned, resolution=60)
    assert 0.3 < np.linalg.norm(result.center) < 0.6 and result.mesh.num_faces > 100


def test_far_splats_do_not_matter_within_the_radius(model):
    means = model.gaussians.means.at[:50].multiply(1e6)
    far = dataclasses.replace(model, gaussians=dataclasses.replace(model.gaussians, means=means))
    assert np.abs(a2tg.extract_mesh(far, resolution=40).mesh.vertices).max() < 2.4


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_bytes": 200_000}, "takes more than 0.0002 GB: lower `resolution`"),
        ({"radius": 0.05, "center": np.array([3.0, 0, 0])}, "there is no surface within the radius"),
        ({"resolution": 0}, "resolution must be in"),
        ({"resolution": 10, "voxel": 0.1}, "`resolution` and `voxel` both"),
        ({"least_faces": 10**6}, "parts? had fewer than 1000000 faces: raise `resolution`, lower `voxel`"),
        ({"most_clusters": 0}, "most_clusters must be at least 1"),
        ({"max_bytes": 0}, "max_bytes must be positive"),
        ({"cameras": []}, "there are no cameras"),
        (None, "has no Gaussians"),
    ],
)
def test_mistakes_are_reported(model, options, message):
    with pytest.raises(ValueError, match=message):
        a2tg.extract_mesh(model[:0] if options is None else model, **{"resolution": 20, **(options or {})})


# The command


def test_the_command_writes_the_original_world(model, tmp_path, capsys):
    from a2tg_jax.cli import main as cli

    a2tg.save_model(tmp_path / "model.npz", model)
    arguments = ["mesh", str(tmp_path / "model.npz"), "--voxel", "0.4", "--out", str(tmp_path / "made.ply")]
    assert cli.main(arguments) == 0
    printed = capsys.readouterr().out
    assert "fused 14 views at voxels of 0.4, within 24 of the centre" in printed and "faces" in printed
    content = (tmp_path / "made.ply").read_bytes()
    start = content.index(b"end_header\n") + 11
    num = int(content.split(b"vertex ")[1].split()[0])
    kind = np.dtype([("position", "<f4", 3), ("color", "u1", 3)])
    positions = np.frombuffer(content, kind, num, start)["position"]
    assert np.median(np.linalg.norm(positions, axis=1)) == pytest.approx(RADIUS / 0.1, abs=0.4)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("mesh nowhere", "nowhere: no such file or folder"),
        ("mesh bare.npz", "bare has no cameras to fuse depths from"),
        ("mesh bare.npz --out mesh.stl", "--out must end in .glb, .ply or .obj"),
        ("mesh bare.npz --max-memory much", "--max-memory must be a number of MB"),
        ("mesh cameras.npz --resolution 0", "--resolution must be in"),
        ("mesh . --voxel -1", "--voxel must be positive and finite; got -1"),
        ("mesh . --radius nan", "--radius must be positive"),
        ("mesh . --clusters 0", "--clusters must be at least 1; got 0"),
        ("mesh . --max-memory 1000000GB", "--max-memory must be at most"),
        ("mesh cameras.npz --radius 0.1", "point that the cameras look at: give a larger --radius"),
        ("mesh cameras.npz --voxel 4", "a voxel is 0.17 of the radius, which is too large to show a surface"),
        ("mesh cameras.npz --out taken.ply", "taken.ply exists; add --overwrite"),
        ("mesh taken.npz", "taken-mesh.glb exists; add --overwrite"),
        ("mesh taken.ply --out taken.ply --overwrite", "taken.ply is the model itself; choose another --out"),
        ("mesh cameras.npz --resolution 2000 --max-memory 1MB", "lower --resolution"),
    ],
)
def test_mistakes_of_the_command(model, tmp_path, monkeypatch, capsys, arguments, message):
    from a2tg_jax.cli import main as cli

    monkeypatch.chdir(tmp_path)
    a2tg.save_model("cameras.npz", model)
    a2tg.save_model("bare.npz", a2tg.Model(model.gaussians))
    a2tg.save_model("taken.npz", model)
    for name in ("taken.ply", "taken-mesh.glb", "taken.png"):
        (tmp_path / name).touch()
    assert cli.main(arguments.split()) == 2
    error = capsys.readouterr().err
    assert message in error.splitlines()[-1]


def test_a_lack_of_memory_is_one_line(model, tmp_path, monkeypatch, capsys):
    def without_memory(*arguments, **options):
        raise MemoryError

    monkeypatch.setattr(meshing, "extract_mesh", without_memory)
    message = "not enough memory: lower --resolution, --radius, --max-memory or --texture-size"
    test_mistakes_of_the_command(model, tmp_path, monkeypatch, capsys, "mesh cameras.npz", message)


def test_a_simplified_mesh_is_not_empty(sphere, monkeypatch):
    empty = (np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    library = types.SimpleNamespace(simplify=lambda *arguments, **options: empty)
    monkeypatch.setitem(sys.modules, "fast_simplification", library)
    with pytest.raises(ValueError, match=r"no faces are left of [0-9,]*: choose more faces than 4"):
        a2tg.simplify_mesh(sphere, 4)


def test_simplifying_keeps_map_coordinates(sphere, monkeypatch):
    """The library takes float32, which has steps of half a metre there."""
    given = []

    def simplify(vertices, faces, target_reduction):
        given.append(vertices)
        return np.asarray(vertices, np.float64), np.asarray(faces)

    monkeypatch.setitem(sys.modules, "fast_simplification", types.SimpleNamespace(simplify=simplify))
    offset = np.array([431_235.0, 5_411_222.0, 312.0])
    far = a2tg.Mesh(np.asarray(sphere.vertices, np.float64) + offset, sphere.faces)
    simple = a2tg.simplify_mesh(far, 100)
    assert given[0].dtype == np.float32
    np.testing.assert_allclose(simple.corners, far.corners, rtol=0, atol=1e-6)
    # Near the origin, the library gets the numbers as they are.
    a2tg.simplify_mesh(sphere, 100)
    np.testing.assert_array_equal(given[1], sphere.vertices)


# Textures


def painted(camera):
    """The sphere as a camera sees it, coloured by position."""
    return camera, np.asarray(sphere_depths(camera).color, np.float32), None


@pytest.fixture(scope="module")
def textured(sphere):
    pytest.importorskip("xatlas", reason="textures need xatlas: pip install 'a2tg-jax[mesh]'")
    grey = a2tg.Mesh(sphere.vertices, sphere.faces, np.full((sphere.num_vertices, 3), 9, np.uint8))
    simple = a2tg.simplify_mesh(grey, 800)
    assert 700 < simple.num_faces <= 800
    views = [painted(camera_at(1.2 * each / np.linalg.norm(each))) for each in AROUND]
    return a2tg.texture_mesh(simple, views, size=128)


def test_texels_have_the_colors_that_the_views_see(textured):
    middle = textured.corners.mean(axis=1)
    places = textured.uv[textured.faces].mean(axis=1)
    rows = ((1 - places[:, 1]) * 128).astype(int)
    columns = (places[:, 0] * 128).astype(int)
    error = np.abs(textured.texture[rows, columns] / 255 - np.clip(0.5 + middle, 0, 1))
    assert np.median(error) < 0.02 and np.quantile(error, 0.95) < 0.1


def test_a_texture_is_filled_beyond_its_charts_and_keeps_colors_of_unseen_texels(textured):
    assert textured.texture.shape == (128, 128, 3) and textured.texture.any(axis=-1).all()
    assert textured.uv.min() >= 0 and textured.uv.max() <= 1
    unseen = a2tg.texture_mesh(a2tg.Mesh(textured.vertices, textured.faces, textured.colors), [], size=64)
    assert (unseen.texture == 9).all()


def test_pictures_of_a_texture_are_floats_of_their_cameras(sphere):
    """Bytes would be white, and a smaller picture would be at another place."""
    pytest.importorskip("xatlas", reason="textures need xatlas: pip install 'a2tg-jax[mesh]'")
    simple = a2tg.simplify_mesh(sphere, 100)
    camera, picture, _ = painted(camera_at(np.array([0.0, -1.2, 0.0])))
    counts = np.ones((camera.height, camera.width), bool)
    for given, mask, message in (
        (np.uint8(255 * picture), None, "picture must be floats; got uint8"),
        (picture[::2], None, r"picture must be \["),
        (picture, np.repeat(counts, 2, 0), r"mask must be \["),
        (picture, np.uint8(255 * counts), "mask must be bools; got uint8"),
    ):
        with pytest.raises(ValueError, match=message):
            a2tg.texture_mesh(simple, [(camera, given, mask)], size=64)


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_textures_are_read_back_by_another_library(textured, tmp_path, suffix):
    trimesh = pytest.importorskip("trimesh", reason="trimesh reads the files back: pip install trimesh")
    files = a2tg.save_mesh(tmp_path / f"mesh{suffix}", textured)
    read = trimesh.load(files[0], force="mesh", process=False)
    assert read.visual.kind == "texture"
    material = read.visual.material
    picture = material.baseColorTexture if suffix == ".glb" else material.image
    np.testing.assert_allclose(read.visual.uv, textured.uv, atol=1e-5)
    assert np.abs(np.asarray(picture.convert("RGB"), float) - textured.texture).mean() < (
        2 if suffix == ".glb" else 0.01
    )
    assert [path.suffix for path in files] == ([".glb"] if suffix == ".glb" else [".obj", ".mtl", ".png"])


def test_photographs_count_in_a_texture_where_they_are_opaque():
    """A cut-out photograph has the model's background around the subject, which is no part of the surface."""
    scene = a2tg.synthetic_scene(num_views=3, width=24, height=16, num_points=20, test_every=0)
    left = np.arange(24) < np.full((16, 1), 12)
    top = np.arange(16)[:, None] < np.full(24, 8)
    alpha = np.where(left, 255, 254).astype(np.uint8)
    cut_out = [np.dstack([view.image, alpha]) for view in scene.train]
    views = [
        dataclasses.replace(scene.train[0], picture=cut_out[0]),
        dataclasses.replace(scene.train[1], picture=cut_out[1], mask=top),
        dataclasses.replace(scene.train[2], mask=top),
    ]
    model = a2tg.Model(a2tg.init_from_points(scene.points, scene.colors), origin=scene.origin)
    source = Source(model, "cut out", load_scene=lambda: dataclasses.replace(scene, train=tuple(views)))
    masks = [mask for _, _, mask in meshing._photographs(source, scene.origin)]
    for mask, wanted in zip(masks, (left, left & top, top), strict=True):
        np.testing.assert_array_equal(mask, wanted)


def test_missing_libraries_are_reported(sphere, model, monkeypatch):
    monkeypatch.setitem(sys.modules, "xatlas", None)
    monkeypatch.setitem(sys.modules, "fast_simplification", None)
    with pytest.raises(ValueError, match=r"xatlas, which is not installed: pip install 'a2tg-jax\[mesh\]'"):
        a2tg.texture_mesh(sphere, [], size=64)
    with pytest.raises(ValueError, match=r"fast-simplification, which is not installed"):
        a2tg.simplify_mesh(sphere, 10)
    monkeypatch.setitem(sys.modules, "skimage.measure", None)
    monkeypatch.setattr(extract, "fuse", lambda *_: pytest.fail("found before the views are fused"))
    with pytest.raises(ValueError, match=r"scikit-image, which is not installed: pip install 'a2tg-jax\[train\]'"):
        a2tg.extract_mesh(model)


# Evaluation


def test_exact_points_lie_where_the_pictures_say():
    scene = a2tg.synthetic_scene(num_views=3, width=24, height=16, num_points=30, test_every=0)
    points = exact_points(scene)
    assert len(points) == 3 * 24 * 16
    known = scene.transform.inverse().apply(scene.points)
    assert a2tg.surface_distance(known, points, threshold=0.4).precision == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--texture renders --out mesh.ply", "a PLY file holds no texture"),
        ("--texture renders --texture-size 5", "--texture-size must be in"),
        ("--texture photographs", "the photographs of cameras are missing"),
        ("--texture renders --texture-size 8193", "--texture-size must be in 16..8192 texels"),
        ("--texture renders --out taken.obj", "taken.png exists; add --overwrite"),
        ("--faces 3", "--faces must be at least 4"),
    ],
)
def test_mistakes_of_textures(model, tmp_path, monkeypatch, capsys, arguments, message):
    pytest.importorskip("xatlas", reason="textures need xatlas: pip install 'a2tg-jax[mesh]'")
    test_mistakes_of_the_command(model, tmp_path, monkeypatch, capsys, f"mesh cameras.npz {arguments}", message)


def test_the_command_keeps_as_many_parts_as_the_library():
    assert inspect.signature(a2tg.extract_mesh).parameters["most_clusters"].default == MeshOptions.clusters
