"""Mistakes in custom appearances: errors name the class, what it returned and what was wanted."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes_random import as_camera, as_gaussians, draw_scene

from a2tg_jax.appearance import Appearance, Arguments, StaticShading, elementwise_functions, takes_arrays
from a2tg_jax.core.pytree import pytree, static
from a2tg_jax.rasterize.kernels import platforms
from a2tg_jax.render import RenderSettings, render_appearance

SCENE = draw_scene(1, num=10, width=16, height=12)
GAUSSIANS, CAMERA = as_gaussians(SCENE, "float32"), as_camera(SCENE, "float32")
MATRIX = np.asarray([[0.2, -0.1], [0.3, 0.1], [-0.2, 0.1]], np.float32)


def drawn(appearance, compositor="xla", **settings):
    settings = RenderSettings(compositor=compositor, **settings)
    return render_appearance(GAUSSIANS, CAMERA, appearance, settings=settings).color


def with_shade(shade):
    return pytree(type("Mine", (Appearance,), {"shade": lambda self, numbers, values, u, v: shade(u, v)}))()


RETURNS = {
    "the residual is float32[]": lambda u, v: (u, None),
    "the residual is (float32[], float32[])": lambda u, v: ((u, v), None),
    "the residual is (float32[2], float32[], float32[])": lambda u, v: ((jnp.stack([u, v]), u, v), None),
    "the factor is (float32[],)": lambda u, v: (None, (u,)),
    "it returned (float32[], float32[], float32[])": lambda u, v: (u, v, u),
    "it returned None": lambda u, v: None,
}


@pytest.mark.parametrize("told", RETURNS)
def test_what_shade_returns_is_named(told):
    with pytest.raises(ValueError) as caught:
        drawn(with_shade(RETURNS[told]))
    wanted = "Mine.shade must return (residual, factor): 3 colours that are added, or None, and a factor, or None"
    assert str(caught.value).startswith(wanted) and told in str(caught.value)


def test_other_results_are_named():
    falloff = pytree(type("Wide", (Appearance,), {"falloff": lambda self, numbers, rho: (rho, rho)}))()
    with pytest.raises(ValueError, match=r"Wide.falloff must return one number.*it returned \(float32\[\], float32"):
        drawn(falloff)
    grey = pytree(type("Grey", (Appearance,), {"own_colors": lambda self, gaussians, *_: gaussians.opacities}))()
    with pytest.raises(
        ValueError, match=r"own_colors \[N, 3\] of N = 10 gaussians, by its num_colors; Grey gave \(10,\)"
    ):
        drawn(grey)


def test_an_error_in_shade_keeps_its_class_and_names_the_appearance():
    with pytest.raises(ZeroDivisionError) as caught:
        drawn(with_shade(lambda u, v: 1 // 0))
    note = " ".join(caught.value.__notes__)
    assert "Mine.shade" in note and "K = 0 numbers, and C = 0 texture values" in note


@pytree(kw_only=True)
class Glow(Appearance):
    strength: jax.Array
    which: int = static()

    def shade(self, numbers, values, u, v):
        return (OPERATIONS[self.which](self.strength, u),) * 3, None


OPERATIONS = [
    lambda field, u: jnp.sin(field) * u,
    lambda field, u: jnp.where(u > 0, field, 0.0),
    lambda field, u: u * field,
    lambda field, u: jnp.asarray(field) + u,
    lambda field, u: u @ field,
]


@pytest.mark.parametrize("which", range(len(OPERATIONS)))
def test_an_array_field_in_shade_is_named(which):
    with pytest.raises(ValueError, match=r"Glow\.strength is an array.*return it from numbers\(\)"):
        drawn(Glow(strength=jnp.ones(10), which=which))


@pytree
class Mixed(Appearance):
    def shade(self, numbers, values, u, v):
        return tuple(jnp.asarray(MATRIX) @ jnp.stack([u, v])), None


@pytree
class MixedByHand(Appearance):
    def shade(self, numbers, values, u, v):
        return tuple(float(row[0]) * u + float(row[1]) * v for row in MATRIX), None


def test_a_matrix_product_in_shade_names_primitive_and_function(monkeypatch):
    told = r"the primitive '(stack|broadcast_in_dim)' in Mixed\.shade"
    with pytest.warns(UserWarning, match=rf"Mixed is composited by XLA, which is slower: .*{told}"):
        found = drawn(Mixed(), "auto")
    np.testing.assert_allclose(found, drawn(MixedByHand(), "auto"), atol=1e-5)
    with pytest.raises(ValueError, match=rf"compositor='native' cannot run Mixed: .*{told}\. Say 'xla', or 'auto'"):
        drawn(Mixed(), "native")
    monkeypatch.setitem(platforms.PLATFORMS, "cuda", "cpu")
    monkeypatch.setattr(platforms.nvrtc, "find", lambda: True)
    with pytest.raises(ValueError, match=rf"compositor='cuda' cannot run Mixed: .*{told}\. Say 'xla', or 'auto'"):
        drawn(Mixed(), "cuda")


WHOLE = with_shade(lambda u, v: ((jnp.stack([u, v]).sum(), u, u), v))
BY_HAND = with_shade(lambda u, v: ((u + v, u, u), v))


@pytest.mark.parametrize(("whole", "by_hand"), [(Mixed(), MixedByHand()), (WHOLE, BY_HAND)])
def test_what_takes_scalars_only_is_applied_pixel_by_pixel(whole, by_hand):
    """A product of matrices fails on arrays of pixels; a sum over them would be one number for all pixels."""
    arguments = Arguments(num_numbers=0, num_values=0, num_colors=3, dtype="float32")
    assert not takes_arrays(StaticShading.of(whole), arguments) and takes_arrays(StaticShading.of(by_hand), arguments)
    functions = elementwise_functions(StaticShading.of(whole), arguments)
    u, v = np.random.default_rng(0).normal(size=(2, 4, 5)).astype(np.float32)

    def total(shade, u, v):
        residual, factor = shade((), (), u, v)
        return sum(jnp.sum(jnp.sin(color)) for color in residual) + (0 if factor is None else jnp.sum(factor * u))

    found = jax.value_and_grad(total, argnums=(1, 2))(functions.shade, u, v)
    wanted = jax.value_and_grad(total, argnums=(1, 2))(by_hand.shade, u, v)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), found, wanted)


def test_an_appearance_that_is_no_pytree_is_named():
    loose = dataclasses.dataclass(frozen=True)(type("Loose", (Appearance,), {}))
    with pytest.raises(ValueError, match=r"appearance must be a pytree: .* class Loose with @a2tg_jax\.pytree"):
        drawn(loose())


def test_a_branch_on_a_number_names_jnp_where():
    with pytest.raises(jax.errors.TracerBoolConversionError) as caught:
        drawn(with_shade(lambda u, v: (None, u) if u > 0 else (None, v)))
    assert "use jnp.where instead of if" in "".join(caught.value.__notes__)
