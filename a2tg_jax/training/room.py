"""Room for the views of a stage: planned before the first step, and more of it after a step that had too little.

Steps are compiled for a capacity of the tile lists, which holds pairs of splat and tile. Several devices also need room
for the rows that travel between them and for the borders between their bands.
"""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp

from a2tg_jax.core.cameras import Camera
from a2tg_jax.data import View
from a2tg_jax.model import Model
from a2tg_jax.rasterize.capacity import capacity_for, pairs_of_view, room_of_view
from a2tg_jax.rasterize.exchange import Exchange
from a2tg_jax.rasterize.image_bands import BorderRoom
from a2tg_jax.rasterize.render_types import RenderSettings
from a2tg_jax.training.session import Session
from a2tg_jax.training.stage import Stage

Size = tuple[int, int]
"""Height and width of a view, in pixels."""
PLANNED_VIEWS = 64
"""Largest number of views that room is planned for."""
GROWTH_ROOM = 1.5
"""Room as a multiple of what the present model needs."""
SURELY_FITTING = 0.999
"""Share of the capacity that surely holds pairs whose number is rounded."""


class StageRoom:
    """Room for the views of a stage, by their size."""

    def __init__(
        self, stage: Stage, views: Sequence[View], tile_size: int, exchange: Exchange | None, session: Session
    ):
        """Args:
        stage: whose steps are compiled for the room.
        views: all views of the training.
        tile_size: in pixels.
        exchange: between the devices that draw together; None: one device.
        session: knows capacities that steps are compiled for.
        """
        self.capacities: dict[Size, int] = {}
        self.exchanges: dict[Size, Exchange] = {}
        self._stage, self._views, self._tile_size = stage, views, tile_size
        self._exchange, self._session = exchange, session

    def settings(self, size: Size, model: Model) -> RenderSettings:
        """Return settings with room for the views of a size, which is planned before the first of them."""
        settings = RenderSettings(tile_size=self._tile_size)
        if size not in self.capacities:
            self._plan(size, model, settings)
        return dataclasses.replace(settings, capacity=self.capacities[size], exchange=self.exchanges.get(size))

    def widen(self, size: Size, model: Model, num_pairs: float) -> None:
        """Make room for views of a size with so many pairs or, if there was enough, for the borders between bands."""
        exchange = self.exchanges.get(size)
        if exchange is None or exchange.border_room is None or num_pairs > SURELY_FITTING * self.capacities[size]:
            self.capacities[size] = self._capacity(size, model, num_pairs * GROWTH_ROOM)
        else:
            room = exchange.border_room.wider()
            covers_image = min(room) >= size[0] + self._tile_size
            self.exchanges[size] = dataclasses.replace(exchange, border_room=None if covers_image else room)

    def _plan(self, size: Size, model: Model, settings: RenderSettings) -> None:
        """Plan for a sample of the views of a size, and for all rows of the model to exist."""
        dtype, rule = model.gaussians.means.dtype, model.rule
        views = [view for view in self._views if view.picture.size == size]
        sample = views[:: -(-len(views) // PLANNED_VIEWS)]
        cameras = [jax.tree.map(lambda x: jnp.asarray(x, dtype), view.camera) for view in sample]
        pairs = max(pairs_of_view(model.gaussians, camera, rule, settings, model.num_live) for camera in cameras)
        growth = (model.gaussians.num / max(model.num, 1)) ** 0.5
        self.capacities[size] = self._capacity(size, model, pairs * GROWTH_ROOM * growth)
        if self._exchange is not None:
            self.exchanges[size] = self._planned_exchange(self._exchange, model, cameras, self.capacities[size])

    def _planned_exchange(self, exchange: Exchange, model: Model, cameras: list[Camera], capacity: int) -> Exchange:
        """Return the exchange with room for the rows that travel in some views once all rows exist, and for the borders
        between bands."""
        rows = -(-model.gaussians.num // exchange.num)
        settings, rule = RenderSettings(tile_size=self._tile_size, exchange=exchange), model.rule
        found = [room_of_view(model.gaussians, one, rule, settings, model.num_live) for one in cameras]
        most = max(own.rows for own in found)
        share = min(1.0, GROWTH_ROOM * max(1, most) / max(1, min(model.num, rows)))
        above, below = (max(own) for own in zip(*(each.borders for each in found), strict=True))
        room = BorderRoom(*(int(GROWTH_ROOM * own) + settings.tile_size for own in (above, below)))
        return dataclasses.replace(exchange, rows_per_pair=share * rows / capacity, border_room=room)

    def _capacity(self, size: Size, model: Model, pairs: float) -> int:
        """Return a capacity for so many pairs in views of a size, one that the session knows if possible."""
        stage = self._stage.name, self._stage.appearance, model.gaussians.num
        return self._session.capacity((*stage, *size), capacity_for(int(pairs)))
