"""Colours as the tags of videos and pictures state them, against an independent library of colour science."""

import struct
import warnings
import zlib

import cv2
import numpy as np
import pytest
from toy_video import turning_face, write_video

from shared.errors import InputError
from shared.imaging.color import (
    TRANSFERS,
    decode_hlg,
    decode_pq,
    decode_transfer,
    encode_transfer,
    rec709_from_primaries,
)
from shared.io.colour_tags import PRIMARIES
from shared.io.video import open_video

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import colour

LINEAR = np.random.default_rng(1).uniform(0.02, 0.8, (24, 32, 3))
"""Light in Rec.709."""


def from_rec709(primaries):
    return np.linalg.inv(rec709_from_primaries(PRIMARIES[primaries][1]))


def tagged_png(path, codes, primaries, curve):
    """A 16-bit PNG with a cICP chunk."""
    data = cv2.imencode(".png", np.rint(65535 * codes[..., ::-1]).astype(np.uint16))[1].tobytes()
    body = b"cICP" + bytes([primaries, curve, 0, 1])
    path.write_bytes(data[:33] + struct.pack(">I", 4) + body + struct.pack(">I", zlib.crc32(body)) + data[33:])


def read_linear(path, transfer="srgb"):
    reader = open_video(path, transfer)
    codes = next(iter(reader))[1]
    return decode_transfer(codes / np.iinfo(codes.dtype).max, transfer), reader.info.warnings


@pytest.mark.parametrize(("number", "name"), [(9, "ITU-R BT.2020"), (12, "P3-D65"), (11, "DCI-P3"), (6, "SMPTE C")])
def test_matrices_of_primaries(number, name):
    theirs = colour.matrix_RGB_to_RGB(colour.RGB_COLOURSPACES[name], colour.RGB_COLOURSPACES["ITU-R BT.709"],
                                      "Bradford")
    assert np.abs(rec709_from_primaries(PRIMARIES[number][1]) - theirs).max() < 1e-3


def test_curves():
    codes = np.linspace(0, 1, 401)
    hlg = colour.models.oetf_inverse_BT2100_HLG(codes)
    assert np.abs(decode_hlg(codes) - hlg).max() < 1e-4
    pq = colour.models.oetf_inverse_BT2100_PQ(codes)
    nominal = colour.models.oetf_inverse_BT2100_PQ(colour.models.eotf_inverse_ST2084(1000))
    np.testing.assert_allclose(decode_pq(codes), pq / nominal, rtol=2e-3, atol=1e-4)
    for transfer in TRANSFERS:
        np.testing.assert_allclose(encode_transfer(decode_transfer(codes, transfer), transfer), codes, atol=2e-4)


@pytest.mark.parametrize("chromaticities", [(0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3, 0.0), (0.3,) * 8,
                                            (np.nan,) * 8, (0.6, 0.3, 0.4, 0.3, 0.2, 0.3, 0.3127, 0.329)])
def test_primaries_that_span_nothing(chromaticities):
    with pytest.raises(ValueError, match="primaries"):
        rec709_from_primaries(chromaticities)


@pytest.mark.parametrize("transfer", TRANSFERS)
@pytest.mark.parametrize("primaries", [9, 12])
def test_wide_primaries_become_rec709(tmp_path, primaries, transfer):
    tagged_png(tmp_path / "0.png", encode_transfer(LINEAR @ from_rec709(primaries).T, transfer), primaries, 13)
    linear, told = read_linear(tmp_path / "%d.png", transfer)
    np.testing.assert_allclose(linear, LINEAR, rtol=3e-3, atol=3e-4)
    assert any(PRIMARIES[primaries][0] in text for text in told)


@pytest.mark.parametrize("primaries", [9, 2, 1])
def test_hybrid_log_gamma_becomes_linear_light(tmp_path, primaries):
    matrix = np.eye(3) if primaries == 1 else from_rec709(9)
    with np.errstate(invalid="ignore"):  # theirs looks at both branches
        codes = colour.models.oetf_BT2100_HLG(LINEAR @ matrix.T)
    tagged_png(tmp_path / "0.png", codes, primaries, 18)
    linear, told = read_linear(tmp_path / "%d.png")
    np.testing.assert_allclose(linear, LINEAR, rtol=3e-3, atol=3e-4)
    assert any("hlg" in text for text in told)


def test_pq_becomes_linear_light(tmp_path):
    nominal = colour.models.oetf_inverse_BT2100_PQ(colour.models.eotf_inverse_ST2084(1000))
    tagged_png(tmp_path / "0.png", colour.models.oetf_BT2100_PQ(nominal * LINEAR @ from_rec709(9).T), 9, 16)
    linear, _ = read_linear(tmp_path / "%d.png")
    np.testing.assert_allclose(linear, LINEAR, rtol=5e-3, atol=5e-4)


@pytest.mark.parametrize("pixel_format", ["yuv420p10le", "yuv444p10le"])
def test_a_video_is_converted_as_its_tags_say(tmp_path, pixel_format):
    plain = turning_face(1)[0]
    p3, rec709 = (write_video(tmp_path / f"{number}.mkv", [plain] * 2, codec="ffv1", pixel_format=pixel_format,
                              colour={"color_primaries": number, "color_trc": 1}) for number in (12, 1))
    shown, told = read_linear(p3)
    stored, nothing = read_linear(rec709)
    expected = (stored @ rec709_from_primaries(PRIMARIES[12][1]).T).clip(0, 1)
    assert np.abs(shown - expected).max() < 2e-3 and np.abs(shown - stored).max() > 0.02
    assert any("Display P3" in text for text in told) and not nothing
    hdr = open_video(write_video(tmp_path / "hdr.mp4", [plain] * 2, colour={"color_primaries": 9, "color_trc": 18}))
    assert hdr.info.transfer_tag == "hlg" and next(iter(hdr))[1].dtype == np.uint16
    assert any("BT.2020" in text for text in hdr.info.warnings)


@pytest.mark.parametrize("colours", [{"color_trc": 9}, {"color_trc": 17}, {"color_primaries": 10}])
def test_what_is_no_light_of_a_camera_is_refused(tmp_path, colours):
    path = write_video(tmp_path / "clip.mkv", turning_face(2), codec="ffv1", pixel_format="yuv444p10le", colour=colours)
    with pytest.raises(InputError, match="not converted"):
        open_video(path)
