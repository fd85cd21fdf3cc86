"""Memory of many large photographs: write a scene to a temporary folder, train on it and measure.

    python -m benchmarks.large_scene --out benchmarks/results/large_scene.json

By default 200 photographs of 6000×4000 pixels in 8 GB, at full size and at a quarter of it; a few iterations and one
view of evaluation. Every case runs in a process of its own, which ends itself if it takes more.
"""

import argparse
import json
import os
import pathlib
import subprocess
import sys
import tempfile
import threading
import time

import numpy as np
from PIL import Image

import a2tg_jax
from a2tg_jax.data.photo_store import SHARE_OF_MEMORY
from benchmarks.timing import memory_peak

NUM_PICTURES = 8
"""Number of different photographs; the others are links to them, decoded like any."""
ITERATIONS = 6


def write_scene(folder: pathlib.Path, num: int, width: int, height: int) -> None:
    """Write a transforms.json, points, and JPEG files: the built-in scene, enlarged and with noise."""
    made = a2tg_jax.synthetic_scene(num_views=NUM_PICTURES, width=600, height=round(600 * height / width))
    views = sorted((*made.train, *made.test), key=lambda view: view.name)
    images = folder / "images"
    rng = np.random.default_rng(0)
    images.mkdir(parents=True)
    frames = []
    for index in range(num):
        view = views[index % NUM_PICTURES]
        path = images / f"{index:04d}.jpg"
        if index < NUM_PICTURES:
            picture = np.asarray(Image.fromarray(view.image).resize((width, height)))
            noise = rng.integers(0, 6, picture.shape, np.uint8)
            Image.fromarray(np.minimum(picture, 249) + noise).save(path, quality=90)
        else:
            os.link(images / f"{index % NUM_PICTURES:04d}.jpg", path)
        pose = np.linalg.inv(np.asarray(view.camera.viewmat, np.float64)) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"images/{path.name}", "transform_matrix": pose.tolist()})
    focal = float(views[0].camera.K[0, 0]) * width / 600
    told = {"fl_x": focal, "fl_y": focal, "w": width, "h": height, "ply_file_path": "points.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(told))
    _write_points(folder / "points.ply", made.points, np.rint(255 * made.colors).astype(int))


def _write_points(path: pathlib.Path, points: np.ndarray, colors: np.ndarray) -> None:
    properties = [f"property float {name}" for name in "xyz"]
    properties += [f"property uchar {name}" for name in ("red", "green", "blue")]
    lines = ["ply", "format ascii 1.0", f"element vertex {len(points)}", *properties, "end_header"]
    lines += [" ".join(map(str, [*point, *color])) for point, color in zip(points, colors, strict=True)]
    path.write_text("\n".join(lines) + "\n")


def measure(case: dict) -> dict:
    """Load, train a little and evaluate a view; end this process if it takes more memory than the limit."""
    threading.Thread(target=_end_beyond, args=(case["limit"],), daemon=True).start()
    a2tg_jax.configure_cpu()
    start = time.perf_counter()
    scene = a2tg_jax.load_scene(case["scene"], downscale=case["downscale"], room=int(SHARE_OF_MEMORY * case["limit"]))
    loaded = time.perf_counter()
    system = a2tg_jax.A2tg.preset("smoke")
    found = {"photographs": len(scene.train) + len(scene.test), "size": scene.train[0].picture.size[::-1]}
    pictures = [view.picture for view in (*scene.train, *scene.test)]
    found["held"], found["photographs_bytes"] = sum(p.is_held for p in pictures), sum(p.nbytes for p in pictures)
    found["load_seconds"], found["load_peak"] = loaded - start, memory_peak()
    short = a2tg_jax.Gaussians2dMcmc(stage1_iterations=ITERATIONS, densify=system.densify)
    result = a2tg_jax.fit(scene, short)
    found["train_seconds"], found["train_peak"] = result.seconds, memory_peak()
    found["psnr"] = a2tg_jax.evaluate(scene.test[:1], result.model).psnr
    return {**case, **found, "peak": memory_peak()}


def _end_beyond(limit: float) -> None:
    while memory_peak() <= limit:
        time.sleep(0.05)
    print(f"more than {limit:,} bytes of memory", file=sys.stderr)
    os._exit(1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("large_scene.json"))
    parser.add_argument("--photographs", type=int, default=200)
    parser.add_argument("--size", type=int, nargs=2, default=(6000, 4000), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--limit", type=float, default=8e9, help="bytes of memory")
    parser.add_argument("--downscale", type=int, nargs="+", default=(1, 4))
    parser.add_argument("--case", type=json.loads, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.case is not None:
        print(json.dumps(measure(args.case)))
        return
    with tempfile.TemporaryDirectory() as folder:
        write_scene(pathlib.Path(folder, "scene"), args.photographs, *args.size)
        found = []
        for downscale in args.downscale:
            case = {"scene": f"{folder}/scene", "downscale": downscale, "limit": args.limit}
            command = [sys.executable, "-m", "benchmarks.large_scene", "--case", json.dumps(case)]
            done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
            found.append(json.loads(done.stdout.splitlines()[-1]) | {"scene": "written"})
            print(found[-1], flush=True)
    args.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
