"""Score a result (an export/ folder) against a subject whose truth is known.

    python -m tools.score SUBJECT [EXPORT] [--frames 12] [--json FILE]

Reads:   SUBJECT/capture.json, gt/{mesh.obj,mask.exr,envmap.exr,poses.npz,frames/}, relight/; of the result mesh.obj and
         poses.npz, and when present maps/, envmap.exr, renders/%04d.exr, relit/NAME.exr (NAME as in the subject's
         relight/NAME_radiance.exr).
Measures: geometry_mm    distance of the true face's points to the result's surface, after alignment
         pose            rotation and translation in the aligned head frame; pose_own_alignment leaves the mesh out
         normal_deg, albedo, specular, roughness    in image space, on the face skin of the frames that hold truth;
                         albedo.confident: where maps/confidence.exr, if there is one, is above 0.5
         confident_texels    where the confidence is above 0.5, anywhere on the head: the share whose albedo is wrong
         envmap          through a cosine and a 25 degree lobe, per-channel gain removed
         rerender, relight   sRGB-coded PSNR on the face skin, raw and with one gain per channel
         gaze, rerender_eyes where the truth has living eyes: degrees between directions, blinks found, and the PSNR on
                         eyes and lids, of which held_out are frames that the solver did not see
         labels          where the truth has labels: intersection over union of skin, hair, cloth and others
         hair_outline_mm where hair stands before the background: from the true outline to the result's
         lid_margins_mm  with living eyes: between the borders of what lids leave open, as the camera sees them
Frames:  the result's head frame and scale may be any; it is aligned by a similarity transform (camera centres first,
         then trimmed ICP on the face).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial import cKDTree

from shared.actions.facial import facial_actions
from shared.errors import InputError
from shared.geometry.blend_shapes import LID_ACTIONS, LidActions
from shared.geometry.eyeballs import eyeballs_of, pitch_from_rest
from shared.geometry.mesh import Mesh
from shared.geometry.raycast import RayScene
from shared.geometry.surface import Surface
from shared.imaging.color import decode_srgb
from shared.io.arrays import load_arrays, read_json, write_json
from shared.io.images import read_exr, read_png
from shared.io.meshes import load_mesh, read_obj
from shared.tracking.models import load_head_model
from tools.scoring import align, gaze, labels, lid_margins, measures
from tools.scoring.buffers import BufferRenderer
from tools.scoring.hair_outline import hair_outline_errors
from tools.scoring.table import table
from tools.scoring.texel_albedo import albedo_pairs

SCORED_FRAMES = 12
CONFIDENCE = "confidence"
MAPS = {"albedo": "diffuse_albedo", "specular": "specular_intensity", "roughness": "roughness", CONFIDENCE: CONFIDENCE}


@dataclass(frozen=True)
class ScoredResult:
    """A result: its mesh, its textures by the truth's names, and a pose for each frame_index."""

    folder: Path
    mesh: Mesh
    textures: dict[str, np.ndarray]
    poses: dict[int, np.ndarray]
    intrinsics: np.ndarray


def load_result(folder: Path, intrinsics: np.ndarray) -> ScoredResult:
    """Reads an export/ folder; intrinsics [3,3] serve when poses.npz has none."""
    arrays = load_arrays(folder / "poses.npz")
    if "camera_from_head" not in arrays:
        raise InputError("no camera_from_head", where=str(folder / "poses.npz"), got=", ".join(sorted(arrays)))
    frame_index = arrays.get("frame_index", np.arange(len(arrays["camera_from_head"])))
    poses = dict(zip(frame_index.tolist(), arrays["camera_from_head"].astype(np.float64), strict=True))
    paths = {name: folder / "maps" / f"{file}.exr" for name, file in MAPS.items()}
    textures = {name: read_exr(path) for name, path in paths.items() if path.exists()}
    return ScoredResult(folder, read_obj(folder / "mesh.obj"), textures, poses, arrays.get("intrinsics", intrinsics))


def score(
    subject: Path,
    export: Path,
    frame_count: int = SCORED_FRAMES,
    seed: int = 0,
    prepare: Callable[[align.Similarity], None] = lambda truth_from_result: None,
) -> dict:
    """All measures as nested dictionaries of floats. InputError when truth or result is missing or damaged.

    prepare(truth_from_result) may add pictures to the result before they are looked for.
    """
    subject, export = Path(subject), Path(export)
    if not (subject / "gt").is_dir():
        raise InputError("no ground truth", where=str(subject), expected="a gt/ folder", hint="see tools/synthesize.py")
    truth = load_arrays(subject / "gt" / "poses.npz")
    result = load_result(export, camera_intrinsics(subject))
    common = [i for i in sorted(result.poses) if i < len(truth["camera_from_head"])]
    if len(common) < 3:
        raise InputError("fewer than 3 poses of the video's frames", where=str(export / "poses.npz"), got=len(common))
    true_poses = truth["camera_from_head"][common]
    found_poses = np.stack([result.poses[i] for i in common])
    rng = np.random.default_rng(seed)
    alignment, scores = score_geometry(subject, result.mesh, true_poses, found_poses, rng)
    prepare(alignment)
    aligned = np.stack([alignment.pose(pose) for pose in found_poses])
    scores["pose"] = measures.pose_errors(true_poses, aligned)
    scores["pose_own_alignment"] = measures.pose_errors_own_alignment(true_poses, found_poses)
    chosen = scored_frames(truth["gt_frames"], result, frame_count)
    scores |= score_appearance(subject, result, chosen, alignment.rotation, rng)
    if {"albedo", CONFIDENCE} <= result.textures.keys() and (subject / "gt" / "albedo.exr").exists():
        gain = np.array(scores["albedo"]["gain"])
        scores["confident_texels"] = score_texels(subject, result, true_poses, alignment, gain, rng)
    if "gaze" in truth:
        scores |= score_eyes(subject, export, truth, alignment.rotation)
    if labels.label_files(subject / "gt" / "frames") and (export / "maps" / "material.exr").exists():
        scores["labels"] = labels.label_scores(subject / "gt" / "frames", export, result.mesh, result.poses,
                                               result.intrinsics)
        outline = hair_outline_errors(subject / "gt" / "frames", export, result.mesh, result.poses, result.intrinsics)
        scores |= {} if outline is None else {"hair_outline_mm": outline}
    scores |= score_light(subject, export)
    return {"subject": subject.resolve().name, "result": str(export), **scores}


def scored_frames(gt_frames: np.ndarray, result: ScoredResult, count: int = SCORED_FRAMES) -> list[int]:
    """At most count of the frames whose truth is known and that have a pose in the result, spread evenly."""
    known = [int(i) for i in gt_frames if int(i) in result.poses]
    chosen = np.unique(np.linspace(0, len(known) - 1, min(count, len(known))).astype(int))
    return [known[k] for k in chosen]


def camera_intrinsics(subject: Path) -> np.ndarray:
    """[3,3] of the subject's true camera, the principal point in the middle."""
    capture = read_json(subject / "capture.json")
    focal = capture["focal_length_px"]
    return np.array([[focal, 0, capture["width"] / 2], [0, focal, capture["height"] / 2], [0, 0, 1.0]])


def score_geometry(
    subject: Path, mesh: Mesh, true_poses: np.ndarray, found_poses: np.ndarray, rng: np.random.Generator
) -> tuple[align.Similarity, dict]:
    """Similarity truth_from_result, and {alignment, geometry_mm}."""
    true_mesh, mask = read_obj(subject / "gt" / "mesh.obj"), read_exr(subject / "gt" / "mask.exr")
    start = align.similarity_from_poses(true_poses, found_poses)
    face_points, face_normals = align.sample_face_skin(true_mesh, mask, rng)
    points, normals = align.sample_result(mesh, start, face_points, face_normals, rng)
    tree = cKDTree(points)
    alignment = align.refine_by_icp(face_points, face_normals, points, normals, tree, start)
    distance = align.surface_distance(face_points, points, normals, tree, alignment)
    return alignment, {
        "alignment": {"scale": float(alignment.scale), "pose_only_scale": float(start.scale)},
        "geometry_mm": {**measures.summary(distance), "within_5mm": float((distance < 5).mean())},
    }


def score_appearance(
    subject: Path, result: ScoredResult, frames: list[int], truth_from_result: np.ndarray, rng: np.random.Generator
) -> dict:
    """Normals, coverage, textures and re-renders on the face skin of the given frames."""
    viewer = BufferRenderer(result.mesh, result.textures)
    angles, coverage, rendered = [], [], []
    pairs: dict[str, list] = {name: [] for name in result.textures if name != CONFIDENCE}
    confidence = []
    for frame in frames:
        stem = subject / "gt" / "frames" / f"{frame:04d}"
        mask = read_png(Path(f"{stem}_mask.png")) > 127
        row, column = np.nonzero(mask)
        seen = viewer.view(result.poses[frame], result.intrinsics, np.stack([column, row], 1))
        hit = seen["coverage"] > 0.5
        row, column = row[hit], column[hit]
        coverage.append(hit.mean())
        angles.append(
            _normal_angles(read_exr(f"{stem}_normal.exr")[row, column], seen["normal"][hit] @ truth_from_result.T)
        )
        for name in pairs:
            pairs[name].append((read_exr(f"{stem}_{name}.exr")[row, column], seen[name][hit]))
        if CONFIDENCE in seen:
            confidence.append(seen[CONFIDENCE][hit].ravel())
        render = read_render(result.folder, frame)
        if render is not None:
            rendered.append((read_exr(f"{stem}_radiance.exr")[mask], render[mask]))
    scores: dict = {
        "normal_deg": measures.summary(np.concatenate(angles)),
        "mask_coverage": float(np.mean(coverage)),
    }
    for name, frame_pairs in pairs.items():
        truth, found = (np.concatenate(side) for side in zip(*frame_pairs, strict=True))
        scores[name] = (
            measures.albedo_errors(truth, found, rng, np.concatenate(confidence) if confidence else None)
            if name == "albedo"
            else measures.scalar_errors(truth, found)
        )
    if rendered:
        scores["rerender"] = measures.image_errors(rendered)
    return scores


def score_texels(
    subject: Path, result: ScoredResult, true_poses: np.ndarray, truth_from_result: align.Similarity, gain: np.ndarray,
    rng: np.random.Generator,
) -> dict:
    """Of the whole head, see texel_albedo: {share, wrong}, and of_segments where the stages' folders are beside the
    export; true_poses [F, 4, 4]; gain [3]: the albedo's, on face skin."""
    truth = read_obj(subject / "gt" / "mesh.obj"), read_exr(subject / "gt" / "albedo.exr"), true_poses
    own = result.mesh, result.textures["albedo"], result.textures[CONFIDENCE]
    surface = segmented_surface(result.folder)
    pairs = albedo_pairs(truth, own, truth_from_result, rng)
    if surface is None:
        return pairs.wrong_where_sure(gain)
    return pairs.wrong_where_sure(gain, surface.face_segment, surface.segment_names)


def read_render(export: Path, frame: int) -> np.ndarray | None:
    """[H, W, 3] linear: a re-render of a frame without the frame's own gain, which truth has none of; None where there
    is none."""
    path = find_image(export / "renders", f"{frame:04d}")
    if path is None:
        return None
    poses = load_arrays(export / "poses.npz")
    gain = poses["gain"][poses["frame_index"] == frame][0] if "gain" in poses else 1.0
    return (read_linear(path) / gain).astype(np.float32)


def score_eyes(subject: Path, export: Path, truth: dict[str, np.ndarray], truth_from_result: np.ndarray) -> dict:
    """{gaze, iris_px, rerender_eyes, lid_margins_mm} against what gt/poses.npz says of living eyes; gaze is None where
    the result has none, the others are left out where there is nothing to compare. truth_from_result [3, 3]."""
    found = gaze.found_gaze(export)
    scores: dict = {"gaze": gaze.gaze_errors(truth["gaze"], found, truth_from_result) if found else None}
    if (irises := gaze.iris_errors_px(truth, export.parent / "work" / "track_landmarks")) is not None:
        scores["iris_px"] = irises
    pairs = {}
    for frame in truth["gt_frames"].tolist():
        stem, render = subject / "gt" / "frames" / f"{frame:04d}", read_render(export, frame)
        if render is not None:
            inside = gaze.eye_pixels(read_exr(f"{stem}_depth.exr"), truth["camera_from_head"][frame], truth["K"],
                                     truth["eyeball_centres"], float(truth["eyeball_radius"]))
            pairs[frame] = read_exr(f"{stem}_radiance.exr")[inside], render[inside]
    solve = export.parent / "work" / "inverse_render" / "solve.json"
    held = [pairs[i] for i in (read_json(solve)["held_out_frames"] if solve.exists() else []) if i in pairs]
    if pairs:
        scores["rerender_eyes"] = {"frames": len(pairs), **measures.image_errors(list(pairs.values()))}
    if held:
        scores["rerender_eyes"]["held_out"] = {"frames": len(held), **measures.image_errors(held)}
    if (margins := score_lids(subject, export, truth)) is not None:
        scores["lid_margins_mm"] = margins
    return scores


def score_lids(subject: Path, export: Path, truth: dict[str, np.ndarray]) -> dict | None:
    """How far the mesh's lids, as the export moves them, are from the truth's, see lid_margins, in frames with open
    eyes; None where the stages' folders are not beside the export, or the head has no eyeballs."""
    surface = segmented_surface(export)
    if surface is None or eyeballs_of(surface) is None:
        return None
    eyes, scene_of = surface.faces_of(("eyes",)), _scenes_with_lids(export, surface)
    result, radius, pairs = load_result(export, camera_intrinsics(subject)), float(truth["eyeball_radius"]), []
    for frame in truth["gt_frames"].tolist():
        if frame not in result.poses or np.isnan(truth["gaze"][frame]).any():
            continue
        depth = read_exr(subject / "gt" / "frames" / f"{frame:04d}_depth.exr")
        pose, lens = truth["camera_from_head"][frame], truth["K"]
        found = lid_margins.opening_of_result(
            scene_of(frame), eyes, result.poses[frame], result.intrinsics, depth.shape[::-1]
        )
        for centre in truth["eyeball_centres"]:
            own = gaze.eye_pixels(depth, pose, lens, centre[None], radius)
            seen = lid_margins.opening_of_truth(depth, pose, lens, centre, radius) & own
            pixel_mm = (pose[:3, :3] @ centre + pose[:3, 3])[2] / lens[0, 0]
            pairs.append((seen, found & own, pixel_mm))
    return lid_margins.lid_margin_errors(pairs)


def segmented_surface(export: Path) -> Surface | None:
    """The mesh with its segments, as the stages' folders beside the export have it; None where they are not there."""
    mesh_path = export.parent / "work" / "inverse_render" / "mesh.npz"
    tracking_path = export.parent / "work" / "track_landmarks" / "tracking.json"
    if not (mesh_path.exists() and tracking_path.exists()):
        return None
    names = tuple(read_json(tracking_path).get("segments", ()))
    segment = load_arrays(mesh_path).get("face_segment")
    return None if segment is None else Surface(load_mesh(mesh_path), segment, names)


def _scenes_with_lids(export: Path, surface: Surface) -> Callable[[int], RayScene]:
    """Of a frame: the surface with its lids as poses.npz of the export has them there; at rest where it has none."""
    rest, faces = surface.mesh.vertices, surface.mesh.faces
    poses, scene = load_arrays(export / "poses.npz"), RayScene(rest, faces)
    if "lids" not in poses:
        return lambda frame: scene
    actions = LidActions.of(facial_actions(load_head_model(), rest, faces, LID_ACTIONS))
    if actions is None:
        return lambda frame: scene
    pitch = pitch_from_rest(poses["gaze"]) if "gaze" in poses else 0.0 * poses["lids"]
    lids = dict(zip(poses["frame_index"].tolist(), zip(poses["lids"], pitch, strict=True), strict=True))
    return lambda frame: RayScene(actions.moved(rest, *lids[frame]), faces)


def _normal_angles(truth: np.ndarray, found: np.ndarray) -> np.ndarray:
    """[N,3] normals -> [N] degrees between them; a mesh that is inside out counts as turned."""
    cosine = (truth * found).sum(1) / np.maximum(np.linalg.norm(truth, axis=1), 1e-12)
    return np.degrees(np.arccos(np.clip(cosine if np.median(cosine) > 0 else -cosine, -1, 1)))


def score_light(subject: Path, export: Path) -> dict:
    """Environment map and relit renders, where the result has them."""
    scores: dict = {}
    if (export / "envmap.exr").exists():
        size = (measures.ENVMAP_WIDTH, measures.ENVMAP_WIDTH // 2)
        truth, found = (
            cv2.resize(read_exr(path), size, interpolation=cv2.INTER_AREA)
            for path in (subject / "gt" / "envmap.exr", export / "envmap.exr")
        )
        scores["envmap"] = measures.envmap_errors(truth, found)
    cases: dict[str, list] = {}
    for path in sorted((subject / "relight").glob("*_radiance.exr")):
        name = path.name.removesuffix("_radiance.exr")
        relit = find_image(export / "relit", name)
        if relit:
            mask = read_png(subject / "relight" / f"{name}_mask.png") > 127
            cases.setdefault(name.rsplit("_", 1)[0], []).append((read_exr(path)[mask], read_linear(relit)[mask]))
    if cases:
        lights = {light: measures.image_errors(pairs) for light, pairs in cases.items()}
        mean = {key: float(np.mean([light[key] for light in lights.values()])) for key in ("psnr", "psnr_gain")}
        scores["relight"] = {**lights, "mean": mean}
    return scores


def find_image(folder: Path, stem: str) -> Path | None:
    """The linear EXR or the sRGB PNG of that name, if any."""
    return next((path for path in (folder / f"{stem}.exr", folder / f"{stem}.png") if path.exists()), None)


def read_linear(path: Path) -> np.ndarray:
    """[H,W,3] linear pixels of an EXR or of an sRGB PNG."""
    return read_exr(path) if path.suffix == ".exr" else decode_srgb(read_png(path) / 255.0)


def main(arguments: list[str] | None = None) -> int:
    """Command line; exit code 0, or 2 when the input is at fault."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("subject", type=Path, help="folder with gt/")
    parser.add_argument("export", type=Path, nargs="?", help="the result (default: SUBJECT/export)")
    parser.add_argument("--frames", type=int, default=12, help="frames with truth that are compared (default 12)")
    parser.add_argument("--json", type=Path, help="write every number to this file as well")
    options = parser.parse_args(arguments)
    try:
        scores = score(options.subject, options.export or options.subject / "export", options.frames)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(table(scores))
    if options.json:
        write_json(options.json, scores)
    return 0
