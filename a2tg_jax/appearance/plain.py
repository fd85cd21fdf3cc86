"""Plain 2DGS as an appearance, without parameters of its own."""

import dataclasses

import jax

from a2tg_jax.appearance.base import Appearance
from a2tg_jax.appearance.rule import PlainRule
from a2tg_jax.core.checks import described


@dataclasses.dataclass(frozen=True)
class Plain(Appearance):
    """Plain 2D Gaussians."""

    max_alpha: float = 0.99
    """Upper limit of alpha."""

    @property
    def is_portable(self) -> bool:
        return type(self) is Plain

    @property
    def is_linear(self) -> bool:
        return True

    def rule(self, params: tuple[()], layout: tuple[()]) -> PlainRule:
        if jax.tree.leaves((params, layout)):
            raise ValueError(
                f"model.params must be () for the appearance Plain; got {described(params)}: give the appearance that "
                "they belong to, as in Model(gaussians, textures, layout, appearance=Textured())"
            )
        return PlainRule(max_alpha=self.max_alpha)
