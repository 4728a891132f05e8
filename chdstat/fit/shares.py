"""Shares: how many pixels of an image each family describes best."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from chdstat._multiplicity import wilson
from chdstat.errors import InputError

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["family_shares"]


def family_shares(dataset: xr.Dataset, *, variable: str = "best_family") -> xr.Dataset:
    """Return the share of pixels that each family describes best, with Wilson's interval.

    The interval takes the pixels for independent; neighbours are not quite, so it is a little too
    short.

    Parameters
    ----------
    dataset
        Of `select` for an image.
    variable
        'best_family' or 'held_out_best_family'.

    Returns
    -------
    xarray.Dataset
        ``family_share`` over (channel, family), among the pixels with any family, its
        ``family_share_interval`` over (channel, family, bound), and ``n_pixels`` over (channel),
        how many these are.

    Raises
    ------
    InputError
        If the dataset has no such variable.

    References
    ----------
    Wilson, "Probable inference, the law of succession, and statistical inference", 1927,
    doi:10.1080/01621459.1927.10502953.
    """
    import xarray as xr

    if variable not in dataset:
        message = f"expected the dataset of chdstat.fit.select with {variable}, got one without"
        raise InputError(message)
    best = dataset[variable]
    names = str(best.attrs["flag_meanings"]).split()[1:]
    counts = np.stack(
        [(best == index).sum(("y", "x")).to_numpy() for index in range(len(names))], axis=-1
    )
    total = counts.sum(axis=-1, keepdims=True)
    shares = xr.Dataset(
        {
            "family_share": (
                ("channel", "family"),
                counts / np.where(total > 0, total, np.nan),
                {"long_name": "share of pixels that a family describes best", "units": "1"},
            ),
            "family_share_interval": (
                ("channel", "family", "bound"),
                wilson(counts, np.broadcast_to(total, counts.shape)),
                {"long_name": "Wilson interval of the share of pixels", "units": "1"},
            ),
            "n_pixels": (
                ("channel",),
                total[:, 0],
                {"long_name": "pixels with any family", "units": "1"},
            ),
        },
        coords={
            "family": np.array(names, dtype=object),
            "bound": np.array(["low", "high"], dtype=object),
        },
    )
    return shares.assign_coords(channel=best["channel"]) if "channel" in best.coords else shares
