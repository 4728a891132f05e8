"""Comparison files: what a comparison found as numbers, maps and figures in a folder."""

from __future__ import annotations

import json
from pathlib import Path

from chdstat._core.files import replacing, unused
from chdstat.analysis import save
from chdstat.comparison import Comparison, ErrorCurve
from chdstat.errors import StoreError
from chdstat.estimators import MLP, Progressive
from chdstat.reporting import figures
from chdstat.viz.lettering import spelt

__all__ = ["save_comparison"]


def save_comparison(
    found: Comparison, folder: str | Path, *, curve: ErrorCurve | None = None
) -> list[Path]:
    """Write a comparison to a new folder, which is there when it is complete.

    ``comparison.json`` holds every measure, ``comparison.zarr`` the estimates and errors as maps,
    one PDF each figure, ``<name>.safetensors`` each estimator that was trained.

    Parameters
    ----------
    found
        What `chdstat.compare` found.
    folder
        Where to; nothing may be there.
    curve
        What `chdstat.error_curve` found, to go with it.

    Returns
    -------
    list of Path
        What was written.

    Raises
    ------
    StoreError
        If something is there already, or cannot be written.
    """
    target = unused(folder)
    content = found.to_dict() | ({} if curve is None else {"curve": curve.to_dict()})
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with replacing(target, folder=True) as partial:
            text = json.dumps(content, indent=2, allow_nan=False)
            (partial / "comparison.json").write_text(text, encoding="utf-8")
            save(found.to_dataset(), partial / "comparison.zarr")
            with spelt():
                for name, figure in figures.of_comparison(found, curve).items():
                    figure.savefig(partial / f"{name}.pdf", metadata={"CreationDate": None})
            for name, model in found.models.items():
                if isinstance(model, (MLP, Progressive)):
                    model.save(partial / f"{name}.safetensors")
    except OSError as error:
        message = f"cannot write to {target}: {error.strerror or error}"
        raise StoreError(message) from error
    return sorted(target.iterdir())
