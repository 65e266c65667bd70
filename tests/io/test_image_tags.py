"""JPEG, PNG and TIFF as their tags say: turned, mirrored, in the primaries of their ICC profile, or refused."""

import struct
import zlib

import cv2
import numpy as np
import pytest

from shared.errors import InputError
from shared.imaging.color import decode_srgb, encode_srgb, rec709_from_primaries
from shared.io.colour_tags import PRIMARIES
from shared.io.image_tags import ImageTags, read_tags
from shared.io.video import open_video

SRGB_D50 = np.array([[0.4361, 0.3851, 0.1431], [0.2225, 0.7169, 0.0606], [0.0139, 0.0971, 0.7141]])
ADOBE = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.3290)
SRGB_CURVE = b"para\0\0\0\0\0\3\0\0" + struct.pack(">5i", *(round(65536 * x) for x in (
    2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)))
SHOWN = {1: lambda p: p, 2: lambda p: p[:, ::-1], 3: lambda p: p[::-1, ::-1], 4: lambda p: p[::-1],
         5: lambda p: p.transpose(1, 0, 2), 6: lambda p: np.rot90(p, -1),
         7: lambda p: np.rot90(p, 2).transpose(1, 0, 2), 8: lambda p: np.rot90(p)}
"""Exif 2.32: which side of the picture the stored row 0 and column 0 are."""


def icc(chromaticities=None, curve=SRGB_CURVE, space=b"RGB "):
    """An ICC profile of three lights."""
    matrix = np.eye(3) if chromaticities is None else rec709_from_primaries(chromaticities)
    columns = np.rint(65536 * SRGB_D50 @ matrix).astype(int)
    names = (b"rXYZ", b"gXYZ", b"bXYZ")
    tags = {name: b"XYZ \0\0\0\0" + struct.pack(">3i", *columns[:, i]) for i, name in enumerate(names)}
    tags |= {b"rTRC": curve, b"gTRC": curve, b"bTRC": curve}
    start, table, body = 132 + 12 * len(tags), b"", b""
    for name, value in tags.items():
        table += name + struct.pack(">II", start + len(body), len(value))
        body += value + bytes(-len(value) % 4)
    return bytes(16) + space + bytes(108) + struct.pack(">I", len(tags)) + table + body


def exif(orientation, order="<"):
    mark = b"II*\0" if order == "<" else b"MM\0*"
    return mark + struct.pack(f"{order}IHHHIHHI", 8, 1, 0x112, 3, 1, orientation, 0, 0)


def jpeg(rgb, *segments):
    """segments: (marker, body)."""
    data = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    notes = b"".join(bytes([0xFF, kind]) + struct.pack(">H", len(body) + 2) + body for kind, body in segments)
    return data[:2] + notes + data[2:]


def png(rgb, *chunks):
    """chunks: (kind, body)."""
    data = cv2.imencode(".png", rgb[..., ::-1])[1].tobytes()
    notes = b"".join(struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
                     for kind, body in chunks)
    return data[:33] + notes + data[33:]


def tiff(rgb, orientation=1, profile=b""):
    """Uncompressed, one strip."""
    height, width = rgb.shape[:2]
    entries = [(256, 3, 1, width), (257, 3, 1, height), (258, 3, 3, 8), (259, 3, 1, 1), (262, 3, 1, 2),
               (273, 4, 1, 0), (274, 3, 1, orientation), (277, 3, 1, 3), (278, 3, 1, height),
               (279, 4, 1, rgb.size)] + [(34675, 7, len(profile), 0)] * bool(profile)
    after = 8 + 2 + 12 * len(entries) + 4
    places = {258: after, 273: after + 6 + len(profile), 34675: after + 6}
    table = b"".join(struct.pack("<HHII", *entry[:3], places.get(entry[0], entry[3])) for entry in entries)
    return (b"II*\0" + struct.pack("<IH", 8, len(entries)) + table + bytes(4) + struct.pack("<3H", 8, 8, 8) + profile
            + rgb.tobytes())


def picture():
    rgb = np.full((48, 64, 3), 90, np.uint8)
    rgb[:16, :16], rgb[:16, -16:], rgb[-16:, :16] = (230, 40, 40), (40, 200, 40), (40, 60, 220)
    return rgb


def read(folder, name, data, transfer="srgb"):
    (folder / f"0.{name}").write_bytes(data)
    reader = open_video(folder / f"%d.{name}", transfer)
    return next(iter(reader))[1], reader.info


@pytest.mark.parametrize("orientation", SHOWN)
@pytest.mark.parametrize("kind", ["jpg", "jpg, big end", "png", "tif"])
def test_pictures_are_turned_and_mirrored(tmp_path, kind, orientation):
    rgb = picture()
    data = {"jpg": lambda: jpeg(rgb, (0xE1, b"Exif\0\0" + exif(orientation))),
            "jpg, big end": lambda: jpeg(rgb, (0xE1, b"Exif\0\0" + exif(orientation, ">"))),
            "png": lambda: png(rgb, (b"eXIf", exif(orientation))),
            "tif": lambda: tiff(rgb, orientation)}[kind]()
    codes, info = read(tmp_path, kind[:3], data)
    shown = SHOWN[orientation](rgb)
    assert (info.height, info.width) == codes.shape[:2] == shown.shape[:2]
    assert np.abs(codes.astype(int) - shown).mean() < 3


def with_profile(kind, rgb, profile):
    return {"jpg": lambda: jpeg(rgb, (0xE2, b"ICC_PROFILE\0\1\2" + profile[:200]),
                                (0xE2, b"ICC_PROFILE\0\2\2" + profile[200:])),
            "png": lambda: png(rgb, (b"iCCP", b"name\0\0" + zlib.compress(profile))),
            "tif": lambda: tiff(rgb, profile=profile)}[kind]()


@pytest.mark.parametrize("kind", ["jpg", "png", "tif"])
def test_the_profiles_primaries_are_followed(tmp_path, kind):
    rgb = picture()
    plain, info = read(tmp_path, kind, with_profile(kind, rgb, icc()))
    assert np.abs(plain.astype(int) - rgb).mean() < 2 and not info.warnings
    codes, info = read(tmp_path, kind, with_profile(kind, rgb, icc(PRIMARIES[12][1])))
    expected = encode_srgb(decode_srgb(plain / 255) @ rec709_from_primaries(PRIMARIES[12][1]).T)
    assert np.abs(codes / 255 - expected).max() < 4e-3
    assert any("Display P3" in text for text in info.warnings)


REFUSED = {
    "unknown primaries": (icc(ADOBE), "primaries are not known"),
    "another curve": (icc(curve=b"curv\0\0\0\0\0\0\0\1\1\xcd"), "curve"),
    "linear light": (icc(curve=b"curv\0\0\0\0\0\0\0\0"), "curve"),
    "tables alone": (icc()[:132] + bytes(200), "none of three lights"),
    "nothing": (b"ICC", "none of three lights"),
    "a million tags": (icc()[:128] + b"\0\xff\xff\xff", "none of three lights"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_profiles_that_are_not_followed_are_refused(tmp_path, name):
    profile, words = REFUSED[name]
    with pytest.raises(InputError, match=words) as caught:
        read(tmp_path, "png", with_profile("png", picture(), profile))
    assert "\n" not in str(caught.value) and "sRGB" in str(caught.value)


def test_a_profile_of_linear_light_fits_linear_pictures(tmp_path):
    linear = icc(curve=b"curv\0\0\0\0\0\0\0\0")
    assert np.array_equal(read(tmp_path, "png", with_profile("png", picture(), linear), "linear")[0], picture())
    assert ImageTags(profile=icc(space=b"GRAY")).primaries("srgb", "") == 1


def test_oblong_pixels_are_refused_and_a_linear_gamma_said(tmp_path):
    with pytest.raises(InputError, match="not square"):
        read(tmp_path, "png", png(picture(), (b"pHYs", struct.pack(">IIB", 2000, 1000, 0))))
    assert read(tmp_path, "png", png(picture(), (b"gAMA", struct.pack(">I", 100_000))))[1].transfer_tag == "linear"


@pytest.mark.parametrize("kind", ["jpg", "png", "tif"])
def test_damaged_tags_say_nothing(kind):
    data = with_profile(kind, picture(), icc())
    for length in range(0, 900, 7):
        tags = read_tags(data[:length])
        assert tags.orientation in range(65536)
    rng = np.random.default_rng(0)
    for _ in range(300):
        spoilt = np.frombuffer(data, np.uint8).copy()
        spoilt[rng.integers(0, min(900, len(data)), 20)] = rng.integers(0, 256, 20)
        tags = read_tags(spoilt.tobytes())
        try:
            assert tags.primaries("srgb", "") in {1, *PRIMARIES}
        except InputError as error:
            assert "ICC profile" in str(error)
