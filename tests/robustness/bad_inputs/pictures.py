"""Image sequences."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import OpenEXR

from bad_inputs.cases import case, write_settings
from bad_inputs.clips import head
from shared.imaging.color import decode_srgb
from shared.io.export_maps import acescg_from_rec709
from shared.io.images import write_png

LINEAR = "colour: {transfer: linear}\n"


def sequence(folder, suffix, write, more="", count=12):
    """frames/%04d.<suffix> by write(path, codes, number)."""
    (folder / "frames").mkdir()
    for number, codes in enumerate(head()[:count]):
        write(folder / "frames" / f"{number:04d}.{suffix}", codes, number)
    write_settings(folder, f"frames/%04d.{suffix}", more)


def exr(path, channels, **attributes):
    """Any channels, as they are."""
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION} | attributes
    with OpenEXR.File(header, {name: np.ascontiguousarray(values) for name, values in channels.items()}) as file:
        file.write(str(path))


def linear(codes):
    """[H, W, 3] float32."""
    return decode_srgb(codes / 255.0).astype(np.float32)


def spoilt_exr(where, value):
    """Writes the frames of these numbers with one value that is no number."""
    def write(path, codes, number):
        values = linear(codes)
        if number in where:
            values[3, 4, 1] = value
        exr(path, {"RGB": values})
    return write


@case("linear EXR")
def linear_exr(folder):
    sequence(folder, "exr", spoilt_exr((), 0), LINEAR)


@case("NaN in an EXR")
def nan_exr(folder):
    sequence(folder, "exr", spoilt_exr((5, 6), np.nan), LINEAR)


@case("NaN in the first EXR", "NaN")
def nan_first(folder):
    sequence(folder, "exr", spoilt_exr((0,), np.nan), LINEAR)


@case("Inf in every EXR", "NaN or infinite")
def inf_exr(folder):
    sequence(folder, "exr", spoilt_exr(range(12), np.inf), LINEAR)


@case("a huge EXR", "too large|not a readable")
def huge_exr(folder):
    def write(path, codes, number):
        exr(path, {"RGB": linear(codes)})
        data = bytearray(path.read_bytes())
        for name in (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"):
            struct.pack_into("<4i", data, data.index(name) + len(name) + 4, 0, 0, 59_999, 59_999)
        path.write_bytes(data)
    sequence(folder, "exr", write, LINEAR)


@case("a truncated EXR", "truncated|not a readable")
def truncated_exr(folder):
    def write(path, codes, number):
        exr(path, {"RGB": linear(codes)})
        path.write_bytes(path.read_bytes()[:600])
    sequence(folder, "exr", write, LINEAR)


@case("EXR of other channels", "other channels")
def other_channels(folder):
    depth = np.zeros((144, 144), np.float32)
    sequence(folder, "exr", lambda path, codes, _: exr(path, {"depth.Z": depth, "id": depth}), LINEAR)


def box(x0, y0, width, height):
    """A window."""
    return np.array([x0, y0], np.int32), np.array([x0 + width - 1, y0 + height - 1], np.int32)


@case("a depth map as EXR", "other channels")
def depth_exr(folder):
    sequence(folder, "exr", lambda path, codes, _: exr(path, {"Z": linear(codes)[..., 0]}), LINEAR)


@case("an EXR of channels that decode to gigabytes", "too large once decoded")
def exr_of_channels(folder):
    planes = {f"aov{i:03d}": np.zeros((2000, 2000), np.float16) for i in range(120)}
    sequence(folder, "exr", lambda path, codes, _: exr(path, {"RGB": np.zeros((2000, 2000, 3), np.float16), **planes}),
             LINEAR, count=1)


@case("an EXR with a large second part", "too large")
def exr_of_parts(folder):
    def write(path, codes, number):
        sizes = (codes.shape[:2], (12_000, 12_000))
        windows = [{"displayWindow": box(0, 0, *sizes[0]), "dataWindow": box(0, 0, *size[::-1])} for size in sizes]
        parts = [OpenEXR.Part({"type": OpenEXR.scanlineimage} | window, {"Y": np.zeros(size, np.float16)}, str(i))
                 for i, (window, size) in enumerate(zip(windows, sizes, strict=True))]
        with OpenEXR.File(parts) as file:
            file.write(str(path))
    sequence(folder, "exr", write, LINEAR, count=1)


@case("an EXR with a huge display window", "too large")
def exr_display_window(folder):
    window = box(0, 0, 60_000, 60_000)
    sequence(folder, "exr", lambda path, codes, _: exr(path, {"RGB": linear(codes)}, displayWindow=window), LINEAR)


@case("EXR in ACEScg")
def acescg_exr(folder):
    primaries = (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)

    def write(path, codes, number):
        exr(path, {"RGB": acescg_from_rec709(linear(codes)).astype(np.float32)}, chromaticities=primaries)
    sequence(folder, "exr", write, LINEAR)


@case("EXR with data windows of their own")
def windowed_exr(folder):
    def write(path, codes, number):
        x, y, values = number % 5, number % 3, linear(codes)
        exr(path, {"RGB": np.ascontiguousarray(values[y:, x:])}, dataWindow=box(x, y, 144 - x, 144 - y),
            displayWindow=box(0, 0, 144, 144))
    sequence(folder, "exr", write, LINEAR)


@case("EXR a hundred times as bright")
def bright_exr(folder):
    sequence(folder, "exr", lambda path, codes, _: exr(path, {"RGB": 100 * linear(codes)}), LINEAR)


@case("EXR with oblong pixels", "not square")
def oblong_exr(folder):
    sequence(folder, "exr", lambda path, codes, _: exr(path, {"RGB": linear(codes)}, pixelAspectRatio=2.0), LINEAR)


@case("EXR below zero", "negative light")
def negative_exr(folder):
    sequence(folder, "exr", lambda path, codes, _: exr(path, {"RGB": linear(codes) - 0.5}), LINEAR)


@case("an environment map as EXR", "environment map")
def envmap_exr(folder):
    write = lambda path, codes, _: exr(path, {"RGB": linear(codes)}, envmap=OpenEXR.ENVMAP_LATLONG)  # noqa: E731
    sequence(folder, "exr", write, LINEAR)


@case("16 bit PNG")
def deep_png(folder):
    sequence(folder, "png", lambda path, codes, _: write_png(path, codes.astype(np.uint16) * 257))


@case("grey PNG with alpha")
def grey_alpha(folder):
    def write(path, codes, number):
        cv2.imwrite(str(path), np.dstack([codes[..., 1]] * 3 + [codes[..., 0]]))
    sequence(folder, "png", write)


@case("a PNG bomb", "too large|unusable")
def png_bomb(folder):
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    def write(path, codes, number):
        rows = zlib.compress(bytes(30_000 * (1 + 30_000 // 8)), 9)
        header = chunk(b"IHDR", struct.pack(">IIBBBBB", 30_000, 30_000, 1, 0, 0, 0, 0))
        path.write_bytes(b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", rows) + chunk(b"IEND", b""))
    sequence(folder, "png", write, count=3)


@case("mirrored JPEG with orientation")
def mirrored_jpeg(folder):
    note = b"Exif\0\0II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x112, 3, 1, 7, 0, 0)  # across the other diagonal

    def write(path, codes, number):
        stored = np.ascontiguousarray(np.rot90(codes, 2).transpose(1, 0, 2)[..., ::-1])
        data = cv2.imencode(".jpg", stored)[1].tobytes()
        path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(note) + 2) + note + data[2:])
    sequence(folder, "jpg", write)


def noted_png(*notes):
    """Writes PNGs with these chunks after their head."""
    def write(path, codes, number):
        write_png(path, codes)
        data = path.read_bytes()
        chunks = b"".join(struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
                          for kind, body in notes)
        path.write_bytes(data[:33] + chunks + data[33:])
    return write


@case("PNG with a damaged ICC profile", "ICC profile")
def damaged_profile(folder):
    sequence(folder, "png", noted_png((b"iCCP", b"x\0\0" + zlib.compress(b"nothing" * 40))))


@case("PNG with oblong pixels", "not square")
def oblong_png(folder):
    sequence(folder, "png", noted_png((b"pHYs", struct.pack(">IIB", 2000, 1000, 0))))


@case("PNG in BT.2020 HLG by its cICP")
def cicp_png(folder):
    sequence(folder, "png", noted_png((b"cICP", bytes([9, 18, 0, 1]))))


@case("a gap in the numbers")
def gap(folder):
    sequence(folder, "png", lambda path, codes, number: write_png(path.with_name(f"{5 * number:04d}.png"), codes))


@case("images of two sizes")
def two_sizes(folder):
    def write(path, codes, number):
        write_png(path, cv2.resize(codes, (100, 100)) if number % 4 == 3 else codes)
    sequence(folder, "png", write)


@case("an empty image", "the file is empty", "limn")
def empty_image(folder):
    sequence(folder, "png", lambda path, codes, n: path.touch() if n == 7 else write_png(path, codes))


@case("text as images", "first image")
def text_images(folder):
    sequence(folder, "png", lambda path, codes, n: path.write_text("not an image"))
