"""Capacities of tile lists: enough, few, and at most twice what was asked for."""

import pytest

from a2tg_jax.rasterize.room import TileRoom


@pytest.mark.parametrize("head_room", [1.0, 1.25, 4.0])
def test_a_capacity_is_enough_and_at_most_half_as_large_again(head_room):
    numbers = [*range(1000, 5000, 7), 3 * 2**20, 3 * 2**20 + 1, 10**9]
    planned = [TileRoom().plan("view", pairs, head_room) for pairs in numbers]
    for pairs, capacity in zip(numbers, planned, strict=True):
        assert head_room * pairs <= capacity <= max(1.5 * head_room * pairs, 1024)
    assert len(set(planned)) <= 10, "programs are compiled for each"


def test_a_capacity_stays_while_it_is_enough_and_not_too_large():
    """So trainings of a sweep share their programs."""
    room = TileRoom()
    first = room.plan("view", 10_000, 1.0)
    assert room.plan("view", first, 1.0) == room.plan("view", first // 2, 1.0) == first
    assert room.plan("other", first // 4, 1.0) < first
    assert room.plan("view", first // 4, 1.0) < first < room.plan("view", first + 1, 1.0)


def test_a_full_list_gets_at_least_twice_the_room():
    room = TileRoom({"view": 1024})
    assert [room.enlarge("view") for _ in range(3)] == [2048, 4096, 8192]
    capacity = room.enlarge("view", 10**6)
    assert 1.25e6 <= capacity <= 2e6 and room.capacities == {"view": capacity}
