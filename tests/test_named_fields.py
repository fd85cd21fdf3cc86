"""Misspelt fields of every public dataclass, and of those that users derive."""

import copy
import dataclasses
import inspect
import pickle

import jax
import pytest

import a2tg_jax as a2tg

PUBLIC = [getattr(a2tg, name) for name in dir(a2tg) if not name.startswith("_")]
CLASSES = [each for each in PUBLIC if inspect.isclass(each) and dataclasses.is_dataclass(each)]


@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: kind.__name__)
def test_every_public_dataclass_names_the_field_that_was_meant(kind):
    fields = [field.name for field in dataclasses.fields(kind) if field.init]
    for name in fields:
        misspelt = f"{name}x"
        with pytest.raises(ValueError, match=f"^{kind.__name__} has no field '{misspelt}'; did you mean .*{name}") as e:
            kind(**{misspelt: 1})
        assert isinstance(e.value, TypeError)
    # Tools read these.
    assert list(inspect.signature(kind).parameters) == fields


@dataclasses.dataclass(frozen=True, kw_only=True)
class Own(a2tg.A2tg):
    strength: float = 1.0


@a2tg.pytree
class OwnEvent(a2tg.StepEvent):
    strength: float = 1.0


class Undecorated(a2tg.A2tg):
    strength: float = 1.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class WithConstructor(a2tg.A2tg):
    def __init__(self, name, *, seeds=3):
        super().__init__(seed=seeds)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: a2tg.A2tg(iterations=30), "A2tg has no field 'iterations'; did you mean stage1_iterations or stage2"),
        (lambda: a2tg.Gaussians(scales=1), "Gaussians has no field 'scales'; did you mean log_scales?"),
        (lambda: dataclasses.replace(a2tg.A2tg(), sedd=1), "A2tg has no field 'sedd'; did you mean seed?"),
        (lambda: a2tg.Similarity(zoom=1), "Similarity has no field 'zoom': it has scale, rotation, translation"),
        (
            lambda: a2tg.A2tg("quick"),
            "no values by position; got 1: .* batch_size=…, and presets as A2tg.preset..quick",
        ),
        (lambda: a2tg.Mcmc(1, 2), "Mcmc takes up to 1 value by position; got 2: give fields by name, such as cap=…"),
        (lambda: Own(strenght=2.0), "Own has no field 'strenght'; did you mean strength?"),
        (lambda: OwnEvent(strenght=2.0), "OwnEvent has no field 'strenght'; did you mean strength?"),
        (lambda: Undecorated(strength=2.0), "Undecorated does not take strength: decorate the class"),
    ],
)
def test_the_mistake_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_constructors_and_copies_work_as_before():
    assert WithConstructor("any", seeds=5).seed == 5
    for value in (Own(strength=2.0), OwnEvent(2.0), a2tg.RenderSettings(tile_size=4)):
        assert pickle.loads(pickle.dumps(value)) == copy.deepcopy(value) == dataclasses.replace(value) == value
    with pytest.raises(TypeError, match="missing 2 required positional arguments"):
        a2tg.Gaussians(1, 2, 3)
    assert jax.tree.map(lambda x: 2 * x, OwnEvent(2.0)).strength == 4.0
