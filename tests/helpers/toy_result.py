"""Folders as the stages leave them, small and synthetic, and a job that reads them: what export_usd starts from."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from shapes import sphere, turned

from shared.contract.job import Parameters
from shared.geometry.mesh import Mesh
from shared.geometry.surface import Surface
from shared.hair.hair_files import write_hair
from shared.hair.joined import HairSurface
from shared.imaging.material_labels import LABELS
from shared.io.arrays import read_json, save_arrays, write_json
from shared.io.images import write_exr, write_png
from shared.io.material_maps import write_material
from shared.io.meshes import save_mesh
from stages.export_usd import STAGE

FRAMES = np.array([3, 5, 8, 12, 13])
RENDERED = [3, 8, 13]
SOURCE_SIZE, CROP_SIZE, CROP = (160, 120), (96, 88), (20.0, 8.0, 0.8)
INTRINSICS = np.array([[300.0, 0.0, 71.0], [0.0, 310.0, 66.0], [0.0, 0.0, 1.0]])
MAP_SIZE, VIEW_SIZE = 16, 64


def toy_mesh():
    """An egg the size of a head."""
    ball = sphere(1.0, 3)
    return ball.replace(vertices=ball.vertices * [75.0, 110.0, 95.0])


EYE_CENTRES, EYE_RADIUS = np.array([[-31.0, 20.0, 78.0], [31.0, 20.0, 78.0]]), 12.0
SEGMENTS = ("skin", "eyes")


def toy_eyed_surface() -> Surface:
    """The egg with two balls for eyes, the left one first, all in one atlas."""
    egg, ball = toy_mesh(), sphere(1.0, 2)
    balls = [ball.vertices * EYE_RADIUS + centre for centre in EYE_CENTRES[::-1]]
    counts = np.cumsum([len(egg.vertices), len(ball.vertices)])
    faces = [egg.faces, *(ball.faces + count for count in counts)]
    mesh = Mesh(
        np.concatenate([egg.vertices, *balls]),
        np.concatenate(faces),
        np.concatenate([egg.uvs * 0.5, ball.uvs * 0.25 + [0.5, 0.0], ball.uvs * 0.25 + [0.75, 0.0]]),
        np.concatenate(faces),
    )
    return Surface(mesh, np.repeat([0, 1], [len(egg.faces), 2 * len(ball.faces)]).astype(np.uint8), SEGMENTS)


def toy_hair() -> HairSurface:
    """A cap over the egg's upper back, 14 mm off it: half of its map is there, with a soft edge."""
    egg = toy_mesh()
    kept = (egg.vertices[egg.faces].mean(1) @ [0.0, 1.0, -0.6]) > 20.0
    used, corners = np.unique(egg.faces[kept], return_inverse=True)
    places = egg.vertices[used] * (1.0 + 14.0 / np.linalg.norm(egg.vertices[used], axis=1, keepdims=True))
    faces = corners.reshape(-1, 3).astype(np.int32)
    random = np.random.default_rng(11)
    albedo = random.uniform(0.02, 0.3, (MAP_SIZE, MAP_SIZE, 3)).astype(np.float32)
    alpha = np.clip(np.linspace(-1.0, 2.0, MAP_SIZE), 0.0, 1.0).astype(np.float32)
    return HairSurface(Mesh(places, faces, egg.uvs[used], faces), albedo, np.tile(alpha, (MAP_SIZE, 1)))


HAIR_RECORD = {"thickness_mm": 14.0, "skull_covered": 0.6, "seen_share": 0.5, "lowest_mm": 80.0}


def toy_gaze() -> np.ndarray:
    """[F, 2, 2]: both eyes wander by up to 0.5 radians and are shut in the third frame."""
    gaze = np.random.default_rng(8).uniform(-0.5, 0.5, (len(FRAMES), 2, 2))
    gaze[2] = np.nan
    return gaze


def toy_poses(moves_by: float = 0.2) -> np.ndarray:
    """[F, 4, 4]: in front of the camera, y down there, turning from side to side and nodding a little."""
    turn = np.linspace(-moves_by, moves_by, len(FRAMES))
    vectors = np.stack([0.3 * turn, turn, 0.1 * turn], axis=1)
    return turned(vectors, np.array([4.0, -6.0, 600.0]) + np.outer(turn, [30.0, 5.0, -20.0]))


def toy_maps() -> dict[str, np.ndarray]:
    """inverse_render's maps, MAP_SIZE square, in their ranges, no two texels alike."""
    random = np.random.default_rng(5)
    shape = (MAP_SIZE, MAP_SIZE)
    normal = np.concatenate([random.uniform(0.4, 0.6, (*shape, 2)), np.ones((*shape, 1))], axis=2)
    return {
        "diffuse_albedo": random.uniform(0.05, 0.8, (*shape, 3)).astype(np.float32),
        "specular_intensity": random.uniform(0.2, 1.4, shape).astype(np.float32),
        "roughness": random.uniform(0.25, 0.7, shape).astype(np.float32),
        "normal": normal.astype(np.float32),
        "confidence": random.uniform(0.0, 1.0, shape).astype(np.float32),
    }


def toy_material() -> np.ndarray:
    """[MAP_SIZE, MAP_SIZE, len(LABELS)] probabilities of materials, each the likeliest somewhere."""
    raised = np.random.default_rng(9).uniform(0.0, 1.0, (MAP_SIZE, MAP_SIZE, len(LABELS))) ** 4
    return (raised / raised.sum(2, keepdims=True)).astype(np.float32)


def write_toy_work(work: Path, moves: str = "head", eyes: bool = False, hair: bool = False) -> Path:
    """Writes work/<stage>/ of all stages before the export; eyes: of the mesh that has some, and their gaze; hair: with
    toy_hair. -> work."""
    for stage in STAGE.inputs:
        (work / stage).mkdir(parents=True)
        write_json(work / stage / "manifest.json", {"stage": stage, "version": 2, "parameters": {"size": 64}})
        costs = {"wall_s": 1.5, "cpu_s": 2.5, "peak_memory_mb": 300.0, "warnings": [f"<{stage}> is a toy"]}
        write_json(work / stage / "provenance.json", costs)
    _write_frames(work / "sample_frames", moves)
    excluded = [{"frame_index": 4, "reason": "landmarks absent"}]
    tracking = {"excluded": excluded, "warnings": [], "segments": SEGMENTS}
    write_json(work / "track_landmarks" / "tracking.json", tracking)
    openness = {"eye_openness": np.where(np.isfinite(toy_gaze()).all(2), 1.0, 0.1)} if eyes else {}
    save_arrays(work / "track_landmarks" / "landmarks.npz", frame_index=FRAMES, **openness)
    write_png(work / "track_landmarks" / "overlay.png", np.full((40, 120, 3), 90, np.uint8))
    write_png(work / "sample_frames" / "chart.png", np.full((40, 60, 3), 120, np.uint8))
    _write_solution(work / "inverse_render")
    if eyes:
        _write_eyes(work / "inverse_render")
    if hair:
        solved = work / "inverse_render"
        write_hair(solved, toy_hair())
        write_json(solved / "solve.json", read_json(solved / "solve.json") | {"hair": HAIR_RECORD})
    return work


def _write_frames(folder: Path, moves: str) -> None:
    (folder / "frames").mkdir()
    (folder / "masks").mkdir()
    random, rows = np.random.default_rng(6), []
    for i, frame in enumerate(FRAMES):
        row = {"frame_index": int(frame), "time_s": frame / 25.0}
        row |= {"file": f"frames/{i:06d}.png", "mask": f"masks/{i:06d}.png"}
        write_png(folder / row["file"], random.integers(40, 200, (*CROP_SIZE[::-1], 3), np.uint8))
        write_png(folder / row["mask"], np.full(CROP_SIZE[::-1], 255, np.uint8))
        rows.append(row | {"sharpness": 1.0, "face_box": [10.0, 10.0, 80.0, 80.0]})
    x0, y0, scale = CROP
    to_crop = np.array([[scale, 0.0, -x0 * scale], [0.0, scale, -y0 * scale], [0.0, 0.0, 1.0]])
    width, height = SOURCE_SIZE
    content = {
        "source": {"name": 'a "clip".mp4', "width": width, "height": height, "fps": 25.0, "frame_count": 20},
        "transfer": "srgb", "moves": moves, "crop": {"x0": x0, "y0": y0, "scale": scale}, "size": list(CROP_SIZE),
        "intrinsics": (to_crop @ INTRINSICS).tolist(), "intrinsics_source": INTRINSICS.tolist(), "focal_known": False,
        "warnings": ["the focal length is not given"], "frames": rows,
        "dropped": [{"frame_index": 6, "reason": "blurred"}],
    }
    write_json(folder / "frames.json", content)


def _write_solution(folder: Path) -> None:
    (folder / "maps").mkdir()
    (folder / "renders").mkdir()
    for name, values in toy_maps().items():
        space = "lin_rec709_scene" if name == "diffuse_albedo" else "data"
        write_exr(folder / "maps" / f"{name}.exr", values, colour_space=space)
    write_material(folder / "maps" / "material.exr", toy_material(), half=True, attributes={})
    radiance = np.random.default_rng(7).uniform(0.1, 3.0, (8, 16, 3))
    write_exr(folder / "envmap.exr", radiance, colour_space="lin_rec709_scene", latlong=True)
    save_mesh(folder / "mesh.npz", toy_mesh())
    save_arrays(folder / "poses.npz", camera_from_head=toy_poses(), frame_index=FRAMES, intrinsics=INTRINSICS)
    for frame in RENDERED:
        render = np.zeros((*CROP_SIZE[::-1], 3), np.float32)
        render[20:60, 20:70] = [0.4, 0.3, 0.25]
        write_exr(folder / "renders" / f"{frame:06d}.exr", render, colour_space="lin_rec709_scene")
    solve = {
        "model": {"light": "cubemap 16", "specular_variation": "one value"},
        "residuals": {"fitted": 0.021, "held_out": 0.023, "texture_held_out": {"one value": 0.02, "16 texels": 0.03}},
        "iterations": [
            {"light": "cubemap", "resolution": 8, "step": 0, "fitted": 0.05, "held_out": 0.06},
            {"light": "cubemap", "resolution": 16, "step": 0, "fitted": 0.021, "held_out": 0.023},
        ],
        "albedo_scale": {"factor": [1.0, 1.0, 1.0]}, "held_out_frames": [5, 8], "warnings": [],
        "render_frames": RENDERED,
    }
    write_json(folder / "solve.json", solve)


def _write_eyes(folder: Path) -> None:
    surface = toy_eyed_surface()
    save_mesh(folder / "mesh.npz", surface.mesh, face_segment=surface.face_segment)
    poses = {"camera_from_head": toy_poses(), "frame_index": FRAMES, "intrinsics": INTRINSICS}
    save_arrays(folder / "poses.npz", **poses, gaze=toy_gaze(), eye_turn=toy_gaze())


class ToyJob:
    """What run and check use of a Job, without the publishing around it."""

    def __init__(self, work: Path, out: Path, name: str = "toy", **parameters):
        out.mkdir(parents=True)
        self.params = Parameters(STAGE.defaults() | {"view_size": VIEW_SIZE} | parameters)
        self.subject = SimpleNamespace(name=name, sensor_width_mm=22.3, focal_length_mm=None)
        self.out, self._work, self.warnings = out, work, []
        self.clips, self.input_names = (), STAGE.inputs

    def input(self, stage: str, clip: str = "") -> Path:
        """The folder of a stage before this one."""
        return self._work / stage

    def manifest(self, stage: str, clip: str = "") -> dict:
        """What the stage was told."""
        return json.loads((self.input(stage, clip) / "manifest.json").read_text())

    def provenance(self, stage: str, clip: str = "") -> dict:
        """What the stage took."""
        return json.loads((self.input(stage, clip) / "provenance.json").read_text())

    def progress(self, iterable, label, total=None):
        """The items, silently."""
        return iterable

    def note(self, text: str) -> None:
        """Nowhere to go."""

    def warn(self, text: str) -> None:
        """Kept for the test to see."""
        self.warnings.append(text)
