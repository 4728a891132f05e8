"""Trained estimators beside the fixed ones: what is asked, and what cannot be."""

from __future__ import annotations

import numpy as np
import pytest

import chdstat as chd
from chdstat.explorer.estimators import batches_of, score_model


def test_a_model_is_scored_on_batches_of_its_number_of_samples():
    x = np.random.default_rng(1).gamma(2.0, size=(24, 24, 3, 512)).astype(np.float32)
    samples = chd.Samples.from_array(x)
    model = chd.estimators.train_model(samples, iterations=5, progress=False)
    batches = batches_of(samples[5, 7], model.inputs)
    found = score_model("mine", model, batches)
    direct = model.estimate(batches.x)
    np.testing.assert_allclose(found.value, direct.radiance.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(found.high, direct.high.mean(axis=0), rtol=1e-6)
    assert found.certainty == pytest.approx(float(direct.certainty.mean()), rel=1e-6)
    assert (found.name, found.given) == ("mine", True)
    assert np.isfinite([found.mse_ratio, found.bias]).all()
    assert score_model("mine", model, batches_of(samples[5, 7], 16)) is None
