"""Repeat the paper's experiment; write the pictures and tables of the page on its figures.

    python tools/make_paper_pictures.py FOLDER [--quick]

FOLDER keeps renders and networks, and is resumed: half an hour, minutes with --quick. Into
docs/understand/paper/ go one WebP file for each figure, numbers.csv and errors.csv.
"""

from __future__ import annotations

import csv
import io
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from PIL import Image

from chdstat.reporting.paper_report import FIGURES, paper_document
from chdstat.studies import paper

OUT = Path(__file__).parents[1] / "docs" / "understand" / "paper"
DPI = 130
QUALITY = 80
COLUMNS = {
    "numbers": {"section": "section", "paper": "the paper", "what": "measured", "here": "here"},
    "errors": {
        "scene": "scene",
        "network": "network",
        "judged": "judged",
        "mse": "squared error",
        "relmse": "relative",
        "improved": "improved",
        "fireflies": "fireflies left",
    },
}


def write(name: str, rows: Sequence[Mapping[str, str]]) -> None:
    """Write some columns of a table."""
    with (OUT / f"{name}.csv").open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(COLUMNS[name].values())
        table.writerows([row[column] for column in COLUMNS[name]] for row in rows)


def main() -> None:
    """Write all files."""
    folder, quick = Path(sys.argv[1]), "--quick" in sys.argv[2:]
    document = paper_document(paper(folder, quick=quick))
    OUT.mkdir(exist_ok=True)
    for name, figure in document.figures.items():
        drawn = io.BytesIO()
        figure.savefig(drawn, format="png", dpi=DPI)
        file = OUT / f"{name.lower()}.webp"
        Image.open(drawn).convert("RGB").save(file, quality=QUALITY, method=6)
        sys.stdout.write(f"{file.name:32} {file.stat().st_size / 1000:.0f} KB\n")
    for name in COLUMNS:
        write(name, document.content[name])
    sys.stdout.write(f"{len(document.figures)} figures of {len(FIGURES)} kinds\n")


if __name__ == "__main__":
    main()
