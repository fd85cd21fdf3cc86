"""Quality of meshes: Chamfer distance and F-score of the built-in scene, whose surfaces are exact.

    python experiments/surface_quality.py --work runs/surfaces

trains plain 2D Gaussians with and without the losses of surfaces, and prints a table.
"""

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from lab.tables import markdown

import a2tg_jax as a2tg
from a2tg_jax.data.synthetic import exact_points

SPACING = 0.01
"""Distance of points on the built-in scene, in its metres."""
THRESHOLD = 0.02
"""Largest distance that the F-score counts, in metres."""
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
    parser.add_argument("--work", type=Path, default=Path("runs/surfaces"), help="folder of the models")
    parser.add_argument("--iterations", type=int, default=2000, help="of the first stage; the second has half")
    parser.add_argument("--resolution", type=int, default=384)
    args = parser.parse_args()
    try:
        print(synthetic_table(args))
    except (OSError, ValueError) as error:
        sys.exit(f"error: {error}")


def synthetic_table(args: argparse.Namespace) -> str:
    """Train what is missing and return a table of the built-in scene."""
    scene = a2tg.synthetic_scene(width=208, height=156)
    points = thinned(exact_points(scene), SPACING)
    rows = []
    for name, weights in WEIGHTS.items():
        model = _trained(args, scene, name, weights)
        mesh = a2tg.extract_mesh(model, resolution=args.resolution, fill_holes=False).mesh
        surface = a2tg.sample_surface(mesh.transform(scene.transform.inverse()), SPACING / 2)
        found = a2tg.surface_distance(thinned(surface, SPACING), points, threshold=THRESHOLD)
        lengths = (f"{1000 * length:.2f}" for length in (found.accuracy, found.completeness, found.chamfer))
        psnr = a2tg.evaluate(scene.test, model).psnr
        rows.append([name, f"{psnr:.2f}", *lengths, f"{found.f_score:.3f}", f"{mesh.num_faces:,}"])
    return markdown(
        ["losses", "test PSNR", "accuracy, mm", "completeness, mm", "Chamfer, mm", "F-score", "faces"], rows
    )


def thinned(points: np.ndarray, spacing: float) -> np.ndarray:
    """Return points [P, 3] such that no two lie in one cube of side `spacing`."""
    order = np.random.default_rng(0).permutation(len(points))
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


if __name__ == "__main__":
    main()
