"""Y'CbCr to R'G'B' against the closed forms, for every matrix, range and depth."""

import av
import cv2
import numpy as np
import pytest
from av.video.reformatter import VideoReformatter

from shared.io.pixel_format import rgb_codes
from shared.io.video import open_video

COEFFICIENTS = {1: (0.2126, 0.0722), 5: (0.299, 0.114), 9: (0.2627, 0.0593)}  # matrix tag -> Kr, Kb
LIMITED, FULL = 1, 2


def rgb_of_yuv(yuv, bits, matrix, colour_range):
    """BT.601-7 / BT.709-6 section 3: digital Y'CbCr -> R'G'B' in [0, 1]."""
    kr, kb = COEFFICIENTS[matrix]
    step = 2.0 ** (bits - 8)
    y, cb, cr = yuv
    if colour_range == FULL:
        top = 2**bits - 1
        y, cb, cr = y / top, (cb - 2 ** (bits - 1)) / top, (cr - 2 ** (bits - 1)) / top
    else:
        y, cb, cr = (y - 16 * step) / (219 * step), (cb - 128 * step) / (224 * step), (cr - 128 * step) / (224 * step)
    red, blue = y + 2 * (1 - kr) * cr, y + 2 * (1 - kb) * cb
    return np.array([red, (y - kr * red - kb * blue) / (1 - kr - kb), blue])


def flat_picture(pixel_format, yuv, bits, matrix, colour_range):
    picture = av.VideoFrame(32, 32, pixel_format)
    picture.colorspace, picture.color_range = matrix, colour_range
    kind = np.uint8 if bits == 8 else np.uint16
    for plane, value in zip(picture.planes, yuv, strict=True):
        plane.update(np.full((plane.height, plane.line_size // kind().itemsize), value, kind).tobytes())
    return picture


@pytest.mark.parametrize("colour_range", [LIMITED, FULL])
@pytest.mark.parametrize("matrix", COEFFICIENTS)
@pytest.mark.parametrize(("pixel_format", "bits"), [("yuv420p", 8), ("yuv422p", 8), ("yuv444p", 8),
                                                    ("yuv420p10le", 10), ("yuv422p10le", 10), ("yuv444p12le", 12)])
def test_flat_colours_convert_as_the_recommendations_say(pixel_format, bits, matrix, colour_range):
    rng = np.random.default_rng(bits * 100 + matrix)
    errors = []
    for _ in range(40):
        yuv = (rng.uniform((60, 112, 112), (190, 144, 144)) * 2 ** (bits - 8)).astype(int)
        expected = rgb_of_yuv(yuv, bits, matrix, colour_range)
        codes = rgb_codes(VideoReformatter(), flat_picture(pixel_format, yuv, bits, matrix, colour_range))
        assert codes.dtype == (np.uint8 if bits == 8 else np.uint16)
        assert np.ptp(codes.reshape(-1, 3), axis=0).max() == 0
        errors.append((codes[16, 16] / np.iinfo(codes.dtype).max - expected) * (2**bits - 1))
    assert np.abs(errors).max() < (0.55 if bits == 8 else 0.1)
    assert np.abs(np.mean(errors, axis=0)).max() < 0.2


def test_an_untagged_picture_is_bt601_when_small_and_bt709_when_large():
    yuv = (120, 110, 150)
    for side, matrix in ((32, 5), (1280, 1)):
        picture = av.VideoFrame(side, 32, "yuv444p")
        picture.colorspace, picture.color_range = 2, LIMITED
        for plane, value in zip(picture.planes, yuv, strict=True):
            plane.update(np.full((plane.height, plane.line_size), value, np.uint8).tobytes())
        codes = rgb_codes(VideoReformatter(), picture)[16, 16]
        assert np.abs(codes - 255 * rgb_of_yuv(yuv, 8, matrix, LIMITED)).max() < 0.6


def test_lossless_video_decodes_without_the_bias_of_cv2(tmp_path):
    """Quantised Y'CbCr keeps the mean of many colours; so must the way back."""
    rgb = np.random.default_rng(0).uniform(40, 200, (64, 64, 3))
    rgb = np.repeat(np.repeat(rgb, 2, axis=0), 2, axis=1)
    red, green, blue = np.moveaxis(rgb / 255, 2, 0)
    luma = 0.2126 * red + 0.7152 * green + 0.0722 * blue
    planes = 16 + 219 * luma, 128 + 224 * (blue - luma) / 1.8556, 128 + 224 * (red - luma) / 1.5748
    path = tmp_path / "clip.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"qp": "0", "preset": "ultrafast"})
        stream.width, stream.height, stream.pix_fmt, stream.codec_context.colorspace = 128, 128, "yuv420p", 1
        picture = av.VideoFrame(128, 128, "yuv420p")
        for plane, values in zip(picture.planes, planes, strict=True):
            values = np.rint(values[:: 128 // plane.height, :: 128 // plane.width])
            rows = np.zeros((plane.height, plane.line_size), np.uint8)
            rows[:, :plane.width] = values
            plane.update(rows.tobytes())
        container.mux(stream.encode(picture))
        container.mux(stream.encode())
    _, ours = next(iter(open_video(path)))
    _, bgr = cv2.VideoCapture(str(path)).read()
    bias, bias_cv2 = (np.mean(codes - rgb, axis=(0, 1)) for codes in (ours.astype(float), bgr[..., ::-1].astype(float)))
    assert np.abs(bias).max() < 0.25
    assert np.abs(bias).max() < np.abs(bias_cv2).max() / 2
