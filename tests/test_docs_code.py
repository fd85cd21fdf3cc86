"""The Python on pages runs from top to bottom, at a small size."""

import inspect
import re
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import a2tg_jax as a2tg
from a2tg_jax.data.scene import origin_of_scene

DOCS = Path(__file__).parent.parent / "docs"
REAL_FIT = inspect.signature(a2tg.fit)


def run(page: str, names: dict, replaced: dict[str, str] | None = None) -> dict:
    """Values of the names after the last block of Python of a page."""
    text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
    for number, block in enumerate(re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)):
        for old, new in (replaced or {}).items():
            block = block.replace(old, new)
        exec(compile(block, f"{page}.md, block {number}", "exec"), names)
    return names


def untrained(*args, **kwargs):
    """Stand-in for `fit`: the untrained model with which the last stage of a system begins."""
    given = REAL_FIT.bind(*args, **kwargs).arguments
    scene, system = given["scene"], given["system"]
    system.check()
    given.get("on_log", dict)({"iteration": 1, "psnr": 9.0})
    gaussians = a2tg.init_from_points(scene.points, scene.colors, num=50, sh_degree=0)
    appearance = system.stages()[-1].appearance
    params, layout = appearance.allocate(jax.random.key(0), gaussians)
    model = a2tg.Model(gaussians, params, layout, appearance=appearance, origin=origin_of_scene(scene))
    return SimpleNamespace(model=model)


def test_examples_run_and_learn():
    names = run("examples", {"__name__": "examples"})
    views = [a2tg.photometric_loss(names[model].render(names["cameras"][0]).color, names["photo"])
             for model in ("model", "trained")]  # fmt: skip
    assert views[1] < 0.9 * views[0]
    assert 2 <= names["pruned"].model.num < 200 == names["result"].model.num
    assert names["gradient"].shape == (200, 5) and abs(names["gradient"]).max() > 0


def test_library_runs(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(a2tg, "fit", untrained)
    fewer = {"cameras, 200):": "cameras, 2):", "iterations=1000": "iterations=2"}
    names = run("library", {"__name__": "library"}, fewer)
    assert {path.name for path in tmp_path.iterdir()} == {"scene.npz", "scene.a2tgz"}
    assert names["found"].psnr > 3
    with pytest.raises(TypeError):
        a2tg.fit(names["scene"], names["system"], no_such_option=1)


def test_other_programs_gaussians_and_poses_are_taken(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    gaussians = a2tg.init_from_points([[0, 0, 2], [0.1, 0, 2]], [[1, 1, 1]] * 2)
    a2tg.save_ply("point_cloud.ply", gaussians)
    scales = jnp.column_stack([gaussians.log_scales, jnp.zeros(2)])
    splats = {"means": gaussians.means, "quats": gaussians.quats, "scales": scales}
    splats |= {"opacities": gaussians.logit_opacities, "sh0": gaussians.sh[:, :1], "shN": gaussians.sh[:, 1:]}
    seen = a2tg.look_at([0, -2, 1], [0, 0, 0], width=8, height=8)
    to_world = jnp.linalg.inv(seen.viewmat) @ jnp.diag(jnp.array([1.0, -1.0, -1.0, 1.0]))
    poses = {"camera_to_world": to_world, "world_view_transform": seen.viewmat.T}
    names = run("coming-from", {"a2tg": a2tg, "jnp": jnp, "splats": splats, **poses})
    np.testing.assert_allclose(names["viewmat"], seen.viewmat, atol=1e-6)
    np.testing.assert_array_equal(names["gaussians"].sh, gaussians.sh)
