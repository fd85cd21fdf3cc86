"""The notebooks run from top to bottom, at a small size, and are committed with the outputs of a whole run."""

import ast
import json
import sys
import types
from pathlib import Path

import matplotlib.pyplot
import pytest

import a2tg_jax as a2tg

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
SMALL = {
    "a_scene_in_five_minutes": {
        "width": 40, "height": 30, "num_views": 9, "iterations": 90, "budget": "40kB",
        "findings": FOLDER.parent / "experiments" / "results" / "claims" / "exploration.md",
    },
    "inverse_problems": {
        "width": 40, "height": 30, "num_views": 11, "iterations": 20, "num_gaussians": 150, "pose_iterations": 3,
        "light_iterations": 10, "texture_iterations": 10, "all_degrees": (6,),
    },
    "training_by_hand": {
        "width": 40, "height": 30, "num_views": 4, "num_gaussians": 60, "num_iterations": 24, "upscale_after": (12,),
    },
    "a_custom_system": {"width": 40, "height": 30, "num_views": 4, "num_points": 120, "iterations": 24, "cap": 60},
    "gradients_and_differences": {"width": 12, "height": 9, "num_gaussians": 5},
    "a_sweep_and_its_table": {
        "width": 24, "height": 18, "num_views": 12, "iterations": 8, "budgets": (20,), "methods": ("MCMC, degree 0",),
    },
}  # fmt: skip
"""Values for the cell that is tagged "parameters"."""
MOST_BYTES = 400_000
MOST_LINES, MOST_COLUMNS = 25, 100
"""Size of a cell; wider lines are cut off where notebooks are read."""
PUBLIC = {"a2tg_jax", "a2tg_jax as a2tg", *(f"a2tg_jax.{name}" for name in dir(a2tg))}


def internal_names(source: str) -> set[str]:
    """The names of the package in Python code that are not public, and private attributes of any value."""
    used = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            used |= {ast.unparse(alias) for alias in node.names if alias.name.split(".")[0] == "a2tg_jax"}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "a2tg_jax":
            used |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Attribute):
            if isinstance(node.value, ast.Name) and node.value.id in ("a2tg", "a2tg_jax"):
                used.add(f"a2tg_jax.{node.attr}")
            elif node.attr.startswith("_") and not node.attr.endswith("__"):
                used.add(ast.unparse(node))
    return used - PUBLIC


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


@pytest.mark.long
def test_a_custom_system_trains_beside_others_and_is_loaded_again(monkeypatch):
    names = run("a_custom_system", monkeypatch)
    models = names["models"]
    assert abs(models["edges"].appearance.edges[:, 3:]).max() > 1e-3
    assert max(model.num_bytes for model in models.values()) <= names["budget"]
    assert names["model"].num == models["edges"].num and len(names["frames"]) == 4


@pytest.mark.long
def test_a_scene_is_trained_drawn_differentiated_and_shown(monkeypatch):
    drawn = []
    live = types.SimpleNamespace(update=drawn.append)
    monkeypatch.setitem(
        sys.modules, "IPython.display", types.SimpleNamespace(HTML=str, display=lambda display_id: live)
    )
    names = run("a_scene_in_five_minutes", monkeypatch)
    assert len(drawn) >= 2 and {picture.color.shape for picture in drawn} == {(30, 40, 3)}
    assert abs(names["by_camera"].viewmat).max() > 0 and abs(names["change"]).max() > 0
    assert names["by_background"][0] == pytest.approx(float(names["difference"]), rel=0.05)
    assert names["frames"].shape == (6, 30, 40, 3)
    assert "scene-data" in names["page"] and len(names["gains"]) == 9


@pytest.mark.long
def test_pose_light_and_texture_descend(monkeypatch):
    """So short a training and descent find nothing; they come nearer to the photograph."""
    names = run("inverse_problems", monkeypatch)

    def error(camera, photograph):
        return float(abs(names["model"].render(camera).color - photograph).mean())

    starts, ends, _ = names["results"][6, "coarse to fine"]
    before, after = (sum(map(error, cameras, names["photographs"])) for cameras in (starts, ends))
    assert after < before
    guess, found = (
        abs(names["lit"](camera, lamp) - names["lamplit"]).mean()
        for camera, lamp in ((names["start"], names["guess"]), (names["end"], names["lamp"]))
    )
    assert found < guess
    unpainted, painted = (
        a2tg.psnr(names[model].render(names["camera"]).color, names["writing"]) for model in ("textured", "by_texels")
    )
    assert painted > unpainted


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


def test_names_that_are_not_public_are_found():
    internal = {
        "from a2tg_jax.appearance import Appearance": "a2tg_jax.appearance.Appearance",
        "from a2tg_jax import render": "a2tg_jax.render",
        "import a2tg_jax.core.sh": "a2tg_jax.core.sh",
        "import a2tg_jax as splats": "a2tg_jax as splats",
        "a2tg.core.sh.sh_sum(x)": "a2tg_jax.core",
        "a2tg.Model(gaussians)._rows": "a2tg.Model(gaussians)._rows",
    }
    assert {source: internal_names(source) for source in internal} == {
        source: {name} for source, name in internal.items()
    }
    assert not internal_names("import a2tg_jax as a2tg\nfrom a2tg_jax import Model\na2tg.A2tg.preset, np.core.sh")


@pytest.mark.parametrize("name", SMALL)
def test_code_uses_public_names(name):
    assert not set().union(*(internal_names("".join(cell["source"])) for cell in code_cells(name)))


@pytest.mark.parametrize("name", SMALL)
def test_cells_are_short_and_pictures_described(name):
    for cell in code_cells(name):
        lines = "".join(cell["source"]).splitlines()
        assert len(lines) <= MOST_LINES and max(map(len, lines)) <= MOST_COLUMNS, lines[0]
        if any("image/png" in output.get("data", {}) for output in cell["outputs"]):
            assert len(cell["metadata"]["alt"]) > 20, lines[0]
