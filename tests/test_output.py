"""Output paths are checked before any work, and `a2tg info` reports what a folder holds."""

import contextlib
import json
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from run_folders import create_run

import a2tg_jax as a2tg
from a2tg_jax.appearance import MovableKernels, allocate_appearance
from a2tg_jax.cli import main as cli, runs
from a2tg_jax.core.gaussians import init_from_points
from a2tg_jax.host.text import in_bytes
from a2tg_jax.results.folder import check_export, check_new, check_output
from a2tg_jax.results.info import describe_run
from a2tg_jax.results.record import RunRecord, SceneSource, write_record


def test_places_that_cannot_be_written_are_named(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match=r"run cannot be made, for .*file is a file$"):
        check_output(tmp_path / "file" / "run")
    check_output(tmp_path / "file")
    if sys.platform == "linux":
        with pytest.raises(ValueError, match=r"^/proc/x cannot be made, for nothing can be written in /proc: "):
            check_output(Path("/proc/x"))


def test_new_folders_on_several_levels_elsewhere_are_reported(tmp_path, monkeypatch, capsys):
    for path in (tmp_path, tmp_path / "run"):
        check_output(path)
    assert capsys.readouterr().err == ""
    check_output(tmp_path / "usb stick" / "runs" / "run")
    assert capsys.readouterr().err == f"a2tg: {tmp_path / 'usb stick'} does not exist and will be made\n"
    monkeypatch.chdir(tmp_path)
    check_output(Path("runs/demo"))
    assert capsys.readouterr().err == "" and not list(tmp_path.iterdir())


def test_a_budget_for_few_gaussians_is_reported():
    assert not a2tg.A2tg(memory_budget="1MB").small_budget and not a2tg.A2tg().small_budget
    assert a2tg.A2tg(memory_budget="1kB").small_budget == "memory_budget has room for 4 Gaussians of 232 bytes"


def test_sizes_have_three_digits_and_a_suitable_unit():
    texts = {1: "1 byte", 999: "999 bytes", 9_996: "10.0 kB", 999_600: "1.00 MB", 2.5e6: "2.50 MB", 12.34e9: "12.3 GB"}
    assert {size: in_bytes(size) for size in texts} == texts and in_bytes(1234e9) == "1,234 GB"


def test_info_shows_what_is_intact_and_names_what_is_damaged(tmp_path):
    run = create_run(tmp_path / "run")
    write_record(run, RunRecord(SceneSource("synthetic"), "a2tg", a2tg.A2tg()))
    run.metrics.write_text("{")
    run.model("a2tg-gaussians").parent.mkdir()
    run.model("a2tg-gaussians").write_bytes(b"PK")
    told = describe_run(run)
    assert f"damaged  {run.metrics}" in told and f"a2tg eval {run.path} rewrites it" in told
    assert "a2tg-gaussians  damaged: " in told and "a2tg-textures   not begun" in told
    assert told.endswith(f"training is not finished; continue with: a2tg train --out {run.path} --resume")


def test_info_is_json_on_request(tmp_path, capsys):
    run = create_run(tmp_path / "run")
    write_record(run, RunRecord(SceneSource("synthetic"), "a2tg", a2tg.A2tg()))
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


def a_model():
    return a2tg.Model(init_from_points(np.eye(3), np.full((3, 3), 0.5)))


@pytest.mark.parametrize(
    ("command", "name"), [("export {} --ply", "x.ply"), ("export {} --web", "x.html"), ("compress {} --out", "x.a2tgz")]
)
def test_a_file_is_not_replaced_unasked(tmp_path, capsys, command, name):
    model, out = tmp_path / "model.npz", tmp_path / name
    a2tg.save_model(model, a_model())
    out.write_text("mine")
    words = [*command.format(model).split(), str(out)]
    assert cli.main(words) == 2
    assert f"{name} exists; add --overwrite to replace it, or choose another {words[2]}" in capsys.readouterr().err
    assert out.read_text() == "mine"
    if name == "x.ply":
        assert cli.main([*words, "--overwrite"]) == 0 and out.read_bytes().startswith(b"ply")


@pytest.mark.parametrize("words", ["--ply", "--single-file --web"])
def test_export_does_not_replace_what_it_reads(tmp_path, capsys, words):
    source = tmp_path / "scene.ply"
    a2tg.save_ply(source, a_model())
    before = source.read_bytes()
    assert cli.main(["export", str(source), "--overwrite", *words.split(), str(source)]) == 2
    assert f"scene.ply is the model itself; choose another {words.split()[-1]}" in capsys.readouterr().err
    assert source.read_bytes() == before


def test_export_tells_what_ply_does_not_keep(tmp_path, capsys):
    appearance = allocate_appearance(MovableKernels(), jax.random.key(0), a_model().gaussians)
    model = a2tg.Model(a_model().gaussians, appearance)
    for name, given in (("kernels", model), ("plain", a_model())):
        a2tg.save_model(tmp_path / f"{name}.npz", given)
        out = tmp_path / f"{name}.compressed.ply"
        assert cli.main(["export", str(tmp_path / f"{name}.npz"), "--ply", str(out)]) == 0
        told = "not kept by this format: what MovableKernels shows besides Gaussians\n" * (given is model)
        assert capsys.readouterr().out == f"file: {out}: 3 Gaussians\n{told}"


@pytest.mark.parametrize("name", ["scene.a2tgw", "photographs.json"])
def test_no_file_of_a_page_is_replaced_unasked(tmp_path, capsys, name):
    """Nor is another output of the same command written then."""
    model, site = tmp_path / "model.npz", tmp_path / "site"
    a2tg.save_model(model, a_model())
    site.mkdir()
    (site / name).write_text("mine")
    assert cli.main(["export", str(model), "--ply", str(site / "x.ply"), "--web", str(site)]) == 2
    assert f"{name} exists; add --overwrite to replace it, or choose another --web" in capsys.readouterr().err
    assert [(path.name, path.read_text()) for path in site.iterdir()] == [(name, "mine")]


@pytest.mark.parametrize(("name", "is_export"), [("models/x.a2tgz", True), ("mesh.glb", True), ("models/x.npz", False)])
def test_exports_into_a_run_are_replaced_by_default_or_if_asked(tmp_path, name, is_export):
    """Files that the run itself wrote are not, even if asked."""
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
    if is_export:
        with pytest.raises(FileExistsError, match="add `overwrite`"):
            check_new(path, "OUT", overwrite=False)


def test_the_mesh_of_a_run_is_replaced_unasked_once_it_was_written_so(tmp_path, monkeypatch, capsys):
    write_record(create_run(tmp_path), RunRecord(SceneSource("synthetic"), "a2tg", a2tg.A2tg()))
    out = tmp_path / "mesh.glb"
    monkeypatch.setattr(runs, "open_source", lambda *_: None)
    monkeypatch.setattr(runs, "write_mesh", lambda source, out, options: out.write_text("mesh"))
    out.write_text("mine")
    assert cli.main(["mesh", str(tmp_path)]) == 2 and out.read_text() == "mine"
    assert "mesh.glb exists; add --overwrite" in capsys.readouterr().err
    for words in (["--overwrite"], [], ["--out", str(out)]):
        assert cli.main(["mesh", str(tmp_path), *words]) == 0 and out.read_text() == "mesh"
