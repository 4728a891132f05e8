"""Statistics: what is computed from the samples of each pixel, and its names for an image.

A statistic is declared once, in one file, as two frozen dataclasses. Its result, a `Result` made by
`result`, has a field for each value. `variable` gives a field its label, unit and dims in the
dataset of an image, and says which p-values are corrected for the number of pixels. The statistic
itself, a `Statistic`, has its options as fields, and computes a result in `Statistic.measure`.
`chdstat.summary.runner.run` applies it to an array, a pixel, a histogram, or an image, tile by
tile. Where it declares a `Quantity`, tables of a pixel show it; where it declares a `MapKind`, maps
do.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import (
    TYPE_CHECKING,
    Any,
    ClassVar,
    Generic,
    Literal,
    Self,
    TypeVar,
    dataclass_transform,
)

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Mapped, label_variables
from chdstat._core.display import Shown
from chdstat._core.resampling import q_values, rejections

if TYPE_CHECKING:
    import xarray as xr

RADIANCE = "W sr-1 m-2"
"""Unit of radiance."""

Kind = TypeVar("Kind")
Found = TypeVar("Found", covariant=True)


@dataclass(frozen=True)
class Variable:
    """The form of a result's field in the dataset of an image; see `variable`."""

    label: str
    dims: tuple[str, ...]
    unit: str
    name: str
    pooled: bool
    rejected: str


def variable(
    label: str,
    *dims: str,
    unit: str = "1",
    name: str = "",
    pooled: bool = False,
    rejected: str = "",
) -> Any:
    """Declare a field that becomes a variable of the dataset of an image.

    Parameters
    ----------
    label, unit
        Attributes ``long_name`` and ``units``. Names that end in ``reason`` are `Reason` codes.
    *dims
        Dims after those of the rows.
    name
        Name in the dataset; by default, that of the field after `Statistic.prefix`.
    pooled
        For a p-value: add the q-value over the image, ``q_value`` for ``p_value``.
    rejected
        For a pooled p-value: label of ``rejected``, which is added: 1 where the q-value is at most
        the statistic's `alpha`.
    """
    return field(metadata={"variable": Variable(label, dims, unit, name, pooled, rejected)})


@dataclass_transform(frozen_default=True, field_specifiers=(variable,))
def result(kind: type[Kind]) -> type[Kind]:
    """Make a class a frozen dataclass with variables among its fields, also for type checkers."""
    return dataclass(frozen=True, repr=False)(kind)


class Result(Shown):
    """Result of a statistic for an array: see `result` and `variable`."""

    @classmethod
    def declared(cls, prefix: str = "") -> dict[str, tuple[str, Variable]]:
        """Return the fields that are variables, by their names in a dataset."""
        own: Any = fields(cls)  # type: ignore[arg-type]
        known = {f.name: f.metadata["variable"] for f in own if "variable" in f.metadata}
        return {about.name or f"{prefix}{name}": (name, about) for name, about in known.items()}


@dataclass(frozen=True)
class Quantity:
    """What tables of a pixel say of a result.

    Attributes
    ----------
    title
        What it is called there.
    text
        Returns the text, of a result and the number of a row of samples.
    of_constant
        Whether it means something for samples that are nearly equal.
    brief
        What it is called in the few lines in which a pixel shows itself; "" to leave it out there.
    """

    title: str
    text: Callable[[Any, int], str]
    of_constant: bool = False
    brief: str = ""


@dataclass(frozen=True)
class MapKind:
    """What a map over the image shows of a result, for the luminance of each pixel.

    Attributes
    ----------
    name, title
        In an address, and for readers.
    unit
        Of the colour bar.
    of
        Returns the numbers, of a result; None where they need no computing.
    names
        Of codes, for a map of labels; empty for a map of numbers.
    ordered
        Whether codes have an order, which their colours then show.
    log
        Whether colours follow the logarithm of the numbers.
    ends
        Ends of the colour bar; None for percentiles of what there is.
    diverging
        Whether 0, or 1 if `log`, stands in the middle, between two colours.
    decided
        Name of the variable that `Statistic.finish` decides over the whole image, and that the map
        shows in the end; "" if each pixel tells alone.
    """

    name: str
    title: str
    unit: str = ""
    of: Callable[..., npt.ArrayLike] | None = None
    names: Mapping[int, str] = field(default_factory=dict)
    ordered: bool = False
    log: bool = False
    ends: tuple[float, float] | None = None
    diverging: bool = False
    decided: str = ""


_SHOWN: list[type[Statistic[Any]]] = []


def shown_statistics() -> list[type[Statistic[Any]]]:
    """Return all statistics that tables or maps show, in the order of their modules."""
    return sorted(_SHOWN, key=lambda kind: kind.__module__)


class Statistic(Generic[Found]):
    """A statistic of rows of samples: a frozen dataclass of its options.

    Attributes
    ----------
    result
        Class of its results.
    description
        Text of a progress bar.
    rows
        Rows of an image: each of the channels, or the luminance.
    binned
        Whether it also takes log histograms.
    logarithms
        Whether it leaves out negative samples.
    film
        Whether it needs where samples fell in their pixel.
    prefix
        Prefix of the names of its variables. {} stands for the `subject`, in it, in labels and in
        `description`.
    around
        Names of variables that `finish` decides by the pixels around, or takes away. All others are
        what the pixel has alone.
    quantities
        What tables of a pixel show of its results.
    """

    result: ClassVar[type[Result]]
    description: ClassVar[str]
    rows: ClassVar[Literal["channels", "luminance"]] = "channels"
    binned: ClassVar[bool] = False
    logarithms: ClassVar[bool] = True
    film: ClassVar[bool] = False
    prefix: ClassVar[str] = ""
    around: ClassVar[frozenset[str]] = frozenset()
    quantities: ClassVar[tuple[Quantity, ...]] = ()

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if {"quantities", "maps"} & vars(cls).keys():
            _SHOWN.append(cls)

    @classmethod
    def of_pixel(cls, spp: int) -> Self | None:  # noqa: ARG003 - some need enough samples
        """Return the statistic as tables and maps show it; None with too few samples for it."""
        return cls()

    def maps(self) -> tuple[MapKind, ...]:
        """Return what maps show of its results."""
        return ()

    @property
    def subject(self) -> str:
        """The measured object, if it is an option, such as the name of a family."""
        return ""

    def measure(self, part: Any) -> Found:
        """Return the result for the rows of a positive part; NaN where a reason says why.

        Call it through `chdstat.summary.runner.measured`, also for a statistic of the same rows
        that this one depends on. That measures once, and silences warnings such as divisions by 0.
        """
        raise NotImplementedError

    @property
    def _declared(self) -> dict[str, tuple[str, Variable]]:
        return self.result.declared(self.prefix.format(self.subject))

    def coordinates(self) -> Mapping[str, Sequence[Any] | npt.NDArray[Any] | None]:
        """Return the coordinates of further dims; None for an absent dim."""
        return {}

    def attrs(self) -> Mapping[str, Any]:
        """Return the attributes of the dataset."""
        return {}

    def variables(self, found: Any) -> Mapped:
        """Return a result for the rows of a tile as variables."""
        first = ("channel",) if self.rows == "channels" else ()
        left_out = {dim for dim, names in self.coordinates().items() if names is None}
        return {
            name: (
                (*first, *(dim for dim in about.dims if dim not in left_out)),
                getattr(found, own),
            )
            for name, (own, about) in self._declared.items()
        }

    def finish(self, dataset: xr.Dataset) -> xr.Dataset:
        """Add pooled values over an image, coordinates, and the names and units of variables."""
        labels = {}
        for name, (_, about) in self._declared.items():
            label = about.label.format(self.subject)
            labels[name] = label, about.unit
            if about.pooled and name in dataset:
                of_image, p_value = re.sub(r"(^|_)p_", r"\1q_", name), dataset[name]
                q_value = p_value.copy(data=q_values(p_value.to_numpy()))
                dataset = dataset.assign({of_image: q_value})
                labels[of_image] = f"{label.replace('p-', 'q-')} over the image", "1"
                if about.rejected:
                    rejected = name.replace("p_value", "rejected")
                    alpha: float = vars(self)["alpha"]
                    found = rejections(q_value, alpha).assign_attrs(false_discovery_rate=alpha)
                    dataset = dataset.assign({rejected: found})
                    labels[rejected] = about.rejected.format(self.subject), "1"
        named = {
            dim: names if isinstance(names, np.ndarray) else np.array(names, dtype=object)
            for dim, names in self.coordinates().items()
            if names is not None and dim in dataset.dims
        }
        return label_variables(dataset, labels).assign_coords(named).assign_attrs(self.attrs())
