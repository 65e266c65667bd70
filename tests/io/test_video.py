"""Video and image sequences: exact values, times, rotation, bounds, and one clear error per fault."""

import struct
from fractions import Fraction

import av
import cv2
import numpy as np
import OpenEXR
import pytest
from toy_video import drawn_face, turning_face, write_sound, write_video

from shared.errors import InputError
from shared.io import source
from shared.io.images import write_exr, write_png
from shared.io.video import open_video, probe


def test_times_follow_a_variable_frame_rate(tmp_path):
    stamps = [0, 40, 80, 200, 240, 400]
    reader = open_video(write_video(tmp_path / "clip.mkv", turning_face(6), pts_ms=stamps))
    frames = list(reader.frames())
    assert [frame.index for frame in frames] == list(range(6))
    assert [frame.time_s for frame in frames] == pytest.approx([stamp / 1000 for stamp in stamps], abs=0.002)
    assert reader.info.frame_count == 6


@pytest.mark.parametrize("rotation", [90, 180, -90])
def test_the_rotation_flag_is_honoured(tmp_path, rotation):
    upright = turning_face(3)
    stored = [np.rot90(rgb, -rotation // 90) for rgb in upright]
    reader = open_video(write_video(tmp_path / "clip.mp4", stored, rotation=rotation))
    assert (reader.info.width, reader.info.height) == (240, 200)
    assert reader.info.rotation == rotation % 360
    for index, codes in reader:
        assert np.abs(codes.astype(int) - upright[index]).mean() < 4
    assert next(reader.frames()).codes((120, 100)).shape == (100, 120, 3)


MATRICES = {
    "mirrored": ((-1, 0, 0, 1), lambda rgb: rgb[:, ::-1]),
    "upside down in a mirror": ((1, 0, 0, -1), lambda rgb: rgb[::-1]),
    "half a turn": ((-1, 0, 0, -1), lambda rgb: rgb[::-1, ::-1]),
    "clockwise": ((0, 1, -1, 0), lambda rgb: np.rot90(rgb, -1)),
    "transposed": ((0, 1, 1, 0), lambda rgb: rgb.transpose(1, 0, 2)),
    "across the other diagonal": ((0, -1, -1, 0), lambda rgb: np.rot90(rgb, 2).transpose(1, 0, 2)),
}


@pytest.mark.parametrize("name", MATRICES)
def test_the_display_matrix_turns_and_mirrors(tmp_path, name):
    matrix, show = MATRICES[name]
    stored = turning_face(2)
    reader = open_video(write_video(tmp_path / "clip.mp4", stored, display_matrix=matrix))
    for index, codes in reader:
        shown = show(stored[index])
        assert (reader.info.height, reader.info.width) == shown.shape[:2] == codes.shape[:2]
        assert np.abs(codes.astype(int) - shown).mean() < 4
    width, height = reader.info.width // 2, reader.info.height // 2
    assert next(reader.frames()).codes((width, height)).shape == (height, width, 3)


@pytest.mark.parametrize("text", ["\u00b2", "\u0663\u0665", "26.", "1e2", "nan", "-26", "26 mm"])
def test_a_focal_length_that_is_no_number_is_passed_over(tmp_path, text):
    key = "com.apple.quicktime.camera.focal_length.35mm_equivalent"
    path = write_video(tmp_path / "clip.mp4", turning_face(2), metadata={key: text})
    assert probe(path).focal_length_35mm is None
    assert probe(write_video(tmp_path / "b.mp4", turning_face(2), metadata={key: "26.5"})).focal_length_35mm == 26.5


def test_of_two_videos_in_a_file_the_larger_is_taken(tmp_path):
    path = tmp_path / "clip.mkv"
    sizes = {"preview": (96, 80), "clip": (240, 200)}
    with av.open(str(path), "w") as container:
        streams = []
        for width, height in sizes.values():
            stream = container.add_stream("ffv1", rate=25)
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            streams.append(stream)
        for rgb in turning_face(5):
            for stream in streams:
                small = cv2.resize(rgb, (stream.width, stream.height))
                container.mux(stream.encode(av.VideoFrame.from_ndarray(small, format="rgb24")))
        for stream in streams:
            container.mux(stream.encode())
    reader = open_video(path)
    assert (reader.info.width, reader.info.height) == (240, 200) and reader.info.frame_count == 5
    assert all(codes.shape == (200, 240, 3) for _, codes in reader)
    assert any("2 videos" in text for text in reader.info.warnings)


def test_chosen_frames_are_the_same_as_in_a_full_pass(tmp_path):
    reader = open_video(write_video(tmp_path / "clip.mp4", turning_face(20), options={"bf": "3", "crf": "20"}))
    whole = dict(reader)
    some = {frame.index: frame.codes() for frame in reader.frames([3, 11, 17])}
    assert sorted(some) == [3, 11, 17]
    assert all(np.array_equal(whole[i], codes) for i, codes in some.items())
    assert [frame.index for frame in reader.frames(step=6)] == [0, 6, 12, 18]


def test_ten_bit_video_keeps_its_depth(tmp_path):
    path = write_video(tmp_path / "clip.mkv", turning_face(2), codec="ffv1", pixel_format="yuv444p10le")
    reader = open_video(path)
    codes = next(reader.frames()).codes()
    assert reader.info.bits == 10 and codes.dtype == np.uint16
    assert np.abs(codes / 257.0 - turning_face(1)[0]).mean() < 0.5


def test_gif(tmp_path):
    frames = turning_face(5)
    with av.open(str(tmp_path / "clip.gif"), "w") as container:
        stream = container.add_stream("gif", rate=10)
        stream.width, stream.height, stream.pix_fmt = 240, 200, "rgb8"
        for rgb in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(rgb, format="rgb24")))
        container.mux(stream.encode())
    reader = open_video(tmp_path / "clip.gif")
    decoded = dict(reader)
    assert reader.info.frame_count == len(decoded) == 5
    assert np.abs(decoded[4].astype(int) - frames[4]).mean() < 25


@pytest.mark.parametrize(("suffix", "kind"), [("png", np.uint8), ("png", np.uint16), ("tif", np.uint16)])
def test_image_sequences_are_read_exactly(tmp_path, suffix, kind):
    rng = np.random.default_rng(3)
    images = rng.integers(0, np.iinfo(kind).max + 1, (3, 20, 30, 3)).astype(kind)
    for number, image in zip((7, 8, 11), images, strict=True):
        cv2.imwrite(str(tmp_path / f"shot_{number:04d}.{suffix}"), image[..., ::-1])
    reader = open_video(tmp_path / f"shot_%04d.{suffix}")
    frames = dict(reader)
    assert sorted(frames) == [0, 1, 4] and reader.info.frame_count == 5
    assert all(np.array_equal(frames[i], image) for i, image in zip((0, 1, 4), images, strict=True))
    assert any("missing" in text for text in reader.info.warnings)
    assert [frame.index for frame in reader.frames(step=2)] == [0, 4]


def test_photographs_are_turned_as_their_camera_says(tmp_path):
    upright = np.zeros((96, 64, 3), np.uint8)
    upright[:30, -20:] = 250, 20, 20
    directory = struct.pack("<HHHIHHI", 1, 0x112, 3, 1, 6, 0, 0)  # one entry: orientation 6, a quarter turn clockwise
    note = b"Exif\0\0" + b"II*\0" + struct.pack("<I", 8) + directory
    stored = cv2.imencode(".jpg", np.ascontiguousarray(np.rot90(upright)[..., ::-1]))[1].tobytes()
    turned = stored[:2] + b"\xff\xe1" + struct.pack(">H", len(note) + 2) + note + stored[2:]
    (tmp_path / "photo_1.jpg").write_bytes(turned)
    (tmp_path / "photo_2.jpg").write_bytes(b"GIF89a" + stored)
    (tmp_path / "photo_3.jpg").write_bytes(b"")
    first, *others = open_video(tmp_path / "photo_%d.jpg").frames()
    assert np.abs(first.codes().astype(int) - upright).mean() < 2
    assert [frame.fault for frame in others] == ["not an image that can be read"] * 2


def test_grey_and_alpha_images_become_rgb(tmp_path):
    grey = np.random.default_rng(0).integers(0, 256, (20, 30), np.uint8)
    for i in range(2):
        write_png(tmp_path / f"grey_{i}.png", grey)
        cv2.imwrite(str(tmp_path / f"alpha_{i}.png"), np.dstack([grey, grey, grey, grey // 2]))
    assert np.array_equal(dict(open_video(tmp_path / "grey_%d.png"))[1], np.dstack([grey] * 3))
    alpha = open_video(tmp_path / "alpha_%d.png")
    assert np.array_equal(dict(alpha)[0], np.dstack([grey] * 3))
    assert any("alpha" in text for text in alpha.info.warnings)


def test_linear_exr_becomes_sixteen_bit_and_bad_values_are_a_fault(tmp_path):
    linear = np.random.default_rng(0).uniform(0, 1.2, (20, 30, 3)).astype(np.float32)
    write_exr(tmp_path / "f.000.exr", linear, colour_space="lin_rec709_scene")
    write_exr(tmp_path / "f.001.exr", linear[:, :20], colour_space="lin_rec709_scene")
    (tmp_path / "f.002.exr").write_bytes((tmp_path / "f.000.exr").read_bytes()[:500])
    reader = open_video(tmp_path / "f.%03d.exr")
    frames = list(reader.frames())
    assert reader.info.transfer_tag == "linear"
    assert np.abs(frames[0].codes() / 65535 - linear.clip(0, 1)).max() < 1e-5
    assert [bool(frame.fault) for frame in frames] == [False, True, True]


def test_not_a_number_in_an_exr_is_a_fault(tmp_path):
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    with OpenEXR.File(header, {"RGB": np.full((20, 30, 3), np.nan, np.float32)}) as file:
        file.write(str(tmp_path / "f.0.exr"))
    with pytest.raises(InputError, match="NaN"):
        open_video(tmp_path / "f.%d.exr")


def cut_in_half(path):
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    return path


def bad_zero(folder):
    (folder / "clip.mp4").touch()
    return folder / "clip.mp4"


def bad_text(folder):
    (folder / "clip.mp4").write_text("not a film\n" * 50)
    return folder / "clip.mp4"


def bad_playlist(folder):
    (folder / "clip.mp4").write_text("#EXTM3U\n#EXTINF:1,\nfile:///etc/hostname\n")
    return folder / "clip.mp4"


def bad_no_index(folder):
    return cut_in_half(write_video(folder / "clip.mp4", turning_face(30)))


def bad_cut_fast_start(folder):
    noise = [np.random.default_rng(i).integers(0, 256, (96, 96, 3), np.uint8) for i in range(30)]
    return cut_in_half(write_video(folder / "clip.avi", noise, codec="mjpeg", pixel_format="yuvj420p", matrix=None))


def bad_cut_matroska(folder):
    return cut_in_half(write_video(folder / "clip.mkv", turning_face(30)))


def bad_gif_bomb(folder):
    size = struct.pack("<HH", 65000, 65000)
    image = b"," + struct.pack("<HH", 0, 0) + size + b"\x00\x02\x02D\x01\x00;"
    (folder / "clip.gif").write_bytes(b"GIF89a" + size + b"\x80\x00\x00" + bytes(6) + image)
    return folder / "clip.gif"


def bad_counter(folder):
    return folder / "%03d_%03d.png"


def bad_first_image(folder):
    (folder / "0.png").write_bytes(b"\x89PNG nothing")
    return folder / "%d.png"


BAD = {
    "zero bytes": (bad_zero, "0 bytes"),
    "text": (bad_text, "not a video"),
    "a playlist that names another file": (bad_playlist, "not a video"),
    "no index": (bad_no_index, "not a video"),
    "cut off, header first": (bad_cut_fast_start, "cut off"),
    "cut off Matroska": (bad_cut_matroska, "cut off"),
    "sound only": (lambda folder: write_sound(folder / "clip.m4a"), "no video stream"),
    "missing": (lambda folder: folder / "clip.mp4", "missing"),
    "a folder": (lambda folder: folder, "folder"),
    "huge GIF": (bad_gif_bomb, "size|large"),
    "8 px": (lambda folder: write_video(folder / "clip.mp4", [np.zeros((8, 8, 3), np.uint8)] * 3), "too small"),
    "oblong pixels": (lambda folder: write_video(folder / "c.mp4", turning_face(3), aspect=Fraction(4, 3)), "square"),
    "turned by 45 degrees": (lambda folder: write_video(
        folder / "c.mp4", turning_face(3), display_matrix=(0.7071, 0.7071, -0.7071, 0.7071)), "no quarter turn"),
    "stretched when shown": (
        lambda folder: write_video(folder / "c.mp4", turning_face(3), display_matrix=(2, 0, 0, 1)), "not square"),
    "shown as nothing": (
        lambda folder: write_video(folder / "c.mp4", turning_face(3), display_matrix=(1, 0, 1, 0)), "display matrix"),
    "two counters": (bad_counter, "not a pattern"),
    "no image": (lambda folder: folder / "%05d.png", "no image"),
    "no image folder": (lambda folder: folder / "frames" / "%05d.png", "folder"),
    "first image damaged": (bad_first_image, "first image"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_one_clear_line(tmp_path, name):
    make, words = BAD[name]
    path = make(tmp_path)
    with pytest.raises(InputError, match=words) as caught:
        for _ in open_video(path).frames():
            pass
    assert "\n" not in str(caught.value) and str(tmp_path) in str(caught.value)


def test_length_and_size_are_bounded(tmp_path, monkeypatch):
    path = write_video(tmp_path / "clip.mp4", turning_face(12))
    monkeypatch.setattr(source, "MAX_FRAMES", 10)
    with pytest.raises(InputError, match="too long"):
        open_video(path)
    monkeypatch.setattr(source, "MAX_PIXELS", 1000)
    with pytest.raises(InputError, match="too large"):
        open_video(path)


def test_a_damaged_packet_costs_single_frames_only(tmp_path):
    path = write_video(tmp_path / "clip.avi", turning_face(20), codec="mjpeg", pixel_format="yuvj420p", matrix=None)
    content = bytearray(path.read_bytes())
    with av.open(str(path)) as container:
        packets = [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]
    start, size = packets[9]
    content[start + size // 3:start + size] = bytes(size - size // 3)
    path.write_bytes(content)
    frames = {frame.index: frame for frame in open_video(path).frames()}
    assert 19 <= len(frames) <= 20
    sound = [frame.codes() for frame in frames.values() if not frame.fault]
    assert len(sound) >= 18
    assert np.abs(sound[0].astype(int) - drawn_face((90, 95))).mean() < 8
