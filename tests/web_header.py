"""The header of a scene for browsers."""

import json
from typing import Any

from a2tg_jax.io.web_scene import HEAD


def web_header(data: bytes) -> dict[str, Any]:
    num_text = HEAD.unpack_from(data)[2]
    header: dict[str, Any] = json.loads(data[HEAD.size : HEAD.size + num_text])
    return header
