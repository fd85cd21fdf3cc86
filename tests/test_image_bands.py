"""Bands of an image and several views at once, as several devices draw them. `on_devices` composites with both."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes_random import as_camera, as_gaussians, draw_scene

from a2tg_jax.core.geometry import homographies, screen_bounds
from a2tg_jax.parallel.exchange import (
    BorderRoom,
    ImageBands,
    map_views,
    of_all_views,
    of_own_view,
    value_and_grad_of_views,
)
from a2tg_jax.rasterize.tiles import TileGrid, tile_lists, tile_rectangles

TILE = 8


def bands_of(rows, num):
    return ImageBands.of(TileGrid(40, rows * TILE, TILE), num)


def least_largest(pairs, num):
    """The least possible number of pairs of the fullest band, found by trying every cut of the first rows."""
    sums = np.concatenate([[0], np.cumsum(pairs)])
    least = sums.astype(float)
    for _ in range(num - 1):
        least = np.array([np.maximum(least[: end + 1], sums[end] - sums[: end + 1]).min() for end in range(len(sums))])
    return least[-1]


def profiles(rows):
    rng = np.random.default_rng(0)
    spread = np.arange(rows)
    yield "even", np.full(rows, 700)
    yield "nothing", np.zeros(rows, int)
    yield "upper quarter", np.where(spread < rows // 4, 900, 0)
    yield "last row", np.where(spread == rows - 1, 50, 0)
    yield "sky", np.where(spread < rows // 3, 40, 1000) + rng.integers(0, 30, rows)
    yield "noise", rng.integers(0, 2000, rows)


@pytest.mark.parametrize("rows, num", [(133, 8), (133, 64), (67, 2), (7, 4), (3, 4)])
def test_the_fullest_band_has_few_pairs(rows, num):
    for name, pairs in profiles(rows):
        borders = np.asarray(bands_of(rows, num).borders(jnp.asarray(pairs, jnp.int32)))
        assert borders[0] == 0 and borders[-1] == rows and (np.diff(borders) >= 0).all(), name
        largest = max(pairs[first:end].sum() for first, end in itertools.pairwise(borders))
        assert largest <= 1.11 * least_largest(pairs, num) + pairs.max(), name


def test_counts_near_the_largest_integer_are_cut_evenly():
    borders = bands_of(128, 4).borders(jnp.full(128, 2**31 - 1, jnp.int32))
    np.testing.assert_array_equal(borders, [0, 32, 64, 96, 128])


def test_an_even_image_needs_no_room_and_room_bounds_bands():
    bands = bands_of(64, 4)
    assert bands.room_for(jnp.arange(0, 65, 16, dtype=jnp.int32)).tolist() == [0, 0]
    borders = bands.borders(jnp.asarray(np.where(np.arange(64) < 16, 900, 0), jnp.int32))
    above, below = bands.room_for(borders).tolist()
    assert above > 20 * TILE and below == 0, "all borders move up"
    own = ImageBands.of(bands.whole, 4, BorderRoom(above, below)).own
    assert int(np.diff(borders).max()) <= own.rows < bands.whole.rows
    assert [hop.bands for hop in ImageBands.of(bands.whole, 4, BorderRoom(0, 0)).hops()] == [0]


@pytest.mark.parametrize("tile, height, num", [(8, 3, 2), (8, 9, 3), (8, 17, 16), (8, 65, 64), (16, 17, 3), (8, 64, 4)])
def test_the_largest_room_is_for_any_borders(tile, height, num):
    """Also if the devices' rows, or the tiles, end below the image."""
    bands = ImageBands.of(TileGrid(40, height, tile), num)
    rows = bands.whole.rows
    for pairs in (np.zeros(rows), *(1000 * np.eye(rows))):
        borders = bands.borders(jnp.asarray(pairs, jnp.int32))
        assert (np.asarray(bands.room_for(borders)) <= np.asarray(bands.room)).all()
        np.testing.assert_array_equal(bands.sums(jnp.asarray(pairs, jnp.int32), borders).sum(), pairs.sum())


@pytest.mark.long
def test_rows_of_tiles_have_the_pairs_of_the_lists():
    scene = draw_scene(3, num=200, width=64, height=45)
    M, _ = homographies(as_gaussians(scene, "float32"), as_camera(scene, "float32"))
    cutoff, grid = jnp.full(200, 9.0), TileGrid(64, 45, TILE)
    boxes = tile_rectangles(screen_bounds(M, cutoff, 0.2), grid)
    bands = ImageBands.of(grid, 3)
    pairs = np.asarray(bands.pairs_of_rows(boxes))
    pairs_above = jax.jit(lambda height: tile_lists(M, cutoff, 0.2, grid, 1 << 15, height=height).num_pairs)
    sums = [float(pairs_above(jnp.int32(min(45, end * TILE)))) for end in range(grid.rows + 1)]
    np.testing.assert_array_equal(pairs, np.diff(sums))
    assert (pairs > 0).all()
    borders = bands.borders(jnp.asarray(pairs))
    reached = np.asarray(bands.reached(boxes, borders))
    first, end = np.asarray(boxes.y0), np.asarray(boxes.y0 + boxes.counts // jnp.maximum(boxes.columns, 1))
    for band, (top, bottom) in enumerate(itertools.pairwise(np.asarray(borders))):
        is_reached = (np.asarray(boxes.counts) > 0) & (np.maximum(first, top) < np.minimum(end, bottom))
        np.testing.assert_array_equal(reached[band], is_reached)


@pytest.mark.parametrize("num_at_once", [2, 4])
def test_views_at_once_have_the_values_and_gradients_of_one_view_after_the_other(num_at_once):
    rng = np.random.default_rng(0)
    gaussians, params, probe = jnp.asarray(rng.normal(size=(5, 3))), jnp.asarray(0.7), jnp.zeros((5, 3))
    rows, views = jnp.asarray(rng.normal(size=(4, 3))), jnp.asarray(rng.normal(size=(4, 5)))

    def loss_of(draw):
        def loss(gaussians, params, rows, probe, view):
            shown = draw(gaussians * params + rows[None]) + probe
            return jnp.sum(view[:, None] * shown**2), shown[0]

        return loss

    def differentiated(derivative):
        def run(arrays):
            value, (by_gaussians, by_params, *others) = derivative(gaussians, params, arrays[0], probe, arrays[1])
            return (value, by_gaussians, others), by_params

        return run

    # What a view shows, twice its own, computed for all views at once.
    together = value_and_grad_of_views(loss_of(lambda x: of_own_view(2 * of_all_views(x))), num_at_once, 0)
    one = jax.value_and_grad(loss_of(lambda x: 2 * x), argnums=(0, 1, 2, 3), has_aux=True)
    expected, by_params = jax.lax.map(differentiated(one), (rows, views))
    found, means = jax.jit(lambda arrays: map_views(differentiated(together), arrays, num_at_once))((rows, views))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(b, a, rtol=1e-5), expected, found)
    np.testing.assert_allclose(jnp.mean(means), jnp.mean(by_params), rtol=1e-5)
