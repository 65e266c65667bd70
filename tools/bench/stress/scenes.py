"""What stands before the camera in a stress test: a synthetic head under some light, as linear pictures with truth.

A scene is rendered once and kept; what a camera makes of it is another matter (camera), and scenes under
different lights may be added up, because light is additive.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path

import numpy as np

from shared.io.arrays import save_arrays
from shared.rendering.envmap import latlong_directions
from tools.synthesis import output
from tools.synthesis.camera import PictureQuality, PinholeCamera
from tools.synthesis.gaze import HALF_SHUT
from tools.synthesis.head import Head, random_head
from tools.synthesis.irradiance import IrradianceQuality, SyntheticShot
from tools.synthesis.makeup import made_up, sweaty
from tools.synthesis.render import RenderQuality, Scene, render
from tools.synthesis.skin import Complexion, SkinPainter
from tools.synthesis.subject import (
    LIVING,
    SENSOR_MM,
    SynthesisSettings,
    head_model,
    light_of,
    living,
    near_lamps,
    plan_shots,
    with_eyes,
)
from tools.synthesis.surface import Materials
from tools.synthesis.wear import coloured, with_beard, with_fringe, with_glasses

SETTINGS = SynthesisSettings(size=224, frames=24, level=1, texture=512, truth_frames=6, lights=("room",),
                             light_height=32,
                             irradiance=IrradianceQuality(size=128, directions=512, lamp_samples=16),
                             picture=PictureQuality(sub=2, lobe_samples=1, lamp_samples=2))
"""Small, so that a run takes less than a minute on one core; the face is 115 px high."""
RECIPE = 2
"""Raise it whenever SETTINGS or the code that renders give other pictures: kept scenes and rows are then not used."""
TINTS = np.array([[1.0, 0.12, 0.1], [0.1, 0.25, 1.0]])
"""Colours of the light from the left and from the right."""
SMILE = {"mouth_smile_left": 1.0, "mouth_smile_right": 1.0, "jaw_open": 0.35, "cheek_puff": 0.2}
SMILE_TIMES = ((0.40, 0.5), (0.44, 1.0), (0.66, 0.5), (0.70, 0.0))
LONG_SMILE_TIMES = ((0.40, 0.5), (0.44, 1.0), (0.84, 0.5), (0.88, 0.0))
"""From which share of the clip on how much of the smile there is."""
SPEECH = {"jaw_open": 0.8, "mouth_stretch": 0.3, "mouth_pucker": 0.2}
SYLLABLE_FRAMES, OPENINGS = 5.3, 4
"""Frames from one syllable to the next, which no whole number of them makes up, and in how many steps lips part."""


@dataclass(frozen=True)
class StressScene:
    """light: one of ENVIRONMENTS; on_head: it turns with the head; lamp_mm: how far its lamps stand, 0: far away; tint:
    how coloured the two sides are, 0 to 1.

    tone: melanin; makeup, wet, fringe: shares; glasses_mm, beard_mm: thickness; smile: what comes and goes mid-clip;
    long_smile: the same for almost half of it; speech: how far lips move in all of it. gaze: share of the head's turn
    by which the eyes turn back to hold the camera; blink: how often they blink, per second; where either is not 0 they
    are living eyes, which wear nothing and show no expression.
    """

    light: str = "room"
    on_head: bool = False
    lamp_mm: float = 0.0
    tint: float = 0.0
    tone: float = 0.35
    makeup: float = 0.0
    wet: float = 0.0
    glasses_mm: float = 0.0
    fringe: float = 0.0
    beard_mm: float = 0.0
    smile: float = 0.0
    long_smile: float = 0.0
    speech: float = 0.0
    gaze: float = 0.0
    blink: float = 0.0
    yaw_deg: float = SETTINGS.yaw_deg
    pitch_deg: float = SETTINGS.pitch_deg
    frames: int = SETTINGS.frames
    seed: int = 0

    @property
    def name(self) -> str:
        """What differs from the defaults, and a digest of everything that decides the pictures."""
        changed = [f"{f.name}{getattr(self, f.name):g}" if not isinstance(getattr(self, f.name), str)
                   else getattr(self, f.name) for f in fields(self) if getattr(self, f.name) != f.default]
        content = json.dumps([self.content, RECIPE], sort_keys=True)
        return "_".join([*changed, hashlib.sha256(content.encode()).hexdigest()[:8]])

    @property
    def content(self) -> dict:
        """Of a digest. Without what later versions added, where it is not used: what was rendered before stays."""
        return {name: value for name, value in asdict(self).items() if value or name not in ("gaze", "blink")}

    @property
    def living(self) -> bool:
        """Do the eyes move?"""
        return bool(self.gaze or self.blink)

    @property
    def settings(self) -> SynthesisSettings:
        """Of the synthesiser; sharp highlights need more samples."""
        quality = SETTINGS.picture if not self.wet else replace(SETTINGS.picture, lobe_samples=4, lamp_samples=8)
        return replace(SETTINGS, frames=self.frames, yaw_deg=self.yaw_deg, pitch_deg=self.pitch_deg, tone=self.tone,
                       lights=(self.light,), seed=self.seed, picture=quality,
                       **({"eyes": LIVING, "gaze": "camera", "gaze_share": self.gaze, "blinks_per_second": self.blink}
                          if self.living else {}))


def camera() -> PinholeCamera:
    """The one that looks at every scene."""
    return PinholeCamera(SETTINGS.size, SETTINGS.size, SETTINGS.focal_mm / SENSOR_MM * SETTINGS.size)


def render_scene(scene: StressScene, folder: Path, processes: int = 1) -> Path:
    """folder/<scene's name> with radiance.npy [F, H, W, 3] half floats and gt/; rendered unless it is there."""
    done = folder / scene.name
    if (done / "radiance.npy").exists():
        return done
    settings, plan = scene.settings, living_plan(scene) if scene.living else _plan(scene)
    shots, truth = plan.shots, plan.truth
    (done / "gt").mkdir(parents=True, exist_ok=True)
    output.write_scene_truth(done / "gt", plan.states[0][0], plan.states[0][0].mesh, 10)
    pictures: list[np.ndarray | None] = [None] * scene.frames
    for state, index in plan.states:
        quality = RenderQuality(settings.irradiance, settings.picture, settings.seed)
        chosen = [shots[i] for i in index]
        wanted = [i in truth for i in index]
        for i, images in zip(index, render(state, chosen, camera(), quality, wanted, processes), strict=True):
            pictures[i] = images["radiance"]
            if i in truth:
                output.write_buffers(str(done / "gt" / "frames" / f"{i:04d}"), images, images, 10)
    poses = np.stack([shot.camera_from_head for shot in shots])
    output.write_poses(done / "gt" / "poses.npz", poses, camera(), truth, plan.eyes)
    save_arrays(done / "landmarks.npz", points_head=plan.landmarks)
    temporary = done / "radiance.tmp.npy"
    np.save(temporary, np.stack(pictures).astype(np.float16))
    temporary.rename(done / "radiance.npy")
    return done


@dataclass(frozen=True, eq=False)
class ScenePlan:
    """What is to be rendered: states, each with the frames that show it, the neutral one first; all frames' shots; the
    frames that get buffers; landmarks [468, 3] mm; what is true of living eyes."""

    states: list[tuple[Scene, list[int]]]
    shots: list[SyntheticShot]
    truth: np.ndarray
    landmarks: np.ndarray
    eyes: dict[str, np.ndarray] = field(default_factory=dict)


def _plan(scene: StressScene) -> ScenePlan:
    """A scene of its own for each strength of the expression."""
    states, light = list(_states(scene)), _light(scene)
    shots = _shots(scene, states[0][0])
    lamps_at = near_lamps(shots, scene.lamp_mm)
    lit = [(Scene(head.mesh, materials, (light,), lamps_at=lamps_at), index) for head, materials, index in states]
    still = np.nonzero(expressions_of(scene)[1] == 0)[0]
    return ScenePlan(lit, shots, _truth_frames(still), states[0][0].landmarks())


def living_plan(scene: StressScene) -> ScenePlan:
    """Of a scene whose eyes and lids move: one state, whose shots have the gaze."""
    head, materials, eyes = living(scene.settings)
    shots, lids, seen = with_eyes(_shots(scene, head), head, eyes.eyes, scene.settings)
    lit = Scene(head.mesh, materials, (_light(scene),), lamps_at=near_lamps(shots, scene.lamp_mm), eyes=eyes, lids=lids)
    opened = np.nonzero((seen["aperture"] >= HALF_SHUT).all(1))[0]
    return ScenePlan([(lit, list(range(scene.frames)))], shots, _truth_frames(opened), head.landmarks(), seen)


def _shots(scene: StressScene, head: Head) -> list[SyntheticShot]:
    shots = plan_shots(head.mesh, scene.settings)
    return [replace(shot, world_from_head=np.eye(3)) for shot in shots] if scene.on_head else shots


def expressions_of(scene: StressScene) -> tuple[dict[str, float], np.ndarray]:
    """The facial actions that the scene's expression is made of, and how much of it each frame shows [F]; 0: none."""
    if scene.speech:
        return SPEECH, scene.speech * opening_of(scene.frames)
    times = LONG_SMILE_TIMES if scene.long_smile else SMILE_TIMES
    return SMILE, (scene.long_smile or scene.smile) * smile_of(scene.frames, times)


def smile_of(frames: int, times: Sequence[tuple[float, float]] = SMILE_TIMES) -> np.ndarray:
    """[F] how much of the smile each frame shows."""
    time, amount = np.arange(frames) / frames, np.zeros(frames)
    for start, value in times:
        amount[time >= start] = value
    return amount


def opening_of(frames: int) -> np.ndarray:
    """[F] how far lips that speak are open in each frame, in steps from 0 to 1."""
    syllable = np.abs(np.sin(np.pi * np.arange(frames) / SYLLABLE_FRAMES))
    return np.round(OPENINGS * np.maximum(1.5 * syllable - 0.5, 0.0)) / OPENINGS


def _truth_frames(still: np.ndarray) -> np.ndarray:
    """Frames that get buffers, evenly spread over those with the face that the mesh has, still [N]."""
    return still[np.unique(np.linspace(0, len(still) - 1, SETTINGS.truth_frames).round().astype(int))]


def _states(scene: StressScene) -> Iterator[tuple[Head, Materials, list[int]]]:
    """Heads with their textures and frames: the neutral one first."""
    model = head_model(SETTINGS.level)
    actions, amount = expressions_of(scene)
    neutral = random_head(model, scene.seed, False)
    # Painted once: what the skin shows moves along with it.
    painter = SkinPainter(neutral, SETTINGS.texture, scene.seed)
    stubble = 1.3 if scene.beard_mm else Complexion.stubble
    materials = sweaty(made_up(painter.paint(Complexion(tone=scene.tone, stubble=stubble)), painter, scene.makeup),
                       scene.wet)
    if scene.glasses_mm or scene.fringe:
        materials = coloured(materials)
    for value in sorted(set(amount)):
        head = random_head(model, scene.seed, False, {name: value * part for name, part in actions.items()})
        if scene.beard_mm:
            head = with_beard(head, scene.beard_mm, scene.seed)
        if scene.glasses_mm:
            head = with_glasses(head, scene.glasses_mm)
        if scene.fringe:
            head = with_fringe(head, scene.fringe, scene.seed)
        yield head, materials, np.nonzero(amount == value)[0].tolist()


def _light(scene: StressScene) -> np.ndarray:
    """[H, 2 H, 3] the scene's environment."""
    image = light_of(scene.light, scene.settings)
    side = np.clip(0.5 + 1.5 * latlong_directions(len(image))[..., :1], 0.0, 1.0)
    tint = (1 - side) * TINTS[0] + side * TINTS[1]
    return (image * (1.0 + scene.tint * (tint - 1.0))).astype(np.float32)
