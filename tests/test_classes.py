"""Programs are told apart by the classes of what they are given, where JAX may mistake one for another."""

import copy
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled_programs import compiled_programs
from lab.fingerprint import fingerprint

import a2tg_jax as a2tg
from a2tg_jax import Change, Noise
from a2tg_jax.core.pytree import beside
from a2tg_jax.results.plan import plan_run


def appearance_of(index: int) -> type:
    @a2tg.pytree
    class Own(a2tg.Appearance):
        def falloff(self, numbers, rho):
            return jnp.exp(-0.5 * rho) + index

    return Own


def test_no_class_runs_the_program_of_another():
    """Under `register_dataclass`, one in five subclasses does."""

    @jax.jit
    def falloff(appearance, rho):
        return appearance.falloff((), rho)

    made = [appearance_of(index)() for index in range(60)]
    with compiled_programs("falloff") as programs:
        for _ in range(2):
            assert [float(falloff(appearance, jnp.float32(0))) for appearance in made] == list(range(1, 61))
    assert len(programs) == 60


def test_fields_are_arrays_static_or_beside():
    @a2tg.pytree
    class Parts:
        array: jax.Array
        choice: str = a2tg.static(default="a")
        note: str | None = beside(default=None)

    one = Parts(jnp.ones(2), note="kept here")
    assert jax.tree.leaves(one) == [one.array] and jax.tree.structure(one) == jax.tree.structure(Parts(one.array))
    assert jax.tree.structure(one) != jax.tree.structure(Parts(one.array, "b"))
    made = jax.jit(lambda parts: parts)(one)
    assert made.note is None and made.choice == "a" and one.note == "kept here"
    assert [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(one)] == [".array"]


def test_arrays_are_compared_as_a_whole():
    scene = a2tg.synthetic_scene(num_views=4, width=24, height=18)
    cameras = [view.camera for view in scene.train]
    gaussians = a2tg.init_from_points(scene.points, scene.colors, num=20, sh_degree=0)
    textures = a2tg.allocate_textures([(2, 2)] * 20)
    model = a2tg.Model(gaussians, a2tg.Appearance(texture=a2tg.Texture(textures)))
    for value in (cameras[0], gaussians, textures, model):
        assert value == copy.deepcopy(value) and value == jax.tree.map(np.asarray, value)
        assert value != jax.tree.map(lambda leaf: leaf + 1, value) and value != "another kind"
        with pytest.raises(TypeError, match="unhashable"):
            hash(value)
    assert copy.deepcopy(cameras[1]) in cameras and cameras.index(copy.deepcopy(cameras[1])) == 1
    assert cameras[0] != dataclasses.replace(cameras[0], width=25) and gaussians != gaussians[:10]
    assert model != dataclasses.replace(model, background=(1.0, 1.0, 1.0))
    with pytest.raises(jax.errors.TracerArrayConversionError):
        jax.jit(lambda one, other: one == other)(gaussians, copy.deepcopy(gaussians))
    assert {a2tg.Mcmc(cap=2): "found"}[a2tg.Mcmc(cap=2)] == "found"


def test_an_assignment_says_how_to_make_a_changed_copy():
    """Of pytrees; other dataclasses have Python's own error."""
    scene = a2tg.synthetic_scene(num_views=4, width=24, height=18)
    for value in (scene.train[0].camera, a2tg.Mcmc(), NoArrays()):
        name = dataclasses.fields(value)[0].name
        with pytest.raises(dataclasses.FrozenInstanceError, match=rf"dataclasses.replace\(old, {name}=...\)"):
            setattr(value, name, 1)
        with pytest.raises(AttributeError, match=f"no field widht, only .*{name}"):
            value.widht = 1


@a2tg.pytree
class NoArrays:
    number: int = 1


def test_transformations_do_not_check_fields():
    @a2tg.pytree
    class Checked:
        array: jax.Array

        def __post_init__(self):
            if not hasattr(self.array, "shape"):
                raise ValueError("array must be one")

    assert jax.tree.map(lambda leaf: None, Checked(jnp.ones(2))).array is None
    with pytest.raises(ValueError, match="array must be one"):
        Checked(1)


def test_systems_that_differ_in_a_class_share_no_stage():
    @a2tg.pytree
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
