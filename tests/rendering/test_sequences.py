"""Samplers that spread the samples of a pixel: within a sequence, and from one to the next.

The radiance of `NUMBERS` is three random numbers, so that what a sampler does to them is known. As
in `test_mitsuba_renderer`, seeds are fixed, and each statistical test has a negative control.
"""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.stats

import chdstat as chd
from chdstat.errors import InputError, StoreError
from chdstat.rendering import render_batches, seeds
from chdstat.rendering.backend import activate, probe
from chdstat.rendering.jobs import Job
from chdstat.rendering.mitsuba_renderer import MitsubaRenderer
from chdstat.rendering.seeds import Sequences, grouped, max_spp
from chdstat.samples.tiles import TILE, chunk_grid
from tests.rendering.numbers import ALPHA, NUMBERS, register_numbers

SIZE = (12, 10)
SEQUENCES = [("stratified", 16), ("multijitter", 15), ("orthogonal", 25), ("ldsampler", 16)]
SPREAD = [SEQUENCES[0], SEQUENCES[3]]
"""One that jitters in strata and the one of low discrepancy: Mitsuba scrambles both kinds apart."""


@pytest.fixture(scope="module")
def backend(backend) -> str:
    """Make the integrators of these tests known to a backend, and return its name."""
    register_numbers(backend)
    with activate(probe(backend)) as mi:

        class Directions(mi.SamplingIntegrator):  # type: ignore[misc, name-defined]
            def sample(self, scene, sampler, ray, medium=None, active=True):
                return mi.Color3f(1 + ray.d.x, 1 + ray.d.y, 1 + ray.d.z), True, []

        mi.register_integrator("directions", Directions)
    return backend


def render(backend: str, scene: Any = NUMBERS, **options: Any) -> chd.Samples:
    return chd.render(scene, **{"backend": backend, "size": SIZE, **options})


@functools.cache
def spread(backend: str, sampler: str, length: int, integrator: str = "random_numbers") -> Any:
    """Return samples of 32 sequences; of 16 where the direction of rays is looked at."""
    scene = {**NUMBERS, "integrator": {"type": integrator}}
    sequences = 32 if integrator == "random_numbers" else 16
    options = {"sampler": sampler, "sequence": length, "spp": sequences * length}
    return render(backend, scene, **options).read()


@functools.cache
def independent(backend: str, integrator: str = "random_numbers") -> Any:
    """Return independent samples, as many as of 32 sequences of 25."""
    scene = {**NUMBERS, "integrator": {"type": integrator}}
    return render(backend, scene, spp=800).read()


def by_sequence(x: np.ndarray, length: int) -> np.ndarray:
    """Return samples as (y, x, channel, sequence, sample), in double precision."""
    return x.reshape(*x.shape[:-1], -1, length).astype(np.float64)


def variance_ratio(x: np.ndarray, length: int) -> float:
    """Return the variance of means of consecutive samples over that of independent ones."""
    means = by_sequence(x, length).mean(axis=-1)
    return float(length * means.var(axis=-1, ddof=1).mean() / x.var(axis=-1, ddof=1).mean())


# --- within a sequence --------------------------------------------------------------------------


@pytest.mark.parametrize(("sampler", "length"), SEQUENCES)
def test_each_stratum_holds_one_sample_of_a_sequence(backend, sampler, length):
    x = spread(backend, sampler, length)[..., : 8 * length]
    strata = np.sort(np.floor(by_sequence(x, length) * length).astype(int), axis=-1)
    assert (strata == np.arange(length)).all()
    # They do not come in the order of the strata, nor in one order.
    first = np.floor(by_sequence(x, length)[..., 0] * length).astype(int)
    assert len(np.unique(first)) == length


def test_independent_strata_hold_what_chance_gives(backend):
    x = independent(backend)[..., :256]
    strata = np.sort(np.floor(by_sequence(x, 16) * 16).astype(int), axis=-1)
    assert (strata == np.arange(16)).all(axis=-1).mean() < 0.01


@pytest.mark.parametrize(("sampler", "length"), SPREAD)
def test_positions_on_the_film_are_spread(backend, sampler, length):
    """Radiance is linear across a pixel: strata of a fourth leave a sixteenth of the variance."""
    x = spread(backend, sampler, length, "directions")[:, :, :2]
    assert variance_ratio(x, length) < 0.12
    other = independent(backend, "directions")[:, :, :2, : 16 * length]
    assert abs(variance_ratio(other, length) - 1) < 0.1


# --- between sequences --------------------------------------------------------------------------


@pytest.mark.parametrize(("sampler", "length"), SPREAD)
def test_sequences_are_independent_of_each_other(backend, sampler, length):
    x = spread(backend, sampler, length)
    if sampler == "ldsampler":  # one scramble for all numbers of a sequence
        x = x[:, :, :1]
    means = by_sequence(x, length).mean(axis=-1) - 0.5
    z = means / means.std()  # (y, x, channel, sequence)

    def p(z: np.ndarray) -> float:
        """Return four times the least of p-values that products of neighbours average to 0."""
        pairs = [
            z[..., 1:] * z[..., :-1],
            z[:, 1:] * z[:, :-1],
            z[1:] * z[:-1],
            (z.mean(axis=-1) ** 2 * z.shape[-1] - 1) / np.sqrt(2),  # all of a pixel at once
        ]
        scores = [pair.mean() * np.sqrt(pair.size) for pair in pairs]
        return float(2 * len(scores) * scipy.stats.norm.sf(np.abs(scores)).min())

    assert p(z) > ALPHA
    assert p(np.repeat(z[..., :16], 2, axis=-1)) < ALPHA


@pytest.mark.parametrize(
    "sampler", ["stratified", pytest.param("ldsampler", marks=pytest.mark.slow)]
)
def test_no_sequence_comes_twice(backend, sampler):
    """Of the low-discrepancy sampler, whose only chance is the scramble; of others, no sample."""
    found = np.concatenate(
        [
            render(backend, sampler=sampler, spp=32, size=(70, 20), seed=seed).read()
            for seed in (0, 1)
        ]
    )
    rows = np.moveaxis(by_sequence(found, 16), 2, -1).reshape(4 * 70 * 20, 48)
    rows = rows if sampler == "ldsampler" else rows.reshape(-1, 3)
    assert len(np.unique(rows, axis=0)) == len(rows)


def test_sequences_share_no_independent_numbers(backend):
    one = independent(backend)[..., :16]
    other = render(backend, spp=16, sampler="multijitter", sequence=16).read()
    a, b = (np.moveaxis(x, 2, 0).reshape(3, -1) for x in (one, other))
    score = ((a - 0.5) * (b - 0.5)).mean(axis=1) * 12 * np.sqrt(a.shape[1])
    assert abs(score).max() < 4


def test_numbers_of_scalar_sequences_are_their_own():
    streams = seeds.Streams((150, 130), 3)
    chunks = list(chunk_grid(130, 150, 64))
    first = {streams.of_sequence(c, q) for c in chunks for q in range(40)}
    assert len(first) == 9 * 40
    assert all(number % TILE**2 == 0 for number in first)
    assert max(first) + TILE**2 <= 2**32 - seeds.PIXELS
    passes = {
        streams.of_pass(c, s) * c.shape[0] * c.shape[1] % 2**32 for c in chunks for s in (0, 63)
    }
    assert not first & passes


def test_wavefronts_of_sequences_share_no_lane():
    """Mitsuba scrambles a sequence by the number of its wavefront plus its first lane."""
    size, sequences = (150, 130), Sequences("orthogonal", 25)
    streams = seeds.Streams(size, 3)
    lanes = TILE**2 * sequences.drawn_together
    numbers = [
        streams.of_wavefront(chunk, block, lanes)
        for chunk in chunk_grid(130, 150, 64)
        for block in range(max_spp("llvm", *size, sequences) // sequences.drawn_together)
    ]
    assert np.diff(sorted(numbers)).min() >= lanes
    assert max(numbers) + lanes <= 2**32


# --- chunks -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sampler", "length"),
    [("stratified", 9), pytest.param("ldsampler", 256, marks=pytest.mark.slow)],
)
def test_samples_do_not_depend_on_how_they_are_cut(backend, sampler, length, tmp_path):
    """Chunks of a store have 64 samples, of which neither 9 nor 256 are a part or a multiple."""
    size, spp = (4, 3), 512 if length == 256 else 144
    options = {"sampler": sampler, "sequence": length, "size": size}
    whole = render(backend, spp=spp, **options).read()
    path = tmp_path / "s.zarr"
    render(backend, spp=spp // 2, out=path, **options)
    assert np.array_equal(render(backend, spp=spp, out=path, **options).read(), whole)
    batches = render_batches(NUMBERS, spp=spp, batch=50, backend=backend, **options)
    assert np.array_equal(np.concatenate(list(batches), axis=-1), whole)
    with activate(probe(backend)):
        renderer = MitsubaRenderer(Job.of(NUMBERS, backend=backend, **options))
        chunk = list(chunk_grid(*size[::-1], spp))[1]
        alone = renderer.chunk(replace(chunk, ss=slice(70, 75)))
    assert np.array_equal(alone, whole[..., 70:75])


def test_chunks_of_one_sequence_are_drawn_together():
    chunks = list(chunk_grid(70, 8, 512))
    groups = list(grouped(chunks, Sequences("ldsampler", 256)))
    assert [len(parts) for _, parts in groups] == [4, 4, 4, 4]
    assert {id(part) for _, parts in groups for part in parts} == set(map(id, chunks))
    assert [len(parts) for _, parts in grouped(chunks, None)] == [1] * len(chunks)
    # Of a render that was stopped, those that are missing.
    [(together, parts)] = grouped(chunks[4:7:2], Sequences("ldsampler", 256))
    assert (together.ss, len(parts)) == (slice(128, 256), 2)


def test_other_seeds_are_other_samples(backend):
    one, seed, length = (
        render(backend, spp=16, sampler="stratified", **options).read()
        for options in ({}, {"seed": 1}, {"sequence": 4})
    )
    assert not (one == seed).any()
    assert (one == length).mean() < 0.01


# --- what is kept of it, and what is refused ----------------------------------------------------


def test_the_sampler_is_a_part_of_the_provenance(tmp_path):
    stored = {"sampler": "stratified", "size": (6, 4), "out": tmp_path / "s.zarr"}
    drawn = render("scalar", "cornell-box", spp=32, **stored)
    assert (drawn.attrs["sampler"], drawn.attrs["sequence"]) == ("stratified", 16)
    assert "sequence" not in render("scalar", "cornell-box", spp=1, size=(6, 4)).attrs
    with pytest.raises(StoreError, match="sequence: stored 16, asked for 4"):
        render("scalar", "cornell-box", spp=64, sequence=4, **stored)


def test_a_sampler_chosen_by_name_needs_no_note():
    scene = {**NUMBERS, "integrator": {"type": "path"}}
    scene["sensor"] = {"type": "perspective", "sampler": {"type": "multijitter"}}
    noted = [
        render("scalar", scene, spp=16, sampler=sampler).attrs["notes"]
        for sampler in ("independent", "multijitter")
    ]
    assert [bool(notes) for notes in noted] == [True, False]


def test_lengths_are_those_of_mitsuba():
    with activate(probe("scalar")) as mi:
        mi.set_log_level(mi.LogLevel.Error)
        for sampler in ("stratified", "multijitter", "orthogonal", "ldsampler"):
            for length in (*range(2, 130), 256, 529, 784, 961, 1023, 1024):
                made = mi.load_dict({"type": sampler, "sample_count": length}).sample_count()
                if made == length:
                    assert Sequences.of(sampler, length) == Sequences(sampler, length)
                else:
                    with pytest.raises(InputError, match="next to it"):
                        Sequences.of(sampler, length)
