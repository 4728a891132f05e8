"""EXR files: what is written comes back, other programs' files are understood, or refused."""

from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from chdstat.errors import InputError, InputWarning, StoreError
from chdstat.io import read_exr, write_exr

LAYOUT = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}


def image(shape=(5, 7, 3), seed=0):
    return np.random.default_rng(seed).lognormal(0, 3, size=shape).astype(np.float32)


def foreign(path, planes, header=LAYOUT):
    """Write a file as another program might."""
    with OpenEXR.File(dict(header), planes) as file:
        file.write(str(path))
    return path


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


def test_viewers_find_channels_and_layers_by_their_usual_names(tmp_path):
    x = image()
    path = write_exr(
        tmp_path / "x.exr", x, extra={"certainty": x[..., 0], "low": x, "v.X": x[..., 1]}
    )
    found = channels_of(path)
    assert set(found) == {"R", "G", "B", "certainty", "low.R", "low.G", "low.B", "v.X"}
    for i, name in enumerate("RGB"):
        np.testing.assert_array_equal(found[name], x[..., i])
        np.testing.assert_array_equal(found[f"low.{name}"], x[..., i])
    with OpenEXR.File(str(path)) as file:
        assert file.header()["chromaticities"][:2] == pytest.approx((0.64, 0.33))


@pytest.mark.parametrize(("count", "names"), [(1, ("Y",)), (3, ("R", "G", "B")), (2, ("u", "v"))])
def test_channels_have_usual_names_or_those_given(tmp_path, count, names):
    x = image((4, 3, count))
    given = None if count in (1, 3) else names
    path = write_exr(tmp_path / "x.exr", x, channels=given, extra={"low": x})
    found = read_exr(path, channels=given)
    assert found.channels == names
    np.testing.assert_array_equal(found.image, x)
    np.testing.assert_array_equal(found.extra["low"], x)


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


def test_half_keeps_nan_and_infinity(tmp_path):
    x = np.full((2, 2, 3), np.nan)
    x[0] = np.inf
    path = write_exr(tmp_path / "x.exr", x, pixel_type="half")
    with pytest.warns(InputWarning, match="half floats of 65504, .* or infinite"):
        np.testing.assert_array_equal(read_exr(path).image, x)


def test_whole_numbers_and_masks_become_floats(tmp_path):
    mask = image()[..., 0] > 1
    path = write_exr(tmp_path / "x.exr", np.ones((5, 7, 3), int), extra={"mask": mask})
    found = read_exr(path)
    assert (found.image == 1).all()
    np.testing.assert_array_equal(found.extra["mask"], mask.astype(np.float32))


# --- files of others ------------------------------------------------------------------------------


def test_other_channels_are_layers(tmp_path):
    x = image()
    planes = {name: x[..., i].copy() for i, name in enumerate("RGB")}
    more = {"A": x[..., 0] + 1, "Z": x[..., 1] + 1, "N.X": x[..., 2] + 1}
    found = read_exr(foreign(tmp_path / "x.exr", {**planes, **more}))
    np.testing.assert_array_equal(found.image, x)
    assert found.extra.keys() == more.keys()
    assert read_exr(tmp_path / "x.exr", channels=["Z"]).image.shape == (5, 7, 1)


def test_channels_that_are_not_there_are_named_with_those_that_are(tmp_path):
    path = foreign(tmp_path / "x.exr", {"U": image()[..., 0].copy()})
    with pytest.raises(InputError, match=r"no channels R, G, B or Y; .*channels=, out of U"):
        read_exr(path)
    with pytest.raises(InputError, match="no layer 'Z', but the channels U"):
        read_exr(path, channels=["Z"])


def test_channels_of_other_parts_are_layers(tmp_path):
    x, normal = image(), image(seed=1)
    first = OpenEXR.Part(dict(LAYOUT), {n: x[..., i].copy() for i, n in enumerate("RGB")}, "rgb")
    other = OpenEXR.Part(dict(LAYOUT), {"X": normal[..., 0].copy(), "n.Y": normal[..., 1]}, "n")
    OpenEXR.File([first, other]).write(str(tmp_path / "x.exr"))
    found = read_exr(tmp_path / "x.exr")
    np.testing.assert_array_equal(found.image, x)
    assert found.extra.keys() == {"n.X", "n.Y"}
    np.testing.assert_array_equal(found.extra["n.X"], normal[..., 0])


def test_a_header_that_claims_more_than_the_file_can_hold_is_refused(tmp_path):
    path = write_exr(tmp_path / "x.exr", image())
    content = bytearray(path.read_bytes())
    start = content.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    content[start : start + 16] = np.array([0, 0, 10**6 - 1, 10**6 - 1], "<i4").tobytes()
    path.write_bytes(content)
    with pytest.raises(StoreError, match=r"cannot hold the 1\.2e\+13 that its header claims"):
        read_exr(path)


def test_channels_of_lower_resolution_are_refused(tmp_path):
    x = image()[:4, :6, 0].copy()
    path = foreign(tmp_path / "x.exr", {"Y": x, "Q": OpenEXR.Channel("Q", x, 2, 2)})
    with pytest.raises(StoreError, match=r"'Q' is of a resolution of its own.*\(4, 6\)"):
        read_exr(path, channels=["Q"])
    with pytest.warns(InputWarning, match="'Q' is left out, for it is of a resolution of its own"):
        np.testing.assert_array_equal(read_exr(path).image[..., 0], x)


def test_luminance_and_chroma_are_refused(tmp_path):
    x = image()[:4, :6, 0].copy()
    chroma = {name: OpenEXR.Channel(name, x, 2, 2) for name in ("RY", "BY")}
    path = foreign(tmp_path / "x.exr", {"Y": x, **chroma})
    with pytest.raises(StoreError, match="luminance and chroma.*: write it with R, G and B"):
        read_exr(path)


def test_deep_images_are_refused(tmp_path):
    deep = np.empty((2, 3), object)
    for i in range(deep.size):
        deep.flat[i] = np.ones(i + 1, np.float32)
    header = {"compression": OpenEXR.ZIPS_COMPRESSION, "type": OpenEXR.deepscanline}
    path = foreign(tmp_path / "x.exr", {"Z": deep}, header)
    with pytest.raises(StoreError, match="'Z' is deep"):
        read_exr(path)


# --- files that are none --------------------------------------------------------------------------


def test_a_file_that_is_not_there_or_not_one(tmp_path):
    with pytest.raises(StoreError, match="no EXR file at"):
        read_exr(tmp_path / "x.exr")
    with pytest.raises(StoreError, match="no EXR file at"):
        read_exr(tmp_path)
    for content in (b"", b"v/", b"\x89PNG\r\n" + bytes(100)):
        (tmp_path / "x.exr").write_bytes(content)
        with pytest.raises(StoreError, match="is not an EXR file"):
            read_exr(tmp_path / "x.exr")


@pytest.mark.parametrize("share", [0.001, 0.02, 0.3, 0.7, 0.999])
def test_a_file_that_is_cut_off(tmp_path, share):
    path = write_exr(tmp_path / "x.exr", image((64, 64, 3)))
    whole = path.read_bytes()
    path.write_bytes(whole[: max(4, int(share * len(whole)))])
    with pytest.raises(StoreError, match="damaged or cut off; write or copy it again"):
        read_exr(path)


def test_a_damaged_file(tmp_path):
    """What does not shrink is stored as it is, without a checksum: only the rest can be checked."""
    path = write_exr(tmp_path / "x.exr", np.round(image((64, 64, 3))))
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 64] = bytes(64)
    path.write_bytes(content)
    with pytest.raises(StoreError, match="damaged"):
        read_exr(path)


# --- writing as a whole or not at all -------------------------------------------------------------


def test_a_file_is_replaced(tmp_path):
    path = write_exr(tmp_path / "x.exr", image())
    write_exr(path, image(seed=1))
    np.testing.assert_array_equal(read_exr(path).image, image(seed=1))
    assert list(tmp_path.iterdir()) == [path]


def test_where_nothing_can_be_written(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "folder.exr").mkdir()
    for path in ("none/x.exr", "file/x.exr", "folder.exr"):
        with pytest.raises(StoreError, match="cannot write an EXR file to"):
            write_exr(tmp_path / path, image())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder.exr"]


def test_what_fails_midway_leaves_the_old_file(tmp_path, monkeypatch):
    path = write_exr(tmp_path / "x.exr", image())

    class Full:
        def __init__(self, header, channels):
            pass

        def __enter__(self):
            return self

        def __exit__(self, *error):
            pass

        def write(self, path):
            Path(path).write_bytes(b"half of it")
            message = "No space left on device."
            raise RuntimeError(message)

    with monkeypatch.context() as patch:
        patch.setattr(OpenEXR, "File", Full)
        with pytest.raises(StoreError, match="No space left"):
            write_exr(path, image(seed=1))
    assert list(tmp_path.iterdir()) == [path]
    np.testing.assert_array_equal(read_exr(path).image, image())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"image": np.ones((4, 4))}, r"\(y, x, channel\), got \(4, 4\)"),
        ({"image": np.ones((0, 4, 3))}, r"got \(0, 4, 3\)"),
        ({"image": np.ones((4, 4, 3), complex)}, "image must hold real numbers.*complex"),
        ({"image": np.ones((4, 4, 2))}, "name the 2 channels"),
        ({"channels": ("R", "G")}, "3 different names"),
        ({"channels": ("R", "G", "G")}, "3 different names"),
        ({"channels": ("a.R", "a.G", "a.B")}, "without a dot"),
        ({"channels": ("R", "G", "")}, "1 to 255 printable characters, got ''"),
        (
            {"extra": {"a": np.ones((4, 3))}},
            r"'a' must have shape \(4, 4\) or \(4, 4, 3\).*\(4, 3\)",
        ),
        ({"extra": {"a": np.full((4, 4), "x")}}, "a must hold real numbers"),
        ({"extra": {"R": np.ones((4, 4))}}, "second channel 'R'"),
        ({"extra": {"a": np.ones((4, 4, 3)), "a.G": np.ones((4, 4))}}, "second channel 'a.G'"),
        ({"extra": {"x" * 256: np.ones((4, 4))}}, "1 to 255 printable"),
        ({"extra": {"a\0b": np.ones((4, 4))}}, "1 to 255 printable"),
        ({"attributes": {"dataWindow": "x"}}, "'dataWindow' belongs to the format"),
        ({"attributes": {"": "x"}}, "1 to 255 printable"),
        ({"attributes": {"spp": 32}}, "'spp' must be text, got int"),
        ({"pixel_type": "double"}, "pixel_type must be one of float, half, got 'double'"),
        (
            {"image": np.full((4, 4, 3), 7e4), "pixel_type": "half"},
            "'R' must be at most 65504.*70000",
        ),
        ({"extra": {"a": np.full((4, 4), -1e39)}}, r"'a' must be at most 3.40282e\+38.*1e\+39"),
    ],
)
def test_wrong_input_is_refused_and_nothing_written(tmp_path, options, message):
    with pytest.raises(InputError, match=message):
        write_exr(tmp_path / "x.exr", **{"image": np.ones((4, 4, 3)), **options})
    assert not list(tmp_path.iterdir())
