"""The report, and the pictures of a model that it shows."""

import base64
import dataclasses
import hashlib
import io
import re
from html.parser import HTMLParser

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from test_results import NAMES, circle, some_history, some_result

from a2tg_jax.appearance import Plain, Textured
from a2tg_jax.core.gaussians import SH_C0, init_from_points
from a2tg_jax.core.origin import Origin
from a2tg_jax.model import Model
from a2tg_jax.render import RenderOutput, RenderSettings
from a2tg_jax.results.figures import curves_figure, save_figure
from a2tg_jax.results.folder import create_run
from a2tg_jax.results.images import largest_gain
from a2tg_jax.results.markup import image, page, slider, table
from a2tg_jax.results.model_pictures import (
    FLIGHT_FRAMES,
    TEXTURE_SIDE,
    animation,
    depth_picture,
    flight,
    learned_textures,
    normal_picture,
)
from a2tg_jax.results.report import SECTIONS, Comparison, comparison_html, write_report
from a2tg_jax.texture import textures_from_arrays


@pytest.fixture
def report(tmp_path) -> str:
    run = create_run(tmp_path)
    save_figure(run.figures / "curves.png", curves_figure({"a": some_history()}, {"a": 0}))
    run.own(run.point_cloud).touch()
    image = np.zeros((30, 40, 3), np.uint8)
    crop = largest_gain(image, image, image)
    pictures = comparison_html(Comparison("a<b.png", [image] * 3, ["photograph", "before", "after"], crop))
    write_report(run, some_result(), [pictures])
    return run.report.read_text(encoding="utf-8")


def test_report_is_one_self_contained_page(report):
    for name, title in SECTIONS:
        assert f'<section id="{name}"><h2>{title}</h2>' in report
    assert "http" not in report.replace("http-equiv", "") and "<link" not in report
    assert report.count("<img ") == report.count('src="data:image/') == 7
    assert "a&lt;b.png" in report and "a<b.png" not in report
    assert "+1.00 dB" in report and "prefers-color-scheme: dark" in report
    assert 'href="point_cloud.ply"' in report and 'href="metrics.json"' not in report


def test_only_the_reports_own_style_and_script_are_allowed(report):
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', report)
    assert policy.startswith("default-src 'none'; img-src data:;") and "unsafe" not in policy
    for tag in ("style", "script"):
        (text,) = re.findall(f"<{tag}>(.*?)</{tag}>", report, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"{tag}-src 'sha256-{digest}'" in policy
    assert not re.findall(r"<[^>]* (?:style|on[a-z]+)=", report)


def test_the_main_model_comes_first_and_the_best_of_each_figure_is_marked(report):
    titles = re.findall("<th>([^<]*)</th>", report)[1:4]
    assert titles == [NAMES[1], NAMES[0], NAMES[2]]
    rows = dict(re.findall(r"<tr><td>([^<]*)</td>(.*?)</tr>", report))
    cells = {name: re.findall("<td([^>]*)>([^<]*)<", row) for name, row in rows.items()}
    marked = {name: [text for kind, text in own if "best" in kind] for name, own in cells.items()}
    assert marked["test PSNR (dB)"] == ["24.00"]
    assert marked["test SSIM"] == [] == marked["frames a second"]  # all are alike
    assert marked["memory (MB)"] == ["0.02", "0.02"] and marked["Gaussians"] == []
    assert marked["a&lt;b.png"] == ["23.00"]


def test_the_models_own_training_time_stands_apart(report):
    cards = dict(re.findall(r'<div class="card">([^<]*)<b>([^<]*)</b>', report))
    gain = "Gain over gaussians-2d-mcmc-continued, with 1.2 times its bytes (0.03 MB and 0.02 MB)"
    assert cards[gain] == "+1.00 dB"
    assert cards["Training"] == "2 min 4 s" and cards["Comparisons&#x27; training"] == "1 min 2 s"


def test_texts_of_a_scene_never_become_markup():
    nasty = '"><script>alert(1)</script>'
    parser = HTMLParser()
    tags, texts = [], []
    parser.handle_starttag = lambda tag, attributes: tags.append(tag)
    parser.handle_data = texts.append
    parser.feed(slider("", [nasty, nasty]) + table([nasty], [[nasty]], {(0, 0)}) + image("data:,", nasty))
    assert "script" not in tags and texts == [nasty] * 5
    assert page(nasty, "", style="", script="").count("<script>") == 1


# Pictures of a model


def some_model(num: int = 4) -> Model:
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (num, 3)).astype(np.float32)
    gaussians = init_from_points(points, np.full((num, 3), 0.5))
    sides = [(1, 1), (2, 4), (4, 2), (0, 0)]
    arrays = [np.zeros((*side, 4), np.float32) for side in sides]
    for array in arrays:
        array[..., 3] = 1
    arrays[1][:, 0, 0], arrays[2][0, :, 3] = 0.5, 0.0
    textures, layout = textures_from_arrays(arrays)
    return Model(gaussians, textures, layout, appearance=Textured())


def test_learned_textures_are_shown_as_their_gaussians_wear_them():
    sheet = learned_textures(some_model())
    assert sheet is not None and sheet.shape == (TEXTURE_SIDE, 2 * TEXTURE_SIDE + 8, 4)
    shapes = {tuple(np.argwhere(part[..., 3]).max(axis=0) + 1) for part in (sheet[:, :64], sheet[:, 72:])}
    assert shapes == {(32, 64), (64, 32)}  # in their own proportions
    wide = next(part for part in (sheet[:, :64], sheet[:, 72:]) if part[0, 63, 3])
    assert wide[0, 0].tolist() == [255, 128, 128, 255] and wide[0, 63].tolist() == [128, 128, 128, 255]
    tall = next(part for part in (sheet[:, :64], sheet[:, 72:]) if part[63, 0, 3])
    assert {int(grey) for grey in tall[:16, :32, 0].ravel()} == {140, 191}  # transparent: the chequered ground


def test_without_larger_textures_there_is_no_sheet():
    model = some_model()
    plain = dataclasses.replace(model, params=(), layout=(), appearance=Plain())
    assert learned_textures(plain) is None
    textures, layout = textures_from_arrays([np.ones((1, 1, 4), np.float32)] * 4)
    assert learned_textures(model.with_textures(textures, layout)) is None


def test_depth_and_normals_are_pictures():
    camera = circle(1)[0]
    alpha = np.ones((camera.height, camera.width), np.float32)
    alpha[:, :5] = 0.1
    depth = alpha * np.linspace(1, 3, camera.height, dtype=np.float32)[:, None]
    towards = -np.asarray(camera.viewmat)[2, :3]
    normal = alpha[..., None] * towards
    output = RenderOutput(*map(jnp.asarray, (normal, alpha, depth, normal, False, depth)))
    seen = depth_picture(output)
    assert seen[:, :5].max() == 0 and seen[0, -1].sum() > seen[-1, -1].sum()
    assert np.abs(normal_picture(output, camera)[:, 5:] - np.array([128.0, 128.0, 255.0])).max() <= 1
    assert normal_picture(output, camera)[:, :5].max() == 0


def test_a_flight_is_a_small_animation():
    cameras = circle(6)
    model = dataclasses.replace(some_model(), origin=Origin.of_cameras(cameras))
    moving = Image.open(io.BytesIO(flight(model, RenderSettings())))
    # Pictures that are alike are one.
    assert FLIGHT_FRAMES / 2 < moving.n_frames <= FLIGHT_FRAMES and moving.size == (cameras[0].width, cameras[0].height)
    assert flight(some_model(), RenderSettings()) is None


def test_an_animation_keeps_its_pictures_in_order():
    images = [np.full((8, 8, 3), SH_C0 * level, np.float32) for level in (0, 1, 2)]
    moving = Image.open(io.BytesIO(animation(map(jnp.asarray, images))))
    shades = []
    for index in range(3):
        moving.seek(index)
        shades.append(np.asarray(moving.convert("RGB"))[4, 4, 0])
    np.testing.assert_allclose(shades, [0, 72, 144], atol=3)
