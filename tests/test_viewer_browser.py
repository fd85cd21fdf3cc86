"""The viewer's page in Chromium beside the JAX renderer: the same pictures to less than 1/255, on average.

Needs Node, Chromium, and `npm ci` in web/; skipped where one is missing.
"""

import dataclasses
import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from small_files import ATTRIBUTES, SCALES
from viewer_cases import shaped_model, small_model, small_numbers, write_case

import a2tg_jax as a2tg
from a2tg_jax import Mcmc
from a2tg_jax.io.edit_file import crop_box
from a2tg_jax.results.model_source import Source, open_source
from a2tg_jax.web.page import viewer_html

WEB = Path(__file__).resolve().parents[1] / "web"
CHROMIUM = ("/usr/bin/chromium", "/usr/bin/chromium-browser", "/usr/bin/google-chrome")
SYSTEM = a2tg.A2tg(
    stage1_iterations=60,
    stage2_iterations=60,
    densify=Mcmc(cap=700),
    texture=a2tg.Upscale(fraction=0.5, at=(0.1, 0.3)),
    texel_rate=1e-2,
)


def run_node(*arguments: str, **environment: str) -> None:
    done = subprocess.run(
        ["npm", "run", *arguments], cwd=WEB, env=os.environ | environment, capture_output=True, text=True, check=False
    )
    print(done.stdout)
    assert done.returncode == 0, done.stdout + done.stderr


def trained(scene: a2tg.Scene) -> Source:
    return Source(a2tg.fit(scene, SYSTEM).model, scene.name)


def ellipsoids(path: Path) -> Path:
    """A 3DGS file: ellipsoids in a ball, with view dependence."""
    rng = np.random.default_rng(3)
    names = [*ATTRIBUTES, "scale_2"]
    rows = {name: rng.normal(size=400) * 0.2 for name in names}
    rows |= {name: rng.normal(size=400) for name in ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity")}
    rows |= {name: rng.normal(size=400) for name in ("rot_0", "rot_1", "rot_2", "rot_3")}
    rows |= {name: rng.normal(size=400) * 0.6 - 2.2 for name in (*SCALES, "scale_2")}
    header = "".join(f"property float {name}\n" for name in names)
    data = np.stack([rows[name] for name in names], axis=1).astype("<f4").tobytes()
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex 400\n{header}end_header\n"
    path.write_bytes(head.encode() + data)
    return path


def cameras_around(distance: float) -> list[a2tg.Camera]:
    """Two views of the origin, 96 × 72."""
    K = np.array([[100, 0, 48], [0, 100, 36], [0, 0, 1]], np.float32)
    cameras = []
    for angle in (0.3, 2.2):
        viewmat = np.eye(4, dtype=np.float32)
        viewmat[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        viewmat[2, 3] = distance
        cameras.append(a2tg.Camera(viewmat, K, 96, 72))
    return cameras


def test_the_pages_own_tests_compare_with_what_is_written_today():
    source = Source(small_model(), "small", "a note")
    wanted = json.loads((WEB / "test" / "small.json").read_text(encoding="utf-8"))
    found = small_numbers(source.model)
    assert set(found) == set(wanted)
    for name, numbers in wanted.items():
        np.testing.assert_allclose(found[name], numbers, rtol=1e-4, atol=2e-5)


@pytest.fixture
def node():
    has_all = shutil.which("npm") and (WEB / "node_modules").is_dir() and any(Path(path).exists() for path in CHROMIUM)
    if not has_all:
        pytest.skip("needs Node, Chromium and `npm ci` in web/")


@pytest.mark.long
def test_the_page_is_what_the_sources_build(node, tmp_path):
    run_node("build", "--", "--outDir", str(tmp_path), "--emptyOutDir")
    built = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert built == viewer_html(), "the sources give another page: .ci/web --write"


@pytest.mark.long
def test_the_page_shows_what_the_renderer_shows(node, tmp_path):
    scene = a2tg.synthetic_scene(num_views=6, width=96, height=72, num_points=400)
    source = trained(scene)
    cameras = [view.camera for view in (*scene.test, *scene.train)][:2]
    write_case(tmp_path / "built-in", source, cameras, ("full", "plain", "depth", "normals"))
    with pytest.warns(UserWarning, match="thinnest axis"):
        cloud = open_source(ellipsoids(tmp_path.parent / "cloud.ply"))
    write_case(tmp_path / "3dgs", cloud, cameras_around(5.0))
    # Noise in all that there is, which rounding changes; the page must show what is left all the more exactly.
    narrow = a2tg.TextureOptions(outside="identity", extent=1.5)
    conventions = {"noise": a2tg.TextureOptions(), "official": a2tg.TextureOptions.official(), "narrow": narrow}
    for name, options in conventions.items():
        write_case(tmp_path / name, Source(small_model(options), name), cameras_around(4.0), of=["the file"])
    shaped = Source(shaped_model(), "shaped")
    write_case(tmp_path / "shaped", shaped, cameras_around(4.0), ("full", "depth", "normals"), of=["the file"])
    run_node("test:browser", "--", "compare", A2TG_CASES=str(tmp_path))


@pytest.mark.long
def test_the_page_shows_a_real_scene(node, shared, tmp_path):
    scene = a2tg.load_scene(shared / "scenes" / "fox", downscale=8)
    source = trained(scene)
    write_case(tmp_path / "fox", source, [view.camera for view in scene.test[:2]])
    run_node("test:browser", "--", "compare", A2TG_CASES=str(tmp_path))


@pytest.mark.long
def test_the_page_itself(node, tmp_path):
    """An edit that it saves shows in Python what the page shows."""
    run_node("test:browser", "--", "page", "adjust", A2TG_EDIT=str(tmp_path))
    edit = a2tg.load_edit(tmp_path / "edit.json")
    model = small_model()
    box = crop_box(model, edit.up, np.zeros(3), np.array([1, 1, 0.55]))
    for found, wanted in ((edit.crop.axes, box.axes), (edit.crop.low, box.low), (edit.crop.high, box.high)):
        np.testing.assert_allclose(found, wanted, atol=1e-6)
    edited, (camera,) = a2tg.apply_edit(model, edit), model.origin.cameras
    assert edited.background == pytest.approx((1, 128 / 255, 0))
    without = a2tg.apply_edit(model, dataclasses.replace(edit, floaters=0.0))
    assert 10 < edited.num < without.num < model.num - 10
    page = np.reshape(json.loads((tmp_path / "picture.json").read_text()), (camera.height, camera.width, 4))
    shown = np.asarray(edited.render(camera, background=(0.0, 0.0, 0.0)).color)
    assert np.abs(page[..., :3] - shown).mean() < 1 / 255
    assert np.abs(page[..., :3] - np.asarray(model.render(camera, background=(0.0, 0.0, 0.0)).color)).mean() > 4 / 255
