"""Write the thumbnails of docs/notebooks.md: of each notebook, the picture of the cell that is tagged "thumbnail".

python docs/scripts/thumbnails.py
"""

import base64
import io
import json
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
OUT = ROOT / "docs" / "images" / "notebooks"
SIZE = 360, 120


def main() -> None:
    """Write all thumbnails."""
    OUT.mkdir(exist_ok=True)
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        (chosen,) = (cell for cell in cells if "thumbnail" in cell["metadata"].get("tags", []))
        (png,) = (output["data"]["image/png"] for output in chosen["outputs"] if "image/png" in output.get("data", {}))
        picture = Image.open(io.BytesIO(base64.b64decode("".join(png)))).convert("RGB")
        picture.thumbnail(SIZE)
        picture.save(OUT / f"{path.stem}.webp", quality=80, method=6)


if __name__ == "__main__":
    main()
