"""Quality of meshes: Chamfer distance and F-score of the built-in scene, whose surfaces are exact, and of DTU's scans.

    python experiments/surface_quality.py synthetic --work runs/surfaces
    python experiments/surface_quality.py dtu scan24.ply --scan 24 --data DTU --world scan24.txt

`synthetic` trains plain 2D Gaussians with and without the losses of surfaces, and prints a table. `dtu` is near the
evaluation of DTU: the mesh is sampled every 0.2 mm, only points within the observed volume and above the table count,
and distances beyond 20 mm are left out. Unlike there, no object masks cull the mesh, and cubes thin the points, so that
figures are not to be put beside published ones. DATA has Points/stl and ObsMask of DTU. The mesh is in millimetres of
DTU's world, or --world names a text file of a 4 × 4 matrix that leads there.
"""

import argparse
import dataclasses
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from lab.tables import markdown
from scipy.io import loadmat

import a2tg_jax as a2tg
from a2tg_jax.data.ply import read_ply_points
from a2tg_jax.data.synthetic import exact_points

SPACING, THRESHOLD = 0.01, 0.02
"""Distance of points on the built-in scene, and largest distance that its F-score counts, in its metres."""
DTU_SPACING, DTU_MOST, DTU_THRESHOLD = 0.2, 20.0, 1.0
"""Millimetres."""
WEIGHTS: Mapping[str, dict[str, float]] = {
    "no losses": {},
    "normals 0.05": {"normal_weight": 0.05},
    "normals 0.2": {"normal_weight": 0.2},
    "normals 0.05, distortion 0.1": {"normal_weight": 0.05, "distortion_weight": 0.1},
    "normals 0.05, distortion 1": {"normal_weight": 0.05, "distortion_weight": 1.0},
    "normals 0.2, distortion 0.1": {"normal_weight": 0.2, "distortion_weight": 0.1},
    "normals 0.2, distortion 0.3": {"normal_weight": 0.2, "distortion_weight": 0.3},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    synthetic = commands.add_parser("synthetic", help="train the built-in scene and compare its meshes")
    synthetic.add_argument("--work", type=Path, default=Path("runs/surfaces"), help="folder of the models")
    synthetic.add_argument("--iterations", type=int, default=2000, help="of the first stage; the second has half")
    synthetic.add_argument("--resolution", type=int, default=384)
    dtu = commands.add_parser("dtu", help="compare a mesh with a scan of DTU")
    dtu.add_argument("mesh", type=Path)
    dtu.add_argument("--scan", type=int, required=True)
    dtu.add_argument("--data", type=Path, required=True, help="folder with Points/stl and ObsMask")
    dtu.add_argument("--world", type=Path, help="text file of a 4 × 4 matrix")
    args = parser.parse_args()
    try:
        print(synthetic_table(args) if args.command == "synthetic" else dtu_text(args))
    except (OSError, ValueError) as error:
        sys.exit(f"error: {error}")


def synthetic_table(args: argparse.Namespace) -> str:
    """Train what is missing and return a table of the built-in scene."""
    scene = a2tg.synthetic_scene(width=208, height=156)
    points = thinned(exact_points(scene), SPACING)
    rows = []
    for name, weights in WEIGHTS.items():
        model = _trained(args, scene, name, weights)
        mesh = a2tg.extract_mesh(model, resolution=args.resolution).mesh
        found = compared(mesh.transform(scene.transform.inverse()), points, SPACING, THRESHOLD)
        psnr = a2tg.evaluate(scene.test, model).psnr
        rows.append([name, f"{psnr:.2f}", *_figures(found, 1000), f"{mesh.num_faces:,}"])
    return markdown(
        ["losses", "test PSNR", "accuracy, mm", "completeness, mm", "Chamfer, mm", "F-score", "faces"], rows
    )


def thinned(points: np.ndarray, spacing: float, seed: int = 0) -> np.ndarray:
    """Return points [P, 3] such that no two lie in one cube of side `spacing`."""
    order = np.random.default_rng(seed).permutation(len(points))
    cubes = np.floor(points[order] / spacing).astype(np.int64)
    _, first = np.unique(cubes, axis=0, return_index=True)
    kept: np.ndarray = points[order[np.sort(first)]]
    return kept


def _trained(args: argparse.Namespace, scene: a2tg.Scene, name: str, weights: Mapping[str, float]) -> a2tg.Model:
    path = args.work / f"{name.replace(' ', '-').replace(',', '')}-{args.iterations}.npz"
    if not path.is_file():
        options = {"stage1_iterations": args.iterations, "stage2_iterations": args.iterations // 2}
        a2tg.save_model(path, a2tg.fit(scene, a2tg.Gaussians2d.preset("quick", loss=dict(weights), **options)).model)
    return a2tg.load_model(path)


def compared(mesh: a2tg.Mesh, points: np.ndarray, spacing: float, threshold: float) -> a2tg.SurfaceDistance:
    """Return the distances of a mesh from points of the true surface, both thinned evenly."""
    sampled = thinned(a2tg.sample_surface(mesh, spacing / 2), spacing)
    return a2tg.surface_distance(sampled, points, threshold=threshold)


def dtu_text(args: argparse.Namespace) -> str:
    """Return the distances of a mesh from a scan of DTU."""
    points = args.data / "Points" / "stl" / f"stl{args.scan:03d}_total.ply"
    observed, table = (args.data / "ObsMask" / name for name in (f"ObsMask{args.scan}_10.mat", f"Plane{args.scan}.mat"))
    for path in (args.mesh, points, observed, table):
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file")
    mesh = read_mesh(args.mesh)
    if args.world is not None:
        matrix = read_matrix(args.world)
        mesh = dataclasses.replace(mesh, vertices=mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3])
    sampled = thinned(a2tg.sample_surface(mesh, DTU_SPACING / 2), DTU_SPACING)
    scan = read_ply_points(points).points
    volume = loadmat(observed)
    plane = loadmat(table)["P"].reshape(-1)
    found = dtu_distance(
        sampled, scan, volume["ObsMask"].astype(bool), volume["BB"], float(volume["Res"].item()), plane
    )
    header = ["scan", "accuracy, mm", "completeness, mm", "Chamfer, mm", "F-score"]
    return markdown(header, [[str(args.scan), *_figures(found, 1)]])


def read_mesh(path: Path) -> a2tg.Mesh:
    """Return the mesh of a file, by trimesh."""
    try:
        import trimesh
    except ImportError:
        raise ValueError("meshes are read by trimesh: pip install 'a2tg-jax[experiments]'") from None
    read = trimesh.load(path, force="mesh", process=False)
    return a2tg.Mesh(np.asarray(read.vertices), np.asarray(read.faces, np.int32))


def read_matrix(path: Path) -> np.ndarray:
    """Return the 4 × 4 matrix of a text file."""
    try:
        matrix = np.loadtxt(path)
    except ValueError as error:
        raise ValueError(f"{path}: must hold the numbers of a 4 × 4 matrix ({error})") from None
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError(f"{path}: must hold a finite 4 × 4 matrix; got the shape {matrix.shape}")
    return matrix


def dtu_distance(
    sampled: np.ndarray, scan: np.ndarray, mask: np.ndarray, bounds: np.ndarray, step: float, plane: np.ndarray
) -> a2tg.SurfaceDistance:
    """Compare points within the observed volume and above the table, as DTU's evaluation does.

    Args:
      sampled: [P, 3] points of the mesh in millimetres.
      scan: [R, 3] points of the scanner.
      mask: [X, Y, Z] observed volume.
      bounds: [2, 3] its corners.
      step: side of its voxels in millimetres.
      plane: [4] plane of the table; points of the scan below it do not count.
    """
    cells = np.rint((sampled - bounds[0]) / step).astype(int)
    is_inside = ((cells >= 0) & (cells < mask.shape)).all(axis=1)
    is_observed = np.zeros(len(sampled), bool)
    is_observed[is_inside] = mask[tuple(cells[is_inside].T)]
    above = scan @ plane[:3] + plane[3] > 0
    # Distances from the mesh count against the whole scan; completeness counts the points above the table.
    forth = a2tg.surface_distance(sampled[is_observed], scan, threshold=DTU_THRESHOLD, most=DTU_MOST)
    back = a2tg.surface_distance(sampled, scan[above], threshold=DTU_THRESHOLD, most=DTU_MOST)
    return forth._replace(completeness=back.completeness, recall=back.recall)


def _figures(found: a2tg.SurfaceDistance, scale: float) -> list[str]:
    lengths = (found.accuracy, found.completeness, found.chamfer)
    return [*(f"{scale * length:.2f}" for length in lengths), f"{found.f_score:.3f}"]


if __name__ == "__main__":
    main()
