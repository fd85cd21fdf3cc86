"""Programs are told apart by the classes of what they are given, where JAX may mistake one for another."""

import dataclasses

import jax
import jax.numpy as jnp

import a2tg_jax as a2tg
from a2tg_jax.core.jit import Jitted, classes_of
from a2tg_jax.events import Change
from a2tg_jax.mcmc import Noise
from a2tg_jax.results.plan import fingerprint, plan_run


def numbered(index: int) -> type:
    @jax.tree_util.register_dataclass
    @dataclasses.dataclass(frozen=True)
    class Numbered:
        scale: float

        def value(self, x):
            return x * self.scale + index

    return Numbered


def test_no_class_runs_the_program_of_another():
    """With `jax.jit`, about one in ten of so many does."""
    function = Jitted(lambda rule, x: rule.value(x))
    rules = [numbered(index)(2.0) for index in range(60)]
    assert [float(function(rule, jnp.float32(0))) for rule in rules] == list(range(60))
    assert function.num_compiled() == 60
    assert [float(function(rule, jnp.float32(1))) for rule in rules] == [2 + index for index in range(60)]
    assert function.num_compiled() == 60
    function.clear_cache()
    assert function.num_compiled() == 0


def test_classes_are_those_of_all_nodes():
    inner, outer = numbered(0), numbered(1)
    assert classes_of((outer(inner(1.0)), [None])) == (tuple, list, type(None), outer, inner)


def test_static_and_donated_arguments_are_counted_as_the_function_has_them():
    function = Jitted(lambda name, x, y: x + y if name == "add" else x - y, static_argnums=(0,), donate_argnums=(2,))
    gone = jnp.ones(3)
    assert float(function("add", jnp.ones(3), gone)[0]) == 2 and gone.is_deleted()
    assert float(function("subtract", jnp.ones(3), jnp.ones(3))[0]) == 0


def test_systems_that_differ_in_a_class_share_no_stage():
    @a2tg.event
    class Still(Noise):
        def apply(self, now, model, moments, state):
            return Change(model, moments, state)

    class Quiet(a2tg.A2tg):
        def stages(self):
            first, second = super().stages()
            events = tuple(Still() if isinstance(event, Noise) else event for event in first.events)
            return dataclasses.replace(first, events=events), second

    shared = plan_run({"a": a2tg.A2tg(), "b": a2tg.A2tg()})
    apart = plan_run({"a": a2tg.A2tg(), "b": Quiet()})
    assert len(shared.stages) == 2 and len(apart.stages) == 4
    assert fingerprint(a2tg.A2tg(), 0) != fingerprint(Quiet(), 0)
