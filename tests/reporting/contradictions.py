"""Reads reports: which of their words their own numbers contradict.

Nothing here knows how the sentences are made: they are read as a reader reads them, and each is
held against the intervals beside it. `contradictions` returns what does not agree.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from math import floor, inf, log10
from typing import Any

NUMBER = r"[−+]?(?:[\d,]*\.?\d+(?:e[−+]?\d+)?|∞)"
SHOWN = re.compile(rf"({NUMBER})( %)? \[({NUMBER})(?: %)?, ({NUMBER})(?: %)?\]")
ABOUT = re.compile(rf"about ({NUMBER}) (?:spp|samples)(?:, ({NUMBER}) (?:to ({NUMBER})|or more))?")
ERROR = re.compile(rf"its (squared|relative squared) error is {SHOWN.pattern} times the mean's")
SIGN = "▲"


def value(text: str) -> float:
    """Return a number as it is written."""
    return float(text.replace(",", "").replace("−", "-").replace("∞", "inf"))


def last_place(text: str) -> float:
    """Return the place of the last digit that is written; of a whole number, of the last not 0."""
    mantissa, _, exponent = text.replace(",", "").strip("−+").partition("e")
    power = 10.0 ** (int(exponent.replace("−", "-")) if exponent else 0)
    if "." in mantissa:
        return power * 10.0 ** -len(mantissa.partition(".")[2])
    return power * 10.0 ** (len(mantissa) - len(mantissa.rstrip("0")))


def digits_of(text: str) -> str:
    """Return the digits of a number, without zeros at its ends; one digit is always shown."""
    return re.sub("[−+.,]|e.*", "", text).strip("0")


def unsupported(text: str) -> Iterator[str]:
    """Yield the intervals of a text that lie beside their value, or do not support its digits."""
    for found in SHOWN.finditer(text):
        written = found[1], found[3], found[4]
        middle, low, high = map(value, written)
        if not low <= middle <= high:
            yield f"{found[0]}: the value lies outside of its interval"
        # Two digits of half of the interval, and one more if an end lies near 1.
        most = (high - low) / 2 * (0.01 if min(abs(low - 1), abs(high - 1)) < 0.1 else 0.1)
        least = 10.0 ** floor(log10(most)) if most > 0 else 0.0
        finest = min(last_place(n) if len(digits_of(n)) > 1 else inf for n in written)
        if not found[2] and finest < 0.99 * least:
            yield f"{found[0]}: more digits than the interval supports"
    for found in ABOUT.finditer(text):
        middle, low = value(found[1]), value(found[2] or found[1])
        high = value(found[3]) if found[3] else inf if found[2] else middle
        if not 0.9 * low <= middle <= 1.1 * high:
            yield f"{found[0]}: the value lies outside of its range"
        digits = digits_of(found[1])
        if high > 2 * low and len(digits) > 1 and digits[1:] != "5":
            yield f"{found[0]}: more digits than the range supports"


def verdict_contradicted(finding: str, because: str) -> Iterator[str]:
    """Yield what a sentence on an estimator says of its errors that their intervals do not."""
    ends = {"relative" if "relative" in f[1] else "squared": (value(f[4]), value(f[5]))
            for f in ERROR.finditer(because)}  # fmt: skip
    said = {verb: set(re.findall("squared|relative", words))
            for verb, words in re.findall(r"(lowers|raises) the (.*?) error", finding)}  # fmt: skip
    for name, (low, high) in ends.items():
        is_lower, is_higher = high < 1, low > 1
        if is_lower != (name in said.get("lowers", ())):
            yield f"{finding}: the {name} error is [{low}, {high}]"
        if is_higher != (name in said.get("raises", ())):
            yield f"{finding}: the {name} error is [{low}, {high}]"
        if "not help measurably" in finding and not (0.89 < low <= 1 <= high):
            yield f"{finding}: the {name} error is [{low}, {high}]"
    for name in {*said.get("lowers", ()), *said.get("raises", ())} - {*ends}:
        yield f"{finding}: no interval of the {name} error"
    if re.search(r"\bhelps\b(?! cannot)", finding):
        yield f"{finding}: helps whom, by which error?"


def signs_contradicted(cell: str) -> Iterator[str]:
    """Yield cells of errors whose sign is not that of their interval."""
    for found in SHOWN.finditer(cell):
        if (value(found[3]) > 1) != (SIGN in cell):
            yield f"{cell}: the sign"
    if SIGN in cell and not SHOWN.search(cell):
        yield f"{cell}: a sign without an interval"


def largest_contradicted(finding: str, rows: list[Mapping[str, str]]) -> Iterator[str]:
    """Yield where a pattern is said to hold most of the noise that does not."""
    shares = {row["name"]: value(row["share"].replace("< ", "").split("\N{NO-BREAK SPACE}")[0])
              for row in rows}  # fmt: skip
    if "largest part of the noise is in" in finding and shares:
        most = max(shares, key=shares.__getitem__)
        if most not in finding:
            yield f"{finding}: {most} has {shares[most]} %"


def contradictions(content: Mapping[str, Any]) -> list[str]:
    """Return what does not agree in the headlines, the key figures and the tables of a report."""
    plain = {"\N{NO-BREAK SPACE}": " "}
    found: list[str] = []

    def read(text: str) -> str:
        return text.translate(str.maketrans(plain))

    noise, estimators = content.get("noise", []), content.get("estimators", {}).get("rows", [])
    for row in content["findings"]:
        finding, because = read(row["finding"]), read(row["because"])
        found += [*unsupported(finding), *unsupported(because)]
        if ERROR.search(because):
            found += verdict_contradicted(finding, because)
        found += largest_contradicted(finding, noise)
        for wanted in re.findall(r"error of ([\d.]+) % you need", finding):
            low = re.search(rf"relMSE, of {SHOWN.pattern}", because)
            if low is None or value(low[3]) < float(wanted):
                found.append(f"{finding}: the samples may reach that already")
    cells = [read(row["estimate"]) for row in noise]
    cells += [read(row[name]) for row in estimators for name in ("mse_ratio", "relmse_ratio")]
    for cell in cells:
        found += [*unsupported(cell), *signs_contradicted(cell)]
    others = [row["share"] for row in noise] + [row["bias"] for row in estimators]
    shapes = content.get("shapes") or {}
    others += [row["share"] for part in ("bodies", "gaussian") for row in shapes.get(part, ())]
    found += [words for cell in others for words in unsupported(read(cell))]
    worse = {row["name"] for row in noise if SIGN in row["estimate"]}
    told = " ".join(row["finding"] for row in content["findings"] if "raises the" in row["finding"])
    found += [f"no headline says that the estimate is worse in {n}" for n in worse if n not in told]
    for figure in content["key_figures"]:
        ends = re.fullmatch(rf"({NUMBER})(?: %)? to ({NUMBER})(?: %)?", read(figure["interval"]))
        middle = re.match(NUMBER, read(figure["value"]))
        if ends and middle and not value(ends[1]) <= value(middle[0]) <= value(ends[2]):
            found.append(f"{figure}: the value lies outside of its interval")
    return found
