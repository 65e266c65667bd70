"""The perturbations of the stress test: where methods fail, each with a severity that grows from none.

A case says what stands before the camera, what the camera makes of it, and what the subject's files claim. Pictures are
exposed so that the skin is not clipped, unless that is what the perturbation is about. The perturbation at 0 is one and
the same case for all of them. Perturbations stand in the order of how likely they are to fail in silence.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass

from tools.bench.stress.camera import Sensor
from tools.bench.stress.scenes import SETTINGS, StressScene
from tools.synthesis.subject import SENSOR_MM


@dataclass(frozen=True)
class StressCase:
    """mix: scenes with their gains, added up. focal_gain: stated focal length over the true one.

    pose_error_deg: of poses that come with the subject and are held. landmark_slide: how far landmarks that come with
    the subject lie off at the widest turn, as a share of the face's width; None: none come. keep: how many frames are
    left, 0: all. shake_px: turn of the camera from frame to frame. mirrored: as some front cameras write
    pictures, which then show the mirrored head: what Limn gives is compared with that.
    """

    mix: tuple[tuple[StressScene, float], ...] = ((StressScene(), 1.0),)
    sensor: Sensor = Sensor()
    focal_gain: float = 1.0
    pose_error_deg: float = 0.0
    landmark_slide: float | None = None
    keep: int = 0
    shake_px: float = 0.0
    mirrored: bool = False

    @property
    def digest(self) -> str:
        """Of all that decides the subject."""
        whole = asdict(self) | {"mix": [[scene.content, gain] for scene, gain in self.mix]}
        content = [[[scene.name, gain] for scene, gain in self.mix], whole]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:12]


@dataclass(frozen=True)
class Perturbation:
    """severities: as people count them, in `unit`; make: severity -> case; says: what a warning about it mentions."""

    name: str
    what: str
    unit: str
    severities: tuple[float, ...]
    make: Callable[[float], StressCase]
    says: str


def _seen(**look: float) -> StressCase:
    return StressCase(mix=((StressScene(**look), 1.0),))


def _shot(**sensor: float) -> StressCase:
    return StressCase(sensor=Sensor(**sensor))


def _between(other: StressScene, share: float, exposure: float = 1.0) -> StressCase:
    return StressCase(mix=((StressScene(), 1.0 - share), (other, share)), sensor=Sensor(exposure=exposure))


def _lamp_at(distance_mm: float) -> StressCase:
    """Most of the light from one lamp at a distance."""
    return _between(StressScene(light="lamp", lamp_mm=distance_mm), 0.7, 2**-0.6)


PERTURBATIONS = (
    Perturbation("cap_lamp", "light that moves with the head", "share of the light", (0.3, 0.8),
                 lambda s: _between(StressScene(light="cap", on_head=True), s),
                 r"moves with the head|moves along|follows? the head"),
    Perturbation("wrong_transfer", "a transfer function other than the stated one", "exponent - 1", (0.16, 1.2),
                 lambda s: _shot(gamma=1.0 + s), r"transfer"),
    Perturbation("white_drift", "white balance that drifts", "log gain, red over green", (0.04, 0.2),
                 lambda s: _shot(white_drift=s), r"white balance|colour (wanders|changes|drifts)"),
    Perturbation("exposure_drift", "exposure that drifts", "log gain", (0.08, 0.4, 0.6),
                 lambda s: _shot(exposure_drift=s), r"exposure|brightness wanders"),
    Perturbation("bands", "bands of a lamp on mains under a rolling shutter", "log gain", (0.05, 0.2),
                 lambda s: _shot(bands=s), r"flicker|bands|brightness wanders"),
    Perturbation("flicker", "light that flickers from frame to frame", "log gain", (0.05, 0.15),
                 lambda s: _shot(flicker=s), r"flicker|bands|brightness wanders"),
    Perturbation("log_footage", "log-like footage that is stated to be sRGB", "share of the log curve", (0.2, 1.0),
                 lambda s: _shot(log_curve=s), r"transfer"),
    Perturbation("shake", "a camera that shakes in the hand", "px from frame to frame", (2.0, 8.0),
                 lambda s: StressCase(shake_px=s), r"shak|camera moves|do not fit"),
    Perturbation("defocus", "focus that misses the face", "px", (1.2, 3.5),
                 lambda s: _shot(defocus_px=s), r"blur|focus|sharp"),
    Perturbation("motion_blur", "a slow shutter", "px at the fastest turn", (3.0, 9.0),
                 lambda s: _shot(motion_px=s), r"blur|focus|sharp"),
    Perturbation("near_dark", "hardly any light, and noise", "stops below", (4.0, 6.5),
                 lambda s: _shot(exposure=2.0**-s), r"underexposed|too dark|noise"),
    Perturbation("compression", "compression", "100 - JPEG quality", (65.0, 92.0),
                 lambda s: _shot(jpeg=round(100 - s)), r"compress|blocks"),
    Perturbation("overexposed", "one side overexposed", "stops above", (1.0, 2.0),
                 lambda s: _shot(exposure=2.0**s), r"overexposed"),
    Perturbation("hard_sun", "a single hard sun", "share of the light", (0.5, 1.0),
                 lambda s: _between(StressScene(light="lamp"), s, 2 ** (-0.85 * s)), r"hard (light|lamp|sun)|shadow"),
    Perturbation("near_lamp", "a lamp that stands near", "1 / m, its nearness", (0.1, 1.0, 1 / 0.6, 2.5),
                 lambda s: _lamp_at(1000.0 / s) if s else StressCase(), r"(light|lamp).*near|near (light|lamp)"),
    Perturbation("coloured_light", "red light from the left, blue from the right", "saturation", (0.5, 1.0),
                 lambda s: _seen(tint=s), r"coloured|tint"),
    Perturbation("glasses", "glasses", "mm, thickness of the rims", (0.8, 2.5),
                 lambda s: _seen(glasses_mm=s), r"glasses|hair|covers|in front of"),
    Perturbation("fringe", "hair over the forehead", "share covered", (0.3, 0.8),
                 lambda s: _seen(fringe=s), r"glasses|hair|covers|in front of"),
    Perturbation("smile", "an expression that changes mid-clip", "strength", (0.4, 1.0),
                 lambda s: _seen(smile=s), r"expression|mouth|do not fit"),
    Perturbation("long_smile", "a smile in almost half of the clip", "strength", (0.4, 1.0),
                 lambda s: _seen(long_smile=s), r"expression|mouth|do not fit"),
    Perturbation("speech", "someone who speaks", "how far the lips part", (0.5, 1.0),
                 lambda s: _seen(speech=s), r"expression|mouth|do not fit"),
    Perturbation("gaze", "eyes that hold the camera while the head turns", "share of the turn", (0.5, 1.0),
                 lambda s: _seen(gaze=s), r"gaze|eyes"),
    Perturbation("blink", "someone who blinks", "blinks per second", (1.0, 2.0),
                 lambda s: _seen(blink=s), r"blink|eyes"),
    Perturbation("wrong_focal", "a focal length given too long", "log of stated over true", (0.1, 0.3, math.log(3.0)),
                 lambda s: StressCase(focal_gain=math.exp(s)), r"focal"),
    Perturbation("short_focal", "a focal length given too short", "log of true over stated", (0.3, math.log(3.0)),
                 lambda s: StressCase(focal_gain=math.exp(-s)), r"focal"),
    Perturbation("swapped_lens", "focal length and sensor width swapped", "of 1", (1.0,),
                 lambda s: StressCase(focal_gain=math.exp(s * 2.0 * math.log(SENSOR_MM / SETTINGS.focal_mm))),
                 r"focal"),
    Perturbation("mirrored", "pictures that the camera mirrored", "of 1", (1.0,),
                 lambda s: StressCase(mirrored=bool(s)), r"mirror"),
    Perturbation("narrow_turn", "a turn too small", "degrees short of the usual 27", (15.0, 22.0),
                 lambda s: _seen(yaw_deg=27.0 - s, pitch_deg=max(12.0 - 0.5 * s, 2.0)), r"changes by only|turn"),
    Perturbation("wide_turn", "a wide turn", "degrees beyond the usual 27", (18.0,),
                 lambda s: _seen(yaw_deg=27.0 + s), r"turn|do not fit"),
    Perturbation("few_frames", "few frames", "frames left out of 24", (12.0, 18.0, 21.0),
                 lambda s: StressCase(keep=round(SETTINGS.frames - s)), r"usable frames"),
    Perturbation("pose_error", "poses of another tracker, held", "degrees", (0.5, 1.0, 3.0),
                 lambda s: StressCase(pose_error_deg=s), r"poses|do not fit"),
    Perturbation("landmark_bias", "landmarks of another tracker that slide", "share of the face's width", (0.02, 0.06),
                 lambda s: StressCase(landmark_slide=s), r"landmarks|do not fit"),
    Perturbation("dark_skin", "very dark skin", "melanin beyond 0.35", (0.65, 1.25),
                 lambda s: _seen(tone=0.35 + s), r"scale|skin's (tone|luminance)"),
    Perturbation("light_skin", "very light skin", "melanin short of 0.35", (0.25,),
                 lambda s: _seen(tone=0.35 - s), r"scale|skin's (tone|luminance)"),
    Perturbation("beard", "beard", "mm", (3.0, 9.0), lambda s: _seen(beard_mm=s), r"beard|hair"),
    Perturbation("sweat", "sweat", "share", (0.5, 1.0), lambda s: _seen(wet=s), r"highlight|gloss|specular"),
    Perturbation("makeup", "make-up with sharp edges", "cover", (0.5, 1.0), lambda s: _seen(makeup=s), r"make-up"),
    Perturbation("many_frames", "more frames", "frames beyond 24", (72.0,),
                 lambda s: _seen(frames=round(SETTINGS.frames + s)), r"frames"),
)
