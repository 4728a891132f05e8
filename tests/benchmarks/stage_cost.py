"""Prints processor seconds and peak memory in MB of one stage, as JSON; `test_stages` runs it."""

import json
import resource
import sys
import tempfile
import time
from pathlib import Path

STAGES = ("import", "render", "summarize", "mixture", "modality", "analyze", "estimate", "contrast")
SETTINGS = {"size": (48, 48), "spp": 512, "backend": "scalar", "progress": False}


def measured(stage: str, folder: Path) -> dict[str, float]:
    start = time.process_time()
    import chdstat as chd

    if stage != "import":
        # Loads Mitsuba, and what the statistics keep.
        small = chd.render("bathroom", seed=3, **{**SETTINGS, "size": (8, 8)})
        chd.analyze(small, progress=False)
    if stage not in ("import", "render"):
        one, other = (chd.render("bathroom", seed=seed, **SETTINGS) for seed in (1, 2))
    work = {
        "import": lambda: None,
        "render": lambda: chd.render("bathroom", seed=1, out=folder / "a.zarr", **SETTINGS),
        "summarize": lambda: chd.summarize(one, progress=False),
        "mixture": lambda: chd.fit.mixture(one, progress=False),
        "modality": lambda: chd.modality(one, progress=False),
        "analyze": lambda: chd.analyze(one, progress=False),
        "estimate": lambda: chd.estimate(one, progress=False),
        "contrast": lambda: chd.contrast(one, other),
    }
    if stage != "import":
        start = time.process_time()
    work[stage]()
    seconds = time.process_time() - start
    return {"s": seconds, "MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3}


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        print(json.dumps(measured(sys.argv[1], Path(place))))
