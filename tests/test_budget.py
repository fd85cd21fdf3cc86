"""Memory budgets: how they are written, what they lead to on the host, and what is said of models that miss one."""

import dataclasses
import itertools
import json
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.special import logit
from small_models import some_now

import a2tg_jax as a2tg
from a2tg_jax import (
    Appearance,
    Due,
    FillingDensity,
    FillingMcmc,
    GradientStatistics,
    Model,
    Texture,
    Upscale,
    adam_init,
    allocate_appearance,
    init_from_points,
    partition,
)
from a2tg_jax.base.config_json import config_from_dict, config_to_dict
from a2tg_jax.cli import main as cli
from a2tg_jax.core.budget import number_to_reach
from a2tg_jax.training import SYSTEMS
from a2tg_jax.training.fitting import warn_of_budget
from a2tg_jax.training.registry import system_from_dict, system_to_dict
from a2tg_jax.training.start import check_points

SHORT = {"stage1_iterations": 60, "initial_gaussians": None}


@pytest.fixture(scope="module")
def scene():
    return a2tg.synthetic_scene(num_views=4, width=24, height=16, num_points=120)


def smoke(name: str, **changes):
    kind = type(a2tg.find_system(name))
    textured = {"stage2_iterations": 6} if kind.preset("smoke").stage2_iterations else {}
    return kind.preset("smoke", **{**SHORT, **textured, **changes})


def filling(system: a2tg.System) -> FillingMcmc | FillingDensity:
    """The event that brings the Gaussians to their number."""
    (found,) = [event for event in system.stages()[0].events if isinstance(event, FillingMcmc | FillingDensity)]
    return found


@pytest.mark.parametrize(
    "text, megabytes",
    [
        ("1.5MB", 1.5), ("1.5", 1.5), (1.5, 1.5), (2, 2.0), ("800kB", 0.8), ("800 KB", 0.8), ("2GB", 2000.0),
        ("1e2 mb", 100.0), ("0.1kB", 1e-4), (None, None), ("None", None), (" .5MB ", 0.5), (1e-05, 1e-5),
        ("1.5MiB", 1.572864), ("500 KiB", 0.512), ("2GiB", 2147.483648),
    ],
)  # fmt: skip
def test_how_a_budget_is_written(text, megabytes):
    assert a2tg.A2tg(memory_budget=text).memory_budget == megabytes
    assert a2tg.A2tg(memory_budget=megabytes).memory_budget == megabytes


def test_what_is_no_budget_is_named():
    for text in ("", "much", "1.5TiB", "1,5MB", "MB", "1.2.3MB", "-1MB", -1.0, True, "nan", "1e999999GB"):
        with pytest.raises(ValueError, match=r"memory_budget must be a number of MB .* 1.5MB, 800kB or 2GB; got"):
            a2tg.A2tg(memory_budget=text)
    for text in ("0", 0.0, "0kB", "1e999"):
        with pytest.raises(ValueError, match="memory_budget must be positive and finite; got"):
            a2tg.A2tg(memory_budget=text)


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_budget_is_one_value_however_it_comes(name, tmp_path):
    """By flag, from TOML as text and as number, and from JSON."""
    kind = type(a2tg.find_system(name))
    wanted = kind(memory_budget=1.5)
    assert wanted == kind(memory_budget="1500kB") and wanted.budget_bytes == 1_500_000
    run = ["--system", name, "--out", str(tmp_path)]
    assert cli.parsed("train", ["synthetic", *run, "--memory-budget", "1.5MB"]).record.options == wanted
    for number in ('"1.5MB"', "1.5", '"1500 kB"'):
        table = tomllib.loads(f"memory_budget = {number}")
        assert kind.preset("paper", **table) == wanted
    assert config_from_dict(kind, json.loads(json.dumps(config_to_dict(wanted)))) == wanted
    assert system_from_dict(system_to_dict(wanted), "file") == wanted


@pytest.mark.parametrize("seed", range(3))
def test_events_double_at_most_and_the_last_leaves_the_cap(seed):
    rng = np.random.default_rng(seed)
    for _ in range(40):
        count = int(rng.integers(1, 60))
        start = int(rng.integers(2, 200_000))
        cap = int(min(start * rng.uniform(1, 2) ** count, 3e6))
        num = start
        for left in range(count, 0, -1):
            before = num
            num = int(number_to_reach(jnp.asarray(num, jnp.int32), cap, left))
            assert before <= num <= min(2 * before, cap)
        assert num == cap


@pytest.mark.parametrize("num_iterations, count, dtype", [(60, 5, np.float32), (200, 16, np.float64)])
def test_monte_carlo_growth_leaves_the_cap(x64, dtype, num_iterations, count):
    """From few Gaussians, at the times that a stage of so many iterations has."""
    model = random_model(0, 300, 4, np.tile([0.5, 0.003], 150))
    model = jax.tree.map(lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, model)
    event = FillingMcmc(300)
    moments = adam_init(partition(model)[0])
    times = event.times(num_iterations)
    apply = jax.jit(
        lambda iteration, left, *rest: event.apply(some_now(iteration, num_iterations, left, num_keys=2), *rest, ())
    )
    counts = [4]
    for left, iteration in zip(range(count, 0, -1), times, strict=True):
        model, moments, *_ = apply(*map(jnp.int32, (iteration, left)), model, moments)
        counts.append(int(model.num_live))
    factors = np.divide(counts[1:], counts[:-1])
    assert len(factors) == count and counts[-1] == 300
    assert abs(np.log(factors[1:]) - np.log(75) / count).max() < 0.2, "by one factor, rounded up"
    assert model.gaussians.means.dtype == dtype


@pytest.mark.parametrize("name", SYSTEMS)
def test_caps_use_up_every_budget(name):
    """But for less than one Gaussian, of whatever degree; for A²TG textures make up the rest."""
    floats = {"textured-gaussians": 64, "supergaussians": 27, "bytewise": 1, "bbsplat": 4 * 256 - 1, "a2tg": 20}
    rng = np.random.default_rng(0)
    for budget, sh_degree in itertools.product(np.exp(rng.uniform(-4, 6, 10)), range(4)):
        degree = "base_degree" if name == "bytewise" else "sh_degree"
        system = dataclasses.replace(a2tg.find_system(name), memory_budget=float(budget), **{degree: sh_degree})
        needed = 4 * (10 + 3 * (sh_degree + 1) ** 2 + floats.get(name, 0))
        assert needed * filling(system).cap <= system.budget_bytes < needed * (filling(system).cap + 1)


ROUND = (0.1, 0.1)
WIDE = (0.05, 0.009)
TALL = (0.009, 0.05)
SHAPES = {"round": (ROUND, ROUND), "thin": (WIDE, TALL), "mixed": (WIDE, ROUND)}


@pytest.mark.parametrize(
    "texture_cap, rounds, budget",
    [(1, 1, "60kB"), (2, 3, 0.1234), (4, 1, "60kB"), (4, 3, 0.1234), (16, 4, "60kB")],
)
@pytest.mark.parametrize("shape", SHAPES)
def test_textures_take_what_gaussians_leave(budget, shape, texture_cap, rounds):
    """Also where all Gaussians are so thin that they take fewer texels than there are bytes for."""
    texture = {"cap": texture_cap, "at": [0.1 * (index + 1) for index in range(rounds)]}
    system = smoke("a2tg", memory_budget=budget, texture=texture)
    (upscale,) = [event for event in system.stages()[1].events if isinstance(event, Upscale)]
    rng = np.random.default_rng(texture_cap)
    num = filling(system).cap
    gaussians = init_from_points(rng.normal(size=(num, 3)), np.full((num, 3), 0.5))
    scales = np.asarray(SHAPES[shape], np.float32)[np.arange(num) % 2]
    gaussians = dataclasses.replace(gaussians, log_scales=jnp.log(jnp.asarray(scales)))
    model = Model(gaussians, allocate_appearance(Appearance(texture=Texture()), jax.random.key(0), gaussians))
    moments = adam_init(partition(model)[0])
    for index in range(rounds):
        assert model.num_bytes <= system.budget_bytes
        sums = jnp.asarray(rng.exponential(size=num) * rng.integers(0, 2, num), jnp.float32)
        state = GradientStatistics(sums, jnp.ones(num, jnp.int32))
        change = upscale.apply(Due(index + 1, rounds), model, moments, state)
        model = change.model
        moments = change.moments
    assert 0.995 * system.budget_bytes <= model.num_bytes <= system.budget_bytes
    if texture_cap > 2:
        assert system.budget_bytes - model.num_bytes < 16 * (4 * 4 - 2 * 2), "less than what one texture would cost"


def random_model(seed: int, num: int, num_live: int, opacities) -> Model:
    rng = np.random.default_rng(seed)
    gaussians = init_from_points(rng.normal(size=(num, 3)), np.full((num, 3), 0.5), seed=seed)
    gaussians = dataclasses.replace(gaussians, logit_opacities=logit(jnp.asarray(opacities, jnp.float32)))
    return Model(gaussians, num_live=jnp.asarray(num_live, jnp.int32))


@pytest.mark.parametrize("faint", [0.0, 0.3, 0.9])
def test_density_control_reaches_its_cap_whatever_is_pruned(faint):
    """Row by row: those that stay, those that are doubled, and their number after every event."""
    num, num_live, num_iterations = 100, 30, 100
    event = FillingDensity(num, threshold=0.5)
    times = event.times(num_iterations)
    plan = jax.jit(lambda iteration, left, *seen: event.plan(some_now(iteration, num_iterations, left), *seen))
    rng = np.random.default_rng(1)
    assert list(times) == [10, 20, 30, 40]
    for left, iteration in zip((4, 3, 2, 1), times, strict=True):
        opacities = np.where(rng.uniform(size=num) < faint, 1, 10) * rng.uniform(0.01, 0.04, num) + 0.01
        opacities[0] = 0.9
        model = random_model(iteration, num, num_live, opacities)
        gradients = np.round(rng.exponential(size=num), 1).astype(np.float32)
        edit, num_refused = plan(*map(jnp.int32, (iteration, left)), model, jnp.asarray(gradients))
        kept, doubled = (np.flatnonzero(mask) for mask in (edit.is_kept, edit.is_cloned | edit.is_split))
        wanted = int(number_to_reach(jnp.asarray(num_live, jnp.int32), num, left))
        opaque = np.flatnonzero((opacities >= 0.05) & (np.arange(num) < num_live))
        assert set(opaque) <= set(kept) and kept.max() < num_live and int(num_refused) == 0
        assert len(kept) == max(len(opaque), (wanted + 1) // 2)
        spared = np.setdiff1d(kept, opaque)
        gone = np.setdiff1d(np.arange(num_live), kept)
        assert not (len(spared) and len(gone)) or opacities[spared].min() >= opacities[gone].max()
        assert set(doubled) <= set(kept)
        rest = np.setdiff1d(kept, doubled)
        assert not (len(rest) and len(doubled)) or gradients[doubled].min() >= gradients[rest].max()
        num_live = len(kept) + len(doubled)
        assert num_live == wanted
    assert num_live == num


@pytest.mark.parametrize(
    "num, budget, message",
    [
        (25, "6kB", r"takes 5,800 bytes, 96\.7% of the memory_budget of 6,000: there is no room for another Gaussian"),
        (20, "6kB", r"takes 4,640 bytes, 77\.3% .*: raise stage1_iterations or initial_gaussians"),
        (26, "6kB", r"takes 6,032 bytes, 100\.5% .*: compose the stages of Gaussians2dMcmc with System\.budget_cap"),
    ],
)
def test_what_misses_its_budget_is_warned_of(num, budget, message):
    model = random_model(0, num, num, np.full(num, 0.5)).live
    with pytest.warns(UserWarning, match=message):
        warn_of_budget(a2tg.Gaussians2dMcmc(memory_budget=budget), model)
    warn_of_budget(a2tg.Gaussians2dMcmc(memory_budget=model.num_bytes / 1e6), model)
    warn_of_budget(a2tg.Gaussians2dMcmc(), model)


RULE = {"select": "threshold"}


def unchosen(name: str, select: str) -> str:
    return rf"texture\.{name} is .* set select to '{select}', or leave {name} out$"


@pytest.mark.parametrize(
    "name, changes, message",
    [
        ("gaussians-2d-mcmc", {"memory_budget": "463B"}, "must be a number of MB"),
        ("gaussians-2d-mcmc", {"memory_budget": "0.463kB"}, "has room for 1 Gaussians of 232 bytes, and there must be"),
        ("bbsplat", {"memory_budget": "1kB"}, "has room for 0 Gaussians of 1,252 bytes"),
        (
            "textured-gaussians", {"memory_budget": "0.1MB", "initial_gaussians": 800},
            "0.1 MB has room for 204 Gaussians of 488 bytes, fewer than .* lower initial_gaussians, which is 800",
        ),
        (
            "a2tg", {"memory_budget": 1.5, "texture": {"select": "budget", "budget_mb": 1.5}},
            "texture.budget_mb both set .* give one",
        ),
        ("a2tg", {"memory_budget": 1.5, "densify": {"cap": 0}}, "densify.cap is 0"),
        ("a2tg", {"texture": {"budget_mb": 1.0}}, unchosen("budget_mb", "budget")),
        ("a2tg", {"texture": RULE | {"threshold": 1e-5, "budget_mb": 1.0}}, unchosen("budget_mb", "budget")),
        ("a2tg", {"texture": {"threshold": 1e-5}}, unchosen("threshold", "threshold")),
        (
            "a2tg", {"texture": {"select": "budget", "budget_mb": 1.0, "threshold": 0.0}},
            unchosen("threshold", "threshold"),
        ),
    ],
)  # fmt: skip
def test_budgets_that_cannot_be_kept_are_refused(name, changes, message):
    with pytest.raises(ValueError, match=message):
        smoke(name, **changes).check()


def test_the_threshold_of_a_preset_may_stay():
    for changes in ({"texture": {"select": "fraction"}}, {"memory_budget": "90MB"}, {}):
        a2tg.A2tg.preset("official", **changes).check()


@pytest.mark.parametrize(
    "name, changes, message",
    [
        ("gaussians-2d", {"memory_budget": "1MB"}, "120 Gaussians at most double in each of the 2 densifications of"),
        ("a2tg", {"memory_budget": "1MB", "stage1_iterations": 10}, "in 10 iterations there is no growth from 120"),
    ],
)
def test_budgets_that_the_points_of_a_scene_cannot_fill_are_refused(scene, name, changes, message):
    system = smoke(name, **changes)
    advice = "raise stage1_iterations or initial_gaussians, or lower memory_budget"
    message = rf"^memory_budget has room for [\d,]+ Gaussians, but {message}.*: {advice}$"
    for start in (check_points, a2tg.fit):
        with pytest.raises(ValueError, match=message):
            start(scene, system)
    check_points(scene, smoke(name, memory_budget="60kB"))
    system.check_given_number(120)


def test_a_budget_of_textures_has_room_for_growth_only_where_there_is_some(scene):
    changes = {"texture": {"select": "budget", "budget_mb": 0.03}, "initial_gaussians": None}
    system = a2tg.A2tg.preset("smoke", **changes)
    with pytest.raises(ValueError, match=r"0\.03, but \d+ Gaussians .*: raise it, or lower densify\.cap$"):
        check_points(scene, system)
    most = 30_000 // (4 * (10 + 3 * (system.sh_degree + 1) ** 2 + 4))
    system.check_given_number(most)
    with pytest.raises(ValueError, match=rf"0\.03, but {most + 1} Gaussians of one texel each .* MB: raise it$"):
        system.check_given_number(most + 1)


@pytest.mark.parametrize("cap", [500_000, 0])
def test_a_budget_of_textures_is_checked_before_the_first_stage(scene, cap):
    """120 Gaussians of 248 bytes: they do not grow in 10 iterations, or because growth is off."""
    densify = {"cap": cap}
    texture = {"select": "budget", "budget_mb": 0.0297}
    system = smoke("a2tg", stage1_iterations=10, densify=densify, texture=texture)
    option = "densify.cap" if cap else "initial_gaussians"
    for start in (check_points, a2tg.fit):
        with pytest.raises(ValueError, match=rf"but 120 Gaussians .* take 0\.030 MB: raise it, or lower {option}$"):
            start(scene, system)
    with pytest.raises(ValueError, match=r"but 120 Gaussians .*: raise it$"):
        system.check_given_number(120)
    smaller = dataclasses.replace(system.texture, budget_mb=0.0298)
    check_points(scene, dataclasses.replace(system, texture=smaller))


def test_textures_that_begin_empty_take_nothing_of_a_budget(scene):
    """120 Gaussians of 232 bytes, or 236 with a shape of the kernel."""
    texture = {"select": "budget", "budget_mb": 120 * 232 / 1e6}
    changes = {"stage1_iterations": 10, "texture": texture, "empty_textures": True}
    check_points(scene, smoke("a2tg", **changes))
    with pytest.raises(ValueError, match=r"but 120 Gaussians without textures take 0\.028 MB: raise it, or lower"):
        check_points(scene, smoke("a2tg", **changes, kernel_rate=0.01))
    given = smoke("a2tg", memory_budget=120 * 232 / 1e6, empty_textures=True)
    given.check_given_number(120)
    with pytest.raises(ValueError, match=r"has room for 120 Gaussians of 232 bytes .* and 121 are given"):
        given.check_given_number(121)


@pytest.mark.parametrize(
    "changes, num",
    [
        ({}, 1_000_000 // (232 + 80)),  # Five texels of 16 bytes.
        ({"texture_share": 0.25}, 750_000 // 232),
        ({"texture_share": 0.25, "sh_degree": 0}, 750_000 // 52),
        ({"texture_share": 0.25, "sh_degree": 0, "kernel_rate": 0.01}, 750_000 // 56),
        ({"texture_share": 0.0}, 1_000_000 // (232 + 16)),  # All begin with a texel.
        ({"texture_share": 0.0, "empty_textures": True}, 1_000_000 // 232),
        ({"texture_share": 0.9}, 1_000_000 // (232 + 256)),  # All are of 4×4 texels in the end.
        ({"texture": {"at": ()}, "empty_textures": True}, 1_000_000 // 232),
        ({"texture": {"at": ()}, "texture_share": 0.9}, 1_000_000 // (232 + 16)),
    ],
)
def test_the_share_of_textures_decides_how_many_gaussians_there_are(changes, num):
    assert filling(smoke("a2tg", memory_budget="1MB", **changes)).cap == num


@pytest.mark.parametrize(
    ("name", "size", "stage"),
    [("a2tg", 248, "textures"), ("textured-gaussians", 488, "textures"), ("bbsplat", 1252, "billboards")],
)
def test_given_gaussians_must_fit_with_what_later_stages_show(name, size, stage):
    """At degree 3 a Gaussian takes 232 bytes, a texel 16."""
    system = smoke(name, memory_budget=120 * size / 1e6)
    system.check_given_number(120)
    message = rf"memory_budget of .* room for 120 Gaussians of {size:,} bytes when the stage '{stage}' begins, and 121"
    with pytest.raises(ValueError, match=f"^{message} "):
        system.check_given_number(121)


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("preset", ["paper", "quick", "smoke"])
def test_presets_reach_ordinary_budgets(scene, name, preset):
    """From 1,000 points, fewer than most scenes have."""
    scene = dataclasses.replace(scene, points=np.zeros((1_000, 3)))
    for budget in ("1.5MB", "20MB", "80MB"):
        system = dataclasses.replace(type(a2tg.find_system(name)).preset(preset), memory_budget=budget)
        system.check()
        check_points(scene, system)


@pytest.mark.long
def test_the_command_line_names_the_flag(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(cli, "configure_cpu", lambda: None)
    preset = ["--system", "gaussians-2d", "--preset", "smoke", "--stage1-iterations", "20"]
    flags = [*preset, "--out", str(tmp_path / "run"), "--memory-budget"]
    for budget, message in (("300MB", "has room for"), ("lots", "must be a number of MB")):
        assert cli.main(["train", "synthetic", *flags, budget]) == 2
        assert f"--memory-budget {message}" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
