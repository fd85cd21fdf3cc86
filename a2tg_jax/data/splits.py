"""Views that are held out from training: test views and validation views."""

import dataclasses
from collections.abc import Sequence
from typing import TypeVar

from a2tg_jax.data.assembly import Shot
from a2tg_jax.data.scene import Scene, View

VALIDATION_EVERY = 8
"""Interval of validation views among the training views."""
Held = TypeVar("Held", Shot, View)
"""A photograph before or after its view is made."""


def with_validation_views(scene: Scene) -> Scene:
    """Return the scene for choosing options: every eighth training view is held out in place of the test views.

    Cameras, points and world stay those of the whole scene. Test views are left out, so that no choice can see them.
    The views of a panorama are held out together and count as one.

    Raises:
      ValueError: if there is one training view, or one panorama, only.
    """
    train, held_out = split_views(scene.train, VALIDATION_EVERY)
    if not train:
        only = "1" if len(scene.train) == 1 else f"1 panorama, cut into {len(scene.train)} views"
        raise ValueError(f"{scene.name}: validation views are taken from at least 2 training views; there is {only}")
    return dataclasses.replace(scene, train=tuple(train), test=tuple(held_out))


def check_test_every(test_every: int) -> None:
    """Raise ValueError unless some views are left for training."""
    if test_every < 0 or test_every == 1:
        raise ValueError(f"test_every must be 0 (no test views) or at least 2; got {test_every}")


def every_kth(shots: Sequence[Shot], test_every: int) -> tuple[list[Shot], list[Shot]]:
    """Return (train, test): test shots are 0, k, 2k, … in order of names; none for k = 0. Shots of a panorama count as
    one."""
    return split_views(sorted(shots, key=lambda shot: shot.name), test_every)


def split_views(views: Sequence[Held], every: int) -> tuple[list[Held], list[Held]]:
    """Return the views that are kept, and those that are held out: 0, k, 2k, …; none for k = 0.

    The views of a panorama count as one. Alone, a held-out view would have training views from the same point.
    """
    numbers: dict[tuple[int | None, int], int] = {}
    kept: list[Held] = []
    held_out: list[Held] = []
    for index, view in enumerate(views):
        number = numbers.setdefault((view.panorama, index if view.panorama is None else 0), len(numbers))
        (held_out if every and number % every == 0 else kept).append(view)
    return kept, held_out
