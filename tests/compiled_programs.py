"""Programs that JAX compiles, counted by its monitoring events."""

import contextlib

import jax


@contextlib.contextmanager
def compiled_programs(name):
    """Yields a list with an entry for each program of a jitted function of that name that the block compiles."""
    programs = []

    def add(event, seconds, fun_name="", **_):
        if event == "/jax/core/compile/backend_compile_duration" and fun_name == f"jit({name})":
            programs.append(seconds)

    jax.monitoring.register_event_duration_secs_listener(add)
    try:
        yield programs
    finally:
        jax.monitoring.unregister_event_duration_listener(add)
