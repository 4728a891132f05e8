"""Summary of a session: what its render tests found, and what they would have found."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from chdstat._core.display import number, percent
from chdstat.render_tests.verdicts import RenderVerdict

_OF_UPDATES = ("written", "replaced", "kept")


def lines_of(verdicts: Sequence[RenderVerdict], alpha: float, *, verbose: bool) -> Iterator[str]:
    """Yield lines for the terminal: one on all tests, one for each reference of an update.

    If `verbose`, a row for each test, too.
    """
    compared = [v for v in verdicts if v.outcome not in _OF_UPDATES]
    if compared:
        yield headline(compared, alpha)
    for verdict in verdicts:
        if verdict.outcome in _OF_UPDATES:
            yield f"{verdict.outcome}: {verdict.name}: {verdict.sentence}"
    if verbose and compared:
        yield ""
        yield from _table(compared)


def headline(verdicts: Sequence[RenderVerdict], alpha: float) -> str:
    """Return one sentence on all tests; the losses are those of tests that pass.

    Examples
    --------
    >>> one = RenderVerdict("box", "t.py::box", 0.005, "no difference found", "", image=0.004)
    >>> headline([one], 0.01).replace(chr(160), " ")
    '1 render test: none differs. Any false alarm: at most 1.0 %. Smallest loss found: 0.4 %'
    """
    kinds = {
        "differ": [v for v in verdicts if v.outcome in ("differ", "bad pixels")],
        "cannot tell": [v for v in verdicts if v.outcome == "cannot tell"],
        "too weak": [v for v in verdicts if v.outcome == "too weak"],
        "refused": [v for v in verdicts if v.outcome == "refused"],
    }
    failed = [f"{len(found)} {name}" for name, found in kinds.items() if found]
    failed = ["1 differs" if text == "1 differ" else text for text in failed]
    what = ", ".join(failed) if failed else "none differs"
    said = f"{_counted(len(verdicts))}: {what}. Any false alarm: at most {percent(alpha)}"
    losses = [v.image for v in verdicts if v.passed and v.image is not None]
    if not losses:
        return said
    ends = [percent(value) for value in (min(losses), max(losses))]
    span = ends[0] if ends[0] == ends[1] else f"{ends[0]} to {ends[1]}"
    return f"{said}. Smallest loss found: {span}"


def _counted(count: int) -> str:
    return f"{count} render test{'s' * (count != 1)}"


def _table(verdicts: Sequence[RenderVerdict]) -> Iterator[str]:
    """Yield rows: name, verdict, samples, p-value, smallest losses."""
    rows: list[tuple[str, ...]] = [
        ("test", "verdict", "spp", "p", "loss found in image", "in a tenth")
    ]
    for v in verdicts:
        losses = (percent(x) if x is not None else "" for x in (v.image, v.tenth))
        p = "" if v.p_value is None else number(v.p_value)
        rows.append((v.name, v.outcome, str(v.spp or ""), p, *losses))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        yield "  ".join(f"{text:{w}}" for text, w in zip(row, widths, strict=True)).rstrip()
