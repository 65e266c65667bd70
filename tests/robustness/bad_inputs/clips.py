"""Videos: damaged, of odd formats, of odd content."""

from __future__ import annotations

import itertools
import os
import struct
from fractions import Fraction
from functools import cache
from pathlib import Path

import av
import cv2
import numpy as np
from quick import TINY
from toy_video import write_sound, write_video

from bad_inputs.cases import case, write_settings
from shared.geometry.raycast import RayScene
from shared.imaging.color import decode_srgb
from shared.io.arrays import load_arrays
from shared.io.images import read_exr, read_png
from shared.io.meshes import read_obj

FFV1 = {"codec": "ffv1", "matrix": None}


@cache
def head() -> tuple[np.ndarray, ...]:
    """The tiny subject's twelve frames [144, 144, 3]."""
    return tuple(read_png(path) for path in sorted((TINY / "frames").glob("*.png")))


@cache
def profiles() -> tuple[np.ndarray, ...]:
    """The tiny subject's head seen from the side, 90 degrees and a little to and fro."""
    mesh, albedo = read_obj(TINY / "gt" / "mesh.obj"), read_exr(TINY / "gt" / "albedo.exr")
    arrays = load_arrays(TINY / "gt" / "poses.npz")
    scene, size = RayScene(mesh.vertices, mesh.faces), len(albedo)
    x, y = np.meshgrid(np.arange(144) + 0.5, np.arange(144) + 0.5)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ np.linalg.inv(arrays["K"]).T
    found = []
    for yaw in np.radians(np.linspace(84, 96, 12)):
        turn = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
        rotation, translation = np.diag([1.0, -1, -1]) @ turn, np.array([0.0, 0, 951])
        face, bary, _ = scene.intersect(np.tile(-translation @ rotation, (len(rays), 1)), rays @ rotation)
        uv = (mesh.uvs[mesh.face_uvs[face]] * bary[..., None]).sum(axis=1)
        column, row = (uv[:, 0] * (size - 1)).astype(int), ((1 - uv[:, 1]) * (size - 1)).astype(int)
        colour = np.where((face >= 0)[:, None], np.sqrt(albedo[row, column]), 0.25)
        found.append((255 * colour.clip(0, 1)).astype(np.uint8).reshape(144, 144, 3))
    return tuple(found)


def cut(path: Path, share: float = 0.5) -> None:
    """Leaves the first part of a file only."""
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])


@case("zero bytes", "empty", "limn")
def zero_bytes(folder):
    (folder / "clip.mp4").touch()


@case("truncated mp4", "not a video")
def truncated_mp4(folder):
    cut(write_video(folder / "clip.mp4", head()))


@case("truncated mkv", "cut off")
def truncated_mkv(folder):
    cut(write_video(folder / "clip.mkv", head() * 3))


@case("truncated avi", "cut off")
def truncated_avi(folder):
    cut(write_video(folder / "clip.avi", head() * 3, **FFV1))


@case("sound only", "no video stream")
def sound_only(folder):
    write_sound(folder / "clip.m4a")


@case("random bytes", "not a video")
def random_bytes(folder):
    (folder / "clip.mp4").write_bytes(np.random.default_rng(0).bytes(100_000))


@case("playlist", "not a video")
def playlist(folder):
    (folder / "clip.mp4").write_text("#EXTM3U\n#EXTINF:1,\nfile:///etc/passwd\n#EXTINF:1,\nhttp://localhost:9/a.ts\n")


@case("concat script", "not a video")
def concat_script(folder):
    (folder / "clip.mp4").write_text("ffconcat version 1.0\nfile /etc/passwd\n")


@case("a folder as the clip", "no such video", "limn")
def folder_as_clip(folder):
    (folder / "clip.mp4").mkdir()


@case("a pipe as the clip", "no such video", "limn")
def pipe_as_clip(folder):
    os.mkfifo(folder / "clip.mp4")


@case("a terabyte", "too large", "limn")
def terabyte(folder):
    with open(folder / "clip.mp4", "wb") as file:
        file.truncate(1 << 40)


@case("one frame", "too few usable frames")
def one_frame(folder):
    write_video(folder / "clip.mp4", head()[:1])


@case("a still", "repeats the frame before")
def still(folder):
    write_video(folder / "clip.avi", head()[:1] * 20, **FFV1)


@case("black", "no face")
def black(folder):
    write_video(folder / "clip.mp4", [np.zeros((144, 144, 3), np.uint8)] * 20)


@case("10,000 frames")
def ten_thousand(folder):
    to_and_fro = itertools.islice(itertools.cycle((*head(), *head()[-2:0:-1])), 10_000)
    write_video(folder / "clip.mp4", list(to_and_fro))


@case("too many frames", "too long")
def too_many(folder):
    """One encoded frame, again and again."""
    with av.open(str(folder / "clip.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt = 32, 32, "yuv420p"
        black = av.VideoFrame.from_ndarray(np.zeros((32, 32, 3), np.uint8), format="rgb24")
        (encoded,) = [*stream.encode(black), *stream.encode()]
        for i in range(20_001):
            packet = av.Packet(bytes(encoded))
            packet.stream, packet.time_base, packet.pts, packet.dts = stream, stream.codec_context.time_base, i, i
            packet.is_keyframe = True
            container.mux(packet)


@case("a header that counts a billion frames", "too long")
def billion(folder):
    path = write_video(folder / "clip.avi", head(), **FFV1)
    data = bytearray(path.read_bytes())
    start = data.index(b"avih") + 8
    struct.pack_into("<I", data, start + 16, 10**9)
    struct.pack_into("<I", data, data.index(b"strh") + 8 + 32, 10**9)
    path.write_bytes(data)


@case("16 px", "no face")
def sixteen(folder):
    write_video(folder / "clip.mp4", [cv2.resize(frame, (16, 16)) for frame in head()])


@case("8 px", "too small")
def eight_px(folder):
    write_video(folder / "clip.mp4", [cv2.resize(frame, (8, 8)) for frame in head()])


@case("8K")
def eight_k(folder):
    wide = [cv2.copyMakeBorder(frame, 0, 0, 56, 56, cv2.BORDER_REPLICATE) for frame in head()]
    write_video(folder / "clip.mp4", [cv2.resize(frame, (7680, 4320)) for frame in wide])
    return ["--set", "sample_frames.max_size=256"]


@case("beyond 8K", "size|large")
def beyond_8k(folder):
    size = struct.pack("<HH", 65000, 65000)
    image = b"," + struct.pack("<HH", 0, 0) + size + b"\x00\x02\x02D\x01\x00;"
    (folder / "clip.gif").write_bytes(b"GIF89a" + size + b"\x80\x00\x00" + bytes(6) + image)


@case("rotation flag")
def rotation_flag(folder):
    write_video(folder / "clip.mp4", [np.rot90(frame) for frame in head()], rotation=-90)


@case("mirrored by its display matrix")
def mirrored_by_matrix(folder):
    write_video(folder / "clip.mp4", [frame[::-1] for frame in head()], display_matrix=(1, 0, 0, -1))


@case("turned by 45 degrees", "no quarter turn")
def turned_by_45(folder):
    write_video(folder / "clip.mp4", head(), display_matrix=(0.7071, 0.7071, -0.7071, 0.7071))


@case("a superscript as focal length")
def superscript_focal_length(folder):
    key = "com.apple.quicktime.camera.focal_length.35mm_equivalent"
    write_video(folder / "clip.mp4", head(), metadata={key: "\u00b2"})
    (folder / "subject.yaml").write_text("video: clip.mp4\n")


@case("a preview before the clip")
def preview_first(folder):
    with av.open(str(folder / "clip.mkv"), "w") as container:
        streams = [container.add_stream("ffv1", rate=25) for _ in range(2)]
        for stream, size in zip(streams, (48, 144), strict=True):
            stream.width, stream.height, stream.pix_fmt = size, size, "yuv444p"
        for frame, stream in itertools.product(head(), streams):
            picture = cv2.resize(frame, (stream.width, stream.height))
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        for stream in streams:
            container.mux(stream.encode())


@case("variable frame rate")
def variable_rate(folder):
    times = np.cumsum([0, *np.tile([20, 35, 80, 41], 3)])[:12].tolist()
    write_video(folder / "clip.mkv", head(), pts_ms=times, rate=1000)


@case("10 bits")
def ten_bits(folder):
    write_video(folder / "clip.mkv", head(), codec="ffv1", pixel_format="yuv420p10le", matrix=None)


def pq_codes(rgb: np.ndarray) -> np.ndarray:
    """uint8 sRGB -> uint8 codes that show the same light on a display of 1000 cd/m2 (ITU-R BT.2100-2, table 4)."""
    power = (0.1 * decode_srgb(rgb / 255.0)) ** 0.1593017578125
    return np.uint8(np.round(255.0 * ((0.8359375 + 18.8515625 * power) / (1.0 + 18.6875 * power)) ** 78.84375))


@case("HDR transfer")
def hdr(folder):
    write_video(folder / "clip.mp4", [pq_codes(rgb) for rgb in head()], colour={"color_trc": 16, "color_primaries": 9})


@case("Display P3")
def display_p3(folder):
    write_video(folder / "clip.mp4", head(), colour={"color_trc": 1, "color_primaries": 12})


@case("a logarithmic transfer tag", "not converted")
def logarithmic(folder):
    write_video(folder / "clip.mkv", head(), codec="ffv1", pixel_format="yuv444p", colour={"color_trc": 9})


@case("alpha")
def alpha(folder):
    write_video(folder / "clip.mkv", head(), codec="ffv1", pixel_format="yuva420p", matrix=None)


@case("grey")
def grey(folder):
    write_video(folder / "clip.mkv", head(), codec="ffv1", pixel_format="gray", matrix=None)


@case("gif")
def gif(folder):
    write_video(folder / "clip.gif", head(), codec="gif", pixel_format="rgb8", matrix=None)


@case("oblong pixels", "not square")
def oblong(folder):
    write_video(folder / "clip.mp4", head(), aspect=Fraction(4, 3))


@case("two faces")
def two_faces(folder):
    small = [cv2.resize(frame, (104, 104)) for frame in head()]
    small = [cv2.copyMakeBorder(frame, 20, 20, 20, 20, cv2.BORDER_REPLICATE) for frame in small]
    write_video(folder / "clip.mp4", [np.hstack(pair) for pair in zip(head(), small, strict=True)])


@case("no face", "no face")
def no_face(folder):
    rng = np.random.default_rng(0)
    write_video(folder / "clip.mp4", [cv2.resize(rng.integers(0, 256, (9, 9, 3), np.uint8), (144, 144))] * 12)


@case("profile only", "no face")
def profile_only(folder):
    write_video(folder / "clip.mp4", profiles())


@case("upside down", "upside down")
def upside_down(folder):
    write_video(folder / "clip.mp4", [frame[::-1, ::-1] for frame in head()])


@case("lying", "on its side|no face")
def lying(folder):
    write_video(folder / "clip.mp4", [np.rot90(frame) for frame in head()])


@case("size changes midway")
def size_changes(folder):
    (folder / "clip.mpg").write_bytes(b"")
    parts = [(head() * 3)[:33], [cv2.resize(frame, (96, 96)) for frame in head()[9:]]]
    for number, frames in enumerate(parts):
        write_video(folder / f"{number}.mpg", frames, codec="mpeg1video", matrix=None, options={"b": "4M"})
    data = b"".join((folder / f"{number}.mpg").read_bytes() for number in (0, 1))
    (folder / "clip.mpg").write_bytes(data)
    for number in (0, 1):
        (folder / f"{number}.mpg").unlink()


@case("bits flipped in the pictures")
def flipped(folder):
    path = write_video(folder / "clip.avi", head() * 2, codec="mjpeg", pixel_format="yuvj420p", matrix=None)
    data = bytearray(path.read_bytes())
    with av.open(str(path)) as container:
        packets = [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]
    for start, size in packets[5:8]:
        data[start + size // 2:start + size - 8] = bytes(size - size // 2 - 8)
    path.write_bytes(data)


@case("unicode names")
def unicode_names(folder):
    write_video(folder / "клип 🎥 日本.mp4", head())


@case("markup as a name")
def markup(folder):
    name = "<img src=x onerror=alert(1)>\"'&@{{.mp4"
    write_video(folder / "clip.mp4", head()).rename(folder / name)
    write_settings(folder, name)
