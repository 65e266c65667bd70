"""Make a head-turn clip whose every truth is known: the demo subject, and at tiny size the tests' subject.

    python -m tools.synthesize DEST [--preset demo|tiny] [--size 400] [--frames 48] [--light lamp] [--chart] ...
    python -m tools.synthesize DEST --scan SUBJECT --light lamp --clipped 0.25
    python -m tools.synthesize DEST --light lamp --lamp-distance 600
    python -m tools.synthesize DEST --eyes living --gaze wander --blinks 1
    python -m tools.synthesize DEST --hair ears --beard 6 --collar

Writes:  DEST/subject.yaml, capture.json, the clip (video.avi, or frames/%04d.png), synthesis.json (how it was made);
         gt/: mesh.obj, albedo.exr, specular.exr, roughness.exr, mask.exr (UV), envmap.exr, poses.npz, where lamps
         stand near lamp.json, of heads with hair or a collar label.png (UV), and for some frames frames/NNNN_*.exr and
         .png; relight/: the same head under other lights. tools/score.py reads all of it but labels. poses.npz of
         living eyes: gaze.true_eyes says what else it holds.
Method:  a random head of the head model with procedural skin, bumps and bust, or the scan of another subject; a
         procedural light; direct light with its diffuse bounces and the GGX lobe, traced with embree (irradiance,
         camera); sensor noise, 8-bit sRGB.
The clip is FFV1 in AVI: of the encoders in OpenCV's wheel the lossy ones shift colours by 2 to 3 codes on their way
through YUV 4:2:0, FFV1 returns every code value. The same arguments give the same bytes, whatever the number of
processes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np
from tqdm import tqdm

from shared.errors import InputError
from shared.geometry.mesh import Mesh
from shared.geometry.transforms import rigid, rotation_from_vector, world_from_head
from shared.io.arrays import save_arrays, write_json
from shared.rendering.envmap import latlong_directions
from shared.tracking.head_model import HeadModel
from shared.tracking.models import load_head_model
from tools.synthesis import output
from tools.synthesis.camera import PictureQuality, PinholeCamera
from tools.synthesis.chart import place_chart
from tools.synthesis.eyes import LivingEyes, living_head
from tools.synthesis.gaze import GAZES, HALF_SHUT, eye_motion, true_eyes
from tools.synthesis.hair import HAIRCUTS, Growth, coloured, grown
from tools.synthesis.head import PITCH_DEG, YAW_DEG, Head, face_part, head_turn, random_head
from tools.synthesis.iris import EyePaint, paint_eyes
from tools.synthesis.irradiance import IrradianceQuality, SyntheticShot
from tools.synthesis.light import ENVIRONMENTS, LampSphere, procedural_environment
from tools.synthesis.lips import with_shut_lips
from tools.synthesis.render import RenderQuality, Scene, render
from tools.synthesis.scan import read_scan
from tools.synthesis.skin import Complexion, SkinPainter, skin_of
from tools.synthesis.surface import Materials

SENSOR_MM, FPS = 22.3, 25.0
DISTANCE_PER_FOCAL = 950.0 / 60.0
"""The camera stands where the head fills the same part of the picture, whatever its lens."""

TOP_MARGIN_MM = 27.0
WITH_CHART = 1.5
"""Width of a picture that holds a chart, relative to its height."""
FACE_RADIANCE = 0.32
"""Mean linear radiance of the face, seen from the front, to which the exposure is set. Skin darker than the default's
is exposed for by half of that, in stops: it stays darker in the picture, and its highlights do not all burn out."""
EXPOSURE_SIZE, EXPOSURE_VIEWS = 200, 3
"""Pictures by which the light is set so that a share of the face burns out: how large, how many."""
LEAST_IRRADIANCE = 0.8
"""Texels of the irradiance per pixel along an edge, of a scan and in burning light: the edges of cast shadows are about
as sharp as the pictures."""
LEAST_LAMP_DISTANCE = 300.0
"""mm from the head's origin: nearer, a lamp would stand among hair and shoulders."""
LIVING = "living"
DENSE_BEARD = 14.0
"""Stubble of a beard that hides most of the skin below it."""
MOST_BEARD_MM = 30.0
RELIGHT_YAWS_DEG = {"front": 0.0, "left15": -15.0, "right15": 15.0}


@dataclass(frozen=True)
class SynthesisSettings:
    """Everything that decides the result.

    level: subdivisions of the head model. noise: standard deviation of the sensor at full scale. lights: the clip's,
    then those of relight/. truth_frames: how many frames get all buffers. mantissa_bits: precision of the truth on
    disk. eyes: open and closed ones are painted and stand still; living ones turn and blink: gaze and gaze_share as in
    gaze.eye_motion, blinks_per_second. face_truth_only: gt/mesh.obj holds the face without the rest of the head.
    chart: a colour chart stands beside the head, and the picture is half as wide again to hold it. specular_scale:
    factor on the specular intensity; 0: matte. growth: hair, beard and collar, whose truth has labels. clipped: share
    of the face's skin on which a channel burns out, over the clip; 0: the light is as bright as FACE_RADIANCE says.
    lamp_distance_mm: of the lamps of the clip's light from the head's mean place, where they then give the irradiance
    that they give far away; 0: they are far away. scan: folder of a subject whose ground truth takes the procedural
    head's place.
    """

    size: int = 400
    frames: int = 48
    seed: int = 0
    eyes: str = "open"
    tone: float = 0.35
    lights: tuple[str, ...] = ("room", "studio", "sky")
    light_height: int = 64
    noise: float = 0.006
    level: int = 2
    texture: int = 1024
    focal_mm: float = 60.0
    yaw_deg: float = YAW_DEG
    pitch_deg: float = PITCH_DEG
    truth_frames: int = 8
    mantissa_bits: int = 10
    face_truth_only: bool = False
    video: str = "video.avi"
    chart: bool = False
    specular_scale: float = 1.0
    clipped: float = 0.0
    lamp_distance_mm: float = 0.0
    scan: str | None = None
    gaze: str = "ahead"
    gaze_share: float = 1.0
    blinks_per_second: float = 0.0
    growth: Growth = Growth()
    irradiance: IrradianceQuality = IrradianceQuality()
    picture: PictureQuality = PictureQuality()

    def record(self) -> dict:
        """For synthesis.json: what living eyes do, and hair, are left out where there are none."""
        values = asdict(self)
        if self.eyes != LIVING:
            for name in ("gaze", "gaze_share", "blinks_per_second"):
                del values[name]
        if not self.growth:
            del values["growth"]
        return values


PRESETS = {
    "demo": SynthesisSettings(),
    "tiny": SynthesisSettings(size=144, frames=12, level=0, texture=128, truth_frames=1, mantissa_bits=4,
                              face_truth_only=True, lights=("room",), light_height=32, noise=0.0015,
                              video="frames/%04d.png",
                              irradiance=IrradianceQuality(size=160, directions=768, bounces=1)),
}


def synthesize(destination: Path, settings: SynthesisSettings, processes: int) -> None:
    """Makes the subject in `destination`, which may not hold one yet. Errors: InputError."""
    if (destination / "subject.yaml").exists():
        raise InputError("holds a subject already", where=str(destination), hint="choose another folder or remove it")
    eyes = None
    if settings.eyes == LIVING:
        head, materials, eyes = living(settings)
        mesh, true_mesh = head.mesh, face_part(head) if settings.face_truth_only else head.mesh
    else:
        mesh, true_mesh, materials = scanned(settings) if settings.scan else procedural(settings)
        materials = replace(materials, specular=settings.specular_scale * materials.specular)
    lights = tuple(light_of(name, settings) for name in settings.lights)
    distance, height = camera_place(mesh, settings)
    chart = place_chart(distance, height, settings.seed) if settings.chart else None
    shots, lids, seen = plan_shots(mesh, settings), (0.0,), {}
    clip = np.arange(settings.frames)
    if eyes is not None:
        shots, lids, seen = with_eyes(shots, head, eyes.eyes, settings)
        clip = clip[(seen["aperture"] >= HALF_SHUT).all(1)]
    lamps_at = near_lamps(shots[:settings.frames], settings.lamp_distance_mm)
    if settings.clipped:
        scene = Scene(mesh, materials, lights[:1], lamps_at=lamps_at, eyes=eyes, lids=lids)
        gain = burning_gain(scene, shots[:settings.frames], settings, processes)
        lights = (np.float32(gain) * lights[0], *lights[1:])
    scene = Scene(mesh, materials, lights, chart, lamps_at, eyes, lids)
    width = round(WITH_CHART * settings.size) if settings.chart else settings.size
    camera = PinholeCamera(width, settings.size, settings.focal_mm / SENSOR_MM * settings.size)
    truth = clip[np.unique(np.linspace(0, len(clip) - 1, settings.truth_frames).round().astype(int))]
    destination.mkdir(parents=True, exist_ok=True)
    output.write_scene_truth(destination / "gt", scene, true_mesh, settings.mantissa_bits)
    poses = np.stack([shot.camera_from_head for shot in shots[:settings.frames]])
    output.write_poses(destination / "gt" / "poses.npz", poses, camera, truth, seen)
    with_buffers = [i in truth or i >= settings.frames for i in range(len(shots))]
    quality = RenderQuality(settings.irradiance, settings.picture, settings.seed)
    pictures = render(scene, shots, camera, quality, with_buffers, processes)
    _write_clip(destination, settings, camera, truth, islice(pictures, settings.frames))
    if len(lights) > 1:
        _write_relight(destination / "relight", settings, scene, shots[settings.frames:], pictures)
    write_json(destination / "synthesis.json", settings.record())
    # Last, so that an interrupted run leaves no subject.
    output.write_description(
        destination, camera, focal_mm=settings.focal_mm, sensor_mm=SENSOR_MM * width / settings.size,
        frames=settings.frames, fps=FPS, video=settings.video,
    )


def procedural(settings: SynthesisSettings) -> tuple[Mesh, Mesh, Materials]:
    """A random head: its mesh, the part of it that the truth holds, its textures."""
    head = random_head(head_model(settings.level), settings.seed, settings.eyes == "closed")
    growth, complexion = settings.growth, Complexion(tone=settings.tone)
    if growth:
        head = grown(head, growth, settings.seed)
    if growth.beard_mm:
        complexion = replace(complexion, stubble=DENSE_BEARD)
    materials = SkinPainter(head, settings.texture, settings.seed).paint(complexion, labelled=bool(growth))
    if growth:
        materials = coloured(materials, growth, complexion.hair_colour, settings.seed)
    return head.mesh, face_part(head) if settings.face_truth_only else head.mesh, materials


def living(settings: SynthesisSettings) -> tuple[Head, Materials, EyePaint]:
    """As procedural, with living eyes and shut lips: the head, its textures on which the eyes look ahead, and how they
    look."""
    head, eyes = living_head(head_model(settings.level), settings.seed)
    head = with_shut_lips(head)
    painter, paint = SkinPainter(head, settings.texture, settings.seed), paint_eyes(eyes, settings.tone, settings.seed)
    materials = painter.paint(Complexion(tone=settings.tone))
    materials = replace(materials, specular=settings.specular_scale * materials.specular)
    return head, paint.on_texture(materials, painter.place, painter.inside("eyes")), paint


def with_eyes(shots: list[SyntheticShot], head: Head, eyes: LivingEyes,
              settings: SynthesisSettings) -> tuple[list[SyntheticShot], tuple[float, ...], dict[str, np.ndarray]]:
    """The shots with gaze and lids, those after the clip's frames with eyes at rest; the lids' states as of Scene; and
    what is true of the eyes in the clip."""
    poses = np.stack([shot.camera_from_head for shot in shots[:settings.frames]])
    motion = eye_motion(eyes, poses, FPS, settings.seed, settings.gaze, settings.gaze_share,
                        settings.blinks_per_second, float(eyes.openings(head, 0.0).mean()))
    lids = (0.0, *sorted(set(motion.lids.tolist()) - {0.0}))
    clip = [replace(shot, gaze=gaze, lids=lids.index(amount))
            for shot, gaze, amount in zip(shots, motion.gaze, motion.lids.tolist(), strict=False)]
    rest = [replace(shot, gaze=np.zeros((2, 2))) for shot in shots[settings.frames:]]
    return clip + rest, lids, true_eyes(eyes, head, motion)


def scanned(settings: SynthesisSettings) -> tuple[Mesh, Mesh, Materials]:
    """As procedural, of a scan."""
    mesh, materials = read_scan(Path(settings.scan))
    return mesh, mesh, materials


def near_lamps(shots: list[SyntheticShot], distance_mm: float) -> LampSphere | None:
    """Lamps at a distance from the mean place of the head's origin in the shots, world space; 0: far away, None."""
    if not distance_mm:
        return None
    return LampSphere(np.mean([shot.place for shot in shots], axis=0), distance_mm)


def burning_gain(scene: Scene, shots: list[SyntheticShot], settings: SynthesisSettings, processes: int) -> float:
    """The factor on the scene's light by which a channel of `settings.clipped` of the face's skin burns out, over a few
    of the shots."""
    chosen = [shots[i] for i in np.linspace(0, len(shots) - 1, EXPOSURE_VIEWS).round().astype(int)]
    camera = PinholeCamera(EXPOSURE_SIZE, EXPOSURE_SIZE, settings.focal_mm / SENSOR_MM * EXPOSURE_SIZE)
    coarse = replace(settings.irradiance, size=EXPOSURE_SIZE, directions=settings.irradiance.directions // 2)
    quality = RenderQuality(coarse, settings.picture, settings.seed)
    brightest = [images["radiance"].max(-1)[images["mask"] > 0.5]
                 for images in render(scene, chosen, camera, quality, [True] * len(chosen), processes)]
    return float(1.0 / np.quantile(np.concatenate(brightest), 1.0 - settings.clipped))


def _write_clip(destination: Path, settings: SynthesisSettings, camera: PinholeCamera, truth: np.ndarray,
                pictures: Iterable[dict[str, np.ndarray]]) -> None:
    clip = output.ClipWriter(destination / settings.video, (camera.width, camera.height), FPS)
    for index, images in enumerate(tqdm(pictures, "frames", settings.frames, disable=None)):
        clip.add(output.sensor_codes(images["radiance"], settings.noise, settings.seed * 1000 + index))
        if index in truth:
            stem = str(destination / "gt" / "frames" / f"{index:04d}")
            output.write_buffers(stem, images, images, settings.mantissa_bits)
    clip.close()


def _write_relight(folder: Path, settings: SynthesisSettings, scene: Scene, shots: list[SyntheticShot],
                   pictures: Iterable[dict[str, np.ndarray]]) -> None:
    folder.mkdir(exist_ok=True)
    for name, light in zip(settings.lights[1:], scene.lights[1:], strict=True):
        output.write_environment(folder / f"{name}_envmap.exr", light)
    cases = [f"{name}_{view}" for name in settings.lights[1:] for view in RELIGHT_YAWS_DEG]
    for case, images in zip(cases, pictures, strict=True):
        output.write_buffers(str(folder / case), images, ("radiance", "mask", "head"), settings.mantissa_bits)
    save_arrays(folder / "poses.npz", **{view: shot.camera_from_head for view, shot in
                                         zip(RELIGHT_YAWS_DEG, shots, strict=False)})


def head_model(level: int) -> HeadModel:
    """The head model, subdivided so often."""
    model = load_head_model()
    for _ in range(level):
        model = model.subdivided()
    return model


def light_of(name: str, settings: SynthesisSettings) -> np.ndarray:
    """The named environment, scaled so that skin that faces the camera is as bright as FACE_RADIANCE says."""
    environment = procedural_environment(name, settings.seed, settings.light_height)
    directions = latlong_directions(environment.shape[0])
    solid_angle = np.sin(np.arccos(directions[..., 1])) * (np.pi / environment.shape[0]) ** 2
    cosine = np.clip(directions[..., 2], 0, 1)
    irradiance = (environment * (cosine * solid_angle)[..., None]).sum((0, 1)).mean()
    skin_albedo = skin_of(settings.tone).mean()
    darker = min(1.0, skin_albedo / skin_of(Complexion().tone).mean())
    return (environment * (FACE_RADIANCE * np.sqrt(darker) * np.pi / (irradiance * skin_albedo))).astype(np.float32)


def camera_place(mesh: Mesh, settings: SynthesisSettings) -> tuple[float, float]:
    """The camera's distance from the head's origin and its height above it, mm."""
    height = mesh.vertices[:, 1].max() + TOP_MARGIN_MM - 0.5 * SENSOR_MM * DISTANCE_PER_FOCAL
    return DISTANCE_PER_FOCAL * settings.focal_mm, height


def plan_shots(mesh: Mesh, settings: SynthesisSettings) -> list[SyntheticShot]:
    """The clip's frames, then three views under each further light."""
    distance, height = camera_place(mesh, settings)
    poses = list(head_turn(settings.frames, distance, height, settings.seed, settings.yaw_deg, settings.pitch_deg))
    light = [0] * settings.frames
    for index in range(1, len(settings.lights)):
        poses += [relight_pose(yaw, height, distance) for yaw in RELIGHT_YAWS_DEG.values()]
        light += [index] * len(RELIGHT_YAWS_DEG)
    turns = world_from_head(np.stack(poses), "head")
    return [SyntheticShot(pose, turn, which, settings.seed * 1000 + i)
            for i, (pose, turn, which) in enumerate(zip(poses, turns, light, strict=True))]


def relight_pose(yaw_deg: float, height_mm: float, distance_mm: float) -> np.ndarray:
    """camera_from_head [4, 4] turned about the head's own axis."""
    flip = np.diag([1.0, -1.0, -1.0])
    turn = rotation_from_vector(np.array([0.0, np.radians(yaw_deg), 0.0]))
    return rigid(flip @ turn, np.array([0.0, height_mm, distance_mm]))


def parse(arguments: list[str] | None) -> tuple[Path, SynthesisSettings, int]:
    """Command line -> destination, settings, number of processes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("destination", type=Path, help="folder of the new subject")
    parser.add_argument("--preset", choices=PRESETS, default="demo", help="values of all that follows (default demo)")
    parser.add_argument("--size", type=int, help="width and height, pixels")
    parser.add_argument("--frames", type=int, help="length of the clip")
    parser.add_argument("--seed", type=int, help="decides head, skin, light and motion")
    parser.add_argument("--eyes", choices=("open", "closed", LIVING),
                        help="living: round eyeballs with iris and cornea, which --gaze and --blinks move")
    parser.add_argument("--gaze", choices=GAZES, help="of living eyes: ahead of the head (default), into the camera, "
                        "or wandering over points of the room")
    parser.add_argument("--gaze-share", type=float, help="how far eyes turn to the camera that look there, 0 to 1")
    parser.add_argument("--blinks", dest="blinks_per_second", type=float, metavar="PER_SECOND", help="of living eyes")
    parser.add_argument("--tone", type=float, help="melanin: 0.15 as the lightest measured faces to 1.6 as the darkest")
    parser.add_argument("--light", choices=ENVIRONMENTS, help="the clip's light")
    parser.add_argument("--focal", dest="focal_mm", type=float, help="focal length, mm, on a sensor 22.3 mm wide")
    parser.add_argument("--yaw", dest="yaw_deg", type=float, help="how far the head turns to each side, degrees")
    parser.add_argument("--pitch", dest="pitch_deg", type=float, help="how far it nods up and down, degrees")
    parser.add_argument("--noise", type=float, help="sensor noise at full scale, share of it")
    parser.add_argument("--specular", dest="specular_scale", type=float,
                        help="factor on the skin's specular intensity; 0: matte")
    parser.add_argument("--clipped", type=float, help="share of the face's skin on which a channel burns out")
    parser.add_argument("--lamp-distance", dest="lamp_distance_mm", type=float, metavar="MM",
                        help="the lamps of the clip's light stand so far from the head, mm; 0: far away (default)")
    parser.add_argument("--hair", choices=HAIRCUTS, help="hair as geometry: cropped, over the ears, or below the jaw; "
                        "with it, a beard or a collar, the truth has labels")
    parser.add_argument("--beard", type=float, default=0.0, metavar="MM", help="a beard of that thickness")
    parser.add_argument("--collar", action="store_true", help="a collar about the neck")
    parser.add_argument("--scan", metavar="SUBJECT",
                        help="subject whose ground truth takes the procedural head's place")
    parser.add_argument("--chart", action="store_true", help="a colour chart beside the head, in a wider picture")
    parser.add_argument("--processes", type=int, default=2, help="worker processes (default 2)")
    options = parser.parse_args(arguments)
    settings = PRESETS[options.preset]
    given = {name: getattr(options, name) for name in
             ("size", "frames", "seed", "eyes", "tone", "noise", "focal_mm", "yaw_deg", "pitch_deg", "specular_scale",
              "clipped", "lamp_distance_mm", "scan", "gaze", "gaze_share", "blinks_per_second")}
    settings = replace(settings, **{name: value for name, value in given.items() if value is not None})
    settings = replace(settings, chart=options.chart,
                       growth=Growth(options.hair or "", options.beard, options.collar))
    if options.light:
        others = tuple(name for name in settings.lights if name != options.light)
        settings = replace(settings, lights=(options.light, *others)[:len(settings.lights)])
    return options.destination, _checked(settings), options.processes


def _checked(settings: SynthesisSettings) -> SynthesisSettings:
    for name, low, high in (("size", 64, 2048), ("frames", 8, 1000), ("seed", 0, 10**6), ("tone", 0.05, 2.0),
                            ("noise", 0.0, 0.1), ("focal_mm", 15.0, 500.0), ("yaw_deg", 0.0, 60.0),
                            ("pitch_deg", 0.0, 40.0), ("specular_scale", 0.0, 2.0), ("clipped", 0.0, 0.9),
                            ("gaze_share", 0.0, 1.0), ("blinks_per_second", 0.0, 3.0)):
        value = getattr(settings, name)
        if not low <= value <= high:
            raise InputError("out of range", where=f"--{name.split('_')[0]}", got=value, expected=f"{low} to {high}")
    if settings.lamp_distance_mm and settings.lamp_distance_mm < LEAST_LAMP_DISTANCE:
        raise InputError("a lamp inside the head's reach", where="--lamp-distance", got=settings.lamp_distance_mm,
                         expected=f"{LEAST_LAMP_DISTANCE:g} mm or more, or 0: far away")
    if settings.lamp_distance_mm and settings.chart:
        raise InputError("the chart's light is far away", where="--lamp-distance with --chart", hint="leave out one")
    if settings.eyes != LIVING and (settings.gaze != "ahead" or settings.blinks_per_second):
        raise InputError("these eyes do not move", where="--gaze or --blinks", got=f"--eyes {settings.eyes}",
                         hint="add --eyes living")
    if not 0.0 <= settings.growth.beard_mm <= MOST_BEARD_MM:
        raise InputError("out of range", where="--beard", got=settings.growth.beard_mm,
                         expected=f"0 to {MOST_BEARD_MM:g} mm")
    if settings.growth and (settings.scan or settings.eyes == LIVING):
        raise InputError("grow on the procedural head alone", where="--hair, --beard or --collar",
                         got="--scan" if settings.scan else f"--eyes {LIVING}", hint="leave out one")
    if settings.scan and settings.eyes != SynthesisSettings.eyes:
        raise InputError("a scan has eyes of its own", where="--scan with --eyes", hint="leave out one")
    if settings.scan and settings.face_truth_only:
        raise InputError("a scan is too large for it", where="--preset tiny", hint="use the preset demo")
    if settings.scan or settings.clipped:
        least = round(LEAST_IRRADIANCE * settings.size)
        fine = replace(settings.irradiance, size=max(settings.irradiance.size, least))
        settings = replace(settings, irradiance=fine)
    return settings


def main(arguments: list[str] | None = None) -> int:
    """Command line; exit code 0, or 2 when the input is at fault."""
    try:
        destination, settings, processes = parse(arguments)
        synthesize(destination, settings, processes)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{destination}: {settings.frames} frames of {settings.size} x {settings.size} px with truth")
    return 0
