"""The views that models were trained on, against those that their scene holds out."""

from pathlib import Path

from a2tg_jax.core.display import counted
from a2tg_jax.data import Scene
from a2tg_jax.model import Model


def check_held_out(model: Model, scene: Scene, path: Path) -> None:
    """Raise ValueError if a model was trained on views that its scene holds out: their figures would be too good.

    Args:
      model: a model of a run; without an origin its views are unknown, and it passes.
      scene: the scene of the run, as it is read now.
      path: the file of the model.
    """
    if model.origin is None:
        return
    trained = {name for name, is_test in zip(model.origin.names, model.origin.is_test, strict=True) if not is_test}
    leaked = sorted(trained & {view.name for view in scene.test} - {view.name for view in scene.train})
    if leaked:
        raise ValueError(
            f"{path} was trained on {counted(len(leaked), 'view')} that {scene.name} now holds out, such as "
            f"{leaked[0]}: the photographs have changed, or views of panoramas, which are held out together since, are "
            "among them; train in a new folder"
        )
