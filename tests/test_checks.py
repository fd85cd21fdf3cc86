"""Public functions say which argument has the wrong shape or dtype; inside transformations, too."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_values import some_gaussians, some_world

import a2tg_jax as a2tg
from a2tg_jax.core.checks import check_floats, check_shape, described
from a2tg_jax.core.numerics import safe_norm
from a2tg_jax.host.text import shortened
from a2tg_jax.training.losses import depth_normals, mean_scale

CAMERA = a2tg.Camera(jnp.eye(4).at[2, 3].set(3), jnp.array([[20.0, 0, 8], [0, 20, 6], [0, 0, 1]]), 16, 12)
SETTINGS = a2tg.RenderSettings(capacity=1024)
IMAGE, MAP = jnp.ones((12, 16, 3)), jnp.ones((12, 16))
KEY = jax.random.key(0)
TEXTURES, LAYOUT = a2tg.allocate_textures(np.ones((7, 2), int))
WRONG_TEXTURES = a2tg.Textures((jnp.ones((7, 1, 1, 3)),))


def changed(**fields) -> a2tg.Gaussians:
    return dataclasses.replace(some_gaussians(), **fields)


FLAT_SH = changed(sh=jnp.zeros((7, 2, 3)))
WRONG_FIELDS = [
    (changed(means=jnp.zeros((7, 4))), "means must be [N, 3]; got [7, 4]"),
    (changed(means=jnp.zeros(())), "means must be [N, 3]; got []"),
    (changed(quats=jnp.zeros((7, 3))), "quats must be [7, 4]; got [7, 3]"),
    (changed(quats=jnp.zeros((6, 4))), "quats must be [7, 4]; got [6, 4]"),
    (changed(log_scales=jnp.zeros((7, 3))), "log_scales must be [7, 2]; got [7, 3]"),
    (changed(logit_opacities=jnp.zeros((7, 1))), "logit_opacities must be [7]; got [7, 1]"),
    (FLAT_SH, "sh must be [7, 16, 3]; got [7, 2, 3]"),
    (changed(sh=jnp.zeros((7, 16, 3), jnp.int32)), "sh must be floats; got int32"),
    (changed(sh=jnp.zeros((7, 16, 3), jnp.float16)), "sh must be float32 as the means are; got float16"),
]


@pytest.mark.parametrize(("gaussians", "message"), WRONG_FIELDS)
def test_every_field_of_gaussians_is_checked(gaussians, message):
    with pytest.raises(ValueError, match=re.escape(f"gaussians.{message}")):
        a2tg.render_image(gaussians, CAMERA)
    with pytest.raises(ValueError, match=re.escape(f"gaussians.{message}")):
        jax.eval_shape(lambda g: a2tg.render_image(g, CAMERA, settings=SETTINGS), gaussians)


def render(**options):
    return a2tg.render_image(some_gaussians(), CAMERA, **options)


def moved(moments=None, num_live=7, **options):
    return a2tg.relocate(KEY, options.get("gaussians", some_gaussians()), moments or (), num_live)


def adam(params, grads, rates=0.1):
    return a2tg.adam_update(params, grads, a2tg.adam_init(params), rates)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: render(background=IMAGE), "background must be one colour [3]; got [12, 16, 3]"),
        (lambda: render(background=0.5), "background must be [3]; got []"),
        (lambda: render(textures=TEXTURES), "textures and layout belong together"),
        (lambda: render(textures=TEXTURES, layout=TEXTURES), "must be Textures and their AtlasLayout"),
        (lambda: render(textures=WRONG_TEXTURES, layout=LAYOUT), "textures.buckets[0] must be [capacity, 1, 1, 4]"),
        (lambda: render(textures=a2tg.Textures(()), layout=LAYOUT), "textures must have one bucket for each size"),
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
        (lambda: mean_scale(some_gaussians(), jnp.ones(7)), "num_live must be []; got [7]"),
        (lambda: moved(gaussians=FLAT_SH), "gaussians.sh must be [7, 16, 3]"),
        (lambda: moved(num_live=jnp.ones(7)), "num_live must be []; got [7]"),
        (lambda: moved(moments=(jnp.ones((6, 3)),)), "every leaf of moments must have 7 rows"),
        (lambda: a2tg.grow(KEY, some_gaussians(), (), 3, jnp.ones(2)), "cap must be []; got [2]"),
        (lambda: a2tg.perturb(KEY, some_gaussians(), 3, jnp.ones(7)), "lr must be []; got [7]"),
        (lambda: a2tg.perturb(KEY, FLAT_SH, 3, 0.1), "gaussians.sh must be [7, 16, 3]"),
        (
            lambda: a2tg.select(np.ones((7, 1)), LAYOUT.sizes, LAYOUT.sizes, fraction=0.5),
            "statistic must be [N]; got [7, 1]",
        ),
        (lambda: a2tg.select(np.ones(7), LAYOUT.sizes[:6], LAYOUT.sizes, fraction=0.5), "sizes must be [7, 2]"),
        (lambda: a2tg.reallocate(WRONG_TEXTURES, LAYOUT, LAYOUT.sizes), "textures.buckets[0] must be"),
        (lambda: a2tg.reallocate(TEXTURES, LAYOUT, LAYOUT.sizes, (WRONG_TEXTURES,)), "moments.buckets[0] must be"),
        (lambda: a2tg.reallocate(TEXTURES, LAYOUT, LAYOUT.sizes[:6]), "new_sizes must be [7, 2]; got [6, 2]"),
        (lambda: a2tg.texture_arrays(WRONG_TEXTURES, LAYOUT), "textures.buckets[0] must be"),
        (lambda: a2tg.textures_from_arrays([np.ones((1, 1, 4), int)]), "texture 0 must be floats; got int64"),
        (
            lambda: a2tg.GradientStatistics.init(7).observe(jnp.ones((7, 1)), jnp.ones(7, bool)),
            "norms must be [7]; got [7, 1]",
        ),
        (lambda: adam({"a": jnp.ones(7)}, {"a": jnp.ones((7, 1))}), "grads['a'] must be [7]; got [7, 1]"),
        (lambda: adam({"a": jnp.ones(7)}, {"b": jnp.ones(7)}), "grads must have the structure of params"),
        (lambda: adam(jnp.ones((7, 3)), jnp.ones((7, 3)), jnp.ones(3)), "rates must broadcast to [7, 3]"),
        (lambda: adam(jnp.ones((1, 3)), jnp.ones((1, 3)), jnp.ones((7, 3))), "rates must broadcast to [1, 3]"),
    ],
)
def test_the_error_names_argument_wanted_and_actual(call, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        call()


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


def test_a_letter_stands_for_one_size():
    check_shape("x", np.ones((4, 2, 4)), ("N", 2, "N"))
    with pytest.raises(ValueError, match=re.escape("x must be [N, 2, N]; got [4, 2, 3]")):
        check_shape("x", np.ones((4, 2, 3)), ("N", 2, "N"))


def test_values_are_described_by_dtype_and_shape():
    assert described((np.zeros((2, 3)), 4, "a")) == "(float64[2, 3], 4, 'a')"
    assert described((jnp.zeros(1),)) == "(float32[1],)"


def test_pytrees_may_hold_anything():
    """No validation when one is made: transformations put objects, batches and None into them."""
    batched = jax.tree.map(lambda x: jnp.stack([x, x]), some_gaussians())
    settings = SETTINGS
    colors = jax.vmap(lambda g: a2tg.render_image(g, CAMERA, settings=settings).color)(batched)
    np.testing.assert_array_equal(colors[0], colors[1])
    assert "object" in repr(jax.tree.map(lambda x: object(), some_gaussians()))


def test_what_a_file_says_is_told_on_one_short_line():
    assert shortened("a\nb\tc") == "a b c" and shortened([1, None]) == "[1, None]"
    assert shortened("\x1b[31mred\x07") == "\ufffd[31mred\ufffd"
    assert len(shortened("x" * 10**6)) == 80 and shortened("x" * 81).endswith("…") and shortened("x" * 80) == "x" * 80
