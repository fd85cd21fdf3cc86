"""Events are the option groups: the path of a field is the option, and messages name it."""

import dataclasses
import re

import pytest
from toy_system import Shrink, Toy

import a2tg_jax as a2tg
from a2tg_jax import HostEvent, StepEvent, find_system
from a2tg_jax.base.config_json import flatten_config
from a2tg_jax.training import SYSTEMS

WITH_AND_WITHOUT = pytest.mark.parametrize("budget", [None, "9MB"])
ALL = pytest.mark.parametrize("name", SYSTEMS)


@ALL
@WITH_AND_WITHOUT
def test_events_of_stages_have_paths_of_options(name, budget):
    system = dataclasses.replace(find_system(name), memory_budget=budget)
    options = flatten_config(system)
    for event in (event for stage in system.stages() for event in stage.events if dataclasses.fields(event)):
        path = system.path_of(event)
        assert {f"{path}.{field.name}" for field in dataclasses.fields(event)} <= set(options)
    assert set(system.limits()) <= set(options)
    assert system.caps() == ("densify.cap",)


@ALL
def test_messages_of_events_name_their_fields(name):
    for stage in find_system(name).stages():
        for event in stage.events:
            names = {field.name for field in dataclasses.fields(event)}
            assert set(re.findall(r"[a-z]+_[a-z_]+", getattr(event, "impossible", ""))) <= names
            assert not event.limited_by or event.limited_by in names


@ALL
def test_every_group_checks_its_own_numbers(name):
    """No number of an event may be negative."""
    system = find_system(name)
    for path, value in flatten_config(system).items():
        group, _, field = path.partition(".")
        if isinstance(getattr(system, group), StepEvent | HostEvent) and type(value) in (int, float):
            with pytest.raises(ValueError, match=rf"^{re.escape(path)} must "):
                system.preset("paper", **{group: {field: type(value)(-1)}}).check()


@pytest.mark.parametrize(
    "name, option", [("a2tg", "texture.at"), ("bytewise", "details.at"), ("bytewise", "view_dependence.at")]
)
def test_the_same_mistake_is_named_by_its_path(name, option):
    group, _, field = option.partition(".")
    system = find_system(name).preset("paper", **{group: {field: [0.5, 0.2]}})
    message = rf"^{re.escape(option)} must be ascending fractions between 0 and 1; got \(0.5, 0.2\)$"
    with pytest.raises(ValueError, match=message):
        system.check()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Own(Toy):
    """A system with an event as an option group, and one without."""

    densify: a2tg.Mcmc = a2tg.Mcmc(cap=60)

    def stages(self):
        (stage,) = super().stages()
        return (dataclasses.replace(stage, events=(self.densify, *stage.events)),)


def test_a_custom_system_gets_paths_for_free():
    system = Own()
    assert system.path_of(Shrink()) == "Shrink" and system.limits() == ("densify.cap",)
    assert Toy().limits() == ("initial_gaussians",)
    assert system.more_growth() == "stage1_iterations or initial_gaussians"
    with pytest.raises(ValueError, match=r"^densify\.cap must be at least 2; got 1$"):
        Own(densify=a2tg.Mcmc(cap=1)).check()


@ALL
@WITH_AND_WITHOUT
def test_further_stages_repeat_the_last_without_growth(name, budget):
    system = dataclasses.replace(find_system(name), memory_budget=budget, more=(5, 7))
    *_, last, first, second = system.all_stages()
    assert (first.name, first.iterations) == ("more", 5) and (second.name, second.iterations) == ("more-2", 7)
    assert first.appearance == last.appearance and set(first.events) <= set(last.events)
    assert all(event.most_gaussians is None for event in first.events)
    system.check()
    with pytest.raises(ValueError, match=r"^more must be at least 1; got 0"):
        dataclasses.replace(system, more=(0,)).check()
