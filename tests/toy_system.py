"""A system of one's own in one file: what a splat shows, an event, a loss term, and the stage that composes them.

In the folder of this file, `a2tg train synthetic --system toy_system:Toy --out runs/toy` trains it.
"""

import dataclasses

import jax
import jax.numpy as jnp

import a2tg_jax as a2tg


@a2tg.pytree(kw_only=True)
class Rings(a2tg.Appearance):
    """Rings around the centre of each splat, added to its own colour; colourless at first."""

    rings: jax.Array | None = None
    """[N, 4] red, green, blue, and how narrow the rings are."""

    def allocate(self, key, gaussians):
        return dataclasses.replace(self, rings=jnp.zeros((gaussians.num, 4)).at[:, 3].set(2.0))

    def numbers(self, gaussians, camera):
        return self.rings

    def shade(self, numbers, values, u, v):
        red, green, blue, frequency = numbers
        wave = jnp.cos(frequency * (u * u + v * v))
        return (red * wave, green * wave, blue * wave), None


@a2tg.pytree
class Shrink(a2tg.StepEvent):
    """After every fifth iteration, scales above the average become smaller."""

    factor: float = 0.9

    def times(self, num_iterations):
        return range(5, num_iterations + 1, 5)

    def apply(self, now, model, moments, state):
        log_scales = model.gaussians.log_scales
        is_large = log_scales > jnp.mean(log_scales)
        log_scales = log_scales + jnp.where(is_large, jnp.log(self.factor), 0.0)
        gaussians = dataclasses.replace(model.gaussians, log_scales=log_scales)
        return a2tg.Change(dataclasses.replace(model, gaussians=gaussians), moments, state)


def contrast(model, target, output):
    """A loss term: rings are to earn their keep."""
    return jnp.mean(model.appearance.rings[:, :3] ** 2)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Toy(a2tg.System):
    """One stage of all that; the fields are the options, and flags of the command line."""

    stage1_iterations: int = 20
    factor: float = 0.9
    contrast_weight: float = 0.1
    """Weight of the contrast: larger values
    make rings fainter."""
    rings_rate: float = 1e-2

    name = "toy"

    def stages(self):
        losses = (*self.loss.terms(), a2tg.Term(contrast, self.contrast_weight))
        rings = Rings()
        events = (Shrink(self.factor),)
        return (a2tg.Stage("rings", rings, events, losses, self.rates, self.stage1_iterations, self.rings_rate),)
