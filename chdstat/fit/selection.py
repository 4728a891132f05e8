"""Selection: which family describes the samples best, and by how much."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, overload

import numpy as np
import numpy.typing as npt

from chdstat._positive import Floats, PositivePart
from chdstat.errors import InputError
from chdstat.fit.families import Family, get_family
from chdstat.fit.mle import fit_part
from chdstat.fit.results import Fit, fit_variables, label_fit
from chdstat.samples import Mapped, Samples

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Criterion", "Selection", "select", "select_part"]

Criterion = Literal["aic", "bic"]


@dataclass(frozen=True)
class Selection:
    """Families compared on the same samples.

    Attributes
    ----------
    families
        Their names.
    criterion
        'aic' or 'bic'.
    values
        The criterion, shape (..., family); the smaller the better.
    best
        Index of the best family, shape (...); -1 where none could be fitted.
    margin
        Criterion of the runner-up minus that of the best, shape (...); NaN with fewer than two
        fits. Above 10, the evidence is very strong (Kass and Raftery 1995,
        doi:10.1080/01621459.1995.10476572).
    fits
        Every `Fit`, by family.
    """

    families: tuple[str, ...]
    criterion: Criterion
    values: Floats
    best: npt.NDArray[np.int8]
    margin: Floats
    fits: Mapping[str, Fit]

    @property
    def names(self) -> npt.NDArray[np.str_]:
        """Name of the best family, shape (...); empty where none could be fitted."""
        return np.asarray([*self.families, ""])[self.best]


@overload
def select(
    x: Samples,
    families: Sequence[str | Family] = ...,
    criterion: Criterion = ...,
    *,
    progress: bool | None = None,
) -> xr.Dataset: ...
@overload
def select(
    x: npt.ArrayLike,
    families: Sequence[str | Family] = ...,
    criterion: Criterion = ...,
    *,
    null: npt.ArrayLike | None = None,
) -> Selection: ...
def select(
    x: Samples | npt.ArrayLike,
    families: Sequence[str | Family] = ("gamma", "lognormal"),
    criterion: Criterion = "bic",
    *,
    null: npt.ArrayLike | None = None,
    progress: bool | None = None,
) -> Selection | xr.Dataset:
    """Fit several families and say which has the smallest information criterion.

    ``AIC = 2 k - 2 log L`` and ``BIC = k log n - 2 log L``, where k counts the mass at 0 as one
    parameter of every family and all likelihoods are those of linear radiance. The best of poor
    families is still poor: the margin compares the families, not the family with the data.

    Parameters
    ----------
    x, null, progress
        As for `chdstat.fit.fit`.
    families
        What to compare.
    criterion
        'aic' or 'bic'.

    Returns
    -------
    Selection or xarray.Dataset
        `Selection` for an array. For `Samples`, the variables of every fit, and ``best_family``
        and ``margin`` over (y, x, channel).

    Raises
    ------
    InputError
        If a family or the criterion is unknown, or there is no family.

    References
    ----------
    Schwarz, "Estimating the dimension of a model", 1978, doi:10.1214/aos/1176344136.

    Examples
    --------
    >>> import numpy as np
    >>> x = np.random.default_rng(3).lognormal(sigma=1.0, size=500)
    >>> str(select(x).names)
    'lognormal'
    """
    chosen = _check(families, criterion)
    if not isinstance(x, Samples):
        return select_part(PositivePart.of(x, null=null), chosen, criterion)
    dataset = x.map(
        lambda block: _variables(select_part(PositivePart.of_pixels(block), chosen, criterion)),
        description="selecting families",
        progress=progress,
    )
    for family in chosen:
        dataset = label_fit(dataset, family.name)
    return _label(dataset, [family.name for family in chosen], criterion)


def select_part(
    part: PositivePart, families: Sequence[Family], criterion: Criterion = "bic"
) -> Selection:
    """Compare families on samples that are already split."""
    fits = {family.name: fit_part(part, family) for family in families}
    values = np.stack([getattr(result, criterion) for result in fits.values()], axis=-1)
    ranked = np.sort(values, axis=-1)
    with np.errstate(invalid="ignore"):
        margin = ranked[..., 1] - ranked[..., 0] if len(fits) > 1 else ranked[..., 0] * np.nan
    return Selection(
        families=tuple(fits),
        criterion=criterion,
        values=values,
        best=np.where(np.isnan(ranked[..., 0]), -1, _argmin(values)).astype(np.int8),
        margin=margin,
        fits=fits,
    )


def _check(families: Sequence[str | Family], criterion: str) -> list[Family]:
    if criterion not in ("aic", "bic"):
        message = f"criterion must be 'aic' or 'bic', got {criterion!r}"
        raise InputError(message)
    if isinstance(families, str) or not families:
        message = f"families must be a sequence of one or more families, got {families!r}"
        raise InputError(message)
    return [get_family(family) for family in families]


def _argmin(values: Floats) -> npt.NDArray[np.intp]:
    return np.asarray(np.where(np.isnan(values), np.inf, values).argmin(axis=-1))


def _variables(selection: Selection) -> Mapped:
    of_fits: dict[str, tuple[tuple[str, ...], npt.NDArray[np.generic]]] = {}
    for result in selection.fits.values():
        of_fits.update(fit_variables(result))
    return {
        **of_fits,
        "best_family": (("channel",), selection.best),
        "margin": (("channel",), selection.margin),
    }


def _label(dataset: xr.Dataset, names: Sequence[str], criterion: str) -> xr.Dataset:
    dataset["best_family"].attrs.update(
        long_name=f"family with the smallest {criterion.upper()}",
        units="1",
        flag_values=[-1, *range(len(names))],
        flag_meanings=" ".join(["none", *names]),
    )
    dataset["margin"].attrs.update(
        long_name=f"{criterion.upper()} of the runner-up minus that of the best family", units="1"
    )
    return dataset
