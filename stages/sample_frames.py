"""Sample frames: from the clip to cropped, lossless frames with masks.

Reads    the subject's video (or numbered images), lens and transfer function.
Writes   frames.json, frames/%06d.png (the crop in the source's own code values), masks/%06d.png, contact_sheet.png;
         chart.png where a colour chart is in view.
Method   A first pass looks at several times as many frames as wanted, in small: follows the faces, and measures
         sharpness and change against the neighbours. Faulty, black, alien, faceless, repeated and blurred frames go,
         each with its reason; the rest is thinned to an even spacing in time. One crop holds the whole head in all of
         them. A second pass decodes just these frames in full, and looks for a colour chart in a dozen of them, and at
         the grey place that a person named. Codes are stored as they are and linearised when read: rounding linear
         light to integers would lose the shadows.
Fails    nothing can be decoded; no face is found; fewer than three frames are usable.
"""

from __future__ import annotations

import numpy as np

from shared.contract import Job, Output, Parameter, Stage, main
from shared.contract.models import FACE_NETWORKS
from shared.contract.records import FRAMES
from shared.contract.subject import Subject
from shared.errors import InputError, LimnError

STAGE = Stage(
    name="sample_frames",
    version=5,
    help="Decode the clip, choose good frames evenly in time, crop them to the head and mask the person.",
    inputs=(),
    models=FACE_NETWORKS,
    outputs=(
        Output("frames.json", "frames with their times, the crop and its camera, dropped frames with the reason",
               fields=FRAMES),
        Output("frames/*.png", "the crop in the source's code values", space="crop", colour_space="source"),
        Output("masks/*.png", "0 background, 128 person, 255 face", space="crop"),
        Output("contact_sheet.png", "nine of the crops with their masks' outlines", colour_space="srgb"),
        Output("chart.png", "the colour chart as found, each patch with the colour it should have", optional=True,
               colour_space="srgb"),
    ),
    parameters=(
        Parameter("frame_count", int, 150, "Frames to keep at most.", "frames", 3, 2000),
        Parameter("max_size", int, 1024, "Longest side of the crop; larger ones are scaled down.", "px", 128, 4096),
        Parameter("candidates", int, 4, "Frames to look at for each that is kept, where the clip has so many.", "",
                  1, 100),
        Parameter("min_sharpness", float, 0.4, "Frames less sharp than this share of their neighbours are dropped.",
                  "", 0.0, 1.0, former="blurred_below"),
    ),
)

CLIPPED_WARNING = 0.1
FACE = 255


def run(job: Job) -> None:
    """Survey, select, crop, write."""
    from shared.capture.cameras import source_intrinsics
    from shared.capture.framing import crop_intrinsics
    from shared.capture.sample_clip import select_frames, survey_clip
    from shared.compute.processor import use_baseline_opencv
    from shared.io.arrays import write_json
    from shared.io.images import write_png
    from shared.io.video import open_video
    from shared.tracking.models import load_face_networks

    use_baseline_opencv()
    subject, params = job.subject, job.params
    reader, networks = open_video(subject.video, subject.transfer), load_face_networks()
    info = reader.info
    chart, grey = watch_for_chart(reader, subject), watch_grey_place(reader, subject)
    candidates = params.frame_count * params.candidates
    survey = survey_clip(reader, networks, subject.transfer, candidates, job.progress)
    selection = select_frames(survey, info, str(subject.video), frame_count=params.frame_count,
                              max_size=params.max_size, blurred_below=params.min_sharpness,
                              moves=subject.moves)
    job.note(selection.summary)
    intrinsics, focal_known, focal_warning = source_intrinsics(
        info, subject.focal_length_px, subject.focal_length_mm, subject.sensor_width_mm)
    records, picture_warnings = write_frames(reader, selection, [chart, grey], job)
    warnings = [*info.warnings, *transfer_warnings(info.transfer_tag, subject.transfer), *selection.warnings,
                *picture_warnings, *chart.warnings(), *grey.warnings(), *[focal_warning] * (not focal_known)]
    if chart.picture is not None:
        write_png(job.out / "chart.png", chart.picture)
    write_json(job.out / "frames.json", {
        "source": {"name": subject.video.name, "width": info.width, "height": info.height, "fps": info.fps,
                   "frame_count": info.frame_count, "codec": info.codec, "rotation_deg": info.rotation},
        "transfer": subject.transfer,
        "moves": subject.moves,
        "crop": selection.crop._asdict(),
        "size": list(selection.crop.size),
        "intrinsics": crop_intrinsics(intrinsics, selection.crop).tolist(),
        "intrinsics_source": intrinsics.tolist(),
        "focal_known": focal_known,
        "chart": chart.record(),
        **({"grey": said} if (said := grey.record()) else {}),
        "frames": records,
        "dropped": selection.dropped,
        "warnings": warnings,
    })
    for text in warnings:
        job.warn(text)


def transfer_warnings(tag: str, transfer: str) -> list[str]:
    """What does not fit between the transfer function that the file names and the one that the subject states."""
    if tag == "linear" and transfer != "linear":
        return [f"the images are linear but read as {transfer}: set colour.transfer to linear"]
    return []


def watch_for_chart(reader, subject: Subject):
    """A ChartWatch for the second pass; a frame that the subject points at is looked at now."""
    from shared.capture.chart_watch import ChartWatch

    place = subject.chart
    chart = ChartWatch(place, subject.transfer)
    if place.frame is not None:
        where, size = f"{subject.folder / 'subject.yaml'}: chart", (reader.info.width, reader.info.height)
        if any(not 0 <= value <= size[axis] for corner in place.corners for axis, value in enumerate(corner)):
            raise InputError("corners outside the picture", where=where, expected=f"inside {size[0]} x {size[1]} px")
        frame = next(iter(reader.frames([place.frame])), None)
        if frame is None or frame.fault:
            raise InputError("the clip has no such frame", where=f"{where}.frame", got=place.frame,
                             expected=f"0 .. {reader.info.frame_count - 1}")
        chart.look_at_given(frame.codes())
    return chart


def watch_grey_place(reader, subject: Subject):
    """A GreyWatch for the second pass; InputError where the place lies outside the picture."""
    from shared.capture.grey_watch import GreyWatch

    size = reader.info.width, reader.info.height
    if any(not 0 <= value <= size[axis] for axis, value in enumerate(subject.grey or ())):
        raise InputError("a place outside the picture", where=f"{subject.folder / 'subject.yaml'}: grey",
                         got=list(subject.grey), expected=f"inside {size[0]} x {size[1]} px")
    return GreyWatch(subject.grey, subject.transfer)


def write_frames(reader, selection, watches, job: Job) -> tuple[list[dict], list[str]]:
    """The second pass: crops, masks and the contact sheet -> one record per frame, and warnings. watches: what looks at
    the whole frames as they pass by: ChartWatch, GreyWatch."""
    from shared.capture.crop_pixels import area_average, clipped_share, display_codes, frame_mask, is_grey
    from shared.capture.framing import face_height
    from shared.compute.parallel import in_order
    from shared.compute.read_ahead import read_ahead
    from shared.imaging.picture_detail import ClipDetail
    from shared.io.images import write_png
    from shared.report.contact_sheet import ContactSheet
    from shared.tracking.models import own_face_networks

    for folder in ("frames", "masks"):
        (job.out / folder).mkdir(parents=True, exist_ok=True)
    crop, transfer, count = selection.crop, job.subject.transfer, len(selection.frame_index)
    sheet, records, clipped, grey, detail = ContactSheet(count), [], [], [], ClipDetail(count)
    for watch in watches:
        watch.expect(count)

    def cut_out(i: int, frame):
        whole = frame.codes()
        for watch in watches:
            watch.look(i, frame.index, whole)
        part = whole[crop.y0:crop.y0 + crop.height, crop.x0:crop.x0 + crop.width].copy()
        points = (selection.landmarks[i][:, :2] - (crop.x0, crop.y0)) * crop.scale
        return i, part, points, frame_record(frame.index, frame.time_s, points, selection.sharpness[i])

    def finish(cut):
        i, part, points, record = cut
        codes = area_average(part, crop.size, transfer)
        rgb = display_codes(codes, transfer)
        mask = frame_mask(rgb, own_face_networks().person_mask(rgb), points)
        write_png(job.out / record["file"], codes)
        write_png(job.out / record["mask"], mask)
        detail.look(i, rgb, mask == FACE, face_height(points))
        return record, rgb, mask, clipped_share(codes, mask), is_grey(codes)

    cuts = read_ahead(map(cut_out, range(count), reader.frames(selection.frame_index)))
    finished = job.progress(in_order(finish, cuts), "cropping", total=count)
    for record, rgb, mask, clipped_of_frame, is_frame_grey in finished:
        records.append(record)
        clipped.append(clipped_of_frame)
        grey.append(is_frame_grey)
        sheet.add(rgb, mask)
    write_png(job.out / "contact_sheet.png", sheet.picture())
    warnings = []
    if np.mean(clipped) > CLIPPED_WARNING:
        warnings.append(f"{np.mean(clipped):.0%} of the face is overexposed: expose it darker")
    if np.mean(grey) > 0.5:
        warnings.append("the clip has no colour: the maps will be grey")
    return records, [*warnings, *detail.warnings()]


def frame_record(frame_index: int, time_s: float, points: np.ndarray, sharpness: float) -> dict:
    """One entry of frames.json. points: landmarks [468, 2] crop px. sharpness: relative to the neighbours."""
    name = f"{frame_index:06d}.png"
    edges = np.concatenate([points.min(axis=0), points.max(axis=0)])
    return {
        "frame_index": frame_index,
        "time_s": time_s,
        "file": f"frames/{name}",
        "mask": f"masks/{name}",
        "sharpness": round(float(sharpness), 4),
        "face_box": [round(float(edge), 2) for edge in edges],
    }


def check(job: Job) -> None:
    """Frames in order and of one size, the crop inside the source, its camera consistent, a face in every mask."""
    from shared.capture.framing import Crop
    from shared.compute.parallel import in_order
    from shared.io.arrays import read_json
    from shared.io.frames import FrameSet

    frames, crop = FrameSet.open(job.out), Crop(**read_json(job.out / "frames.json")["crop"])
    source_width, source_height = frames.source_size
    inside = 0 <= crop.x0 <= source_width - crop.width and 0 <= crop.y0 <= source_height - crop.height
    require(inside, f"{crop} leaves the source of {source_width} x {source_height} px")
    require(crop.scale <= 1 and max(crop.size) <= job.params.max_size, f"{crop} is too large")
    require(frames.size == crop.size, f"size {frames.size} is not the crop's {crop.size}")
    require(3 <= frames.count <= job.params.frame_count, f"{frames.count} frames")
    require(bool(np.all(np.diff(frames.frame_index) > 0)), "frames are not in order")
    require(bool(np.all(np.diff(frames.time_s) > 0)), "times do not rise")
    corner = frames.intrinsics @ np.linalg.inv(frames.intrinsics_source) @ (crop.x0, crop.y0, 1.0)
    require(np.allclose(corner, (0, 0, 1), atol=1e-6), "the crop's intrinsics do not belong to the crop")
    for _ in in_order(lambda i: check_frame(frames, i), range(frames.count)):
        pass


def check_frame(frames, i: int) -> None:
    """Sizes, mask values, and a face that is not of one colour."""
    codes, mask, size = frames.read_codes(i), frames.read_mask(i), frames.size[::-1]
    require(codes.shape == (*size, 3) and mask.shape == size, f"{frames.files[i]}: wrong size")
    known = np.isin(np.nonzero(np.bincount(mask.ravel(), minlength=256))[0], (0, 128, FACE))
    require(bool(known.all()), f"{frames.mask_files[i]}: values besides 0, 128, 255")
    require(bool((mask == FACE).any()), f"{frames.mask_files[i]}: no face")
    require(int(np.ptp(codes[mask == FACE])) > 0, f"{frames.files[i]}: the face is of one colour")


def require(condition: bool, what: str) -> None:
    """LimnError unless the condition holds."""
    if not condition:
        raise LimnError(f"sample_frames: {what}")


if __name__ == "__main__":
    raise SystemExit(main(STAGE, run, check))
