"""Contrast right renders of Mitsuba's test scenes with the references beside them.

Mitsuba's public data repository, https://github.com/mitsuba-renderer/mitsuba-data, holds scenes in
``tests/scenes/*/*.xml`` and references of them in ``refs``: an image, and one of the variances of a
sample, both of 32,000 spp (``src/render/tests/test_renders.py`` of Mitsuba 3). Renders of a right
renderer must not differ from them::

    git clone https://github.com/mitsuba-renderer/mitsuba-data
    python tools/mitsuba_references.py mitsuba-data

Each scene is rendered in a process of its own, with the integrator in its name and those by which
Mitsuba tests it, too, and with the samples of Mitsuba's own test. By chance alone, a contrast of
any of them differs with a probability of at most alpha. Beside it stands the verdict of Mitsuba's
test of the same render: a pixel fails if the z-value of any of X, Y and Z is beyond the Šidák
quantile, and a render if more than .25 % of the values of all pixels do.

If the film has a filter, which mixes the samples of neighbouring pixels, or the integrator cannot
sample one pixel after the other, Mitsuba renders passes with seeds of their own, and passes take
the place of samples. With ``--depth 1``, light is missing wherever paths are longer. The exit code
is 1 if a render differs.
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
from scipy import special

import chdstat as chd
from chdstat.inference import Reference
from chdstat.io.exr import from_xyz

OTHERS = {
    "direct": ("direct_projective",),
    "path": ("prb", "prb_projective"),
    "volpath": ("volpathmis", "prbvolpath"),
    "ptracer": ("path",),
}
"""Integrators by which Mitsuba also tests a scene, or that can take the place of its own."""
LEAST_SPP = 16
PASSES = 64
_LEVEL, _MAY_FAIL, _LEAST_VARIANCE = 0.01, 0.0025, 1e-4
"""Of Mitsuba's test."""
_NAMES = ("scene", "integrator", "spp", "outcome", "p", "z_test", "words")
_COLUMNS = "{scene:46} {integrator:17} {spp:>8} {outcome:20} {p:>8} {z_test:>14}  {words}"


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


def xyz_of(path: Path) -> np.ndarray:
    """Return what was converted from X, Y and Z, as it was before."""
    return np.asarray(chd.io.read_exr(path).image @ np.linalg.inv(from_xyz()).T)


def z_test(image: np.ndarray, spp: int, mean: Path) -> tuple[bool, float]:
    """Return whether Mitsuba's test accepts an image (y, x, channel), and the share that fails."""
    variance = np.maximum(xyz_of(variance_of(mean)), _LEAST_VARIANCE)
    z = (image @ np.linalg.inv(from_xyz()).T - xyz_of(mean)) * np.sqrt(spp / variance)
    pixels = image.shape[0] * image.shape[1]
    level = -np.expm1(np.log1p(-_LEVEL) / pixels)
    failed = float(np.mean(2 * special.ndtr(-np.abs(z)) <= level))
    return failed <= _MAY_FAIL, failed


def has_filter(scene: Path) -> str:
    """Return the filter of a film in Mitsuba's words; "" if it is a box."""
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    film = mi.load_file(str(scene)).sensors()[0].film()
    kind = str(film.rfilter()).partition("[")[0].strip()
    return "" if kind == "BoxFilter" else kind


def passes(scene: Path, integrator: str, spp: int, asked: argparse.Namespace) -> chd.Samples:
    """Return passes by Mitsuba, each with a seed of its own."""
    import mitsuba as mi

    mi.set_variant("scalar_rgb" if asked.backend == "scalar" else "llvm_ad_rgb")
    depth = {} if asked.depth is None else {"max_depth": asked.depth}
    loaded = mi.load_file(str(scene), integrator=integrator, **depth)
    each = max(1, round(spp / PASSES))
    seeds = np.random.SeedSequence(asked.seed).generate_state(PASSES)
    images = [np.array(mi.render(loaded, spp=each, seed=int(s)))[..., :3] for s in seeds]
    return chd.Samples.from_array(np.stack(images, axis=-1), averaged=each)


def rendered(
    scene: Path, integrator: str, spp: int, size: tuple[int, int], asked: argparse.Namespace
) -> tuple[chd.Samples, str]:
    """Return samples, and "" or why they are passes."""
    if kind := has_filter(scene):
        return passes(scene, integrator, spp, asked), f"(passes: its film has a {kind})"
    try:
        source = chd.load_scene(scene, integrator=integrator)
        return chd.render(
            source, spp=spp, size=size, seed=asked.seed, max_depth=asked.depth,
            backend=asked.backend, progress=False,
        ), ""  # fmt: skip
    except chd.errors.RenderError as error:
        if "pixel by pixel" not in str(error):
            raise
        return passes(scene, integrator, spp, asked), "(passes: it samples no single pixels)"


def contrasts(scene: Path, mean: Path, asked: argparse.Namespace) -> list[dict[str, Any]]:
    """Render a scene with each of its integrators; return rows of the table."""
    own = scene.stem.rpartition("_")[2]
    height, width = chd.io.read_exr(mean).image.shape[:2]
    spp = max(LEAST_SPP, round(asked.samples / (height * width)))
    rows: list[dict[str, Any]] = []
    for integrator in (own, *OTHERS.get(own, ())):
        try:
            samples, how = rendered(scene, integrator, spp, (width, height), asked)
        except (chd.errors.ChdstatError, RuntimeError) as error:
            rows.append({"integrator": integrator, "outcome": "not rendered", "words": str(error)})
            continue
        number = samples.spp * int(samples.attrs.get("averaged", 1))
        reference = Reference.read(mean, spp=asked.reference_spp)
        found = chd.contrast(samples, reference, alpha=asked.alpha, seed=asked.seed)
        accepted, failed = z_test(found.maps["mean_a"].to_numpy()[..., -3:], number, mean)
        rows.append(
            {
                "integrator": integrator,
                "spp": number,
                "outcome": found.outcome,
                "p": f"{found.image_p_value:.2g}",
                "z_test": f"{'accepts' if accepted else 'rejects'} {failed:.2%}",
                "words": f"{found.conclusion} {how}".strip(),
            }
        )
        if asked.out is not None:
            found.maps.to_netcdf(asked.out / f"{scene.stem}-{integrator}.nc")
    return rows


def main() -> int:
    """Print the table; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="a clone of mitsuba-data, or a part of it")
    parser.add_argument("--samples", type=float, default=2e6, help="samples of an image, at least")
    parser.add_argument("--reference-spp", type=int, default=32_000)
    parser.add_argument("--alpha", type=float, default=0.01, help="of all scenes together")
    parser.add_argument("--depth", type=int, help="longest paths, instead of those of the scene")
    parser.add_argument("--only", default="", help="scenes whose name contains this")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--out", type=Path, help="folder for the maps of each contrast")
    parser.add_argument("--scene", type=Path, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    every = references(asked.folder)
    asked.alpha /= max(len(every), 1)
    if asked.scene is not None:
        warnings.simplefilter("ignore")
        say(json.dumps(contrasts(asked.scene, every[asked.scene], asked)))
        return 0
    found = {s: r for s, r in every.items() if asked.only in s.stem}
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
