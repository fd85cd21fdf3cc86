"""Some rows of a model, several models as one, and the gradient in a whole model."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes_random import as_gaussians, draw_scene
from small_models import billboards, movable_kernels, with_bands

from a2tg_jax import (
    Appearance,
    Bands,
    Exponents,
    Model,
    Texture,
    adam_init,
    adam_update,
    allocate_appearance,
    combine,
    concatenate,
    partition,
    textures_from_arrays,
    value_and_grad,
)
from a2tg_jax.core.table import Table
from a2tg_jax.events import gather_moments, gather_rows
from a2tg_jax.model import check_model

NUM = 12
SIZES = [(1, 1), (4, 2), (2, 2)]


def moved(tree):
    """The tree with other floats."""
    rng, (floats, rest) = np.random.default_rng(0), partition(tree)
    return combine(jax.tree.map(lambda leaf: leaf + rng.normal(size=leaf.shape).astype(np.float32), floats), rest)


def some_model(name: str, seed: int = 2, num: int = NUM) -> Model:
    """A model of `num` Gaussians, behind which two rows do not exist."""
    gaussians = as_gaussians(draw_scene(seed, num=num + 2), "float32")
    template = APPEARANCES[name]
    if template.bands is not None:
        gaussians = dataclasses.replace(gaussians, sh=gaussians.sh[:, :1])
    appearance = moved(allocate_appearance(template, jax.random.key(seed), gaussians))
    rng = np.random.default_rng(seed)
    if template.texture is not None:
        sizes = [SIZES[(index + seed) % 3] for index in range(num + 2)]
        arrays = [rng.uniform(size=(*size, 4)).astype(np.float32) for size in sizes]
        appearance = appearance.with_textures(textures_from_arrays(arrays))
    model = Model(gaussians, appearance, jnp.int32(num))
    if template.bands is not None:
        dense = rng.normal(size=(num + 2, 15, 3)).astype(np.float32)
        model = with_bands(model, dense, rng.integers(0, 4, num + 2))
    return model


APPEARANCES = {
    "plain": Appearance(),
    "texture": Appearance(texture=Texture(start=(2, 3))),
    "movable kernels": movable_kernels(),
    "billboards": billboards(side=3),
    "bands": Appearance(bands=Bands(), texture=Texture(start=(1, 2))),
    "exponents": Appearance(exponents=Exponents()),
    "all parts": Appearance(bands=Bands(), exponents=Exponents(), texture=Texture(start=(1, 2))),
}


def rows_of(model: Model) -> list[np.ndarray]:
    """All floats of each Gaussian that exists, as flat arrays."""
    model = model.live
    leaves = jax.tree.leaves((model.gaussians, model.appearance), is_leaf=lambda leaf: isinstance(leaf, Table))
    columns = [leaf.blocks() if isinstance(leaf, Table) else np.asarray(leaf) for leaf in leaves]
    columns.append(np.pad(model.sh, ((0, 0), (0, 16 - model.sh.shape[1]), (0, 0))))
    return [np.concatenate([np.ravel(column[row]) for column in columns]) for row in range(model.num)]


def assert_rows(found: Model, wanted: list[np.ndarray]) -> None:
    assert found.num_live is None and found.num == len(wanted)
    check_model(found)
    for a, b in zip(rows_of(found), wanted, strict=True):
        np.testing.assert_array_equal(a, b)


SLOW = ("plain", "texture", "movable kernels", "billboards")
every_appearance = pytest.mark.parametrize(
    "name", ["all parts", *(pytest.param(name, marks=pytest.mark.long) for name in SLOW)]
)


@every_appearance
def test_rows_are_chosen_by_mask_indices_and_slice(name):
    model = some_model(name)
    rows = rows_of(model)
    keep = np.arange(NUM) % 3 != 1
    assert_rows(model[keep], [row for row, kept in zip(rows, keep, strict=True) if kept])
    assert_rows(model[jnp.asarray([7, 0, 7])], [rows[7], rows[0], rows[7]])
    assert_rows(model[-4:-1], rows[-4:-1])
    assert_rows(model[np.zeros(NUM, bool)], [])
    assert model[keep].num_bytes < model.num_bytes


@every_appearance
def test_models_are_joined(name):
    first = some_model(name)
    second = some_model(name, seed=3, num=5)
    assert_rows(concatenate([first, second, first]), rows_of(first) + rows_of(second) + rows_of(first))
    assert_rows(concatenate([first]), rows_of(first))
    assert_rows(concatenate([first[:0], second]), rows_of(second))
    halves = first[: NUM // 2], first[NUM // 2 :]
    assert_rows(concatenate(halves), rows_of(first))


@pytest.mark.parametrize("template", [billboards(), movable_kernels()], ids=lambda template: type(template).__name__)
def test_an_appearance_of_no_gaussians(template):
    none = as_gaussians(draw_scene(0), "float32")[:0]
    appearance = allocate_appearance(template, jax.random.key(0), none)
    check_model(Model(none, appearance))
    assert Model(none, appearance).num_bytes == 0


def test_lower_degrees_are_filled_up():
    first = some_model("plain")
    second = some_model("plain", seed=3)
    flat = dataclasses.replace(first, gaussians=dataclasses.replace(first.gaussians, sh=first.gaussians.sh[:, :1]))
    joined = concatenate([flat, second])
    assert joined.gaussians.sh_degree == 3 and not np.any(joined.sh[:NUM, 1:])
    np.testing.assert_array_equal(joined.sh[NUM:], second.live.sh)


def test_mistakes_are_named():
    model = some_model("plain")
    with pytest.raises(ValueError, match=r"rows must choose among 12 Gaussians: .*14"):
        _ = model[np.ones(14, bool)]
    with pytest.raises(ValueError, match=r"rows must choose among 12 Gaussians: .*12"):
        _ = model[[0, 12]]
    with pytest.raises(ValueError, match=r"rows must be a mask \[12\], indices or a slice; got int64 \[1, 1\]"):
        _ = model[[[3]]]
    with pytest.raises(ValueError, match=r"rows must be .*; got float64 \[1\]"):
        _ = model[[0.5]]
    with pytest.raises(ValueError, match="concatenate needs at least one model"):
        concatenate([])
    with pytest.raises(ValueError, match="one appearance; got plain Gaussians and MovableKernels"):
        concatenate([model, some_model("movable kernels")])


@pytest.mark.long
def test_a_loss_of_a_whole_model_is_differentiated():
    model = some_model("texture")
    floats, rest = partition(model)

    def loss(model, weight):
        return weight * sum(jnp.sum(jnp.sin(leaf)) for leaf in jax.tree.leaves(partition(model)[0]))

    with pytest.raises(TypeError, match="int32"):
        jax.grad(loss)(model, 2.0)
    value, gradient = jax.jit(value_and_grad(loss))(model, 2.0)
    loss = jax.jit(loss)
    np.testing.assert_allclose(value, loss(model, 2.0), rtol=1e-5)
    expected = jax.tree.map(lambda x: 2 * np.cos(x), floats)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), gradient, expected)
    updated, _ = adam_update(floats, gradient, adam_init(floats), 1e-2)
    assert loss(combine(updated, rest), 2.0) < value


def test_a_loss_may_return_more():
    model = some_model("plain")
    found, gradient = value_and_grad(lambda m: (jnp.sum(m.gaussians.means**2), m.num_live), has_aux=True)(model)
    assert found[1] == NUM and not jax.tree.leaves(gradient.appearance)
    np.testing.assert_allclose(gradient.gaussians.means, 2 * model.gaussians.means)


@pytest.mark.long
@pytest.mark.parametrize("rows", [[0, 5, 3], [1, 1, *range(NUM + 2)]])
def test_an_event_may_leave_fewer_rows_or_more(rows, name="exponents"):
    model = some_model(name)
    moments = adam_init(partition(model)[0])
    moments = dataclasses.replace(moments, mu=moved(moments.mu))
    found = gather_rows(model, np.asarray(rows))
    found_moments = gather_moments(moments, np.asarray(rows))
    assert found.gaussians.num == len(rows)
    for before, after in ((model.gaussians, found.gaussians), (model.appearance, found.appearance)):
        jax.tree.map(lambda b, a: np.testing.assert_array_equal(np.asarray(b)[rows], a), before, after)
    jax.tree.map(lambda b, a: np.testing.assert_array_equal(np.asarray(b)[rows], a), moments.mu, found_moments.mu)
