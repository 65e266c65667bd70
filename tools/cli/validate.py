"""`limn validate`: a subject's inputs by themselves, in seconds, without writing anything.

The clip is decoded once from end to end, so that a cut-off file shows; faces are looked for in some frames of it only.
Where those show none, as many are looked at as sample_frames would, so that the verdict is the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from shared.capture.cameras import source_intrinsics
from shared.capture.framing import face_height
from shared.capture.landmarks import FaceNetworks
from shared.capture.sample_clip import analysis_size, small_face, survey_clip, upright_face
from shared.contract.subject import Subject
from shared.errors import InputError
from shared.io.image_sequence import ImageSequenceReader
from shared.io.video import VideoReader, open_video
from shared.tracking.given_tracking import read_given_landmarks, read_given_poses
from shared.tracking.models import load_face_networks
from stages.sample_frames import STAGE, transfer_warnings, watch_for_chart, watch_grey_place

LOOKS = 24
"""Frames in which a face is looked for at first."""
WHOLE = (0.0, 0.0, 1.0)
"""The crop that is the whole frame: x0, y0, scale."""


@dataclass(frozen=True)
class Findings:
    """Of one clip. facts: in words. error: why no run can begin, None where one may. crash: an error of ours."""

    name: str
    facts: str = ""
    warnings: Sequence[str] = ()
    error: InputError | None = None
    crash: str = ""

    def lines(self) -> list[str]:
        """For people."""
        return [f"{self.name}: {self.facts}", *(f"  warning: {text}" for text in self.warnings)] if self.facts else []


def validate(subjects: Sequence[Subject]) -> Iterator[Findings]:
    """The findings on each clip of each subject; nothing that is wrong with one stops the others."""
    networks = load_face_networks()
    for subject in subjects:
        for clip in subject.clips or (subject,):
            name = f"{subject.name}/{clip.name}" if subject.clips else subject.name
            try:
                yield _look_at(name, clip, networks)
            except InputError as error:
                yield Findings(name, error=error)
            except OSError as error:
                where = str(error.filename or clip.video)
                yield Findings(name, error=InputError("cannot be read", where=where, got=error.strerror or error))
            except Exception as error:  # what a strange file does to a library must not hide the other subjects
                yield Findings(name, crash=f"{clip.video}: {type(error).__name__}: {' '.join(str(error).split())}")


def _look_at(name: str, clip: Subject, networks: FaceNetworks) -> Findings:
    reader = open_video(clip.video)
    info = reader.info
    intrinsics, is_known, warning = source_intrinsics(
        info, clip.focal_length_px, clip.focal_length_mm, clip.sensor_width_mm)
    _read_given(clip, info.frame_count)
    watch_for_chart(reader, clip)
    watch_grey_place(reader, clip)
    height_px = _face_height_px(reader, clip, networks)
    facts = (f"{info.width} x {info.height} px, {info.frame_count} frames, {info.fps:.4g} frames/s, {info.codec}; "
             f"focal length {intrinsics[0, 0]:.0f} px{'' if is_known else ' (not given)'}; "
             f"face {height_px:.0f} px high")
    warnings = [*info.warnings, *transfer_warnings(info.transfer_tag, clip.transfer), *([] if is_known else [warning]),
                *small_face(height_px)]
    return Findings(name, facts, warnings)


def _read_given(clip: Subject, frame_count: int) -> None:
    """InputError where another tracker's files do not belong to the clip."""
    frames = np.arange(frame_count)
    if clip.landmarks is not None:
        read_given_landmarks(clip.landmarks, frames, WHOLE)
    if clip.poses is not None:
        read_given_poses(clip.poses, frames)


def _face_height_px(reader: VideoReader | ImageSequenceReader, clip: Subject, networks: FaceNetworks) -> float:
    """Median height of the face, px of the source frame; InputError where there is none, or no upright one."""
    defaults = STAGE.defaults()
    for looks in (LOOKS, defaults["frame_count"] * defaults["candidates"]):
        survey = survey_clip(reader, networks, clip.transfer, looks, lambda items, *_, **__: items)
        if survey.main_face is not None or survey.count == reader.info.frame_count:
            break
    observed = upright_face(survey, str(clip.video)).observations.values()
    return float(np.median([face_height(points) for points in observed])) * (
        reader.info.height / analysis_size(reader.info)[1])
