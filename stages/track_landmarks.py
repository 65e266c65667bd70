"""Head pose in each frame and the head's shape.

Reads    sample_frames: the cropped frames and their intrinsics.
Writes   poses.npz, mesh.npz, landmarks.npz, tracks.npz, tracking.json, overlay.png.
Method   468 landmarks a frame start the poses; dense skin tracks, adjusted as one rigid body (pycolmap), hold them
         still; the head model is fitted to the tracks and then bent to them freely. Scale is the head model's prior.
Fails    no landmarks in three frames; skin that cannot be tracked (too small, blurred, or not the same head).
"""

from __future__ import annotations

import numpy as np

from shared.contract import Job, Output, Parameter, Stage, main

STAGE = Stage(
    name="track_landmarks",
    version=1,
    help="Head pose in each frame and the head's shape, from landmarks and dense skin tracks.",
    inputs=("sample_frames",),
    outputs=(
        Output("poses.npz", "camera_from_head [F, 4, 4], covariance [F, 6, 6], frame_index, intrinsics", unit="mm"),
        Output("mesh.npz", "the fitted head with its UVs and face segments", unit="mm", space="head"),
        Output("landmarks.npz", "the networks' 468 landmarks of each used frame", unit="px", space="crop"),
        Output("tracks.npz", "track points on the skin and their reprojection errors", unit="mm", space="head"),
        Output("tracking.json", "residuals, rotation range, excluded frames with their reasons, warnings"),
        Output("overlay.png", "mesh and landmarks drawn over five frames", colour_space="srgb"),
    ),
    parameters=(
        Parameter("passes", int, 2, "Passes of dense tracking over the fitted head after the first.", "", 1, 6),
        Parameter("references", int, 3, "Reference frames that each pass tracks from.", "frames", 1, 5),
        Parameter("tracks", int, 1500, "Skin points tracked from each reference frame.", "points", 100, 20000),
        Parameter("warp_width", float, 480.0, "Width of the face in the flow's pictures.", "px", 100.0, 2000.0),
        Parameter("loss_scale", float, 0.2, "Residual beyond which a track loses its pull.", "px", 0.01, 10.0),
        Parameter("point_prior", float, 5.0, "Deviation of track points about the fitted head.", "mm", 0.01, 1000.0),
        Parameter("stiffness", float, 4.0, "Resistance of the free shape correction to bending.", "", 0.01, 1e6),
        Parameter("least_presence", float, 0.5, "Landmark network's confidence below which a frame is lost.", "", 0, 1),
        Parameter("largest_error", float, 1.5, "Median track error beyond which a frame is excluded.", "px", 0.1, 50.0),
    ),
)

SMALL_ROTATION_DEG = 15.0


def read_landmarks(job: Job, frames) -> tuple[np.ndarray, np.ndarray]:
    """All frames through the networks -> landmarks [F, 468, 2] px and presence [F]."""
    from shared.io.models import load_face_networks

    networks, previous = load_face_networks(), None
    points, presence = np.zeros((frames.count, 468, 2)), np.zeros(frames.count)
    for i in job.progress(range(frames.count), "landmarks"):
        rgb = eight_bit(frames.read_codes(i))
        certain, found = networks.track(rgb, previous) if previous is not None else (0.0, None)
        if certain < job.params.least_presence:
            faces = networks.detect(rgb)
            certain, found = networks.landmarks(rgb, faces[0]) if faces else (0.0, None)
        if found is not None and certain >= job.params.least_presence:
            points[i], presence[i], previous = found[:, :2], certain, found
        else:
            previous = None
    return points, presence


def eight_bit(codes: np.ndarray) -> np.ndarray:
    """uint8 or uint16 code values -> uint8."""
    return codes if codes.dtype == np.uint8 else (codes >> 8).astype(np.uint8)


def build_clip(job: Job, frames, used: np.ndarray, landmarks_px: np.ndarray):
    """Contrast images and unusable pixels of the frames with a face."""
    import cv2

    from shared.solve.track_head import Clip
    from shared.tracks import local_contrast, unusable_pixels

    clip = Clip([], [], landmarks_px[used], frames.intrinsics, frames.size)
    sigma = float(np.clip(clip.face_width_px / 55.0, 2.5, 12.0))
    for i in job.progress(used, "contrast images"):
        rgb = eight_bit(frames.read_codes(i))
        clip.contrast.append(local_contrast(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), sigma))
        background = frames.read_mask(i) == 0
        clip.unusable.append(unusable_pixels(rgb) | background.astype(np.uint8))
    return clip


def judge_frames(job: Job, frames, used: np.ndarray, presence: np.ndarray, track) -> tuple[np.ndarray, list[dict]]:
    """Which of the tracked frames fit [U] bool, and every excluded frame with its reason."""
    error = np.nanmedian(np.where(np.isfinite(track.error_px), track.error_px, np.nan)[track.reliable], axis=1)
    limit = max(job.params.largest_error, 4.0 * float(np.median(error)))
    fits = track.reliable.copy()
    fits[track.reliable] = error <= limit
    excluded = []
    for i in range(frames.count):
        place = np.nonzero(used == i)[0]
        reason = ""
        if len(place) == 0:
            reason = f"no face found (presence {presence[i]:.2f})"
        elif not track.reliable[place[0]]:
            reason = "too little skin could be tracked"
        elif not fits[place[0]]:
            error_px = np.nanmedian(track.error_px[place[0]])
            reason = f"track error {error_px:.2f} px: blur, talk or a hand before the face"
        if reason:
            excluded.append({"frame_index": int(frames.frame_index[i]), "reason": reason})
    return fits, excluded


def rotation_range_deg(camera_from_head: np.ndarray) -> float:
    """Largest angle between two frames' views of the head, in degrees."""
    from shared.geometry import camera_centres
    from shared.mesh import normalised

    directions = normalised(camera_centres(camera_from_head))
    return float(np.degrees(np.arccos(np.clip((directions @ directions.T).min(), -1.0, 1.0))))


def summarise(job: Job, frames, model, track, fits: np.ndarray, excluded: list[dict]) -> dict:
    """tracking.json; its warnings also go to the log."""
    error = track.error_px[fits]
    turned = rotation_range_deg(track.camera_from_head[fits])
    warnings = []
    if turned < SMALL_ROTATION_DEG:
        warnings.append(
            f"the view of the head changes by only {turned:.0f} degrees: depth rests on the head model; "
            "film a turn of 25 degrees to each side"
        )
    if not frames.focal_known:
        warnings.append("the focal length is a guess: depth and scale follow it; give camera.focal_length_mm")
    if len(excluded) > 0.2 * frames.count:
        warnings.append(f"{len(excluded)} of {frames.count} frames do not fit and were left out")
    for warning in warnings:
        job.warn(warning)
    return {
        "segments": list(model.segment_names),
        "excluded": excluded,
        "warnings": warnings,
        "frames": int(fits.sum()),
        "tracks": int(track.error_px.shape[1]),
        "rotation_range_deg": round(turned, 2),
        "reprojection_px": {
            "median": round(float(np.nanmedian(error)), 4),
            "p95": round(float(np.nanpercentile(error, 95)), 4),
        },
        "scale": "fixed by the head model's mean size and identity prior",
        "identity": [round(float(code), 4) for code in track.fit.identity],
        "expression": [round(float(code), 4) for code in track.fit.expression],
    }


def publish(job: Job, frames, model, used, landmarks_px, presence, track) -> None:
    """Writes all outputs."""
    from shared.io.arrays import save_arrays, write_json
    from shared.io.images import write_png
    from shared.io.meshes import save_mesh
    from shared.mesh import Mesh
    from shared.overlay import overlay_strip
    from shared.solve.track_head import choose_references

    fits, excluded = judge_frames(job, frames, used, presence, track)
    kept = used[fits]
    save_arrays(
        job.out / "poses.npz",
        camera_from_head=track.camera_from_head[fits],
        covariance=track.covariance[fits],
        frame_index=frames.frame_index[kept],
        intrinsics=frames.intrinsics_source,
        intrinsics_crop=frames.intrinsics,
    )
    mesh = Mesh(track.fit.vertices, model.faces, model.uvs, model.face_uvs)
    save_mesh(job.out / "mesh.npz", mesh, face_segment=model.face_segment)
    save_arrays(
        job.out / "landmarks.npz",
        landmarks_px=landmarks_px[kept],
        presence=presence[kept],
        frame_index=frames.frame_index[kept],
    )
    residual = np.nanmedian(track.error_px[fits], axis=0)
    save_arrays(job.out / "tracks.npz", points_head=track.points_head, residual_px=residual)
    write_json(job.out / "tracking.json", summarise(job, frames, model, track, fits, excluded))
    shown = kept[choose_references(track.camera_from_head[fits], 5)]
    pictures = [eight_bit(frames.read_codes(i)) for i in shown]
    poses = [track.camera_from_head[np.nonzero(used == i)[0][0]] for i in shown]
    write_png(job.out / "overlay.png", overlay_strip(pictures, mesh, poses, frames.intrinsics, landmarks_px[shown]))


def run(job: Job) -> None:
    """Landmarks, tracks, poses, head."""
    from shared.errors import InputError
    from shared.io.frames import FrameSet
    from shared.io.models import load_head_model
    from shared.solve.fit_head import FitWeights
    from shared.solve.track_head import TrackSettings, track_head

    frames, model = FrameSet.open(job.input("sample_frames")), load_head_model().subdivided()
    landmarks_px, presence = read_landmarks(job, frames)
    used = np.nonzero(presence > 0)[0]
    if len(used) < 3:
        raise InputError(
            "no face in this clip",
            where=frames.source_name,
            got=f"{len(used)} frames with landmarks",
            expected="3 or more",
            mend="film one head, facing the camera at the start, 200 px wide or more",
        )
    params = job.params
    settings = TrackSettings(
        passes=params.passes,
        references=params.references,
        tracks_per_reference=params.tracks,
        warp_width_px=params.warp_width,
        loss_scale_px=params.loss_scale,
        prior_mm=params.point_prior,
        fit=FitWeights(stiffness=params.stiffness),
    )
    track = track_head(build_clip(job, frames, used, landmarks_px), model, settings, job.progress, job.note)
    publish(job, frames, model, used, landmarks_px, presence, track)


def check(job: Job) -> None:
    """A head of human size before the camera, rigid poses, small residuals."""
    from shared.errors import LimnError
    from shared.io.arrays import load_arrays, read_json
    from shared.io.meshes import load_mesh

    poses = load_arrays(job.out / "poses.npz")["camera_from_head"]
    rotation = poses[:, :3, :3]
    if not np.allclose(rotation @ np.swapaxes(rotation, 1, 2), np.eye(3), atol=1e-6):
        raise LimnError("poses are not rigid")
    if not (np.isfinite(poses).all() and (poses[:, 2, 3] > 0).all()):
        raise LimnError("the head is not before the camera in every frame")
    height = np.ptp(load_mesh(job.out / "mesh.npz").vertices[:, 1])
    if not 150.0 < height < 450.0:
        raise LimnError(f"the fitted head and neck are {height:.0f} mm high; expected 150 to 450")
    if read_json(job.out / "tracking.json")["reprojection_px"]["median"] > 5.0:
        raise LimnError("median reprojection error above 5 px")


if __name__ == "__main__":
    raise SystemExit(main(STAGE, run, check))
