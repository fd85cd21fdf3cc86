"""The notebooks run from top to bottom, at a small size, and are committed with the outputs of a whole run."""

import json
import sys
import types
from pathlib import Path

import matplotlib.pyplot
import pytest

import a2tg_jax as a2tg

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
SMALL = {
    "training_by_hand": {
        "width": 40, "height": 30, "num_views": 4, "num_gaussians": 60, "num_iterations": 24, "upscale_after": (12,),
        "pose_iterations": 10,
    },
    "a_system_of_your_own": {
        "width": 40, "height": 30, "num_views": 4, "num_points": 120, "iterations": 24, "cap": 60,
    },
    "fitting_one_image": {"width": 32, "height": 24, "num_gaussians": 40, "num_iterations": 20},
    "refining_poses": {"width": 40, "height": 30, "num_views": 5, "iterations": 20, "pose_iterations": 3,
        "all_degrees": (6,)},
    "gradients_and_differences": {"width": 12, "height": 9, "num_gaussians": 5},
    "a_sweep_and_its_table": {
        "width": 24, "height": 18, "num_views": 12, "iterations": 8, "budgets": (20,), "methods": ("MCMC, degree 0",),
    },
}  # fmt: skip
"""Values for the cell that is tagged "parameters"."""
MOST_BYTES = 300_000


def code_cells(name: str) -> list[dict]:
    notebook = json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def run(name: str, monkeypatch) -> dict:
    """What the names of a notebook stand for after its last cell, its parameters being those of `SMALL`."""
    module = types.ModuleType(name)
    monkeypatch.setitem(sys.modules, name, module)
    for number, cell in enumerate(code_cells(name)):
        exec(compile("".join(cell["source"]), f"{name}, code cell {number}", "exec"), module.__dict__)
        if "parameters" in cell["metadata"].get("tags", []):
            assert module.__dict__.keys() >= SMALL[name].keys()
            module.__dict__.update(SMALL[name])
    return module.__dict__


@pytest.fixture(autouse=True)
def _draws_nothing(monkeypatch, tmp_path):
    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    yield
    matplotlib.pyplot.close("all")


@pytest.mark.long
def test_training_by_hand_learns_and_grows_textures(monkeypatch):
    names = run("training_by_hand", monkeypatch)
    assert names["losses_after"][-4:].mean() < 0.9 * names["losses_after"][:4].mean()
    assert names["before"].textures.bucket_sizes == ((1, 1),)
    assert names["after"].textures.sizes.max() == 2
    disturbed = a2tg.photometric_loss(names["after"].render(names["disturbed"]).color, names["photograph"])
    assert names["value"] < 0.95 * disturbed, "the camera descends"


@pytest.mark.long
def test_a_system_of_your_own_trains_beside_others_and_is_loaded_again(monkeypatch):
    names = run("a_system_of_your_own", monkeypatch)
    models = names["models"]
    assert abs(models["edges"].appearance.edges[:, 3:]).max() > 1e-3
    assert max(model.num_bytes for model in models.values()) <= names["budget"]
    assert names["model"].num == models["edges"].num and len(names["frames"]) == 4


@pytest.mark.long
def test_one_image_is_fitted(monkeypatch):
    names = run("fitting_one_image", monkeypatch)
    losses = {name: losses for name, (_, losses) in names["fits"].items()}
    assert all(each[-1] < 0.8 * each[0] for each in losses.values())
    assert losses["4×4 texels"][-1] < losses["plain"][-1]
    assert names["starts"]["plain, equal bytes"].num_bytes == pytest.approx(names["textured"].num_bytes, rel=0.05)


@pytest.mark.long
def test_poses_descend(monkeypatch):
    """So short a training and descent find no pose; they take cameras nearer in the picture."""
    names = run("refining_poses", monkeypatch)
    starts, ends, _ = names["results"][6, "coarse to fine"]
    before, after = (
        [float(abs(names["model"].render(camera).color - photo).mean()) for camera, photo in pairs]
        for pairs in (zip(starts, names["photographs"], strict=True), zip(ends, names["photographs"], strict=True))
    )
    assert sum(after) < sum(before)


def test_gradients_agree_with_differences(monkeypatch):
    names = run("gradients_and_differences", monkeypatch)
    assert len(names["found"]) == 9
    assert max(map(names["error"], names["found"].values())) < 1e-6
    assert min(names["curves"]["float64"]) < 1e-3 * min(names["curves"]["float32"])


@pytest.mark.long
def test_a_sweep_goes_on_with_the_runs_that_are_left(monkeypatch):
    names = run("a_sweep_and_its_table", monkeypatch)
    results = json.loads((names["folder"] / "results.json").read_text(encoding="utf-8"))
    assert results == names["results"] and len(results) == 2
    assert all(19_900 < result["bytes"] <= 20_000 for result in results.values())
    sources = ("".join(cell["source"]) for cell in code_cells("a_sweep_and_its_table"))
    (sweep,) = (source for source in sources if "results.json" in source)
    lost = results.popitem()[0]
    (names["folder"] / "results.json").write_text(json.dumps(results), encoding="utf-8")
    exec(sweep, names | {"run": lambda scene, system, session, file: file.stem})
    assert json.loads((names["folder"] / "results.json").read_text(encoding="utf-8")) == results | {lost: lost}


@pytest.mark.parametrize("name", SMALL)
def test_outputs_are_committed_and_small(name):
    assert {path.stem for path in FOLDER.glob("*.ipynb")} == SMALL.keys()
    assert (FOLDER / f"{name}.ipynb").stat().st_size < MOST_BYTES
    cells = code_cells(name)
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1)), "run it from the top"
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert not any(output["output_type"] == "error" for output in outputs)
    assert any("image/png" in output.get("data", {}) for output in outputs)
