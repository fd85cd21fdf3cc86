"""Edits of the viewer: what they keep, and where they are applied."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_files import model_in, taken_apart
from small_values import centers_of, some_gaussians
from test_upright import captured, node_matrix
from viewer_cases import small_model

import a2tg_jax as a2tg
from a2tg_jax import Similarity, turntable
from a2tg_jax.cli.main import main
from a2tg_jax.io.columns import decode
from a2tg_jax.io.edit_file import largest_score
from a2tg_jax.io.floaters import floater_scores
from a2tg_jax.io.web_scene import encode_web_scene
from a2tg_jax.results.editing import edit_of
from a2tg_jax.results.options import EditOptions

NOWHERE = Similarity(1.0, np.eye(3), np.zeros(3))
TILTED = Rotation.from_euler("xy", [25, 10], degrees=True).as_matrix()
EDIT = {"format": "a2tg-jax edit", "version": 1}


def edit_file(folder, **changes):
    path = folder / "edit.json"
    path.write_text(json.dumps(EDIT | changes))
    return path


def test_a_crop_keeps_what_is_in_the_box(tmp_path):
    """Turned, with open sides; textures and cameras stay with their Gaussians."""
    model = small_model()
    crop = {"axes": TILTED.tolist(), "low": [None, -0.5, None], "high": [0.4, None, None]}
    edited = a2tg.apply_edit(model, a2tg.load_edit(edit_file(tmp_path, crop=crop, background=[1, 0, 0.5])))
    x, y, _ = TILTED @ np.asarray(model.gaussians.means).T
    wanted = model[(x <= 0.4) & (y >= -0.5)]
    assert 0 < wanted.num < model.num
    np.testing.assert_array_equal(edited.gaussians.means, wanted.gaussians.means)
    np.testing.assert_array_equal(edited.textures.sizes, wanted.textures.sizes)
    assert (edited.background, edited.origin) == ((1, 0, 0.5), model.origin)
    with pytest.raises(ValueError, match="the edit would remove all 300 Gaussians"):
        a2tg.apply_edit(model, a2tg.load_edit(edit_file(tmp_path, crop={"low": [50, None, None], "high": [None] * 3})))


def test_limits_of_floaters_are_whole_numbers():
    """As in web/test/extent.test.ts: float32 and float64 must hide the same."""
    assert [largest_score(strictness) for strictness in (0, 0.2, 0.5, 0.8, 0.9, 1)] == [255, 204, 128, 51, 25, 0]


def test_floaters_are_what_floats_not_what_is_faint():
    """A wall that is sparse, large and faint stays; small opaque needles before it go."""
    model = captured(NOWHERE)
    rng = np.random.default_rng(0)
    floor = np.concatenate([rng.uniform(-1, 1, (400, 2)), rng.normal(0, 0.01, (400, 1))], axis=1)
    wall = np.concatenate([rng.uniform(-6, 6, (60, 2)), rng.normal(-3, 0.1, (60, 1))], axis=1)
    centers = centers_of(model.origin.viewmats)
    needles = np.repeat(centers, 2, axis=0)[:20] * rng.uniform(0.6, 0.85, (20, 1)) + rng.normal(0, 0.1, (20, 3))
    means = np.concatenate([floor, wall, needles])
    log_scales = np.repeat(np.log([0.05, 1.0, 0.02]), [400, 60, 20])[:, None] * np.ones(2)
    cameras = (model.origin.viewmats, model.origin.Ks, model.origin.sizes)
    scores = floater_scores(means, log_scales, *cameras)
    assert scores[-20:].min() > 26 > scores[:-20].max()
    logits = np.where(np.arange(480) < 460, -3.0, 3.0)  # An opacity of 0.05, and 0.95 of the needles.
    gaussians = some_gaussians(480)
    arrays = {"means": means, "log_scales": log_scales, "logit_opacities": logits}
    gaussians = dataclasses.replace(gaussians, **{name: jnp.asarray(x, jnp.float32) for name, x in arrays.items()})
    edited = a2tg.apply_edit(a2tg.Model(gaussians, origin=model.origin), a2tg.Edit(floaters=0.9))
    np.testing.assert_array_equal(edited.gaussians.means, gaussians.means[:460])


def test_scores_of_few_or_equal_gaussians():
    """Without cameras the one far away floats, and its copies as well."""
    nothing = (np.zeros((0, 4, 4)), np.zeros((0, 3, 3)), np.zeros((0, 2)))
    assert floater_scores(np.zeros((1, 3)), np.zeros((1, 2)), *nothing).tolist() == [0]
    assert floater_scores(np.zeros((30, 3)), np.full((30, 2), -9.0), *nothing).max() == 0
    cloud = np.concatenate([np.random.default_rng(0).uniform(size=(200, 3)), [[9.0, 9.0, 9.0]]])
    for copies in (1, 20):
        means = np.concatenate([cloud, np.repeat(cloud[-1:], copies - 1, axis=0)])
        scores = floater_scores(means, np.full((len(means), 2), -5.0), *nothing)
        assert scores[200:].min() == 255 > 4 * np.median(scores[:200])


def test_the_viewers_file_has_the_same_scores_and_the_vertical():
    model = a2tg.apply_edit(small_model(), a2tg.Edit(up=np.array([0.0, 0.6, 0.8])))
    header, body = taken_apart(data := encode_web_scene(model))
    scores = []
    start = 0
    for name, coder, length in header["parts"]:
        if name == "floaters":
            count = min(header["chunk"], 300 - sum(map(len, scores)))
            scores.append(decode(coder, body[start : start + length], 1, count)[0])
        start += length
    numbers = (np.asarray(model.gaussians.means), np.asarray(model.gaussians.log_scales))
    cameras = (model.origin.viewmats, model.origin.Ks, model.origin.sizes)
    np.testing.assert_array_equal(np.sort(np.concatenate(scores)), np.sort(floater_scores(*numbers, *cameras)))
    assert header["origin"]["up"] == [0.0, 0.6, 0.8]
    assert header["page"]["subject"].startswith("no subject: it follows from what at least 3 cameras look at")
    assert model_in(data).origin == model.origin


def test_a_chosen_vertical_turns_files_and_orbits_but_no_number(tmp_path):
    model = captured(NOWHERE)
    up = TILTED @ [0, 0, 1]
    edited = a2tg.apply_edit(model, a2tg.Edit(up=up))
    np.testing.assert_array_equal(edited.gaussians.sh, model.gaussians.sh)
    for suffix in (".npz", ".a2tgz", ".glb"):
        a2tg.save_splats(tmp_path / f"m{suffix}", edited)
        np.testing.assert_allclose(a2tg.load_splats(tmp_path / f"m{suffix}").origin.up, up, atol=1e-12)
    turned = edited.transform(Similarity(2.0, TILTED.T, np.ones(3)))
    np.testing.assert_allclose(turned.origin.vertical, [0, 0, 1], atol=1e-12)
    a2tg.save_ply(tmp_path / "m.ply", edited, world="upright")
    found = a2tg.load_splats(tmp_path / "m.ply")
    np.testing.assert_allclose(found.origin.transform.rotation @ up, [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(node_matrix(tmp_path / "m.glb")[:3, :3] @ up, [0, 1, 0], atol=1e-12)
    orbit = turntable(edited.origin.cameras, 8, edited.origin.up)
    np.testing.assert_allclose([camera.viewmat[0, :3] @ up for camera in orbit], 0, atol=1e-6)


def test_commands_take_an_edit(tmp_path, capsys):
    a2tg.save_model(tmp_path / "m.npz", captured(NOWHERE))
    means = np.asarray(captured(NOWHERE).gaussians.means)
    path = edit_file(tmp_path, crop={"low": [0, None, None], "high": [None] * 3}, up=(TILTED @ [0, 0, 1]).tolist())
    words = ["convert", str(tmp_path / "m.npz"), str(tmp_path / "n.npz"), "--edit", str(path)]
    assert main(words) == 0
    edited = a2tg.load_model(tmp_path / "n.npz")
    np.testing.assert_array_equal(edited.gaussians.means, means[means[:, 0] >= 0])
    assert main(["convert", str(tmp_path / "m.npz"), str(tmp_path / "n.ply"), "--edit", str(path)]) == 0
    assert main(["export", str(tmp_path / "m.npz"), "--web", str(tmp_path / "site"), "--edit", str(path)]) == 0
    assert "the original one turned by" in capsys.readouterr().out
    page = model_in((tmp_path / "site" / "scene.a2tgz").read_bytes())
    assert a2tg.load_ply(tmp_path / "n.ply").num == page.num == edited.num
    assert page.origin == edited.origin
    assert main([*words[:2], str(tmp_path / "o.npz"), "--edit", str(tmp_path / "none.json")]) == 2
    assert "no such edit; a2tg edit or the viewer's 'Save edit' makes one" in capsys.readouterr().err
    assert main([*words[:2], str(tmp_path / "o.npz"), "--edit", str(tmp_path / "n.ply")]) == 2
    assert "; give edit.json, which a2tg edit or the viewer's 'Save edit' makes\n" in capsys.readouterr().err


def test_an_edit_from_flags(tmp_path, capsys):
    """The file has what the flags say, and a model written directly is the same as with the file."""
    model = captured(Similarity(2.0, TILTED, np.ones(3)))
    a2tg.save_model(tmp_path / "m.npz", model)
    flags = ["--crop", "40:100", "0:55", "0:100", "--floaters", "20", "--upright", "3", "--background", "#ff0080"]
    for name in ("e.json", "a.npz"):
        assert main(["edit", str(tmp_path / "m.npz"), "--out", str(tmp_path / name), *flags]) == 0
    edit = a2tg.load_edit(tmp_path / "e.json")
    assert (edit.floaters, edit.background) == (0.2, (1, 0, 128 / 255))
    # The cameras are level against the vertical of their world.
    np.testing.assert_allclose(edit.up, [0, 0, 1], atol=1e-6)
    edited = a2tg.apply_edit(model, edit)
    assert f"an edit that keeps {edited.num} of 60 Gaussians" in capsys.readouterr().out and 5 < edited.num < 55
    np.testing.assert_array_equal(a2tg.load_model(tmp_path / "a.npz").gaussians.means, edited.gaussians.means)
    edit = edit_of(EditOptions(upright="-y"), model)
    np.testing.assert_allclose(model.origin.transform.inverse().rotation @ edit.up, [0, -1, 0], atol=1e-12)


def test_a_file_for_programs_that_show_spz_upside_down(tmp_path, capsys):
    """The opposite vertical turns it half over, so that its +y is up."""
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # +z is up in the model's world, −y in the original one.
    a2tg.save_model(tmp_path / "m.npz", captured(Similarity(2.0, turn, np.ones(3))))
    assert main(["convert", str(tmp_path / "m.npz"), str(tmp_path / "a.spz")]) == 0
    assert "upright with +y down, which is the original one" in capsys.readouterr().out
    assert main(["edit", str(tmp_path / "m.npz"), "--out", str(tmp_path / "b.spz"), "--upright=y"]) == 0
    usual, other = (np.asarray(a2tg.load_splats(tmp_path / name).gaussians.means) for name in ("a.spz", "b.spz"))
    by_height = np.argsort(usual[:, 1])
    against_height = np.argsort(-other[:, 1])
    np.testing.assert_allclose(other[against_height, 1], -usual[by_height, 1], atol=1e-3)
    # A turn about x and one about the vertical, no mirror image.
    turned, distance = Rotation.align_vectors(usual[by_height], other[against_height])
    assert distance < 0.02 and turned.magnitude() == pytest.approx(np.pi, abs=1e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (EditOptions(), "nothing to change"),
        (EditOptions(crop=("0:100", "60:40", "0:100")), "`crop` must be .*; got '60:40'"),
        (EditOptions(floaters=101), "`floaters` must be a percentage from 0 to 100; got 101"),
        (EditOptions(upright="q"), "`upright` must be .*; got 'q'; the first is 0"),
        (EditOptions(background="whit"), "`background` must be a colour .*; got 'whit'"),
    ],
)
def test_flags_of_edits_are_checked(options, message):
    with pytest.raises(ValueError, match=message):
        edit_of(options, captured(NOWHERE))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": 2}, "is not an edit of version 1"),
        ({"floaters": 1.5}, "floaters must be a number from 0 to 1; got 1.5"),
        ({"floaters": True}, "floaters must be a number"),
        ({"crop": [1]}, "crop must be an object"),
        ({"crop": {"low": [1, 2], "high": [None] * 3}}, "crop.low must be 3 finite numbers or null"),
        ({"crop": {"axes": [[1, 0, 0]] * 3, "low": [0] * 3, "high": [1] * 3}}, "crop.axes must have a rotation"),
        ({"subject": 1}, "subject must be true or false; got 1"),
        ({"up": [0, 0, 0]}, "up must not be zero"),
        ({"background": [1, 2, None]}, "background must be 3 finite numbers"),
        ({"background": [0, 0.5, 255]}, "background must be numbers from 0 to 1"),
        ({"crops": {}}, "has the unknown entry crops"),
    ],
)
def test_invalid_edits_are_refused(tmp_path, changes, message):
    with pytest.raises(ValueError, match=f"edit.json: .*{message}"):
        a2tg.load_edit(edit_file(tmp_path, **changes))
