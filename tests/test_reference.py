"""The published formats: readers without this library find in the kept files what it finds, and checksums hold."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from reference_files import FILES, NUM, SUMS, checksum, load, numbers, reference_model, shaped_model
from small_files import taken_apart

from a2tg_jax import TextureOptions, save_splats
from a2tg_jax.io.web_scene import encode_web_scene

DATA = Path(__file__).parent / "data"
KEPT = DATA / "web.a2tgz"
READER = Path(__file__).parents[1] / "docs" / "reference" / "read_model.py"


def test_checksums_hold():
    listed = dict(reversed(line.split("  ")) for line in (DATA / SUMS).read_text().splitlines())
    assert set(listed) == {*FILES, "numbers.json"} == {path.name for path in DATA.iterdir() if path.is_file()} - {SUMS}
    assert listed == {name: checksum(DATA / name) for name in listed}
    assert sum(path.stat().st_size for path in DATA.iterdir() if path.is_file()) < 60_000


@pytest.mark.parametrize("name", FILES)
def test_the_reference_reader_finds_what_this_library_finds(reference, name):
    read_model, _ = reference
    found = read_model(DATA / name)
    wanted = numbers(load(DATA / name))
    assert set(found) == {*wanted, "header"} and len(found["means"]) == NUM
    for key, values in wanted.items():
        np.testing.assert_allclose(found[key], values, atol=2e-6, rtol=2e-6, err_msg=key)


@pytest.mark.long
@pytest.mark.parametrize("has_shapes", [False, True])
def test_what_is_read_is_drawn_as_this_library_draws_it(reference, tmp_path, has_shapes):
    """It follows the rules of the page alone."""
    read_model, draw = reference
    model = shaped_model() if has_shapes else reference_model()
    options = {"outside": "identity", "extent": 1.5}
    texture = dataclasses.replace(model.appearance.texture, options=TextureOptions(**options))
    model = dataclasses.replace(model, appearance=dataclasses.replace(model.appearance, texture=texture))
    for name in ("m.npz", "m.glb"):
        save_splats(tmp_path / name, model)
    origin = model.origin
    found, again = (read_model(tmp_path / name).get("exponents") for name in ("m.npz", "m.glb"))
    assert (found is None) == (again is None) == (not has_shapes)
    np.testing.assert_allclose([] if again is None else again, [] if found is None else found, rtol=1e-6)
    found = read_model(tmp_path / "m.npz")
    image = draw(found, origin.viewmats[0], origin.Ks[0], 64, 48, model.background, **options)
    wanted = np.asarray(model.render(origin.cameras[0]).color)
    assert np.ptp(wanted) > 0.5
    np.testing.assert_allclose(image, wanted, atol=2e-3)
    assert np.mean(np.abs(image - wanted)) < 1e-5


def test_the_kept_files_hold_the_model():
    """Exactly, or as coarsely as they say; a reader of both is compared with the numbers in text."""
    wanted = numbers(reference_model())
    texts = json.loads((DATA / "numbers.json").read_text())
    for name, held in texts.items():
        found = numbers(load(DATA / name))
        for key, values in held.items():
            np.testing.assert_allclose(found[key].ravel(), values, atol=1e-6, err_msg=key)
    for key, values in numbers(load(DATA / "model.npz")).items():
        np.testing.assert_array_equal(values, wanted[key])
    found = numbers(load(DATA / "floats.a2tgz"))
    order = np.argmin(np.linalg.norm(found["means"][:, None] - wanted["means"], axis=2), axis=1)
    np.testing.assert_array_equal(found["means"], wanted["means"][order])
    np.testing.assert_array_equal(found["sizes"], wanted["sizes"][order])


def test_scenes_for_browsers_are_still_written_so():
    """All but what zlib codes."""
    found, _ = taken_apart(encode_web_scene(reference_model(), title="reference"))
    wanted, _ = taken_apart(KEPT.read_bytes())
    # The kept file was written before textures had an extent.
    wanted["appearance"]["parts"]["texture"]["options"]["extent"] = 3.0
    # And before pages showed the subject alone.
    assert found["page"].pop("subject").startswith("no subject")
    for header in (found, wanted):
        header["parts"] = [name for name, *_ in header["parts"]]
    assert found == wanted


@pytest.mark.long
def test_the_reference_reader_takes_nothing_of_this_library():
    sources = [path.read_text() for path in READER.parent.glob("*.py")]
    assert not any("a2tg_jax" in source for source in sources)
    assert max(source.count("\n") for source in sources) <= 130
    command = [sys.executable, str(READER), str(DATA / "webp.a2tgz")]
    assert "means: float64 [10, 3]" in subprocess.run(command, capture_output=True, text=True, check=True).stdout
