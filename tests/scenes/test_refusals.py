"""What Mitsuba refuses is said in words: where it is, what is wrong, and what to do."""

from __future__ import annotations

import re

import pytest

import chdstat as chd
from chdstat.errors import ChdstatError, SceneError

SENSOR = (
    '<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="2"/>{}</film>'
    "{}</sensor>"
)
SCENE = '<scene version="3.0.0">\n{}\n{}\n</scene>\n'


def written(tmp_path, part: str, film: str = "", sampler: str = ""):
    path = tmp_path / "room.xml"
    path.write_text(SCENE.format(SENSOR.format(film, sampler), part), encoding="utf-8")
    return path


def said(scene, **options) -> str:
    """Return what is said of a scene that is refused."""
    with pytest.raises(ChdstatError) as refused:
        chd.render(scene, spp=1, size=(2, 2), backend="scalar", progress=False, **options)
    return str(refused.value)


def of_file(plugin: str, name: str) -> str:
    return f'<shape type="{plugin}"><string name="filename" value="{name}"/></shape>'


def of_bsdf(kind: str, inside: str) -> str:
    return f'<shape type="sphere"><bsdf type="{kind}">{inside}</bsdf></shape>'


@pytest.mark.parametrize(
    ("part", "words"),
    [
        ('<bsdf type="difuse"/>', "Mitsuba has no bsdf 'difuse'; did you mean 'diffuse'?"),
        ('<integrator type="pathh"/>', "no integrator 'pathh'; did you mean 'path'?"),
        (
            '<integrator type="sppm"/>',
            "no integrator 'sppm'; give another integrator, such as path",
        ),
        (of_bsdf("diffuse", '<float name="ior" value="1"/>'), "'diffuse' takes no ior; correct"),
        (of_file("ply", "a.ply"), "names a file that cannot be found: a.ply; put them"),
        (
            of_file("obj", "a.obj") + of_file("obj", "b.obj"),
            "2 files that cannot be found: a.obj, b",
        ),
        (
            '<texture type="bitmap"><string name="filename" value="a.png"/></texture>',
            "found: a.png",
        ),
        (of_bsdf("conductor", '<string name="material" value="Auu"/>'), "no material 'Auu'"),
        ('<float name="a" value="$b"/>', "its parameter 'b' has no value; give one"),
        ('<include filename="no.xml"/>', 'included file "no.xml" not found; correct it there'),
        ("<nonsense/>", "unsupported XML element: <nonsense>; correct it there"),
    ],
)
def test_what_is_refused_is_said_in_words(tmp_path, part, words):
    found = said(written(tmp_path, part))
    assert words in found
    assert "(room.xml, line 3)" in found
    assert not re.search(r"\.cpp|\[\w+\] |\.h:", found)


def test_names_that_are_nearly_right_are_suggested(tmp_path):
    path = written(tmp_path, "")
    with pytest.raises(SceneError, match="'room.xml'"):
        chd.load_scene(path.with_name("rom.xml"))
    with pytest.raises(SceneError, match="no folder"):
        chd.load_scene(tmp_path / "nowhere" / "room.xml")
    with pytest.raises(SceneError, match="depht"):
        chd.load_scene(path, depht=3).load()


def test_replaced_films_may_be_unknown(tmp_path):
    options = {"spp": 1, "size": (2, 2), "backend": "scalar", "progress": False}
    sampler = '<sampler type="sobol"><integer name="seed" value="3"/></sampler>'
    path = written(tmp_path, '<emitter type="constant"/>', sampler=sampler)
    samples = chd.render(path, **options)
    assert samples.attrs["notes"][-1].startswith("the scene asks for the sobol sampler")
    film = '<boolean name="high_quality_edges" value="true"/><rfilter type="lanczos7"/>'
    samples = chd.render(written(tmp_path, '<emitter type="constant"/>', film=film), **options)
    assert samples.attrs["notes"][0] == "the film's high_quality_edges: not used"
    assert samples.attrs["notes"][1].startswith("the scene asks for the lanczos7 filter")
    assert samples.read().tolist() == chd.render(path, **options).read().tolist()
