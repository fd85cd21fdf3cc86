"""Mistakes in stages, events and loss terms of one's own: each is an error that names the stage and the part."""

import dataclasses
import functools
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import a2tg_jax as a2tg
from a2tg_jax.appearance import Exponents
from a2tg_jax.rasterize.views import render_traced
from a2tg_jax.training.corrections import Exposure
from a2tg_jax.training.terms import Photometric, l1


@pytest.fixture(scope="module")
def scene():
    return a2tg.synthetic_scene(num_views=3, width=16, height=16, num_points=50)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Own(a2tg.System):
    """One stage, some of whose fields are given."""

    given: Any = None

    def stages(self):
        first = a2tg.Stage("own", a2tg.Appearance(), (), (Photometric(),), self.rates, 2)
        return (dataclasses.replace(first, **self.given),)


def own(**given):
    return Own(given=given, loss=a2tg.LossConfig(ssim_weight=0))


def roughness(model, target, output):
    return jnp.mean(jnp.abs(jnp.diff(output.depth, axis=0)))


def each_pixel(model, target, output):
    return jnp.abs(output.color - target.image)


class Undecorated(a2tg.StepEvent):
    pass


@a2tg.pytree
class Named(a2tg.StepEvent):
    title: str = "a"


@a2tg.pytree
class Never(a2tg.HostEvent):
    def iterations(self, num_iterations):
        return (0.5,)


@a2tg.pytree
class Always(a2tg.HostEvent):
    """At all times if its period is 0; removes everything."""

    every: int = 1

    def iterations(self, num_iterations):
        return tuple(range(self.every, num_iterations + 1, self.every))

    def apply(self, due, model, moments, state):
        return a2tg.keep_rows(model, moments, state, np.zeros(len(model.gaussians.means), bool))


@a2tg.pytree
class Unending(a2tg.StepEvent):
    def times(self, num_iterations):
        return a2tg.Times(1, num_iterations, 0)


@a2tg.pytree
class Returning(a2tg.StepEvent):
    """Returns one of several things."""

    what: str = a2tg.static(default="tuple")

    def apply(self, now, model, moments, state):
        halved = dataclasses.replace(model, gaussians=model.gaussians[::2])
        results = {
            "tuple": (model, moments, state),
            "model": a2tg.Change(model.gaussians, moments, state),
            "half": a2tg.Change(halved, moments, state),
            "state": a2tg.Change(model, moments, (now.iteration,)),
        }
        return results[self.what]


@a2tg.pytree
class OnHost(a2tg.HostEvent):
    def iterations(self, num_iterations):
        return (1,)

    def apply(self, due, model, moments, state):
        return model


@a2tg.pytree
class Observing(a2tg.StepEvent):
    observes = True

    def observe(self, state, model, seen):
        return seen.colors

    def apply(self, now, model, moments, state):
        return a2tg.Change(model, moments, state)


WRONG = {
    "camera": lambda self, row, camera: row,
    "color": lambda self, row, color: color.mean((0, 1)),
    "penalty": lambda self, row: row,
    "learning_rate": lambda self, progress: None,
    "project": lambda self, rows: rows[:1],
}


@a2tg.pytree
class Correcting(Exposure):
    """A correction of which one method returns something wrong."""

    wrong: str = a2tg.static(default="camera")

    def __getattribute__(self, name):
        if name in WRONG and name == object.__getattribute__(self, "wrong"):
            return functools.partial(WRONG[name], self)
        return super().__getattribute__(name)


GIVEN = {
    "stage 'own': appearance must be an Appearance; got the class Appearance: say Appearance(…)": {
        "appearance": a2tg.Appearance
    },
    "stage 'own': rates must be LearningRates; got float": {"rates": 0.1},
    "stage 'own': appearance_rate must be the learning rate of the arrays of Gaussians with exponents, such as": {
        "appearance": a2tg.Appearance(exponents=Exponents()),
        "appearance_rate": None,
    },
    "stage 'own': appearance_rate must be the learning rate of the arrays of Gaussians with texture": {
        "appearance": a2tg.Appearance(texture=a2tg.Texture())
    },
    "stage 'own': iterations must be an integer; got '30'": {"iterations": "30"},
    "stage 'own': events must be a tuple or a list; got Noise: one of them stands in (…,)": {"events": a2tg.Noise()},
    "stage 'own': events[1] must be a StepEvent or a HostEvent; got the class Noise: say Noise(…)": {
        "events": (a2tg.Noise(), a2tg.Noise)
    },
    "stage 'own': events[0] must be a pytree: decorate the class Undecorated": {"events": (Undecorated(),)},
    "stage 'own': events[0] must hold numbers; got 'a': make fields of Named": {"events": (Named(),)},
    "stage 'own': Never.iterations must return ascending integers in a tuple; got (0.5,)": {"events": (Never(),)},
    "stage 'own': Always.iterations: range() arg 3 must not be zero": {"events": (Always(0),)},
    "stage 'own': Unending.times: every must be at least 1; got 0": {"events": (Unending(),)},
    "stage 'own': losses must be a tuple or a list; got function": {"losses": roughness},
    "stage 'own': losses must have a term": {"losses": ()},
    "stage 'own': losses[0] must be a loss term, such as Term(function); got function: say Term(roughness)": {
        "losses": (roughness,)
    },
    "stage 'own': losses[0] must be a loss term, such as Term(function); got the class": {"losses": (Photometric,)},
    "stage 'own': corrections[0] must be a Correction; got str": {"corrections": ("exposure",)},
}


@pytest.mark.parametrize("message", GIVEN)
def test_a_part_of_the_wrong_kind_is_named(message):
    with pytest.raises(ValueError, match=re.escape(message)):
        own(**GIVEN[message]).stages()[0].check()


RETURNED = {
    "stage 'own': Returning.apply: the result must be a Change; got tuple": {"events": (Returning(),)},
    "stage 'own': Returning.apply: model must be a Model; got Gaussians": {"events": (Returning("model"),)},
    "stage 'own': Returning.apply: moments.mu.gaussians.means must be [": {"events": (Returning("half"),)},
    "stage 'own': Returning.apply: state must keep its structure": {"events": (Returning("state"),)},
    "stage 'own': Observing.observe must keep its structure": {"events": (Observing(),)},
    "stage 'own': OnHost.apply: the result must be a Change; got Model": {"events": (OnHost(),)},
    "stage 'own': Always.apply: is_kept must keep at least 2 Gaussians; got 0 of 50": {"events": (Always(),)},
    "the loss function 'each_pixel' must return a scalar, such as jnp.mean(…); got float32[16, 16, 3]": {
        "losses": (a2tg.Term(each_pixel),)
    },
    "the loss function '<lambda>' must return a scalar, such as jnp.mean(…); got None": {
        "losses": (a2tg.Term(lambda *_: None),)
    },
    "Correcting.camera must keep its structure": {"corrections": (Correcting(wrong="camera"),)},
    "Correcting.color must be [16, 16, 3]; got [3]": {"corrections": (Correcting(wrong="color"),)},
    "Correcting.penalty must return a scalar": {"corrections": (Correcting(wrong="penalty"),)},
    "Correcting.learning_rate must return a scalar": {"corrections": (Correcting(wrong="learning_rate"),)},
    "Correcting.project must be [": {"corrections": (Correcting(wrong="project"),)},
    "target.points was not loaded: say has_points=True, as in Term(function, has_points=True)": {
        "losses": (a2tg.Term(lambda model, target, output: target.points.depths.sum()),)
    },
    "target.depth was not loaded: say has_depths=True": {
        "losses": (a2tg.Term(lambda model, target, output: target.depth.sum()),)
    },
    "depth was not rendered: say has_geometry=True, as in Term(function, has_geometry=True)": {
        "losses": (Photometric(), a2tg.Term(roughness))
    },
}


@pytest.mark.parametrize("message", RETURNED)
def test_a_wrong_result_is_named(scene, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        a2tg.fit(scene, own(**RETURNED[message]), progress=False)


def test_depth_that_was_not_rendered_is_no_zero(scene):
    model, camera = a2tg.Model(a2tg.init_from_points(scene.points, scene.colors)), scene.test[0].camera
    settings = a2tg.RenderSettings(capacity=64, compositor="xla", supersample=2)

    def shown(has_geometry):
        arguments = model.gaussians, camera, model.appearance, jnp.zeros(3), settings
        return render_traced(*arguments, has_geometry=has_geometry)[0]

    assert jax.eval_shape(lambda: roughness(model, None, shown(True))).shape == ()
    with pytest.raises(ValueError, match="depth was not rendered: say has_geometry=True"):
        jax.eval_shape(lambda: roughness(model, None, shown(False)))
    output = jax.eval_shape(lambda: shown(False))
    assert output.alpha.shape == (16, 16) and output.geometry is None
    for name in ("depth", "normal", "distortion"):
        with pytest.raises(ValueError, match=f"{name} was not rendered"):
            getattr(output, name)


def test_photographs_too_small_for_ssim_are_refused_before_anything_compiles(scene):
    """Unless the loss has none."""
    tiny = a2tg.synthetic_scene(num_views=3, width=10, height=10, num_points=50)
    told = "has 10 by 10 pixels, but the loss has SSIM, which needs 11 by 11: take larger photographs, or set"
    with pytest.raises(ValueError, match=told):
        a2tg.fit(tiny, own(losses=(Photometric(1),)), progress=False)
    assert a2tg.fit(tiny, own(losses=(a2tg.Term(l1),)), progress=False).model.num == 50


def test_terms_of_ones_own_want_depth_maps_and_points(scene):
    views = tuple(dataclasses.replace(view, points=None) for view in scene.train)
    without = dataclasses.replace(scene, train=views)
    for flag, told in (("has_depths", "needs depth maps"), ("has_points", "needs points that photographs observed")):
        term = a2tg.Term(lambda model, target, output: 0.0 * output.color.sum(), **{flag: True})
        with pytest.raises(ValueError, match=f"or a custom term, {told}"):
            a2tg.fit(without, own(losses=(Photometric(), term)), progress=False)
    seen = a2tg.Term(
        lambda model, target, output: target.points.depths.mean() + 0 * output.color.sum(), has_points=True
    )
    assert a2tg.fit(scene, own(losses=(Photometric(), seen)), progress=False).model.num == 50
