"""The notebooks run from top to bottom, at a small size, and are committed with the outputs of a whole run."""

import json
import sys
import types
from pathlib import Path

import matplotlib
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
}  # fmt: skip
"""Values for the cell that is tagged "parameters"."""
MOST_BYTES = 900_000


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


def test_training_by_hand_learns_and_grows_textures(monkeypatch):
    names = run("training_by_hand", monkeypatch)
    assert names["losses_after"][-4:].mean() < 0.9 * names["losses_after"][:4].mean()
    assert names["before"].layout.resolutions == ((1, 1),)
    assert names["after"].layout.sizes.max() == 2
    disturbed = a2tg.photometric_loss(names["after"].render(names["disturbed"]).color, names["photograph"])
    assert names["value"] < 0.95 * disturbed, "the camera descends"


def test_a_system_of_your_own_trains_beside_others_and_is_loaded_again(monkeypatch):
    names = run("a_system_of_your_own", monkeypatch)
    models = names["models"]
    assert abs(models["edges"].params[:, 3:]).max() > 1e-3
    assert max(model.num_bytes for model in models.values()) <= names["budget"]
    assert names["model"].num == models["edges"].num and len(names["frames"]) == 4


@pytest.mark.parametrize("name", SMALL)
def test_outputs_are_committed_and_small(name):
    assert {path.stem for path in FOLDER.glob("*.ipynb")} == SMALL.keys()
    assert (FOLDER / f"{name}.ipynb").stat().st_size < MOST_BYTES
    cells = code_cells(name)
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1)), "run it from the top"
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert not any(output["output_type"] == "error" for output in outputs)
    assert any("image/png" in output.get("data", {}) for output in outputs)
