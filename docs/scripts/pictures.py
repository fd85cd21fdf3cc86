"""Write the pictures of docs/tutorial.md and docs/meshes.md: the viewer, a mesh and its texture, losses for surfaces.

python docs/scripts/pictures.py SCENE docs/images

SCENE is a capture whose licence allows pictures of it, here snowmiku (MIT). Models are trained once and kept in
runs/pictures. Needs Chromium and the extra [mesh]; takes half an hour on two cores.
"""

import io
import json
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile
from base64 import b64decode
from typing import IO, Any

import numpy as np
from PIL import Image

import a2tg_jax as a2tg
from a2tg_jax.core.cameras import resize_camera
from a2tg_jax.mesh.texturing import draw_view
from a2tg_jax.results.images import to_uint8
from a2tg_jax.results.model_source import Source
from a2tg_jax.web.page import viewer_html_with

MODELS = pathlib.Path("runs/pictures")
ITERATIONS = 2_000
BUDGET = "0.3MB"
NORMALS = {"normal_weight": 0.2}
NUM_FACES = 100_000
ATLAS = 1024
RESOLUTION = 256
WINDOW = 1100, 660
WIDTH, GAP, QUALITY = 560, 8, 88
"""Pixels of a mesh's view and between two, and the quality of JPEG files."""
LIGHT = np.array([-0.4, -0.5, -0.77])
"""Direction to the light in camera axes: left, up, and back."""
LOADED = "new Promise(done => { (function look() { window.a2tg ? a2tg.loaded.then(done) : setTimeout(look, 100) })() })"


def main(capture: pathlib.Path, out: pathlib.Path) -> None:
    """Train what is missing and write all pictures."""
    scene = a2tg.load_scene(capture, downscale=2)
    system = a2tg.Bytewise.preset("quick", memory_budget=BUDGET, **lengths(ITERATIONS))
    source = Source(trained(scene, system, "viewer"), scene.name)
    save(picture_of_viewer(source, find_chromium() or sys.exit("needs Chromium")), out / "viewer.jpg")
    save(picture_of_mesh(scene, trained(scene, surfaces(NORMALS), "mesh")), out / "mesh.jpg")
    built_in = a2tg.synthetic_scene(width=208, height=156)
    models = [trained(built_in, surfaces(losses), name) for losses, name in (({}, "plain"), (NORMALS, "normals"))]
    save(picture_of_losses(models), out / "mesh-losses.jpg")


def lengths(iterations: int) -> dict[str, int]:
    return {"stage1_iterations": iterations, "stage2_iterations": iterations // 2}


def surfaces(losses: dict[str, float]) -> a2tg.System:
    return a2tg.Gaussians2d.preset("quick", loss=losses, **lengths(ITERATIONS))


def trained(scene: a2tg.Scene, system: a2tg.System, name: str) -> a2tg.Model:
    """Return the model of that name, trained if it is missing."""
    path = MODELS / f"{name}.npz"
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        a2tg.save_model(path, a2tg.fit(scene, system).model)
    return a2tg.load_model(path)


def save(picture: Image.Image, path: pathlib.Path) -> None:
    picture.save(path, quality=QUALITY)


# Meshes


def picture_of_mesh(
    scene: a2tg.Scene, model: a2tg.Model, *, resolution: int = RESOLUTION, size: int = ATLAS
) -> Image.Image:
    """Draw a mesh, the mesh with a texture of the photographs, and the texture atlas."""
    mesh = a2tg.simplify_mesh(a2tg.extract_mesh(model, resolution=resolution).mesh, NUM_FACES)
    views = ((view.camera, a2tg.view_image(view, model.background), None) for view in scene.train)
    mesh = a2tg.texture_mesh(mesh, views, size=size)
    camera = enlarged(scene.test[len(scene.test) // 2].camera)
    atlas = Image.fromarray(mesh.texture).resize((camera.height, camera.height), Image.Resampling.LANCZOS)
    return side_by_side([shaded(mesh, camera), textured(mesh, camera), np.asarray(atlas)])


def picture_of_losses(models: list[a2tg.Model], *, resolution: int = RESOLUTION) -> Image.Image:
    """Draw the meshes of several models in one view."""
    meshes = (a2tg.extract_mesh(model, resolution=resolution).mesh for model in models)
    return side_by_side([shaded(mesh, enlarged(models[0].origin.cameras[0])) for mesh in meshes])


def enlarged(camera: a2tg.Camera) -> a2tg.Camera:
    return resize_camera(camera, WIDTH, round(WIDTH * camera.height / camera.width))


def shaded(mesh: a2tg.Mesh, camera: a2tg.Camera) -> np.ndarray:
    """Draw a grey mesh in a camera's view, [H, W, 3], white where there is none."""
    normals = np.zeros((mesh.num_vertices, 3))
    for corners in mesh.faces.T:
        np.add.at(normals, corners, mesh.face_normals)
    normals, is_hit = interpolated(normals, mesh, camera)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-30)
    light = 0.25 + 0.75 * np.clip(normals @ np.asarray(camera.viewmat)[:3, :3].T @ LIGHT, 0, 1)
    return to_uint8(np.where(is_hit, light[..., None], np.ones(3)))


def textured(mesh: a2tg.Mesh, camera: a2tg.Camera) -> np.ndarray:
    """Draw a mesh with its texture in a camera's view, [H, W, 3], white where there is none."""
    uv, is_hit = interpolated(mesh.uv, mesh, camera)
    height, width = mesh.texture.shape[:2]
    row = np.clip((1 - uv[..., 1]) * height, 0, height - 1).astype(int)
    column = np.clip(uv[..., 0] * width, 0, width - 1).astype(int)
    return np.where(is_hit, mesh.texture[row, column], np.uint8(255))


def interpolated(values: np.ndarray, mesh: a2tg.Mesh, camera: a2tg.Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return values of vertices [V, C] at the pixels of a view, [H, W, C], and whether a face is there, [H, W, 1]."""
    drawn = draw_view(mesh, camera)
    return np.einsum("hwk,hwkc->hwc", drawn.weights, values[mesh.faces[drawn.face]]), drawn.face[..., None] >= 0


def side_by_side(pictures: list[np.ndarray]) -> Image.Image:
    gap = np.full((len(pictures[0]), GAP, 3), 255, np.uint8)
    return Image.fromarray(np.concatenate([part for picture in pictures for part in (gap, picture)][1:], axis=1))


# The viewer


def find_chromium() -> str | None:
    """Return the path of Chromium, None if it is not installed."""
    return next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


def picture_of_viewer(source: Source, chromium: str, window: tuple[int, int] = WINDOW) -> Image.Image:
    """Draw the viewer's page with its panel unfolded, without a graphics processor."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        page = pathlib.Path(folder) / "scene.html"
        text = viewer_html_with(source.encoded).replace('<details id="panel">', '<details id="panel" open>', 1)
        page.write_text(text, encoding="utf-8")
        options = ["--headless", "--no-sandbox", "--no-first-run", "--remote-debugging-pipe",
                   "--use-angle=swiftshader", "--enable-unsafe-swiftshader", f"--user-data-dir={folder}/profile",
                   "about:blank"]  # fmt: skip
        (commands, to_browser), (from_browser, answers) = os.pipe(), os.pipe()
        # Chromium reads commands from file 3 and writes answers to file 4.
        launch = ["bash", "-c", f'exec "$@" 3<&{commands} 4>&{answers}', "bash", chromium, *options]
        process = subprocess.Popen(
            launch, pass_fds=(commands, answers), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        os.close(commands)
        os.close(answers)
        with os.fdopen(to_browser, "wb", 0) as written, os.fdopen(from_browser, "rb") as read:
            try:
                return Image.open(io.BytesIO(screenshot(DevTools(written, read), page.as_uri(), window))).convert("RGB")
            finally:
                process.terminate()
                process.wait()


def screenshot(browser: "DevTools", address: str, window: tuple[int, int]) -> bytes:
    """Return a PNG file of the viewer's page, once the whole scene is loaded and drawn."""
    pages = (each for each in browser("Target.getTargets")["targetInfos"] if each["type"] == "page")
    browser.session = browser("Target.attachToTarget", targetId=next(pages)["targetId"], flatten=True)["sessionId"]
    width, height = window
    browser("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
    browser("Page.navigate", url=address)
    browser("Runtime.evaluate", expression=LOADED, awaitPromise=True)
    before = b""
    now = b"-"
    while before != now:  # The page draws finer and finer pictures.
        browser("Runtime.evaluate", expression="new Promise(done => setTimeout(done, 3000))", awaitPromise=True)
        before = now
        now = b64decode(browser("Page.captureScreenshot", format="png")["data"])
    return now


class DevTools:
    """Chromium's DevTools protocol: JSON messages that end in a zero byte."""

    def __init__(self, commands: IO[bytes], answers: IO[bytes]):
        self._commands = commands
        self._answers = answers
        self._num = 0
        self.session: str | None = None

    def __call__(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command and return its result."""
        self._num += 1
        session = {} if self.session is None else {"sessionId": self.session}
        command = {"id": self._num, "method": method, "params": parameters, **session}
        self._commands.write(json.dumps(command).encode() + b"\0")
        while (answer := json.loads(self._message())).get("id") != self._num:
            pass  # An event.
        if "error" in answer:
            raise OSError(f"{method}: {answer['error']}")
        return answer["result"]

    def _message(self) -> bytes:
        found = bytearray()
        while (byte := self._answers.read(1)) != b"\0":
            if not byte:
                raise OSError("Chromium has ended")
            found += byte
        return bytes(found)


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]))
