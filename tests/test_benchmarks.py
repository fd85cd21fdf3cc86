"""The benchmarks run, and bounds count what they say."""

import dataclasses
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[1]))  # Last, so that the installed package comes first.

from a2tg_jax.data.synthetic import still_life
from benchmarks import bounds, meshes, scaling, stages
from benchmarks.tables import bounds as bounds_table


@pytest.fixture(scope="module")
def counted():
    return bounds.count(300, "mixed", 40, 24)


def test_stages_of_a_step_can_be_measured(monkeypatch):
    monkeypatch.setattr(stages, "timed", jax.eval_shape)
    case = {"num": 50, "width": 32, "height": 16}
    assert stages.measure_stages(case)["evaluated_pairs"] > 0
    monkeypatch.setattr(stages, "timed", lambda function, *_: function())
    assert stages.measure_step({**case, "textures": "mixed"})["step"].loss > 0


def test_operations_of_a_jaxpr_are_its_arithmetic():
    def function(x, y):
        return jax.jit(lambda x: jnp.exp(x) + y)(x * y), jnp.stack([x, y]) * 2

    assert bounds.operations(jax.make_jaxpr(function)(1.0, 2.0)) == 3 + 2


@pytest.mark.long
def test_pairs_beyond_the_last_visible_splat_are_not_taken(monkeypatch):
    seen = []
    monkeypatch.setattr(bounds.View, "taken", lambda view, lists: seen.append((view, lists)) or np.zeros(1))
    bounds.count(300, "none", 40, 24)
    monkeypatch.undo()
    ((view, lists),) = seen
    ids, starts = np.asarray(lists.ids), np.asarray(lists.starts)
    probe = jnp.zeros((300, 4))

    def transmittance(lengths):
        return np.asarray(view._by_tile(view._composite(bounds.beginning(lists, ids, starts, lengths), probe)[1]))

    whole, taken = transmittance(np.diff(starts)), view.taken(lists)
    np.testing.assert_array_equal(transmittance(taken), whole)
    fewer = np.maximum(taken - 1, 0)
    assert (taken > 0).any() and (transmittance(fewer) != whole).any(axis=1)[taken > 0].all()


@pytest.mark.long
def test_bounds_add_up(counted):
    work, spec = counted
    assert 0 < work.textured < work.composited <= work.taken * bounds.TILE_SIZE**2 and work.taken <= work.listed
    assert work.listed <= work.boxes and work.num_texels > 300
    found = {stage.name: stage for stage in bounds.stages(work, spec)}
    twice = bounds.stages(dataclasses.replace(work, composited=2 * work.composited), spec)
    assert found["Adam"].bytes == 7 * 4 * (58 * 300 + 4 * work.num_texels)
    assert [one.flops > found[one.name].flops for one in twice] == ["compositing" in name for name in found]
    case = {"num": 300, "textures": "mixed", "stages": [stage.told for stage in found.values()]}
    assert "| 300, textured |" in bounds_table({"bounds": [case]})


@pytest.mark.long
def test_devices_share_the_pairs_of_an_image_with_a_sky():
    found = scaling.counted(3000, 4, 1, has_sky=True)
    assert found["fullest_band"] < 1.15 < 1.5 < found["fullest_of_even_bands"] < 4
    assert found["least_bytes"] <= found["row_bytes"] < found["row_bytes_of_even_bands"]
    assert 0 < found["pixel_bytes"] < 2 * 4 * scaling.CHANNELS * scaling.WIDTH * scaling.HEIGHT * 3
    alone = scaling.counted(3000, 4, 4, has_sky=True)
    assert alone["fullest_band"] == 1 and alone["pixel_bytes"] == 0, "a view for each device"


@pytest.mark.long
def test_normals_of_splats_on_the_built_in_scene_are_those_of_its_shapes():
    for shape, _ in still_life(np.random.default_rng(0)):
        points, normals = shape.place(*np.random.default_rng(1).uniform(0.2, 0.8, (2, 50)).astype(np.float32))
        np.testing.assert_allclose(meshes.normals_at(points.T), normals.T, atol=1e-3)
