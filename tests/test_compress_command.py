"""The command `a2tg compress`, with and without tuning, on a tiny run."""

import dataclasses
import re
import shutil

import numpy as np
import pytest
from run_folders import create_run
from small_files import grids_of, half_turned
from small_models import origin_of
from test_cli import fails

from a2tg_jax import (
    A2tg,
    Appearance,
    CompactChoices,
    DivergedError,
    Mcmc,
    Texture,
    Trial,
    allocate_textures,
    evaluate,
    load_compact,
    load_model,
    save_model,
)
from a2tg_jax.cli import main as cli
from a2tg_jax.data.load import SceneSource
from a2tg_jax.finish import tuning
from a2tg_jax.results import compression
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.record import RunRecord, read_record, write_record
from a2tg_jax.training import reports
from a2tg_jax.training.start import initial_model

TUNE = ["compress", "--tune-iterations", "30", "--verbose"]
COARSE = CompactChoices(means=5, log_scales=3, quats=3, opacities=2, sh_0=3, sh_rest=2, texels=2)


pytestmark = pytest.mark.usefixtures("untouched_jax")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished run whose last model has texels, made without training."""
    run = create_run(tmp_path_factory.mktemp("compress") / "run")
    system = A2tg(stage1_iterations=1, stage2_iterations=1, initial_gaussians=60, densify=Mcmc(cap=60))
    write_record(run, RunRecord(SceneSource("synthetic", downscale=5), "a2tg", system))
    scene = read_record(run).scene.load()
    model = dataclasses.replace(initial_model(scene, system), origin=origin_of(scene))
    textures = allocate_textures(np.full((60, 2), 2), rgb=0.1)
    save_model(run.own(run.model("a2tg-gaussians")), model)
    textured = dataclasses.replace(model, appearance=Appearance(texture=Texture(textures)))
    save_model(run.own(run.model("a2tg-textures")), textured)
    return run


@pytest.mark.long
def test_compress(run, tmp_path, monkeypatch, capsys):
    """Choices are measured on the run's photographs or, without them, on renders of the model."""
    ladder = {"means": (8, 14), "sh_rest": (3, 8)}
    monkeypatch.setattr(compression, "LADDER", ladder)
    assert cli.main(["compress", str(run.path), "--max-loss", "0.5"]) == 0
    text = capsys.readouterr().out
    assert text.count("\n") == 2 and "dB lost" not in text
    assert cli.main(["compress", str(run.path), "--max-loss", "0.5", "--verbose"]) == 0
    text = capsys.readouterr().out
    path = run.model("a2tg-textures").with_suffix(".a2tgz")
    assert "dB lost, training views  dB lost, test views" in text and f"\n{path}: " in text
    assert load_compact(path).num_bytes == load_model(run.model("a2tg-textures")).num_bytes > 2 * path.stat().st_size
    assert path.relative_to(run.path).as_posix() in run.written()

    def gone(self):
        raise FileNotFoundError("no photographs")

    monkeypatch.setattr(SceneSource, "load", gone)
    out = tmp_path / "other.a2tgz"
    assert cli.main(["compress", str(run.path), "--out", str(out), "--max-loss", "0.5", "--verbose"]) == 0
    assert "dB lost, for a model of 30 dB" in capsys.readouterr().out and load_compact(out).num == 60
    out = tmp_path / "no.a2tgz"
    assert "--tune-iterations needs the photographs of" in fails(capsys, *TUNE, str(run.path), "--out", out)
    assert not out.exists()


@pytest.mark.long
def test_compress_with_tuning(run, tmp_path, monkeypatch, capsys):
    """Tuned files are measured like the others, and kept only if they are smaller and lose no more."""
    ladder = {"means": (3, 5, 8, 14), "log_scales": (1, 2, 4, 10), "sh_0": (1, 2, 4, 10), "opacities": (1, 2, 4, 10)}
    monkeypatch.setattr(compression, "TUNED_LADDER", ladder)
    monkeypatch.setattr(tuning, "MOST_TUNINGS", 1)
    monkeypatch.setattr(reports, "TIMED_SECONDS", 0.0)
    plain = tmp_path / "plain.a2tgz"
    tuned = tmp_path / "tuned.a2tgz"
    with monkeypatch.context() as patch:
        patch.setattr(compression, "smallest_tuned", lambda *a: tuning.TunedFiles([]))
        assert cli.main([*TUNE, str(run.path), "--out", str(plain), "--max-loss", "0.02"]) == 0
    capsys.readouterr()
    assert cli.main([*TUNE, str(run.path), "--out", str(tuned), "--max-loss", "0.02"]) == 0
    printed = capsys.readouterr().out
    scene = read_record(run).scene.load()
    # Nothing grows.
    assert re.search(r"\ntuning 1 of up to 4: .*, about 0:\d\d:\d\d left; [\d.]+ [MG]B of memory\n", printed)
    assert "then training up to" in printed and "\ntuned 1 " in printed and "\ntuned 1: means " in printed
    before, after = (
        evaluate(scene.train, m).psnr for m in (load_model(run.model("a2tg-textures")), load_compact(tuned))
    )
    assert before - after <= 0.02 and tuned.stat().st_size <= plain.stat().st_size


@pytest.mark.long
def test_compress_within_a_file_budget(run, tmp_path, monkeypatch, capsys):
    """The file stays within its bytes, and tuning makes it better; too few bytes are refused with the fewest."""
    ladder = {"means": (5, 8, 14), "log_scales": (2, 4, 10), "sh_0": (2, 4, 10), "opacities": (2, 4, 10)}
    monkeypatch.setattr(compression, "LADDER", ladder)
    monkeypatch.setattr(compression, "TUNED_LADDER", ladder)
    scene = read_record(run).scene.load()
    path = run.model("a2tg-textures")
    losses = []
    for name, flags in {"plain": (), "tuned": ("--tune-iterations", "30")}.items():
        out = tmp_path / f"{name}.a2tgz"
        assert cli.main(["compress", str(run.path), "--out", str(out), "--file-budget", "2.3kB", *flags]) == 0
        assert 2000 < out.stat().st_size <= 2300
        losses.append(evaluate(scene.train, load_model(path)).psnr - evaluate(scene.train, load_compact(out)).psnr)
    assert losses[1] < losses[0]
    capsys.readouterr()
    refused = ["compress", run.path, "--out", tmp_path / "no.a2tgz"]
    assert "--file-budget must be at least " in fails(capsys, *refused, "--file-budget", "0.1kB")
    assert "give one of them" in fails(capsys, *refused, "--file-budget", "6kB", "--max-loss", "0.1")
    assert "--file-budget must be a number of MB" in fails(capsys, *refused, "--file-budget", "six")


def tuned_so(path, choices, *, adds=0, losses=2):
    """A search of tuned files that has found the model of a file in some bits, said to be larger than it is."""
    model = half_turned(load_model(path))
    tuned = tuning.Tuned(model, choices, grids_of(model, choices))
    trial = Trial(choices, len(tuned.data) + adds, (0.0,) * losses)
    return tuning.TunedFiles([trial], trial, tuned)


@pytest.mark.long
@pytest.mark.parametrize(("adds", "is_kept"), [(0, True), (10**9, False)])
def test_compress_writes_the_smaller_file(adds, is_kept, run, tmp_path, monkeypatch, capsys):
    found = tuned_so(run.model("a2tg-textures"), COARSE, adds=adds)
    monkeypatch.setattr(compression, "TUNED_LADDER", {"means": (8, 14)})
    monkeypatch.setattr(compression, "smallest_tuned", lambda *a: found)
    out = tmp_path / "tuned.a2tgz"
    assert cli.main([*TUNE, str(run.path), "--out", str(out), "--max-loss", "0.5"]) == 0
    assert (out.read_bytes() == found.tuned.data) is is_kept
    assert ("chosen: means 5" in capsys.readouterr().out) is is_kept


@pytest.mark.long
def test_a_tuned_file_may_be_the_only_one_within_the_loss(run, tmp_path, monkeypatch, capsys):
    found = tuned_so(run.model("a2tg-textures"), COARSE, losses=1)
    monkeypatch.setattr(compression, "TUNED_LADDER", {"means": (3, 4)})
    monkeypatch.setattr(compression, "loss_measures", lambda *a: {"training views": lambda model: 1.0})
    out = tmp_path / "tuned.a2tgz"
    command = [*TUNE, str(run.path), "--out", str(out), "--max-loss", "0.2"]
    with monkeypatch.context() as patch:
        patch.setattr(compression, "smallest_tuned", lambda *a: tuning.TunedFiles([]))
        assert cli.main(command) == 2
        assert "--max-loss must be larger: no file, tuned or not, is within it; got 0.2" in capsys.readouterr().err
        tried = [tuning.Trial(COARSE, 1, (loss,)) for loss in (0.9, 0.3)]
        patch.setattr(compression, "smallest_tuned", lambda *a: tuning.TunedFiles(tried))
        assert cli.main(command) == 2
        assert "got 0.2; the best tuned file loses 0.300 dB" in capsys.readouterr().err
    assert not out.exists()
    monkeypatch.setattr(compression, "smallest_tuned", lambda *a: found)
    assert cli.main(command) == 0 and out.read_bytes() == found.tuned.data


@pytest.mark.long
@pytest.mark.parametrize(
    ("error", "code"),
    [(KeyboardInterrupt(), 130), (ValueError("a bug"), 2), (DivergedError("the loss has exploded", None), 0)],
)
def test_a_tuning_that_ends_early(error, code, run, tmp_path, monkeypatch, capsys):
    """One that diverges keeps what was found before; any other writes no file."""

    def stop(*arguments, **options):
        raise error

    monkeypatch.setattr(compression, "TUNED_LADDER", {"means": (8, 14)})
    monkeypatch.setattr(compression, "tune_compact", stop)
    assert cli.main([*TUNE, str(run.path), "--out", str(tmp_path / "a.a2tgz"), "--max-loss", "0.5"]) == code
    assert [path.name for path in tmp_path.iterdir()] == ([] if code else ["a.a2tgz"])
    if code == 0:
        printed = "tuning ended early, what was found before is kept: the loss has exploded\n"
        assert printed in capsys.readouterr().out and load_compact(tmp_path / "a.a2tgz").num == 60


@pytest.mark.long
def test_only_a_file_that_the_run_wrote_is_replaced(run, tmp_path, monkeypatch, capsys):
    """Nothing is computed before the refusal."""

    class Reached(Exception):
        pass

    def reached(*_, **__):
        raise Reached

    def begins(*words) -> bool:
        try:
            assert ".a2tgz exists; add --overwrite to replace it" in fails(capsys, "compress", *words)
        except Reached:
            return True
        return False

    monkeypatch.setattr(compression, "loss_measures", reached)
    model = tmp_path / "scene.npz"
    model.write_bytes(run.model("a2tg-textures").read_bytes())
    copy = RunFolder(tmp_path / "run")
    shutil.copytree(run.path, copy.path)
    for source, out in ((model, model), (copy.path, copy.model("a2tg-textures"))):
        out.with_suffix(".a2tgz").unlink(missing_ok=True)
        assert begins(source)
        out.with_suffix(".a2tgz").touch()
    copy.marker.write_text(copy.marker.read_text().replace("models/a2tg-textures.a2tgz\n", ""))
    assert not begins(model) and not begins(copy.path) and begins(model, "--overwrite")
    copy.own(copy.model("a2tg-textures").with_suffix(".a2tgz"))
    assert begins(copy.path)


@pytest.mark.parametrize(
    ("name", "printed"), [("plain.a2tgz", ", which is compressed already"), ("c.ply", ""), ("c.SOG", "")]
)
def test_compress_names_what_it_reads(name, printed, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).touch()
    assert f"a2tg compress reads a run folder or *.npz; got {name}{printed}\n" in fails(capsys, "compress", name)
