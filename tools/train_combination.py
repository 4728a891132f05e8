"""Train the network of `chdstat.estimate`, and write the file that is shipped.

Usage: ``python tools/train_combination.py FOLDER``. The folder keeps renders of built-in scenes
only: each as it is, zoomed into, and with short paths; 256 samples of a pixel to estimate from, and
a reference of another seed. Rendering takes a quarter of an hour on two cores, training ten
minutes. Networks that were trained without each scene in turn print what its errors are, over those
of the better denoiser from the mean. The widths of the shipped intervals are those of such left-out
scenes.

References are noisy, too. What their noise adds to errors is taken away by simulation extrapolation
(Cook and Stefanski 1994, doi:10.1080/01621459.1994.10476871): what as much noise again adds to them
is measured.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

import chdstat as chd
from chdstat.estimators.default_estimate.candidates import Measured, candidates
from chdstat.estimators.default_estimate.weighting_network import LEVELS, comparisons, unit_of
from chdstat.estimators.training import write_model
from chdstat.rendering import render_batches

SCENES = (
    "bathroom",
    "caustic",
    "cornell-box",
    "day-room",
    "fog",
    "gallery",
    "many-lights",
    "night-room",
)
VIEWS: dict[str, dict[str, Any]] = {
    "whole": {"size": (128, 128)},
    "zoom": {"size": (320, 320), "crop": (100, 110, 128, 128)},
    "short": {"size": (128, 128), "max_depth": 3},
}
SPP = 256
REFERENCES = {"whole": (2048, 11, 12), "zoom": (1536, 21, 22), "short": (1536, 21, 22)}
"""Samples of a reference's pixels, the seed of the samples, and that of the reference."""
NUMBERS = 8, 24, 64, 256
"""Samples of a pixel that are estimated from."""
PER_THIRD = 3_000
"""Pixels of an image that tell how wide intervals are where it is dark, between, and bright."""
TARGET = Path(chd.__file__).parent / "estimators/combination.weighting_network.safetensors"
STEPS, AT_ONCE, HIDDEN, RATE, DECAY = 500, 6, 48, 3e-3, 1e-2
WORSE = 3.0
"""How much more an error above that of the denoiser counts, in logarithms."""
WIDTH = 0.2
"""What the likelihood of the errors counts."""
BIAS, UNBIASED = 3.0, 0.005
"""What a bias of the whole image counts beyond this share."""


def say(line: str) -> None:
    """Write a line now."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


@dataclass
class Case:
    """An image to learn from: inputs, candidates (pixel, candidate, channel) and reference."""

    scene: str
    name: str
    inputs: torch.Tensor
    candidates: torch.Tensor
    unit: torch.Tensor
    reference: torch.Tensor
    noise: torch.Tensor
    weight: torch.Tensor
    best: tuple[float, float]


def rendered(folder: Path, scene: str, view: str) -> dict[str, np.ndarray]:
    """Return samples, features, reference and its variance; rendered once."""
    path = folder / (f"{scene}.npz" if view == "whole" else f"{scene}+{view}.npz")
    if not path.exists():
        spp, seed, other = REFERENCES[view]
        samples = chd.render(scene, spp=SPP, seed=seed, progress=False, **VIEWS[view])
        batches = render_batches(
            scene, spp=spp, batch=64, seed=other, progress=False, **VIEWS[view]
        )
        means = [batch.mean(axis=-1, dtype=np.float64) for batch in batches]
        variance = np.var(means, axis=0, ddof=1) / len(means)
        features = {f"f_{name}": image for name, image in samples.features.items()}
        np.savez(path, x=samples.read(), ref=np.mean(means, axis=0), var=variance, **features)
        say(f"rendered {path.name}")
    return dict(np.load(path))


def case(held: dict[str, np.ndarray], scene: str, name: str, n: int, *, guided: bool) -> Case:
    """Return what is learned from n samples of a render, with features or without."""
    features = {key[2:]: held[key] for key in held if key.startswith("f_")} if guided else {}
    few = chd.Samples.from_array(held["x"][..., :n])
    measured = Measured.of(few)
    made = [candidates(start, features) for start in measured.starts]
    names, unit = list(made[0]), unit_of(made[0])
    inputs = comparisons(made, measured, unit)
    full = np.stack(list(made[0].values())) * measured.unit
    unit = unit * measured.unit
    reference, noise = held["ref"], held["var"]
    weight = 1 / (np.maximum(reference, 0) ** 2 + 0.01 * reference.mean() ** 2)
    squared = (full - reference) ** 2 - noise
    mse, relmse = squared.mean(axis=(1, 2, 3)), (squared * weight).mean(axis=(1, 2, 3))
    denoised = [i for i, n in enumerate(names) if n in ("denoised", "denoised with features")]
    best = min(denoised, key=lambda i: mse[i] * relmse[i])

    def rows(array: np.ndarray) -> torch.Tensor:
        return torch.tensor(array.reshape(-1, array.shape[-1]).astype(np.float32))

    return Case(
        scene,
        f"{name} {n}",
        rows(inputs),
        torch.tensor(full.reshape(len(full), -1, full.shape[-1]).transpose(1, 0, 2).copy()),
        rows(unit[..., np.newaxis]),
        rows(reference),
        rows(noise),
        rows(weight),
        (float(mse[best]), float(relmse[best])),
    )


class Network(torch.nn.Module):
    """Two hidden layers, then scores of the candidates and the logarithm of the width."""

    def __init__(self, cases: list[Case]) -> None:
        super().__init__()
        seen = torch.cat([c.inputs for c in cases])
        self.centre, self.spread = seen.mean(dim=0), seen.std(dim=0) + 1e-3
        self.candidates = cases[0].candidates.shape[1]
        widths = seen.shape[1], HIDDEN, HIDDEN, self.candidates + 1
        self.layers = torch.nn.ModuleList(
            torch.nn.Linear(a, b) for a, b in itertools.pairwise(widths)
        )
        with torch.no_grad():
            self.layers[-1].weight.zero_()
            self.layers[-1].bias.zero_()
            self.layers[-1].bias[0], self.layers[-1].bias[-1] = 2.0, -2.0

    def forward(self, inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return weights (pixel, candidate) and the logarithm of widths (pixel, 1)."""
        x = (inputs - self.centre) / self.spread
        for layer in self.layers[:-1]:
            x = torch.nn.functional.leaky_relu(layer(x))
        x = self.layers[-1](x)
        return torch.softmax(x[:, :-1], dim=1), x[:, -1:]


def ratios(c: Case, found: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return MSE and relMSE over those of the better denoiser, without the reference's noise."""
    squared = (found - c.reference) ** 2 - c.noise
    return squared.mean() / c.best[0], (squared * c.weight).mean() / c.best[1]


def combined(network: Network, c: Case) -> tuple[torch.Tensor, torch.Tensor]:
    """Return estimates (pixel, channel) and the logarithm of their widths."""
    weights, width = network(c.inputs)
    return (weights[..., None] * c.candidates).sum(dim=1), width


def errors(c: Case, found: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return absolute errors in the unit of a pixel, and those with twice the noise."""
    apart = found - c.reference
    noisier = apart + c.noise.clamp_min(0).sqrt() * torch.randn_like(apart)
    return apart.abs() / c.unit, noisier.abs() / c.unit


def train(cases: list[Case], steps: int = STEPS, seed: int = 0) -> Network:
    """Train on a few images at a time, as a whole: errors are ratios over an image."""
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    network = Network(cases)
    optimiser = torch.optim.AdamW(network.parameters(), RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=steps)
    for _ in range(steps):
        loss = torch.zeros(())
        for i in rng.choice(len(cases), min(AT_ONCE, len(cases)), replace=False):
            c = cases[i]
            found, width = combined(network, c)
            for ratio in ratios(c, found):
                log = torch.log(ratio.clamp_min(0.02))
                loss = loss + log + WORSE * torch.relu(log)
            shift = (found - c.reference).mean() / c.reference.mean()
            loss = loss + BIAS * torch.relu(shift.abs() - UNBIASED)
            # Laplace's law: the width is the mean absolute error.
            error, noisier = errors(c, found.detach())
            loss = loss + WIDTH * (width + (2 * error - noisier) * torch.exp(-width)).mean()
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        schedule.step()
    return network


def left_out(cases: list[Case], steps: int) -> np.ndarray:
    """Return quantiles of errors, in predicted widths, of networks that have not seen the scene.

    Shape (third of brightness, level). Each image counts the same, however its errors are
    distributed.
    """
    rng = np.random.default_rng(0)
    table: list[list[float]] = []
    drawn: list[list[np.ndarray]] = [[], [], []]
    for scene in sorted({c.scene for c in cases}):
        network = train([c for c in cases if c.scene != scene], steps)
        for c in (c for c in cases if c.scene == scene):
            with torch.no_grad():
                found, width = combined(network, c)
                table.append([float(r) for r in ratios(c, found)])
                scores = torch.stack(errors(c, found)) * torch.exp(-width)
            order = np.argsort(c.unit.numpy().ravel(), kind="stable")
            for third, rows in zip(drawn, np.array_split(order, 3), strict=True):
                third.append(scores.numpy()[:, rng.choice(rows, PER_THIRD)].reshape(2, -1))
            say(f"{c.name:24s} {table[-1][0]:6.2f} {table[-1][1]:6.2f}")
    means = np.exp(np.log(np.maximum(table, 0.02)).mean(axis=0))
    say(f"{'geometric mean':24s} {means[0]:6.2f} {means[1]:6.2f}")
    quantiles = [np.quantile(np.concatenate(third, axis=1), LEVELS, axis=1) for third in drawn]
    return np.array([2 * once - twice for once, twice in np.swapaxes(quantiles, 1, 2)], np.float32)


def main() -> None:
    """Render what is missing, train both networks, and write them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--out", type=Path, default=TARGET)
    options = parser.parse_args()
    arrays: dict[str, np.ndarray] = {}
    for kind in ("features", "plain"):
        cases = [
            case(held, scene, f"{scene} {view}", n, guided=kind == "features")
            for scene in SCENES
            for view in VIEWS
            for held in [rendered(options.folder, scene, view)]
            for n in NUMBERS
        ]
        say(f"{kind}: {len(cases)} images, left out by scene")
        arrays[f"{kind}.quantiles"] = left_out(cases, options.steps // 2)
        network = train(cases, options.steps)
        for i, layer in enumerate(network.layers):
            arrays[f"{kind}.matrix{i}"] = layer.weight.detach().numpy()
            arrays[f"{kind}.offset{i}"] = layer.bias.detach().numpy()
        arrays[f"{kind}.centre"] = network.centre.numpy()
        arrays[f"{kind}.spread"] = network.spread.numpy()
    about = {"scenes": SCENES, "samples": NUMBERS, "chdstat": chd.__version__}
    write_model(options.out, arrays, about)
    say(f"wrote {options.out}")


if __name__ == "__main__":
    sys.exit(main())
