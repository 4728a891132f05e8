"""A cold report in a process of its own, which prints what each of its stages cost as JSON.

Arguments: a scene, a backend, samples per pixel, what the report holds and the PDF to write; in
place of the last two, ``render`` renders the same samples and nothing else. Numbers are seconds of
the processor, of all threads.
"""

import json
import sys
import time

from chdstat.reporting import content, figures, scene_report
from chdstat.studies.claim import Claim

STAGES = {
    "rendering": (scene_report, "render"),
    "analysis": (scene_report, "patterns_of"),
    "atlas": (scene_report, "atlas"),
    "trainings": (scene_report._Report, "trained"),
    "comparison, with trainings": (scene_report, "compare"),
    "errors against N": (scene_report._Report, "curve"),
    "claims": (Claim, "find"),
    "text": (content, "report_content"),
    "figures": (figures, "report_figures"),
    "typesetting": (scene_report, "typeset"),
}


def main(scene: str, backend: str, spp: str, contents: str, target: str = "") -> None:
    """Write a report, or only render, and print the seconds of each stage."""
    seconds = dict.fromkeys(STAGES, 0.0)

    def timed(stage, function):
        def call(*arguments, **options):
            start = time.process_time()
            try:
                return function(*arguments, **options)
            finally:
                seconds[stage] += time.process_time() - start

        return call

    for stage, (owner, name) in STAGES.items():
        setattr(owner, name, timed(stage, getattr(owner, name)))
    if contents == "render":
        loaded = scene_report.load_scene(scene)
        settings = scene_report._settings_of(loaded, None, as_published=False) | {"spp": int(spp)}
        scene_report.render(loaded, **settings, backend=backend, progress=False)
    else:
        scene_report.report(
            scene, target, contents=contents, spp=int(spp), backend=backend, progress=False
        )
    print(json.dumps({**seconds, "all": time.process_time()}))


if __name__ == "__main__":
    main(*sys.argv[1:])
