"""LPIPS kept from an earlier measurement, if this one has no weights."""

import dataclasses
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from a2tg_jax.host.regular_files import open_regular
from a2tg_jax.measure.evaluation import Evaluation
from a2tg_jax.results.folder import RunFolder, read_json
from a2tg_jax.results.summary import ModelResult


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def with_kept_lpips(run: RunFolder, measured: Mapping[str, ModelResult]) -> dict[str, ModelResult]:
    """Return the metrics with the LPIPS of metrics.json for every model file that has not changed since."""
    try:
        metrics, per_view = read_json(run.metrics), read_json(run.per_view)
        network, models = metrics["lpips_network"], metrics["models"]
        unchanged = {name for name, found in measured.items() if models.get(name, {}).get("sha256") == found.sha256}
        return {
            name: _with_lpips(found, per_view[name], network) if network and name in unchanged else found
            for name, found in measured.items()
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return dict(measured)  # none was measured, or it cannot be read


def _with_lpips(found: ModelResult, kept: Mapping[str, Any], network: str) -> ModelResult:
    test = None if found.test is None else _merged(found.test, kept[found.held_out], network)
    corrected = {key: _merged(evaluation, kept[key], network) for key, evaluation in found.corrected.items()}
    train = _merged(found.train, kept["train"], network)
    return dataclasses.replace(found, train=train, test=test, corrected=corrected)


def _merged(found: Evaluation, kept: Mapping[str, Any], network: str) -> Evaluation:
    per_view = tuple(dataclasses.replace(view, lpips=float(kept[view.name]["lpips"])) for view in found.per_view)
    return dataclasses.replace(found, per_view=per_view, lpips_network=network)
