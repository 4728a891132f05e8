"""Other renderers: recorded samples against a renderer's own images, and what recording costs.

Run with ``pytest benchmarks/test_other_renderers.py --benchmark-only -s -n 0``: ten minutes for
each; ``-k Cycles`` chooses one, and CHDSTAT_SPP gives the means another number of samples. A
failure is a mean that differs from that of a renderer's own images at 1 % for all scenes together,
samples that depend on each other, a recording that takes more than 1.3 times as long as the
renderer alone needs for the same passes, or other samples after a kill or with two workers.
"""

from __future__ import annotations

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
from chdstat.samples import inspect, is_store
from tests.recording.scene_renderers import CYCLES, LUXCORE, SceneRenderer

SIZE, SPP = (48, 32), int(os.environ.get("CHDSTAT_SPP", "1302"))
"""2e6 samples an image."""
SEEDS, OWN_SPP = 16, {CYCLES: 256, LUXCORE: SPP // 4}
"""A renderer's own images and their samples per pixel. Those of Cycles are one long sequence each,
so that several seeds tell their noise."""
LEVEL = 0.01
MOST_COST = 1.3
COSTS = {
    CYCLES: (("focus", (128, 96), 256), ("motion", (48, 32), 512)),
    LUXCORE: (("matte", (128, 96), 128), ("motion", (48, 32), 512)),
}
"""Scenes whose recording is timed, with their sizes and passes."""

ALONE = {
    CYCLES: """
    import sys, time, bpy, cycles, numpy as np
    bpy.ops.wm.open_mainfile(filepath=sys.argv[-4])
    width, height, spp = map(int, sys.argv[-3:])
    scene = bpy.context.scene
    c, r = scene.cycles, scene.render
    c.samples, c.use_sample_subset, c.sample_offset, c.sample_subset_length = 4096, True, 1, 1
    c.use_adaptive_sampling = c.use_denoising = False
    c.sample_clamp_indirect, c.pixel_filter_type = 0, "BOX"
    c.sampling_pattern = "TABULATED_SOBOL"
    r.use_persistent_data, r.use_compositing, r.use_sequencer = True, False, False
    r.resolution_x, r.resolution_y, r.resolution_percentage = width, height, 100
    before = cycles.CyclesRender.render
    def render(self, depsgraph):
        before(self, depsgraph)
        pixels = np.empty(width * height * 4, np.float32)
        self.get_result().layers[0].passes[0].rect.foreach_get(pixels)
    cycles.CyclesRender.render = render
    bpy.ops.render.render()
    start = time.perf_counter()
    for seed in range(spp):
        c.seed = seed * 7919
        scene.update_tag()
        bpy.ops.render.render()
    print("SECONDS", time.perf_counter() - start)
""",
    LUXCORE: """
    import os, sys, time, numpy as np, pyluxcore as lux
    lux.Init()
    os.chdir(os.path.dirname(sys.argv[-4]))
    width, height, spp = map(int, sys.argv[-3:])
    scene = lux.Scene(sys.argv[-4])
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
""",
}
"""The same passes, rendered and read by the renderer alone."""


@pytest.fixture(scope="module", params=[CYCLES, LUXCORE], ids=str)
def renderer(request: pytest.FixtureRequest) -> SceneRenderer:
    """Return a renderer that works here."""
    if request.param.why_not:
        pytest.skip(request.param.why_not)
    return request.param


@pytest.fixture(scope="module")
def scenes(renderer: SceneRenderer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of its scenes."""
    return renderer.make(tmp_path_factory.mktemp(str(renderer)))


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


def test_means_are_those_of_its_own(renderer: SceneRenderer, scenes: Path, benchmark) -> None:
    """Of twelve scenes; six correlations each beyond 4.5 deviations: by accident 1 in 2000."""
    rows = []

    def recorded() -> None:
        for path in sorted(scenes.glob(f"*{renderer.suffix}")):
            source = renderer.source(path, size=SIZE)
            samples = chd.record(source, spp=SPP, seed=7, progress=False)
            source.close()
            reference = renderer.images(path, SIZE, OWN_SPP[renderer], SEEDS)
            found = chd.contrast(samples, reference, alpha=LEVEL / 12)
            x = samples.read()
            rows.append((path.stem, found.outcome, found.image_p_value, dependence(x)))
            print(f"\n{path.stem:13s} {found.outcome}, p {rows[-1][2]:.3f}; largest correlation "
                  f"{rows[-1][3]:.1f} deviations; {(x == 0).all(2).mean():.1%} null; largest "
                  f"sample {x.max():.3g}, of the means {x.mean(-1).max():.3g}")  # fmt: skip

    benchmark.pedantic(recorded, rounds=1)
    assert {row[1] for row in rows} == {"no difference found"}
    assert max(row[3] for row in rows) < 4.5


def test_recording_costs_little(
    renderer: SceneRenderer, scenes: Path, benchmark, tmp_path: Path
) -> None:
    ratios, script = [], tmp_path / "alone.py"
    script.write_text(textwrap.dedent(ALONE[renderer]))

    def measured() -> None:
        for name, size, spp in COSTS[renderer]:
            for turn in range(3):
                told = renderer.run(script, scenes / f"{name}{renderer.alone}", *size, spp)
                alone = float(told.partition("SECONDS")[2].split()[0])
                source = renderer.source(scenes / f"{name}{renderer.suffix}", size=size)
                source(0)
                start = time.perf_counter()
                out = tmp_path / f"{name}{turn}.zarr"
                chd.record(source, spp=spp, out=out, progress=False)
                ratios.append((time.perf_counter() - start) / alone)
                source.close()
                print(f"\n{name} {size}: {ratios[-1]:.2f} of {1e3 * alone / spp:.1f} ms a pass")

    benchmark.pedantic(measured, rounds=1)
    assert np.median(ratios) < MOST_COST


KILLED = (
    "import sys, chdstat; chdstat.render(sys.argv[1], size=(24, 16), spp=4096, out=sys.argv[2])"
)


def test_kills_and_workers_change_no_bit(
    renderer: SceneRenderer, scenes: Path, benchmark, tmp_path: Path
) -> None:
    from distributed import Client, LocalCluster

    path = scenes / f"{'glossy' if renderer is LUXCORE else 'materials'}{renderer.suffix}"
    out = tmp_path / "killed.zarr"

    def compared() -> None:
        child = subprocess.Popen([sys.executable, "-c", KILLED, path, out])
        while not (is_store(out) and inspect(out)["complete_spp"] >= 64):
            time.sleep(0.2)
        child.kill()
        child.wait()
        source = renderer.source(path, size=(24, 16))
        whole = chd.record(source, spp=256, progress=False).read()
        resumed = chd.record(source, spp=256, out=out, progress=False).read()
        np.testing.assert_array_equal(resumed[..., :256], whole)
        with LocalCluster(n_workers=2, threads_per_worker=1) as cluster, Client(cluster) as client:
            spread = chd.record(source, spp=256, client=client, progress=False).read()
        source.close()
        np.testing.assert_array_equal(spread, whole)

    benchmark.pedantic(compared, rounds=1)
