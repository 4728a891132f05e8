"""Normality maps: names, units and q-values of the datasets that tests of normality end in."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from chdstat._multiplicity import q_values, rejections
from chdstat._reasons import flag_attributes
from chdstat.errors import InputError

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["check_choice", "check_level", "finish"]

_LABELS = {
    "statistic": "test statistic of normality",
    "p_value": "p-value of normality",
    "skewness": "skewness of what was tested",
    "kurtosis": "excess kurtosis of what was tested",
    "predicted_skewness": "skewness of averages of independent samples",
    "predicted_kurtosis": "excess kurtosis of averages of independent samples",
    "skewness_ratio": "skewness of averages over what independent samples predict",
    "n_predicted": "samples per average whose predicted shape cannot be told from Gaussian",
    "n_predicted_interval": "95 % interval of n_predicted",
    "n_predicted_reason": "why there is no n_predicted",
    "n": "samples that were tested",
    "q_value": "q-value of normality over the image",
    "rejected": "1 where not Gaussian, at the false discovery rate of the dataset",
}


def check_choice(choice: object, table: Iterable[str], name: str) -> None:
    """Raise InputError if an option is none of those there are."""
    names = tuple(table)
    if choice not in names:
        message = f"{name} must be one of {', '.join(names)}, got {choice!r}"
        raise InputError(message)


def check_level(alpha: float) -> None:
    """Raise InputError if a level lies outside (0, 1)."""
    if not 0 < alpha < 1:
        message = f"alpha must lie between 0 and 1, got {alpha}"
        raise InputError(message)


def finish(dataset: xr.Dataset, title: str, alpha: float) -> xr.Dataset:
    """Add q-value and ``rejected`` for every axis beyond (y, x) apart, and say what is what."""
    p_value = dataset["p_value"]
    q_value = p_value.copy(data=q_values(p_value.to_numpy()))
    dataset = dataset.assign(q_value=q_value, rejected=rejections(q_value, alpha))
    for name in dataset.data_vars:
        if name in _LABELS:
            dataset[name].attrs.update(long_name=_LABELS[str(name)], units="1")
    dataset["reason"].attrs.update(long_name="why there is no test", units="1", **flag_attributes())
    return dataset.assign_attrs(test=title, false_discovery_rate=alpha)
