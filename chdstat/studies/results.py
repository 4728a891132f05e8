"""Results: what a study found in each scene and in all of them, as a table, JSON and a PDF."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from chdstat._core.files import checked_target, replacing
from chdstat.analysis import Overview, overview
from chdstat.comparison import Comparison
from chdstat.errors import StoreError
from chdstat.patterns import Atlas
from chdstat.samples import Samples
from chdstat.studies.claims import FINDINGS, Finding, SceneData
from chdstat.studies.outcomes import plain

__all__ = ["ACROSS", "SceneStudy", "Study"]

ACROSS = "all scenes"
"""Name of the column of claims that compare scenes."""


@dataclass(frozen=True)
class SceneStudy:
    """What a study found in one scene.

    Attributes
    ----------
    evidence
        Samples, regions, analysis and what they were compared with.
    findings
        On every claim about a single scene, in their order.
    repeated
        Verdict of another seed by number of the claim, where there is one.
    chosen
        Whether the library chose the regions.
    atlas
        Shapes that recur; None where no pixel has one.
    again
        Samples of the other seed; None without.
    seconds
        Time of each part of the work, in s.
    notes
        What could not be done, and why.
    """

    evidence: SceneData
    findings: tuple[Finding, ...]
    repeated: Mapping[int, str] = field(default_factory=dict)
    chosen: bool = False
    atlas: Atlas | None = None
    again: Samples | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of the scene."""
        return self.evidence.name

    @property
    def comparison(self) -> Comparison | None:
        """Estimators side by side; None where the samples cannot judge them."""
        return self.evidence.comparison

    @cached_property
    def overview(self) -> Overview:
        """The scene in a few numbers."""
        return overview(self.evidence.analysis)

    def to_dict(self) -> dict[str, Any]:
        """Return everything but arrays, ready for JSON."""
        return {
            "scene": self.name,
            "regions": [plain(vars(region)) for region in self.evidence.regions],
            "regions_chosen_by_library": self.chosen,
            "overview": self.overview.to_dict(),
            "findings": [
                {**f.to_dict(), "verdict_of_another_seed": self.repeated.get(f.number)}
                for f in self.findings
            ],
            "renders": {name: _told(samples) for name, samples in self._renders().items()},
            "seconds": plain(self.seconds),
            "notes": list(self.notes),
        }

    def _renders(self) -> dict[str, Samples]:
        found = {
            "image": self.evidence.samples,
            "shorter_paths": self.evidence.shorter,
            "another_integrator": self.evidence.integrator,
            "another_seed": self.again,
        }
        return {name: samples for name, samples in found.items() if samples is not None}


def _told(samples: Samples) -> dict[str, Any]:
    """Return the provenance of samples, ready for JSON."""
    known = (str, bool, int, float, list, tuple, Mapping)
    attrs = {k: plain(v) for k, v in samples.attrs.items() if isinstance(v, known)}
    return {**attrs, "shape": list(samples.shape), "store": samples.path and str(samples.path)}


@dataclass(frozen=True)
class Study:
    """What a study found.

    Attributes
    ----------
    scenes
        One by one, in the order given.
    across
        Findings on claims that compare scenes.
    provenance
        Versions of what was used, and the time of the whole, in s.
    """

    scenes: tuple[SceneStudy, ...]
    across: tuple[Finding, ...]
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the scenes."""
        return tuple(scene.name for scene in self.scenes)

    def finding(self, number: int, scene: str | None = None) -> Finding | None:
        """Return what was found on a claim, in a scene or, without one, in all of them."""
        found = self.across
        if scene is not None:
            found = next((s.findings for s in self.scenes if s.name == scene), ())
        return next((f for f in found if f.number == number), None)

    def table(self) -> list[dict[str, str]]:
        """Return verdicts, a row for each claim: its number and name, and a column for each scene.

        A claim that compares scenes has its verdict in the column "all scenes"; what was not
        asked is an empty string.
        """
        rows = []
        for claim in FINDINGS:
            row = {"number": str(claim.number), "claim": claim.name}
            for column in (*self.names, None):
                found = self.finding(claim.number, column)
                row[column or ACROSS] = "" if found is None else found.verdict
            rows.append(row)
        return rows

    def to_dict(self) -> dict[str, Any]:
        """Return everything but arrays, ready for JSON; what is not finite is None."""
        return {
            "provenance": plain(self.provenance),
            "table": self.table(),
            "across": [f.to_dict() for f in self.across],
            "scenes": [scene.to_dict() for scene in self.scenes],
        }

    def save_json(self, path: str | Path) -> Path:
        """Write `to_dict` to a file; an earlier one is replaced when the new one is complete.

        Raises
        ------
        InputError
            If the path does not end in .json, or nothing can be written there.
        StoreError
            If it cannot be written.
        """
        target = checked_target(path, ".json")
        text = json.dumps(self.to_dict(), indent=1, ensure_ascii=False, allow_nan=False)
        try:
            with replacing(target) as partial:
                partial.write_text(text + "\n", encoding="utf-8")
        except OSError as error:
            message = f"cannot write {target}: {error.strerror or error}"
            raise StoreError(message) from error
        return target

    def save_pdf(self, path: str | Path) -> Path:
        """Typeset the study.

        Raises
        ------
        InputError
            If the path does not end in .pdf, or nothing can be written there.
        ChdstatError
            If it cannot be typeset or written.
        """
        from chdstat.reporting.study_report import save_pdf

        return save_pdf(self, checked_target(path, ".pdf"))
