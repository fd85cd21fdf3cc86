"""Shapes of kernels handed from a file to a first stage, and from one stage to the next."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from run_folders import create_run
from small_models import rule_of
from small_values import some_gaussians

import a2tg_jax as a2tg
from a2tg_jax import Appearance, Exponents, Texture, allocate_appearance
from a2tg_jax.appearance.parts import nearest_gaussians
from a2tg_jax.results.model_source import check_init, write_first_stage
from a2tg_jax.results.record import RunRecord, SceneSource
from a2tg_jax.training.cost import forecast_stages
from a2tg_jax.training.start import padded, state_of_model

NUM = 40
SHAPES = np.linspace(-1, 1, NUM).astype(np.float32)
GAUSSIANS = dataclasses.replace(some_gaussians(NUM), sh=some_gaussians(NUM).sh[:, :1])
OF_GAUSSIANS = a2tg.Bytewise(kernel_rate=0.0)


def shaped(texture: Texture | None = None) -> a2tg.Model:
    """A model whose kernels differ."""
    template = Appearance(exponents=Exponents(), texture=texture)
    appearance = allocate_appearance(template, jax.random.key(0), GAUSSIANS)
    return a2tg.Model(GAUSSIANS, appearance.with_shapes(jnp.asarray(SHAPES)))


@pytest.fixture(scope="module")
def scene():
    return a2tg.synthetic_scene(width=32, height=24, num_views=4, num_points=50)


def first_model(file, scene, system, tmp_path) -> a2tg.Model:
    """The model that the splats of a file give instead of the first stage."""
    record = RunRecord(SceneSource("synthetic"), system.name, system, init=str(file))
    run = create_run(tmp_path / "run")
    planned = record.plan.stages[0]
    write_first_stage(run, record, a2tg.load_splats(file), scene)
    found = a2tg.load_model(run.model(planned.name))
    assert rule_of(found.appearance) == planned.stage.appearance
    return found


def test_plain_splats_begin_as_gaussians_where_kernels_have_shapes(tmp_path, scene):
    a2tg.save_ply(tmp_path / "a.ply", a2tg.transform_gaussians(GAUSSIANS, scene.transform.inverse()))
    found = first_model(tmp_path / "a.ply", scene, a2tg.Bytewise(), tmp_path)
    np.testing.assert_allclose(found.gaussians.means, GAUSSIANS.means, atol=1e-5)
    np.testing.assert_array_equal(found.appearance.shapes, np.zeros(NUM))


@pytest.mark.parametrize(("system", "has_shapes"), [(a2tg.Bytewise(), True), (OF_GAUSSIANS, False)])
def test_shapes_of_a_file_are_kept_or_its_nearest_gaussians_taken(tmp_path, scene, system, has_shapes):
    a2tg.save_model(tmp_path / "a.npz", shaped())
    found = first_model(tmp_path / "a.npz", scene, system, tmp_path)
    wanted = GAUSSIANS if has_shapes else nearest_gaussians(GAUSSIANS, SHAPES)
    np.testing.assert_allclose(found.gaussians.logit_opacities, wanted.logit_opacities, rtol=1e-5)
    grown = np.log(scene.transform.scale)
    np.testing.assert_allclose(found.gaussians.log_scales, wanted.log_scales + grown, atol=1e-5)
    if has_shapes:
        np.testing.assert_array_equal(found.appearance.shapes, SHAPES)


def test_a_first_stage_without_shapes_is_reported(tmp_path, recwarn):
    a2tg.save_model(tmp_path / "a.npz", shaped())
    check_init(tmp_path / "a.npz", tmp_path / "run", a2tg.Bytewise())
    assert not recwarn.list
    with pytest.warns(UserWarning, match=r"the shapes of its kernels \(the nearest Gaussians replace them\)$"):
        check_init(tmp_path / "a.npz", tmp_path / "run", a2tg.A2tg())
    a2tg.save_model(tmp_path / "b.npz", shaped(Texture()))
    with pytest.warns(UserWarning, match="leaves out what its splats show besides kernels$"):
        check_init(tmp_path / "b.npz", tmp_path / "run", a2tg.Bytewise())


def test_bytes_of_shapes_count_in_a_budget(tmp_path, scene):
    """56 bytes a Gaussian: 13 floats, and one of its shape."""
    a2tg.save_ply(tmp_path / "a.ply", GAUSSIANS)
    check_init(tmp_path / "a.ply", tmp_path / "run", a2tg.Bytewise(memory_budget="2.24kB"))
    with pytest.raises(
        ValueError, match=r"a\.ply: memory_budget .* room for 39 Gaussians of 56 bytes .*, and 40 are given"
    ):
        check_init(tmp_path / "a.ply", tmp_path / "run", a2tg.Bytewise(memory_budget="2.2kB"))
    assert a2tg.Bytewise(memory_budget="5.5kB").small_budget == (
        "memory_budget has room for 98 Gaussians of 56 bytes, and scenes need thousands: 560kB holds 10,000"
    )
    given, _ = forecast_stages(scene, a2tg.Bytewise(), NUM)
    assert given.model_bytes == 40 * 56


def test_a_stage_without_shapes_takes_the_nearest_gaussians():
    stage = OF_GAUSSIANS.stages()[1]
    with pytest.warns(UserWarning, match="^stage 'details' has no shapes of kernels: it takes the") as caught:
        found = state_of_model(shaped(), stage, OF_GAUSSIANS, ()).model
    assert caught[0].filename == __file__, "the line that called the package"
    nearest = nearest_gaussians(GAUSSIANS, SHAPES)
    jax.tree.map(np.testing.assert_array_equal, found.live.gaussians, nearest)
    assert not np.allclose(nearest.log_scales, GAUSSIANS.log_scales)
    same = padded(shaped(), a2tg.Bytewise().stages()[1], a2tg.Bytewise())
    jax.tree.map(np.testing.assert_array_equal, same.live.gaussians, GAUSSIANS)
    np.testing.assert_array_equal(same.live.appearance.shapes, SHAPES)
