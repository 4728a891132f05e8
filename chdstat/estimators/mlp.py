"""The learned estimator: a small network, trained on one scene, that replaces the sample mean.

>>> from chdstat.estimators import MLP
>>> model = MLP.preset("elek2019")          # then model.train(samples, seed=0)
>>> model.inputs
32

The samples of one channel go in as they were drawn, the radiance of that channel comes out.
"""

from __future__ import annotations

from dataclasses import asdict
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import all_good, as_samples, is_bad, warn_left_out
from chdstat.errors import InputError, StoreError
from chdstat.estimators.model_files import read_model, write_model
from chdstat.estimators.order import mean_of_good
from chdstat.estimators.registry import LearnedEstimator, register_learned
from chdstat.estimators.training import PRESETS, History, Preset, Trained, train
from chdstat.samples import Samples

__all__ = ["MLP"]

Array = npt.NDArray[Any]


class MLP:
    """A network from samples of one channel to their pixel's radiance.

    Make one with `MLP.preset` or `MLP.load`.

    References
    ----------
    O. Elek, M. M. Thomas, A. Forbes, "Learning Patterns in Sample Distributions for Monte Carlo
    Variance Reduction", 2019.
    """

    def __init__(self, config: Preset, *, trained: Trained | None = None) -> None:
        self.config = config
        self._trained = trained

    @classmethod
    def preset(cls, name: str) -> Self:
        """Return an untrained network as published.

        Raises
        ------
        InputError
            If there is no preset of that name.
        """
        if name not in PRESETS:
            message = f"no preset is called {name!r}; there are {', '.join(PRESETS)}"
            raise InputError(message)
        return cls(PRESETS[name])

    @property
    def name(self) -> str:
        """Name of its preset."""
        return self.config.name

    @property
    def inputs(self) -> int:
        """Samples per estimate."""
        return self.config.inputs

    @property
    def train_pixels(self) -> npt.NDArray[np.int64]:
        """Pixels that it was trained on, rows (y, x)."""
        return self._state.train_pixels

    @property
    def train_shape(self) -> tuple[int, int]:
        """Height and width of the image that it was trained on."""
        return self._state.train_shape

    @property
    def history(self) -> History:
        """How the training went."""
        return History(*self._state.history.T)

    @property
    def provenance(self) -> dict[str, Any]:
        """Where it comes from: scene, seed, pixels, batches, iterations, chdstat version."""
        return dict(self._state.provenance)

    def __repr__(self) -> str:
        state = "untrained" if self._trained is None else f"scene {self.provenance['scene']!r}"
        return f"<MLP {self.name!r}, {self.inputs} samples, {state}>"

    def train(
        self,
        samples: Samples,
        *,
        seed: int = 0,
        iterations: int | None = None,
        pixels: npt.ArrayLike | None = None,
        progress: bool | None = None,
    ) -> Self:
        """Train on a part of an image's pixels, against their leave-batch-out references.

        Parameters
        ----------
        samples
            The image; batches with a bad sample are left out and counted.
        seed
            Draws the pixels, the validation part, the first weights and the minibatches.
        iterations
            Other than the preset says.
        pixels
            Train on these, rows (y, x), and draw none.
        progress
            Show a progress bar; None shows it on a terminal.

        Returns
        -------
        MLP
            Itself, trained.

        Raises
        ------
        InputError
            If there are too few samples, or too few pixels with good ones.
        """
        self._trained = train(
            self.config, samples, seed=seed, iterations=iterations, pixels=pixels, progress=progress
        )
        return self

    def predict(self, x: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """Estimate radiance.

        Parameters
        ----------
        x
            Samples of one channel in the order drawn, shape (..., inputs). A bad sample is replaced
            by the mean of the good ones beside it.

        Returns
        -------
        ndarray
            Estimates, shape (...), in the unit of `x`; NaN where no sample is good. Where the
            network overflows, the mean of the good samples.

        Raises
        ------
        InputError
            If the last axis does not hold exactly `inputs` samples, or nothing was trained yet.
        """
        samples = as_samples(x)
        warn_left_out(samples, within="chdstat.estimators")
        if samples.shape[-1] != self.inputs:
            message = (
                f"{self.name} takes exactly {self.inputs} samples on the last axis, "
                f"got shape {samples.shape}"
            )
            raise InputError(message)
        return self._predict_rows(samples.reshape(-1, self.inputs)).reshape(samples.shape[:-1])

    def save(self, path: str | Path) -> None:
        """Write the trained network and its provenance to a safetensors file.

        Raises
        ------
        InputError
            If nothing was trained yet.
        StoreError
            If the file cannot be written.
        """
        state = self._state
        about = {
            "kind": "mlp",
            "preset": asdict(self.config),
            "scale": state.scale,
            "train_shape": state.train_shape,
            "provenance": state.provenance,
        }
        arrays: dict[str, Array] = {f"weight{i}": w for i, w in enumerate(state.weights)}
        arrays |= {"history": state.history, "train_pixels": state.train_pixels}
        write_model(Path(path), arrays, about)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a trained network; this runs no code from the file.

        Raises
        ------
        StoreError
            If there is no such file, it is damaged, or it holds something else.
        """
        arrays, about = read_model(Path(path))
        try:
            preset = dict(about["preset"])
            config = Preset(**{**preset, "hidden": tuple(preset["hidden"])})
            count = 2 * (len(config.sizes) - 1)
            trained = Trained(
                [arrays[f"weight{i}"] for i in range(count)],
                arrays["history"],
                arrays["train_pixels"],
                (int(about["train_shape"][0]), int(about["train_shape"][1])),
                float(about["scale"]),
                dict(about["provenance"]),
            )
        except (KeyError, IndexError, TypeError, ValueError) as error:
            message = f"{path} does not hold a whole network ({error!r}); train or copy it again"
            raise StoreError(message) from error
        _check_weights(trained.weights, config, path)
        return cls(config, trained=trained)

    @property
    def _state(self) -> Trained:
        if self._trained is None:
            message = f"{self.name} is not trained yet; call train(samples) or MLP.load(path)"
            raise InputError(message)
        return self._trained

    def _predict_rows(self, samples: Array) -> npt.NDArray[np.float32]:
        from chdstat.estimators.network import evaluate

        if not all_good(samples):
            samples = np.where(is_bad(samples), mean_of_good(samples)[..., np.newaxis], samples)
        rows = samples.astype(np.float32, copy=False)
        estimate = evaluate(_absorb_scale(self._state), rows)
        lost = ~np.isfinite(estimate)
        estimate[lost] = rows[lost].mean(axis=-1, dtype=np.float64)
        return estimate


def _absorb_scale(state: Trained) -> list[npt.NDArray[np.float32]]:
    """Return weights that work on radiance itself; a network of a black scene answers black."""
    first, *between, matrix, bias = state.weights
    scale = np.float32(state.scale)
    return [first / (scale or np.float32(1)), *between, matrix * scale, bias * scale]


def _check_weights(weights: list[npt.NDArray[np.float32]], preset: Preset, path: object) -> None:
    sizes = preset.sizes
    shapes = [s for pair in pairwise(sizes) for s in (pair, pair[1:])]
    if [w.shape for w in weights] != shapes or not all(np.isfinite(w).all() for w in weights):
        message = f"{path} does not hold finite weights of layers {sizes}; train or copy it again"
        raise StoreError(message)


def _trained(preset: Preset, samples: Samples, **options: Any) -> MLP:
    return MLP(preset).train(samples, **options)


_ELEK = PRESETS["elek2019"]
register_learned(
    LearnedEstimator(
        _ELEK.name,
        partial(_trained, _ELEK),
        _ELEK.source,
        inputs=_ELEK.inputs,
        pixels=_ELEK.pixels,
        label="Elek et al. 2019",
        place=8,
        default=True,
    )
)
