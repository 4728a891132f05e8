"""What the page on noisy Blender scenes shows is what Cycles draws."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="no bpy")
_TOOL = Path(__file__).parents[2] / "tools" / "make_blender_examples.py"


@pytest.fixture(scope="module")
def tool():
    spec = importlib.util.spec_from_file_location("make_blender_examples", _TOOL)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_examples_are_those_of_the_page(tool, tmp_path):
    """Means of rooms without fireflies; each fails by accident once in 15,000 other seeds."""
    subprocess.run(
        [sys.executable, _TOOL, "scenes", tmp_path], check=True, capture_output=True, timeout=120
    )
    assert (tmp_path / "monkey.blend").exists()
    shown, spp = np.load(tool.OUT), 48
    for name in ("glass-3", "lamps-1", "window-1"):
        passes = tool.samples_of(tmp_path / f"{name}.blend", spp).read().mean(axis=(0, 1, 2))
        mean, black, _ = shown[f"{name.replace('-', '/')}/numbers"]
        assert 0 < black < 1
        error = passes.std(ddof=1) / spp**0.5
        assert abs(passes.mean() - mean) < 4.5 * error, name
