"""Forecasts compared with XLA and with training, runs that cannot fit, and progress of a training."""

import dataclasses
import functools
import io
import re
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled_programs import compiled_programs
from toy_system import Toy

import a2tg_jax as a2tg
from a2tg_jax import Mcmc, Picture, Prune, resize_camera
from a2tg_jax.base import machine, memory
from a2tg_jax.base.memory import allowed_memory
from a2tg_jax.cli import main as cli
from a2tg_jax.cli.training import ask
from a2tg_jax.host import progress_bars
from a2tg_jax.results import forecast
from a2tg_jax.results.forecast import (
    Bytes,
    RunForecast,
    checked_forecast,
    doubts_about,
    forecast_run,
    room_for_photographs,
    time_after,
)
from a2tg_jax.results.plan import plan_run
from a2tg_jax.results.record import RunRecord, SceneSource
from a2tg_jax.training import SYSTEMS, cost, fitting
from a2tg_jax.training.cost import check_rows_fit, forecast_stages
from a2tg_jax.training.loop import StageRun
from a2tg_jax.training.reports import HALVED_WORK, Pace, Progress, RestOfRun, saved_work
from a2tg_jax.training.start import initial_model
from a2tg_jax.training.step import jitted_step

MB = 10**6


@dataclasses.dataclass(frozen=True, kw_only=True)
class Capped(Toy):
    """A toy whose growth is an option of another name."""

    growth: Mcmc = Mcmc(50)

    def stages(self) -> tuple[a2tg.Stage, ...]:
        (stage,) = super().stages()
        return (dataclasses.replace(stage, events=(*stage.events, self.growth)),)


@functools.cache
def scene_of(width, height, num_views=4):
    """The built-in scene with pictures of another size, which take no memory."""
    made = a2tg.synthetic_scene(num_views=num_views, width=24, height=16, num_points=200)
    shape = (height, width, 3)
    picture = Picture(shape, lambda: np.zeros(shape, np.uint8), is_held=True)
    resized = lambda views: tuple(  # noqa: E731
        dataclasses.replace(view, camera=resize_camera(view.camera, width, height), picture=picture) for view in views
    )
    return dataclasses.replace(made, train=resized(made.train), test=resized(made.test))


SMALL = scene_of(24, 16)


def run_of(scene, system):
    return forecast_run(scene, plan_run({"a": system}))


def peak_of(scene, system):
    return run_of(scene, system).peak[1].total


def small_system(iterations=2):
    return a2tg.Gaussians2dMcmc(stage1_iterations=iterations, initial_gaussians=60, densify=a2tg.Mcmc(cap=66))


def test_a_stage_compiles_its_step_once_and_has_its_memory_from_xla(monkeypatch):
    scene = scene_of(48, 32)
    system = small_system()
    monkeypatch.setattr(cost, "used_memory", lambda num_devices: 10**12)
    jitted_step().clear_cache()
    run = StageRun(scene, system, 0, initial_model(scene, system), max_memory=10**13)
    with compiled_programs("train_step") as programs:
        assert len(run.steps(1, 2)) == 2
    assert len(programs) == 1
    said = jitted_step().lower(*run.arguments(1)).compile().memory_analysis()
    new = said.temp_size_in_bytes + said.output_size_in_bytes - said.alias_size_in_bytes
    assert run.memory - 10**12 == new > sum(leaf.nbytes for leaf in jax.tree.leaves(run.state.model))


def test_a_step_that_cannot_fit_is_refused_before_it_runs(monkeypatch):
    scene = scene_of(48, 32)
    system = small_system()
    monkeypatch.setattr(cost, "used_memory", lambda num_devices: 10**12)
    run = StageRun(scene, system, 0, initial_model(scene, system), max_memory=10**12)
    with pytest.raises(
        ValueError, match=r"stage 'gaussians': XLA reports .* 1,000 GB may be used: lower densify\.cap, "
    ):
        run.steps(1, 2)
    assert int(run.state.iteration) == 0 and run.memory is None


def test_a_stage_refuses_what_a_later_one_cannot_hold(monkeypatch):
    """Parameters and moments of before and after a step: six times the model."""
    monkeypatch.setattr(cost, "used_memory", lambda num_devices: 0)
    train = functools.partial(a2tg.fit_stage, scene_of(48, 32), small_system(), 0)
    progress = Progress(after=RestOfRun(model_bytes=10**10))
    with pytest.raises(ValueError, match=r"and what follows the stage about 60\.0 GB; 50\.0 GB may be used"):
        train(progress=progress, max_memory=5 * 10**10)
    assert train(progress=progress, max_memory=7 * 10**10).model.num > 1
    progress = Progress(after=RestOfRun(programs=10**6))
    with pytest.raises(ValueError, match=r"and what follows the stage about 50,000 GB; 50\.0 GB may be used"):
        train(progress=progress, max_memory=5 * 10**10)


def test_rows_and_bytes_are_those_that_training_reaches():
    system = a2tg.A2tg(
        stage1_iterations=12, stage2_iterations=12, initial_gaussians=60, densify=a2tg.Mcmc(cap=66),
        texture=a2tg.Upscale(fraction=0.5, at=(0.3, 0.6)),
    )  # fmt: skip
    first, second = forecast_stages(SMALL, system)
    assert (first.num_rows, second.num_rows) == (66, 66)
    assert first.model_bytes == 232 * 66
    assert second.model_bytes == 232 * 66 + 16 * 66 * (0.5 + 0.5 * 16)
    assert (first.num_programs, second.num_programs) == (1, 3)


def test_splats_of_a_file_replace_the_first_stage(monkeypatch):
    monkeypatch.setattr(forecast, "used_memory", lambda: 4 * 10**8)
    system = a2tg.A2tg.preset("smoke")
    first, second = forecast_stages(SMALL, system, 10**6)
    assert (first.num_rows, first.is_trained, second.num_rows) == (10**6, False, 10**6)
    record = RunRecord(SceneSource("synthetic"), "a2tg", system, ("gaussians-2d",), "smoke")
    own, given = (forecast_run(SMALL, record.plan, num) for num in (None, 10**6))
    assert own.phases.keys() - given.phases.keys() == {"a2tg-gaussians"}
    other = "gaussians-2d-gaussians"
    assert given.phases[other].model == own.phases[other].model
    assert given.disk_bytes > own.disk_bytes + 10**6 * 232
    with pytest.raises(ValueError, match=r"a2tg-textures: program.* change `init`, "):
        checked_forecast(SMALL, record, 10**9, num_given=10**6)


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_budget_is_the_size_of_what_is_left(name):
    preset = type(a2tg.find_system(name)).preset("smoke")
    system = dataclasses.replace(preset, memory_budget="0.3MB", initial_gaussians=100)
    *_, last = forecast_stages(SMALL, system)
    assert 0.5 * 0.3 * MB < last.model_bytes < 1.1 * 0.3 * MB


def test_more_of_anything_takes_more(monkeypatch):
    monkeypatch.setattr(forecast, "used_memory", lambda: 10**9)
    scene, large, system = scene_of(600, 400), scene_of(2400, 1600), a2tg.Gaussians2dMcmc(densify=a2tg.Mcmc(cap=50_000))
    before = peak_of(scene, system)
    changes = ({"densify": a2tg.Mcmc(cap=200_000)}, {"sh_degree": 0})
    more, less = (peak_of(scene, dataclasses.replace(system, **change)) for change in changes)
    assert less < before < more and peak_of(large, system) > before


def test_photographs_on_disk_take_what_is_read_ahead():
    scene = scene_of(1200, 800, num_views=40)
    on_disk = tuple(dataclasses.replace(v, picture=dataclasses.replace(v.picture, is_held=False)) for v in scene.train)
    system = a2tg.Gaussians2dMcmc()
    held = run_of(scene, system).peak[1].photographs
    lazy = run_of(dataclasses.replace(scene, train=on_disk, test=()), system).peak[1].photographs
    assert held > 39 * 1200 * 800 * 3 > lazy > 1200 * 800 * 3


def forecast_with(**sizes):
    return RunForecast({"a-gaussians": Bytes(**sizes)}, 3e6, ("densify.cap",))


@pytest.mark.parametrize(
    ("name", "advice"),
    [
        ("photographs", "change `downscale`"),
        ("model", "change `densify.cap`"),
        ("program", "the program itself takes about 5.00 GB of it: allow more with `max_memory`"),
    ],
)
def test_a_run_that_does_not_fit_is_refused_with_the_option_to_change(name, advice):
    found = forecast_with(**{"program": 1e6, "photographs": 1e6, "model": 1e6, name: 5e9})
    with pytest.raises(ValueError, match=rf"5.00 GB of memory \(a-gaussians: .*4.00 GB may be used: {advice}"):
        found.check_memory(4e9)
    found.check_memory(5.1e9)


@pytest.mark.parametrize(
    "system, option",
    [
        (a2tg.A2tg(), "change `densify.cap`, `memory_budget` or"),
        (a2tg.A2tg(memory_budget="90MB"), "change `memory_budget` or"),
        (Toy(), "change `initial_gaussians`, `memory_budget` or"),
        (Capped(), "change `growth.cap`, `memory_budget` or"),
    ],
)
def test_a_system_names_its_own_limit(system, option):
    found = dataclasses.replace(forecast_with(model=5e9), limits=system.limits())
    with pytest.raises(ValueError, match=option):
        found.check_memory(4e9)
    assert run_of(SMALL, system).limits == system.limits()


@pytest.mark.parametrize(
    ("preset", "downscale", "size", "flags"),
    [
        ("paper", 2, (1600, 1067), "--preset quick --downscale 6"),
        ("paper", 2, (320, 213), "--preset quick --downscale 2"),
        ("paper", 1, (100, 67), "--preset quick"),
        ("paper", 1, (640, 427), "--preset quick"),
        ("paper", 1, (641, 427), "--preset quick --downscale 2"),
        ("paper", 1, (4000, 2667), "--preset quick --downscale 7"),
        ("quick", 2, (3200, 2133), "--preset quick --downscale 10"),
        ("quick", 2, (320, 213), None),
    ],
)
def test_the_forecast_of_a_long_run_has_quicker_flags(monkeypatch, tmp_path, preset, downscale, size, flags):
    monkeypatch.setattr(memory, "memory_limit", lambda: 10**12)
    record = RunRecord(SceneSource("fox", downscale=downscale), "a2tg", a2tg.A2tg.preset(preset), preset=preset)
    text = checked_forecast(scene_of(*size), record, None, out=tmp_path)
    assert text.endswith(f"\nquicker on CPUs: {flags} takes minutes") == (flags is not None)
    assert "quicker" not in checked_forecast(scene_of(*size), record, None), "a resumed run keeps its options"


def test_a_forecast_is_two_lines_of_text(monkeypatch):
    parts = "a-gaussians: program 500 MB, photographs 1.00 GB, model 2.00 MB"
    text = forecast_with(program=0.5e9, photographs=1e9, model=2e6).text(8e9)
    assert text.splitlines() == [
        f"memory: at least 1.50 GB ({parts}); 8.00 GB may be used",
        "disk: about 3.00 MB in the run folder",
    ]
    monkeypatch.setattr(memory, "memory_limit", lambda: 64 * 10**9)
    text = checked_forecast(SMALL, RunRecord(SceneSource("synthetic"), "a2tg", a2tg.A2tg.preset("smoke")), None)
    assert "64.0 GB may be used\ndisk: about " in text


def test_on_an_accelerator_its_own_memory_counts(monkeypatch):
    class Device:
        platform = "gpu"

        def memory_stats(self):
            return {"bytes_limit": 6 * 10**9}

    scene, system = scene_of(600, 400), a2tg.Gaussians2dMcmc()
    for module in (machine, memory):
        monkeypatch.setattr(module, "default_device", Device)
    found = run_of(scene, system)
    assert allowed_memory(None) == 6e9 and allowed_memory(5e9) == 5e9
    assert found.peak[1].program == 0


def test_the_state_must_fit_on_one_of_several_devices(monkeypatch):
    monkeypatch.setattr(memory, "memory_limit", lambda: 10**12)
    scene, capped = SMALL, a2tg.Mcmc(cap=10**6)
    pruned = a2tg.Gaussians2dMcmc(densify=capped, prune=Prune(share=0.1, at=(0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)))
    record, found = RunRecord(SceneSource("synthetic"), "gaussians-2d-mcmc", pruned), run_of(scene, pruned)
    assert max(found.whole.values()) == (3 + 3) * 232 * 10**6
    for devices in (2, 4):
        (plain,) = forecast_stages(scene, Capped(batch_size=4, growth=capped), num_devices=devices)
        assert plain.whole_bytes == (3 + 3 / devices) * plain.model_bytes
    with pytest.raises(ValueError, match=r"the state of .* must fit on one device: .* change `densify.cap`"):
        found.check_one_device(2e8)
    checked_forecast(scene, record, None, 2)
    monkeypatch.setattr(RunForecast, "check_memory", lambda found, limit: None)
    with pytest.raises(ValueError, match="must fit on one device"):
        checked_forecast(scene, record, 2 * 10**8, 2)
    checked_forecast(scene, record, 2 * 10**8)


BEYOND_ANY_MACHINE = 10**9  # MB, 10^15 bytes
TOO_MANY = dict(memory_budget=BEYOND_ANY_MACHINE), dict(densify=a2tg.CloneSplitPrune(cap=10**12))


@pytest.mark.parametrize("options", TOO_MANY)
def test_rows_beyond_the_machine_are_refused_before_they_are_allocated(monkeypatch, options):
    monkeypatch.setattr(fitting, "StageRun", lambda *args: pytest.fail("the stage began"))
    scene, (name,) = a2tg.synthetic_scene(), options
    kind = a2tg.A2tg if name == "memory_budget" else a2tg.Gaussians2d
    system, wanted = kind.preset("smoke", **options), "memory_budget of 1,000,000,000 MB is too large for this machine "
    if name == "densify":
        wanted = "densify.cap is too large for this machine "
    start = initial_model(scene, kind.preset("smoke"))
    for train in (
        lambda: a2tg.fit(scene, system),
        lambda: a2tg.fit(scene, system, start=start),
        lambda: a2tg.fit_stage(scene, system, 0),
    ):
        with pytest.raises(ValueError, match=f"^{wanted}.*Gaussians of 232 bytes, and 4 copies .* may be used: lower"):
            train()


def test_a_later_stage_beyond_the_machine_is_refused_before_the_first(monkeypatch):
    """The first stage takes 232 of the 312 bytes that the budget allows per Gaussian."""
    scene, system = a2tg.synthetic_scene(), a2tg.A2tg.preset("smoke", memory_budget=1)
    limits = {first: 4 * forecast.model_bytes for first, forecast in enumerate(forecast_stages(scene, system))}
    assert limits[0] < limits[1] == 4 * MB
    monkeypatch.setattr(memory, "memory_limit", lambda: limits[1])
    check_rows_fit(scene, system, 0, None, machine.Devices())
    monkeypatch.setattr(memory, "memory_limit", lambda: limits[1] - 1)
    for first, num_start in ((0, None), (1, 3205)):
        with pytest.raises(ValueError, match=r"stage 'textures' trains up to 3,205 .* at least 4.00 MB"):
            check_rows_fit(scene, system, first, num_start, machine.Devices())
    check_rows_fit(scene, system, 0, None, machine.Devices(), max_memory=limits[1])
    check_rows_fit(scene, system, 0, None, machine.Devices(1, 2))  # Other machines' memory is not known.


def test_numbers_of_events_may_be_arrays():
    system = a2tg.A2tg.preset("smoke")
    fraction = jnp.asarray(system.texture.fraction)
    of_array = dataclasses.replace(system, texture=dataclasses.replace(system.texture, fraction=fraction))
    found = check_rows_fit(SMALL, of_array, 0, None, machine.Devices())
    assert found == check_rows_fit(SMALL, system, 0, None, machine.Devices())


def test_the_start_is_named_if_it_is_too_large(monkeypatch):
    monkeypatch.setattr(memory, "memory_limit", lambda: 10**6)
    system = a2tg.Gaussians2dMcmc.preset("smoke", densify=a2tg.Mcmc(cap=0))
    with pytest.raises(ValueError, match=r"^start is too large .* up to 2,000 Gaussians"):
        check_rows_fit(SMALL, system, 0, 2000, machine.Devices())


def test_max_memory_allows_what_a_machine_does_not_report(monkeypatch):
    monkeypatch.setattr(memory, "memory_limit", lambda: 10**5)
    scene, system = a2tg.synthetic_scene(num_views=4), a2tg.Gaussians2dMcmc.preset("smoke", stage1_iterations=2)
    with pytest.raises(ValueError, match=r"densify\.cap is too large .* allow more with max_memory"):
        a2tg.fit_stage(scene, system, 0)
    assert a2tg.fit_stage(scene, system, 0, max_memory=10**12).model.num > 1


@pytest.mark.parametrize("group", ["texture", "view_dependence"])
def test_a_budget_that_an_event_cannot_reach_is_no_need(group):
    """Textures grow twice, to 16 texels at most, and 16 harmonics have 48 numbers."""
    num, events = 100, dict(
        texture=a2tg.Upscale(select="budget", budget_mb=BEYOND_ANY_MACHINE, at=(0.1, 0.2)),
        view_dependence=a2tg.AdaptDegrees(budget_mb=BEYOND_ANY_MACHINE),
    )  # fmt: skip
    room = dict(texture=16 * 16 * num, view_dependence=4 * 48 * num)
    assert events[group].most_bytes(1000.0, num, 100) == 1000 + room[group]


def test_the_command_refuses_a_budget_beyond_the_machine(capsys, tmp_path):
    args = ["train", "synthetic", "--preset", "smoke", "--memory-budget", f"{BEYOND_ANY_MACHINE}MB"]
    assert cli.main([*args, "--out", str(tmp_path / "run")]) == 2
    assert re.search(r"the run would need at least .* change --memory-budget", capsys.readouterr().err)
    assert not (tmp_path / "run").exists()


def test_each_of_several_devices_has_a_copy_of_the_model_and_its_gradients():
    plan = plan_run({"a": a2tg.Gaussians2dMcmc(batch_size=4, densify=a2tg.Mcmc(cap=1000))})
    alone, four = (forecast_run(SMALL, plan, None, num).peak[1].model for num in (1, 4))
    assert 11 * alone == 4 * four == 4 * 11 * 232 * 1000


def test_on_a_cpu_the_memory_that_is_free_counts(monkeypatch):
    monkeypatch.setattr(memory, "memory_limit", lambda: 123 * MB)
    assert allowed_memory(None) == 123 * MB and allowed_memory(1.0) == 1
    assert memory.memory_limit() > MB
    assert room_for_photographs(8 * 10**9) == 2 * 10**9  # A quarter of what is allowed.
    assert room_for_photographs(None) is None


@pytest.mark.parametrize(
    ("amount", "message"),
    [("100MB", "would need at least .* of memory .* with --max-memory"), ("lots", "--max-memory must be .* got lots")],
)
def test_the_command_refuses_before_it_makes_a_folder(tmp_path, untouched_jax, capsys, amount, message):
    out = tmp_path / "run"
    assert cli.main(["train", "synthetic", "--preset", "smoke", "--out", str(out), f"--max-memory={amount}"]) == 2
    error = capsys.readouterr().err
    assert re.search(message, error) and error.count("\n") == 1 and not out.exists()


def pace_of(seconds, **options) -> Pace:
    """The pace of a stage of 1,000 iterations, by a clock that shows these times."""
    seconds = iter(seconds)
    return Pace(0, 1000, lambda: next(seconds), **options)


def test_the_pace_is_reported_once_when_enough_was_timed():
    pace = pace_of([10.0, 10.5, 12.5, 13.0, 30.0, 31.0, 41.0], most_gaussians=9_000)

    def told(done, num_compiled=1):
        pace.time(done, num_compiled)
        return pace.forecast_at(done)

    assert told(10) is None  # The steps of the compilation.
    assert told(20) is None
    growing = "; more as Gaussians are added, up to 9,000"
    assert told(60) == f"50 ms an iteration, about 0:00:47 left{growing}"
    assert told(70) is None
    assert told(80, num_compiled=2) is None and told(90, num_compiled=2) is None
    assert told(600, num_compiled=2) == "22 ms an iteration, about 0:00:09 left"


@pytest.mark.parametrize(
    ("seconds", "dones", "programs", "expected"),
    [
        ([10.0, 12.0], (10, 50), (39, 10.0), "50 ms an iteration, about 0:07:18 left, with 39 programs to compile"),
        ([0.0, 5.0], (10, 20), (), "500 ms an iteration, about 0:08:10 left"),
    ],
)
def test_the_pace_counts_the_programs_ahead(seconds, dones, programs, expected):
    """950 iterations of 50 ms, and 39 programs of 10 s; without growth, growth is not mentioned."""
    pace = pace_of(seconds)
    for done in dones:
        pace.time(done, 1, *programs)
    told = pace.forecast_at(dones[-1])
    assert told == expected


def test_what_would_show_little_is_asked_about(monkeypatch, capsys):
    """Without a terminal it is an error, with one a question."""
    scene, record = a2tg.synthetic_scene(width=80, height=60), RunRecord(SceneSource("fox", downscale=40))
    assert doubts_about(scene, RunRecord(SceneSource("fox"))) == []
    small = dataclasses.replace(record, options=a2tg.A2tg(memory_budget="20kB"))
    budget, photographs = doubts_about(scene, small)
    assert budget.startswith("memory_budget has room for") and budget.endswith("in bytes of the model in memory")
    assert re.match(r"`downscale` 40 leaves photographs of 80×60 pixels, .*: `downscale` 5 makes", photographs)
    with pytest.raises(ValueError, match=r"has room .*; `downscale` 40 .*; to train all the same, add `yes`"):
        ask([budget, photographs])
    huge = dataclasses.replace(record, options=a2tg.Bytewise(memory_budget="100MB"), scene=SceneSource("fox"))
    assert doubts_about(scene, huge) == [
        "`memory_budget` has room for more Gaussians (1,785,714) than the photographs have pixels (115,200): 645kB "
        "holds one for ten pixels"
    ]
    tiny = RunRecord(SceneSource("fox"), file_budget="1kB").budgeted()
    (doubt,) = doubts_about(scene, tiny)
    holds = "80.0kB holds about 10,000"
    assert doubt == f"`file_budget` has room for about 125 Gaussians, and scenes need thousands: {holds}"
    for stream in (sys.stdin, sys.stderr):
        monkeypatch.setattr(stream, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(sys.stdin, "readline", iter(["Y\n", "\n"]).__next__, raising=False)
    with pytest.warns(UserWarning, match="leaves photographs"):
        ask([photographs])
    with pytest.warns(UserWarning, match="has room"), pytest.raises(ValueError, match="nothing was trained"):
        ask([budget])
    assert capsys.readouterr().err.count("Train all the same? [y/N]") == 2


def test_the_pace_counts_what_follows_the_stage():
    pace = pace_of([10.0, 12.0], after=RestOfRun(400, 3))
    for done in (10, 50):
        pace.time(done, 1, 0, 5.0)
    assert pace.left(50).total_seconds() == 82  # 1,350 iterations of 50 ms, and 3 programs of 5 s.
    assert pace.forecast_at(50) == "50 ms an iteration, about 0:01:22 left"


def test_a_run_is_forecast_with_its_later_stages_and_its_evaluation():
    plan, scene = plan_run({"a2tg": a2tg.A2tg.preset("smoke")}), a2tg.synthetic_scene(width=40, height=30)
    first, last = plan.names
    after, alone = time_after(scene, plan, plan.names), time_after(scene, plan, [last])
    views = len(scene.train) + len(scene.test)
    assert alone[last] == after[last] == (1.5 * views, 0.5, 0)
    assert time_after(scene, plan, [last], num_tuning=1000)[last] == (1.5 * views + 1000, 0.5, 0)
    assert after[first].iterations == 1.5 * views + plan[last].stage.iterations and after[first].programs > 1.5
    _, textured = forecast_stages(scene, plan[last].system)
    assert after[first].model_bytes == textured.model_bytes


def test_the_halved_photographs_of_a_comparison_count_as_the_work_that_they_are():
    main, other = (a2tg.Gaussians2dMcmc.preset("quick", coarse_share=share) for share in (0.0, 0.5))
    plan = plan_run({"main": main, "other": other})
    last, first, _ = plan.names[1:]
    stage = plan[first].stage
    assert stage.num_coarse == stage.iterations // 2

    def iterations_after(scene):
        evaluation = time_after(scene, plan, [last])[last].iterations
        return time_after(scene, plan, [last, first])[last].iterations - evaluation

    large, small = scene_of(300, 200), scene_of(300, 100)
    assert iterations_after(large) == pytest.approx(stage.iterations - (1 - HALVED_WORK) * stage.num_coarse)
    assert iterations_after(small) == stage.iterations, "photographs of less than 128 rows are not halved"
    programs = [next(iter(forecast_stages(scene, other))).num_programs for scene in (large, small)]
    assert programs[0] == programs[1] + 1


def test_the_pace_counts_every_view_that_is_halved():
    """Not only the first one, which may be the one that is too small."""
    views = (scene_of(300, 100).train[0], *scene_of(300, 200).train[1:])
    saved = saved_work(views)
    assert saved == pytest.approx((1 - HALVED_WORK) * (len(views) - 1) / len(views))
    pace = pace_of([0.0, 10.0], num_coarse=500, saved=saved)
    for done in (0, 100):
        pace.time(done, 1)
    work = (500 - 100) * (1 - saved) + 500
    assert pace.left(100).total_seconds() == round(10 * work / (100 * (1 - saved)))


def test_the_end_of_a_run_is_no_longer_than_it_was_measured():
    """Of three stages with 28 views each, iterations of 88 ms and a step that compiled in 77 s, on a busy machine: a
    minute was left after the last iteration, and a compilation for each model made it four."""
    chain = tuple(f"bytewise-{name}" for name in ("gaussians", "details", "more"))
    plan = plan_run({"bytewise": a2tg.Bytewise.preset("quick", more=(300,), memory_budget=0.3)})
    assert tuple(plan.names) == chain
    rest = time_after(scene_of(24, 16, num_views=28), plan, [chain[-1]])[chain[-1]]
    pace = pace_of([0.0, 8.8], after=rest)
    for done in (800, 900):
        pace.time(done, 1, 0, 77.0)
    lefts = [pace.left(done).total_seconds() for done in (900, 950, 1000)]
    assert 40 <= lefts[-1] <= 80
    np.testing.assert_allclose(np.diff(lefts), -50 * 0.088, atol=1)


def test_the_pace_is_above_the_bar(capsys):
    with a2tg.ProgressBar("a-stage", 0, 100) as bar:
        bar.tell("50 ms an iteration, about 0:00:47 left")
    captured = capsys.readouterr()
    assert "\r" not in captured.err
    assert captured.out == "a-stage: 50 ms an iteration, about 0:00:47 left\n"


def test_items_without_a_terminal_are_counted_in_plain_lines(capsys, monkeypatch):
    monkeypatch.setattr(progress_bars, "PLAIN_SECONDS", 0.0)
    assert list(progress_bars.progress_over(list(range(25)), "frames", "frame")) == list(range(25))
    lines = capsys.readouterr().err.splitlines()
    assert (
        lines[0].startswith("frames: 3 of 25, about 0:00:00 left")
        and lines[-1] == "frames: 25 of 25"
        and len(lines) == 9
    )
    assert list(progress_bars.progress_over([1, 2], "frames", "frame", is_shown=False)) == [1, 2]
    assert not capsys.readouterr().err


def test_without_a_terminal_tenths_are_plain_lines(capsys, monkeypatch):
    monkeypatch.setattr(progress_bars, "PLAIN_SECONDS", 0.0)
    with a2tg.ProgressBar("a-stage", 0, 20) as bar:
        for done in range(1, 21):
            bar.update(done, 0.5, 20.0, None, None)
    lines = capsys.readouterr().err.splitlines()
    assert lines[:2] == ["a-stage: compiling", "a-stage: 2 of 20, loss 0.5000, 20.00 dB"] and len(lines) == 11


def test_an_infinite_psnr_does_not_stay_in_the_running_mean(capsys, monkeypatch):
    monkeypatch.setattr(progress_bars, "PLAIN_SECONDS", 0.0)
    with a2tg.ProgressBar("a-stage", 0, 4) as bar:
        for done, psnr in enumerate((np.inf, 20.0, np.inf, 20.0), 1):
            bar.update(done, 0.5, psnr, None, None)
    assert capsys.readouterr().err.endswith("a-stage: 4 of 4, loss 0.5000, 20.00 dB\n")


def test_in_a_notebook_a_bar_is_one_output(capsys, monkeypatch):
    """Each output of a cell that is shown, with all lines that replaced one another."""
    outputs = []

    def display(line, *, raw, display_id):
        assert raw and display_id
        outputs.append([line["text/plain"]])
        return SimpleNamespace(update=lambda line, raw, place=outputs[-1]: place.append(line["text/plain"]))

    monkeypatch.setitem(sys.modules, "IPython.display", SimpleNamespace(display=display))
    stream = type("OutStream", (io.StringIO,), {"__module__": "ipykernel.iostream"})()
    monkeypatch.setattr(sys, "stderr", stream)
    assert list(progress_bars.progress_over([1, 2, 3], "frames", "frame")) == [1, 2, 3]
    with a2tg.ProgressBar("a-stage", 0, 20) as bar:
        for done in range(1, 21):
            bar.update(done, 0.5, 20.0, None, None)
    frames, stage = outputs
    assert "| 0/3 " in frames[0] and "| 3/3 " in frames[-1]
    assert "a-stage (compiling)" in stage[0] and "a-stage: 100%" in stage[-1] and "| 20/20 " in stage[-1]
    assert list(progress_bars.progress_over([1], "frames", "frame", is_shown=False)) == [1]
    assert len(outputs) == 2 and not stream.getvalue() and not capsys.readouterr().out
