"""Textures that cover another area than ±3σ: in files, in files of earlier versions, joined with others, and baked."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from run_folders import RECORD, create_run
from small_files import put_together, read_archive, taken_apart, write_archive
from small_models import assert_same_rule, some_checkpoint, some_model

import a2tg_jax as a2tg
from a2tg_jax.cli.main import main
from a2tg_jax.io.web_scene import encode_web_scene
from a2tg_jax.results.record import read_record, write_record

NARROW = a2tg.TextureOptions(outside="identity", extent=1.5)
SYSTEM = a2tg.A2tg(sh_degree=0, lookup=NARROW)
WRONG = {
    0: "at least 0.001",
    -1.5: "at least 0.001",
    1e9: "at most 1000",
    "wide": "must be float",
    True: "must be float",
}
FORMATS = ["model.npz", "model.a2tgz", "model.gltf", "web.a2tgz", "checkpoint.npz"]


def write(path: Path) -> None:
    """A file of textures of half the extent."""
    if path.name == "checkpoint.npz":
        a2tg.save_checkpoint(path, some_checkpoint(SYSTEM))
    elif path.name == "web.a2tgz":
        path.write_bytes(encode_web_scene(some_model(SYSTEM)))
    else:
        a2tg.save_splats(path, some_model(SYSTEM))


def appearance_in(path: Path) -> a2tg.Appearance:
    if path.name == "checkpoint.npz":
        checkpoint = a2tg.load_checkpoint(path)
        assert checkpoint.system.lookup == checkpoint.state.model.appearance.texture_options
        return checkpoint.state.model.appearance
    return a2tg.load_splats(path).appearance


def put(node: object, extent: object) -> int:
    """Set the extent wherever options of a texture lookup are, or remove it (None), and return the number of places."""
    if isinstance(node, list):
        return sum(put(each, extent) for each in node)
    if not isinstance(node, dict):
        return 0
    is_place = "outside" in node
    if is_place:
        node.pop("extent")
        node |= {} if extent is None else {"extent": extent}
    return is_place + sum(put(each, extent) for each in node.values())


def rewrite(path: Path, extent: object) -> None:
    if path.suffix == ".npz":
        header, arrays = read_archive(path)
        assert put(header, extent)
        write_archive(path, header, arrays)
    elif path.suffix == ".a2tgz":
        header, body = taken_apart(path.read_bytes())
        assert put(header, extent)
        path.write_bytes(put_together(header, body))
    else:
        described = json.loads(path.read_text())
        assert put(described, extent) == 2, "the extension and the extras"
        path.write_text(json.dumps(described))


@pytest.mark.parametrize("name", FORMATS)
def test_files_keep_it_and_mean_3_without_it(tmp_path, name):
    path = tmp_path / name
    write(path)
    assert appearance_in(path).texture_options == NARROW
    rewrite(path, None)
    assert appearance_in(path).texture_options == dataclasses.replace(NARROW, extent=3.0)


@pytest.mark.parametrize("name", FORMATS)
def test_files_with_a_wrong_one_are_refused(tmp_path, name):
    path = tmp_path / name
    write(path)
    for extent, words in WRONG.items():
        rewrite(path, extent)
        with pytest.raises(ValueError, match=rf"extent must be .*{words.removeprefix('must be ')}"):
            appearance_in(path)


def test_run_folders_keep_it_and_mean_3_without_it(tmp_path):
    run = create_run(tmp_path / "run")
    write_record(run, dataclasses.replace(RECORD, options=SYSTEM))
    assert read_record(run).options.lookup == NARROW
    written = run.record.read_text()
    run.record.write_text(written.replace("extent = 1.5\n", ""))
    assert run.record.read_text() != written and read_record(run).options.lookup.extent == 3.0
    run.record.write_text(written.replace("extent = 1.5\n", "extent = -1.5\n"))
    with pytest.raises(ValueError, match=r"run\.toml: extent must be at least 0\.001 and at most 1000; got -1\.5"):
        read_record(run)


def test_models_of_two_extents_are_not_joined():
    narrow = some_model(SYSTEM)
    wide = some_model(a2tg.A2tg(sh_degree=0))
    assert a2tg.concatenate([narrow, narrow]).appearance.texture_options == NARROW
    with pytest.raises(
        ValueError, match=r"one extent; got 1\.5 and 3: train them with the same lookup\.extent, or convert"
    ):
        a2tg.concatenate([narrow, wide])


def test_info_says_it(tmp_path, capsys):
    a2tg.save_model(tmp_path / "m.npz", some_model(SYSTEM))
    assert main(["info", str(tmp_path / "m.npz")]) == 0
    assert "textures over ±1.5σ 1×1: 12" in capsys.readouterr().out


def test_rows_a_transform_and_an_edit_keep_it():
    model = some_model(SYSTEM)
    moved = model.transform(a2tg.Similarity(2.0, np.eye(3), np.ones(3)))
    edited = a2tg.apply_edit(model, a2tg.Edit(floaters=0.5))
    for changed in (model[:5], moved, edited):
        assert_same_rule(changed, model)
