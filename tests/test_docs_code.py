"""The Python on pages runs from top to bottom, at a small size."""

import dataclasses
import inspect
import re
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_models import origin_of
from test_notebooks import internal_names

import a2tg_jax as a2tg

DOCS = Path(__file__).parent.parent / "docs"
REAL_FIT = inspect.signature(a2tg.fit)


def blocks_of(page: Path) -> list[str]:
    """The blocks of Python of a page."""
    return re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def run(page: str, names: dict, replaced: dict[str, str] | None = None) -> dict:
    """Values of the names after the last block of Python of a page, of which the README is one."""
    file = (DOCS.parent if page == "README" else DOCS) / f"{page}.md"
    for number, block in enumerate(blocks_of(file)):
        for old, new in (replaced or {}).items():
            block = block.replace(old, new)
        exec(compile(block, f"{page}.md, block {number}", "exec"), names)
    return names


def untrained(*args, **kwargs):
    """Stand-in for `fit`: the untrained model with which the last stage of a system begins."""
    given = REAL_FIT.bind(*args, **kwargs).arguments
    scene = given["scene"]
    system = given["system"]
    system.check()
    given.get("on_log", dict)({"iteration": 1, "psnr": 9.0})
    gaussians = a2tg.init_from_points(scene.points, scene.colors, num=50, sh_degree=0)
    appearance = system.stages()[-1].appearance
    appearance = a2tg.allocate_appearance(appearance, jax.random.key(0), gaussians)
    model = a2tg.Model(gaussians, appearance, origin=origin_of(scene))

    def more(scene, iterations):
        return untrained(scene, dataclasses.replace(system, more=(*system.more, iterations)))

    return SimpleNamespace(model=model, stages=[SimpleNamespace(model=model)], more=more)


def test_code_uses_public_names():
    found = set()
    for page in (DOCS.parent / "README.md", *DOCS.rglob("*.md")):
        found |= set().union(*map(internal_names, blocks_of(page)))
    assert not found


def test_the_code_of_the_readme_runs():
    names = run("README", {})
    assert names["images"].shape == (len(names["scene"].test), 78, 104, 3)
    for leaf in (*jax.tree.leaves(names["gradient"]), names["pose_gradient"].viewmat):
        assert np.isfinite(leaf).all() and np.any(np.asarray(leaf))


def test_textures_are_read_edited_and_put_back():
    """One Gaussian that faces the camera, textured red at the left; mirrored as on the page, it is red at the right."""
    text = (DOCS / "library.md").read_text(encoding="utf-8").partition("## Textures\n")[2]
    block = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)[0]
    quats = jnp.array([[1.0, 0, 0, 0]])
    sh = jnp.full((1, 1, 3), -3.0)  # Black.
    gaussians = a2tg.Gaussians(jnp.zeros((1, 3)), quats, jnp.zeros((1, 2)), jnp.full(1, 2.0), sh)
    texels = np.zeros((2, 2, 4), np.float32)
    texels[..., 3], texels[:, 0, 0] = 1, 1
    textures = a2tg.textures_from_arrays([texels])
    model = a2tg.Model(gaussians, a2tg.Appearance(texture=a2tg.Texture(textures)))
    camera = a2tg.look_at([0, 0, -4], [0, 0, 0], up=[0, -1, 0], width=16, height=16)
    names = {"model": model, "camera": camera, "a2tg": a2tg}
    exec(block, names)
    before, after = (np.asarray(each.render(camera).color)[..., 0] for each in (model, names["edited"]))
    assert abs(before[:, :8].sum() - before[:, 8:].sum()) > 0.4 * before.sum()
    np.testing.assert_allclose(after, before[:, ::-1], atol=1e-4)


@pytest.mark.long
def test_examples_run_and_learn():
    names = run("examples", {"__name__": "examples"})
    views = [a2tg.photometric_loss(names[model].render(names["cameras"][0]).color, names["photo"])
             for model in ("model", "trained")]  # fmt: skip
    assert views[1] < 0.9 * views[0]
    assert 2 <= names["pruned"].model.num < 200 == names["result"].model.num
    painted = names["painted"].model
    assert painted.num < 200 and painted.bytes_of(0) == 4 * 8 * 7 and abs(painted.appearance.codes).max() > 0
    assert names["gradient"].shape == (200, 5) and abs(names["gradient"]).max() > 0


@pytest.mark.long
def test_library_runs(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(a2tg, "fit", untrained)
    fewer = {"cameras, 200):": "cameras, 2):", "iterations=1000": "iterations=2", "Pool(2)": "Pool(1)"}
    names = run("library", {"__name__": "library"}, fewer)
    assert {path.name for path in tmp_path.iterdir()} == {"scene.npz", "scene.a2tgz", "scene.ply"}
    np.testing.assert_allclose(names["aligned"].gaussians.means, names["model"].gaussians.means, atol=1e-4)
    assert names["found"].psnr > 3
    assert [output.color.shape for output in names["renders"]] == [(48, 64, 3)] * 2
    with pytest.raises(TypeError):
        a2tg.fit(names["scene"], names["system"], no_such_option=1)


def test_the_smallest_system_has_a_stage_with_arrays():
    names = run("systems", {"__name__": "systems", "a2tg": a2tg, "dataclasses": dataclasses, "jax": jax, "jnp": jnp})
    system = names["Toy"]()
    system.check()
    (stage,) = system.stages()
    gaussians = a2tg.init_from_points(np.eye(3), np.ones((3, 3)), sh_degree=0)
    appearance = a2tg.allocate_appearance(stage.appearance, jax.random.key(0), gaussians)
    assert appearance.numbers(gaussians, None).shape == (3, 4)
    assert appearance.shade((0.5, 0.0, 0.0, 2.0), (), 0.0, 0.0)[0][0] == 0.5


def test_other_programs_gaussians_and_poses_are_taken(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    gaussians = a2tg.init_from_points([[0, 0, 2], [0.1, 0, 2]], [[1, 1, 1]] * 2)
    a2tg.save_ply("point_cloud.ply", gaussians)
    model = a2tg.Model(gaussians)
    saved = []
    torch = SimpleNamespace(tensor=np.array, save=lambda value, path: saved.append((path, value)))
    seen = a2tg.look_at([0, -2, 1], [0, 0, 0], width=8, height=8)
    to_world = jnp.linalg.inv(seen.viewmat) @ jnp.diag(jnp.array([1.0, -1.0, -1.0, 1.0]))
    poses = {"camera_to_world": to_world, "world_view_transform": seen.viewmat.T}
    names = run("coming-from", {"a2tg": a2tg, "jnp": jnp, "torch": torch, "model": model, **poses})
    np.testing.assert_allclose(names["viewmat"], seen.viewmat, atol=1e-6)
    np.testing.assert_array_equal(names["gaussians"].sh, gaussians.sh)
    path, checkpoint = saved[0]
    assert path == "scene.pt" and [*checkpoint["splats"]] == [*a2tg.to_gsplat(model)]
    assert Path("scene.pt").stat().st_size > 0
