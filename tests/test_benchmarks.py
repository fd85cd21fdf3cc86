"""The benchmarks run, and their tables say what they measured."""

import json
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[1]))  # Last, so that the installed package comes first.

from a2tg_jax.data.synthetic import still_life
from benchmarks import meshes, scaling, stages
from benchmarks.tables import gpu as gpu_table


def test_stages_of_a_step_can_be_measured(monkeypatch):
    monkeypatch.setattr(stages, "timed", jax.eval_shape)
    case = {"num": 50, "width": 32, "height": 16}
    assert stages.measure_stages(case)["evaluated_pairs"] > 0
    monkeypatch.setattr(stages, "timed", lambda function, *_: function())
    assert stages.measure_step({**case, "textures": "mixed"})["step"].loss > 0


def test_the_table_of_gpus_joins_passes_and_steps():
    case = {"num": 3000, "textures": "mixed"}
    passes = {"case": "render", **case, "forward": {"ms": 1.21}, "both": {"ms": 3.4}}
    step = {"case": "step", **case, "step": {"ms": 4.4}, "device_peak_mb": 446.2}
    other = {"case": "gsplat", "num": 3000, "forward": {"ms": 2.0}, "both": {"ms": 7.0}}
    *_, ours, theirs = gpu_table({"gpu": [passes, step, other, {"case": "gsplat", "failed": "took long"}]}).splitlines()
    assert ours == "| 3,000 | this library | mixed | 1.2 | 3.4 | 4.4 | 446 |"
    assert theirs == "| 3,000 | gsplat, 2D Gaussians | none | 2.0 | 7.0 | – | – |"


def test_the_table_of_gpus_is_current():
    root = Path(__file__).parents[1]
    report = json.loads((root / "benchmarks" / "results" / "gpu.json").read_text())
    assert gpu_table(report) in (root / "docs" / "performance.md").read_text()


def test_bytes_sent_are_those_of_collectives_of_each_step():
    program = """HloModule jit_step

%event (x: f32[8,3]) -> f32[8,3] {
  ROOT %gathered = f32[8,3]{1,0} all-gather(%x), dimensions={0}
}

%part (x: f32[2,3]) -> f32[8,3] {
  ROOT %gathered = f32[8,3]{1,0} all-gather(%x), dimensions={0}
}

ENTRY %main (x: f32[2,3]) -> f32[8,3] {
  %all = f32[8,3]{1,0} call(%x), to_apply=%part
  %moved = (f32[1,2]{1,0}, pred[4]{0}) all-to-all(%a, %b), dimensions={0}
  ROOT %changed = f32[8,3]{1,0} conditional(%is_due, %all, %all), branch_computations={%event, %event}
}
"""
    assert scaling.bytes_sent(program, 4) == {"all-to-all": 12 * 3 // 4, "all-gather": 96 * 3 // 4}


@pytest.mark.long
def test_normals_of_splats_on_the_built_in_scene_are_those_of_its_shapes():
    for shape, _ in still_life(np.random.default_rng(0)):
        points, normals = shape.place(*np.random.default_rng(1).uniform(0.2, 0.8, (2, 50)).astype(np.float32))
        np.testing.assert_allclose(meshes.normals_at(points.T), normals.T, atol=1e-3)
