"""A system of one's own in one file: a splat rule, an event and a loss term, and the stage that composes them."""

import dataclasses

import jax
import jax.numpy as jnp

import a2tg_jax as a2tg


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class RingsRule(a2tg.PlainRule):
    """Rings around the centre of each splat, in a colour and at a width of its own, [N, 4]."""

    rings: jax.Array

    def numbers(self, gaussians, camera):
        return self.rings

    def shade(self, numbers, values, u, v):
        red, green, blue, frequency = numbers
        wave = jnp.cos(frequency * (u * u + v * v))
        return (red * wave, green * wave, blue * wave), None


@dataclasses.dataclass(frozen=True)
class Rings(a2tg.Appearance):
    """Splats with rings."""

    frequency: float = 2.0

    def allocate(self, key, gaussians):
        return jnp.zeros((gaussians.num, 4)).at[:, 3].set(self.frequency), ()

    def rule(self, params, layout) -> a2tg.AppearanceRule:
        return RingsRule(rings=params)


@a2tg.event
class Shrink(a2tg.StepEvent):
    """Every so many iterations the largest splats become a little smaller."""

    factor: float = 0.9

    num_keys = 0

    def times(self, num_iterations):
        return a2tg.Times(5, num_iterations, 5)

    def apply(self, now, model, moments, state):
        gaussians = model.gaussians
        largest = jnp.mean(gaussians.log_scales)
        smaller = jnp.where(gaussians.log_scales > largest, jnp.log(self.factor), 0.0)
        gaussians = dataclasses.replace(gaussians, log_scales=gaussians.log_scales + smaller)
        return a2tg.Change(dataclasses.replace(model, gaussians=gaussians), moments, state)


def ring_contrast(model, target, output):
    """Mean squared contrast of the rings: rings are to earn their keep."""
    return jnp.mean(model.params[:, :3] ** 2)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Toy(a2tg.System):
    """Rings that shrink."""

    iterations: int = 20
    frequency: float = 2.0
    factor: float = 0.9
    contrast_weight: float = 0.1
    rings_rate: float = 1e-2

    name = "toy"

    def stages(self):
        losses = (*self.loss.terms(), a2tg.Term(ring_contrast, self.contrast_weight))
        rings, events = Rings(self.frequency), (Shrink(self.factor),)
        return (a2tg.Stage("rings", rings, events, losses, self.rates, self.iterations, self.rings_rate),)
