"""Dense networks in torch: start, train by minibatches, evaluate in chunks.

Weights live outside as a list of NumPy arrays, a matrix (in, out) and a bias (out,) per layer, so
that a trained model is data. Training runs on one CPU thread: these networks are so small that
starting a kernel costs more than running it, and one thread makes the result repeatable.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import torch

from chdstat._core.arrays import spans

__all__ = ["TrainingRows", "descend", "evaluate", "initial_weights"]

Weights = list[npt.NDArray[np.float32]]

RECORD_EVERY = 100
"""Iterations between two rows of the history."""
_VALIDATION_ROWS = 16_384
"""Rows of the validation part that a row of the history looks at, at most."""
_ROWS_AT_ONCE = 65_536


@dataclass(frozen=True)
class TrainingRows:
    """What a network learns from, in units of the scene's mean.

    Attributes
    ----------
    inputs
        float32, shape (row, input).
    targets
        float32, shape (row,).
    baseline
        Squared error of the sample mean, float32, shape (row,).
    train, validation
        Indices of the rows of each.
    """

    inputs: npt.NDArray[np.float32]
    targets: npt.NDArray[np.float32]
    baseline: npt.NDArray[np.float32]
    train: npt.NDArray[np.int64]
    validation: npt.NDArray[np.int64]


def initial_weights(sizes: Sequence[int], rng: np.random.Generator) -> Weights:
    """Draw He-uniform matrices and zero biases for layers of the given sizes (He et al. 2015)."""
    weights: Weights = []
    for fan_in, fan_out in pairwise(sizes):
        limit = np.sqrt(6 / fan_in)
        weights.append(rng.uniform(-limit, limit, (fan_in, fan_out)).astype(np.float32))
        weights.append(np.zeros(fan_out, np.float32))
    return weights


def descend(
    weights: Weights,
    data: TrainingRows,
    *,
    iterations: int,
    minibatch: int,
    learning_rate: float,
    rng: np.random.Generator,
    advance: Callable[[float], None],
) -> tuple[Weights, npt.NDArray[np.float64]]:
    """Minimise the squared error with Adam.

    Returns
    -------
    weights : list of ndarray
        As after the last record at which all of them were finite.
    history : ndarray
        Rows (iteration, train loss, validation loss, train baseline, validation baseline); the
        train columns average over the minibatches since the row before.
    """
    inputs, targets = torch.from_numpy(data.inputs), torch.from_numpy(data.targets)
    watched = torch.from_numpy(data.validation[:_VALIDATION_ROWS])
    validation_baseline = data.baseline[watched.numpy()].mean()
    kept, history = weights, []
    with _one_thread():
        parameters = [torch.tensor(w, requires_grad=True) for w in weights]
        optimiser = torch.optim.Adam(parameters, lr=learning_rate, fused=True)
        for done in spans(iterations, RECORD_EVERY):
            # One gather for many minibatches: indexing would otherwise dominate.
            rows = rng.choice(data.train, size=(done.stop - done.start, minibatch))
            drawn = torch.from_numpy(rows)
            steps = zip(inputs[drawn], targets[drawn], strict=True)
            losses = [_step(optimiser, parameters, x, y) for x, y in steps]
            current = [p.detach().numpy().copy() for p in parameters]
            if not all(np.isfinite(w).all() for w in current):
                break
            kept = current
            with torch.inference_mode():
                validation = _loss(parameters, inputs[watched], targets[watched])
            train = torch.stack(losses).mean()
            baseline = data.baseline[rows].mean()
            history.append((done.stop, train, validation, baseline, validation_baseline))
            advance(done.stop - done.start)
    return kept, np.array(history, np.float64).reshape(-1, 5)


def evaluate(weights: Weights, x: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Run a network over rows (row, input), on the GPU where torch finds one; result (row,)."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    parameters = [torch.tensor(w, device=device) for w in weights]
    result = np.empty(len(x), np.float32)
    with torch.inference_mode():
        for part in spans(len(x), _ROWS_AT_ONCE):
            # Torch has no negative strides, such as those of a reversed view.
            rows = torch.tensor(np.ascontiguousarray(x[part]), device=device)
            result[part] = _forward(parameters, rows).cpu().numpy()
    return result


def _forward(parameters: Sequence[torch.Tensor], x: torch.Tensor) -> torch.Tensor:
    *hidden, matrix, bias = parameters
    for layer in range(0, len(hidden), 2):
        x = torch.relu(torch.addmm(hidden[layer + 1], x, hidden[layer]))
    return torch.addmm(bias, x, matrix)[:, 0]


def _loss(parameters: Sequence[torch.Tensor], x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.mse_loss(_forward(parameters, x), y)


def _step(
    optimiser: torch.optim.Adam, parameters: list[torch.Tensor], x: torch.Tensor, y: torch.Tensor
) -> torch.Tensor:
    loss = _loss(parameters, x, y)
    gradients = torch.autograd.grad(loss, parameters)
    for parameter, gradient in zip(parameters, gradients, strict=True):
        parameter.grad = gradient
    optimiser.step()
    return loss.detach()


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
