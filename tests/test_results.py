"""Run folders, output paths, records, plans, histories and summaries, each without training."""

import contextlib
import dataclasses
import errno
import importlib.util
import json
import os
import re
import shlex
import sys
import tomllib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from run_folders import NAMES, RECORD, circle, create_run, some_history, some_result, tensorboard_scalars
from small_models import movable_kernels, origin_of, with_row

import a2tg_jax as a2tg
from a2tg_jax import (
    A2tg,
    BBSplat,
    Bytewise,
    Gaussians2d,
    Gaussians2dMcmc,
    LearningRates,
    Mcmc,
    Model,
    TexturedGaussians,
    Upscale,
    View,
    allocate_appearance,
    evaluate,
    init_from_points,
    like,
    psnr,
    render_image,
    save_model,
    smooth_path,
    synthetic_scene,
    view_image,
)
from a2tg_jax.base.text import in_bytes
from a2tg_jax.cli import main as cli
from a2tg_jax.measure import evaluation
from a2tg_jax.results import info
from a2tg_jax.results.commands import repeating_command
from a2tg_jax.results.folder import OLD, RunFolder, check_free, drop_old, open_run, set_aside
from a2tg_jax.results.history import EventWriter, read_history, write_history
from a2tg_jax.results.images import to_uint8
from a2tg_jax.results.info import describe_run
from a2tg_jax.results.output_paths import check_export, check_output
from a2tg_jax.results.plan import plan_run
from a2tg_jax.results.record import RunRecord, SceneSource, contradictions, read_record, read_run_file, write_record
from a2tg_jax.results.report import (
    metrics_json,
    per_view_json,
    sizes_line,
    summary_text,
)
from a2tg_jax.results.run_evaluation import check_held_out, evaluate_run
from a2tg_jax.results.run_training import RunOptions, train_run

needs_tensorboard = pytest.mark.skipif(
    importlib.util.find_spec("tensorboardX") is None, reason="the extra [tensorboard] is not installed"
)


def with_record(path, record=RECORD) -> RunFolder:
    run = create_run(path)
    write_record(run, record)
    return run


# Evaluation


def test_evaluation_measures_the_render(monkeypatch):
    times = iter((3, 1, 2, 8, 9, 4, 8, 8, 8))  # three renders of each view
    monkeypatch.setattr(evaluation, "_seconds", lambda renderer, camera: next(times))
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
    assert found[1:].per_view == found.per_view[1:]
    assert found.frames_per_second == 1 / 4, "the median over views, each at its fastest"
    with pytest.raises(ValueError, match="at least one view"):
        evaluate((), gaussians)


def test_views_of_the_training_are_not_scored_as_held_out(tmp_path):
    scene = synthetic_scene(num_views=4, width=8, height=6, num_points=9)
    grown = dataclasses.replace(scene, train=scene.train[1:], test=(*scene.test, scene.train[0]))
    run = with_record(tmp_path / "run", RunRecord(SceneSource("synthetic"), "a2tg", A2tg.preset("smoke")))
    gaussians = init_from_points(scene.points, scene.colors)
    save_model(run.model("a2tg-gaussians"), Model(gaussians, origin=origin_of(scene)))
    message = rf"a2tg-gaussians.npz was trained on 1 view that synthetic now holds out, such as {scene.train[0].name}"
    for action in (lambda: evaluate_run(run, grown), lambda: train_run(run, grown, RunOptions())):
        with pytest.raises(ValueError, match=message):
            action()
    check_held_out(Model(gaussians, origin=origin_of(grown)), scene, run.path)
    check_held_out(Model(gaussians), grown, run.path)


# Folders


def test_folders_in_use_are_refused_and_unused_ones_free(tmp_path):
    create_run(with_record(tmp_path / "run").path)  # It has a record, but its run never began.
    run = RunFolder(tmp_path / "run")
    run.own(run.report).touch()
    (tmp_path / "photo.jpg").touch()
    with pytest.raises(FileExistsError, match=r"is not empty; add `resume` .* `overwrite`"):
        check_free(run.path)
    check_free(run.path, overwrite=True)
    for path, words in ((tmp_path, "not a run folder"), (tmp_path / "photo.jpg", "is a file")):
        with pytest.raises(FileExistsError, match=words):
            check_free(path, overwrite=True)
    with pytest.raises(FileNotFoundError, match="is not a run folder"):
        open_run(tmp_path)


def test_overwrite_deletes_only_what_runs_write(tmp_path):
    run = with_record(tmp_path / "run")
    own = [run.model(NAMES[0]), run.history(NAMES[1]), run.checkpoint(NAMES[0], 5), run.report, run.test / "a.png"]
    foreign = [tmp_path / "out.txt", run.path / "notes.txt", run.test / "mine.png", run.path / "models" / "mine.npz"]
    for path in [*map(run.own, own), *foreign]:
        path.parent.mkdir(exist_ok=True)
        path.touch()
    with open(run.marker, "a", encoding="utf-8") as file:
        file.write("../out.txt\n\nmodels\n")
    set_aside(run)
    assert RunFolder(run.path / OLD).model(NAMES[0]).is_file()
    drop_old(run)
    left = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert sorted(left) == sorted([*foreign, run.marker])


def test_a_scene_is_never_overwritten(tmp_path):
    """A Blender scene has folders of the same names as a run's."""
    for name in ("train/r_0.png", "test/r_0.png", "models/r_0.png", "transforms_train.json", "run.toml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(FileExistsError, match="not a run folder"):
        check_free(tmp_path, overwrite=True)


def test_newest_checkpoints_are_kept(tmp_path):
    """Also if the name of another stage begins in the same way."""
    run = create_run(tmp_path)
    kept = [run.checkpoint("a-b", 7), run.checkpoint("a", 999_999), run.checkpoint("a", 1_000_000)]
    for path in [*kept, *(run.checkpoint("a", iteration) for iteration in (20, 100, 1000, 3))]:
        path.parent.mkdir(exist_ok=True)
        path.touch()
    run.drop_old_checkpoints("a")
    assert [*run.checkpoints("a-b"), *run.checkpoints("a")] == kept
    assert sorted(kept[0].parent.iterdir()) == sorted(kept)


# Output paths


def test_places_that_cannot_be_written_are_named(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match=r"run cannot be made, because .*file is a file$"):
        check_output(tmp_path / "file" / "run")
    check_output(tmp_path / "file")
    if sys.platform == "linux":
        with pytest.raises(ValueError, match=r"^/proc/x cannot be made, because /proc is not writable: "):
            check_output(Path("/proc/x"))


def test_new_folders_on_several_levels_elsewhere_are_reported(tmp_path, monkeypatch):
    for path in (tmp_path, tmp_path / "run"):
        check_output(path)
    with pytest.warns(UserWarning, match="usb stick does not exist and will be made"):
        check_output(tmp_path / "usb stick" / "runs" / "run")
    monkeypatch.chdir(tmp_path)
    check_output(Path("runs/demo"))
    assert not list(tmp_path.iterdir())


def test_a_budget_for_few_gaussians_is_reported():
    assert not a2tg.A2tg(memory_budget="1MB").small_budget and not a2tg.A2tg().small_budget
    assert a2tg.A2tg(memory_budget="1kB").small_budget == (
        "memory_budget has room for 4 Gaussians of 232 bytes, and scenes need thousands: 2.32MB holds 10,000"
    )


def test_sizes_have_three_digits_and_a_suitable_unit():
    texts = {1: "1 byte", 999: "999 bytes", 9_996: "10.0 kB", 999_600: "1.00 MB", 2.5e6: "2.50 MB", 12.34e9: "12.3 GB"}
    assert {size: in_bytes(size) for size in texts} == texts and in_bytes(1234e9) == "1,234 GB"


def test_info_shows_what_is_intact_and_names_what_is_damaged(tmp_path):
    run = with_record(tmp_path / "run", RunRecord(SceneSource("synthetic"), "a2tg", A2tg()))
    run.metrics.write_text("{")
    run.model("a2tg-gaussians").parent.mkdir()
    run.model("a2tg-gaussians").write_bytes(b"PK")
    printed = describe_run(run)
    assert f"damaged  {run.metrics}" in printed and f"a2tg eval {run.path} rewrites it" in printed
    assert "a2tg-gaussians  damaged: " in printed and "a2tg-textures   not begun" in printed
    assert printed.endswith(f"training is not finished; continue with: a2tg train --out {run.path} --resume")


def test_info_of_a_folder_lists_its_runs(tmp_path, capsys):
    run = with_record(tmp_path / "b", RunRecord(SceneSource("synthetic")))
    other = with_record(tmp_path / "a", RunRecord(SceneSource("synthetic"), "a2tg", A2tg()))
    other.record.write_text("scene = {")
    run.viewer.write_bytes(b"12345")
    size = in_bytes(run.record.stat().st_size + run.marker.stat().st_size + 5)
    assert cli.main(["info", str(tmp_path)]) == 0
    damaged, begun = capsys.readouterr().out.splitlines()
    assert damaged.startswith("a ") and "is not valid TOML" in damaged
    assert re.split(r"  +", begun) == ["b", "bytewise", size, "not begun"]
    assert f"page     {run.viewer}, 5 bytes\ndisk     {size}" in describe_run(run)
    assert cli.main(["info", str(tmp_path), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert "is not valid TOML" in facts[0]["damage"] and facts[1]["damage"] is None


def test_info_of_a_folder_lists_runs_that_may_not_be_read(tmp_path, capsys, monkeypatch):
    """Runs of other users, and files that a training replaces meanwhile."""
    runs = [with_record(tmp_path / name, RunRecord(SceneSource("synthetic"), "a2tg", A2tg())) for name in "ab"]

    def read(run):
        if run.path.name == "a":
            raise PermissionError(13, "Permission denied", str(run.record))
        return read_record(run)

    monkeypatch.setattr(info, "read_record", read)
    assert cli.main(["info", str(tmp_path)]) == 0
    denied, begun = capsys.readouterr().out.splitlines()
    assert "Permission denied" in denied and str(runs[0].record) in denied and begun.endswith("not begun")


def test_info_of_a_folder_has_the_progress_of_begun_runs_and_those_of_make(tmp_path, capsys):
    runs = {}
    for name in ("first", "miku/run", "next"):
        runs[name] = with_record(tmp_path / name, RunRecord(SceneSource("synthetic"), "a2tg", A2tg()))
        runs[name].model(NAMES[0]).parent.mkdir()
        runs[name].checkpoint(NAMES[0], 201).parent.mkdir()
    runs["first"].checkpoint(NAMES[0], 201).touch()
    for name in ("miku/run", "next"):
        a2tg.save_model(runs[name].model(NAMES[0]), a_model())
    runs["next"].checkpoint(NAMES[1], 7).touch()
    assert cli.main(["info", str(tmp_path)]) == 0
    rows = [re.split(r"  +", line) for line in capsys.readouterr().out.splitlines()]
    assert [(name, system) for name, system, *_ in rows] == [(str(Path(name)), "a2tg") for name in runs]
    first, made, later = (row[-1] for row in rows)
    assert first.startswith(f"{NAMES[0]} after iteration 201 of ")
    assert made == f"{NAMES[0]} 3 Gaussians; 696 bytes"
    assert later.startswith(f"{NAMES[1]} after iteration 7 of ")


def test_a_folder_of_runs_is_answered_with_the_runs_to_give(tmp_path, capsys):
    made = with_record(tmp_path / "miku" / "run").path
    page = ["--web", str(tmp_path / "page")]
    for folder in (tmp_path, made.parent):
        for words in (
            ["render", folder],
            ["eval", folder],
            ["export", folder, *page],
            ["train", "--resume", "--out", folder],
        ):
            assert cli.main(list(map(str, words))) == 2
            wanted = (
                f"{folder} is not a run folder (it has no run.toml): it holds run folders; give one of them: {made}\n"
            )
            assert wanted in capsys.readouterr().err
        assert not (folder / ".a2tg-run").exists()


def test_folders_of_other_users_next_to_runs_are_passed_over(tmp_path, capsys, monkeypatch):
    """Such as lost+found on a disk."""
    with_record(tmp_path / "a", RunRecord(SceneSource("synthetic"), "a2tg", A2tg()))
    closed = tmp_path / "lost+found"
    closed.mkdir()
    stat = os.stat

    def denied(path, *arguments, **options):
        if closed in Path(str(path)).parents:
            raise PermissionError(13, "Permission denied", str(path))
        return stat(path, *arguments, **options)

    monkeypatch.setattr(os, "stat", denied)
    assert cli.main(["info", str(tmp_path)]) == 0
    assert capsys.readouterr().out.startswith("a  a2tg  ")
    assert cli.main(["render", str(tmp_path)]) == 2
    assert f"it holds run folders; give one of them: {tmp_path / 'a'}\n" in capsys.readouterr().err


@pytest.mark.parametrize("number", [errno.EACCES, errno.EROFS])
def test_measuring_in_a_folder_that_is_not_writable_asks_for_a_copy(tmp_path, capsys, monkeypatch, number):
    """Such as a run of another user, or one on a disk that is mounted to be read only."""
    run = with_record(tmp_path / "run", RunRecord(SceneSource("synthetic"), "a2tg", A2tg()))

    def denied(path, *arguments, **options):
        raise OSError(number, os.strerror(number), str(path))

    monkeypatch.setattr("a2tg_jax.results.folder.open", denied, raising=False)
    assert cli.main(["eval", str(run.path)]) == 2
    assert (
        f"{run.path} is not writable ({os.strerror(number)}): give a copy of this folder\n" in capsys.readouterr().err
    )


def test_info_is_json_on_request(tmp_path, capsys):
    run = with_record(tmp_path / "run", RunRecord(SceneSource("synthetic"), "a2tg", A2tg()))
    run.metrics.write_text(json.dumps({"models": {"a2tg-gaussians": {"test": {"psnr": 20.5}}}}))
    run.model("a2tg-gaussians").parent.mkdir()
    a2tg.save_model(run.model("a2tg-gaussians"), a_model())
    run.checkpoint("a2tg-textures", 40).parent.mkdir()
    run.checkpoint("a2tg-textures", 40).write_bytes(b"")
    assert cli.main(["info", str(run.path), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    first, second = facts["stages"]
    assert (facts["scene"], facts["is_finished"], facts["report"], facts["damage"]) == ("synthetic", False, None, None)
    assert first["state"] == "finished" and first["num_gaussians"] == 3 and first["psnr"] == {"test": 20.5}
    assert second["state"] == "in training" and second["iteration"] == 40 and second["psnr"] is None
    assert "a2tg-gaussians  3 Gaussians; 696 bytes; test 20.50 dB" in describe_run(run)


def test_info_of_a_file_says_what_it_holds(tmp_path, capsys):
    path = tmp_path / "a.ply"
    a2tg.save_ply(path, a_model())
    assert cli.main(["info", str(path)]) == 0
    size = in_bytes(path.stat().st_size)
    lines = [f"file     {path}, PLY, {size}", "model    3 Gaussians; 696 bytes; degree 3", "cameras  none"]
    assert capsys.readouterr().out.splitlines() == lines
    assert cli.main(["info", str(path), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["format"], facts["num_gaussians"], facts["num_bytes"], facts["num_cameras"]) == ("PLY", 3, 696, 0)


def a_model():
    return a2tg.Model(init_from_points(np.eye(3), np.full((3, 3), 0.5)))


@pytest.mark.parametrize(
    ("words", "mine", "message"),
    [
        (
            "export model.npz --web x.html",
            "x.html",
            "x.html exists; add --overwrite to replace it, or choose another --web",
        ),
        ("export model.npz --web site", "site/scene.a2tgz", "scene.a2tgz exists; add --overwrite"),
        ("export model.npz --web site", "site/photographs.json", "photographs.json exists"),
        ("compress model.npz --out x.a2tgz", "x.a2tgz", "x.a2tgz exists; add --overwrite"),
        ("mesh run", "run/mesh.glb", "mesh.glb exists; add --overwrite"),
        ("convert model.npz x.ply", "x.ply", "x.ply exists; add --overwrite"),
        ("export scene.ply --overwrite --single-file --web scene.ply", "", "the model itself; choose another --web"),
    ],
)
def test_files_are_not_replaced_without_a_flag(tmp_path, monkeypatch, capsys, words, mine, message):
    """Nor is another output of the same command written then."""
    monkeypatch.chdir(tmp_path)
    with_record(tmp_path / "run", RunRecord(SceneSource("synthetic")))
    a2tg.save_model("model.npz", a_model())
    a2tg.save_ply("scene.ply", a_model())
    if mine:
        Path(mine).parent.mkdir(exist_ok=True)
        Path(mine).write_text("mine")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert cli.main(words.split()) == 2
    assert re.search(message, capsys.readouterr().err)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_conversion_reports_what_ply_does_not_keep(tmp_path, capsys):
    appearance = allocate_appearance(movable_kernels(), jax.random.key(0), a_model().gaussians)
    model, lost = a2tg.Model(a_model().gaussians, appearance), "what MovableKernels shows besides Gaussians"
    for given, line in ((model, f"not kept by this format: {lost}\n"), (a_model(), "")):
        a2tg.save_model(tmp_path / "a.npz", given)
        assert cli.main(["convert", str(tmp_path / "a.npz"), "--overwrite", str(tmp_path / "a.ply")]) == 0
        world = "world: as in the source, which has no cameras to find the vertical by\n"
        assert capsys.readouterr().out.partition("\n")[2] == f"{line}{world}"


@pytest.mark.parametrize(("name", "is_export"), [("models/x.a2tgz", True), ("mesh.glb", True), ("models/x.npz", False)])
def test_exports_into_a_run_are_replaced_by_default_or_on_request(tmp_path, name, is_export):
    """Files that the run itself wrote are never replaced."""
    run = create_run(tmp_path)
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.touch()
    with pytest.raises(FileExistsError, match="add `overwrite`"):
        check_export(path, path, "--out", overwrite=False)
    run.own(path)
    check_export(path, path, "--out", overwrite=False)
    with contextlib.nullcontext() if is_export else pytest.raises(ValueError, match="belongs to the run"):
        check_export(path, tmp_path / "other", "--out", overwrite=True)


def test_the_mesh_of_a_run_is_replaced_by_default_once_the_command_has_written_it(tmp_path, monkeypatch):
    with_record(tmp_path, RunRecord(SceneSource("synthetic")))
    out = tmp_path / "mesh.glb"
    monkeypatch.setattr("a2tg_jax.results.model_source.open_source", lambda *_: None)
    monkeypatch.setattr("a2tg_jax.results.meshing.write_mesh", lambda source, out, *_: out.write_text("mesh"))
    out.write_text("mine")
    for words in (["--overwrite"], [], ["--out", str(out)]):
        assert cli.main(["mesh", str(tmp_path), *words]) == 0 and out.read_text() == "mesh"


# Records


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("scene = {", r"run\.toml: is not valid TOML"),
        ('system = "a2tg"', r"run\.toml: scene is missing"),
        ('scene = "a"\nscenes = "b"', r"run\.toml: scenes is an unknown key; did you mean scene\?"),
        ("scene = 3", r"run\.toml: scene must be str; got 3"),
        ('scene = "a"\ncompare = [1]', r"run\.toml: compare must be list of str; got \[1\]"),
        (
            'scene = "a"\n[options.details]\ncaps = 4',
            r"options\.details\.caps is an unknown key; did you mean cap\?",
        ),
        ('scene = "a"\n[options]\nseed = 0.5', r"run\.toml: options\.seed must be int; got 0\.5"),
        (
            'scene = "a"\n[options]\ndetails = 1',
            r"run\.toml: options\.details must hold the fields of Upscale",
        ),
        ('scene = "a"\n[options.details]\nat = ["1"]', r"run\.toml: options\.details\.at must be"),
        (
            'scene = "a"\n[options.details]\naxes = "both"',
            r"options\.details\.axes must be one of paper, authors",
        ),
        ('scene = "a"\nsystem = "b2tg"', "there is no system 'b2tg'; the systems are a2tg, "),
        ('scene = "a"\npreset = "fast"', "bytewise has the presets paper, .*; got 'fast'"),
        (
            'scene = "a"\n[options]\ninitial_opacity = 3',
            r"initial_opacity must .* got 3.0.*another version",
        ),
    ],
)
def test_wrong_record_is_one_clear_line(tmp_path, text, message):
    run = create_run(tmp_path)
    run.record.write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        read_record(run)
    assert "\n" not in str(caught.value)


def test_a_configuration_file_may_be_partial_and_its_paths_start_from_its_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "files").mkdir()
    file = Path("files/mine.toml")
    text = 'system = "a2tg"\npreset = "quick"\ninit = "a.ply"\n[options.texture]\nk_a = 9\nat = [0.25, 0.5]\n'
    file.write_text('scene = "../fox"\n' + text)
    record = read_run_file(file)
    assert record.scene == SceneSource(str(tmp_path / "fox")) and record.init == str(tmp_path / "files/a.ply")
    assert (record.options.stage1_iterations, record.options.densify.cap) == (1_500, 10_000)
    assert (record.options.texture.k_a, record.options.texture.at) == (9.0, (0.25, 0.5))
    assert all(isinstance(number, float) for number in (record.options.texture.k_a, *record.options.texture.at))
    file.write_text(f'scene = "synthetic"\ninit = "{tmp_path / "b.ply"}"\n')
    assert (read_run_file(file).scene.path, read_run_file(file).init) == ("synthetic", str(tmp_path / "b.ply"))
    (tmp_path / "files/cells").mkdir()
    file.write_text('scene = "./cells"\n')
    assert read_run_file(file).scene.path == str(tmp_path / "files/cells")
    file.write_text('scene = "cells"\n')
    with pytest.warns(UserWarning, match=r"cells is the built-in scene; give \./cells for the folder"):
        assert read_run_file(file).scene.path == "cells"


@pytest.mark.parametrize(
    ("name", "system", "compare", "preset"),
    [
        ("a2tg", A2tg.preset("quick"), ("gaussians-2d-mcmc", "textured-gaussians"), "quick"),
        ("a2tg", A2tg.preset("quick"), (), None),
        ("a2tg", A2tg(), (), "smoke"),
        (
            "a2tg",
            A2tg(
                texture=Upscale(select="budget", at=(0.1, 0.5), budget_mb=3.5), densify=Mcmc(cap=7),
                initial_gaussians=50, background="white", rates=LearningRates(quats=float("inf")),
            ),
            (),
            None,
        ),
        ("gaussians-2d", Gaussians2d(seed=5), ("gaussians-2d-mcmc",), None),
    ],
)  # fmt: skip
def test_command_repeats_the_run(tmp_path, monkeypatch, name, system, compare, preset):
    """run.toml holds every number, so other defaults, or a preset, change nothing; None where a preset has a value."""
    record = RunRecord(SceneSource(str(tmp_path / "a b"), downscale=4), name, system, compare, preset)
    run = with_record(tmp_path / "run c", record)
    assert read_run_file(run.record) == record
    assert tomllib.loads(run.record.read_text())["options"]["stage1_iterations"] == system.stage1_iterations
    program, command, *arguments = shlex.split(repeating_command(run))
    again = cli.parsed(command, arguments)
    assert (program, again.record, again.out) == ("a2tg", record, tmp_path / "run c-again")
    (run.path / "below").mkdir()
    for folder, place in ((run.path, "."), (run.path / "below", "..")):
        monkeypatch.chdir(folder)
        assert shlex.split(repeating_command(RunFolder(Path(place))))[-1] == str(tmp_path / "run c-again")
    assert again.record.systems == record.systems


LATER = ("empty_textures", "texture_share", "kernel_rate", "extent", "least")
"""Options of A²TG that version 0.3 lacks."""


@pytest.mark.parametrize("compare", [(), ("a2tg",)])
def test_a_run_of_an_earlier_version_lacks_what_its_preset_has_since(tmp_path, compare):
    """Version 0.3 trained "quick" with textures of one texel over ±3σ; resumed, evaluated and repeated it stays so."""
    off = {"empty_textures": False, "texture_share": None, "kernel_rate": None, "lookup": {"extent": 3.0}}
    main = Bytewise.preset("quick") if compare else A2tg.preset("quick", single_texel_rate=0.0, **off)
    compare_options = {"a2tg": {"single_texel_rate": 0.0, **off}} if compare else {}
    record = RunRecord(
        RECORD.scene, "bytewise" if compare else "a2tg", main, compare, "quick", compare_options=compare_options
    )
    run = with_record(tmp_path / "run", record)
    lines = run.record.read_text().splitlines()
    run.record.write_text("\n".join(line for line in lines if line.partition(" =")[0] not in LATER))
    earlier = read_record(run).systems["a2tg"]
    assert earlier == record.systems["a2tg"]
    assert earlier.stages()[1].appearance.texture_options.extent == 3.0 and earlier.kernel_rate is None
    assert parsed("--config", run.record).systems["a2tg"] == earlier
    # A file that somebody writes means the preset of today.
    written = tmp_path / "mine.toml"
    written.write_text('scene = "cells"\nsystem = "a2tg"\npreset = "quick"\n')
    assert read_run_file(written).options == A2tg.preset("quick") != earlier


def test_contradictions_are_named():
    larger = dataclasses.replace(RECORD.options.texture, cap=8)
    changed = dataclasses.replace(RECORD.options, seed=3, texture=larger)
    asked = dataclasses.replace(RECORD, scene=SceneSource("/scenes/a b", downscale=4), options=changed)
    assert contradictions(asked, RECORD) == ["downscale", "seed", "texture.cap"]
    assert contradictions(RECORD, RECORD) == []
    assert "system" in contradictions(dataclasses.replace(RECORD, system="gaussians-2d", options=Gaussians2d()), RECORD)


# Plans


def test_shared_stages_are_trained_once():
    main = A2tg.preset("quick", kernel_rate=None)
    kinds = {"baseline": Gaussians2dMcmc, "fixed": TexturedGaussians, "density": Gaussians2d}
    plan = plan_run({"main": main, **{label: like(kind, main) for label, kind in kinds.items()}})
    assert plan.names == (
        "main-gaussians", "main-textures", "baseline-continued", "fixed-textures", "density-gaussians",
        "density-continued",
    )  # fmt: skip
    assert plan.chains["fixed"] == ("main-gaussians", "fixed-textures")
    assert [planned.start for planned in plan.stages][1:4] == [plan["main-gaussians"]] * 3
    assert plan["density-continued"].first_iteration == 1_500
    shaped = A2tg.preset("quick")
    plan = plan_run({"main": shaped, "baseline": like(Gaussians2dMcmc, shaped)})
    assert plan.chains["baseline"] == ("baseline-gaussians", "baseline-continued"), "plain Gaussians have no shapes"


def test_stages_that_differ_are_not_shared():
    changes = {
        "seed": 1, "batch_size": 2, "initial_opacity": 0.2, "background": "white", "stage1_iterations": 7,
        "rates": LearningRates(sh_rest=1.0), "densify": Mcmc(cap=9), "coarse_share": 0.5,
    }  # fmt: skip
    assert len(plan_run({"a": A2tg(), "b": A2tg()}).stages) == 2
    for name, value in changes.items():
        assert len(plan_run({"a": A2tg(), "b": dataclasses.replace(A2tg(), **{name: value})}).stages) == 4, name


# Compared systems


COMPARED = dataclasses.replace(RECORD, compare=("bytewise", "gaussians-2d-mcmc"), preset="quick")


def parsed(*words) -> RunRecord:
    return cli.parsed("train", [*map(str, words), "--out", "again"]).record


def test_compared_systems_take_the_options(tmp_path, monkeypatch):
    text = "from a2tg_jax import A2tg\nfrom a2tg_jax.adapt import Upscale\nS = A2tg(texture=Upscale(anisotropic=False))"
    (tmp_path / "variants_of_mine.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    record = dataclasses.replace(RECORD, compare=("variants_of_mine:S", "textured-gaussians"))
    square, fixed = list(record.systems.values())[1:]
    assert list(record.systems) == ["a2tg", "S", "textured-gaussians"]
    square_textures = dataclasses.replace(RECORD.options.texture, anisotropic=False)
    assert square == dataclasses.replace(RECORD.options, texture=square_textures)
    assert (fixed.stage1_iterations, fixed.densify.cap) == (1_500, 10_000)
    assert dataclasses.replace(RECORD, compare=("bbsplat",)).systems["bbsplat"].billboard == BBSplat().billboard
    of_preset = dataclasses.replace(RECORD, compare=("bbsplat",), preset="quick").systems["bbsplat"]
    assert of_preset.billboard == BBSplat.preset("quick").billboard != BBSplat().billboard
    assert of_preset.densify.cap == RECORD.options.densify.cap
    with pytest.raises(ValueError, match="would be called 'a2tg'"):
        dataclasses.replace(RECORD, compare=("a2tg",)).check()


def test_options_that_the_main_system_lacks_stay_when_defaults_change(tmp_path, monkeypatch):
    before = COMPARED.systems["bytewise"]
    run = with_record(tmp_path, COMPARED)
    table = tomllib.loads(run.record.read_text())["compare_options"]
    assert set(table) == set(COMPARED.compare)
    assert "share" in table["bytewise"]["prune"] and "texel_rate" not in table["bytewise"]
    presets = {"quick": dataclasses.replace(before, prune=dataclasses.replace(before.prune, share=0.123))}
    monkeypatch.setattr(type(before), "presets", classmethod(lambda _: presets))
    assert COMPARED.systems["bytewise"].prune.share == 0.123
    assert read_record(run).systems["bytewise"] == before
    again = parsed("--config", run.record, "--seed", "3")
    assert again.systems["bytewise"] == dataclasses.replace(before, seed=3)


def test_options_of_compared_systems_take_precedence(tmp_path):
    """Plain Gaussians of degree 0 compared with A²TG of degree 3, whatever the flags for the main system."""
    other = {"bytewise": {"seed": 9, "rates": {"means": 0.5}}, "gaussians-2d-mcmc": {"sh_degree": 0}}
    record = dataclasses.replace(COMPARED, compare_options=other)
    run = with_record(tmp_path, record)
    assert read_record(run).systems == record.systems
    again = parsed("--config", run.record, "--sh-degree", "2").systems
    bytewise = again["bytewise"]
    assert (bytewise.seed, bytewise.rates.means, bytewise.sh_degree) == (9, 0.5, 2)
    assert (again["a2tg"].sh_degree, again["gaussians-2d-mcmc"].sh_degree) == (2, 0)


def test_a_configuration_file_may_set_options_of_compared_systems(tmp_path):
    file = tmp_path / "mine.toml"
    text = 'scene = "synthetic"\nsystem = "a2tg"\ncompare = ["bytewise"]\n'
    text += "[compare_options.bytewise.exponents]\nleast = 0.5\n"
    file.write_text(text)
    found = parsed("--config", file, "--seed", "3")
    assert found.systems["bytewise"].exponents.least == 0.5 and found.systems["bytewise"].seed == 3
    for preset in ("smoke", "paper"):
        other = parsed("--config", file, "--preset", preset)
        assert other.systems["bytewise"].exponents == Bytewise.preset(preset).exponents
    file.write_text(text.replace('compare = ["bytewise"]', ""))
    added = parsed("--config", file, "--compare", "bytewise")
    added.check()
    assert added.systems["bytewise"].exponents.least == 0.5
    with pytest.raises(ValueError, match=r"bytewise: the run does not compare this system: add it"):
        parsed("--config", file).check()


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("[compare_options.bytewise]\nexponents.leas = 1.0", r"bytewise\.exponents\.leas is an unknown key"),
        ("[compare_options.bytewise]\nexponents.least = []", r"bytewise\.exponents\.least must be float; got \[\]"),
        ("compare_options.bytewise = 3", r"compare_options\.bytewise must be a table of options; got 3"),
    ],
)
def test_wrong_options_of_compared_systems_are_named(tmp_path, table, message):
    (tmp_path / "mine.toml").write_text(f'scene = "synthetic"\nsystem = "a2tg"\ncompare = ["bytewise"]\n{table}\n')
    with pytest.raises(ValueError, match=message):
        parsed("--config", tmp_path / "mine.toml").check()


def test_a_resumed_run_takes_every_option_from_its_folder(tmp_path, capsys):
    record = dataclasses.replace(COMPARED, scene=SceneSource("synthetic"), compare=("bytewise",))
    run = with_record(tmp_path / "run", record)
    resumed = ["--out", str(run.path), "--resume"]
    assert cli.parsed("train", resumed).resumed(run) == read_record(run)
    cli.parsed("train", [*resumed, "--compare", "gaussians-2d-mcmc", "--on-nan", "restore"]).resumed(run)
    again = read_record(run)
    assert (again.compare, again.on_nan) == (("bytewise", "gaussians-2d-mcmc"), "restore")
    assert cli.main(["train", "--config", str(run.record), *resumed]) == 2
    assert "--resume takes every option from the run folder: leave out --config" in capsys.readouterr().err


# Summaries


def test_gains_are_over_the_compared_systems():
    result = some_result()
    assert result.main == "a2tg-textures" and result.before == ["a2tg-gaussians"]
    assert result.gains == pytest.approx({"gaussians-2d-mcmc-continued": 1.0})
    unfinished = dataclasses.replace(result, models={NAMES[0]: result.models[NAMES[0]]})
    assert (unfinished.main, unfinished.before, unfinished.gains) == ("a2tg-gaussians", [], {})


def test_metrics_hold_means_of_the_views():
    metrics = json.loads(json.dumps(metrics_json(some_result())))
    means = {"psnr": 24.0, "ssim": 0.6, "lpips": 0.5, "flat_psnr": 8.0, "views": 2}
    assert metrics["models"]["a2tg-textures"]["test"] == means
    assert metrics["lpips_network"] == "alex" and metrics["gains_db"] == {"gaussians-2d-mcmc-continued": 1.0}
    assert metrics["models"]["a2tg-textures"]["num_bytes"] == 28_000
    assert per_view_json(some_result())["a2tg-gaussians"]["train"]["c.png"]["psnr"] == 22


def test_summary_has_a_column_for_each_model_and_fits_the_terminal():
    wide, narrow = (summary_text(some_result(), width).splitlines() for width in (80, 48))
    assert re.split(r"\s{2,}", wide[0])[1:] == NAMES
    assert wide[1].split() == ["test", "PSNR", "(dB)", "21.00", "24.00", "23.00"]
    table = narrow[: len(narrow) - 2]
    assert max(map(len, table)) <= 48 and table.count("") == 1
    assert sum(line.count("dB)") for line in table) == 2 * sum(line.count("dB)") for line in wide)
    assert narrow[-2:] == wide[-2:]


@pytest.mark.parametrize(
    ("own", "other", "expected"),
    [
        (330_000, 220_000, "with 1.5 times its bytes (0.33 MB and 0.22 MB)"),
        (500_000, 1_000_000, "with 0.50 times its bytes (0.50 MB and 1.00 MB)"),
        (1_020_000, 1_000_000, "with 1.02 times its bytes (1.02 MB and 1.00 MB)"),
        (1_010_000, 1_000_000, "at equal bytes (1.01 MB)"),
        (0, 0, "at equal bytes (0.00 MB)"),
    ],
)
def test_gains_name_the_bytes_that_they_cost(own, other, expected):
    sizes, models = {"a2tg-textures": own, "gaussians-2d-mcmc-continued": other}, some_result().models
    models = {name: dataclasses.replace(found, num_bytes=sizes.get(name, 1)) for name, found in models.items()}
    result = dataclasses.replace(some_result(), models=models)
    line = f"a2tg-textures: +1.00 dB over gaussians-2d-mcmc-continued, {expected}"
    assert summary_text(result).splitlines()[-1] == line


def test_the_summary_has_shares_of_budgets_and_published_bytes_if_there_are_any():
    plain, system = some_result(), dataclasses.replace(RECORD.options, memory_budget="28.1kB")
    assert "published" not in summary_text(plain) and "budget" not in summary_text(plain)
    within = some_result(dataclasses.replace(RECORD, options=system))
    assert "a2tg-textures takes 28,000 bytes of its budget of 28,100 (99.64 %)" in summary_text(within)
    counted = dataclasses.replace(plain.models[NAMES[1]], num_published_bytes=20_000)
    text = summary_text(dataclasses.replace(plain, models={**plain.models, NAMES[1]: counted}))
    assert re.search(r"as published \(MB\) +0\.02\n", text)


def test_the_summary_has_durations_in_words():
    result = some_result()
    seconds = dict(zip(NAMES, (4.4, 65, 3720), strict=True))
    models = {name: dataclasses.replace(result.models[name], seconds=seconds[name]) for name in NAMES}
    line = re.search("time of the stage +(.*)", summary_text(dataclasses.replace(result, models=models), 120))
    assert re.split("  +", line[1]) == ["4 s", "1 min 5 s", "1 h 2 min"]


# Histories


def test_sizes_are_of_files_that_exist(tmp_path):
    result, run = some_result(), create_run(tmp_path)
    assert sizes_line(run, result) == "size of a2tg-textures: 28.0 kB in memory"
    run.viewer.write_bytes(bytes(500_000))
    path = run.model(result.main).with_suffix(".a2tgz")
    path.parent.mkdir()
    path.write_bytes(bytes(4_000))
    sizes = "500 kB as a page (viewer.html), 4.00 kB compressed (a2tg-textures.a2tgz)"
    assert sizes_line(run, result) == f"size of a2tg-textures: 28.0 kB in memory, {sizes}"


@pytest.mark.parametrize(
    "train, ending", [(24, "are about as good"), (26, "the photographs are somewhat worse"), (27, "take more")]
)
def test_one_line_says_what_the_photographs_allow(train, ending):
    result = some_result()
    main = result.models[result.main]
    views = tuple(dataclasses.replace(view, psnr=float(train)) for view in main.train.per_view)
    seen = dataclasses.replace(main.train, per_view=views)
    measured = dataclasses.replace(main, splits=main.splits | {"train": seen})
    text = summary_text(dataclasses.replace(result, models=result.models | {result.main: measured}))
    assert re.search(rf"^{train}\.0 dB on training views, 24\.0 held out: .*{ending}$", text, re.MULTILINE)


def test_history_round_trip_with_loss_terms(tmp_path):
    """One of two stages has a term that the other lacks."""
    one = with_row(some_history(num=2), 1, 3, 0.3, 20.0, 5, 0.1, 2.0, l1=0.25, roughness=0.05)
    both = one.followed_by(with_row(some_history(num=1), 2, 2, 0.2, 20.0, 5, 0.1, 2.0, l1=0.2))
    for history in (some_history(), both):
        write_history(tmp_path / "h.csv", history)
        found = read_history(tmp_path / "h.csv").to_dict()
        assert found.keys() == history.to_dict().keys()
        for name, column in history.to_dict().items():
            np.testing.assert_array_equal(found[name], column)
    first, *_, last = (tmp_path / "h.csv").read_text().splitlines()
    assert first.endswith(",seconds,loss_l1,loss_roughness") and last.endswith(",2.0,0.2,nan")


def written_for_tensorboard(run, *histories, skipped=None):
    writer = EventWriter(run, "a2tg-gaussians")
    if skipped is not None:
        writer.skip(skipped)
    for history in histories:
        writer.add(history)
    writer.close()


@needs_tensorboard
def test_tensorboard_gets_each_row_once(tmp_path):
    """A file has the new rows of each call; another process adds the rows after the checkpoint."""
    run = RunFolder(tmp_path)
    wanted = with_row(some_history(num=9), 1, 10, 0.3, 20.0, 5, 0.1, 2.0, l1=0.25)
    written_for_tensorboard(run, some_history(num=3), some_history(num=3), some_history(num=7))
    written_for_tensorboard(run, wanted, skipped=some_history(num=7))
    found = tensorboard_scalars(run.tensorboard)
    assert found.pop("loss_l1/a2tg-gaussians") == [(10, 0.25)]
    columns = ("loss", "psnr", "num_gaussians", "megabytes", "seconds")
    assert set(found) == {f"{column}/a2tg-gaussians" for column in columns}
    for column in columns:
        steps, values = zip(*found[f"{column}/a2tg-gaussians"], strict=True)
        assert steps == (*range(1, 11),)
        np.testing.assert_allclose(values, getattr(wanted, column), rtol=1e-6)
    assert sorted(run.files()) == sorted(run.tensorboard.iterdir())
    run.clear()
    assert not run.tensorboard.exists()


def test_without_tensorboard_one_line_says_what_to_do(monkeypatch, tmp_path, capsys, untouched_jax):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    assert cli.main(["train", "synthetic", "--out", str(tmp_path / "run"), "--tensorboard"]) == 2
    line = (
        "a2tg: error: --tensorboard needs tensorboardX, which is not installed: pip install 'a2tg-jax[tensorboard]'\n"
    )
    assert capsys.readouterr().err == line and not (tmp_path / "run").exists()


# The path


def test_path_is_smooth_and_stays_near_the_cameras():
    path = smooth_path(circle(12), 60)
    viewmats = np.stack([np.asarray(camera.viewmat, np.float64) for camera in path])
    rotations = viewmats[:, :3, :3]
    centers = -np.einsum("nji,nj->ni", rotations, viewmats[:, :3, 3])
    eyes = np.broadcast_to(np.eye(3), (60, 3, 3))
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), eyes, atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-6)
    assert np.all(np.abs(np.linalg.norm(centers, axis=1) - 1.8) < 0.3)
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    assert steps.max() < 1.1 * steps.min()
    towards = np.einsum("ni,ni->n", rotations[:, 2], -centers / np.linalg.norm(centers, axis=1, keepdims=True))
    assert towards.min() > 0.95
    with pytest.raises(ValueError, match="two cameras"):
        smooth_path(circle(1), 10)
