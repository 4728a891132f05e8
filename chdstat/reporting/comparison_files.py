"""Comparison files: what a comparison found as numbers, maps and figures in a folder."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from matplotlib.figure import Figure

from chdstat.analysis import save
from chdstat.comparison import Comparison, ErrorCurve
from chdstat.errors import StoreError
from chdstat.estimators import MLP, Progressive
from chdstat.reporting import figures
from chdstat.viz.lettering import spelt

__all__ = ["save_comparison", "unused_folder"]


_NUMBERS = "comparison.json"


def save_comparison(
    found: Comparison, folder: str | Path, *, curve: ErrorCurve | None = None
) -> list[Path]:
    """Write a comparison to a folder that has none yet.

    ``comparison.json`` holds every measure, ``comparison.zarr`` the estimates and errors as maps,
    one PDF each figure, ``<name>.safetensors`` each estimator that was trained.

    Parameters
    ----------
    found
        What `chdstat.compare` found.
    folder
        Where to; made if it is not there.
    curve
        What `chdstat.error_curve` found, to go with it.

    Returns
    -------
    list of Path
        What was written.

    Raises
    ------
    StoreError
        If a comparison is there already, or something cannot be written.
    """
    target = unused_folder(folder)
    numbers = target / _NUMBERS
    content = found.to_dict() | ({} if curve is None else {"curve": curve.to_dict()})
    try:
        target.mkdir(parents=True, exist_ok=True)
        numbers.write_text(json.dumps(content, indent=2, allow_nan=False), encoding="utf-8")
        drawn = _save_figures(figures.of_comparison(found, curve), target)
    except OSError as error:
        message = f"cannot write to {target}: {error.strerror or error}"
        raise StoreError(message) from error
    maps = save(found.to_dataset(), target / "comparison.zarr")
    return [numbers, maps, *drawn, *_save_models(found, target)]


def unused_folder(folder: str | Path) -> Path:
    """Return a folder to write to, or raise StoreError if a comparison is there already."""
    target = Path(folder)
    if (target / _NUMBERS).exists():
        message = f"{target} holds a comparison; nothing was overwritten. Give another folder"
        raise StoreError(message)
    return target


def _save_figures(drawn: Mapping[str, Figure], target: Path) -> list[Path]:
    paths = {target / f"{name}.pdf": figure for name, figure in drawn.items()}
    with spelt():
        for path, figure in paths.items():
            figure.savefig(path, metadata={"CreationDate": None})
    return list(paths)


def _save_models(found: Comparison, target: Path) -> list[Path]:
    trained = {
        name: model for name, model in found.models.items() if isinstance(model, (MLP, Progressive))
    }
    for name, model in trained.items():
        model.save(target / f"{name}.safetensors")
    return [target / f"{name}.safetensors" for name in trained]
