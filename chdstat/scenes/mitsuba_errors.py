"""Mitsuba's errors about a scene, in words that say what to do.

Mitsuba's texts name lines of its own source. What is wrong, and where in the scene, is taken from
them; a name that Mitsuba does not have is compared with those that it has.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from chdstat.errors import brief, did_you_mean
from chdstat.scenes.plugins import known_names
from chdstat.scenes.settings import GUIDED

_MARK = re.compile(r"(?<!\S)\[(?:\w+\.(?:cpp|h):\d+|[A-Z]\w*)\]\s*")
"""Where in Mitsuba's source an error was raised."""
_PLACE = re.compile(
    r"(?:While loading|Error while loading|At) "
    r"(?:dictionary node \"(?P<node>[^\"]*)\"|(?P<file>.+?) \(line (?P<line>\d+), col \d+\)): "
)
"""Where in the scene it is."""
_NO_FILE = re.compile(r"\bnot found\b|does not exist|No such file")
_SHOWN = 5
"""Names of missing files that are shown."""
_LONGEST = 200
"""Letters of a name that are shown."""


def in_words(error: BaseException, missing: Sequence[str] = ()) -> str:
    """Return what an error says: its place in the scene, what is wrong, and what to do.

    Parameters
    ----------
    error
        Mitsuba's error.
    missing
        Files that the scene names and that are not there.

    Examples
    --------
    >>> text = '[a.cpp:1] At s.xml (line 3, col 5): failed to instantiate bsdf plugin of type '
    >>> in_words(RuntimeError(text + '"difuse": [PluginManager] Plugin "difuse" not found!'))
    " (s.xml, line 3): Mitsuba has no bsdf 'difuse'; did you mean 'diffuse'?"
    """
    why, place = _MARK.sub("", " ".join(str(error).split())), ""
    for found in _PLACE.finditer(why):  # the last one is that of an included file
        place = f" ({Path(found['file']).name}, line {found['line']})" if found["file"] else ""
        place = place or ("" if found["node"] == "root" else f" (at {found['node']!r})")
    why = _PLACE.split(why)[-1]
    for pattern, words in _CAUSES:
        if match := pattern.search(why):
            return f"{place}: {words(match)}"
    if missing and _NO_FILE.search(why):
        return f"{place}: {_of_files(missing)}"
    why = brief(RuntimeError(why)) if why else brief(error)
    return f"{place}: {why.rstrip('.!')}; correct {'it there' if place else 'the scene'}"


def _of_plugin(match: re.Match[str]) -> str:
    kind, name = match["kind"], match["name"]
    kind = "plugin" if kind == "unknown" else kind
    advice = "; correct the name, or load the plugin that registers it"
    if kind == "integrator":
        advice = "; give another integrator, such as path, or load the plugin that registers it"
    near = did_you_mean(name, {*known_names(), *GUIDED})
    return f"Mitsuba has no {kind} {name!r}{near or advice}"


def _of_properties(match: re.Match[str]) -> str:
    names = ", ".join(re.findall(r"- \w+ \"([^\"]+)\"", match["list"]))
    return f"the {match['kind']} {match['name']!r} takes no {names}; correct the name or remove it"


def _of_parameter(match: re.Match[str]) -> str:
    name = match["name"]
    return (
        f"its parameter {name!r} has no value; give one: load_scene(file, {name}=...), or on the "
        f"command line -D {name}=VALUE"
    )


def _of_unused(match: re.Match[str]) -> str:
    names = ", ".join(re.findall(r"\$(\w+)", match["list"]))
    return f"the scene has no parameter {names}; leave it out, or correct the name"


def _of_metal(match: re.Match[str]) -> str:
    import mitsuba

    tables = Path(str(mitsuba.__file__)).parent.glob("data/ior/*.eta.spd")
    near = did_you_mean(match["name"], [table.name.split(".")[0] for table in tables])
    return f"Mitsuba has no material {match['name']!r}{near or '; give one of its metals'}"


def _of_files(missing: Sequence[str]) -> str:
    names = (n if len(n) <= _LONGEST else f"...{n[3 - _LONGEST :]}" for n in missing[:_SHOWN])
    shown = ", ".join(names)
    more = f" and {len(missing) - _SHOWN} more" if len(missing) > _SHOWN else ""
    files = "a file" if len(missing) == 1 else f"{len(missing)} files"
    return (
        f"it names {files} that cannot be found: {shown}{more}; put them where the scene names "
        "them, or correct the names"
    )


_CAUSES: Sequence[tuple[re.Pattern[str], Callable[[re.Match[str]], str]]] = (
    (
        re.compile(
            r"failed to instantiate (?P<kind>\w+) plugin of type \"(?P<name>.*?)\": "
            r"Plugin \"(?P=name)\" not found"
        ),
        _of_plugin,
    ),
    (
        re.compile(
            r"unreferenced propert\w+ in (?P<kind>\w+) plugin of type \"(?P<name>.*?)\":"
            r"(?P<list>.*)"
        ),
        _of_properties,
    ),
    (re.compile(r"undefined parameter: \$(?P<name>\w+)"), _of_parameter),
    (re.compile(r"unused parameter\w*:?(?P<list>.*)"), _of_unused),
    (re.compile(r"\"data/ior/(?P<name>.+?)\.\w+\.spd\": file does not exist"), _of_metal),
)
