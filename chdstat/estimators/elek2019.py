"""The learned estimator: a small network, trained on one scene, that replaces the sample mean.

>>> from chdstat.estimators import MLP
>>> model = MLP.preset("elek2019")          # then model.train(samples, seed=0)
>>> model.inputs
32

The samples of one channel go in as they were drawn, the radiance of that channel comes out.
`PRESETS` are published networks, each a frozen list of choices. The paper asks for a certainty with
which to mix the network and the mean, its fallback: `MLP.estimate` learns one from the validation
rows, beside the network as published.

Weights are NumPy arrays, a matrix (in, out) and a bias (out,) per layer. Training runs on one CPU
thread: these networks are so small that starting a kernel costs more than running it, and one
thread makes the result repeatable.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Self, cast

import numpy as np
import numpy.typing as npt

from chdstat import __version__
from chdstat._core.arrays import (
    Array,
    Floats,
    Indices,
    Reals,
    all_good,
    as_pixels,
    as_samples,
    generator,
    is_bad,
    spans,
    warn_left_out,
    whole,
)
from chdstat._core.progress import track
from chdstat.errors import InputError, check_option, check_probability
from chdstat.estimators import training
from chdstat.estimators.held_out import (
    PUBLISHED_PIXELS,
    check_spp,
    checked_pixels,
    draw_pixels,
    training_batches,
)
from chdstat.estimators.registry import Estimates, LearnedEstimator, mean_of_good, register_learned
from chdstat.samples import Samples, opened

if TYPE_CHECKING:
    import torch

Weights = list[npt.NDArray[np.float32]]

PAPER = "elek2019"
"""Name of the network of the paper."""
RECORD_EVERY = 100
"""Iterations between two rows of the history."""
_ROWS_AT_ONCE = 65_536
_OCTAVES = np.arange(-5, 5)
"""Classes of brightness: octaves of the mean of an estimate's samples, in units of the training
mean; darker and brighter means belong to the first and the last."""
_FEW, _BORROWED = 128, 32
"""Rows below which a class takes the residuals of all, and rows that all count for beside its own
in the certainty of a class."""
_LEVELS = np.linspace(0, 1, 401)
"""Probabilities of the quantiles of residuals."""


@dataclass(frozen=True, kw_only=True)
class Preset:
    """How a network is built and trained; "chosen here" marks what the publication leaves open.

    Attributes
    ----------
    name, source
        Name of the preset, and where it was published.
    inputs
        Number of input samples, all of one channel, in the order drawn.
    hidden
        Neurons of each dense layer (ReLU, chosen here); one linear output follows.
    pixels
        Pixels drawn for training: 6400. With `spare`, at least a quarter of the image must remain
        for judging (93 x 93 pixels or more); else half of the image trains.
    validation_share
        Share of the batches that are used for validation only.
    iterations
        Number of minibatches.
    learning_rate
        Constant step size.
    minibatch
        Rows per iteration, drawn with replacement; chosen here.
    optimiser
        Adam with its usual moments (0.9, 0.999); chosen here.
    initialisation
        He-uniform matrices, zero biases; chosen here.
    scaling
        Radiance is divided by one constant, the mean training reference, and multiplied by it
        afterwards, so that training does not depend on the unit of radiance; chosen here.
    leave_out
        Whether the target of a batch is the mean of the other samples of its pixel; the paper's is
        that of all of them.
    spare
        Whether to leave pixels for judging; the paper does not say.
    validation_rows
        At most so many validation rows are evaluated for a row of the history; None for all, as the
        paper has it.
    patience
        Stop after so many iterations without a smaller validation loss, and take the weights that
        had the smallest; None trains to the end, as the paper does.
    """

    name: str
    source: str
    inputs: int = 32
    hidden: tuple[int, ...] = (32, 32, 32)
    pixels: int = PUBLISHED_PIXELS
    validation_share: float = 0.1
    iterations: int = 30_000
    learning_rate: float = 0.005
    minibatch: int = 256
    optimiser: str = "adam"
    initialisation: str = "he-uniform"
    scaling: str = "training mean"
    leave_out: bool = True
    spare: bool = True
    validation_rows: int | None = 16_384
    patience: int | None = None

    @property
    def sizes(self) -> tuple[int, ...]:
        """Neurons of every layer, input and output among them."""
        return (self.inputs, *self.hidden, 1)


PRESETS = {PAPER: Preset(name=PAPER, source="Elek, Thomas and Forbes 2019")}
"""Published networks by name."""


@dataclass(frozen=True)
class Deviation:
    """A choice in which a network here may differ from the paper's, and how to switch it.

    Attributes
    ----------
    name
        Name of the switch.
    paper
        What the paper does, or leaves open.
    other
        What is done otherwise, and why.
    published, changed
        Fields of `Preset` that make it so; none where the choice is not about training.
    ours
        Whether the library's own network takes the other way.
    """

    name: str
    paper: str
    other: str
    published: Mapping[str, Any] = field(default_factory=dict)
    changed: Mapping[str, Any] = field(default_factory=dict)
    ours: bool = True


CHOICES = {
    choice.name: choice
    for choice in (
        Deviation(
            "targets",
            "The target of a batch is the mean of all samples of its pixel, the batch among them.",
            "The mean of the other samples: else the network learns to trust noise that its target "
            "shares with it.",
            {"leave_out": False},
            {"leave_out": True},
        ),
        Deviation(
            "pixels",
            "6400 pixels train, however many remain; all of a smaller image.",
            "At least a quarter of the image does not train, or half of one below 93 × 93 pixels: "
            "somebody must judge.",
            {"spare": False},
            {"spare": True},
        ),
        Deviation(
            "validation",
            "The validation loss is that of a tenth of all batches.",
            "That of at most 16,384 rows of them: the same curve in less time.",
            {"validation_rows": None},
            {"validation_rows": PRESETS[PAPER].validation_rows},
        ),
        Deviation(
            "judging",
            "All pixels judge, those that trained among them, by the mean of all their samples.",
            "Pixels that did not train, by samples that no estimate has seen, without the noise "
            "of these: as in all comparisons here.",
        ),
        Deviation(
            "patience",
            "All 30,000 iterations are done, and the last weights taken.",
            "2000 iterations after the smallest validation loss it ends, and takes the weights of "
            "that: reports on a scene do so, for more takes long and gains little.",
            {"patience": None},
            {"patience": 2000},
            ours=False,
        ),
        Deviation(
            "channels",
            "“A separate network for each tested scene”: whether R, G and B share it, the paper "
            "leaves open. They do here.",
            "A network for each channel: the other reading.",
            ours=False,
        ),
    )
}
"""What the paper does and the library, or a part of it, does otherwise, by name of the switch."""


def as_published(*changed: str) -> Preset:
    """Return the paper's network as published, but for some of `CHOICES`.

    Raises
    ------
    InputError
        If there is no choice of that name.

    Examples
    --------
    >>> as_published().leave_out, as_published("targets").leave_out
    (False, True)
    """
    settings: dict[str, Any] = {}
    for choice in CHOICES.values():
        settings |= choice.published
    for name in changed:
        check_option("choice", name, CHOICES)
        settings |= CHOICES[name].changed
    return replace(PRESETS[PAPER], **settings)


@dataclass(frozen=True, kw_only=True)
class _TrainedMLP(training.Trained):
    """A trained network.

    Attributes
    ----------
    weights
        A matrix (in, out) and a bias (out,) per layer.
    scale
        Mean training reference; the network works in units of it.
    certainty, residuals
        By class of brightness: weight of the network beside the mean, shape (octave,), and
        quantiles of what it is wrong by, in units of the octave, shape (octave, probability).
    """

    weights: Weights
    scale: float
    certainty: Floats
    residuals: Reals


class MLP(training.TrainedModel[_TrainedMLP]):
    """A network from samples of one channel to their pixel's radiance.

    Make one with `MLP.preset` or `MLP.load`.

    References
    ----------
    O. Elek, M. M. Thomas, A. Forbes, "Learning Patterns in Sample Distributions for Monte Carlo
    Variance Reduction", 2019.
    """

    kind = "mlp"
    inputs: int

    def __init__(self, config: Preset) -> None:
        self.config = config
        self.name, self.inputs = config.name, config.inputs
        self._trained = None

    @classmethod
    def preset(cls, name: str) -> Self:
        """Return an untrained network as published.

        Raises
        ------
        InputError
            If there is no preset of that name.
        """
        check_option("preset", name, PRESETS)
        return cls(PRESETS[name])

    def __repr__(self) -> str:
        state = "untrained" if self._trained is None else f"scene {self.provenance['scene']!r}"
        return f"<MLP {self.name!r}, {self.inputs} samples, {state}>"

    def effort(self) -> dict[str, Any]:
        """Return iterations, patience and pixels of its training, and whether these are few."""
        used = len(self.train_pixels)
        return {
            "iterations": int(self.history.iteration[-1]),
            "patience": int(self.provenance.get("patience") or 0),
            "train_pixels": used,
            "fewer_pixels": used < self.config.pixels,
        }

    def deviations(self) -> list[str]:
        """Return how its training differs from the published one, as sentences."""
        effort, published, there = self.effort(), self.config, []
        if (done := effort["iterations"]) < published.iterations:
            there.append(f"{done} minibatches train its network in place of {published.iterations}")
        if effort["fewer_pixels"]:
            used = effort["train_pixels"]
            there.append(f"{used} pixels train it in place of {published.pixels}")
        return there

    def train(
        self,
        samples: Samples,
        *,
        seed: int = 0,
        iterations: int | None = None,
        patience: int | None = None,
        pixels: npt.ArrayLike | None = None,
        progress: bool = True,
    ) -> Self:
        """Train on a part of an image's pixels, against their leave-batch-out references.

        Parameters
        ----------
        samples
            The image; batches with a bad sample are left out and counted.
        seed
            Draws the pixels, the validation part, the first weights and the minibatches.
        iterations
            Minibatches; None takes as many as the preset says.
        patience
            Stop after so many iterations without a smaller validation loss, and take the weights
            that had the smallest; None takes what the preset says, and so trains to the end.
        pixels
            Train on these, rows (y, x), and draw none.
        progress
            Show progress: a bar in a terminal or notebook, elsewhere a line every ten seconds.

        Returns
        -------
        MLP
            Itself, trained.

        Raises
        ------
        InputError
            If there are too few samples, or too few pixels with good ones.
        """
        config, shape = self.config, samples.shape[:2]
        wanted = config.iterations if iterations is None else iterations
        wanted = whole("iterations", wanted, least=1)
        patience = config.patience if patience is None else patience
        check_spp(samples, config.inputs)
        if pixels is None:
            chosen = draw_pixels(shape, config.pixels, seed=seed, spare=config.spare)
        else:
            chosen = checked_pixels(pixels, shape)
        batches, references = training_batches(
            samples, chosen, config.inputs, leave_out=config.leave_out
        )
        if len(batches) < 2:
            message = (
                f"training needs at least 2 batches without a bad sample, got {len(batches)} from "
                f"{len(chosen)} pixels with {samples.fewest} spp; give a larger image or more "
                "samples"
            )
            raise InputError(message)
        scale = float(references.mean())
        # In units of the scene's mean, in place, for they are large. Black stays black.
        batches /= np.float32(scale or 1.0)
        references /= scale or 1.0
        weights, history, held_out = _fit(
            config,
            batches,
            references.astype(np.float32),
            iterations=wanted,
            patience=patience,
            rng=generator(seed).spawn(1)[0],
            progress=progress,
        )
        history[:, 1:] *= scale**2
        x, target = batches.reshape(-1, config.inputs)[held_out], references.reshape(-1)[held_out]
        mean = x.mean(axis=1, dtype=np.float64)
        certainty, residuals = _validated(mean, evaluate(weights, x), target)
        provenance = {
            "scene": samples.name,
            "samples": samples.attrs,
            "samples_shape": list(samples.shape),
            "seed": seed,
            "pixels_wanted": config.pixels if pixels is None else len(chosen),
            "pixels_used": len(chosen),
            "batches_used": len(batches),
            "batches_excluded": len(chosen) * (samples.fewest // config.inputs) - len(batches),
            "iterations": int(history[-1, 0]) if len(history) else 0,
            **({} if patience is None else {"patience": patience}),
            "chdstat": __version__,
        }
        self._trained = _TrainedMLP(
            weights=weights,
            scale=scale,
            certainty=certainty,
            residuals=residuals,
            history=history,
            train_pixels=chosen,
            train_shape=shape,
            provenance=provenance,
        )
        return self

    def estimate(self, x: Samples | npt.ArrayLike, *, level: float = 0.9) -> Estimates:
        r"""Estimate radiance between the mean and the network, with certainty and interval.

        The estimate is :math:`m + c\, (g - m)`, with the mean m of a channel's samples and what
        the network makes of them, g. The certainty

        .. math:: c = \sum (t - m)(g - m) / \sum (g - m)^2

        has the least squared error over the validation rows with references t, and is clipped to
        [0, 1]. Each octave of m has its own. The ends of the interval are quantiles of the
        residuals of the same rows (split conformal prediction). Pixels of the training scene are
        covered with the stated probability on average; other scenes may not be.

        Parameters
        ----------
        x
            Samples, shape (..., channel, inputs), also as `Samples` or the path of a store.
        level
            Probability of the interval.

        Returns
        -------
        Estimates
            Radiance and interval of shape (..., channel); the certainty of a pixel is the mean over
            its channels. A model from an earlier version, which was saved without certainty, is
            followed entirely, and its interval is NaN.

        Raises
        ------
        InputError
            As for `predict`; or if `x` has no channels, or `level` is not between 0 and 1.

        References
        ----------
        J. Lei, M. G'Sell, A. Rinaldo, R. J. Tibshirani and L. Wasserman, "Distribution-free
        predictive inference for regression", Journal of the American Statistical Association
        113(523), 2018, doi:10.1080/01621459.2017.1307116.
        """
        check_probability(level=level)
        samples, state = as_pixels(cast("npt.ArrayLike", opened(x))), self.state
        network, mean = self.predict(samples).astype(np.float64), mean_of_good(samples)
        octave, unit = _octave_of(mean / (state.scale or 1))
        tails, certainty = (0.5 - level / 2, 0.5 + level / 2), state.certainty[octave]
        quantiles = np.array([np.interp(tails, _LEVELS, one) for one in state.residuals])
        with np.errstate(over="ignore", invalid="ignore"):
            radiance = mean + certainty * (network - mean)
            low, high = radiance + quantiles.T[:, octave] * unit * state.scale
            if not (samples < 0).any():
                low = np.minimum(np.maximum(low, 0), radiance)
            parts = radiance, certainty.mean(axis=-1), low, high
            found: list[Any] = [part.astype(np.float32) for part in parts]
        found.append(level if np.isfinite(quantiles).all() else np.nan)
        return Estimates(*found)

    def predict(self, x: Samples | npt.ArrayLike) -> npt.NDArray[np.float32]:
        """Estimate radiance by the network alone, as published.

        Parameters
        ----------
        x
            Samples of one channel in the order drawn, shape (..., inputs), also as `Samples` or the
            path of a store. A bad sample is replaced by the mean of the good ones beside it.

        Returns
        -------
        ndarray
            Estimates, shape (...), in the unit of `x`; NaN where no sample is good, and the mean of
            the good samples where the network overflows.

        Raises
        ------
        InputError
            If the last axis does not hold exactly `inputs` samples, these are averages or depend on
            each other, or the network is not trained.
        """
        samples = as_samples(cast("npt.ArrayLike", opened(x)))
        warn_left_out(samples, within="chdstat.estimators")
        if samples.shape[-1] != self.inputs:
            message = (
                f"{self.name} takes exactly {self.inputs} samples on the last axis, got shape "
                f"{samples.shape}; take as many, as by spp={self.inputs}"
            )
            raise InputError(message)
        rows = samples.reshape(-1, self.inputs)
        if not all_good(rows):
            rows = np.where(is_bad(rows), mean_of_good(rows)[..., np.newaxis], rows)
        rows = rows.astype(np.float32, copy=False)
        # The network works on linear radiance. Trained on a black scene, it estimates black.
        first, *between, matrix, bias = self.state.weights
        scale = np.float32(self.state.scale)
        with np.errstate(over="ignore"):
            weights = [first / (scale or np.float32(1)), *between, matrix * scale, bias * scale]
        estimate = evaluate(weights, rows)
        lost = ~np.isfinite(estimate)
        estimate[lost] = rows[lost].mean(axis=-1, dtype=np.float64)
        return estimate.reshape(samples.shape[:-1])

    def _to_file(self, state: _TrainedMLP) -> tuple[dict[str, Array], dict[str, Any]]:
        arrays: dict[str, Array] = {f"weight{i}": w for i, w in enumerate(state.weights)}
        arrays |= {"certainty": state.certainty, "residuals": state.residuals}
        return arrays, {"preset": asdict(self.config), "scale": state.scale}

    @classmethod
    def _from_file(
        cls, arrays: dict[str, Array], about: Mapping[str, Any], common: dict[str, Any]
    ) -> Self:
        preset = dict(about["preset"])
        model = cls(Preset(**{**preset, "hidden": tuple(preset["hidden"])}))
        sizes = model.config.sizes
        weights = [arrays[f"weight{i}"] for i in range(2 * (len(sizes) - 1))]
        shapes = [s for pair in pairwise(sizes) for s in (pair, pair[1:])]
        if [w.shape for w in weights] != shapes or not all(np.isfinite(w).all() for w in weights):
            message = f"finite weights of layers {sizes} are wanted"
            raise ValueError(message)
        model._trained = _TrainedMLP(
            weights=weights,
            scale=float(about["scale"]),
            certainty=arrays.get("certainty", np.ones(len(_OCTAVES))),
            residuals=arrays.get("residuals", np.full((len(_OCTAVES), _LEVELS.size), np.nan)),
            **common,
        )
        return model


_ELEK = PRESETS[PAPER]


def _train(samples: Samples, **options: Any) -> MLP:
    return MLP(_ELEK).train(samples, **options)


register_learned(
    LearnedEstimator(
        _ELEK.name,
        _train,
        _ELEK.source,
        inputs=_ELEK.inputs,
        pixels=_ELEK.pixels,
        about="Network of the paper: 32 samples of a channel in, its radiance out.",
        label="Elek et al. 2019",
        place=8,
    )
)


def initial_weights(sizes: Sequence[int], rng: np.random.Generator) -> Weights:
    """Draw He-uniform matrices and zero biases for layers of the given sizes (He et al. 2015)."""
    weights: Weights = []
    for fan_in, fan_out in pairwise(sizes):
        limit = np.sqrt(6 / fan_in)
        weights.append(rng.uniform(-limit, limit, (fan_in, fan_out)).astype(np.float32))
        weights.append(np.zeros(fan_out, np.float32))
    return weights


def evaluate(weights: Weights, x: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Run a network over rows (row, input), on the GPU where torch finds one; result (row,)."""
    import torch

    device = "cuda" if torch.cuda.is_available() else "cpu"
    parameters = [torch.tensor(w, device=device) for w in weights]
    result = np.empty(len(x), np.float32)
    with torch.inference_mode():
        for part in spans(len(x), _ROWS_AT_ONCE):
            # Torch does not support negative strides, as a reversed view has.
            rows = torch.tensor(np.ascontiguousarray(x[part]), device=device)
            result[part] = _forward(parameters, rows).cpu().numpy()
    return result


def _forward(parameters: Sequence[torch.Tensor], x: torch.Tensor) -> torch.Tensor:
    import torch

    *hidden, matrix, bias = parameters
    for layer in range(0, len(hidden), 2):
        x = torch.relu(torch.addmm(hidden[layer + 1], x, hidden[layer]))
    return torch.addmm(bias, x, matrix)[:, 0]


def _fit(
    preset: Preset,
    batches: npt.NDArray[np.float32],
    references: npt.NDArray[np.float32],
    *,
    iterations: int,
    patience: int | None,
    rng: np.random.Generator,
    progress: bool,
) -> tuple[Weights, npt.NDArray[np.float64], Indices]:
    """Minimise the squared error on batches (batch, channel, sample) and references.

    Returns
    -------
    weights : list of ndarray
        Weights at the last record at which all were finite; with a patience, those at the record
        with the smallest validation loss.
    history : ndarray
        Rows of `History`.
    validation : ndarray
        Rows (batch and channel) that validate.
    """
    import torch

    # `torch.optim.Adam` is a class around this function that also imports the compiler of torch.
    from torch.optim.adam import adam

    count, channels, n = batches.shape
    order = rng.permutation(count)
    held_out = max(1, round(count * preset.validation_share))
    # The channels of a batch stay together on one side of the split.
    in_order = (order[:, np.newaxis] * channels + np.arange(channels)).reshape(-1)
    validation, train = np.split(in_order, [held_out * channels])
    validation = validation[: preset.validation_rows]
    x, y = batches.reshape(-1, n), references.reshape(-1)
    of_mean = (x.mean(axis=1) - y) ** 2
    inputs, targets = torch.from_numpy(x), torch.from_numpy(y)
    outside = inputs[validation], targets[validation]

    def loss(rows: torch.Tensor, wanted: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.mse_loss(_forward(parameters, rows), wanted)

    def losses() -> Iterator[tuple[torch.Tensor, npt.NDArray[np.int64]]]:
        for part in spans(iterations, RECORD_EVERY):
            # One gather for many minibatches: indexing would otherwise dominate.
            rows = rng.choice(train, size=(part.stop - part.start, preset.minibatch))
            drawn = torch.from_numpy(rows)
            for k, pair in enumerate(zip(inputs[drawn], targets[drawn], strict=True)):
                yield loss(*pair), rows[k]

    weights = initial_weights(preset.sizes, rng)
    parameters = [torch.tensor(w, requires_grad=True) for w in weights]
    first, second = ([torch.zeros_like(parameter) for parameter in parameters] for _ in range(2))
    steps = [torch.zeros(()) for _ in parameters]
    usual: Any = {"beta1": 0.9, "beta2": 0.999, "eps": 1e-8, "weight_decay": 0.0}
    usual |= {"fused": True, "amsgrad": False, "maximize": False, "lr": preset.learning_rate}
    history, smallest, best, seen = [], np.inf, 0, []
    with training.threads(1), track("training", iterations, unit="it", show=progress) as advance:
        for iteration, (error, drawn) in enumerate(losses(), 1):
            gradients = list(torch.autograd.grad(error, parameters))
            with torch.no_grad():
                adam(parameters, gradients, first, second, [], steps, **usual)
            seen.append((error.detach(), drawn))
            advance(1)
            if iteration % RECORD_EVERY and iteration != iterations:
                continue
            current = [p.detach().numpy().copy() for p in parameters]
            if not all(np.isfinite(w).all() for w in current):
                break
            with torch.inference_mode():
                held_out_loss = float(loss(*outside))
            if patience is None or held_out_loss < smallest:
                weights, smallest, best = current, held_out_loss, iteration
            minibatch_losses, rows = zip(*seen, strict=True)
            seen = []
            fit, baseline = torch.stack(minibatch_losses).mean(), of_mean[np.stack(rows)].mean()
            history.append((iteration, fit, held_out_loss, baseline, of_mean[validation].mean()))
            if patience is not None and iteration - best >= patience:
                break
    return weights, np.array(history, np.float64).reshape(-1, 5), validation


def _octave_of(mean: Floats) -> tuple[Indices, Floats]:
    """Return the class of brightness of means in the training unit, and the unit of the class."""
    within = np.clip(np.nan_to_num(mean), 2.0 ** _OCTAVES[0], 2.0 ** _OCTAVES[-1])
    octave: Any = np.floor(np.log2(within))
    return octave.astype(np.int64) - _OCTAVES[0], 2.0**octave


def _validated(mean: Floats, network: Reals, target: Floats) -> tuple[Floats, Reals]:
    """Return the certainty and the residuals of `_TrainedMLP` from rows in the training unit.

    The fewer rows of a class decide, the nearer its certainty is to that of all rows, each in the
    unit of its octave. The square of a sum over the sum of squares says how many rows decide.
    """
    octave, unit = _octave_of(mean)
    move = np.where(np.isfinite(network), network - mean, 0) / unit
    wanted, least = (target - mean) / unit, np.finfo(np.float64).tiny
    members = octave == np.arange(len(_OCTAVES))[:, np.newaxis]
    product, square = members @ (wanted * move), members @ move**2
    rows = square**2 / np.maximum(members @ move**4, least)
    whole, own = product.sum() / max(square.sum(), least), product / np.maximum(square, least)
    certainty = np.clip((rows * own + _BORROWED * whole) / (rows + _BORROWED), 0, 1)
    residuals = wanted - certainty[octave] * move
    parts = [residuals[of] if of.sum() >= _FEW else residuals for of in members]
    # Of n rows, those of rank (n + 1) p: an interval must hold another row, not one of these.
    quantiles = [np.quantile(part, _LEVELS, method="weibull") for part in parts]
    return certainty, np.array(quantiles, np.float32)
