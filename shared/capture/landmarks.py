"""Faces in a picture: boxes, 468 landmarks, person mask.

The networks are BlazeFace (short range), Face Mesh and Selfie Segmentation of MediaPipe (Apache-2.0), run
through OpenCV's dnn module. The crops follow MediaPipe's graphs: the detector sees the whole picture
letterboxed; the landmark network sees a square turned so that the eyes are level and 1.5 times as large as
the face.

References: [Bazarevsky2019] (BlazeFace); [Kartynnik2019] (Face Mesh).
"""

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from shared.errors import InputError

LANDMARK_COUNT = 468
DETECTOR_SIZE = 128
LANDMARK_SIZE = 192
MASK_SIZE = 256
CROP_ENLARGEMENT = 1.5
MIN_PRESENCE = 0.5
SETTLING_CROPS = 2
"""The crop follows the landmarks, which follow the crop: after so many more rounds they hardly move."""

# "Right" is the subject's own right: the left side of an ordinary picture. Closed loops run in order.
# fmt: off
OVAL = (10, 338, 297, 332, 284, 251, 389, 356, 454, 323, 361, 288, 397, 365, 379, 378, 400, 377,
        152, 148, 176, 149, 150, 136, 172, 58, 132, 93, 234, 127, 162, 21, 54, 103, 67, 109)
# fmt: on
EYE_RIGHT = (33, 246, 161, 160, 159, 158, 157, 173, 133, 155, 154, 153, 145, 144, 163, 7)
EYE_LEFT = (263, 466, 388, 387, 386, 385, 384, 398, 362, 382, 381, 380, 374, 373, 390, 249)
LIPS = (61, 185, 40, 39, 37, 0, 267, 269, 270, 409, 291, 375, 321, 405, 314, 17, 84, 181, 91, 146)
BROW_RIGHT = (70, 63, 105, 66, 107, 55, 65, 52, 53, 46)
BROW_LEFT = (300, 293, 334, 296, 336, 285, 295, 282, 283, 276)
EYE_CORNERS_RIGHT = (33, 133)  # outer, inner
EYE_CORNERS_LEFT = (263, 362)
CHIN = 152


class Detection(NamedTuple):
    """One face: score in [0, 1]; box [4] = x0, y0, x1, y1 px; keypoints [6, 2] px.

    Keypoints: right eye, left eye, nose tip, mouth, right ear, left ear (right = the subject's).
    """

    score: float
    box: np.ndarray
    keypoints: np.ndarray


class FaceNetworks:
    """The three networks, loaded once; pictures are uint8 [H, W, 3] RGB, points are px with centres at +0.5."""

    def __init__(self, detector_path: Path, landmarks_path: Path, person_mask_path: Path) -> None:
        """Load the three .tflite files; InputError where OpenCV cannot read one."""
        self._detector = load_network(detector_path)
        self._landmarks = load_network(landmarks_path)
        self._person_mask = load_network(person_mask_path)
        self._anchors = _ssd_anchors()

    def detect(self, rgb: np.ndarray, min_score: float = 0.5, zoom: bool = True) -> list[Detection]:
        """Find faces, best first.

        rgb: uint8 [H, W, 3]. min_score: in [0, 1]. zoom: where the whole picture shows no face, look again
        through overlapping square windows of 1, 1/2 and 1/3 of the short side (the network needs a face of at
        least a sixth of what it sees); there the landmark network must agree, since many windows make many
        guesses.
        """
        height, width = rgb.shape[:2]
        found = self._detect_window(rgb, (0, 0, width, height), min_score)
        for fraction in (1.0, 0.5, 1 / 3) if zoom else ():
            if found:
                break
            side = max(DETECTOR_SIZE // 2, round(min(height, width) * fraction))
            for window in _windows(width, height, side):
                guesses = _suppress(self._detect_window(rgb, window, min_score))
                found += [guess for guess in guesses if self.landmarks(rgb, guess)[0] > MIN_PRESENCE]
        return _suppress(found)

    def landmarks(self, rgb: np.ndarray, detection: Detection) -> tuple[float, np.ndarray]:
        """468 landmarks of one detected face, with one re-crop from its own first answer.

        Returns presence in [0, 1] and points [468, 3]: x, y in px; z in px too, smaller towards the camera.
        """
        centre = (detection.box[:2] + detection.box[2:]) / 2
        size = float(np.max(detection.box[2:] - detection.box[:2]))
        eyes = detection.keypoints[1] - detection.keypoints[0]
        _, points = self._landmarks_in_crop(rgb, _crop_to_image(centre, size, eyes))
        return self.track(rgb, points)

    def track(self, rgb: np.ndarray, previous: np.ndarray) -> tuple[float, np.ndarray]:
        """As `landmarks`, with the crop taken from landmarks [468, >=2] of the frame before: no detection. previous
        [468, >=2] px."""
        low, high = previous[:, :2].min(axis=0), previous[:, :2].max(axis=0)
        eyes = previous[EYE_CORNERS_LEFT[0], :2] - previous[EYE_CORNERS_RIGHT[0], :2]
        crop = _crop_to_image((low + high) / 2, float(np.max(high - low)), eyes)
        return self._landmarks_in_crop(rgb, crop)

    def find(
        self, rgb: np.ndarray, previous: np.ndarray | None, least_presence: float
    ) -> tuple[float, np.ndarray | None]:
        """Presence and landmarks [468, 3] px of one frame of a clip; (presence, None) below least_presence.

        previous: landmarks of a neighbouring frame, or None. They only tell which of several faces is meant, and stand
        in where the detector finds none: what they would add to the crop, the frame would inherit from its neighbour,
        and a clip run backwards would be tracked otherwise. previous [468, >=2] px.
        """
        faces = self.detect(rgb)
        if previous is not None and len(faces) > 1:
            middle = previous[:, :2].mean(axis=0)
            faces.sort(key=lambda face: np.linalg.norm((face.box[:2] + face.box[2:]) / 2 - middle))
        certain, points = self.landmarks(rgb, faces[0]) if faces else (0.0, None)
        if certain < least_presence and previous is not None:
            certain, points = self.track(rgb, previous)
        return self._settled(rgb, certain, points, least_presence)

    def find_alone(self, rgb: np.ndarray, least_presence: float) -> tuple[float, np.ndarray | None] | None:
        """What `find` says whatever the neighbouring frame was; None where that one has a say: several faces, or none
        that is certain. rgb: uint8 [H, W, 3]; least_presence: in [0, 1]."""
        faces = self.detect(rgb)
        if len(faces) != 1:
            return None
        certain, points = self.landmarks(rgb, faces[0])
        return None if certain < least_presence else self._settled(rgb, certain, points, least_presence)

    def _settled(self, rgb, certain, points, least_presence) -> tuple[float, np.ndarray | None]:
        for _ in range(SETTLING_CROPS if certain >= least_presence else 0):
            certain, points = self.track(rgb, points)
        return (certain, points) if certain >= least_presence else (certain, None)

    def person_mask(self, rgb: np.ndarray) -> np.ndarray:
        """Probability that a pixel shows a person: float32 [H, W] in [0, 1], from one pass at 256 x 256.

        The network was made for a head and shoulders that fill the picture: hand it a crop around the person,
        two to four times as wide as the face's box.
        """
        height, width = rgb.shape[:2]
        small = cv2.resize(rgb, (MASK_SIZE, MASK_SIZE), interpolation=cv2.INTER_AREA)
        (mask,) = run_network(self._person_mask, small.astype(np.float32) / 255, (MASK_SIZE * MASK_SIZE,))
        mask = mask.reshape(MASK_SIZE, MASK_SIZE)
        return cv2.resize(mask, (width, height), interpolation=cv2.INTER_CUBIC).clip(0, 1)

    def _detect_window(self, rgb: np.ndarray, window: tuple[int, int, int, int], min_score: float) -> list[Detection]:
        """Faces inside x0, y0, x1, y1 of the picture, letterboxed to the detector's input."""
        x0, y0, x1, y1 = window
        side = max(x1 - x0, y1 - y0)
        scale = DETECTOR_SIZE / side
        offset = np.array([x0 - (side - (x1 - x0)) / 2, y0 - (side - (y1 - y0)) / 2])
        part = cv2.resize(
            rgb[y0:y1, x0:x1], None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        )
        padded = np.zeros((DETECTOR_SIZE, DETECTOR_SIZE, 3), np.float32)
        top, left = (DETECTOR_SIZE - part.shape[0]) // 2, (DETECTOR_SIZE - part.shape[1]) // 2
        padded[top : top + part.shape[0], left : left + part.shape[1]] = part / 127.5 - 1
        boxes, logits = run_network(self._detector, padded, (896 * 16, 896))
        scores = _sigmoid(logits)
        found = []
        for i in np.nonzero(scores >= min_score)[0]:
            values = boxes.reshape(896, 8, 2)[i] / DETECTOR_SIZE
            centre = values[0] + self._anchors[i]
            box = np.concatenate([centre - values[1] / 2, centre + values[1] / 2]).reshape(2, 2)
            keypoints = values[2:] + self._anchors[i]
            found.append(Detection(float(scores[i]), (box * side + offset).ravel(), keypoints * side + offset))
        return found

    def _landmarks_in_crop(self, rgb: np.ndarray, image_from_crop: np.ndarray) -> tuple[float, np.ndarray]:
        """Presence and points [468, 3] px from the crop that the affine map [2, 3] describes."""
        crop = crop_under(rgb, image_from_crop, LANDMARK_SIZE)
        values, logit = run_network(self._landmarks, crop, (LANDMARK_COUNT * 3, 1))
        points = values.reshape(LANDMARK_COUNT, 3).astype(np.float64)
        scale = float(np.sqrt(np.linalg.det(image_from_crop[:, :2])))
        points[:, :2] = points[:, :2] @ image_from_crop[:, :2].T + image_from_crop[:, 2]
        points[:, 2] *= scale
        return float(_sigmoid(logit)[0]), points


def crop_under(rgb: np.ndarray, image_from_crop: np.ndarray, size: int) -> np.ndarray:
    """float32 [size, size, 3] in [0, 1]: the crop of a picture (uint8) that the affine map image_from_crop [2, 3]
    describes, px with centres at +0.5."""
    # cv2 counts pixel centres from 0.0, we from 0.5: shift on both sides.
    warp = image_from_crop.copy()
    warp[:, 2] += warp[:, :2] @ (0.5, 0.5) - 0.5
    return warped(rgb, warp, size)


def warped(rgb: np.ndarray, image_from_crop: np.ndarray, size: int) -> np.ndarray:
    """float32 [size, size, 3] in [0, 1]: the picture (uint8) under an affine map image_from_crop [2, 3] of
    integer-centred pixels.

    In floating point: 8-bit results round the other way on other processors, which moves landmarks by 0.01 px.
    """
    corners = np.array([[0, 0, 1], [size, 0, 1], [0, size, 1], [size, size, 1]]) @ image_from_crop.T
    height, width = rgb.shape[:2]
    low = np.clip(np.floor(corners.min(0)).astype(int) - 1, 0, (width - 1, height - 1))
    high = np.clip(np.ceil(corners.max(0)).astype(int) + 2, low + 1, (width, height))
    part = rgb[low[1] : high[1], low[0] : high[0]].astype(np.float32) / 255
    part_from_crop = image_from_crop - np.column_stack([np.zeros((2, 2)), low])
    return cv2.warpAffine(part, part_from_crop, (size, size), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)


def load_network(path: Path) -> cv2.dnn.Net:
    """A .tflite file as a network; InputError where OpenCV cannot read it."""
    try:
        return cv2.dnn.readNetFromTFLite(str(path), cv2.dnn.ENGINE_CLASSIC)
    except cv2.error as error:
        raise InputError(
            "a face network cannot be read",
            where=str(path),
            got=str(error).strip().splitlines()[-1],
            expected="an undamaged .tflite file",
            hint="run make setup",
        ) from error


def run_network(net: cv2.dnn.Net, image: np.ndarray, sizes: tuple[int, ...]) -> list[np.ndarray]:
    """Run a network on an image float32 [H, W, 3]; outputs, flattened, in the order of the element counts
    `sizes`.
    """
    net.setInput(np.ascontiguousarray(image.transpose(2, 0, 1)[None]))
    outputs = net.forward(net.getUnconnectedOutLayersNames())
    return [next(output for output in outputs if output.size == size).ravel() for size in sizes]


def _sigmoid(logits: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-np.clip(logits.astype(np.float64), -50, 50)))


def _ssd_anchors() -> np.ndarray:
    """Anchor centres [896, 2] of the short-range detector: 16 x 16 cells of two, then 8 x 8 cells of six."""
    anchors = []
    for cells, per_cell in ((16, 2), (8, 6)):
        y, x = np.meshgrid((np.arange(cells) + 0.5) / cells, (np.arange(cells) + 0.5) / cells, indexing="ij")
        anchors.append(np.repeat(np.stack([x, y], axis=-1).reshape(-1, 2), per_cell, axis=0))
    return np.concatenate(anchors)


def _windows(width: int, height: int, side: int) -> list[tuple[int, int, int, int]]:
    """Square windows of `side` px that cover the picture, each overlapping its neighbour by half or more."""

    def starts(length: int) -> np.ndarray:
        count = 1 + int(np.ceil(max(0, length - side) / (side / 2)))
        return np.rint(np.linspace(0, max(0, length - side), count)).astype(int)

    return [
        (int(x), int(y), min(int(x) + side, width), min(int(y) + side, height))
        for y in starts(height)
        for x in starts(width)
    ]


def _suppress(detections: list[Detection], max_overlap: float = 0.3) -> list[Detection]:
    """Weighted non-maximum suppression of BlazeFace: overlapping answers are averaged by score, best first."""
    rest = sorted(detections, key=lambda d: -d.score)
    kept = []
    while rest:
        best = rest.pop(0)
        group = [best] + [d for d in rest if box_overlap(best.box, d.box) > max_overlap]
        rest = [d for d in rest if box_overlap(best.box, d.box) <= max_overlap]
        weights = np.array([d.score for d in group])
        kept.append(
            Detection(
                best.score,
                np.average([d.box for d in group], axis=0, weights=weights),
                np.average([d.keypoints for d in group], axis=0, weights=weights),
            )
        )
    return kept


def box_overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Shared area of two boxes a [4] and b [4] (x0, y0, x1, y1) over the smaller one's: a nested box counts as the
    same face."""
    sides = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
    smaller = min(np.prod(a[2:] - a[:2]), np.prod(b[2:] - b[:2]))
    return float(np.prod(np.maximum(sides, 0)) / max(smaller, 1e-9))


def _crop_to_image(centre: np.ndarray, size: float, eyes: np.ndarray) -> np.ndarray:
    """Affine map [2, 3] from the 192 px crop to the picture: level with the eye line, 1.5 times the face's
    size.
    """
    angle = np.arctan2(eyes[1], eyes[0])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    linear = turn * (CROP_ENLARGEMENT * size / LANDMARK_SIZE)
    return np.column_stack([linear, centre - linear @ np.full(2, LANDMARK_SIZE / 2)])
