"""The viewer's page, one HTML file with script and style inside, and the files next to it."""

import base64
import html
import re
from importlib import resources

SCENE_NAME = "scene.a2tgz"
"""Name of the scene file next to the page."""
PHOTOGRAPHS_NAME = "photographs.json"
"""Name of the list of cameras with photographs next to the page (`photograph_name`)."""
STATUS_NAME = "training.json"
"""Name of the status of a running training, which the page polls while it exists."""


def viewer_html(*, is_training: bool = False, is_exported: bool = False) -> str:
    """Return the viewer's page for the scene next to it, or for a running training; exported, with its panel folded."""
    page = resources.files(__package__).joinpath("viewer.html").read_text(encoding="utf-8")
    if is_exported:
        page = page.replace('<details id="panel" open>', '<details id="panel">', 1)
    # An attribute, not a script: the page's policy allows no other script than its own.
    return page.replace("<html ", '<html data-training="yes" ', 1) if is_training else page


def viewer_html_with(scene: bytes) -> str:
    """Return the viewer's page with a scene in it; it needs no other file."""
    # text/plain, which browsers do not run, so that the page's policy stays as it is; before the script.
    data = f'<script type="text/plain" id="scene-data">{base64.b64encode(scene).decode("ascii")}</script>\n  '
    head, script, rest = viewer_html(is_exported=True).partition('<script type="module">')
    return f"{head}{data}{script}{rest}"


def comparison_html(first: tuple[str, bytes], second: tuple[str, bytes]) -> str:
    """Return a page with two scenes, each a title and a file, and a divider between them."""
    page = resources.files(__package__).joinpath("compare.html").read_text(encoding="utf-8")
    values = {"title": f"{first[0]} | {second[0]}"}
    for name, (title, scene) in (("first", first), ("second", second)):
        values |= {name: title, f"{name}_page": viewer_html_with(scene)}
    # In one pass, so that no text is taken for the place of another.
    return re.sub(r"\{(\w+)\}", lambda found: html.escape(values[found[1]]), page)


def photograph_name(index: int) -> str:
    """Return the path of a camera's photograph."""
    return f"photographs/{index}.jpg"
