"""Choosing frames from a clip: survey all candidates in small, keep the good ones evenly in time, find one crop."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from shared.capture.clip_survey import ClipSurvey
from shared.capture.crop_pixels import display_codes
from shared.capture.face_tracker import FaceTrack
from shared.capture.frame_quality import spread_evenly
from shared.capture.framing import Crop, choose_crop, face_height, skull_box
from shared.capture.landmarks import FaceNetworks
from shared.compute.read_ahead import read_ahead
from shared.errors import InputError
from shared.io.image_sequence import ImageSequenceReader
from shared.io.source import SourceFrame, VideoInfo
from shared.io.video import VideoReader

ANALYSIS_SIZE_PX = 1280
MASKS_IN_SURVEY = 30
MIN_FRAMES, FEW_FRAMES = 3, 30
SMALL_FACE_PX = 200
DRIFT_WARNING = 0.1
HINT_FILM = (
    "film one face that fills at least a third of the picture's height, turning slowly from side to side for 5 to 20 "
    "seconds in steady light"
)
Progress = Callable[..., Iterable]


@dataclass(frozen=True)
class Selection:
    """The frames to keep, by rising frame_index, and what to do with them.

    landmarks: per frame [468, 3] source px. sharpness [F]: relative to the neighbours. dropped: frame_index and
    reason of each frame that is not good enough. warnings: sentences for people. summary: one line for the log.
    """

    frame_index: list[int]
    landmarks: list[np.ndarray]
    sharpness: np.ndarray
    crop: Crop
    dropped: list[dict]
    warnings: list[str]
    summary: str


def survey_clip(reader: VideoReader | ImageSequenceReader, networks: FaceNetworks, transfer: str, candidates: int,
                progress: Progress) -> ClipSurvey:
    """The first pass over the clip, looking at about `candidates` evenly spaced frames at 1280 px or less."""
    count = reader.info.frame_count
    stride = max(1, count // candidates)
    size = analysis_size(reader.info)
    survey = ClipSurvey(networks, mask_every=max(1, count // stride // MASKS_IN_SURVEY))

    def look(frame: SourceFrame) -> tuple[SourceFrame, np.ndarray | None]:
        return frame, None if frame.fault else display_codes(frame.codes(size), transfer)

    looks = read_ahead(map(look, reader.frames(step=stride)))
    for frame, rgb in progress(looks, "looking for faces", total=-(-count // stride)):
        survey.add(frame.index, frame.time_s, rgb, frame.fault)
    return survey


def analysis_size(info: VideoInfo) -> tuple[int, int]:
    """(width, height) of the pictures that the survey sees: the source's, or scaled down to 1280 px."""
    scale = min(1.0, ANALYSIS_SIZE_PX / max(info.width, info.height))
    return max(1, round(info.width * scale)), max(1, round(info.height * scale))


def select_frames(survey: ClipSurvey, info: VideoInfo, where: str, *, frame_count: int, max_size: int,
                  blurred_below: float, moves: str) -> Selection:
    """Keep up to frame_count good frames; InputError without a face or with fewer than three such frames.

    where: the clip, for messages. max_size: px, of the crop. blurred_below: relative sharpness. moves: "head" or
    "camera"; with the former the background should stand still.
    """
    face = upright_face(survey, where)
    reasons, sharpness = survey.verdicts(blurred_below)
    usable = np.array([i for i, reason in enumerate(reasons) if not reason], int)
    if len(usable) < MIN_FRAMES:
        raise InputError("too few usable frames", where=where, expected=f"{MIN_FRAMES} or more", hint=HINT_FILM,
                         got=f"{len(usable)} of {survey.count}" + f" ({tally(reasons)})" * any(reasons))
    kept = usable[spread_evenly(np.array(survey.time_s)[usable], sharpness[usable], frame_count)]
    analysed = analysis_size(info)
    to_source = np.array([info.width / analysed[0], info.height / analysed[1]])
    head_boxes = survey.head_boxes(kept) * np.tile(to_source, 2)
    landmarks = [face.observations[int(i)] * [*to_source, to_source[0]] for i in kept]
    crop = choose_crop(head_boxes, info.width, info.height, max_size)
    return Selection(
        frame_index=[survey.frame_index[i] for i in kept],
        landmarks=landmarks,
        sharpness=sharpness[kept],
        crop=crop,
        dropped=[{"frame_index": index, "reason": reason}
                 for index, reason in zip(survey.frame_index, reasons, strict=True) if reason],
        warnings=[*_face_warnings(survey, landmarks), *_loss_warnings(reasons, len(kept)),
                  *_scene_warnings(survey, info, kept, landmarks, reasons, moves)],
        summary=f"{len(kept)} of {info.frame_count} frames, dropped: {tally(reasons) or 'none'}; "
                f"crop {crop.width} x {crop.height} px, scale {crop.scale:g}",
    )


def upright_face(survey: ClipSurvey, where: str) -> FaceTrack:
    """The face that the clip is about; InputError where there is none, or the head lies on its side."""
    face = survey.main_face
    if face is None:
        raise InputError("no face found in the clip", where=where, got=f"{survey.count} frames looked at",
                         expected="a face that looks towards the camera, the right way up", hint=HINT_FILM)
    turns = survey.quarter_turns()
    if turns:
        transpose = {1: "transpose=2", 2: "hflip,vflip", 3: "transpose=1"}[turns]
        raise InputError("the head is upside down" if turns == 2 else "the head lies on its side", where=where,
                         expected="an upright head", hint=f"ffmpeg -i IN -vf {transpose} -c:v libx264 -crf 12 OUT.mp4")
    return face


def tally(reasons: list[str]) -> str:
    """Reasons with their counts, most frequent first: "12 blurred, 3 no face found"."""
    kinds = [reason.split(":")[0] for reason in reasons if reason]
    return ", ".join(f"{kinds.count(kind)} {kind}" for kind in sorted(set(kinds), key=lambda k: (-kinds.count(k), k)))


def _face_warnings(survey: ClipSurvey, landmarks: list[np.ndarray]) -> Iterator[str]:
    if survey.other_faces:
        yield f"{survey.other_faces + 1} faces in the clip: the largest and most lasting one is taken"
    yield from small_face(float(np.median([face_height(points) for points in landmarks])))


def small_face(height_px: float) -> list[str]:
    """A warning where a face of this height, px of the source frame, shows too little."""
    if height_px >= SMALL_FACE_PX:
        return []
    return [f"the face is only {height_px:.0f} px high: maps will be coarse ({SMALL_FACE_PX} px or more are good)"]


def _loss_warnings(reasons: list[str], kept: int) -> Iterator[str]:
    if kept < FEW_FRAMES:
        yield f"only {kept} usable frames: expect less detail ({FEW_FRAMES} or more are good)"
    lost = sum(bool(reason) for reason in reasons)
    if lost > len(reasons) / 4:
        yield f"{lost} of {len(reasons)} frames dropped: {tally(reasons)}"


def _scene_warnings(survey: ClipSurvey, info: VideoInfo, kept: np.ndarray, landmarks: list[np.ndarray],
                    reasons: list[str], moves: str) -> Iterator[str]:
    limits = np.array([info.width, info.height])
    heads = np.stack([skull_box(points) for points in landmarks])
    out = (heads[:, :2] < 0).any(axis=1) | (heads[:, 2:] > limits).any(axis=1)
    if out.any():
        yield f"the head reaches beyond the picture's edge in {np.count_nonzero(out)} of {len(out)} frames"
    drift = survey.background_drift(kept, *analysis_size(info))
    contradiction = survey.motion_contradicts(moves, reasons)
    if contradiction:
        yield contradiction
    elif moves == "head" and drift > DRIFT_WARNING:
        yield f"the background's brightness wanders by {drift:.0%}: lock the exposure and keep the light still"
