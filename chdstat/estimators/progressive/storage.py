"""Storage: a trained progressive estimator as a safetensors file, which runs no code when read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat.errors import StoreError
from chdstat.estimators._modelfile import read_model, write_model
from chdstat.estimators.progressive.inputs import InputConfig
from chdstat.estimators.progressive.marks import Marks
from chdstat.estimators.progressive.results import Learned, Trust
from chdstat.estimators.progressive.shapes import Shape
from chdstat.estimators.progressive.spread import Spread

__all__ = ["read_learned", "write_learned"]

_KIND = "progressive"

Arrays = Mapping[str, npt.NDArray[Any]]


def write_learned(path: str | Path, learned: Learned, inputs: Sequence[str]) -> None:
    """Write what was learned, and from which inputs.

    Raises
    ------
    StoreError
        If the file cannot be written.
    """
    about = {
        "kind": _KIND,
        "shape": learned.network.shape.to_dict(),
        "inputs": list(inputs),
        "unit": learned.unit,
        "train_shape": learned.train_shape,
        "provenance": learned.provenance,
    }
    arrays: dict[str, npt.NDArray[Any]] = {
        f"network.{name}": w for name, w in learned.network.to_arrays().items()
    }
    arrays |= {f"spread.{name}": a for name, a in vars(learned.spread).items()}
    arrays |= {f"trust.{name}": a for name, a in vars(learned.trust).items()}
    arrays |= {f"marks.{name}": a for name, a in vars(learned.marks).items()}
    arrays |= {"history": learned.history, "train_pixels": learned.train_pixels}
    write_model(Path(path), arrays, about)


def read_learned(path: str | Path) -> tuple[Learned, InputConfig]:
    """Read what was learned, and from which inputs.

    Raises
    ------
    StoreError
        If there is no such file, it is damaged, or it holds something else.
    """
    arrays, about = read_model(Path(path))
    if about.get("kind") != _KIND:
        message = f"{path} holds a model of kind {about.get('kind')!r}, not {_KIND!r}"
        raise StoreError(message)
    if "trust.shares" not in arrays:
        message = (
            f"{path} was trained by an earlier version, which did not measure how far it pays to "
            "follow the network; train it again"
        )
        raise StoreError(message)
    try:
        return _learned(arrays, about), InputConfig.of(about["inputs"])
    except (AttributeError, KeyError, IndexError, TypeError, ValueError) as error:
        message = f"{path} does not hold a whole network ({error!r}); train or copy it again"
        raise StoreError(message) from error


def _learned(arrays: Arrays, about: Mapping[str, Any]) -> Learned:
    from chdstat.estimators.progressive.network import Network

    network = Network(Shape(**about["shape"]))
    network.load_arrays(_below("network.", arrays))
    provenance = dict(about["provenance"])
    used = sum(int(scene["pixels_used"]) for scene in provenance["scenes"])
    if arrays["train_pixels"].shape != (used, 2):
        message = f"its scenes have {used} pixels, got {arrays['train_pixels'].shape}"
        raise ValueError(message)
    return Learned(
        network=network.eval(),
        spread=Spread(**_below("spread.", arrays)),
        unit=float(about["unit"]),
        history=arrays["history"],
        train_pixels=arrays["train_pixels"].astype(np.int64, copy=False),
        train_shape=(int(about["train_shape"][0]), int(about["train_shape"][1])),
        provenance=provenance,
        trust=Trust(**_below("trust.", arrays)),
        marks=Marks(**_below("marks.", arrays)),
    )


def _below(prefix: str, arrays: Arrays) -> dict[str, npt.NDArray[Any]]:
    return {k.removeprefix(prefix): a for k, a in arrays.items() if k.startswith(prefix)}
