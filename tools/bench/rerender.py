"""The held-out frames of a run rendered anew from what it wrote, and where in them skin, eyes, lips and head are.

The run itself re-renders a few frames, most of them fitted. Here one renderer makes all held-out ones from mesh, maps,
light and poses, with visibility and bounces, gaze and lids; the normal map, which the run's own re-renders leave out
too, is left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shared.actions.facial import facial_actions
from shared.errors import InputError
from shared.geometry.blend_shapes import LID_ACTIONS, LidActions
from shared.geometry.mesh import interpolate
from shared.geometry.raycast import camera_hits
from shared.geometry.surface import Surface
from shared.hair.joined import HAIR_SEGMENT
from shared.imaging.color import CLIPPED_CODE
from shared.imaging.frame_index import spread_frames
from shared.imaging.material_labels import SKIN
from shared.imaging.texture import sample_bilinear
from shared.imaging.turning_eyes import TurningEyes
from shared.inverse.problem import FACE_SKIN
from shared.io.arrays import load_arrays, read_json
from shared.io.frames import FrameSet
from shared.io.material_maps import read_material
from shared.rendering.precomputed_transfer import Sizes
from shared.rendering.studio_lights import studio_light
from shared.rendering.views import HeadViews, ViewCamera, clip_camera
from shared.tracking.eyes import lids_in_frames
from shared.tracking.models import load_head_model
from tools.relight.inputs import Asset, open_asset
from tools.scoring.held_out import HeldOutFrame

REGIONS = {"skin": FACE_SKIN, "eyes": ("eyes", "eye_sockets", "lids"), "lips": ("lips", "inner_mouth")}
"""Segments of each region; `head` is all that the mesh covers within the person mask, `bare_skin` what of the skin's
segments the map of materials calls skin: no beard, and no hair that falls over a cheek."""
SIZES = Sizes(directions=768, nodes=700)
RELIT_UNDER = "low_sun"
FILLED = 0.99
"""Share of a pixel from which on head and hair fill it."""


@dataclass(frozen=True, eq=False)
class HeldOutCamera:
    """A held-out frame as the run has it: its number, its place in the frame set, and its camera."""

    frame: int
    place: int
    camera: ViewCamera


class SolvedClip:
    """What a run (work/) says about its clip, ready to be rendered. at_most: held-out frames, evenly spread; 0: all.
    InputError where the run holds no frame out or its mesh has no segments."""

    def __init__(self, run: Path, at_most: int = 0):
        work = run / "work"
        self.asset: Asset = open_asset(work / "inverse_render", (0.5,) * 3, 0.0, 0.5)
        self.frames = FrameSet.open(work / "sample_frames")
        self.held_out = _held_out(work, self.frames, at_most)
        segment = load_arrays(work / "inverse_render" / "mesh.npz").get("face_segment")
        if segment is None:
            raise InputError("the mesh has no face segments", where=str(work / "inverse_render" / "mesh.npz"))
        names = read_json(work / "track_landmarks" / "tracking.json")["segments"]
        count = len(self.asset.mesh.faces) - len(segment)
        segment, names = np.concatenate([segment, np.full(count, len(names))]), (*names, HAIR_SEGMENT)
        self.segment_names = np.array(names)[segment]
        is_skin = (read_material(work / "inverse_render" / "maps" / "material.exr").argmax(2) == SKIN)[..., None]
        self.is_skin = np.concatenate([is_skin, np.zeros_like(is_skin)], axis=1) if count else is_skin
        cameras = [item.camera for item in self.held_out]
        turn = any(camera.gaze is not None for camera in cameras)
        eyes = TurningEyes.of(Surface(self.asset.mesh, segment, tuple(names))) if turn else None
        head = self.asset.mesh.faces[: len(segment) - count]
        moving = facial_actions(load_head_model(), self.asset.mesh.vertices[: head.max() + 1], head, LID_ACTIONS)
        lids = LidActions.of(moving)
        self.views = HeadViews(self.asset.mesh, self.asset.maps, SIZES, cameras, eyes=eyes, lids=lids,
                               head_faces=self.asset.head_faces)

    def compared(self) -> list[HeldOutFrame]:
        """Every held-out frame beside its re-render under the clip's light."""
        cameras = [item.camera for item in self.held_out]
        renders = self.views.render(self.asset.envmap, cameras, self.asset.moves, fade=False, lamp=self.asset.lamp)
        return [
            HeldOutFrame(item.frame, self.frames.read_linear(item.place), render, self.regions(item))
            for item, render in zip(self.held_out, renders, strict=True)
        ]

    def regions(self, item: HeldOutCamera) -> dict[str, np.ndarray]:
        """{region: [H, W] bool} of the pixels that count in a frame."""
        sure = filled_and_unclipped(self.frames.read_codes(item.place), self.frames.read_mask(item.place),
                                    self.views.coverage(item.camera))  # fmt: skip
        found = region_pixels(self.shown(item), sure)
        return found | {"bare_skin": found["skin"] & (self._texture(item, self.is_skin)[..., 0] > 0.5)}

    def shown(self, item: HeldOutCamera) -> np.ndarray:
        """[H, W] str: the segment that each pixel's centre shows, "" beside the head."""
        face, _ = self._seen(item.camera)
        return np.where(face >= 0, self.segment_names[face], "")

    def clipped_share(self) -> float:
        """Share of the bare skin's pixels in which a channel is clipped, in all held-out frames."""
        clipped = [is_clipped(self.frames.read_codes(item.place))[np.isin(self.shown(item), FACE_SKIN)] for item in
                   self.held_out]  # fmt: skip
        return float(np.concatenate(clipped).mean())

    def albedo(self, item: HeldOutCamera) -> np.ndarray:
        """[H, W, 3] linear: the albedo map as the camera sees it, 0 beside the head."""
        return self._texture(item, self.asset.maps["diffuse_albedo"])

    def relit(self, item: HeldOutCamera) -> np.ndarray:
        """[H, W, 3] linear: the head as the camera sees it under a studio light, 0 beside it."""
        return self.views.render(studio_light(RELIT_UNDER), [item.camera], "head", fade=False)[0]

    def _texture(self, item: HeldOutCamera, texture: np.ndarray) -> np.ndarray:
        """[H, W, C]: a texture [S, S, C] as the camera sees it, 0 beside the head."""
        face, bary = self._seen(item.camera)
        hit, mesh = face >= 0, self.asset.mesh
        picture = np.zeros((*face.shape, texture.shape[2]), np.float32)
        place = interpolate(mesh.uvs, mesh.face_uvs, face[hit], bary[hit])
        picture[hit] = sample_bilinear(texture.astype(np.float32, copy=False), place)
        return picture

    def _seen(self, camera: ViewCamera) -> tuple[np.ndarray, np.ndarray]:
        face, bary, _ = camera_hits(self.views.viewer.scene, camera.camera_from_head, camera.intrinsics, *camera.size)
        return face, bary


def is_clipped(codes: np.ndarray) -> np.ndarray:
    """[H, W, 3] codes -> [H, W] bool: some channel tells only that it was at least so bright."""
    return (codes >= CLIPPED_CODE * np.iinfo(codes.dtype).max).any(-1)


def filled_and_unclipped(codes: np.ndarray, mask: np.ndarray, coverage: np.ndarray) -> np.ndarray:
    """[H, W] bool: pixels that head and hair fill (coverage [H, W]), inside the person mask [H, W] and not
    clipped in any channel of codes [H, W, 3]."""
    return (coverage > FILLED) & (mask > 0) & ~is_clipped(codes)


def region_pixels(shown: np.ndarray, sure: np.ndarray) -> dict[str, np.ndarray]:
    """{region: [H, W] bool} from the segment that each pixel shows [H, W] str, where sure [H, W]."""
    found = {name: sure & np.isin(shown, segments) for name, segments in REGIONS.items()}
    return found | {"head": sure & (shown != "")}


def _held_out(work: Path, frames: FrameSet, at_most: int) -> list[HeldOutCamera]:
    """The frames that inverse_render held out, with its poses and the lens of track_landmarks."""
    solved, tracked = load_arrays(work / "inverse_render" / "poses.npz"), work / "track_landmarks"
    record = read_json(tracked / "tracking.json")
    lids = lids_in_frames(load_arrays(tracked / "landmarks.npz"), record, solved["frame_index"])
    solved |= {} if lids is None else {"lids": lids}
    lens = solved["intrinsics_crop"]
    place = {int(frame): k for k, frame in enumerate(solved["frame_index"])}
    numbers = read_json(work / "inverse_render" / "solve.json")["held_out_frames"]
    if not numbers:
        raise InputError("no frame was held out", where=str(work / "inverse_render" / "solve.json"))
    chosen = spread_frames(len(numbers), at_most) if at_most else range(len(numbers))
    return [
        HeldOutCamera(frame, frames.position(frame), clip_camera(solved, place[frame], lens, frames.size))
        for frame in (numbers[k] for k in chosen)
    ]  # fmt: skip
