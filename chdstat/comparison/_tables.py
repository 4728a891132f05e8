"""Tables: measures with their intervals as rows, as variables, and as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat.comparison._sums import MEASURES
from chdstat.metrics import Interval

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "ALL_CHANNELS",
    "OVER_BATCHES",
    "about_of",
    "dataset_of",
    "interval_variables",
    "names_array",
    "parts_of",
    "ready_for_json",
    "row_of",
]

Array = npt.NDArray[Any]

ALL_CHANNELS = -1
"""Last place of the channel axis of a measure: the average over channels."""
OVER_BATCHES = "_over_batches"
"""What follows the suffix of an interval over batches, in place of pixels."""
_SUFFIXES = {
    "": "",
    "_se": ", standard error",
    "_low": ", lower end of the 95 % interval",
    "_high": ", upper end of the 95 % interval",
}


def parts_of(interval: Interval) -> dict[str, Array]:
    """Return value, standard error and ends of an interval, by the suffix of their name."""
    values = interval.value, interval.standard_error, interval.low, interval.high
    return dict(zip(_SUFFIXES, values, strict=True))


def interval_variables(
    measures: Mapping[str, Interval],
    dims: tuple[str, ...],
    *,
    prefix: str = "",
    infix: str = "",
    about: str = "",
    skip_value: bool = False,
) -> dict[str, Any]:
    """Return measures as variables of a dataset, with long names and units."""
    variables = {}
    for measure, interval in measures.items():
        long_name, units = MEASURES[measure]
        for suffix, values in parts_of(interval).items():
            if suffix or not skip_value:
                attrs = about_of(f"{long_name}{_SUFFIXES[suffix]}{about}", units)
                variables[prefix + measure + suffix + infix] = (dims, values, attrs)
    return variables


def dataset_of(
    variables: Mapping[str, Any], coordinates: Mapping[str, Any], attrs: Mapping[str, Any]
) -> xr.Dataset:
    """Return a dataset whose attributes a file can hold: what is neither text nor whole is JSON."""
    import xarray as xr

    plain = {
        k: v if isinstance(v, str | int) else json.dumps(v, default=str) for k, v in attrs.items()
    }
    return xr.Dataset(dict(variables), dict(coordinates), plain)


def names_array(names: Iterable[str]) -> npt.NDArray[np.object_]:
    """Return names as a coordinate: zarr v3 has no stable type for text of fixed length."""
    return np.array(list(names), dtype=object)


def ready_for_json(value: Any) -> Any:
    """Replace what JSON cannot say."""
    if isinstance(value, Mapping):
        return {str(key): ready_for_json(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [ready_for_json(part) for part in value]
    if isinstance(value, np.generic | np.ndarray):
        return ready_for_json(value.tolist())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def row_of(
    measures: Mapping[str, Interval], index: tuple[int, int], *, infix: str = ""
) -> dict[str, float]:
    """Return one place of all measures as a flat row; with an infix, without the values."""
    return {
        measure + suffix + infix: float(values[index])
        for measure, interval in measures.items()
        for suffix, values in parts_of(interval).items()
        if suffix or not infix
    }


def about_of(long_name: str, units: str) -> dict[str, str]:
    """Return the attributes of a variable."""
    return {"long_name": long_name, "units": units}
