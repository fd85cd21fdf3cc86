"""A degree of spherical harmonics per Gaussian: the same picture as with zeros for what is missing, at fewer bytes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from scenes_random import as_camera, as_gaussians, draw_scene
from scipy.spatial.transform import Rotation
from small_files import read_archive, write_archive
from small_models import assert_same_rule, billboards, movable_kernels, rule_of, with_bands
from small_values import some_gaussians

from a2tg_jax import (
    AdaptDegrees,
    Appearance,
    Camera,
    Due,
    Exponents,
    Gaussians2dMcmc,
    LearningRates,
    Mcmc,
    Model,
    Seen,
    Similarity,
    Stage,
    Texture,
    adam_init,
    allocate_appearance,
    combine,
    load_model,
    load_ply,
    partition,
    plan_render,
    save_model,
    save_ply,
)
from a2tg_jax.core.table import Layout, bucket_capacity, resize
from a2tg_jax.densify.view_dependence import most_blocks
from a2tg_jax.training.start import padded

NUM = 40
NUM_FLOATS = (13, 22, 37, 58)
"""Of a Gaussian of degree 0 to 3."""


def sizes_of(degrees: np.ndarray, base: int) -> np.ndarray:
    """Coefficients [N, 1] above the degree that all have."""
    return (degrees[:, None] + 1) ** 2 - (base + 1) ** 2


def random_degrees(seed: int, base: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(base, 4, NUM)


def cut(sh: np.ndarray, degrees: np.ndarray) -> np.ndarray:
    """The coefficients [N, 16, 3] with zeros above each Gaussian's degree."""
    bases = (degrees + 1) ** 2
    return np.where(np.arange(16)[None, :, None] < bases[:, None, None], sh, 0)


def banded(seed: int, base: int = 0, dtype: str = "float32", template: Appearance = Appearance()):  # noqa: B008 - frozen
    """A model of a random degree per Gaussian, and the same of degree 3 with zeros."""
    scene = draw_scene(seed, num=NUM)
    degrees = random_degrees(seed, base)
    full = as_gaussians(scene, dtype)
    full = dataclasses.replace(full, sh=jnp.asarray(cut(np.asarray(full.sh), degrees), full.means.dtype))
    gaussians = dataclasses.replace(full, sh=full.sh[:, : (base + 1) ** 2])
    plain = Model(full, allocate_appearance(template, jax.random.key(0), gaussians))
    model = with_bands(Model(gaussians, plain.appearance), full.sh[:, (base + 1) ** 2 :], degrees)
    return model, plain, as_camera(scene, dtype)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("base", range(4))
def test_the_picture_is_that_of_zeros_for_what_is_missing(base):
    model, plain, camera = banded(base, base, "float64")
    np.testing.assert_allclose(model.render(camera).color, plain.render(camera).color, atol=1e-12)


@pytest.mark.parametrize("base", range(4))
def test_bytes_are_those_of_each_degree(base):
    model, _, _ = banded(1, base)
    degrees = random_degrees(1, base)
    np.testing.assert_array_equal(model.degrees, degrees)
    assert model.num_bytes == 4 * sum(NUM_FLOATS[degree] for degree in degrees)
    first = dataclasses.replace(model, num_live=jnp.int32(25))
    assert first.num_bytes == first.live.num_bytes == 4 * sum(NUM_FLOATS[degree] for degree in degrees[:25])
    assert Model(model.gaussians).num_bytes == 4 * NUM * NUM_FLOATS[base]


@pytest.mark.usefixtures("x64")
def test_gradients_are_those_of_the_dense_coefficients():
    model, plain, camera = banded(2, dtype="float64")
    settings = plan_render(plain.gaussians, camera, head_room=2.0)
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(camera.height, camera.width, 3)))

    def gradient(model):
        floats, rest = partition(model)
        loss = lambda floats: jnp.sum(weights * combine(floats, rest).render(camera, settings=settings).color)  # noqa: E731
        return combine(jax.grad(loss)(floats), rest)

    found = gradient(model)
    expected = gradient(plain)
    wanted = cut(np.asarray(expected.gaussians.sh), model.degrees)
    np.testing.assert_allclose(found.sh, wanted[:, : found.sh.shape[1]], atol=1e-12)
    np.testing.assert_allclose(found.gaussians.means, expected.gaussians.means, atol=1e-10)


@pytest.mark.long
@pytest.mark.parametrize(
    "template",
    [
        Appearance(texture=Texture(start=(2, 1)), exponents=Exponents()),
        Appearance(texture=Texture(start=(0, 0))),
        movable_kernels(),
        billboards(side=3),
    ],
)
def test_whatever_else_is_shown_is_as_without(template, tmp_path):
    model, plain, camera = banded(3, template=template)
    expected = plain.render(camera).color
    np.testing.assert_allclose(model.render(camera).color, expected, atol=1e-6)
    save_model(tmp_path / "m.npz", dataclasses.replace(model, num_live=jnp.int32(30)))
    loaded = load_model(tmp_path / "m.npz")
    assert_same_rule(loaded, model)
    assert loaded.num == 30
    np.testing.assert_array_equal(loaded.degrees, model.degrees[:30])
    shorter = dataclasses.replace(plain, num_live=jnp.int32(30))
    np.testing.assert_allclose(loaded.render(camera).color, shorter.render(camera).color, atol=1e-6)


def test_a_ply_file_and_another_world_have_all_coefficients(tmp_path):
    model, plain, _ = banded(5)
    world = Similarity(1.5, Rotation.random(random_state=0).as_matrix(), np.array([0.3, -0.2, 0.1]))
    expected = np.asarray(plain.transform(world).gaussians.sh)
    np.testing.assert_allclose(model.transform(world).sh, expected, atol=1e-6, err_msg="it turns with the world")
    save_ply(tmp_path / "m.ply", model)
    np.testing.assert_array_equal(load_ply(tmp_path / "m.ply").sh, np.asarray(plain.gaussians.sh))
    for degree in range(4):
        gaussians = dataclasses.replace(plain.gaussians, sh=plain.gaussians.sh[:, : (degree + 1) ** 2])
        save_ply(tmp_path / "m.ply", gaussians)
        np.testing.assert_array_equal(load_ply(tmp_path / "m.ply").sh, gaussians.sh)
    save_ply(tmp_path / "m.ply", gaussians[:0])
    assert load_ply(tmp_path / "m.ply").num == 0


def test_rows_move_while_all_have_one_degree():
    gaussians = as_gaussians(draw_scene(0, num=NUM), "float32")
    rows = np.random.default_rng(10).integers(0, NUM, NUM)
    low = Model(dataclasses.replace(gaussians, sh=gaussians.sh[:, :1]))
    one_degree = with_bands(low, gaussians.sh[:, 1:], np.full(NUM, 3))
    np.testing.assert_array_equal(one_degree[rows].sh, gaussians.sh[rows])
    model, _, _ = banded(0)
    with pytest.raises(ValueError, match="coefficients of 4 sizes cannot change rows: densify and prune before"):
        model.appearance.coefficients.gather(rows)


@pytest.mark.parametrize("seed", range(3))
def test_other_degrees_keep_what_a_gaussian_keeps(seed):
    model, plain, _ = banded(seed)
    ones = jax.tree.map(jnp.ones_like, partition(model)[0])
    degrees = random_degrees(seed + 20)
    table, ones = resize(model.appearance.coefficients, sizes_of(degrees, 0), ones)
    changed = dataclasses.replace(model, appearance=model.appearance.with_coefficients(table))
    np.testing.assert_array_equal(changed.degrees, degrees)
    both = np.minimum(degrees, model.degrees)
    np.testing.assert_array_equal(changed.sh, cut(np.asarray(plain.gaussians.sh), both)[:, : changed.sh.shape[1]])
    kept = combine(ones, partition(changed)[1]).sh
    np.testing.assert_array_equal(kept, cut(np.ones((NUM, 16, 3)), both)[:, : kept.shape[1]])


def test_the_gradient_of_missing_coefficients_is_that_of_coefficients_that_are_zero():
    """Σ over views of ∂L/∂colour · Y is what JAX finds at zeros."""
    rng = np.random.default_rng(0)
    means = rng.normal(size=(NUM, 3))
    centers = rng.normal(size=(6, 3)) + 5
    colors = rng.normal(size=(6, NUM, 3)).astype(np.float32)
    as_array = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    model = Model(dataclasses.replace(some_gaussians(NUM), means=as_array(means)))
    viewmats = np.tile(np.eye(4), (6, 1, 1))
    viewmats[:, :3, 3] = -centers
    cameras = Camera(as_array(viewmats), jnp.tile(jnp.eye(3), (6, 1, 1)), 4, 3)
    nothing = jnp.zeros((6, NUM, 3))
    event = AdaptDegrees(1.0)
    seen = Seen(cameras, nothing, nothing[..., 0] > 0, as_array(colors))
    state = event.observe(event.init(model), model, seen)
    expected = np.zeros((NUM, 16, 3))
    for center, color in zip(centers, colors, strict=True):
        for i in range(NUM):
            direction = (means[i] - center) / np.linalg.norm(means[i] - center)
            expected[i] += np.outer(oracle.sh_basis(direction), color[i])
    np.testing.assert_allclose(state.total, expected, atol=1e-4)
    norms = [np.linalg.norm(expected[:, (d**2) : (d + 1) ** 2] / 6, axis=(1, 2)) for d in (1, 2, 3)]
    np.testing.assert_allclose(state.strengths(), np.stack(norms, 1), rtol=1e-4)


def degrees_after(degrees, dense, strengths, budget, **options):
    """Degrees that an event with some bytes to spend leaves, given average gradients by the bands of degree 1 to 3."""
    num = len(degrees)
    gaussians = some_gaussians(num)
    model = with_bands(Model(dataclasses.replace(gaussians, sh=gaussians.sh[:, :1])), dense, degrees)
    event = AdaptDegrees((model.num_bytes + budget) / 1e6, **options)
    total = np.zeros((num, 16, 3), np.float32)
    total[:, [1, 4, 9], 0] = strengths
    state = dataclasses.replace(event.init(model), total=jnp.asarray(total), views=jnp.int32(1))
    return event.apply(Due(), model, adam_init(partition(model)[0]), state).model.degrees


def test_degrees_rise_where_the_gradient_per_byte_is_largest():
    degrees = np.array([0, 0, 1, 2, 3])
    strengths = np.array([[4.0, 9, 9], [3.0, 9, 9], [9, 6.0, 9], [9, 9, 6.0], [9, 9, 9]])
    # Per byte: 4/36, 3/36, 6/60, 6/84; the last has all.
    for budget, wanted in ((36, [1, 0, 1, 2, 3]), (96, [1, 0, 2, 2, 3]), (1000, [1, 1, 2, 3, 3]), (0, degrees)):
        np.testing.assert_array_equal(degrees_after(degrees, np.ones((5, 15, 3)), strengths, budget), wanted)


def test_idle_bands_are_given_up():
    degrees = np.array([0, 1, 1, 2])
    dense = np.zeros((4, 15, 3), np.float32)
    dense[2, :3] = dense[3, :3] = 1.0
    np.testing.assert_array_equal(degrees_after(degrees, dense, 0.0, 1000, idle=0.01), [0, 0, 1, 1])
    np.testing.assert_array_equal(degrees_after(degrees, np.zeros_like(dense), 0.0, 1000), degrees)


@pytest.mark.parametrize("budget_mb", [0.0031])
def test_an_event_stays_within_its_budget_and_spends_it(budget_mb):
    model, _, camera = banded(6, template=Appearance(texture=Texture(start=(0, 0))))
    event = AdaptDegrees(budget_mb, at=(0.5,))
    cameras = jax.tree.map(lambda x: x[None], camera)
    colors = jnp.asarray(np.random.default_rng(0).normal(size=(1, NUM, 3)), jnp.float32)
    nothing = jnp.zeros_like(colors)
    seen = Seen(cameras, nothing, jnp.zeros((1, NUM), bool), colors)
    appearance = allocate_appearance(rule_of(model.appearance), jax.random.key(0), model.gaussians)
    base = Model(model.gaussians, appearance)
    state = event.observe(event.init(base), base, seen)
    after = event.apply(Due(), base, adam_init(partition(base)[0]), state).model
    assert 1e6 * budget_mb - 36 < after.num_bytes <= 1e6 * budget_mb
    # Two programs, which round sums of float32 differently.
    np.testing.assert_allclose(after.render(camera).color, base.render(camera).color, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("base, highest, num_bytes", [(0, 2, 5_000), (1, 3, 900), (0, 3, 100_000)])
def test_there_is_room_for_all_degrees_that_fit(base, highest, num_bytes):
    """Any degrees within the bytes fit the shape that is planned before, which has few rows to spare."""
    gaussians = some_gaussians(NUM)
    low = Model(dataclasses.replace(gaussians, sh=gaussians.sh[:, : (base + 1) ** 2]))
    empty = with_bands(low, np.zeros((NUM, 16 - (base + 1) ** 2, 3)), np.full(NUM, base)).appearance.coefficients
    room = most_blocks(num_bytes, base, highest, NUM, empty)
    expected = {(0,): bucket_capacity(NUM)}
    for favourite in range(base + 1, highest + 1):  # As many of one degree as fit.
        size = (favourite + 1) ** 2 - (base + 1) ** 2
        count = min(NUM, num_bytes // (4 * 3 * size))
        if count:
            expected[size,] = bucket_capacity(count)
    assert dict(zip(*room, strict=True)) == expected
    degrees = np.random.default_rng(highest).integers(base, highest + 1, NUM)
    sizes = sizes_of(degrees, base)
    wide = Layout(room.sizes, (bucket_capacity(NUM),) * len(room.sizes))
    table, _ = resize(empty, sizes, room=wide)
    assert table.layout == wide
    np.testing.assert_array_equal(table.sizes, sizes)
    table, _ = resize(table, sizes, room=Layout(room.sizes, (1,) * len(room.sizes)))
    np.testing.assert_array_equal(table.sizes, sizes)


@pytest.mark.parametrize("damage", ["bands", "texture", "degree"])
def test_a_file_whose_parts_disagree_is_refused(tmp_path, damage):
    template = Appearance(texture=Texture(start=(2, 1)))
    (model, _, _), (other, _, _) = banded(3, template=template), banded(4, base=1, template=template)
    if damage == "degree":
        damaged = dataclasses.replace(model, gaussians=other.gaussians)
    else:
        part = {damage: getattr(model[:20].appearance, damage)}
        damaged = dataclasses.replace(model, appearance=dataclasses.replace(model.appearance, **part))
    with pytest.raises(
        ValueError,
        match=r"^(bands\.coefficients|textures) (are of 20 Gaussians, but there are 40|have blocks of 3 coefficients)",
    ):
        save_model(tmp_path / "m.npz", damaged)
    for name, own in {"whole": model, "part": model[:20], "other": other}.items():
        save_model(tmp_path / f"{name}.npz", own)
    header, arrays = read_archive(tmp_path / "whole.npz")
    _, others = read_archive(tmp_path / ("other.npz" if damage == "degree" else "part.npz"))
    names = {"bands": ("degrees", "band_1", "band_2", "band_3"), "texture": ("sizes", "texels")}
    paths = ["sh"] if damage == "degree" else [f"appearance/{name}" for name in names[damage]]
    write_archive(tmp_path / "m.npz", header, arrays | {path: others[path] for path in paths})
    with pytest.raises(ValueError, match=r"m\.npz: (bands|textures)(\.coefficients)? are (of 20|above degree 0)"):
        load_model(tmp_path / "m.npz")


def test_degrees_rise_in_banded_models_only_and_no_gaussians_are_added_then():
    model, _, _ = banded(5)
    stage = Stage("more", rule_of(model.appearance), (Mcmc(2 * NUM),), (), LearningRates(), 100, 0.0)
    with pytest.raises(ValueError, match="textures or degrees have grown already"):
        padded(model, stage, Gaussians2dMcmc())
    model = Model(as_gaussians(draw_scene(1, num=NUM), "float32"))
    event = AdaptDegrees(1.0)
    with pytest.raises(ValueError, match=r"^plain Gaussians cannot raise degrees: the stage needs Appearance\(bands="):
        event.apply(Due(), model, adam_init(partition(model)[0]), event.init(model))
