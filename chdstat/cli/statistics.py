"""Statistics: the commands that say what samples are like."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from chdstat.cli._app import app
from chdstat.cli._options import Json, Quiet, StorePath, progress_of, thresholds_of
from chdstat.cli._output import print_json, print_table

__all__ = ["analyze"]


@app.command(epilog="Example: chdstat analyze bathroom.zarr -o bathroom-maps.zarr")
def analyze(
    store: StorePath,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="Write all maps to this new zarr store.", show_default=False
        ),
    ] = None,
    threshold: Annotated[
        list[str] | None,
        typer.Option(
            "--threshold",
            metavar="NAME=VALUE",
            help="When a pattern counts, such as tail_index=0.3; repeat for more.",
        ),
    ] = None,
    resamples: Annotated[
        int,
        typer.Option(min=0, help="Bootstrap replicates of goodness of fit: minutes for an image."),
    ] = 0,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Say what the sample distributions of a store are: nulls, families, tails, modes, averages."""
    import chdstat
    from chdstat._core.files import unused
    from chdstat.analysis import save
    from chdstat.overviews import overview

    if out is not None:
        unused(out)  # refused before the work, not after
    thresholds = thresholds_of(threshold)
    dataset = chdstat.analyze(
        chdstat.open(store),
        thresholds=thresholds,
        resamples=resamples,
        progress=progress_of(quiet),
    )
    if out is not None:
        save(dataset, out)
    numbers = overview(dataset).to_dict()
    if as_json:
        print_json(numbers)
    else:
        print_table(numbers)
