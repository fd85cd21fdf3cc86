"""Checks of arguments: what they let pass. What they refuse is in test_mistakes."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_values import some_gaussians, some_world

import a2tg_jax as a2tg
from a2tg_jax.core.cameras import check_camera
from a2tg_jax.core.checks import check_floats, check_number, check_shape, described
from a2tg_jax.core.numerics import safe_norm
from a2tg_jax.host.text import shortened
from a2tg_jax.rasterize.render_types import Geometry
from a2tg_jax.training.losses import depth_normals

CAMERA = a2tg.Camera(jnp.eye(4).at[2, 3].set(3), jnp.array([[20.0, 0, 8], [0, 20, 6], [0, 0, 1]]), 16, 12)
SETTINGS = a2tg.RenderSettings(capacity=1024)


def render(**options):
    return a2tg.render_image(some_gaussians(), CAMERA, **options)


def moved(moments=None, num_live=7, **options):
    return a2tg.relocate(KEY, options.get("gaussians", some_gaussians()), moments or (), num_live)


def sizes_after(sizes, scales, **options):
    return a2tg.next_sizes(sizes, scales, **{"k_a": 4.0, "k_s": 0.01, "cap": 4, **options})


def adam(params, grads, rates=0.1):
    return a2tg.adam_update(params, grads, a2tg.adam_init(params), rates)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: render(background=IMAGE), "background must be one colour [3]; got [12, 16, 3]"),
        (lambda: render(background=0.5), "background must be [3]; got []"),
        (lambda: render(textures=SIZES), "textures must be Textures; got ndarray"),
        (lambda: render(textures=WRONG_TEXTURES), "textures.buckets[0] must be [capacity, 1, 1, 4]"),
        (lambda: render(textures=dataclasses.replace(TEXTURES, buckets=())), "textures must have one bucket for each"),
        (lambda: a2tg.render_image(some_gaussians().means, CAMERA), "gaussians must be Gaussians; got Array"),
        (lambda: a2tg.render_image(some_gaussians(), IMAGE), "camera must be a Camera; got Array"),
        (
            lambda: a2tg.render_image(some_gaussians(), dataclasses.replace(CAMERA, viewmat=jnp.eye(3))),
            "camera.viewmat must be [4, 4]; got [3, 3]",
        ),
        (
            lambda: a2tg.render_image(some_gaussians(), dataclasses.replace(CAMERA, width=0)),
            "camera.width must be a positive number of pixels; got 0",
        ),
        (lambda: a2tg.plan_render(FLAT_SH, CAMERA), "gaussians.sh must be [7, 16, 3]"),
        (lambda: a2tg.Model(FLAT_SH).render(CAMERA), "gaussians.sh must be [7, 16, 3]"),
        (lambda: a2tg.Renderer(FLAT_SH), "gaussians.sh must be [7, 16, 3]"),
        (lambda: a2tg.view_gradients(lambda m, o: 0.0, a2tg.Model(FLAT_SH), CAMERA), "sh must be [7, 16, 3]"),
        (lambda: a2tg.save_ply("never.ply", FLAT_SH), "gaussians.sh must be [7, 16, 3]"),
        (lambda: a2tg.transform_gaussians(FLAT_SH, some_world()), "gaussians.sh must be [7, 16, 3]"),
        (lambda: a2tg.photometric_loss(IMAGE, IMAGE[:, :15]), "image and target must both be [H, W, 3]"),
        (lambda: a2tg.psnr(MAP, MAP), "image and target must both be [H, W, 3]"),
        (lambda: a2tg.ssim(IMAGE, IMAGE.astype(int)), "must be floats"),
        (lambda: a2tg.normal_consistency(IMAGE, MAP[None], MAP, CAMERA), "depth must be [12, 16]; got [1, 12, 16]"),
        (lambda: a2tg.normal_consistency(MAP, MAP, MAP, CAMERA), "normal must be [12, 16, 3]; got [12, 16]"),
        (lambda: depth_normals(MAP, MAP[:5] > 0, CAMERA), "is_valid must be [12, 16]; got [5, 16]"),
        (lambda: moved(gaussians=FLAT_SH), "gaussians.sh must be [7, 16, 3]"),
        (lambda: moved(num_live=jnp.ones(7)), "num_live must be []; got [7]"),
        (lambda: moved(moments=(jnp.ones((6, 3)),)), "every leaf of moments must have 7 rows"),
        (lambda: a2tg.grow(KEY, some_gaussians(), (), 3, jnp.ones(2)), "cap must be []; got [2]"),
        (lambda: a2tg.perturb(KEY, some_gaussians(), 3, jnp.ones(7)), "lr must be []; got [7]"),
        (lambda: a2tg.perturb(KEY, FLAT_SH, 3, 0.1), "gaussians.sh must be [7, 16, 3]"),
        (
            lambda: a2tg.select(np.ones((7, 1)), SIZES, SIZES, fraction=0.5),
            "statistic must be [N]; got [7, 1]",
        ),
        (lambda: a2tg.select(np.ones(7), SIZES[:6], SIZES, fraction=0.5), "sizes must be [7, 2]"),
        (lambda: a2tg.reallocate(WRONG_TEXTURES, SIZES), "textures.buckets[0] must be"),
        (lambda: a2tg.reallocate(TEXTURES, SIZES, (WRONG_TEXTURES,)), "moments.buckets[0] must be"),
        (lambda: a2tg.reallocate(TEXTURES, SIZES[:6]), "new_sizes must be [7, 2]; got [6, 2]"),
        (lambda: a2tg.texture_arrays(WRONG_TEXTURES), "textures.buckets[0] must be"),
        (lambda: a2tg.textures_from_arrays([np.ones((1, 1, 4), int)]), "texture 0 must be floats; got int64"),
        (
            lambda: a2tg.GradientStatistics.init(7).observe(jnp.ones((7, 1)), jnp.ones(7, bool)),
            "norms must be [7]; got [7, 1]",
        ),
        (lambda: adam({"a": jnp.ones(7)}, {"a": jnp.ones((7, 1))}), "grads['a'] must be [7]; got [7, 1]"),
        (lambda: adam({"a": jnp.ones(7)}, {"b": jnp.ones(7)}), "grads must have the structure of params"),
        (lambda: adam(jnp.ones((7, 3)), jnp.ones((7, 3)), jnp.ones(3)), "rates must broadcast to [7, 3]"),
        (lambda: adam(jnp.ones((1, 3)), jnp.ones((1, 3)), jnp.ones((7, 3))), "rates must broadcast to [1, 3]"),
        (lambda: adam({"a": jnp.ones(7, int)}, {"a": jnp.ones(7)}), "params['a'] must be floats; got int32"),
        (lambda: sizes_after(SCALES, SIZES), "sizes must be integers [N, 2] as (Tv, Tu); got float32 (7, 2)"),
        (lambda: sizes_after(TEXTURES, SCALES), "sizes must be integers [N, 2]; got Textures: pass textures.sizes"),
        (
            lambda: sizes_after(100 * SIZES, SCALES),
            "texture sides must be in 1..16, or both 0; got 100..100",
        ),
        (lambda: sizes_after(SIZES, -SCALES), "scales must be positive standard deviations; got -1: say"),
        (lambda: sizes_after(SIZES, SCALES, k_a=np.nan), "k_a must be at least 0; got nan"),
        (lambda: sizes_after(SIZES, SCALES, cap=4.5), "cap must be an int, 1 to 16; got 4.5"),
        (lambda: sizes_after(SIZES, SCALES, axes="foo"), "axes must be one of paper, authors; got 'foo'"),
        (lambda: a2tg.reallocate(SIZES, SIZES), "textures must be Textures; got ndarray"),
        (lambda: a2tg.reallocate(TEXTURES, SIZES, kept=np.arange(7)), "kept must be bools; got int64"),
        (lambda: a2tg.texture_arrays(SIZES), "textures must be Textures; got ndarray"),
        (lambda: a2tg.allocate_textures(SIZES, rgb=(1, 1, 1)), "rgb must be a number; got (1, 1, 1)"),
        (lambda: render(settings=None), "settings must be RenderSettings; got NoneType"),
        (lambda: a2tg.RenderSettings(tile_size=8.0), "tile_size must be an int, 1 to 64; got 8.0"),
        (lambda: a2tg.RenderSettings(sh_degree=7), "sh_degree must be an int, 0 to 3; got 7"),
        (lambda: a2tg.RenderSettings(tile_batch=-1), "tile_batch must be an int, at least 0, or None; got -1"),
        (lambda: a2tg.RenderSettings(near_plane="1"), "near_plane must be a number above 0; got '1'"),
        (lambda: a2tg.plan_render(CAMERA, some_gaussians()), "gaussians must be a Model or Gaussians; got Camera"),
        (lambda: a2tg.plan_render(some_gaussians(), None), "cameras must be a Camera or an Iterable; got NoneType"),
        (lambda: a2tg.plan_render(some_gaussians(), [VIEW]), "cameras[0] must be a Camera; got View: use view.camera"),
        (lambda: a2tg.Renderer(some_gaussians(), CAMERA), "appearance must be an Appearance; got Camera"),
        (lambda: a2tg.resize_camera(CAMERA, 0, 12), "width must be an int, at least 1; got 0"),
        (lambda: a2tg.resize_camera(CAMERA, 16, np.nan), "height must be an int, at least 1; got nan"),
        (lambda: a2tg.resize_camera(CAMERA, 16, 12.0), "height must be an int, at least 1; got 12.0"),
        (lambda: a2tg.smooth_path([CAMERA, CAMERA], "5"), "num_frames must be an int, at least 1; got '5'"),
        (lambda: a2tg.photometric_loss(OUTPUT, IMAGE), "image must be an array; got RenderOutput: say output.color"),
        (
            lambda: a2tg.photometric_loss(IMAGE, VIEW),
            "target must be an array; got View: say view_image(",
        ),
        (lambda: a2tg.photometric_loss(IMAGE, IMAGE, ssim_weight=2), "ssim_weight must be at least 0 and at most 1"),
        (lambda: a2tg.ssim(None, IMAGE), "image must be an array; got NoneType"),
        (lambda: a2tg.normal_consistency(IMAGE, MAP, MAP, VIEW), "camera must be a Camera; got View: use view.camera"),
        (lambda: a2tg.normal_consistency(None, MAP, MAP, CAMERA), "normal must be [12, 16, 3]; got NoneType"),
        (lambda: a2tg.parameter_bytes(a2tg.Model(some_gaussians())), "got Model: say model.num_bytes"),
        (lambda: a2tg.parameter_bytes(some_gaussians(), SIZES), "textures must be Textures; got ndarray"),
        (lambda: a2tg.view_image(CAMERA), "view must be a View; got Camera"),
        (
            lambda: a2tg.view_gradients(lambda m, o: 0.0, some_gaussians(), CAMERA),
            "got Gaussians: say Model(gaussians)",
        ),
        (lambda: a2tg.shrink_textures(some_gaussians(), [VIEW]), "got Gaussians: say Model(gaussians)"),
        (lambda: a2tg.align_poses(CAMERA, some_gaussians()), "got Camera: say align_poses(scene.test, model)"),
        (lambda: a2tg.adam_update(IMAGE, IMAGE, None, 0.1), "state must be an AdamState; got NoneType: say adam_init"),
        (
            lambda: a2tg.adam_update(IMAGE, IMAGE, a2tg.adam_init(IMAGE), 0.1, b1=1.0),
            "b1 must be at least 0 and below 1",
        ),
        (lambda: a2tg.exponential_decay("1", 0.1, 3, 10), "start must be a number, or an array of numbers; got "),
        (lambda: a2tg.exponential_decay(1.0, 0.0, 3, 10), "final_factor must be above 0; got 0.0"),
        (
            lambda: a2tg.exponential_decay(1.0, 0.1, None, 10),
            "iteration must be a number, or an array",
        ),
        (lambda: a2tg.color_fit(IMAGE, IMAGE[:5]), "target must be [12, 16, 3]; got [5, 16, 3]"),
        (lambda: a2tg.color_fit(IMAGE, IMAGE, np.ones((12, 16), int)), "mask must be bools; got int64"),
        (lambda: a2tg.transform_gaussians(some_gaussians(), np.eye(4)), "similarity must be a Similarity; got ndarray"),
    ],
)
def test_the_error_names_argument_wanted_and_actual(call, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        call()


INTRINSICS = {
    "not finite": CAMERA.K.at[0, 2].set(jnp.nan),
    "focal length of 0": CAMERA.K.at[1, 1].set(0.0),
    "negative focal length": CAMERA.K.at[1, 1].multiply(-1),
    "transposed": CAMERA.K.T,
    "scaled": 2 * CAMERA.K,
}


@pytest.mark.parametrize("K", INTRINSICS.values(), ids=INTRINSICS)
def test_intrinsics_of_a_wrong_form_are_refused_outside_jit(K):
    camera = dataclasses.replace(CAMERA, K=K)
    with pytest.raises(ValueError, match=re.escape("camera.K must be [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] in pix")):
        a2tg.render_image(some_gaussians(), camera)
    jax.eval_shape(lambda camera: a2tg.render_image(some_gaussians(), camera, settings=SETTINGS), camera)


def test_intrinsics_may_be_skewed_and_drift():
    check_camera(dataclasses.replace(CAMERA, K=CAMERA.K.at[0, 1].set(3.0).at[1, 0].set(1e-3).at[2, 2].set(1.001)))


def test_numbers_within_limits_pass_whatever_their_kind():
    for value in (1, 1.0, np.float32(1), jnp.float32(1), np.ones((), int)):
        check_number("x", value, least=0, most=1)
    assert jax.jit(lambda x: check_number("x", x, above=5) or x)(1.0) == 1
    for value in (True, "1", None, np.ones(1), np.nan, 2, 1j):
        with pytest.raises(ValueError, match=r"^x must be (a number )?at least 0 and at most 1; got "):
            check_number("x", value, least=0, most=1)


def test_schedules_are_computed_for_many_iterations_at_once():
    rates = a2tg.exponential_decay(jnp.ones(3), 0.01, jnp.array([0, 5, 10]), 10)
    np.testing.assert_allclose(rates, [1, 0.1, 0.01], rtol=1e-6)


def test_metrics_take_nested_lists():
    image = np.full((12, 12, 3), 0.25, np.float32)
    assert float(a2tg.psnr(image.tolist(), image + np.float32(0.1))) == pytest.approx(20, abs=1e-4)


def test_gaussians_are_not_iterated_without_an_end():
    with pytest.raises(TypeError, match="'Gaussians' object is not iterable"):
        list(some_gaussians())


def test_an_image_goes_behind_the_splats_as_the_error_says():
    """The recipe for a background image gives what one colour gives where the image is of that colour."""
    color = jnp.array([0.2, 0.5, 0.7])
    output = render()
    composed = output.color + (1 - output.alpha[..., None]) * jnp.broadcast_to(color[None, None], (12, 16, 3))
    np.testing.assert_allclose(composed, render(background=color).color, atol=1e-6)


def test_checks_pass_tracers_and_leave_nothing_in_the_program():
    def checked(x):
        check_floats("x", x, ("N", 3))
        check_shape("x", x, ("N", "C"))
        return safe_norm(x)

    assert str(jax.make_jaxpr(checked)(jnp.ones((5, 3)))) == str(jax.make_jaxpr(safe_norm)(jnp.ones((5, 3))))
    assert jax.vmap(checked)(jnp.ones((2, 5, 3))).shape == (2, 5)


def test_shapes_and_values_in_words():
    check_shape("x", np.ones((4, 2, 4)), ("N", 2, "N"))
    with pytest.raises(ValueError, match=re.escape("x must be [N, 2, N]; got [4, 2, 3]")):
        check_shape("x", np.ones((4, 2, 3)), ("N", 2, "N"))
    assert described((np.zeros((2, 3)), 4, "a")) == "(float64[2, 3], 4, 'a')"
    assert described((jnp.zeros(1),)) == "(float32[1],)"
    assert shortened("a\nb\tc") == "a b c" and shortened([1, None]) == "[1, None]"
    assert shortened("\x1b[31mred\x07") == "\ufffd[31mred\ufffd"
    assert len(shortened("x" * 10**6)) == 80 and shortened("x" * 81).endswith("…") and shortened("x" * 80) == "x" * 80


def test_pytrees_may_hold_anything():
    """No validation when one is made: transformations put objects, batches and None into them."""
    batched = jax.tree.map(lambda x: jnp.stack([x, x]), some_gaussians())
    colors = jax.vmap(lambda g: a2tg.render_image(g, CAMERA, settings=SETTINGS).color)(batched)
    np.testing.assert_array_equal(colors[0], colors[1])
    assert "object" in repr(jax.tree.map(lambda x: object(), some_gaussians()))


@pytest.mark.long
def test_a_moved_model_renders_the_same_with_moved_settings():
    near = a2tg.Camera(jnp.eye(4).at[2, 3].set(0.7), CAMERA.K, 16, 12)
    model = dataclasses.replace(a2tg.Model(some_gaussians(40)), origin=a2tg.Origin.of_cameras([near]))
    world, settings = dataclasses.replace(some_world(), scale=0.2), SETTINGS
    moved = model.transform(world)
    (camera,) = moved.origin.cameras
    shown = model.render(near, settings=settings).color
    np.testing.assert_allclose(moved.render(camera, settings=settings.transform(world)).color, shown, atol=2e-5)
    assert np.abs(moved.render(camera, settings=settings).color - shown).max() > 0.01
