"""Labels: a name for every pixel of a picture, from whatever says so."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from chdstat._reasons import flag_attributes
from chdstat.errors import InputError
from chdstat.patterns import Label, classify
from chdstat.samples import Samples

__all__ = ["Given", "Labels", "labels_of"]

Given = npt.ArrayLike | Literal["classify"] | None
"""Codes (y, x), a labelled map or dataset of `chdstat.classify`, or the order to classify."""


@dataclass(frozen=True)
class Labels:
    """Codes of pixels and what they mean.

    Attributes
    ----------
    codes
        Shape (y, x).
    names
        By code.
    """

    codes: npt.NDArray[np.int64]
    names: dict[int, str]


def labels_of(given: Any, samples: Samples, *, progress: bool | None = None) -> Labels | None:
    """Return the labels of a picture; None stays None.

    Parameters
    ----------
    given
        Codes of `Label`, shape (y, x); a labelled map of other codes with the attributes
        ``flag_values`` and ``flag_meanings``; a dataset with such a map as ``label``; or
        "classify".

    Raises
    ------
    InputError
        If it is neither, has another shape, or holds codes without a name.
    """
    if given is None:
        return None
    if isinstance(given, str):
        if given != "classify":
            message = f"labels must be a map of labels or 'classify', got {given!r}"
            raise InputError(message)
        given = classify(samples, progress=progress)
    if hasattr(given, "data_vars"):
        given = _label_of(given)
    codes = np.asarray(given)
    if codes.shape != samples.shape[:2] or codes.dtype.kind not in "iu":
        message = (
            f"labels must be integers of shape {samples.shape[:2]}, one for each pixel; "
            f"got {codes.dtype} of shape {codes.shape}"
        )
        raise InputError(message)
    return _checked(codes.astype(np.int64), _names(getattr(given, "attrs", {})))


def _label_of(dataset: Any) -> Any:
    if "label" not in dataset:
        message = f"a dataset of labels has a variable 'label'; this one has {list(dataset)}"
        raise InputError(message)
    return dataset["label"]


def _names(attrs: dict[str, Any]) -> dict[int, str]:
    flags = attrs if "flag_meanings" in attrs else flag_attributes(Label)
    values = np.atleast_1d(flags["flag_values"]).tolist()
    return dict(zip(values, flags["flag_meanings"].split(), strict=True))


def _checked(codes: npt.NDArray[np.int64], names: dict[int, str]) -> Labels:
    unknown = set(np.unique(codes).tolist()) - set(names)
    if unknown:
        message = f"labels must be among {names}, got {sorted(unknown)} too"
        raise InputError(message)
    return Labels(codes, names)
