"""Where new Gaussians are placed by the errors of pictures, and what an event does with them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bits import bits_of
from kept_checkpoints import fit_keeping_checkpoints
from small_values import SH_C0, rotations

import a2tg_jax as a2tg
from a2tg_jax import Due, PlaceByError, View, adam_init, partition
from a2tg_jax.densify.placing import gaussians_at_errors

DEPTH = 4.0
FOCAL = 20.0
SIZE = (16, 24)
K = np.array([[FOCAL, 0, 12], [0, FOCAL, 8], [0, 0, 1]], np.float32)
TILT = 0.5
"""Slope of the wall: its depth grows by this for each unit to the right."""


def wall() -> a2tg.Model:
    """A red opaque wall before a camera at the origin, of one large Gaussian, with one spare row."""
    turn = np.arctan(TILT) / 2
    gaussians = a2tg.Gaussians(
        means=jnp.array([[0.0, 0.0, DEPTH]]),
        # About y, so that the first axis is along (1, 0, TILT).
        quats=jnp.array([[np.cos(turn), 0, -np.sin(turn), 0]]),
        log_scales=jnp.full((1, 2), np.log(100.0)),
        logit_opacities=jnp.array([8.0]),
        sh=(jnp.array([[[1.0, 0.0, 0.0]]]) - 0.5) / SH_C0,
    )
    joined = jax.tree.map(lambda a: jnp.concatenate([a, jnp.zeros((30, *a.shape[1:]))]), gaussians)
    return a2tg.Model(joined, num_live=jnp.asarray(1, jnp.int32))


def camera() -> a2tg.Camera:
    return a2tg.Camera(jnp.eye(4), jnp.asarray(K), SIZE[1], SIZE[0])


def photograph(left: int, right: int, color: tuple[int, ...]) -> np.ndarray:
    """The wall as it is drawn, but for some columns of another colour."""
    picture = np.zeros((*SIZE, 3), np.uint8)
    picture[..., 0] = 252  # An opaque pixel has an alpha of 0.99.
    picture[:, left:right] = color
    return picture


def seen(picture: np.ndarray, mask: np.ndarray | None = None) -> View:
    return View("wall.png", camera(), picture, mask)


def placed(views: list[View], num: int = 20, background: tuple = (0, 0, 0)) -> a2tg.Gaussians:
    return gaussians_at_errors(wall(), Due(views=views, background=background), num)


def columns_of(gaussians: a2tg.Gaussians) -> np.ndarray:
    """The columns of pixels in which the centres are seen."""
    means = np.asarray(gaussians.means)
    return means[:, 0] / means[:, 2] * FOCAL + K[0, 2]


def test_they_are_on_the_surface_at_the_wrong_pixels_and_of_their_colour():
    new = placed([seen(photograph(5, 8, (0, 0, 255)))])
    assert new.num == 20
    columns = columns_of(new)
    assert columns.min() > 5 and columns.max() < 8, "only these pixels are wrong"
    np.testing.assert_allclose(columns % 1, 0.5, atol=1e-3, err_msg="at the middle of a pixel")
    means = np.asarray(new.means)
    np.testing.assert_allclose(means[:, 2], DEPTH + TILT * means[:, 0], rtol=2e-3)
    np.testing.assert_allclose(new.scales, np.repeat(means[:, 2:] / FOCAL, 2, axis=1), rtol=1e-4)
    np.testing.assert_allclose(new.opacities, 0.3, rtol=1e-5)
    # In the plane of the wall, whose normal is (TILT, 0, −1), in either direction.
    normals = rotations(new.quats)[:, :, 2]
    expected = np.array([TILT, 0, -1]) / np.hypot(TILT, 1)
    np.testing.assert_allclose(np.abs(normals @ expected), 1, atol=1e-5)
    angles = np.asarray(new.quats)
    assert len(np.unique(angles[:, 0].round(3))) > 10, "turned at random around it"
    shown = np.asarray(new.sh[:, 0]) * SH_C0 + 0.5
    np.testing.assert_allclose(shown, np.broadcast_to([0.05, 0.05, 1.0], shown.shape), atol=1e-5)


def test_pixels_are_drawn_in_proportion_to_their_error_in_all_views():
    """Differences of 252 and 126: two thirds of the Gaussians are at the former, in two views or in one."""
    black = photograph(2, 4, (0, 0, 0))
    dark = photograph(20, 22, (126, 0, 0))
    for views in ([seen(black), seen(dark)], [seen(np.minimum(black, dark))]):
        columns = columns_of(placed(views, 3_000))
        assert abs(np.mean(columns < 4) - 2 / 3) < 0.04 and abs(np.mean(columns > 20) - 1 / 3) < 0.04


def test_what_masks_leave_out_and_what_shows_no_surface_gets_none():
    mask = np.ones(SIZE, bool)
    mask[:, 5:7] = False
    new = placed([seen(photograph(5, 8, (0, 0, 255)), mask)])
    assert new.num == 20 and (columns_of(new) > 7).all()
    model = wall()
    faint = dataclasses.replace(model.gaussians, logit_opacities=jnp.full(model.gaussians.num, -1.0))
    views = [seen(photograph(5, 8, (0, 0, 255)))]
    model = dataclasses.replace(model, gaussians=faint)
    found = gaussians_at_errors(model, Due(views=views), 20)
    assert found.num == 0, "an alpha of 0.27"


def test_transparent_pixels_have_the_colour_of_the_background():
    picture = np.full((*SIZE, 4), (255, 3, 3, 255), np.uint8)  # As an alpha of 0.99 draws red before white.
    picture[:, 5:8, 3] = 0
    new = placed([seen(picture)], background=(1, 1, 1))
    columns = columns_of(new)
    assert new.num == 20 and columns.min() > 5 and columns.max() < 8
    np.testing.assert_allclose(np.asarray(new.sh[:, 0]) * SH_C0 + 0.5, 1, atol=1e-5)


def applied(event: PlaceByError, model: a2tg.Model, views: list[View], seed: int = 0):
    moments = adam_init(partition(model)[0])
    ones = jax.tree.map(jnp.ones_like, (moments.mu, moments.nu))
    moments = dataclasses.replace(moments, mu=ones[0], nu=ones[1])
    return event.apply(Due(views=views, seed=seed), model, moments, ())


def test_the_event_adds_a_share_up_to_the_cap():
    model = wall()
    views = [seen(photograph(5, 8, (0, 0, 255)))]
    change = applied(PlaceByError(share=1.0, cap=100), model, views)
    assert change.model.num == 2 and change.rows is None and change.unused is None
    assert change.model.gaussians.num == model.gaussians.num, "no row is allocated"
    assert bits_of(change.model.gaussians[:1]) == bits_of(model.gaussians[:1])
    for moments in (change.moments.mu, change.moments.nu):
        np.testing.assert_array_equal(moments.gaussians.means[:3, 0], [1, 0, 1])
    full = applied(PlaceByError(share=1.0, cap=2), change.model, views)
    assert full.model.num == 2 and full.unused.startswith("share adds no Gaussian")
    assert applied(PlaceByError(share=0.2), model, views).unused.startswith("share of 1 Gaussians is less than one")
    hidden = applied(PlaceByError(share=1.0), model, [seen(photograph(5, 8, (0, 0, 255)), np.zeros(SIZE, bool))])
    assert hidden.model.num == 1 and "views are right" in hidden.unused
    again = applied(PlaceByError(share=1.0, cap=100), model, views)
    assert bits_of(again.model) == bits_of(change.model)
    other = applied(PlaceByError(share=1.0, cap=100), model, views, seed=1)
    assert bits_of(other.model) != bits_of(change.model)


def test_appearance_of_new_rows_is_the_initial_one():
    model = wall()
    views = [seen(photograph(5, 8, (0, 0, 255)))]
    shapes = jnp.full(31, 0.3)
    model = dataclasses.replace(model, appearance=a2tg.Appearance(exponents=a2tg.Exponents(shapes)))
    change = applied(PlaceByError(share=1.0), model, views)
    np.testing.assert_allclose(change.model.appearance.shapes[:3], [0.3, 0, 0.3])
    textures = a2tg.allocate_textures(np.full((31, 2), 2))
    textured = dataclasses.replace(model, appearance=a2tg.Appearance(texture=a2tg.Texture(textures)))
    with pytest.raises(ValueError, match=r"^share must be 0 in a stage whose Gaussians have textures"):
        applied(PlaceByError(share=1.0), textured, views)


def test_impossible_numbers_are_refused_before_training():
    stage = a2tg.Bytewise.preset("smoke").stages()[0]
    for event, message in (
        (PlaceByError(share=1.5), r"PlaceByError\.share must be"),
        (PlaceByError(cap=1), r"PlaceByError\.cap must be at least 2"),
        (PlaceByError(at=(1.0,)), r"PlaceByError\.at must be ascending fractions between 0 and 1"),
    ):
        with pytest.raises(ValueError, match=message):
            dataclasses.replace(stage, events=(event,)).check()


@pytest.mark.long
def test_bytewise_resumes_between_two_of_its_times():
    scene = a2tg.synthetic_scene(num_views=4, width=24, height=16, num_points=120)
    system = a2tg.Bytewise.preset(
        "smoke", stage1_iterations=100, stage2_iterations=10, memory_budget="30kB", initial_gaussians=None
    )
    result, checkpoints = fit_keeping_checkpoints(scene, system, every=45)
    again = a2tg.fit(scene, system, resume=checkpoints[0])
    assert bits_of(again.model) == bits_of(result.model)
    without = dataclasses.replace(system, place=PlaceByError(share=0.0))
    assert not any(isinstance(event, PlaceByError) for event in without.stages()[0].events)
    assert bits_of(a2tg.fit(scene, without).model) != bits_of(result.model)
