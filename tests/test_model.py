"""Models as values: saved and loaded, moved, cut to the rows that exist, rendered without their photographs."""

import dataclasses
import json
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes_random import as_camera, as_gaussians, draw_scene
from small_files import read_archive, write_archive
from small_models import assert_same_rule
from small_values import assert_same, some_gaussians, some_world
from test_hostile_models import refused, spoiled, with_array, with_header

from a2tg_jax import (
    Appearance,
    Bands,
    Camera,
    Exponents,
    Model,
    Origin,
    RenderSettings,
    Texture,
    TextureOptions,
    allocate_appearance,
    concatenate,
    load_model,
    pytree,
    render_appearance,
    save_model,
    save_ply,
    static,
    texture_arrays,
    textures_from_arrays,
    to_gsplat,
)

SIZES = [(1, 1), (4, 2), (1, 4), (2, 2), (4, 2), (1, 1), (3, 5)]


@pytree(kw_only=True)
class Tint(Appearance):
    """A colour of its own for each splat: an appearance from elsewhere."""

    tint: jax.Array | None = None
    strength: float = static(default=0.5)
    channels: tuple[int, ...] = static(default=(0, 1, 2))
    name: str | None = static(default=None)

    def allocate(self, key, gaussians):
        return dataclasses.replace(self, tint=jnp.full((gaussians.num, 3), self.strength))


def some_textures(num: int = 7):
    rng = np.random.default_rng(3)
    sizes = [SIZES[i % len(SIZES)] for i in range(num)]
    return [rng.uniform(size=(*size, 4)).astype(np.float32) for size in sizes]


def some_origin(num: int = 3) -> Origin:
    cameras = [as_camera(draw_scene(seed, width=20 + seed), "float32") for seed in range(num)]
    names = [f"{index}.png" for index in range(num)]
    return Origin.of_cameras(cameras, names, is_test=[True] + [False] * (num - 1), transform=some_world())


def textured_model() -> Model:
    texture = Texture(textures_from_arrays(some_textures()), (2, 2), TextureOptions.official())
    return Model(some_gaussians(), Appearance(texture=texture), background=(0.1, 0.2, 0.3), origin=some_origin())


def assert_same_model(found: Model, wanted: Model) -> None:
    assert_same_rule(found, wanted)
    assert found.background == wanted.background and found.origin == wanted.origin
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


# Files


def test_round_trip(tmp_path):
    save_model(tmp_path / "m.npz", textured_model(), {"note": "kept", "format": "of the caller"})
    assert_same_model(load_model(tmp_path / "m.npz"), textured_model())
    assert read_archive(tmp_path / "m.npz")[0]["note"] == "kept"


def test_only_rows_that_exist_are_kept(tmp_path):
    model = dataclasses.replace(textured_model(), num_live=jnp.asarray(4, jnp.int32))
    save_model(tmp_path / "m.npz", model)
    loaded = load_model(tmp_path / "m.npz")
    assert loaded.num == 4 and loaded.num_live is None
    assert_same(loaded.gaussians, some_gaussians()[:4])
    for array, again in zip(some_textures()[:4], texture_arrays(loaded.textures), strict=True):
        np.testing.assert_array_equal(array, again)
    assert loaded.num_bytes == model.num_bytes == 232 * 4 + 16 * (1 + 8 + 4 + 4)


def test_no_gaussians_without_an_origin(tmp_path):
    model = Model(some_gaussians(0), Appearance(texture=Texture(textures_from_arrays([]))))
    save_model(tmp_path / "m.npz", model)
    assert_same_model(load_model(tmp_path / "m.npz"), model)
    camera = as_camera(draw_scene(0), "float32")
    assert np.isfinite(load_model(tmp_path / "m.npz").render(camera).color).all()


def test_models_of_version_0_2(tmp_path):
    """One appearance held another one, whose arrays were inner.NAME, and the background was in the origin."""
    wanted = dataclasses.replace(textured_model(), gaussians=some_gaussians())
    shapes = np.linspace(-1, 1, 7).astype(np.float32)
    shaped = dataclasses.replace(wanted.appearance, exponents=Exponents(jnp.asarray(shapes)))
    save_model(tmp_path / "textured.npz", wanted)
    header, arrays = read_archive(tmp_path / "textured.npz")
    header["origin"]["background"] = header.pop("background")
    options = header.pop("appearance")["parts"]["texture"]
    inner = {"module": "a2tg_jax.appearance.textured", "name": "Textured", "options": options}
    outer = {"module": "a2tg_jax.appearance.shaped", "name": "Shaped", "options": {}, "held": {"inner": inner}}
    write_archive(tmp_path / "textured.npz", {**header, "appearance": inner}, arrays)
    assert_same_model(load_model(tmp_path / "textured.npz"), wanted)
    arrays = {name.replace("appearance/", "appearance/inner."): array for name, array in arrays.items()}
    arrays["appearance/shapes"] = shapes
    write_archive(tmp_path / "shaped.npz", {**header, "appearance": outer}, arrays)
    assert_same_model(load_model(tmp_path / "shaped.npz"), dataclasses.replace(wanted, appearance=shaped))


# Appearances from elsewhere


def tinted_model(**options) -> Model:
    appearance = allocate_appearance(Tint(**options), jax.random.key(0), some_gaussians())
    return Model(some_gaussians(), appearance)


def test_an_appearance_of_an_imported_module_is_found(tmp_path):
    save_model(tmp_path / "m.npz", tinted_model(strength=0.25, channels=(2, 1), name="red"))
    assert_same_model(load_model(tmp_path / "m.npz"), tinted_model(strength=0.25, channels=(2, 1), name="red"))


def test_a_file_imports_nothing_and_says_what_to_do(tmp_path):
    save_model(tmp_path / "m.npz", tinted_model())
    spoiled(tmp_path / "m.npz", lambda header, _: header["appearance"].update(module="antigravity"))
    with pytest.raises(ValueError, match=r"m\.npz: .*Tint .*antigravity.*import that module.*appearances=\(Tint,\)"):
        load_model(tmp_path / "m.npz")
    assert_same_model(load_model(tmp_path / "m.npz", appearances=(Tint,)), tinted_model())


def test_options_that_a_file_cannot_keep_are_refused(tmp_path):
    model = tinted_model(name=object())
    with pytest.raises(ValueError, match="options of Tint cannot be kept"):
        save_model(tmp_path / "m.npz", model)
    assert not list(tmp_path.iterdir())


# Damage


def with_text(text: str):
    """Replaces the header by any text."""

    def spoil(path):
        _, arrays = read_archive(path)
        np.savez(path, header=np.frombuffer(text.encode(), np.uint8), **arrays)

    return spoil


def head(**values) -> str:
    return json.dumps({"format": "a2tg-jax model", "version": 1, **values})


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda path: path.write_bytes(path.read_bytes()[:-30]), "damaged"),
        (lambda path: path.write_bytes(b""), "damaged"),
        (with_text("[1, 2]"), "damaged"),
        (with_text(head(note=float("nan"))), "damaged"),
        (with_text("[" * 100_000), "damaged"),
        (with_text(head(appearance=3)), "damaged"),
        (with_text(head(appearance={"name": "Textured"})), "lacks 'options'"),
    ],
)
def test_files_that_are_damaged_are_one_error_that_names_them(tmp_path, spoil, message):
    path = tmp_path / "bad.npz"
    save_model(path, textured_model())
    spoil(path)
    refused(load_model, path, message)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (with_array("means", lambda x: x[:, :2]), r"gaussians\.means must be \[N, 3\]; got \[7, 2\]"),
        (with_array("means", lambda x: x[0, 0]), r"gaussians\.means must be \[N, 3\]"),
        (with_array("sh", lambda x: x[:, :2]), r"gaussians\.sh must be \[7, K, 3\] with K = 1, 4, 9 or 16.*got K = 2"),
        (with_array("quats", lambda x: x.astype(np.int32)), r"gaussians\.quats must be floats"),
        (with_array("quats", lambda x: x.astype(str)), "quats must be of plain numbers"),
        (lambda _, arrays: arrays.pop("quats"), "lacks 'quats'"),
        (lambda _, arrays: arrays.pop("appearance/texels"), "the array texels of the appearance is missing"),
        (with_array("appearance/texels", lambda x: x[1:]), "disagree"),
        (with_array("appearance/texels", lambda x: x.astype(np.int32)), "must be floats"),
        (with_array("appearance/sizes", lambda x: -x), r"sizes: texture sides must be in 1\.\.16, or both 0"),
        (with_array("appearance/sizes", lambda x: x.astype(float)), "sizes must be integers"),
        (with_array("appearance/sizes", lambda x: x.ravel()), "sizes must be integers"),
        (
            lambda _, a: a.update({"appearance/sizes": np.ones((2, 2), int), "appearance/texels": np.eye(2, 4)}),
            "textures are of 2 Gaussians, but there are 7 gaussians",
        ),
        (lambda header, _: header["appearance"].update(name="Curtains"), "Curtains.*which is unknown"),
        (lambda header, _: header["appearance"].update(name="jax.numpy"), "which is unknown"),
        (lambda header, _: header["appearance"].update(module="os", name="system"), "which is unknown"),
        (lambda header, _: header["appearance"]["parts"]["texture"].update(start=9), r"Texture\.start must be"),
        (with_array("origin/Ks", lambda x: x[1:]), r"origin/Ks must be \[3, 3, 3\]"),
        (with_header(background=[0, 1]), "bad.npz: .*unpack"),
        (with_header(background="red"), "bad.npz: .*float"),
        (with_header(origin=None), "damaged"),
    ],
)
def test_arrays_and_options_that_do_not_fit_are_refused(tmp_path, change, message):
    path = tmp_path / "bad.npz"
    save_model(path, textured_model())
    spoiled(path, change)
    refused(load_model, path, message)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.long)])
def test_flipped_bits_are_found_or_do_no_harm(tmp_path, seed):
    path = tmp_path / "bits.npz"
    rng = np.random.default_rng(seed)
    save_model(path, textured_model())
    whole = path.read_bytes()
    for place in rng.integers(len(whole), size=100):
        data = bytearray(whole)
        data[place] ^= int(rng.integers(1, 256))
        path.write_bytes(bytes(data))
        try:
            assert_same_model(load_model(path), textured_model())
        except ValueError as error:
            assert "bits.npz" in str(error)


def test_a_model_of_wrong_shapes_is_not_written(tmp_path):
    gaussians = dataclasses.replace(some_gaussians(), sh=jnp.zeros((7, 2, 3)))
    with pytest.raises(ValueError, match=r"model\.gaussians\.sh must be \[7, K, 3\] with K = 1, 4, 9 or 16.*got K = 2"):
        save_model(tmp_path / "m.npz", Model(gaussians))
    with pytest.raises(FileNotFoundError, match=r"m\.npz"):
        load_model(tmp_path / "m.npz")


# The value


def test_rows_of_another_number_are_refused(tmp_path):
    """Both numbers are named; four textures of seven Gaussians would otherwise move to the wrong ones."""
    textures = textures_from_arrays(some_textures())
    few = textures_from_arrays(some_textures(4))
    model = Model(some_gaussians(), Appearance(texture=Texture(textures), exponents=Exponents(jnp.zeros(7))))
    coefficients = allocate_appearance(Appearance(bands=Bands()), jax.random.key(0), some_gaussians()[:4]).coefficients
    words = "are of 4 Gaussians, but there are 7"
    for replace in (model.with_textures, model.appearance.with_textures):
        with pytest.raises(ValueError, match=f"textures {words}"):
            replace(few)
    with pytest.raises(ValueError, match=f"coefficients {words}"):
        model.appearance.with_coefficients(coefficients)
    with pytest.raises(ValueError, match=r"shapes must be \[7\]; got \[4\]"):
        model.appearance.with_shapes(jnp.zeros(4))
    for shape in ([4, 16, 3], [7, 1, 3], [7, 25, 3]):
        with pytest.raises(ValueError, match=re.escape(f"sh must be [7, 16, 3]; got {shape}")):
            model.with_sh(np.zeros(shape))
    wrong = Model(some_gaussians(), Appearance(texture=Texture(few)))
    uses = {
        "rows": lambda: wrong[2:4],
        "ply": lambda: save_ply(tmp_path / "a.ply", wrong),
        "gsplat": lambda: to_gsplat(wrong),
        "npz": lambda: save_model(tmp_path / "a.npz", wrong),
        "concatenate": lambda: concatenate([wrong, wrong]),
    }
    for name, use in uses.items():
        with pytest.raises(ValueError, match=f"textures {words}"):
            pytest.fail(f"{name}: {use()}")
    assert not [*tmp_path.iterdir()]


@pytest.mark.long
@pytest.mark.usefixtures("x64")
def test_a_moved_model_shows_the_same_to_its_cameras():
    scene = draw_scene(9)
    textures = textures_from_arrays(scene.textures)
    origin = Origin.of_cameras([as_camera(scene, "float64")])
    model = Model(as_gaussians(scene, "float64"), Appearance(texture=Texture(textures)), origin=origin)
    moved = model.transform(some_world())

    def first_view(model: Model):
        viewmat = jnp.asarray(model.origin.viewmats[0])
        K = jnp.asarray(model.origin.Ks[0])
        return model.render(
            Camera(viewmat, K, *model.origin.sizes[0].tolist()), settings=RenderSettings(near_plane=1e-3)
        )

    before = first_view(model)
    after = first_view(moved)
    np.testing.assert_allclose(after.color, before.color, atol=1e-9)
    assert before.alpha.mean() > 0.2


def test_moves_compose():
    model = textured_model()
    first = some_world(1)
    second = some_world(2)
    twice = model.transform(first).transform(second)
    once = model.transform(first.then(second))
    np.testing.assert_allclose(twice.gaussians.means, once.gaussians.means, atol=1e-5)
    np.testing.assert_allclose(twice.origin.viewmats, once.origin.viewmats, atol=1e-12)
    np.testing.assert_allclose(twice.origin.transform.translation, once.origin.transform.translation, atol=1e-12)
    back = twice.transform(twice.origin.transform.inverse()).origin.transform
    np.testing.assert_allclose(back.scale, 1.0)
    np.testing.assert_allclose(back.rotation, np.eye(3), atol=1e-12)


@pytest.mark.long
def test_dead_rows_do_not_show():
    scene = draw_scene(4)
    gaussians = as_gaussians(scene, "float32")
    camera = as_camera(scene, "float32")
    spoiled = jax.tree.map(lambda x: x.at[10:].set(jnp.nan), gaussians)
    model = Model(spoiled, num_live=jnp.asarray(10, jnp.int32))
    expected = render_appearance(gaussians[:10], camera, Appearance())
    np.testing.assert_array_equal(model.render(camera).color, expected.color)
    np.testing.assert_array_equal(model.live.render(camera).color, expected.color)


def test_a_model_is_a_pytree_whose_origin_is_no_leaf():
    model = textured_model()
    again = jax.jit(lambda model: jax.tree.map(lambda x: x, model))(model)
    assert_same_model(again, dataclasses.replace(model, origin=None))
    assert jax.tree.structure(model) == jax.tree.structure(textured_model()) == jax.tree.structure(again)
    assert some_origin() == some_origin() != some_origin(2)


def test_reprs_are_short():
    model = textured_model()
    camera = as_camera(draw_scene(0), "float32")
    assert repr(model.gaussians).startswith(
        "Gaussians(means=float32[7, 3], quats=float32[7, 4], log_scales=float32[7, 2]"
    )
    assert repr(camera) == "Camera(viewmat=float32[4, 4], K=float32[3, 3], width=43, height=30)"
    assert "float32[2, 1, 1, 4]" in repr(model.textures) and "int32[7]" in repr(model.textures)
    assert repr(model) == (
        "Model(7 Gaussians, SH degree 3, Gaussians with texture, 2.28 kB, Origin(3 cameras, 1 of them for testing))"
    )
