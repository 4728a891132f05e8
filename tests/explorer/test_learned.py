"""Trained estimators beside the fixed ones: what is asked, and what cannot be."""

from __future__ import annotations

import numpy as np

import chdstat as chd
from chdstat.explorer.batch_estimates import batches_of, estimates_of_model


def test_a_model_estimates_from_batches_of_its_number_of_samples():
    x = np.random.default_rng(1).gamma(2.0, size=(24, 24, 3, 512)).astype(np.float32)
    samples = chd.Samples.from_array(x)
    model = chd.estimators.train_model(samples, iterations=5, progress=False)
    batches = batches_of(samples[5, 7], model.inputs)
    (found,) = estimates_of_model("mine", model, batches)
    direct = model.estimate(batches)
    assert found.name == "mine"
    np.testing.assert_array_equal(found.values, direct.radiance)
    np.testing.assert_array_equal(found.certainty, direct.certainty)
    assert estimates_of_model("mine", model, batches_of(samples[5, 7], 16)) == []
