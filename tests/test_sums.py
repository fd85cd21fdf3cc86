"""Cotangents summed over parts of the tiles: the same bits as with a full copy for each part, in less memory."""

import itertools

import numpy as np
import pytest

from a2tg_jax.rasterize.kernels.native.composite import SumsOfParts, _overlap

NUM, NUM_TILES, COLUMNS = 300, 40, 4


def draw_lists(rng):
    """ids [pairs] and starts [tiles + 1]; a splat is in a few tiles that follow each other."""
    first = rng.integers(0, NUM_TILES, NUM)
    tiles = [np.flatnonzero((first <= t) & (t < first + rng.integers(1, 6, NUM))) for t in range(NUM_TILES)]
    starts = np.cumsum([0, *map(len, tiles)]).astype(np.int32)
    return np.concatenate([*tiles, np.full(50, NUM - 1)]).astype(np.int32), starts


def draw_images(rng, is_shared: bool):
    """[N, 3] and the length of the table."""
    sizes = rng.integers(1, 4, (NUM, 2))
    ends = np.cumsum(sizes.prod(1))
    order = rng.permutation(NUM)  # images need not be in the order of their splats
    first = np.empty(NUM, np.int64)
    first[order] = np.cumsum(sizes[order].prod(1)) - sizes[order].prod(1)
    first = first // 2 if is_shared else first
    return np.concatenate([first[:, None], sizes], axis=1).astype(np.int32), int(ends[-1])


def results_of(length: int, has_probe: bool):
    return [np.full(shape, 7, np.float32) for shape in ((NUM, 5), (length, COLUMNS), (NUM if has_probe else 1, 4))]


def add(ids, starts, part, images, splats, texels, probe, places=None, *more):
    """What a thread does, in numpy: with the extra rows that the loop is given, or without places in its own copy."""
    for position in range(starts[part[0]], starts[part[1]]):
        numbers = np.random.default_rng(position).normal(size=5).astype(np.float32)
        splat = ids[position]
        place = -1 if places is None else places[position]
        row, own = (splat, (splats, texels, probe)) if place < 0 else (place, more)
        own[0][row] += numbers
        if len(probe) == NUM:
            own[2][row] += numbers[:4]
        first, height, width = images[splat]
        first = first if place < 0 else more[3][place]
        own[1][first : first + height * width] += numbers[:COLUMNS]


@pytest.mark.parametrize("is_shared", [False, True])
@pytest.mark.parametrize("has_probe", [False, True])
@pytest.mark.parametrize("borders", [[0, 40], [0, 13, 40], [0, 9, 10, 10, 25, 40]])
def test_sums_are_those_of_full_copies(borders, has_probe, is_shared):
    rng = np.random.default_rng(0)
    ids, starts = draw_lists(rng)
    images, length = draw_images(rng, is_shared)
    assert _overlap(images) == is_shared
    parts = list(itertools.pairwise(borders))
    copies = [[np.zeros_like(x) for x in results_of(length, has_probe)] for _ in parts]
    for part, copy in zip(parts, copies, strict=True):
        add(ids, starts, part, images, *copy)
    expected = [sum(more, start=first) for first, *more in zip(*copies, strict=True)]

    found = results_of(length, has_probe)
    room = SumsOfParts(ids, starts, images, found, parts)
    for index in np.random.default_rng(1).permutation(len(parts)):
        add(ids, starts, parts[index], images, *room.outputs(index))
    room.add_up()
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_array_equal(a.view(np.int32), b.view(np.int32))


def test_a_part_has_room_for_what_it_shares_only():
    """1,000 splats, each in its own tile, but 3 of them in two, on both sides of a border."""
    num = 1_000
    ids = np.concatenate([np.arange(500), [7, 8, 9], np.arange(500, num)]).astype(np.int32)
    starts = np.concatenate([np.arange(500), np.arange(503, num + 4)]).astype(np.int32)
    images = np.stack([np.arange(num) * 16, *np.full((2, num), 4)], axis=1).astype(np.int32)
    results = [np.ones((num, 17), np.float32), np.ones((16 * num, 4), np.float32), np.ones((1, 4), np.float32)]
    room = SumsOfParts(ids, starts, images, results, [(0, 499), (499, num)])
    assert room.splats.tolist() == [7, 8, 9]
    _, _, _, _, more_splats, more_texels, *_ = room.outputs(1)
    assert more_splats.shape == (3, 17) and more_texels.shape == (48, 4)
    assert not any(result.any() for result in results)
