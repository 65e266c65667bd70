"""EXR clips: bounded by their headers, and read as their headers say: primaries, windows, scale."""

import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from shared.errors import InputError
from shared.io.export_maps import acescg_from_rec709
from shared.io.exr_header import read_parts
from shared.io.exr_picture import read_rec709
from shared.io.images import exr_size, read_exr, write_exr
from shared.io.video import open_video
from tools.relight.inputs import read_light

REPOSITORY = Path(__file__).resolve().parents[2]
PICTURE = np.random.default_rng(0).uniform(0.02, 0.9, (40, 60, 3)).astype(np.float32)
AP1 = (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)


def box(x0, y0, width, height):
    return np.array([x0, y0], np.int32), np.array([x0 + width - 1, y0 + height - 1], np.int32)


def write(path, channels=PICTURE, **header):
    """An EXR with these attributes; channels: an array as RGB, or {name: array}."""
    channels = {"RGB": channels} if isinstance(channels, np.ndarray) else channels
    defaults = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    with OpenEXR.File(defaults | header, channels) as file:
        file.write(str(path))
    return path


def write_parts(path, sizes, channels="RGB"):
    parts = []
    for number, (width, height) in enumerate(sizes):
        header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION,
                  "displayWindow": box(0, 0, *sizes[0]), "dataWindow": box(0, 0, width, height)}
        pixels = np.zeros((height, width, 3) if channels == "RGB" else (height, width), np.float16)
        parts.append(OpenEXR.Part(header, {channels: pixels}, f"part{number}"))
    with OpenEXR.File(parts) as file:
        file.write(str(path))
    return path


def opened(folder):
    """Its codes as linear values, and its warnings."""
    reader = open_video(folder / "f.%d.exr")
    return next(iter(reader))[1] / 65535, reader.info.warnings


def test_headers_are_read_as_the_library_reads_them(tmp_path):
    path = write(tmp_path / "a.exr", {"RGB": PICTURE, "A": PICTURE[..., 0].astype(np.float16)}, chromaticities=AP1,
                 dataWindow=box(3, 4, 60, 40), displayWindow=box(0, 0, 70, 50))
    part, = read_parts(path)
    assert [(c.name, c.kind) for c in part.channels] == [("A", 1), ("B", 2), ("G", 2), ("R", 2)]
    assert part.data == (3, 4, 63, 44) and part.display == (0, 0, 70, 50) and part.size == (60, 40)
    assert part.values["chromaticities"] == pytest.approx(AP1) and not part.deep
    assert exr_size(path) == (60, 40)
    assert part.bytes() == 60 * 40 * (3 * 4 + 2)
    assert [p.size for p in read_parts(write_parts(tmp_path / "b.exr", [(20, 30), (50, 60)]))] == [(20, 30), (50, 60)]


def test_a_cut_header_is_an_error_at_every_length(tmp_path):
    data = write(tmp_path / "a.exr").read_bytes()
    for length in range(0, data.index(b"screenWindowWidth"), 7):
        (tmp_path / "cut.exr").write_bytes(data[:length])
        with pytest.raises(InputError, match="EXR"):
            read_parts(tmp_path / "cut.exr")


def test_spoilt_headers_end_in_one_line_or_a_picture(tmp_path):
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 64
    data = write(tmp_path / "a.exr", chromaticities=AP1, type=OpenEXR.tiledimage, tiles=tiles).read_bytes()
    rng, spoilt = np.random.default_rng(0), tmp_path / "f.0.exr"
    for name in (b"float", b"box2i", b"tiledesc", b"chlist", b"string"):
        spoilt.write_bytes(data.replace(name, bytes(reversed(name)), 1))
        with pytest.raises(InputError, match="EXR"):
            open_video(tmp_path / "f.%d.exr")
    for _ in range(400):
        codes = np.frombuffer(data, np.uint8).copy()
        codes[rng.integers(4, 500, 3)] = rng.integers(0, 256, 3)
        spoilt.write_bytes(codes.tobytes())
        try:
            open_video(tmp_path / "f.%d.exr")
        except InputError as error:
            assert "\n" not in str(error)


def many_channels(folder):
    plane = np.zeros((2000, 2000), np.float16)
    names = {f"aov{i:03d}": plane for i in range(70)}
    return write(folder / "f.0.exr", {"RGB": np.zeros((2000, 2000, 3), np.float16), **names})


def far_too_many_channels(folder):
    plane = np.zeros((20, 30), np.float16)
    return write(folder / "f.0.exr", {f"aov{i:03d}": plane for i in range(200)})


def large_second_part(folder):
    return write_parts(folder / "f.0.exr", [(60, 40), (12_000, 12_000)], "Y")


def many_parts(folder):
    return write_parts(folder / "f.0.exr", [(60, 40)] * 100)


def huge_display_window(folder):
    return write(folder / "f.0.exr", displayWindow=box(0, 0, 60_000, 60_000))


def huge_tiles(folder):
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 64
    tiles.mode = OpenEXR.ONE_LEVEL
    path = write(folder / "f.0.exr", type=OpenEXR.tiledimage, tiles=tiles)
    data = bytearray(path.read_bytes())
    struct.pack_into("<2I", data, data.index(b"tiledesc\0") + 13, 60_000, 60_000)
    path.write_bytes(data)


BOMBS = {
    "channels that decode to gigabytes": (many_channels, "too large once decoded"),
    "hundreds of channels": (far_too_many_channels, "too many channels"),
    "a large second part": (large_second_part, "too large"),
    "a hundred parts": (many_parts, "too many parts"),
    "a huge display window": (huge_display_window, "too large"),
    "huge tiles": (huge_tiles, "tiles"),
}


@pytest.mark.parametrize("name", BOMBS)
def test_what_is_too_large_is_refused_before_it_is_decoded(tmp_path, name):
    make, words = BOMBS[name]
    make(tmp_path)
    code = ("import resource, sys; from shared.io.video import open_video; from shared.errors import InputError\n"
            "start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
            "try: open_video(sys.argv[1])\n"
            "except InputError as error: print(error)\n"
            "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - start)")
    command = [sys.executable, "-c", code, str(tmp_path / "f.%d.exr")]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True)
    line, grown_kb = done.stdout.splitlines()
    assert words in line and str(tmp_path) in line
    assert int(grown_kb) < 60_000


def test_primaries_are_converted(tmp_path):
    write(tmp_path / "f.0.exr", acescg_from_rec709(PICTURE).astype(np.float32), chromaticities=AP1)
    write(tmp_path / "f.1.exr", PICTURE)
    reader = open_video(tmp_path / "f.%d.exr")
    for _, codes in reader:  # by each file's own header
        assert np.abs(codes / 65535 - PICTURE).max() < 2e-4
    assert any("primaries" in text for text in reader.info.warnings)


def test_a_colour_space_may_stand_in_for_primaries(tmp_path):
    write(tmp_path / "f.0.exr", acescg_from_rec709(PICTURE).astype(np.float32), colorInteropID="lin_ap1_scene")
    assert np.abs(opened(tmp_path)[0] - PICTURE).max() < 2e-4


def test_what_limn_writes_as_rec709_stays_as_it_is(tmp_path):
    write_exr(tmp_path / "f.0.exr", PICTURE, colour_space="lin_rec709_scene")
    linear, warnings = opened(tmp_path)
    assert np.abs(linear - PICTURE).max() < 1e-5 and not warnings


@pytest.mark.parametrize("layout", ["tiled", "mipmap"])
def test_tiles_and_their_first_level(tmp_path, layout):
    picture = np.tile(PICTURE, (2, 2, 1))
    write_exr(tmp_path / "f.0.exr", picture, colour_space="lin_rec709_scene", layout=layout)
    assert np.abs(opened(tmp_path)[0] - picture).max() < 1e-5


def test_the_display_window_is_the_picture(tmp_path):
    for number, (x, y) in enumerate([(-7, -3), (5, 4), (30, 20)]):
        write(tmp_path / f"f.{number}.exr", dataWindow=box(x, y, 60, 40), displayWindow=box(0, 0, 64, 48))
    reader = open_video(tmp_path / "f.%d.exr")
    whole = np.zeros((200, 200, 3), np.float32)
    for frame, (x, y) in zip(reader.frames(), [(-7, -3), (5, 4), (30, 20)], strict=True):
        assert not frame.fault
        shown = whole.copy()
        shown[100 + y:140 + y, 100 + x:160 + x] = PICTURE
        assert np.abs(frame.codes() / 65535 - shown[100:148, 100:164]).max() < 1e-5
    assert any("data window" in text for text in reader.info.warnings)


@pytest.mark.parametrize("scale", [100.0, 0.004])
def test_any_scale_fits_the_codes(tmp_path, scale):
    for number in range(2):
        write(tmp_path / f"f.{number}.exr", PICTURE * scale * (1 - 0.3 * number))
    reader = open_video(tmp_path / "f.%d.exr")
    first, second = (codes / 65535 for _, codes in reader)
    gain = first.sum() / (PICTURE.sum() * scale)
    assert np.log2(gain) == pytest.approx(round(np.log2(gain)), abs=1e-3)  # a power of two, the same in all frames
    assert 0.5 < first.max() <= 1 and second.sum() == pytest.approx(0.7 * first.sum(), rel=1e-3)
    assert any("between 0 and 1" in text for text in reader.info.warnings)


def test_a_bright_window_behind_does_not_darken_the_rest(tmp_path):
    picture = PICTURE.copy()
    picture[:8] = 50
    write(tmp_path / "f.0.exr", picture)
    linear, warnings = opened(tmp_path)
    assert np.abs(linear[8:] - PICTURE[8:]).max() < 1e-5 and not warnings


def test_negative_light_is_said_or_refused(tmp_path):
    noisy = PICTURE.copy()
    noisy[::7, ::5] = -0.1
    write(tmp_path / "f.0.exr", noisy)
    assert any("negative values count as zero" in text for text in opened(tmp_path)[1])
    write(tmp_path / "f.0.exr", PICTURE - 0.4)
    with pytest.raises(InputError, match="negative light"):
        opened(tmp_path)


def deep(path):
    data = bytearray(write(path).read_bytes())
    data[5] |= 0x08
    path.write_bytes(data)


def half_rate(path):
    data = bytearray(write(path).read_bytes())
    struct.pack_into("<2i", data, data.index(b"chlist\0") + 11 + 10, 2, 2)
    path.write_bytes(data)


REFUSED = {
    "oblong pixels": (lambda path: write(path, pixelAspectRatio=2.0), "not square"),
    "an environment map": (lambda path: write(path, envmap=OpenEXR.ENVMAP_LATLONG), "environment map"),
    "not linear": (lambda path: write(path, colorInteropID="srgb_rec709_scene"), "not linear"),
    "primaries on a line": (
        lambda path: write(path, chromaticities=(0.6, 0.3, 0.4, 0.3, 0.2, 0.3, 0.3127, 0.329)), "chromaticities"),
    "deep": (deep, "deep"),
    "integers": (lambda path: write(path, PICTURE.astype(np.uint32)), "integers"),
    "channels of lower resolution": (half_rate, "lower resolution"),
    "depth alone": (lambda path: write(path, {"Z": PICTURE[..., 0]}), "other channels"),
    "luminance and chroma": (lambda path: write(path, {n: PICTURE[..., 0] for n in ("Y", "RY", "BY")}), "chroma"),
    "a layer": (lambda path: write(path, {f"left.{c}": PICTURE[..., 0] for c in "RGB"}), "other channels"),
    "windows apart": (
        lambda path: write(path, dataWindow=box(500, 0, 60, 40), displayWindow=box(0, 0, 60, 40)), "lies outside"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_followed_is_one_line(tmp_path, name):
    make, words = REFUSED[name]
    make(tmp_path / "f.0.exr")
    with pytest.raises(InputError, match=words) as caught:
        opened(tmp_path)
    assert "\n" not in str(caught.value) and str(tmp_path) in str(caught.value)


def test_own_files_and_lights_are_bounded_too(tmp_path):
    light = write(tmp_path / "light.exr", {"Y": np.zeros((4096, 8192), np.float16)})
    assert read_exr(light).shape == (4096, 8192)  # larger than any frame of a clip may be
    with pytest.raises(InputError, match="too large"):
        read_exr(large_second_part(tmp_path))


def test_a_light_in_other_primaries_is_converted(tmp_path):
    light = np.random.default_rng(2).uniform(0.1, 5, (16, 32, 3)).astype(np.float32)
    write_exr(tmp_path / "rec709.exr", light, colour_space="lin_rec709_scene")
    write_exr(tmp_path / "ap1.exr", acescg_from_rec709(light), colour_space="lin_ap1_scene")
    write_exr(tmp_path / "grey.exr", light[..., 0], colour_space="data")
    assert np.array_equal(read_rec709(tmp_path / "rec709.exr"), light)
    assert np.abs(read_rec709(tmp_path / "ap1.exr") - light).max() < 1e-3
    assert np.array_equal(read_rec709(tmp_path / "grey.exr"), light[..., 0])
    assert np.abs(read_light(str(tmp_path / "ap1.exr"), None) - light).max() < 1e-3
