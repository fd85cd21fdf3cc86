"""All scripts beside the package can be imported, and those that measure run at their smallest size."""

import importlib
import json
import os
import pathlib
import shutil
import sys

import numpy as np
import pytest
from PIL import Image
from small_models import origin_of

import a2tg_jax as a2tg
from a2tg_jax.results.model_source import Source

ROOT = pathlib.Path(__file__).parents[1]
sys.path.append(str(ROOT))  # Last, so that the installed package comes first.

OTHERS = {"gsplat", "torch"}
"""Programs that scripts compare with, and that no extra installs."""
SCRIPTS = [
    *("benchmarks." + ".".join(path.relative_to(ROOT / "benchmarks").with_suffix("").parts)
      for path in sorted((ROOT / "benchmarks").rglob("*.py")) if path.stem != "__init__"),
    *(path.stem for path in sorted((ROOT / "experiments").glob("*.py"))),
    *("lab." + path.stem for path in sorted((ROOT / "experiments" / "lab").glob("*.py")) if path.stem != "__init__"),
    *(path.stem for path in sorted((ROOT / "docs" / "scripts").glob("*.py"))),
]  # fmt: skip


@pytest.mark.parametrize("name", SCRIPTS)
def test_it_can_be_imported(name):
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name not in OTHERS:
            raise
        pytest.skip(f"{name} compares with {error.name}, which is not installed")


RANDOM = {"num": 40, "width": 24, "height": 16, "textures": "mixed"}


@pytest.mark.parametrize(
    "case",
    [
        {"case": "limit", "multiply_adds": 20, "pairs": 1e4},
        {"case": "render", **RANDOM},
        pytest.param({"case": "stages", **RANDOM}, marks=pytest.mark.long),
    ],
    ids=lambda case: case["case"],
)
def test_a_case_is_measured(monkeypatch, capsys, case):
    from benchmarks import limit, measure, rendering, stages

    monkeypatch.setattr("a2tg_jax.configure_cpu", lambda **_: None)
    for module in (limit, rendering, stages):  # once, not for a second
        if hasattr(module, "timed"):
            monkeypatch.setattr(module, "timed", lambda function, *given, **_: (function(*given), {"ms": 1.0})[1])
    monkeypatch.setattr(sys, "argv", ["measure", json.dumps(case)])
    measure.main()
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["peak_mb"] > 0


SMALLEST = {
    "__main__": "--only limit --out {out}",
    "large_scene": "--photographs 4 --size 60 40 --downscale 2 --out {out}",
    "meshes": "--num 300 --views 2 --size 32 24 --resolution 12",
    "plots": "benchmarks/results/cpu.json {folder}",
    "scaling": "--gaussians 500 --devices 1 --steps 2 --out {out}",
    "tables": "benchmarks/results/cpu.json {folder}/performance.md {folder}/NOTEBOOK.md",
}
"""Arguments of the scripts of `benchmarks`."""


@pytest.mark.long
@pytest.mark.parametrize("name", SMALLEST)
def test_it_runs(name, tmp_path, monkeypatch, capsys):
    arguments = SMALLEST[name].format(out=tmp_path / "found.json", folder=tmp_path).split()
    pages = [ROOT / "docs" / "performance.md", ROOT / "experiments" / "NOTEBOOK.md"] if name == "tables" else []
    for page in pages:
        shutil.copy(page, tmp_path)
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))  # For the processes that scripts start.
    monkeypatch.setattr("a2tg_jax.configure_cpu", lambda **_: None)
    monkeypatch.setattr("benchmarks.sections.THREADS", (1,))
    monkeypatch.setattr("benchmarks.sections.MULTIPLY_ADDS", {"forward": 20})
    monkeypatch.setattr("benchmarks.meshes.SMALL", (48, 32))
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    importlib.import_module(f"benchmarks.{name}").main()
    printed = capsys.readouterr().out
    assert "failed" not in printed
    assert all((tmp_path / page.name).read_bytes() == page.read_bytes() for page in pages), "the tables are current"
    assert printed or any(tmp_path.iterdir())


def test_drawings_of_the_documentation_are_drawn_and_small(tmp_path):
    import drawings

    drawings.main(tmp_path, dpi=10)
    kept = {path.name: path.stat().st_size for path in (ROOT / "docs" / "images").glob("how-*.png")}
    assert {path.name for path in tmp_path.iterdir()} == kept.keys()
    assert max(kept.values()) < 100_000


def test_the_loop_of_the_readme_is_drawn(tmp_path):
    import loop

    scene = a2tg.synthetic_scene(num_views=4, width=24, height=16, num_points=50)
    gaussians = a2tg.init_from_points(scene.points, scene.colors)
    a2tg.save_model(tmp_path / "model.npz", a2tg.Model(gaussians, origin=origin_of(scene)))
    loop.main(tmp_path / "model.npz", tmp_path / "loop.webp", num_frames=3)
    with Image.open(tmp_path / "loop.webp") as picture:
        assert picture.n_frames == 4 and picture.size == (24, 16)


@pytest.mark.long
def test_the_picture_of_cells_is_drawn_and_small(tmp_path, capsys):
    import cells

    cells.main(tmp_path, stage1_iterations=40, stage2_iterations=40)
    with Image.open(tmp_path / "cells.png") as drawn, Image.open(ROOT / "docs" / "images" / "cells.png") as kept:
        assert drawn.size == kept.size
    assert (ROOT / "docs" / "images" / "cells.png").stat().st_size < 150_000
    assert capsys.readouterr().out.count(" dB") == 2


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:.* there was no room")
def test_pictures_of_the_viewer_and_of_meshes_are_drawn(tmp_path, monkeypatch):
    import pictures

    monkeypatch.setattr(pictures, "MODELS", tmp_path)
    monkeypatch.setattr(pictures, "ITERATIONS", 100)
    scene = a2tg.synthetic_scene(num_views=8, width=64, height=48)
    model = pictures.trained(scene, pictures.surfaces(pictures.NORMALS), "mesh")
    drawn = [
        pictures.picture_of_mesh(scene, model, resolution=64, size=256),
        pictures.picture_of_losses([model, model], resolution=64),
    ]
    if chromium := pictures.find_chromium():
        drawn.append(pictures.picture_of_viewer(Source(model, "small"), chromium, (400, 300)))
        assert drawn[-1].size == (400, 300)
    for picture in drawn:
        assert np.asarray(picture)[50:250, 50:350].std() > 10
