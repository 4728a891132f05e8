"""EXR files: what is written comes back; windows, names, colours and kinds of channels of others.

What is of other programs is used, told, or refused.
"""

import warnings

import numpy as np
import OpenEXR
import pytest

import chdstat as chd
from chdstat.errors import InputError, InputWarning, StoreError
from chdstat.io import read_exr, write_exr
from tests.io.writers import deep, exr, planes_of, window

RNG = np.random.default_rng(2)
IMAGE = RNG.gamma(2.0, size=(11, 14, 3)).astype(np.float32)
REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
AP0 = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
AP1 = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
P3 = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290)
REC2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)
# Matrices to linear Rec. 709. ACES: OpenColorIO 2.4, built-in "ACES-AP0_to_CIE-XYZ-D65_BFD" and
# "ACES-AP1_to_CIE-XYZ-D65_BFD", then "CIE-XYZ-D65_to_REC.709". Rec. 2020: ITU-R BT.2407-0, section
# 2.2. P3: Lindbloom's method, as in colour-science 0.4.
MATRICES = {
    AP0: [[2.5217, -1.1341, -0.3876], [-0.2765, 1.3727, -0.0962], [-0.0154, -0.1530, 1.1684]],
    AP1: [[1.7051, -0.6218, -0.0833], [-0.1303, 1.1408, -0.0105], [-0.0240, -0.1290, 1.1530]],
    REC2020: [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]],
    P3: [[1.2249, -0.2249, 0.0], [-0.0421, 1.0421, 0.0], [-0.0196, -0.0786, 1.0983]],
}


def image(shape=(5, 7, 3), seed=0):
    return np.random.default_rng(seed).lognormal(0, 3, size=shape).astype(np.float32)


def channels_of(path):
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: channel.pixels for name, channel in file.channels().items()}


# --- what comes back ------------------------------------------------------------------------------


def test_what_is_written_is_read_back_to_the_bit(tmp_path):
    x = image()
    x[0, 0], x[1, 1, 0], x[2, 2, 2] = np.nan, np.inf, 1e-45
    extra = {
        "certainty": image((5, 7), 1),
        "low": image(seed=2),
        "light.high": image(seed=3),
        "number": np.arange(35, dtype=np.uint32).reshape(5, 7) + 2**31,
    }
    attributes = {"comment": "Grüße, 日本", "empty": "", "store": "a\nb"}
    path = write_exr(tmp_path / "x.exr", x, extra=extra, attributes=attributes)
    found = read_exr(path)
    np.testing.assert_array_equal(found.image, x)
    assert found.channels == ("R", "G", "B")
    assert found.extra.keys() == extra.keys()
    for name, layer in extra.items():
        np.testing.assert_array_equal(found.extra[name], layer)
        assert found.extra[name].dtype == layer.dtype
    assert found.attributes == attributes
    with OpenEXR.File(str(path)) as file:
        header = file.header()
        assert header["chromaticities"][:2] == pytest.approx((0.64, 0.33))
        for name in ("dataWindow", "displayWindow"):
            assert np.array_equal(header[name], window(0, 0, 6, 4))
    names = {*"RGB", *("low.R", "low.G", "low.B"), *("light.high." + c for c in "RGB")}
    assert channels_of(path).keys() == {*names, "certainty", "number"}


@pytest.mark.parametrize(("count", "names"), [(1, ("Y",)), (3, ("R", "G", "B")), (2, ("u", "v"))])
def test_channels_have_usual_names_or_those_given(tmp_path, count, names):
    x = image((4, 3, count))
    given = None if count in (1, 3) else names
    path = write_exr(tmp_path / "x.exr", x, channels=given, extra={"low": x})
    for found in (read_exr(path, channels=given), read_exr(path)):
        assert found.channels == names
        np.testing.assert_array_equal(found.image, x)
        np.testing.assert_array_equal(found.extra["low"], x)


@pytest.mark.parametrize("said", ["", "u", '["u", "w"]', "[[]]", "3", "{}"])
def test_a_header_that_names_no_channels_is_ignored(tmp_path, said):
    planes = planes_of(image((4, 3, 3)))
    path = exr(tmp_path / "x.exr", planes, imageChannels=said)
    assert read_exr(path).channels == ("R", "G", "B")


def test_half_layers_stay_half(tmp_path):
    x = image()
    path = write_exr(tmp_path / "x.exr", x, extra={"one": x[..., 0].astype(np.float16)})
    assert channels_of(path)["one"].dtype == np.float16
    assert channels_of(path)["R"].dtype == np.float32


@pytest.mark.parametrize(
    "arrange",
    [np.asfortranarray, lambda x: np.ascontiguousarray(x[::-1])[::-1], lambda x: x.astype(">f4")],
)
def test_the_order_in_memory_does_not_matter(tmp_path, arrange):
    x = image()
    path = write_exr(tmp_path / "x.exr", arrange(x), extra={"one": arrange(x[..., 0])})
    np.testing.assert_array_equal(read_exr(path).image, x)
    np.testing.assert_array_equal(read_exr(path).extra["one"], x[..., 0])


def test_half_keeps_eleven_bits(tmp_path):
    x = np.clip(image(), 1e-3, 6e4)
    path = write_exr(tmp_path / "x.exr", x, pixel_type="half", extra={"one": x[..., 0]})
    assert {plane.dtype for plane in channels_of(path).values()} == {np.dtype(np.float16)}
    found = read_exr(path)
    assert found.image == pytest.approx(x, rel=2**-11)
    assert found.image.dtype == found.extra["one"].dtype == np.float32


# --- files of others ------------------------------------------------------------------------------


def test_channels_of_lower_resolution_are_refused(tmp_path):
    x = image()[:4, :6, 0].copy()
    path = exr(tmp_path / "x.exr", {"Y": x, "Q": OpenEXR.Channel("Q", x, 2, 2)})
    with pytest.raises(StoreError, match=r"'Q'.*\(4, 6\)"):
        read_exr(path, channels=["Q"])
    with pytest.warns(InputWarning, match="'Q' is left out, for it is of a resolution of its own"):
        np.testing.assert_array_equal(read_exr(path).image[..., 0], x)


# --- files that are none --------------------------------------------------------------------------


# --- writing as a whole or not at all -------------------------------------------------------------


def test_chromaticities_of_an_unknown_kind_are_told(tmp_path):
    path = write_exr(tmp_path / "x.exr", np.ones((4, 5, 3)))
    kind = b"chromaticities\0chromaticities\0"
    content = path.read_bytes()
    assert content.count(kind) == 1
    path.write_bytes(content.replace(kind, b"chromaticities\0chromaticitie?\0"))
    assert "taken for linear Rec. 709" in told(path)[1]


def told(path, **options):
    """Read an image, and return it with what was told of it."""
    with warnings.catch_warnings(record=True, action="always") as caught:
        found = read_exr(path, **options)
    assert {w.category for w in caught} <= {InputWarning}
    assert {w.filename for w in caught} <= {__file__}
    return found, " | ".join(str(w.message) for w in caught)


# --- windows --------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [OpenEXR.scanlineimage, OpenEXR.tiledimage])
@pytest.mark.parametrize("origin", [(0, 0), (5, -3)])
@pytest.mark.parametrize("data", [(0, 0, 13, 10), (2, 3, 9, 4), (13, 10, 13, 10)])
def test_a_frame_lies_in_its_display_window(tmp_path, kind, origin, data):
    left, top, right, bottom = data
    x, y = origin
    part = IMAGE[top : bottom + 1, left : right + 1]
    header = {
        "dataWindow": window(left + x, top + y, right + x, bottom + y),
        "displayWindow": window(x, y, x + 13, y + 10),
    }
    path = exr(tmp_path / "x.exr", planes_of(part), kind=kind, **header)
    found, said = told(path)
    expected = np.zeros_like(IMAGE)
    expected[top : bottom + 1, left : right + 1] = part
    np.testing.assert_array_equal(found.image, expected)
    assert not said


def test_a_frame_of_any_compression_is_read(tmp_path):
    smooth = np.linspace(0.1, 1, 64 * 48 * 3).reshape(64, 48, 3).astype(np.float32)
    lossy = ("PXR24", "B44", "DWA", "LJ2K")
    for name, compression in OpenEXR.Compression.__members__.items():
        if not name.startswith(("NUM", "LAST")):
            exr(tmp_path / "x.exr", planes_of(smooth), compression=compression)
            bound = 0.02 if name.startswith(lossy) else 0
            found = read_exr(tmp_path / "x.exr").image
            np.testing.assert_allclose(found, smooth, rtol=bound, err_msg=name)


@pytest.mark.parametrize("data", [(-2, -3, 15, 12), (-2, 0, 13, 10), (4, 4, 17, 8)])
def test_what_lies_outside_the_window_is_cut(tmp_path, data):
    left, top, right, bottom = data
    whole = RNG.random((20, 24, 3)).astype(np.float32)  # its pixel (5, 5) is the first displayed
    part = whole[top + 5 : bottom + 6, left + 5 : right + 6]
    header = {"dataWindow": window(*data), "displayWindow": window(0, 0, 13, 10)}
    path = exr(tmp_path / "x.exr", planes_of(part), **header)
    found, said = told(path)
    expected = np.zeros_like(IMAGE)
    inside = np.s_[max(top, 0) : min(bottom, 10) + 1, max(left, 0) : min(right, 13) + 1]
    expected[inside] = whole[5:16, 5:19][inside]
    np.testing.assert_array_equal(found.image, expected)
    assert "pixels outside of its display window" in said


def test_parts_have_windows_of_their_own(tmp_path):
    shown = {"displayWindow": window(-1, -1, 12, 9)}
    depth = {"Z": np.full((3, 4), 7, np.float32)}
    path = exr(
        tmp_path / "x.exr",
        planes_of(IMAGE[:5, :6]),
        (depth, shown | {"dataWindow": window(2, 1, 5, 3), "name": "depth"}),
        **(shown | {"dataWindow": window(-1, -1, 4, 3)}),
    )
    found, said = told(path)
    assert found.image.shape == (11, 14, 3)
    np.testing.assert_array_equal(found.image[:5, :6], IMAGE[:5, :6])
    assert not found.image[5:].any()
    assert not found.image[:, 6:].any()
    assert found.extra["depth.Z"].sum() == 7 * 12
    assert (found.extra["depth.Z"][2:5, 3:7] == 7).all()
    assert not said


def stack(folder, places, *, shown=(0, 0, 31, 31), aov=False):
    """Write frames of which each has a light of 100 at (12, 12), by data windows of their own."""
    for number, (left, top) in enumerate(places):
        frame = np.zeros((16, 16, 3), np.float32)
        frame[12 - top, 12 - left] = 100 + number
        header = {
            "dataWindow": window(left, top, left + 15, top + 15),
            "displayWindow": window(*shown),
        }
        planes = planes_of(frame) | (planes_of(frame / 200, prefix="albedo.") if aov else {})
        exr(folder / f"{number}.exr", planes, **header)
    return sorted(folder.glob("*.exr"))


def test_frames_of_a_stack_are_placed_by_their_windows(tmp_path):
    files = stack(tmp_path, [(0, 0), (4, 6), (12, 1)], aov=True)
    samples = chd.io.read(*files, features={"albedo": "albedo"})
    assert samples.shape == (32, 32, 3, 3)
    for number in range(3):
        lit = np.argwhere(samples.read()[..., 0, number])
        assert lit.tolist() == [[12, 12]]
    assert np.argwhere(samples.features["albedo"][..., 0]).tolist() == [[12, 12]]


def test_frames_of_other_display_windows_are_refused(tmp_path):
    first = stack(tmp_path, [(0, 0)])
    (tmp_path / "other").mkdir()
    for shown, match in (((0, 0, 31, 30), r"\(31, 32\) pixels"), ((1, 0, 32, 31), r"\(1, 0\)")):
        other = stack(tmp_path / "other", [(4, 4)], shown=shown)
        with pytest.raises(InputError, match=match):
            chd.io.read(*first, *other).read()


def test_feature_files_are_placed_too(tmp_path):
    header = {"dataWindow": window(1, 1, 6, 4), "displayWindow": window(0, 0, 13, 10)}
    vector = RNG.normal(size=(4, 6, 3)).astype(np.float32)
    other = header | {"chromaticities": AP1}
    files = {
        "position": exr(tmp_path / "p.exr", planes_of(vector, "XYZ"), **header),
        "normal": exr(tmp_path / "n.exr", planes_of(vector), **other),
        "depth": exr(tmp_path / "d.exr", {"Z": vector[..., 2].copy()}, **header),
    }
    found = chd.Samples.from_array(RNG.gamma(1.0, size=(11, 14, 3, 8)))
    np.save(tmp_path / "x.npy", found.read())
    features = chd.io.read(tmp_path / "x.npy", axes="yxcs", features=files).features
    for name, index in (("position", ...), ("normal", ...), ("depth", (..., 2))):
        np.testing.assert_array_equal(features[name][1:5, 1:7], vector[index])
        assert np.count_nonzero(features[name]) == vector[index].size


# --- names ----------------------------------------------------------------------------------------

COLOURS = [
    ("R", "G", "B"),
    ("r", "g", "b"),
    ("red", "green", "blue"),
    ("Red", "Green", "Blue"),
    ("beauty.R", "beauty.G", "beauty.B"),
    ("rgba.r", "rgba.g", "rgba.b"),
    ("View Layer.Combined.R", "View Layer.Combined.G", "View Layer.Combined.B"),
]


@pytest.mark.parametrize("names", COLOURS)
@pytest.mark.parametrize("more", [{}, {"A": 3}, {"Z": 2}, {"N.X": 0, "N.Y": 1, "N.Z": 2}])
def test_colours_are_found_by_their_names(tmp_path, names, more):
    planes = planes_of(IMAGE, names)
    path = exr(tmp_path / "x.exr", planes | {n: IMAGE[..., 0].copy() for n in more})
    found, said = told(path)
    np.testing.assert_array_equal(found.image, IMAGE)
    assert found.extra.keys() == more.keys()
    assert not said
    np.testing.assert_array_equal(chd.io.read(path).read()[..., 0], IMAGE)


@pytest.mark.parametrize("names", [n for n in COLOURS if "." in n[0]])
def test_alpha_of_a_layer_is_left_out(tmp_path, names):
    layer = names[0].rpartition(".")[0]
    other = planes_of(IMAGE + 1, prefix="direct.")
    planes = planes_of(IMAGE, names) | other | {f"{layer}.A": np.ones_like(IMAGE[..., 0])}
    path = exr(tmp_path / "x.exr", planes)
    with pytest.raises(InputError, match=layer):
        chd.io.read(path)
    np.testing.assert_array_equal(chd.io.read(path, variable=layer).read()[..., 0], IMAGE)
    np.testing.assert_array_equal(read_exr(path, channels=[layer]).image, IMAGE)


@pytest.mark.parametrize("channel", ["Z", "depth.Z"])  # of any program; of Blender
def test_a_part_is_a_layer_also_the_first(tmp_path, channel):
    path = exr(
        tmp_path / "x.exr",
        {channel: IMAGE[..., 0].copy()},
        (planes_of(IMAGE), {"name": "beauty"}),
        name="depth",
    )
    np.testing.assert_array_equal(chd.io.read(path).read()[..., 0], IMAGE)
    found = chd.io.read(path, variable="beauty", features={"depth": "depth"})
    np.testing.assert_array_equal(found.read()[..., 0], IMAGE)
    np.testing.assert_array_equal(found.features["depth"], IMAGE[..., 0])


@pytest.mark.parametrize("first", ["albedo", "beauty"])
def test_the_first_part_of_colours_is_told(tmp_path, first):
    images = np.random.default_rng(0).random((2, 4, 5, 3), dtype=np.float32)
    parts = [planes_of(image) for image in images]
    path = exr(tmp_path / "parts.exr", parts[0], (parts[1], {"name": "light"}), name=first)
    with warnings.catch_warnings(record=True, action="always") as told:
        assert (chd.io.read(path).read()[..., 0] == images[0]).all()
    assert [str(warning.message) for warning in told] == (first == "albedo") * [
        f"{path} has 2 parts of colours: the first, 'albedo', is taken for the image; give the "
        "layer of the samples as variable, one of light for another"
    ]
    with warnings.catch_warnings(action="error"):
        assert (chd.io.read(path, variable="light").read()[..., 0] == images[1]).all()


def test_xyz_is_colour_where_nothing_else_is(tmp_path):
    xyz = planes_of(IMAGE, "XYZ")
    alone = exr(tmp_path / "a.exr", xyz)
    found, said = told(alone)
    # IEC 61966-2-1:1999, amendment 1.
    to_xyz = np.array(
        [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    )
    np.testing.assert_allclose(found.image @ to_xyz.T, IMAGE, atol=2e-3)
    assert "X, Y and Z of CIE 1931" in said
    assert found.channels == ("R", "G", "B")
    named = read_exr(alone, channels=["X", "Y", "Z"])
    np.testing.assert_array_equal(named.image, IMAGE)
    beside = exr(tmp_path / "b.exr", xyz | planes_of(IMAGE + 1, prefix="beauty."))
    np.testing.assert_array_equal(told(beside)[0].image, IMAGE + 1)
    assert not told(beside)[1]
    several = xyz | planes_of(IMAGE, prefix="a.") | planes_of(IMAGE, prefix="b.")
    with pytest.raises(InputError, match="out of a, b"):
        read_exr(exr(tmp_path / "c.exr", several))


def test_numbers_of_objects_are_no_radiance(tmp_path):
    numbers = np.arange(154, dtype=np.uint32).reshape(11, 14)
    rgb = exr(tmp_path / "a.exr", dict.fromkeys("RGB", numbers))
    one = exr(tmp_path / "b.exr", {"id": numbers} | planes_of(IMAGE))
    only = exr(tmp_path / "c.exr", {"id": numbers})
    for path, options in ((rgb, {}), (one, {"variable": "id"}), (only, {})):
        with pytest.raises((StoreError, InputError), match="whole numbers"):
            chd.io.read(path, **options)
    assert read_exr(one).extra["id"].dtype == np.uint32
    np.testing.assert_array_equal(read_exr(one, channels=["id"]).image[..., 0], numbers)


def test_deep_and_small_channels_do_not_stop_others(tmp_path):
    about = {"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION, "name": "deep"}
    exr(tmp_path / "x.exr", planes_of(IMAGE), ({"Z": deep((11, 14))}, about))
    found, said = told(tmp_path / "x.exr")
    np.testing.assert_array_equal(found.image, IMAGE)
    assert "'deep.Z' is left out, for it is deep" in said
    with pytest.raises(StoreError, match=r"'deep\.Z'"):
        chd.io.read(tmp_path / "x.exr", features={"depth": "deep"})


# --- colours --------------------------------------------------------------------------------------


@pytest.mark.parametrize("primaries", MATRICES)
@pytest.mark.parametrize("names", ["RGB", "rgb"])
def test_colours_become_those_of_rec_709(tmp_path, primaries, names):
    path = exr(tmp_path / "x.exr", planes_of(IMAGE, names), chromaticities=primaries)
    found, said = told(path)
    expected = IMAGE @ np.array(MATRICES[primaries]).T
    np.testing.assert_allclose(found.image, expected, atol=1e-3)
    assert "converted to linear Rec. 709" in said
    white = np.ones_like(IMAGE)
    path = exr(tmp_path / "w.exr", planes_of(white), chromaticities=primaries)
    np.testing.assert_allclose(told(path)[0].image, 1, rtol=1e-5)


@pytest.mark.parametrize(
    ("header", "as_if"),
    [
        ({"chromaticities": REC709}, None),
        ({"chromaticities": tuple(v + 2e-4 for v in REC709)}, None),
        ({"colorInteropID": "lin_rec709_scene"}, None),
        ({"oiio:ColorSpace": "Linear"}, None),
        ({"colorInteropID": "lin_ap1_scene"}, AP1),
        ({"oiio:ColorSpace": "ACEScg"}, AP1),
        ({"colorSpace": "ACES2065-1"}, AP0),
        ({"arnold/color_space": "whatever"}, None),
        ({"acesImageContainerFlag": 1}, AP0),
        ({"acesImageContainerFlag": 1, "chromaticities": AP0}, AP0),
        ({"colorInteropID": "lin_ap1_scene", "chromaticities": P3}, P3),
    ],
)
def test_colours_are_known_by_what_programs_write(tmp_path, header, as_if):
    found, said = told(exr(tmp_path / "x.exr", planes_of(IMAGE), **header))
    expected = IMAGE if as_if is None else IMAGE @ np.array(MATRICES[as_if]).T
    np.testing.assert_allclose(found.image, expected, atol=1e-3 if as_if else 0)
    assert bool(said) == (as_if is not None)


@pytest.mark.parametrize(
    ("header", "match"),
    [
        ({"oiio:ColorSpace": "sRGB"}, "names the colour space 'sRGB'"),
        ({"colorInteropID": "srgb_rec709_scene"}, "'srgb_rec709_scene'"),
        ({"colorspace": "ARRI LogC4"}, "'ARRI LogC4'"),
        ({"chromaticities": REC709, "colorSpace": "ACEScg"}, "'ACEScg'"),
        ({"chromaticities": (0.0,) * 8}, "no chromaticities"),
        ({"chromaticities": (0.6, 0.3, 0.6, 0.3, 0.15, 0.06, 0.31, 0.33)}, "on a line"),
        ({"pixelAspectRatio": 2.0}, "2 times their height"),
    ],
)
def test_what_is_not_understood_is_told_and_kept(tmp_path, header, match):
    path = exr(tmp_path / "x.exr", planes_of(IMAGE), **header)
    found, said = told(path)
    np.testing.assert_array_equal(found.image, IMAGE)
    assert match in said
    with pytest.warns(InputWarning, match=match):
        chd.io.read(path)


def test_a_stack_that_mixes_primaries_is_brought_to_one(tmp_path):
    matrices = [np.array(MATRICES[p]) for p in (AP1, REC2020)] + [np.eye(3)]
    truth = RNG.gamma(2.0, size=(3, 11, 14, 3))
    for number, (primaries, matrix) in enumerate(
        zip((AP1, REC2020, REC709), matrices, strict=True)
    ):
        stored = (truth[number] @ np.linalg.inv(matrix).T).astype(np.float32)
        planes = planes_of(stored) | planes_of(stored, prefix="albedo.")
        planes |= planes_of(stored, prefix="n.")
        exr(tmp_path / f"{number}.exr", planes, chromaticities=primaries)
    features = {"albedo": "albedo", "normal": "n"}
    with pytest.warns(InputWarning, match="converted to linear Rec. 709") as caught:
        samples = chd.io.read(tmp_path, features=features)
    found = samples.read()
    assert len(caught) == 2  # one for each
    np.testing.assert_allclose(np.moveaxis(found, -1, 0), truth, atol=2e-3)
    np.testing.assert_allclose(samples.features["albedo"], truth.mean(axis=0), atol=2e-3)
    assert abs(samples.features["normal"] - truth.mean(axis=0)).max() > 0.1


def test_nulls_and_bad_samples_stay_what_they_are(tmp_path):
    image = IMAGE.copy()
    image[0], image[1, 1, 0] = 0, np.nan
    found = told(exr(tmp_path / "x.exr", planes_of(image), chromaticities=AP1))[0].image
    assert not found[0].any()
    assert np.isnan(found[1, 1]).all()
    assert np.isfinite(np.delete(found.reshape(-1, 3), 15, axis=0)).all()


def test_grey_has_no_primaries(tmp_path):
    planes = {"Y": IMAGE[..., 0].copy()}
    found, said = told(exr(tmp_path / "x.exr", planes, chromaticities=AP1))
    np.testing.assert_array_equal(found.image[..., 0], IMAGE[..., 0])
    assert not said


@pytest.mark.parametrize("value", [65504, -np.inf])
def test_what_half_floats_cut_is_told_once(tmp_path, value):
    for number in range(3):
        half = (IMAGE * (number + 1)).astype(np.float16)
        half[number, 2] = value
        exr(tmp_path / f"{number}.exr", planes_of(half))
    with pytest.warns(InputWarning, match="half floats of 65504") as caught:
        chd.io.read(tmp_path).read()
    assert len(caught) == 1
