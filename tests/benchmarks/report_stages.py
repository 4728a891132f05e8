"""A cold report in a process of its own, which prints how long each of its stages took as JSON.

Arguments: a scene, a backend and the PDF to write. The trainings run beside the analysis, so that
their time is what was waited for them after it.
"""

import json
import sys
import time

from chdstat.reporting import content, figures, scene_report

STAGES = {
    "rendering": (scene_report, "render"),
    "analysis": (scene_report, "analyze"),
    "atlas": (scene_report, "atlas"),
    "trainings, after these": (scene_report, "_trained"),
    "comparison": (scene_report, "compare"),
    "errors against N": (scene_report, "_curve"),
    "text": (content, "scene_content"),
    "figures": (figures, "report_figures"),
    "typesetting": (scene_report, "typeset"),
}


def main(scene: str, backend: str, target: str) -> None:
    """Write a report, and print the seconds of each stage."""
    seconds = {}

    def timed(stage, function):
        def call(*arguments, **options):
            start = time.perf_counter()
            try:
                return function(*arguments, **options)
            finally:
                seconds[stage] = time.perf_counter() - start

        return call

    for stage, (owner, name) in STAGES.items():
        setattr(owner, name, timed(stage, getattr(owner, name)))
    start = time.perf_counter()
    scene_report.report(scene, target, backend=backend, progress=False)
    seconds["all"] = time.perf_counter() - start
    print(json.dumps(seconds))


if __name__ == "__main__":
    main(*sys.argv[1:])
