"""Pictures of files of splats by programs for browsers, drawn in a headless Chromium without a GPU."""

import base64
import http.server
import io
import json
import subprocess
import tempfile
import threading
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

PAGES = Path(__file__).parent
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)
TYPES = {".mjs": "text/javascript", ".js": "text/javascript", ".html": "text/html", ".wasm": "application/wasm"}
TIMEOUT = 120


class Camera(NamedTuple):
    """Camera as the pages place it."""

    width: int
    height: int
    K: list[list[float]]
    c2w: list[list[float]]
    """Camera to world, y up and z backward."""


def draw(page: str, file: Path, camera: Camera, others: Path, chromium: str) -> np.ndarray:
    """Return the picture [H, W, 3] uint8 that a page draws of a file.

    Args:
      page: "playcanvas", "spark" or "babylon".
      file: the splats.
      camera: in the world of the file.
      others: folder with the node_modules of the programs.
      chromium: command of Chromium.
    """
    drawn = list[bytes]()
    is_drawn = threading.Event()

    class Handler(http.server.BaseHTTPRequestHandler):
        def log_message(self, *arguments: Any) -> None:
            pass

        def do_GET(self) -> None:
            path = self.path.partition("?")[0].lstrip("/")
            if path == "camera.json":
                self.answer(json.dumps(camera._asdict()).encode(), "application/json")
                return
            found = next(
                (place for place in (PAGES / path, file.parent / path, others / path) if path and place.is_file()), None
            )
            self.answer(None if found is None else found.read_bytes(), TYPES.get(Path(path).suffix, "x/x"))

        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            self.answer(b"", "text/plain")
            if self.path == "/picture":
                drawn.append(body)
                is_drawn.set()
            else:
                print(f"{page}: {body.decode()[:300]}")

        def answer(self, body: bytes | None, kind: str) -> None:
            self.send_response(404 if body is None else 200)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body or b"")))
            self.end_headers()
            self.wfile.write(body or b"")

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server, tempfile.TemporaryDirectory() as profile:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}/{page}.html?{file.name}"
        command = [chromium, *FLAGS, f"--user-data-dir={profile}", "--window-size=1600,1200", address]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as browser:
            is_drawn.wait(TIMEOUT)
            browser.terminate()
        server.shutdown()
    if not drawn:
        raise ValueError(f"{page} drew nothing of {file.name} within {TIMEOUT} s")
    picture = base64.b64decode(drawn[0].partition(b",")[2])
    return np.asarray(Image.open(io.BytesIO(picture)).convert("RGB"))
