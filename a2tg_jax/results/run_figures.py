"""Figures of a run: files in its folder, and how the report shows them."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.colors import to_hex

from a2tg_jax.core.cameras import Camera
from a2tg_jax.host.atomic import replacing
from a2tg_jax.model import Model
from a2tg_jax.rasterize.render_types import RenderSettings
from a2tg_jax.renderer import Renderer
from a2tg_jax.results.figures import curves_figure, save_figure, sizes_figure
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.images import file_uri, level_colors, save_picture, texel_levels
from a2tg_jax.results.model_pictures import depth_picture, flight, learned_textures, level_picture, normal_picture
from a2tg_jax.training import History

NOT_HIT = "chequered where nothing is hit and the background shows"


@dataclasses.dataclass(frozen=True)
class ReportFigure:
    """A file in the run folder, as the report shows it."""

    path: Path
    caption: str
    kind: str = ""
    """Class of the report's style."""
    legend: Sequence[tuple[str, str]] = ()
    """Colours, as CSS names them, and what they mean."""

    @property
    def uri(self) -> str:
        return file_uri(self.path)


@dataclasses.dataclass(frozen=True)
class Figures:
    """All figures of a run, by their places in the report."""

    curves: Sequence[ReportFigure] = ()
    textures: Sequence[ReportFigure] = ()
    """Textures and their sizes; none if no Gaussian has more than one texel."""
    maps: Sequence[ReportFigure] = ()
    """A view in colours of what varies between Gaussians."""
    geometry: Sequence[ReportFigure] = ()
    flight: Sequence[ReportFigure] = ()


class LevelMap(NamedTuple):
    """Level of each Gaussian in a property that varies, such as its degree."""

    file: str
    told: str
    levels: np.ndarray
    """[N] integers, each of which has a colour."""
    names: Sequence[str]
    """Meaning of levels 0, 1, …"""


def level_maps(model: Model) -> list[LevelMap]:
    """Return the texels of each Gaussian and its degree, each only if it varies."""
    maps = []
    texels = _texel_levels(model)
    if _vary(texels):
        names = ["1 or none", *(str(2**level) for level in range(1, texels.max() + 1))]
        maps.append(LevelMap("resolutions.png", "the number of its texels", texels, names))
    degrees = np.zeros(0, int) if model.appearance.bands is None else model.degrees
    if _vary(degrees):
        names = [str(degree) for degree in range(degrees.max() + 1)]
        maps.append(LevelMap("degrees.png", "the degree of its view dependence", degrees, names))
    return maps


def _texel_levels(model: Model) -> np.ndarray:
    """Return [N] log₂ of the texels; none without textures."""
    if model.textures is None or model.appearance.texture_options is None:
        return np.zeros(0, int)
    return texel_levels(model.textures)


def _vary(levels: np.ndarray) -> bool:
    return len(np.unique(levels)) > 1


def write_figures(
    run: RunFolder, model: Model, camera: Camera, settings: RenderSettings, histories: Mapping[str, History],
    starts: Mapping[str, int],
) -> Figures:  # fmt: skip
    """Write the figures of a run.

    Args:
      run: its folder.
      model: its main model.
      camera: view that shows maps, depth and normals.
      settings: render settings of the model.
      histories: of the stages, by name.
      starts: how many iterations lie before each.
    """
    return Figures(
        curves=[_curves(run, histories, starts)],
        textures=_textures(run, model) if _texel_levels(model).any() else [],
        maps=[_map(run, model, one, camera, settings) for one in level_maps(model)],
        geometry=_geometry(run, model, camera, settings),
        flight=_flight(run, model, settings),
    )


def _curves(run: RunFolder, histories: Mapping[str, History], starts: Mapping[str, int]) -> ReportFigure:
    path = run.own(run.figures / "curves.png")
    save_figure(path, curves_figure(histories, starts))
    return ReportFigure(path, "Loss and PSNR of the training views seen, with running means.", "chart")


def _textures(run: RunFolder, model: Model) -> list[ReportFigure]:
    assert model.textures is not None
    found = []
    learned = learned_textures(model)
    if learned is not None:
        path = run.own(run.figures / "textures.png")
        save_picture(path, learned)
        told = "Some textures that add much to the picture, in their Gaussians' colours; chequered where transparent."
        found.append(ReportFigure(path, told, "texels"))
    path = run.own(run.figures / "sizes.png")
    save_figure(path, sizes_figure(model.textures.sizes))
    return [*found, ReportFigure(path, "How many Gaussians have a texture of each resolution.", "chart")]


def _map(run: RunFolder, model: Model, shown: LevelMap, camera: Camera, settings: RenderSettings) -> ReportFigure:
    path = run.own(run.figures / shown.file)
    save_picture(path, level_picture(model, shown.levels, camera, settings))
    legend = [(to_hex(color), name) for color, name in zip(level_colors(len(shown.names)), shown.names, strict=True)]
    return ReportFigure(path, f"The first view, every Gaussian by {shown.told}; {NOT_HIT}.", legend=legend)


def _geometry(run: RunFolder, model: Model, camera: Camera, settings: RenderSettings) -> list[ReportFigure]:
    """Write depth and normals of a view."""
    output = Renderer(model, settings=settings)(camera)
    depth, normals = run.own(run.figures / "depth.png"), run.own(run.figures / "normals.png")
    picture, stops = depth_picture(output)
    save_picture(depth, picture)
    save_picture(normals, normal_picture(output, camera))
    legend = [(to_hex(tuple(color)), f"{distance:.3g}") for distance, color in stops]
    told = f"Depth in units of the normalised world; nearer and farther depths take the colours of the ends; {NOT_HIT}."
    facing = f"Normals: red to the right, green up, blue to the camera; {NOT_HIT}."
    return [ReportFigure(depth, told, legend=legend), ReportFigure(normals, facing)]


def _flight(run: RunFolder, model: Model, settings: RenderSettings) -> list[ReportFigure]:
    """Write an animation, if there are cameras to fly past."""
    moving = flight(model, settings)
    if moving is None:
        return []
    path = run.own(run.figures / "flight.webp")
    with replacing(path) as temporary:
        temporary.write_bytes(moving)
    return [ReportFigure(path, "A flight past the cameras.", "figure")]
