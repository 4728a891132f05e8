"""LuxCore: recorded samples against the renderer's own images, and what recording costs.

Run with ``pytest benchmarks/test_luxcore.py --benchmark-only -s``: ten minutes.
A failure is a mean that differs from that of LuxCore's own images at 1 % for all scenes together,
samples that depend on each other, a recording that takes more than 1.3 times as long as LuxCore
needs for the same passes, or other samples after a kill or with two workers.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import rankdata

import chdstat as chd
from chdstat.inference.references import Reference
from chdstat.recording.luxcore import LuxCoreSource

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("pyluxcore") is None, reason="LuxCore is not installed"
)
SCRIPT = Path(__file__).parents[1] / "tests/recording/luxcore_scenes.py"
SIZE, SPP = (48, 32), int(os.environ.get("LUXCORE_SPP", "1302"))
"""2e6 samples an image."""
SEEDS, OWN_SPP = 16, SPP // 4
LEVEL = 0.01
MOST_COST = 1.3

ALONE = """
    import sys, time, numpy as np, pyluxcore as lux
    from pathlib import Path
    lux.Init()
    lux.AddFileNameResolverPath(str(Path(sys.argv[1]).parent))
    width, height, spp = map(int, sys.argv[2:])
    scene = lux.Scene(sys.argv[1])
    def drawn(seed):
        settings = lux.Properties()
        settings.SetFromString(f'''
            renderengine.type = RTPATHCPU
            renderengine.seed = {seed}
            sampler.type = RTPATHCPUSAMPLER
            rtpathcpu.zoomphase.size = 1
            native.threads.count = 1
            path.pathdepth.total = 5
            path.pathdepth.diffuse = 4
            path.pathdepth.glossy = 4
            path.pathdepth.specular = 6
            film.filter.type = NONE
            film.width = {width}
            film.height = {height}
            film.outputs.0.type = RGB
            film.outputs.0.filename = o.exr
        ''')
        session = lux.RenderSession(lux.RenderConfig(settings, scene))
        session.Start()
        session.WaitNewFrame()
        session.Stop()
        image = np.empty((height, width, 3), np.float32)
        session.GetFilm().GetOutputFloat(lux.FilmOutputType.RGB, image, 0, False)
    drawn(1)
    start = time.perf_counter()
    for seed in range(spp):
        drawn(seed * 7919 + 1)
    print("SECONDS", time.perf_counter() - start)
"""
"""The same passes, rendered and read by LuxCore alone."""


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from tests.recording import luxcore_scenes

    folder = tmp_path_factory.mktemp("luxcore")
    luxcore_scenes.make(folder)
    return folder


def own_images(path: Path) -> Reference:
    words = [path, path.parent, *map(str, (*SIZE, OWN_SPP, SEEDS))]
    subprocess.run([sys.executable, SCRIPT, *words], check=True, capture_output=True)
    names = (path.parent / f"{path.stem}-{n}.npy" for n in range(SEEDS))
    batches = np.stack([np.load(name) for name in names], axis=-1)
    return Reference(batches.mean(-1), spp=SEEDS * OWN_SPP, batches=batches, precision=1e-6)


def dependence(x: np.ndarray) -> float:
    """Return the largest correlation of ranks in standard deviations: of passes and neighbours."""
    lum = x.mean(axis=2)
    random = lum.min(-1) < lum.max(-1)  # of other pixels, samples are equal
    z = (rankdata(lum, axis=-1) - (lum.shape[-1] + 1) / 2) * random[..., np.newaxis]
    z /= np.where(random, z.std(-1), 1)[..., np.newaxis]
    one, expected = 1 / np.sqrt(random.sum() * lum.shape[-1]), -1 / (lum.shape[-1] - 1)
    found = [((z[..., k:] * z[..., :-k]).mean() / random.mean() - expected) / one for k in (1, 2)]
    pairs = ((z[:, 1:], z[:, :-1]), (z[1:], z[:-1]), (z[1:, 1:], z[:-1, :-1]))
    found += [(a * b).sum() / np.sqrt(np.square(a * b).sum()) for a, b in pairs]
    means = z.sum((0, 1)) / np.sqrt(random.sum())
    found.append((means.var() - 1) / np.sqrt(2 / lum.shape[-1]))
    return float(np.abs(found).max())


def test_means_are_those_of_luxcore(scenes: Path, benchmark) -> None:
    """Of twelve scenes; six correlations each beyond 4.5 deviations: by accident 1 in 2000."""
    rows = []

    def recorded() -> None:
        for path in sorted(scenes.glob("*.cfg")):
            source = LuxCoreSource(path, size=SIZE)
            samples = chd.record(source, spp=SPP, seed=7, progress=False)
            source.close()
            reference = own_images(path.with_suffix(".scn"))
            found = chd.contrast(samples, reference, alpha=LEVEL / 12)
            x = samples.read()
            rows.append((path.stem, found.outcome, found.image_p_value, dependence(x)))
            print(f"\n{path.stem:13s} {found.outcome}, p {rows[-1][2]:.3f}; largest correlation "
                  f"{rows[-1][3]:.1f} deviations; {(x == 0).all(2).mean():.1%} null; largest "
                  f"sample {x.max():.3g}, of the means {x.mean(-1).max():.3g}")  # fmt: skip

    benchmark.pedantic(recorded, rounds=1)
    assert {row[1] for row in rows} == {"no difference found"}
    assert max(row[3] for row in rows) < 4.5


def test_recording_costs_little(scenes: Path, benchmark, tmp_path: Path) -> None:
    ratios = []

    def measured() -> None:
        for name, size, spp in (("matte", (128, 96), 128), ("motion", (48, 32), 512)):
            for turn in range(3):
                script = tmp_path / "alone.py"
                script.write_text(textwrap.dedent(ALONE))
                words = [sys.executable, script, scenes / f"{name}.scn", *map(str, (*size, spp))]
                told = subprocess.run(
                    words, check=True, capture_output=True, text=True, cwd=scenes
                ).stdout
                alone = float(told.partition("SECONDS")[2].split()[0])
                source = LuxCoreSource(scenes / f"{name}.cfg", size=size)
                source(0)
                start = time.perf_counter()
                out = tmp_path / f"{name}{turn}.zarr"
                chd.record(source, spp=spp, out=out, progress=False)
                ratios.append((time.perf_counter() - start) / alone)
                source.close()
                print(f"\n{name} {size}: {ratios[-1]:.2f} of {1e3 * alone / spp:.1f} ms a pass")

    benchmark.pedantic(measured, rounds=1)
    assert np.median(ratios) < MOST_COST


KILLED = """
    import sys, chdstat as chd
    from chdstat.recording.luxcore import LuxCoreSource
    chd.record(LuxCoreSource(sys.argv[1], size=(24, 16)), spp=4096, out=sys.argv[2], progress=False)
"""


def test_kills_and_workers_change_no_bit(scenes: Path, benchmark, tmp_path: Path) -> None:
    from distributed import Client, LocalCluster

    path, out = scenes / "glossy.cfg", tmp_path / "killed.zarr"

    def compared() -> None:
        child = subprocess.Popen([sys.executable, "-c", textwrap.dedent(KILLED), path, out])
        while not (chd.samples.is_store(out) and chd.open(out).spp >= 64):
            time.sleep(0.2)
        child.kill()
        child.wait()
        source = LuxCoreSource(path, size=(24, 16))
        whole = chd.record(source, spp=256, progress=False).read()
        resumed = chd.record(source, spp=256, out=out, progress=False).read()
        np.testing.assert_array_equal(resumed[..., :256], whole)
        with LocalCluster(n_workers=2, threads_per_worker=1) as cluster, Client(cluster) as client:
            spread = chd.record(source, spp=256, client=client, progress=False).read()
        source.close()
        np.testing.assert_array_equal(spread, whole)

    benchmark.pedantic(compared, rounds=1)
