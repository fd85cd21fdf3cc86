"""Plain 2DGS as an appearance: no parameters besides the Gaussians' own."""

import dataclasses

from a2tg_jax.appearance.base import Appearance
from a2tg_jax.appearance.rule import PlainRule


@dataclasses.dataclass(frozen=True)
class Plain(Appearance):
    """Plain 2DGS."""

    max_alpha: float = 0.99
    """Alpha never exceeds it."""

    def rule(self, params: tuple, layout: tuple) -> PlainRule:
        return PlainRule(max_alpha=self.max_alpha)
