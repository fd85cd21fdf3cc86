"""Docstrings of public names: examples run, arguments, results and fields are described, nothing private is named."""

import ast
import doctest
import inspect
import re
import typing
from pathlib import Path

import pytest
from docstring_parser import parse_from_object
from small_models import write_random_squeeze
from test_data_transforms import write_scene

import a2tg_jax as a2tg

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "a2tg_jax"
MAIN = {
    "A2tg", "adam_update", "allocate_textures", "Bytewise", "Camera", "CloneSplitPrune", "evaluate", "extract_mesh",
    "find_system", "fit", "fit_stage", "Gaussians", "Gaussians2dMcmc", "grow", "init_from_points", "load_compact",
    "load_model", "load_ply", "load_scene", "look_at", "lpips", "Mcmc", "Model", "next_sizes", "perturb",
    "photometric_loss", "plan_render", "polish", "Prune", "psnr", "reallocate", "relocate", "render_appearance",
    "render_image", "Renderer", "RenderSettings", "save_compact", "save_gltf", "save_mesh", "save_model", "save_ply",
    "save_splats", "scene_from_arrays", "select", "Similarity", "smooth_path", "ssim", "synthetic_scene", "Term",
    "Textures", "textures_from_arrays", "Upscale", "value_and_grad", "view_gradients", "view_image",
}  # fmt: skip
"""Names with an example."""
ALSO_PUBLIC = {"Table"}
"""Names that the reference gives to custom systems besides."""
PUBLIC = {name: getattr(a2tg, name) for name in a2tg.__all__}
FUNCTIONS = {name: value for name, value in PUBLIC.items() if inspect.isfunction(value)}


def documented():
    """The docstrings of public names, and of the methods and properties of public classes, by name."""
    for name, value in PUBLIC.items():
        yield name, inspect.getdoc(value) or ""
        for member, own in vars(value).items() if inspect.isclass(value) else ():
            own = getattr(own, "fget", None) or getattr(own, "func", None) or getattr(own, "__func__", own)
            if inspect.isfunction(own) and (member == "__init__" or not member.startswith("_")):
                yield f"{name}.{member}", inspect.getdoc(own) or ""


def members() -> set[str]:
    """What public docstrings may name besides public names: fields, methods and parameters."""
    found = set()
    for value in PUBLIC.values():
        if inspect.isclass(value):
            found |= {name for base in value.__mro__ for name in [*vars(base), *vars(base).get("__annotations__", {})]}
        found |= set(inspect.signature(value.__init__ if inspect.isclass(value) else value).parameters)
    return found


def private_names() -> set[str]:
    """What modules of the package define and `a2tg_jax` does not offer."""
    found = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            targets = getattr(node, "targets", [getattr(node, "target", None)])
            found |= {getattr(node, "name", "")} | {target.id for target in targets if isinstance(target, ast.Name)}
    return found - PUBLIC.keys() - members() - ALSO_PUBLIC


@pytest.fixture(scope="module")
def names(tmp_path_factory):
    """The names with which the reference says that examples begin."""
    folder = tmp_path_factory.mktemp("examples")
    (folder / "scene").mkdir()
    write_scene(folder / "scene")
    write_random_squeeze(folder / "lpips.npz")
    (block,) = re.findall(r"^```python\n(.*?)^```", (ROOT / "docs/api/index.md").read_text(), re.MULTILINE | re.DOTALL)
    made = {"folder": folder}
    exec(block, made)
    return made


@pytest.mark.parametrize("name", [name for name in PUBLIC if ">>> " in (inspect.getdoc(PUBLIC[name]) or "")])
def test_examples_run(name, names, monkeypatch):
    monkeypatch.chdir(names["folder"])
    example = doctest.DocTestParser().get_doctest(inspect.getdoc(PUBLIC[name]), dict(names), name, None, None)
    printed = []
    failed = doctest.DocTestRunner().run(example, out=printed.append).failed
    assert not failed, "".join(printed)


def test_main_names_have_an_example():
    assert not {name for name in MAIN if ">>> " not in (inspect.getdoc(PUBLIC[name]) or "")}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_argument_and_result_is_described(name):
    text = inspect.getdoc(FUNCTIONS[name])
    signature = inspect.signature(FUNCTIONS[name])
    described = re.findall(r"^  \*{0,2}(\w+): ", text.partition("Args:\n")[2].partition("\n\n")[0], re.MULTILINE)
    assert described == list(signature.parameters)
    assert ("\nReturns:\n" in text) == (signature.return_annotation not in (None, "None"))
    if re.search(r"^    raise ", inspect.getsource(FUNCTIONS[name]), re.MULTILINE):
        assert "\nRaises:\n" in text


INTERNAL = {
    "BandStatistics", "Clock", "CloneSplitPlan", "Coefficients", "Devices", "Event", "KernelRates", "Machine",
    "Layout", "RecordedViews", "SplitStatistics", "TileRoom", "TrainState",
}  # fmt: skip
"""Types in public signatures whose values users only pass on, or give as mappings."""


def named_classes(hint) -> set[str]:
    """The classes of the package in an annotation."""
    if isinstance(hint, type) and not typing.get_args(hint):
        return {hint.__name__} if hint.__module__.startswith("a2tg_jax.") else set()
    inner = hint if isinstance(hint, list | tuple) else typing.get_args(hint)
    return set().union(*map(named_classes, inner))


def test_types_in_public_signatures_are_public():
    found = set()
    for value in PUBLIC.values():
        members = vars(value).values() if inspect.isclass(value) else ()
        for own in [value, *members]:
            own = getattr(own, "fget", None) or getattr(own, "__func__", own)
            is_public = inspect.isclass(own) or not getattr(own, "__name__", "_").startswith("_")
            if (inspect.isfunction(own) and is_public) or own is value:
                for hint in typing.get_type_hints(own).values():
                    found |= named_classes(hint)
    assert found - PUBLIC.keys() == INTERNAL


def test_every_field_is_described():
    wanted = {
        f"{name}.{field}"
        for name, value in PUBLIC.items()
        for field in getattr(value, "__dataclass_fields__", getattr(value, "_fields", ()))
        if not field.startswith("_")
    }
    found = set()
    for name, value in PUBLIC.items():
        for base in value.__mro__ if inspect.isclass(value) else ():
            if base.__module__.startswith("a2tg_jax."):
                found |= {f"{name}.{param.arg_name}" for param in parse_from_object(base).params if param.description}
    assert not wanted - found


def test_docstrings_name_nothing_private():
    private = private_names()
    found = set()
    modules = {path.stem for path in PACKAGE.rglob("*.py")} | {path.name for path in PACKAGE.iterdir()}
    modules -= members() | PUBLIC.keys()
    for name, text in documented():
        for quoted in re.findall(r"`([A-Za-z_][\w.]*)", text):
            head, *_, last = quoted.split(".") if "." in quoted else (quoted, quoted)
            if last in private or re.match("_[a-z]", last) or (head != last != "json" and head in modules):
                found.add((name, quoted))
        # Classes are written without quotes, too.
        found |= {(name, word) for word in re.findall(r"\b(?:[A-Z][a-z]+){2,}\b", text) if word in private}
    assert not found
