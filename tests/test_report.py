"""The report, and its pictures and figures."""

import base64
import dataclasses
import hashlib
import json
import re
import subprocess
from html.parser import HTMLParser
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from run_folders import NAMES, circle, create_run, some_history, some_result
from small_models import with_bands

from a2tg_jax import (
    Appearance,
    Geometry,
    Model,
    RenderOutput,
    RenderSettings,
    Texture,
    init_from_points,
    textures_from_arrays,
)
from a2tg_jax.data.load import SceneSource
from a2tg_jax.results import figures
from a2tg_jax.results.images import error_picture, largest_gain, side_by_side, to_uint8
from a2tg_jax.results.report import Comparison, ModelResult, write_report
from a2tg_jax.results.run_evaluation import is_split_by_number


def written_report(folder, result, *, view="a", captions=("b",), shown=(), **options) -> str:
    run = create_run(folder)
    run.own(run.point_cloud).touch()
    image = np.zeros((30, 40, 3), np.uint8)
    comparison = Comparison.of(view, [image] * len(captions), captions, np.s_[:8, :8])
    places = dict.fromkeys(("curves", "textures", "maps", "geometry"), ()) | dict(shown)
    write_report(run, result, [comparison], places, **options)
    return run.report.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("report") / "curves.png"
    Image.new("RGB", (40, 30)).save(path)
    shown = {"curves": [figures.ReportFigure(path, "Curves.", "chart", [("#ff0000", "red")])]}
    captions = ["photograph", "before", "after"]
    return written_report(path.with_name("run"), some_result(), view="a<b.png", captions=captions, shown=shown)


def test_report_is_one_self_contained_page(report):
    sections = re.findall('<section id="([a-z]+)"><h2>', report)
    assert len(sections) == 9 and re.findall('<a href="#([a-z]+)">', report) == sections
    assert "http" not in report.replace("http-equiv", "") and "<link" not in report
    assert report.count("<img ") == report.count('src="data:image/') == 7
    assert "a&lt;b.png" in report and "a<b.png" not in report
    assert "+1.00 dB" in report and "prefers-color-scheme: dark" in report
    assert 'href="point_cloud.ply"' in report and 'href="metrics.json"' not in report
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
    assert marked["a&lt;b.png"] == ["23.00 / 0.5000"]


def test_cards_show_gains_and_the_models_own_training_time(report):
    cards = dict(re.findall(r'<div class="card">([^<]*)<b>([^<]*)</b>', report))
    gain = "Gain over gaussians-2d-mcmc-continued, with 1.2 times its bytes (0.03 MB and 0.02 MB)"
    assert cards[gain] == "+1.00 dB"
    assert cards["Training"] == "2 min 4 s" and cards["Comparisons&#39; training"] == "1 min 2 s"


def test_texts_of_a_scene_never_become_markup(tmp_path):
    nasty = '"><script>alert(1)</script>'
    result = dataclasses.replace(some_result(), scene=nasty)
    report = written_report(tmp_path, result, view=nasty, captions=[nasty, nasty])
    parser = HTMLParser()
    tags, texts = [], []
    parser.handle_starttag = lambda tag, attributes: tags.append(tag)
    parser.handle_data = texts.append
    parser.feed(report)
    assert tags.count("script") == 1
    # Twice the title, the view, its two captions below pictures and crops and on buttons, and the one that is shown.
    assert sum(nasty in text for text in texts) == 2 + 1 + 2 * 3 + 1


def test_the_report_says_what_is_special_about_a_run(tmp_path):
    """No test views, metrics up to exposure and pose, and a model no better than one flat colour per view."""

    def special(measured: ModelResult) -> ModelResult:
        views = [dataclasses.replace(view, flat_psnr=26.0) for view in measured.train.per_view]
        train = dataclasses.replace(measured.train, per_view=tuple(views))
        return dataclasses.replace(measured, splits=dict.fromkeys(("train", "train_color_fit", "train_aligned"), train))

    plain = some_result()
    result = dataclasses.replace(plain, models={name: special(found) for name, found in plain.models.items()})
    report, usual = (written_report(tmp_path / str(id(each)), each) for each in (result, plain))
    for printed in ("2 views, none held out", "Training PSNR", "Colours fitted: ", "Poses aligned: ", "did not learn"):
        assert printed in report and printed not in usual
    assert "4 views, 2 held out" in usual and "test views: " in usual and "test views: " not in report


@pytest.mark.parametrize(("tested", "is_shown"), [("13", True), ("12", False), ("24", False)])
def test_a_run_that_held_every_second_view_out_shows_how_to_train_on_all(tested, is_shown, tmp_path):
    """Other test views are those of a list of the scene, which no option changes."""
    views = [SimpleNamespace(name=name, panorama=None) for name in "1234"]
    test, train = ([view for view in views if (view.name in tested) is is_test] for is_test in (True, False))
    source, scene = SceneSource("s", test_every=2), SimpleNamespace(test=test, train=train)
    by_number = is_split_by_number(source, scene)
    assert not is_split_by_number(dataclasses.replace(source, validation=True), scene)
    report = written_report(tmp_path, some_result(), is_split_by_number=by_number)
    assert "dB on training views" in report
    assert ("For the final picture" in report) is is_shown is ("--test-every 0 --out" in report)


def test_the_views_of_a_panorama_count_as_one():
    views = [SimpleNamespace(name=str(number), panorama=number // 2) for number in range(6)]
    scene = SimpleNamespace(test=[*views[:2], *views[4:]], train=views[2:4])
    assert is_split_by_number(SceneSource("s", test_every=2), scene)
    assert not is_split_by_number(SceneSource("s", test_every=3), scene)


def test_the_report_names_the_commit(tmp_path, monkeypatch):
    """A checkout's own, or the one that pip noted: a repository may have site-packages of another commit in it."""

    def git(*words: str) -> str:
        command = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b", *words]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    def reported() -> str:
        run = tmp_path / f"run{len(list(tmp_path.iterdir()))}"
        return " ".join(written_report(run, some_result()).split())

    monkeypatch.setattr("a2tg_jax.host.source_commit.CHECKOUT", tmp_path)
    git("init")
    (tmp_path / ".gitignore").write_text("run*")
    assert "commit <code>" not in reported()
    (tmp_path / "a").write_text("1")
    git("add", "a")
    git("commit", "-m", "1")
    commit = git("rev-parse", "HEAD")
    assert f"commit <code>{commit}</code> (version" in reported()
    (tmp_path / "a").write_text("2")
    assert f"commit <code>{commit}</code>, with local changes (version" in reported()
    assert "<pre>pip install '.[train]' a2tg train --config" in reported()
    monkeypatch.setattr("a2tg_jax.host.source_commit.CHECKOUT", tmp_path / "site-packages")
    for note, commit in (({"vcs_info": {"commit_id": "abc"}}, "abc"), ({"dir_info": {}}, None)):
        found = SimpleNamespace(read_text=lambda _, note=note: json.dumps(note))
        monkeypatch.setattr("a2tg_jax.host.source_commit.distribution", lambda _, found=found: found)
        assert (f"commit <code>{commit}</code>" in reported()) == (commit is not None)
    monkeypatch.setenv("A2TG_COMMIT", "of a copy")
    assert "commit <code>of a copy</code>" in reported()


# Pictures of a model


def some_model(num: int = 4) -> Model:
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (num, 3)).astype(np.float32)
    gaussians = init_from_points(points, np.full((num, 3), 0.5))
    sides = [(1, 1), (2, 4), (4, 2), (0, 0)]
    arrays = [np.zeros((*side, 4), np.float32) for side in sides]
    for array in arrays:
        array[..., 3] = 1
    arrays[1][:, 0, 0], arrays[2][0, :, 3] = 0.5, 0.0
    textures = textures_from_arrays(arrays)
    return Model(gaussians, Appearance(texture=Texture(textures)))


def shown(alpha, depth, normal=None) -> RenderOutput:
    """A render of which only these are read."""
    return RenderOutput(0.0, jnp.asarray(alpha), None, Geometry(jnp.asarray(depth), normal, None))


HISTORIES = {NAMES[0]: some_history(1), NAMES[1]: some_history(2), NAMES[2]: some_history(2)}


@pytest.fixture
def figures_of(tmp_path, monkeypatch):
    """Figures of a report by file name: pictures with their legends, and plots. The model's render is a stand-in."""

    def written(model, output=None):
        camera = circle(1)[0]
        ones = np.ones((camera.height, camera.width))
        seen = output or shown(ones, ones, np.zeros((*ones.shape, 3)))
        plots = {}
        monkeypatch.setattr(figures, "Renderer", lambda *_, **__: lambda camera: seen)
        monkeypatch.setattr(figures, "save_figure", lambda path, figure: plots.update({path.name: figure}))
        run = create_run(tmp_path / str(len(list(tmp_path.iterdir()))))
        starts = {NAMES[0]: 0, NAMES[1]: 60, NAMES[2]: 60}
        places = figures.write_figures(run, model, camera, RenderSettings(), HISTORIES, starts)
        made = {}
        for figure in [*places["textures"], *places["maps"], *places["geometry"]]:
            if figure.path.is_file():
                made[figure.path.name] = np.asarray(Image.open(figure.path)), figure.legend
        return made | plots

    return written


def test_learned_textures_are_shown_as_their_gaussians_wear_them(figures_of):
    sheet, _ = figures_of(some_model())["textures.png"]
    assert sheet.shape == (64, 2 * 64 + 8, 4)
    shapes = {tuple(np.argwhere(part[..., 3]).max(axis=0) + 1) for part in (sheet[:, :64], sheet[:, 72:])}
    assert shapes == {(32, 64), (64, 32)}  # in their own proportions
    wide = next(part for part in (sheet[:, :64], sheet[:, 72:]) if part[0, 63, 3])
    assert wide[0, 0].tolist() == [255, 128, 128, 255] and wide[0, 63].tolist() == [128, 128, 128, 255]
    tall = next(part for part in (sheet[:, :64], sheet[:, 72:]) if part[63, 0, 3])
    assert {int(grey) for grey in tall[:16, :32, 0].ravel()} == {140, 191}  # transparent: the chequered ground


def test_depth_and_normals_are_pictures(figures_of):
    camera = circle(1)[0]
    alpha = np.ones((camera.height, camera.width), np.float32)
    alpha[:, :5] = 0.1
    depth = alpha * np.linspace(1, 3, camera.height, dtype=np.float32)[:, None]
    towards = -np.asarray(camera.viewmat)[2, :3]
    normal = alpha[..., None] * towards
    made = figures_of(Model(some_model().gaussians), shown(alpha, depth, normal))
    seen, stops = made["depth.png"]
    normals, _ = made["normals.png"]
    assert seen[0, -1].sum() > seen[-1, -1].sum()
    distances = [float(distance) for _, distance in stops]
    assert distances == sorted(distances) and 1 < distances[0] < 1.1 and 2.7 < distances[-1] < 3
    assert np.abs(normals[:, 5:] - np.array([128.0, 128.0, 255.0])).max() <= 1
    for picture in (seen, normals):
        assert {tuple(color) for color in picture[:, :5].reshape(-1, 3)} == {(140,) * 3, (191,) * 3}


@pytest.mark.parametrize(("share", "factor"), [(0.2, 1000), (0.04, 0.01)], ids=["far", "near"])
def test_outliers_leave_the_colours_of_depth_to_the_scene(figures_of, share, factor):
    """A far background, and splats before the camera."""
    depth = np.broadcast_to(np.linspace(1, 3, 100, dtype=np.float32), (100, 100)).copy()
    depth[: round(100 * share)] *= factor
    output = shown(np.ones_like(depth), depth, np.zeros((100, 100, 3)))
    colors = figures_of(Model(some_model().gaussians), output)["depth.png"][0][-1].astype(int)
    assert np.abs(colors[5] - colors[94]).max() > 150


def test_where_nothing_is_hit_there_is_still_a_picture(figures_of):
    nothing = np.zeros((4, 4))
    made = figures_of(Model(some_model().gaussians), shown(nothing, nothing, np.zeros((4, 4, 3))))
    assert made["depth.png"][0].shape == made["normals.png"][0].shape == (4, 4, 3)


def test_maps_show_what_varies_between_gaussians(figures_of):
    textured = some_model()
    sizes = {"textures.png", "sizes.png"}
    of_size = {side: textures_from_arrays([np.ones((side, side, 4), np.float32)] * 4) for side in (1, 4)}
    gaussians = init_from_points(np.eye(3, dtype=np.float32) / 2, np.full((3, 3), 0.5), sh_degree=0)
    cases = [
        (textured, sizes | {"resolutions.png"}, ["1 or none", "2", "4", "8"]),
        (textured.with_textures(of_size[1]), set(), None),
        (textured.with_textures(of_size[4]), {"sizes.png"}, None),
        (with_bands(Model(gaussians), np.zeros((3, 8, 3)), [0, 2, 1]), {"degrees.png"}, ["0", "1", "2"]),
    ]
    for model, files, names in cases:
        made = figures_of(model)
        assert made.keys() == files | {"curves.png", "depth.png", "normals.png"}
        for file in files & {"resolutions.png", "degrees.png"}:
            colors, meanings = zip(*made[file][1], strict=True)
            assert [*meanings] == names and len(set(colors)) == len(names)


def test_textures_of_a_fixed_size_are_counted():
    texts = [text.get_text() for text in figures.sizes_figure(np.array([[3, 3]] * 3 + [[4, 1]])).axes[0].texts]
    assert sorted(texts)[:2] == ["1\n25.0%", "3\n75.0%"] and set(texts[2:]) - set(sorted(texts)[:2]) == {"–"}


def test_figures_are_drawn_within_their_canvas(figures_of, tmp_path):
    made = figures_of(some_model())
    for name in ("curves.png", "sizes.png"):
        made[name].savefig(tmp_path / name, format="png", dpi=110)
        assert (tmp_path / name).stat().st_size > 1000
        box = made[name].axes[0].title.get_window_extent()
        assert box.x0 >= 0 and box.x1 <= made[name].bbox.x1


def test_largest_gain_finds_the_square_and_leaves_out_where_both_fail():
    target = np.full((40, 60, 3), 100, np.uint8)
    before, after = target.copy(), target.copy()
    before[23:33, 41:51] = 250
    assert largest_gain(target, before, after) == np.s_[23:33, 41:51]
    before[23:33, 41:51], before[5:15, 5:15], after[5:15, 5:15] = 150, 255, 200
    assert largest_gain(target, before, after)[0].start == 23
    after[:] = 200
    rows, columns = largest_gain(target, before, after)
    assert rows.stop - rows.start == columns.stop - columns.start == 10


def test_pictures_are_rounded_clipped_brightened_and_put_in_a_row():
    assert to_uint8(np.array([[[-1.0, 0.5, 2.0]]])).tolist() == [[[0, 128, 255]]]
    difference = error_picture(np.array([[[10, 0, 200]]], np.uint8), np.array([[[0, 5, 0]]], np.uint8))
    assert difference.tolist() == [[[40, 20, 255]]]
    images = [np.full((30, 40, 3), shade, np.uint8) for shade in (50, 150)]
    sheet = np.asarray(side_by_side(images, ["photograph", "render"]))
    assert sheet.shape[1] == 2 * 240 + 6, "small images are enlarged"
    assert sheet[-1, 0, 0] == 50 and sheet[-1, -1, 0] == 150
