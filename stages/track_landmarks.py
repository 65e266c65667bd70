"""Head pose in each frame and the head's shape.

Reads    sample_frames: the cropped frames and their intrinsics. The subject's own landmarks or poses, where
         subject.yaml names them.
Writes   poses.npz, mesh.npz, landmarks.npz, tracks.npz, tracking.json, overlay.png, curves.png, residuals.png.
Method   468 landmarks a frame start the poses, dense flow and then tracks against the clip's mean texture, adjusted as
         one rigid body, hold them still; the head model is fitted to the tracks and then bent to them freely, its lids
         laid on those of the frames, its lips shut. Its size is the head model's mean and what the irises say, or that
         of a given length. Frames of another expression than most are left out. Irises, followed by their texture and
         laid on their rims, and lids tell gaze and blinks; what turns with the eyes tells where open lids end.
Fails    no landmarks in three frames; skin that cannot be tracked (too small, blurred, or not the same head); a head
         that does not turn (a poster, too).
"""

from __future__ import annotations

import numpy as np

from shared.contract import Job, Output, Parameter, Stage, main
from shared.contract.models import FACE_NETWORKS, HEAD_MODEL_FILE, IRIS_NETWORK
from shared.contract.records import LANDMARKS, MESH, TRACKED_POSES, TRACKING, TRACKS

STAGE = Stage(
    name="track_landmarks",
    version=22,
    help="Head pose in each frame and the head's shape, from landmarks and dense skin tracks.",
    inputs=("sample_frames",),
    given=("landmarks", "poses"),
    models=(*FACE_NETWORKS, IRIS_NETWORK, HEAD_MODEL_FILE),
    outputs=(
        Output("poses.npz", "the head's pose in each frame, its covariance, the gaze, the lens", unit="mm",
               fields=TRACKED_POSES),
        Output("mesh.npz", "the fitted head with its UVs and face segments", unit="mm", space="head", fields=MESH),
        Output("landmarks.npz", "the 468 landmarks of each used frame, irises and lids", unit="px", space="crop",
               fields=LANDMARKS),
        Output("tracks.npz", "track points on the skin, their errors in pixels and in depth", unit="mm", space="head",
               fields=TRACKS),
        Output("tracking.json", "residuals, rotation range, excluded frames with their reasons, warnings",
               fields=TRACKING),
        Output("overlay.png", "mesh and landmarks drawn over five frames", colour_space="srgb"),
        Output("curves.png", "pose and its uncertainty over time", colour_space="srgb"),
        Output("residuals.png", "track errors in the texture's layout", space="uv", colour_space="srgb"),
    ),
    parameters=(
        Parameter("start_frames", int, 60, "Frames that the first poses come from.", "frames", 3, 1000),
        Parameter("references", int, 3, "Reference frames of the dense flow.", "frames", 1, 5),
        Parameter("flow_tracks", int, 1000, "Skin points that flow follows from each.", "points", 100, 20000),
        Parameter("warp_width", float, 320.0, "Width of the face in the flow's pictures.", "px", 100.0, 2000.0),
        Parameter("fine_passes", int, 1, "Passes over the finest detail.", "", 1, 6),
        Parameter("tracks", int, 5000, "Skin points tracked against the mean texture.", "points", 100, 20000),
        Parameter("texel_px", float, 1.0, "Edge of the mean texture's texels.", "px", 0.5, 8.0, former="texel"),
        Parameter("window_sigma", float, 5.0, "Standard width of the windows that are matched.", "texels", 1.5, 30.0,
                  former="window"),
        Parameter("point_sigma", float, 10.0, "Deviation of track points about the fitted head.", "mm", 0.01, 1000.0,
                  former="point_prior"),
        Parameter("head_fit", str, "robust", "Weights of the head model's fit.", choices=("robust", "published"),
                  former="fit"),
        Parameter("stiffness", float, 20.0, "Stiffness of the free shape, per noise over relief.", "", 0.01, 1e6),
        Parameter("min_confidence", float, 0.5, "Landmark network's confidence below which a frame is lost.", "", 0, 1,
                  former="least_presence"),
        Parameter("eyes", bool, True, "Find gaze and blinks."),
        Parameter("outlier_factor", float, 4.0, "Frames that fit so many times worse are left out.", "", 1.5, 100.0),
    ),
)


def look_at_frames(job: Job, frames):
    """Each frame read once -> landmarks [F, 468, 2] px and presence [F], by the networks or of the given file, the F
    grey frames that the pictures for tracking are made of, and the eyes of each frame, None without `eyes`."""
    from shared.capture.iris import SeenEyes
    from shared.compute.parallel import in_order
    from shared.imaging.color import eight_bit
    from shared.tracking.given_tracking import read_given_landmarks
    from shared.tracking.models import own_face_networks, own_iris_network
    from shared.tracking.tracked_clip import GreyFrame

    given, points, presence = job.subject.landmarks, np.zeros((frames.count, 468, 2)), np.zeros(frames.count)
    if given is not None:
        points, is_given = read_given_landmarks(given, frames.frame_index, frames.crop)
        presence = is_given.astype(float)
    least, greys, eyes, previous = job.params.min_confidence, [], [], None

    def eyes_in(rgb: np.ndarray, landmarks_px: np.ndarray | None):
        return own_iris_network().eyes(rgb, landmarks_px) if job.params.eyes and landmarks_px is not None else None

    def look(i: int):
        rgb = eight_bit(frames.read_codes(i))
        found = own_face_networks().find_alone(rgb, least) if given is None else None
        named = points[i] if presence[i] > 0 else None
        return GreyFrame.of(rgb, frames.read_mask(i) == 0), found, eyes_in(rgb, named if found is None else found[1])

    for i, (grey, found, seen) in enumerate(in_order(look, job.progress(range(frames.count), "landmarks"))):
        greys.append(grey)
        if given is None:
            if found is None:
                rgb = eight_bit(frames.read_codes(i))
                found = own_face_networks().find(rgb, previous, least)
                seen = eyes_in(rgb, found[1])
            presence[i], previous = found
            if previous is not None:
                points[i] = previous[:, :2]
        eyes.append(seen)
    return points, presence, greys, SeenEyes.of(eyes) if job.params.eyes else None


def build_clip(job: Job, frames, greys: list, used: np.ndarray, landmarks_px: np.ndarray, given_poses, seen):
    """Contrast pictures and unusable pixels of the frames with a face. greys: of all frames, which go as their pictures
    come; used [F] int: positions of those frames; given_poses [F, 4, 4] mm or None; seen: eyes of all frames."""
    from shared.compute.parallel import in_order
    from shared.tracking.tracked_clip import TrackedClip, face_width

    width = face_width(landmarks_px[used])

    def pictures(i: int) -> tuple[np.ndarray, ...]:
        grey, greys[i] = greys[i], None
        return *grey.contrast(width), grey.unusable

    made = list(in_order(pictures, job.progress(used, "contrast pictures")))
    contrast, detail, unusable = (list(kind) for kind in zip(*made, strict=True))
    return TrackedClip(
        contrast,
        detail,
        unusable,
        landmarks_px[used],
        frames.time_s[used],
        frames.intrinsics,
        frames.size,
        None if given_poses is None else given_poses[used],
        job.subject.hold_poses,
        None if seen is None else seen.lids_px[used],
    )


def read_settings(job: Job, focal_known: bool):
    """The stage's parameters as the solver's settings."""
    from shared.tracking.first_poses import FlowSettings
    from shared.tracking.fit_head import PUBLISHED, FitWeights
    from shared.tracking.track_head import TrackSettings

    params = job.params
    return TrackSettings(
        flow=FlowSettings(params.references, params.flow_tracks, params.warp_width),
        start_frames=params.start_frames,
        fine_passes=params.fine_passes,
        tracks=params.tracks,
        texel_px=params.texel_px,
        window_sigma=params.window_sigma,
        prior_mm=params.point_sigma,
        estimate_focal=not focal_known,
        fit=PUBLISHED if params.head_fit == "published" else FitWeights(stiffness=params.stiffness),
    )


def excluded_frames(frames, used: np.ndarray, presence: np.ndarray, reasons: list[str]) -> list[dict]:
    """Every frame that got no pose, with its reason. used [F] int: positions of the frames with a face; presence
    [F], 0 to 1."""
    of_used = dict(zip(used.tolist(), reasons, strict=True))
    excluded = []
    for i in range(frames.count):
        reason = of_used.get(i, f"no face found (presence {presence[i]:.2f})")
        if reason:
            excluded.append({"frame_index": int(frames.frame_index[i]), "reason": reason})
    return excluded


def summarise(job: Job, frames, model, track, fits: np.ndarray, excluded: list[dict], common, measured: dict) -> dict:
    """tracking.json; its warnings also go to the log. fits [F] bool: frames that got a pose; common: their
    expression; measured: what is said of scale and eyes."""
    from shared.geometry.transforms import rotation_range_deg
    from shared.tracking.track_quality import rotation_deviation_deg, warnings_of

    lips = track.fit.vertices[np.unique(model.faces[model.segment("lips")])]
    warnings = warnings_of(track, fits, frames.count, frames.focal_known, lips)
    warnings += filter(None, [common.warning()])
    for warning in warnings:
        job.warn(warning)
    error = track.error_px[fits]
    rotation = rotation_deviation_deg(track, fits)
    return {
        "segments": list(model.segment_names),
        "excluded": excluded,
        "warnings": warnings,
        "frames": int(fits.sum()),
        "tracks": int(track.error_px.shape[1]),
        "rotation_range_deg": round(rotation_range_deg(track.camera_from_head[fits]), 2),
        "rotation_deviation_deg": {
            "median": round(float(np.median(rotation)), 4),
            "max": round(float(rotation.max()), 4),
        },
        "reprojection_px": {
            "median": round(float(np.nanmedian(error)), 4),
            "p95": round(float(np.nanpercentile(error, 95)), 4),
        },
        "held_out_px": {"before": round(track.held_out_px[0], 4), "after": round(track.held_out_px[1], 4)},
        "noise_factor": round(track.noise_factor, 3),
        "focal": {
            "solved": track.focal_solved,
            "gain": round(track.focal_gain, 5),
            "log_deviation": round(track.focal_deviation, 5),
        },
        "held": job.subject.hold_poses,
        "identity": [round(float(code), 4) for code in track.fit.identity],
        "expression": [round(float(code), 4) for code in track.fit.expression],
        **measured,
    }


def size_head(job: Job, frames, model, kept: np.ndarray, seen, track, fits: np.ndarray, lens: np.ndarray):
    """-> the track at the head's own size, its surface, its eyes (None without `eyes`), and what set that size. kept
    [F] int: positions of the frames with a pose, which fits [U] bool has of the tracked ones; seen: eyes of all frames;
    lens [3, 3]."""
    from dataclasses import replace

    from shared.tracking.eyes import head_scale, track_eyes
    from shared.tracking.fit_lids import LidMargins, lay_on_balls
    from shared.tracking.fit_surface import ThinPlate

    def measured(track, seen):
        surface = model.surface(track.fit.vertices)
        if seen is None:
            return surface, None
        return surface, track_eyes(surface, seen, track.camera_from_head[fits], lens, frames.time_s[kept])

    surface, eyes = measured(track, None if seen is None else seen.subset(kept))
    scale = head_scale(surface, eyes, job.subject.pupil_distance_mm)
    job.note(f"size: {100 * (scale.factor - 1):+.1f} % (deviation {100 * scale.log_deviation:.1f} %) by {scale.method}")
    openings = None if eyes is None or eyes.openings is None else eyes.openings.scaled(scale.factor)
    if scale.factor != 1.0:
        track = track.scaled(scale.factor)
        surface, eyes = measured(track, None if eyes is None else eyes.seen)
    if openings is not None:
        vertices = lay_on_balls(ThinPlate(model), LidMargins.of(model), track.fit.vertices, openings)
        track = replace(track, fit=replace(track.fit, vertices=vertices))
        surface = model.surface(vertices)
    return track, surface, eyes, scale


def publish(job: Job, frames, model, used, landmarks_px, presence, seen, track) -> None:
    """Writes all outputs."""
    from shared.imaging.color import eight_bit
    from shared.io.arrays import save_arrays, write_json
    from shared.io.images import write_png
    from shared.io.meshes import save_mesh
    from shared.report.tracking_pictures import overlay_strip, pose_curves, residual_map
    from shared.tracking.bundle import zoomed
    from shared.tracking.expression import common_expression
    from shared.tracking.first_poses import choose_references
    from shared.tracking.track_quality import frames_that_fit

    fits, reasons = frames_that_fit(track, job.params.outlier_factor)
    gain = track.focal_gain if track.focal_solved else 1.0
    lens = zoomed(frames.intrinsics, gain)
    common = common_expression(
        model, track.fit.vertices, track.camera_from_head, lens, landmarks_px[used], fits
    )
    fits = fits & common.shown
    reasons = [reason or common.reason(k) for k, reason in enumerate(reasons)]
    kept = used[fits]
    track, surface, eyes, scale = size_head(job, frames, model, kept, seen, track, fits, lens)
    mesh, poses, covariance = surface.mesh, track.camera_from_head[fits], track.covariance[fits]
    save_arrays(
        job.out / "poses.npz",
        camera_from_head=poses,
        covariance=covariance,
        frame_index=frames.frame_index[kept],
        intrinsics=zoomed(frames.intrinsics_source, gain),
        intrinsics_crop=lens,
        **({} if eyes is None else eyes.pose_arrays),
    )
    save_mesh(job.out / "mesh.npz", mesh, face_segment=model.face_segment)
    save_arrays(
        job.out / "landmarks.npz",
        landmarks_px=landmarks_px[kept],
        presence=presence[kept],
        frame_index=frames.frame_index[kept],
        **({} if eyes is None else eyes.landmark_arrays),
    )
    residual = np.nanmedian(track.error_px[fits], axis=0)
    save_arrays(job.out / "tracks.npz", points_head=track.points_head, residual_px=residual, sigma_mm=track.sigma_mm)
    excluded = excluded_frames(frames, used, presence, reasons)
    said = {"scale": scale.record()} | ({} if eyes is None else {"eyes": eyes.record(frames.frame_index[kept])})
    write_json(job.out / "tracking.json", summarise(job, frames, model, track, fits, excluded, common, said))
    chosen, gaze = choose_references(poses, 5), None if eyes is None else eyes.gaze
    pictures = [eight_bit(frames.read_codes(i)) for i in kept[chosen]]
    write_png(job.out / "overlay.png", overlay_strip(pictures, mesh, poses[chosen], lens, landmarks_px[kept[chosen]]))
    write_png(job.out / "curves.png", pose_curves(poses, covariance, frames.time_s[kept], gaze))
    write_png(job.out / "residuals.png", residual_map(mesh, track.points_head, residual))


def load_solver():
    """The solver's libraries, which take a second to load, and the head model."""
    import shared.tracking.track_head  # noqa: F401
    from shared.tracking.models import load_head_model

    return load_head_model().subdivided()


def run(job: Job) -> None:
    """Landmarks, tracks, poses, head."""
    from concurrent.futures import ThreadPoolExecutor

    from shared.compute.processor import use_baseline_opencv
    from shared.errors import InputError
    from shared.io.frames import FrameSet
    from shared.tracking.given_tracking import read_given_poses

    use_baseline_opencv()
    frames = FrameSet.open(job.input("sample_frames"))
    with ThreadPoolExecutor(1) as beside:
        loading = beside.submit(load_solver)
        landmarks_px, presence, greys, seen = look_at_frames(job, frames)
        model = loading.result()
    from shared.tracking.track_head import track_head

    given_poses = None
    if job.subject.poses is not None:
        given_poses, posed = read_given_poses(job.subject.poses, frames.frame_index)
        presence = np.where(posed, presence, 0.0)
    used = np.nonzero(presence > 0)[0]
    if len(used) < 3:
        raise InputError(
            "no face in this clip",
            where=frames.source_name,
            got=f"{len(used)} frames with landmarks",
            expected="3 or more",
            hint="film one head, facing the camera at the start, 200 px wide or more",
        )
    clip = build_clip(job, frames, greys, used, landmarks_px, given_poses, seen)
    track = track_head(clip, model, read_settings(job, frames.focal_known), job.progress, job.note)
    publish(job, frames, model, used, landmarks_px, presence, seen, track)


def check(job: Job) -> None:
    """A head of human size before the camera, rigid poses, small residuals."""
    from shared.errors import LimnError
    from shared.io.arrays import load_arrays, read_json
    from shared.io.meshes import load_mesh

    arrays = load_arrays(job.out / "poses.npz")
    poses, covariance = arrays["camera_from_head"], arrays["covariance"]
    rotation = poses[:, :3, :3]
    if not np.allclose(rotation @ np.swapaxes(rotation, 1, 2), np.eye(3), atol=1e-6):
        raise LimnError("poses are not rigid")
    if not (np.isfinite(poses).all() and (poses[:, 2, 3] > 0).all()):
        raise LimnError("the head is not before the camera in every frame")
    if not (np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance).min() >= -1e-12):
        raise LimnError("a pose has no covariance")
    height = np.ptp(load_mesh(job.out / "mesh.npz").vertices[:, 1])
    if not 150.0 < height < 450.0:
        raise LimnError(f"the fitted head and neck are {height:.0f} mm high; expected 150 to 450")
    if read_json(job.out / "tracking.json")["reprojection_px"]["median"] > 5.0:
        raise LimnError("median reprojection error above 5 px")


if __name__ == "__main__":
    raise SystemExit(main(STAGE, run, check))
