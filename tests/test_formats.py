"""Formats of other programs: what is read back after writing, what each keeps, and the conversion of files."""

import base64
import dataclasses
import json
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from run_folders import create_run
from small_files import write_archive
from small_models import assert_same_rule, movable_kernels, with_bands
from small_values import some_gaussians

from a2tg_jax import (
    A2tg,
    Appearance,
    Camera,
    Exponents,
    Gaussians2d,
    Model,
    Origin,
    Similarity,
    Texture,
    allocate_appearance,
    init_from_points,
    load_model,
    load_ply,
    load_splats,
    save_model,
    save_ply,
    save_splats,
    synthetic_scene,
    transform_gaussians,
)
from a2tg_jax.cli.main import main
from a2tg_jax.io.formats import FORMATS, file_bytes, format_of, lost_by, unseen_elsewhere
from a2tg_jax.model_file import number_in_file
from a2tg_jax.results import model_source, run_training
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.model_source import check_init, write_first_stage
from a2tg_jax.results.record import RunRecord, SceneSource, read_record, write_record
from a2tg_jax.results.run_training import RunOptions, begin_run

CODED = [".compressed.ply", ".spz", ".sog", ".splat", ".ksplat"]
OTHERS = [".ply", *CODED]
TEXTURES = "textures (bake turns them into plain splats)"
CUT = "colours of 1 Gaussian beyond the format's range (cut)"
RNG = np.random.default_rng(0)


def textured() -> Model:
    """Textures of one texel that change nothing."""
    return showing(Appearance(texture=Texture()))


def showing(template: Appearance) -> Model:
    return Model(some_gaussians(), allocate_appearance(template, jax.random.key(0), some_gaussians()))


def small_scene() -> Model:
    """Gaussians with colours that bytes can hold, far enough apart to be told by their places."""
    gaussians = some_gaussians(300)
    unit = gaussians.quats / jnp.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    sh = jnp.asarray(RNG.normal(size=gaussians.sh.shape) * 0.1, jnp.float32)
    return Model(dataclasses.replace(gaussians, quats=unit, log_scales=gaussians.log_scales - 3, sh=sh))


def matched(found: Model, model: Model) -> Model:
    """The rows of a model in the order of another, whose means are nearest."""
    apart = np.asarray(found.gaussians.means)[:, None] - np.asarray(model.gaussians.means)
    return found[np.linalg.norm(apart, axis=-1).argmin(axis=0)]


@pytest.mark.parametrize("suffix", OTHERS)
def test_splats_come_back_from_files_of_other_programs(tmp_path, suffix):
    model = small_scene()
    save_splats(tmp_path / f"a{suffix}", model)
    found = matched(load_splats(tmp_path / f"a{suffix}"), model).gaussians
    own = model.gaussians
    dots = np.sum(np.asarray(found.quats) * np.asarray(own.quats), axis=1)
    np.testing.assert_allclose(found.means, own.means, atol=5e-3)
    np.testing.assert_allclose(np.abs(dots), 1, atol=1e-3)
    np.testing.assert_allclose(found.log_scales, own.log_scales, atol=0.04)
    np.testing.assert_allclose(found.opacities, own.opacities, atol=5e-3)
    np.testing.assert_allclose(found.sh[:, 0], own.sh[:, 0], atol=0.02)
    degree = FORMATS[suffix].highest_degree
    assert found.sh_degree == degree
    np.testing.assert_allclose(found.sh[:, 1:], own.sh[:, 1 : (degree + 1) ** 2], atol=0.07)


def test_compressed_ply_and_sog_say_that_splats_are_flat(tmp_path):
    save_splats(tmp_path / "a.compressed.ply", small_scene())
    assert b"\ncomment SplatRenderMode: 2dgs\n" in (tmp_path / "a.compressed.ply").read_bytes()[:200]
    save_splats(tmp_path / "a.sog", small_scene())
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        assert json.loads(archive.read("meta.json"))["model"] == "2dgs"


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".spz", ".sog"])
def test_gaussforge_reads_our_files_as_we_do(tmp_path, suffix):
    """It shares no code with this library."""
    gaussforge = pytest.importorskip("gaussforge", reason="gaussforge is not installed")
    save_splats(tmp_path / f"a{suffix}", small_scene())
    own = load_splats(tmp_path / f"a{suffix}").gaussians
    read = gaussforge.GaussForge().read((tmp_path / f"a{suffix}").read_bytes(), suffix[1:])["data"]
    names = ("positions", "alphas", "colors", "scales", "rotations")
    means, logits, colors, scales, quats = (np.frombuffer(read[name], "<f4").reshape(own.num, -1) for name in names)
    np.testing.assert_allclose(means, own.means, atol=1e-6)
    np.testing.assert_allclose(colors, own.sh[:, 0], atol=1e-5)
    np.testing.assert_allclose(1 / (1 + np.exp(-logits[:, 0].astype(np.float64))), own.opacities, atol=2e-6)
    np.testing.assert_allclose(scales[:, :2], own.log_scales, atol=1e-5)
    assert scales[:, 2].max() < scales[:, :2].min()
    np.testing.assert_allclose(np.abs(np.sum(quats * np.asarray(own.quats), axis=1)), 1, atol=1e-3)
    rest = np.frombuffer(read["sh"], "<f4").reshape(own.num, own.sh.shape[1] - 1, 3)
    # Bins of compressed PLY are decoded at their centres by us, and by gaussforge at their ends.
    np.testing.assert_allclose(rest, own.sh[:, 1:], atol=0.02 if suffix == ".compressed.ply" else 1e-5)


def test_positions_beyond_a_format_are_refused_or_told(tmp_path):
    path = tmp_path / "a.spz"
    near = small_scene()
    means = near.gaussians.means.at[0].add(4100).at[1].add(-2050)  # No other origin has all within reach.
    far = dataclasses.replace(near, gaussians=dataclasses.replace(near.gaussians, means=means))
    with pytest.raises(ValueError, match=r"holds positions up to 2048 units.*write \*\.ply or"):
        save_splats(path, far)
    assert not path.exists()
    shrunk = transform_gaussians(near.gaussians, Similarity(1e-2, np.eye(3), np.zeros(3)))
    with pytest.warns(UserWarning, match=r"a\.spz: positions are rounded by .* or enlarge the scene"):
        save_splats(path, Model(shrunk))
    spread = dataclasses.replace(near.gaussians, means=near.gaussians.means * 500_000)
    with pytest.warns(UserWarning, match=r"a\.sog: positions are rounded by .*; write \*\.ply$"):
        save_splats(tmp_path / "a.sog", Model(spread))


@pytest.mark.parametrize(("suffix", "num"), [(".spz", 5), (".splat", 3), (".ksplat", 3), (".compressed.ply", 2)])
def test_cut_colours_and_scales_are_counted(tmp_path, suffix, num):
    """The count is that of the Gaussians that come back changed."""
    g = small_scene().gaussians
    sh = g.sh.at[:3, 0, 0].set(4).at[3:5, 15, 2].set(-5)
    g = dataclasses.replace(g, log_scales=g.log_scales.at[:2].set(-10.5), sh=sh)
    save_splats(tmp_path / f"a{suffix}", Model(g))
    found = matched(load_splats(tmp_path / f"a{suffix}"), Model(g)).gaussians
    changed = np.abs(np.asarray(found.sh) - np.asarray(sh)[:, : found.sh.shape[1]]) > 0.3
    lost = lost_by(Model(g), Path(f"a{suffix}"))
    assert np.count_nonzero(changed.any(axis=(1, 2))) == num
    assert f"colours of {num} Gaussians beyond the format's range (cut)" in lost
    printed = "scales of 2 Gaussians beyond the format's range (cut)"
    assert (printed in lost) == (suffix == ".spz") == bool(np.abs(found.log_scales - g.log_scales).max() > 0.4)


@pytest.mark.parametrize("suffix", CODED)
def test_a_file_without_gaussians_is_refused(tmp_path, suffix):
    with pytest.raises(ValueError, match="has no Gaussians"):
        save_splats(tmp_path / f"a{suffix}", Model(some_gaussians(3)[:0]))


def test_what_a_format_does_not_keep():
    world = Similarity(2.0, np.eye(3), np.zeros(3))
    camera = Camera(jnp.eye(4), jnp.eye(3), 8, 8)
    model = dataclasses.replace(textured(), origin=Origin.of_cameras([camera], transform=world))
    assert lost_by(model, Path("a.npz")) == []
    assert lost_by(model, Path("a.ply")) == [TEXTURES, "cameras and background"]
    assert lost_by(model, Path("a.SPZ")) == [TEXTURES, CUT, "cameras and background", "last digits"]
    assert "spherical harmonics above degree 2" in lost_by(Model(some_gaussians()), Path("a.ksplat"))
    assert lost_by(Model(some_gaussians(), background=(1.0, 1.0, 1.0)), Path("a.ply")) == ["background"]
    assert lost_by(Model(some_gaussians()), Path("a.splat")) == ["spherical harmonics above degree 0", "last digits"]
    # Where splats differ in degree, the highest counts.
    dense = some_gaussians()
    base = Model(dataclasses.replace(dense, sh=dense.sh[:, :1]))
    banded = with_bands(base, dense.sh[:, 1:], [0, 1, 2, 2, 1, 0, 0])
    assert lost_by(banded, Path("a.ksplat")) == ["last digits"]
    assert lost_by(banded, Path("a.splat")) == ["spherical harmonics above degree 0", "last digits"]
    shaped = showing(Appearance(texture=Texture(), exponents=Exponents()))
    assert lost_by(shaped, Path("a.ply")) == ["textures and shapes of kernels (bake turns them into plain splats)"]
    assert lost_by(shaped, Path("a.glb")) == lost_by(shaped, Path("a.a2tgz")) == ["last digits"]
    unseen = "textures and shapes of kernels (bake turns them into plain splats)"
    assert unseen_elsewhere(shaped, Path("a.glb")) == unseen
    assert unseen_elsewhere(shaped, Path("a.a2tgz")) == unseen_elsewhere(Model(some_gaussians()), Path("a.glb")) == ""
    kernels = showing(Appearance(exponents=Exponents()))
    assert lost_by(kernels, Path("a.usda"))[0] == "shapes of kernels (bake turns them into plain splats)"
    found = lost_by(showing(movable_kernels(exponents=Exponents())), Path("a.ply"))
    assert found == [lost_by(kernels, Path("a.ply"))[0], "what MovableKernels shows besides Gaussians"]
    learned = {"exposure": np.zeros((0, 3, 4)), "pose": np.zeros((0, 6))}
    model = Model(some_gaussians(), origin=dataclasses.replace(model.origin, corrections=learned))
    assert lost_by(model, Path("a.npz")) == []
    assert lost_by(model, Path("a.glb")) == ["learned exposures", "learned motions of cameras", "last digits"]
    assert format_of(Path("a.compressed.ply")).name != format_of(Path("a.ply")).name
    with pytest.raises(ValueError, match=r"known are \.npz"):
        format_of(Path("a.xyz"))


@pytest.mark.parametrize("data", [b"", b"glXF\x02\xb0\xff", b"{"])
def test_files_that_are_no_gltf_are_refused_in_plain_words(tmp_path, data):
    path = tmp_path / "a.glb"
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"a\.glb: is not glTF, or is damaged"):
        load_splats(path)


def test_convert_on_the_command_line(tmp_path, capsys):
    save_model(tmp_path / "a.npz", textured())
    assert main(["convert", str(tmp_path / "a.npz"), str(tmp_path / "b.ply")]) == 0
    printed = capsys.readouterr().out
    assert f"not kept by this format: {TEXTURES}\n" in printed and "times)" in printed
    assert main(["convert", str(tmp_path / "b.ply"), str(tmp_path / "c.npz")]) == 0
    np.testing.assert_array_equal(load_model(tmp_path / "c.npz").gaussians.means, load_ply(tmp_path / "b.ply").means)
    assert main(["convert", str(tmp_path / "b.ply"), str(tmp_path / "b.ply")]) == 2
    assert "is the source" in capsys.readouterr().err
    assert main(["convert", str(tmp_path / "b.ply"), str(tmp_path / "c.xyz")]) == 2
    assert "unknown suffix" in capsys.readouterr().err


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_textures_and_origin_pass_through_gltf(tmp_path, capsys, suffix):
    """There and back by the command, with the bytes of the buffer beside a *.gltf."""
    model = dataclasses.replace(
        textured(), origin=Origin.of_cameras([], transform=Similarity(2.0, np.eye(3), np.arange(3.0)))
    )
    save_model(tmp_path / "a.npz", model)
    main(["convert", str(tmp_path / "a.npz"), str(tmp_path / f"b{suffix}")])
    assert "not kept by this format: last digits\n" in (printed := capsys.readouterr().out) and "(0." not in printed
    assert f"not shown by other programs: {TEXTURES}\n" in printed
    main(["convert", str(tmp_path / f"b{suffix}"), str(tmp_path / "c.npz")])
    found = load_model(tmp_path / "c.npz")
    assert found.origin == model.origin
    assert_same_rule(found, model)
    np.testing.assert_array_equal(found.gaussians.means, model.gaussians.means)


def test_files_beside_the_output_are_kept(tmp_path, capsys):
    save_model(tmp_path / "a.npz", Model(some_gaussians()))
    (tmp_path / "b.bin").write_bytes(b"of another")
    assert main(["convert", str(tmp_path / "a.npz"), str(tmp_path / "b.gltf")]) == 2
    assert "b.bin exists; add --overwrite to replace it, or choose another OUT" in capsys.readouterr().err
    assert main(["convert", str(tmp_path / "a.npz"), str(tmp_path / "c.gltf")]) == 0
    (tmp_path / "c.bin").rename(tmp_path / "b.bin")
    (tmp_path / "c.gltf").write_text((tmp_path / "c.gltf").read_text().replace("c.bin", "b.bin"))
    sizes = [file.stat().st_size for file in (tmp_path / "c.gltf", tmp_path / "b.bin")]
    assert file_bytes(tmp_path / "c.gltf") == sum(sizes)
    assert main(["convert", str(tmp_path / "c.gltf"), str(tmp_path / "b.gltf"), "--overwrite"]) == 2
    assert "b.bin is part of the source" in capsys.readouterr().err


def test_bytes_of_an_embedded_buffer_are_those_of_its_file(tmp_path):
    save_splats(tmp_path / "a.gltf", Model(some_gaussians()))
    described = json.loads((tmp_path / "a.gltf").read_text())
    data = base64.b64encode((tmp_path / "a.bin").read_bytes()).decode()
    described["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{data}"
    for text in (json.dumps(described), "{}"):
        (tmp_path / "a.gltf").write_text(text)
        assert file_bytes(tmp_path / "a.gltf") == (tmp_path / "a.gltf").stat().st_size


@pytest.mark.long
def test_training_starts_from_a_file_in_place_of_the_first_stage(tmp_path, capsys, monkeypatch):
    scene = synthetic_scene(width=32, height=24, num_views=4, num_points=50)
    started = []

    def begun(scene, system, index, start, **options):
        started.append((index, start))
        raise KeyboardInterrupt

    monkeypatch.setattr(run_training, "fit_stage", begun)
    system = A2tg(stage1_iterations=5, stage2_iterations=4, sh_degree=1)
    original = transform_gaussians(some_gaussians(40), scene.transform.inverse())
    save_ply(tmp_path / "a.ply", original)
    run = create_run(tmp_path / "run")
    record = RunRecord(SceneSource("synthetic"), "a2tg", system, init=str(tmp_path / "a.ply"))
    record.check()
    write_record(run, record)
    assert read_record(run) == record
    with pytest.raises(KeyboardInterrupt):
        write_first_stage(run, record, load_splats(tmp_path / "a.ply"), scene)
        run_training.train_run(run, scene, RunOptions(progress=False))
    ((index, first),) = started
    assert index == 1
    np.testing.assert_allclose(first.gaussians.means, some_gaussians(40).means, atol=1e-5)
    np.testing.assert_allclose(first.gaussians.sh, some_gaussians(40).sh[:, :4], atol=1e-5)
    with pytest.raises(ValueError, match="has no second one"):
        dataclasses.replace(record, system="gaussians-2d", options=Gaussians2d()).check()
    command = ["train", "synthetic", "--out", str(tmp_path / "new"), "--init", str(tmp_path / "no.ply")]
    assert main(command) == 2 and "there is no file" in capsys.readouterr().err


@pytest.mark.long
def test_a_file_in_place_of_the_first_stage_is_read_once_and_counted(tmp_path, monkeypatch):
    scene = synthetic_scene(width=32, height=24, num_views=4, num_points=50)
    read = []
    counts = []

    def read_and_noted(file):
        read.append(file)
        return load_splats(file)

    def trained(*_, **options):
        raise RuntimeError("the second stage")

    for module in (model_source, run_training):
        monkeypatch.setattr(module, "load_splats", read_and_noted)
    monkeypatch.setattr(SceneSource, "load", lambda self, room, **options: scene)
    monkeypatch.setattr(run_training, "checked_forecast", lambda *args: counts.append(args[4]))
    monkeypatch.setattr(run_training, "fit_stage", trained)
    save_ply(tmp_path / "a.ply", some_gaussians(40))
    system = A2tg(stage1_iterations=5, stage2_iterations=4)
    record = RunRecord(SceneSource("synthetic"), "a2tg", system, init=str(tmp_path / "a.ply"))
    with pytest.raises(RuntimeError, match="the second stage"):
        begin_run(record, tmp_path / "run", RunOptions(progress=False))
    assert read == [tmp_path / "a.ply"] and counts == [40]
    resume = ["train", "--out", str(tmp_path / "run"), "--resume", "--quiet"]
    with pytest.raises(RuntimeError, match="the second stage"):
        main(resume)
    assert len(read) == 1 and counts == [40, 40], "a resumed run counts the model of its first stage"
    RunFolder(tmp_path / "run").model("a2tg-gaussians").unlink()
    with pytest.raises(RuntimeError, match="the second stage"):
        main(resume)
    assert len(read) == 2 and counts == [40] * 3, "a resumed run without that model reads the file again"


def test_gaussians_of_a_model_are_counted_by_their_means(tmp_path):
    header = {"format": "a2tg-jax model", "version": 1}
    write_archive(tmp_path / "a.npz", header, {"means": np.zeros((40, 3))})
    assert number_in_file(tmp_path / "a.npz") == 40, "nothing else is read"
    write_archive(tmp_path / "a.npz", header, {"quats": np.zeros((40, 4))})
    with pytest.raises(ValueError, match="it has no means"):
        number_in_file(tmp_path / "a.npz")


@pytest.mark.long
def test_what_a_first_stage_cannot_take_of_a_file_is_refused_or_told(tmp_path):
    save_model(tmp_path / "a.npz", textured())
    with pytest.warns(UserWarning, match="leaves out what its splats show besides Gaussians"):
        check_init(tmp_path / "a.npz", tmp_path / "run", A2tg(sh_degree=3))
    gaussians = init_from_points(np.eye(4, 3), np.eye(4, 3), sh_degree=2)
    save_ply(tmp_path / "a.ply", dataclasses.replace(gaussians, sh=gaussians.sh.at[0, 4:].set(0.5)))
    with pytest.warns(UserWarning, match="its spherical harmonics above degree 1"):
        check_init(tmp_path / "a.ply", tmp_path / "run", A2tg(sh_degree=1))
    with pytest.raises(ValueError, match=r"room for 3 Gaussians of 148 bytes .*, and 4 are given"):
        check_init(tmp_path / "a.ply", tmp_path / "run", A2tg(sh_degree=2, memory_budget=0.0005))
