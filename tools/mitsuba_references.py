"""Contrast right renders of Mitsuba's test scenes with the references beside them.

Mitsuba's public data repository, https://github.com/mitsuba-renderer/mitsuba-data, holds scenes in
``tests/scenes/*/*.xml`` and references of them in ``refs``: an image, and one of the variances of a
sample, both of 32,000 spp (``src/render/tests/test_renders.py`` of Mitsuba 3). Renders of a right
renderer must not differ from them::

    git clone https://github.com/mitsuba-renderer/mitsuba-data
    python tools/mitsuba_references.py mitsuba-data --alpha 0.05

Each scene is rendered in a process of its own, with the integrator in its name and those by which
Mitsuba tests it, too. A reference is taken as exact, and with its variances. By chance alone, a
share of at most alpha of the contrasts differ. Films with a filter mix the samples of neighbouring
pixels, which is a difference of means; they are named instead of compared. With ``--depth 1``,
light is missing wherever paths are longer. The exit code is 1 if a render differs.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np

import chdstat as chd
from chdstat.inference import Reference
from chdstat.io.exr import from_xyz

OTHERS = {"path": ("prb",), "volpath": ("volpathmis", "prbvolpath"), "ptracer": ("path",)}
"""Integrators by which Mitsuba also tests a scene, or that can take the place of one that cannot
be sampled pixel by pixel."""
LEAST_SPP = 16
_COLUMNS = "{scene:48} {integrator:11} {spp:>5} {reference:>9} {outcome:20} {p:>8}  {words}"


_NAMES = ("scene", "integrator", "spp", "reference", "outcome", "p", "words")


def say(line: str) -> None:
    """Print a line at once."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def references(folder: Path) -> dict[Path, Path]:
    """Return the RGB references by scene; both with a variance image."""
    found = {}
    for scene in sorted(folder.glob("**/tests/scenes/*/*.xml")):
        mean = scene.parent / "refs" / f"{scene.stem.rpartition('_')[0]}_ref_rgb.exr"
        if mean.exists() and variance_of(mean).exists():
            found[scene] = mean
    return found


def variance_of(mean: Path) -> Path:
    """Return the file with the variances."""
    return mean.with_name(f"{mean.stem}_var.exr")


def reference_of(mean: Path, spp: int) -> Reference:
    """Return a mean with the variances of R, G and B.

    The file has those of X, Y and Z, converted as if they were colours. As the samples of a pixel
    have nearly one colour, the standard deviations are converted instead.
    """
    to_rgb = from_xyz()
    xyz = chd.io.read_exr(variance_of(mean)).image @ np.linalg.inv(to_rgb).T
    variance = (np.sqrt(np.maximum(xyz, 0)) @ to_rgb.T) ** 2
    return Reference(chd.io.read_exr(mean).image, variance, spp, name=str(mean))


def filter_of(scene: Path) -> str:
    """Return the filter of a film in Mitsuba's words."""
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    film = mi.load_file(str(scene)).sensors()[0].film()
    return str(film.rfilter()).partition("[")[0].strip()


def contrasts(scene: Path, mean: Path, asked: argparse.Namespace) -> list[dict[str, Any]]:
    """Render a scene with each of its integrators; return rows of the table."""
    own = scene.stem.rpartition("_")[2]
    height, width = chd.io.read_exr(mean).image.shape[:2]
    spp = max(LEAST_SPP, round(asked.samples / (height * width)))
    if (kind := filter_of(scene)) != "BoxFilter":
        return [{"integrator": own, "outcome": "not compared", "words": f"its film has a {kind}"}]
    rows: list[dict[str, Any]] = []
    for integrator in (own, *OTHERS.get(own, ())):
        try:
            source = chd.load_scene(scene, integrator=integrator)
            samples = chd.render(
                source, spp=spp, size=(width, height), seed=asked.seed, max_depth=asked.depth,
                backend=asked.backend, progress=False,
            )  # fmt: skip
        except chd.errors.ChdstatError as error:
            rows.append({"integrator": integrator, "outcome": "not rendered", "words": str(error)})
            continue
        for kind, b in (("exact", mean), ("variance", reference_of(mean, asked.reference_spp))):
            found = chd.contrast(samples, b, alpha=asked.alpha, seed=asked.seed)
            rows.append(
                {
                    "integrator": integrator,
                    "spp": spp,
                    "reference": kind,
                    "outcome": found.outcome,
                    "p": f"{found.image_p_value:.2g}",
                    "words": found.conclusion,
                }
            )
    return rows


def main() -> int:
    """Print the table; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="a clone of mitsuba-data, or a part of it")
    parser.add_argument("--samples", type=float, default=5e5, help="samples of an image, at least")
    parser.add_argument("--reference-spp", type=int, default=32_000)
    parser.add_argument("--alpha", type=float, default=0.05, help="of each contrast")
    parser.add_argument("--depth", type=int, help="longest paths, instead of those of the scene")
    parser.add_argument("--only", default="", help="scenes whose name contains this")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--scene", type=Path, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    found = {s: r for s, r in references(asked.folder).items() if asked.only in s.stem}
    if asked.scene is not None:
        warnings.simplefilter("ignore")
        say(json.dumps(contrasts(asked.scene, found[asked.scene], asked)))
        return 0
    say(f"{len(found)} scenes\n")
    say(_COLUMNS.format(**{name: name for name in _NAMES}))
    counts: dict[str, set[Path]] = {}
    for scene in found:
        command = [sys.executable, *sys.argv, "--scene", str(scene)]
        run = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
        rows = json.loads(run.stdout.splitlines()[-1]) if run.returncode == 0 else []
        if not rows:
            why = (run.stderr.splitlines() or [f"exit code {run.returncode}"])[-1]
            rows = [{"outcome": "ended", "words": why}]
        for row in rows:
            blank = dict.fromkeys(_NAMES, "")
            say(_COLUMNS.format(**blank | row | {"scene": scene.stem}))
            counts.setdefault(row["outcome"], set()).add(scene)
    say("\nscenes: " + ", ".join(f"{name} {len(of)}" for name, of in counts.items()))
    return int("differ" in counts)


if __name__ == "__main__":
    raise SystemExit(main())
