"""Small clips drawn and encoded for the tests, and stand-ins for the face networks that know the drawn faces."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from shared.capture.landmarks import CHIN, EYE_LEFT, EYE_RIGHT, OVAL, Detection

SKIN = (210, 150, 120)


def drawn_face(centre: tuple[float, float], size: float = 60, width: int = 240, height: int = 200,
               skin: tuple[int, int, int] = SKIN, seed: int = 0) -> np.ndarray:
    """uint8 [H, W, 3]: a textured ellipse, half height `size` px, before a wall that brightens to the right."""
    rng = np.random.default_rng(seed)
    wall = np.full((height, width, 3), (60, 70, 80), np.uint8)
    wall += np.linspace(0, 40, width).astype(np.uint8)[:, None]
    texture = cv2.resize(rng.integers(-40, 40, (40, 40, 1)).astype(np.float32), (width, height))
    y, x = np.mgrid[0:height, 0:width] + 0.5
    inside = ((x - centre[0]) / (0.75 * size)) ** 2 + ((y - centre[1]) / size) ** 2 <= 1
    moved = np.roll(texture, (round(centre[1]), round(centre[0])), axis=(0, 1))
    face = np.clip(np.array(skin) + moved[..., None], 0, 255).astype(np.uint8)
    return np.where(inside[..., None], face, wall)


def turning_face(count: int, **options) -> list[np.ndarray]:
    """Frames in which the face wanders from left to right."""
    return [drawn_face((90 + 2.0 * i, 95 + (i % 3)), **options) for i in range(count)]


def write_video(path: Path, frames: Sequence[np.ndarray], *, codec: str = "libx264", pixel_format: str = "yuv420p",
                rate: int = 25, rotation: int | None = None, pts_ms: Sequence[int] | None = None,
                matrix: int | None = 1, options: dict | None = None, aspect: Fraction | None = None,
                colour: dict | None = None, display_matrix: Sequence[float] | None = None,
                metadata: dict | None = None) -> Path:
    """Encodes uint8 RGB frames, with very little loss by default. display_matrix: a, b, c, d, see orientation.py."""
    quality = {"crf": "8", "preset": "ultrafast"} if codec == "libx264" else {}
    flags = {"movflags": "use_metadata_tags"} if metadata else {}
    with av.open(str(path), "w", options=flags) as container:
        container.metadata.update(metadata or {})
        stream = container.add_stream(codec, rate=rate, options=options or quality)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = pixel_format
        if aspect:
            stream.codec_context.sample_aspect_ratio = aspect
        for name, value in ({"colorspace": matrix} if matrix else {}).items() | (colour or {}).items():
            setattr(stream.codec_context, name, value)
        if rotation is not None:
            stream.set_display_rotation(rotation)
        if display_matrix is not None:
            a, b, c, d = (round(65536 * value) for value in display_matrix)
            stream.set_display_matrix([a, b, 0, c, d, 0, 0, 0, 1 << 30])
        for i, rgb in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")
            if matrix:
                frame = frame.reformat(format=pixel_format, dst_colorspace=matrix,
                                       interpolation=4 | 0x40000 | 0x2000 | 0x4000)
                frame.colorspace = matrix
            if pts_ms is not None:
                frame.pts, frame.time_base = pts_ms[i], Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def write_sound(path: Path) -> Path:
    """A second of silence in a file without pictures."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=48000)
        for _ in range(47):
            frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
            frame.sample_rate = 48000
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def oval_landmarks(centre: np.ndarray, half: np.ndarray) -> np.ndarray:
    """[468, 3] px: the oval on an ellipse (chin lowest), eyes level, all else in the middle."""
    points = np.tile([*centre, 0.0], (468, 1))
    angle = 2 * np.pi * np.arange(len(OVAL)) / len(OVAL)
    points[list(OVAL), :2] = centre + half * np.stack([np.sin(angle), -np.cos(angle)], axis=1)
    points[list(EYE_RIGHT), :2] = centre - half * (0.4, 0.2)
    points[list(EYE_LEFT), :2] = centre + half * (0.4, -0.2)
    assert OVAL.index(CHIN) == len(OVAL) // 2
    return points


class DrawnFaceNetworks:
    """Finds the reddish regions of a picture; the interface of FaceNetworks."""

    def __init__(self, score: float = 0.95) -> None:
        self.score = score
        self.calls = {"detect": 0, "track": 0}

    def detect(self, rgb: np.ndarray, min_score: float = 0.5, zoom: bool = True) -> list[Detection]:
        """Every reddish region, largest first."""
        self.calls["detect"] += 1
        _, _, stats, _ = cv2.connectedComponentsWithStats(_skin(rgb).astype(np.uint8))
        boxes = [np.array([x, y, x + w, y + h], float) for x, y, w, h, area in stats[1:] if area > 200]
        boxes.sort(key=lambda box: -np.prod(box[2:] - box[:2]))
        return [Detection(self.score, box, np.zeros((6, 2))) for box in boxes]

    def landmarks(self, rgb: np.ndarray, detection: Detection) -> tuple[float, np.ndarray]:
        """The ellipse inside the box."""
        box = detection.box
        return 1.0, oval_landmarks((box[:2] + box[2:]) / 2, (box[2:] - box[:2]) / 2)

    def track(self, rgb: np.ndarray, previous: np.ndarray) -> tuple[float, np.ndarray]:
        """The region nearest to the face before."""
        self.calls["track"] += 1
        centre = (previous[:, :2].min(axis=0) + previous[:, :2].max(axis=0)) / 2
        found = [d for d in self.detect(rgb) if np.linalg.norm((d.box[:2] + d.box[2:]) / 2 - centre) < 40]
        self.calls["detect"] -= 1
        return self.landmarks(rgb, found[0]) if found else (0.0, previous)

    def person_mask(self, rgb: np.ndarray) -> np.ndarray:
        """1 where reddish."""
        return _skin(rgb).astype(np.float32)


def _skin(rgb: np.ndarray) -> np.ndarray:
    values = rgb.astype(int)
    return values[..., 0] - values[..., 2] > 40
