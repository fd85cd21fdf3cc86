"""Run folders, summaries, pictures, figures and the smooth path, each without training."""

import dataclasses
import json
import re
import shlex

import jax.numpy as jnp
import numpy as np
import pytest

from a2tg_jax import cli
from a2tg_jax.cameras import Camera
from a2tg_jax.checkpoint import History
from a2tg_jax.config import DensifyConfig, TextureConfig, TrainConfig
from a2tg_jax.data import View, view_image
from a2tg_jax.evaluation import Evaluation, ViewMetrics, evaluate
from a2tg_jax.gaussians import init_from_points
from a2tg_jax.metrics import psnr
from a2tg_jax.paths import smooth_path
from a2tg_jax.render import render_image
from a2tg_jax.results.figures import curves_figure, resolutions_figure, save_figure, sizes_figure
from a2tg_jax.results.folder import create_run, open_run
from a2tg_jax.results.history import read_history, write_history
from a2tg_jax.results.pictures import error_picture, largest_gain, resolution_colors, side_by_side, to_uint8
from a2tg_jax.results.record import RunRecord, SceneSource, changed_fields, read_record, write_record
from a2tg_jax.results.report import SECTIONS, Comparison, write_report
from a2tg_jax.results.summary import PhaseResult, RunResult, metrics_json, minutes, per_view_json, summary_text

RECORD = RunRecord(SceneSource("scenes/a b", downscale=2), TrainConfig.quick(), baseline=True)


def some_result(record: RunRecord = RECORD) -> RunResult:
    def phase(psnr: float, texels: int) -> PhaseResult:
        views = (ViewMetrics("a<b.png", psnr, 0.5, 0.25), ViewMetrics("c.png", psnr + 2, 0.7, 0.75))
        found = Evaluation(views, "alex", 20.0, ())
        return PhaseResult(found, found, 100, texels, 0.0232 + 16e-6 * texels, 0.0, 62.0)

    return RunResult("scene", record, {"stage1": phase(20, 0), "stage2": phase(23, 300), "baseline": phase(22, 0)})


def some_history(stage: int = 1, num: int = 60) -> History:
    steps = np.arange(1, num + 1)
    ones = np.ones(num)
    return History(stage * np.ones(num, int), steps, 1 / steps, 20 + np.log(steps), 5 * steps, 0.1 * ones, 0.5 * steps)


def circle(num: int) -> list[Camera]:
    """Cameras on a circle of radius 2 about the origin, looking at it, y down along -z of the world."""
    cameras = []
    for angle in np.linspace(0, 2 * np.pi, num, endpoint=False):
        center = 2 * np.array([np.cos(angle), np.sin(angle), 0])
        z, y = -center / 2, np.array([0, 0, -1.0])
        rotation = np.stack([np.cross(y, z), y, z])
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ center
        K = jnp.asarray([[50, 0, 20], [0, 50, 15], [0, 0, 1]], jnp.float32)
        cameras.append(Camera(jnp.asarray(viewmat, jnp.float32), K, 40, 30))
    return cameras


# Evaluation


def test_evaluation_measures_the_render():
    cameras, background = circle(3), (0.2, 0.4, 0.6)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))
    gaussians = init_from_points(points, points + 0.5)
    images = [np.asarray(render_image(gaussians, camera, background=background).color) for camera in cameras]
    views = [View(f"{i}.png", camera, to_uint8(1 - images[i])) for i, camera in enumerate(cameras)]
    found = evaluate(views, gaussians, background=background, num_renders=2)
    for i, measured in enumerate(found.per_view):
        target = jnp.asarray(view_image(views[i]))
        assert measured.psnr == pytest.approx(float(psnr(jnp.asarray(images[i]), target)), rel=1e-4)
        assert measured.lpips is None
    np.testing.assert_allclose(np.stack(found.renders), to_uint8(np.stack(images[:2])), atol=1)
    assert found.psnr == pytest.approx(np.mean([view.psnr for view in found.per_view]))
    assert found[1:].per_view == found.per_view[1:] and found.frames_per_second > 0
    with pytest.raises(ValueError, match="no views"):
        evaluate((), gaussians)


# Folders


def test_existing_folder_is_refused(tmp_path):
    run = create_run(tmp_path / "run")
    run.own(run.report).touch()
    with pytest.raises(FileExistsError, match=r"is not empty; add --resume .* --overwrite"):
        create_run(tmp_path / "run")
    (tmp_path / "photo.jpg").touch()
    for overwrite in (False, True):
        with pytest.raises(FileExistsError, match="is not empty and not a run folder"):
            create_run(tmp_path, overwrite=overwrite)
    with pytest.raises(FileExistsError, match="is a file"):
        create_run(tmp_path / "photo.jpg", overwrite=True)


def test_folder_of_a_run_that_never_began_is_free(tmp_path):
    write_record(create_run(tmp_path / "run"), RECORD)
    create_run(tmp_path / "run")


def test_overwrite_deletes_only_what_runs_write(tmp_path):
    run = create_run(tmp_path / "run")
    write_record(run, RECORD)
    own = [run.model("stage1"), run.history("stage2"), run.checkpoint("stage1", 5), run.report, run.test / "a.png"]
    foreign = [
        tmp_path / "outside.txt",
        run.path / "notes.txt",
        run.test / "mine.png",
        run.path / "models" / "mine.npz",
    ]
    for path in [*map(run.own, own), *foreign]:
        path.parent.mkdir(exist_ok=True)
        path.touch()
    with open(run.marker, "a", encoding="utf-8") as file:
        file.write("../outside.txt\n")
    create_run(run.path, overwrite=True)
    left = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert sorted(left) == sorted([*foreign, run.marker])


def test_a_scene_is_never_overwritten(tmp_path):
    """A Blender scene has folders that runs have too."""
    photographs = [tmp_path / split / "r_0.png" for split in ("train", "test", "models", "figures")]
    for path in [*photographs, tmp_path / "transforms_train.json", tmp_path / "config.json"]:
        path.parent.mkdir(exist_ok=True)
        path.touch()
    with pytest.raises(FileExistsError, match="not a run folder"):
        create_run(tmp_path, overwrite=True)
    assert all(path.is_file() for path in photographs)


def test_open_run_wants_a_run(tmp_path):
    with pytest.raises(FileNotFoundError, match="is not a run folder"):
        open_run(tmp_path)


def test_newest_checkpoints_are_kept(tmp_path):
    run = create_run(tmp_path)
    for iteration in (20, 100, 1000, 3):
        run.checkpoint("stage1", iteration).parent.mkdir(exist_ok=True)
        run.checkpoint("stage1", iteration).touch()
    run.drop_old_checkpoints("stage1")
    assert run.checkpoints("stage1") == [run.checkpoint("stage1", 100), run.checkpoint("stage1", 1000)]


# Records


def test_record_round_trip(tmp_path):
    run = create_run(tmp_path)
    write_record(run, RECORD)
    assert read_record(run) == RECORD


def test_damaged_record_is_one_clear_line(tmp_path):
    run = create_run(tmp_path)
    run.config.write_text("{")
    with pytest.raises(ValueError, match=r"config\.json: is not valid JSON"):
        read_record(run)
    run.config.write_text(json.dumps({"source": {}, "config": {}, "baseline": True}))
    with pytest.raises(ValueError, match=r"config\.json\.source\.path is missing"):
        read_record(run)


@pytest.mark.parametrize(
    "config",
    [
        TrainConfig.quick(),
        TrainConfig(
            texture=TextureConfig(is_enabled=False, upscale_at=(0.1, 0.5), budget_mb=3.5),
            densify=DensifyConfig(cap=7),
            initial_gaussians=50,
            background="white",
        ),
    ],
)
def test_command_repeats_the_run(tmp_path, config):
    record = RunRecord(SceneSource(str(tmp_path / "a b"), downscale=4), config, baseline=True)
    a2tg, name, *arguments = shlex.split(record.command(tmp_path / "run"))
    assert (a2tg, cli._parse(name, arguments).record) == ("a2tg", record)


def test_changed_fields_are_those_asked_for_in_vain():
    kept = TrainConfig.quick()
    asked = dataclasses.replace(TrainConfig.paper(), seed=3)
    assert changed_fields(asked, TrainConfig.paper(), kept) == ["seed"]
    assert changed_fields(TrainConfig.paper(), TrainConfig.paper(), kept) == []
    assert changed_fields(kept, TrainConfig.paper(), kept) == []


# Summaries


def test_gain_is_over_the_baseline():
    result = some_result()
    assert result.gain == pytest.approx(1.0)
    assert dataclasses.replace(result, phases={"stage1": result.phases["stage1"]}).gain is None


def test_metrics_hold_means_of_the_views():
    metrics = json.loads(json.dumps(metrics_json(some_result())))
    assert metrics["phases"]["stage2"]["test"] == {"psnr": 24.0, "ssim": 0.6, "lpips": 0.5, "views": 2}
    assert metrics["lpips_network"] == "alex"
    assert per_view_json(some_result())["stage1"]["train"]["c.png"]["psnr"] == 22


def test_summary_has_a_column_for_each_phase():
    lines = summary_text(some_result()).splitlines()
    assert re.split(r"\s{2,}", lines[0])[1:] == ["stage 1", "stage 2, textured", "stage 2, untextured"]
    assert lines[1].split() == ["test", "PSNR", "(dB)", "21.00", "24.00", "23.00"]
    assert lines[-1] == "textures bring +1.00 dB over the untextured second stage"


def test_durations():
    assert [minutes(seconds) for seconds in (4.4, 65, 3720)] == ["4 s", "1 min 5 s", "1 h 2 min"]


def test_history_round_trip(tmp_path):
    write_history(tmp_path / "h.csv", some_history())
    for x, y in zip(
        dataclasses.astuple(read_history(tmp_path / "h.csv")), dataclasses.astuple(some_history()), strict=True
    ):
        np.testing.assert_array_equal(x, y)
    (tmp_path / "h.csv").write_text("a,b\n")
    with pytest.raises(ValueError, match="has the columns a, b"):
        read_history(tmp_path / "h.csv")


# Pictures


def test_largest_gain_finds_the_square():
    target = np.full((40, 60, 3), 100, np.uint8)
    before, after = target.copy(), target.copy()
    before[23:33, 41:51] = 250
    crop = largest_gain(target, before, after)
    assert (crop.top, crop.left, crop.side) == (23, 41, 10)
    assert crop.of(before).min() == 250


def test_pictures_are_rounded_clipped_and_brightened():
    assert to_uint8(np.array([[[-1.0, 0.5, 2.0]]])).tolist() == [[[0, 128, 255]]]
    difference = error_picture(np.array([[[10, 0, 200]]], np.uint8), np.array([[[0, 5, 0]]], np.uint8))
    assert difference.tolist() == [[[40, 20, 255]]]


def test_side_by_side_puts_images_in_a_row():
    images = [np.full((30, 40, 3), shade, np.uint8) for shade in (50, 150)]
    sheet = np.asarray(side_by_side(images, ["photograph", "render"]))
    assert sheet.shape[1] == 2 * 40 + 6
    assert sheet[-1, 0, 0] == 50 and sheet[-1, -1, 0] == 150


def test_resolution_colors_differ():
    colors = resolution_colors(5)
    assert colors.shape == (5, 3) and len(np.unique(colors, axis=0)) == 5
    assert resolution_colors(1).shape == (1, 3)


def test_figures_are_written(tmp_path):
    histories = {"stage1": some_history(1), "stage2": some_history(2), "baseline": some_history(2)}
    sizes = np.array([(1, 1), (1, 4), (4, 2), (1, 1), (8, 8)])
    figures = [curves_figure(histories), sizes_figure(sizes), resolutions_figure(np.zeros((30, 40, 3), np.uint8), 7)]
    for index, figure in enumerate(figures):
        save_figure(tmp_path / f"{index}.png", figure)
        assert (tmp_path / f"{index}.png").stat().st_size > 1000


# The report


def test_report_is_one_self_contained_page(tmp_path):
    run = create_run(tmp_path)
    save_figure(run.figures / "curves.png", curves_figure({"stage1": some_history()}))
    image = np.zeros((30, 40, 3), np.uint8)
    crop = largest_gain(image, image, image)
    write_report(run, some_result(), [Comparison("a<b.png", [image] * 3, ["photograph", "before", "after"], crop)])
    page = run.report.read_text(encoding="utf-8")
    for name, title in SECTIONS:
        assert f'<section id="{name}"><h2>{title}</h2>' in page
    assert "http" not in page and "<script" not in page and "<link" not in page
    assert page.count("<img ") == page.count('src="data:image/') == 7
    assert "a&lt;b.png" in page and "a<b.png" not in page
    assert "+1.00 dB" in page and "prefers-color-scheme: dark" in page


# The path


def test_path_is_smooth_and_stays_near_the_cameras():
    path = smooth_path(circle(12), 60)
    viewmats = np.stack([np.asarray(camera.viewmat, np.float64) for camera in path])
    rotations = viewmats[:, :3, :3]
    centers = -np.einsum("nji,nj->ni", rotations, viewmats[:, :3, 3])
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (60, 3, 3)), atol=1e-6
    )
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-6)
    assert np.all(np.abs(np.linalg.norm(centers, axis=1) - 1.8) < 0.3)
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    assert steps.max() < 1.1 * steps.min()
    towards = np.einsum("ni,ni->n", rotations[:, 2], -centers / np.linalg.norm(centers, axis=1, keepdims=True))
    assert towards.min() > 0.95


def test_path_wants_two_cameras():
    with pytest.raises(ValueError, match="two cameras"):
        smooth_path(circle(1), 10)
