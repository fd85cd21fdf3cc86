"""What compiled programs leave behind."""

import jax
import jax.numpy as jnp
import pytest

from a2tg_jax.memory import keep_room_for_programs, return_free_memory


def told(folder, count: int, limit: str):
    """A folder in which the system tells of a process with so many pieces of memory."""
    for name in ("self", "sys/vm"):
        (folder / name).mkdir(parents=True)
    (folder / "self/maps").write_text("00-01 rw-p\n" * count)
    (folder / "sys/vm/max_map_count").write_text(limit)
    return folder


@pytest.mark.parametrize("count, limit, is_dropped", [(59, "100\n", False), (61, "100\n", True), (61, "many", False)])
def test_programs_are_dropped_before_there_is_no_room_for_more(tmp_path, count, limit, is_dropped):
    double = jax.jit(lambda x: 2 * x)
    double(jnp.ones(3))
    assert keep_room_for_programs(told(tmp_path, count, limit)) == is_dropped
    assert double._cache_size() == (0 if is_dropped else 1)
    assert float(double(jnp.ones(3))[0]) == 2


def test_without_such_a_system_nothing_happens(tmp_path):
    assert not keep_room_for_programs(tmp_path / "nowhere")
    return_free_memory()
