"""Names in messages: an event names its field, a system the option that sets it, and every option named exists."""

import dataclasses
import re
from typing import Any

import pytest
from toy_system import Toy

import a2tg_jax as a2tg
from a2tg_jax.events import Event, FieldError, HostEvent, StepEvent, iterations_at
from a2tg_jax.io.config_json import flatten_config
from a2tg_jax.mcmc import FillingMcmc
from a2tg_jax.training.registry import SYSTEMS, with_changes

WITH_AND_WITHOUT = pytest.mark.parametrize("budget", [None, "9MB"])
ALL = pytest.mark.parametrize("name", SYSTEMS)


def system_of(name: str, budget: str | None) -> a2tg.System:
    return dataclasses.replace(a2tg.find_system(name), memory_budget=budget)


def events_of(system: a2tg.System) -> list[tuple[tuple[int, int], Event]]:
    """All events of a system with their places: stage, event."""
    stages = enumerate(system.stages())
    return [((at, index), event) for at, stage in stages for index, event in enumerate(stage.events)]


def changed(system: a2tg.System, option: str, value: Any) -> a2tg.System:
    change = value
    for part in reversed(option.split(".")):
        change = {part: change}
    return with_changes(system, change, "test")


def other(field: str, value: Any) -> Any:
    """Another valid value of an option that sets a field of an event."""
    if isinstance(value, bool):
        return not value
    if field == "at":
        return [0.01, 0.02]
    if isinstance(value, int):
        return value - 1
    return value / 2 if value else 0.5


def options_of(system: a2tg.System) -> list[tuple[tuple[int, int], str, str]]:
    """Place, field and option of all fields of events of which the system knows the option."""
    return [
        (place, field.name, option)
        for place, event in events_of(system)
        for field in dataclasses.fields(event)
        if (option := system.option_of(event, field.name)) is not None and getattr(event, "keep", None) is None
    ]


@ALL
@WITH_AND_WITHOUT
def test_the_option_named_for_a_field_sets_the_field(name, budget):
    system = system_of(name, budget)
    found = options_of(system)
    values = flatten_config(system)
    assert found and {option for _, _, option in found} <= set(values)
    for place, field, option in found:
        if isinstance(values[option], str):
            continue
        before, after = (
            dict(events_of(each))[place] for each in (system, changed(system, option, other(field, values[option])))
        )
        assert getattr(before, field) != getattr(after, field), f"{option} does not set {field} of {before}"


@ALL
@WITH_AND_WITHOUT
def test_messages_of_events_name_options_of_the_system(name, budget):
    system = system_of(name, budget)
    events = [event for _, event in events_of(system) if isinstance(event, StepEvent)]
    told = [system.told(event, message) for event in events for message in (event.impossible, event.refused)]
    named = re.findall(r"(?:raise|lower) (\S+)", " ".join(told))
    assert set(named) <= set(flatten_config(system))
    assert named or not any(event.refused for event in events)


@pytest.mark.parametrize(
    "name, option",
    [("a2tg", "texture.upscale_at"), ("bytewise", "texture.at"), ("bytewise", "view_dependence.at")],
)
def test_the_same_mistake_is_told_by_the_option_of_each_system(name, option):
    system = changed(a2tg.find_system(name), option, [0.5, 0.2])
    message = rf"^{re.escape(option)} must be ascending fractions between 0 and 1; got \(0.5, 0.2\)$"
    with pytest.raises(ValueError, match=message):
        system.check()
    with pytest.raises(ValueError, match=message), system.naming_options():
        for _, event in events_of(changed(system, option, [0.5])):
            if isinstance(event, HostEvent) and system.option_of(event, "at") == option:
                dataclasses.replace(event, at=(0.5, 0.2)).iterations(10)


def test_without_a_system_an_event_names_its_field():
    with pytest.raises(FieldError, match=r"^cap has room for 50 Gaussians, but in 9 iterations .* from 20$"):
        FillingMcmc(50).num_rows(20, 9)
    with pytest.raises(FieldError, match=r"^at must be ascending"):
        a2tg.Upscale(at=(0.5, 0.2)).iterations(10)
    with pytest.raises(ValueError, match=r"^prune\.at must be ascending"):
        iterations_at((0.5, 0.2), 10, "prune.at")


def test_a_system_that_tells_no_option_names_field_and_event():
    assert Toy().told(a2tg.Mcmc(5), "raise {cap}") == "raise cap of Mcmc"
    assert Toy().more_growth() == "stage1_iterations or initial_gaussians"
