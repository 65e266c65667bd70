"""The result as files that other programs open, and a page on which a person judges it.

Reads    sample_frames: frames.json and the chosen frames (for the report). track_landmarks: tracking.json and
         overlay.png. init_albedo: its record. inverse_render: maps, envmap.exr, mesh.npz, poses.npz, renders,
         solve.json. Of all of them manifest.json and provenance.json.
Writes   head.usda, head.usdz, mesh.obj, maps/*.exr, envmap.exr, poses.npz, renders/*.exr, run.json, report.html.
Method   Units, axes, colour spaces and sources are stated on everything that is written; then the asset is validated
         as a stranger would find it on disk.
Fails    values that are not finite, a mesh with broken indices or UVs, a map that is not a square power of two,
         anything that usd-core's validators or the MaterialX definitions object to.
"""

from __future__ import annotations

import time
from pathlib import Path

from shared.contract import Job, Output, Parameter, Stage, main
from shared.errors import LimnError

STAGE = Stage(
    name="export_usd",
    version=1,
    help="The head as USD, OBJ and EXR, with a report to judge it by.",
    inputs=("sample_frames", "track_landmarks", "init_albedo", "inverse_render"),
    outputs=(
        Output("head.usda", "mesh, materials, light, camera and motion", unit="mm", space="world"),
        Output("head.usdz", "head.usda and its textures in one file; absent when usdz is off", optional=True),
        Output("mesh.obj", "the mesh with its UVs", unit="mm", space="head"),
        Output("maps/*.exr", "texture maps, v up", space="uv", colour_space="in each file"),
        Output("maps/png/*.png", "integer copies of the maps; absent unless png_copies", space="uv", optional=True),
        Output("envmap.exr", "the light, lat-long", space="world", colour_space="in the file"),
        Output("poses.npz", "camera_from_head [F, 4, 4], frame_index [F], intrinsics [3, 3] of the frame", "mm"),
        Output("renders/*.exr", "re-renders in full source frames", colour_space="in each file"),
        Output("run.json", "parameters, model, costs, residuals and warnings of all stages", volatile=True),
        Output("report.html", "the page for people", volatile=True),
    ),
    parameters=(
        Parameter("map_format", str, "half", "Precision of the EXR files.", choices=("half", "float")),
        Parameter("acescg", bool, False, "Write colours as ACEScg instead of linear Rec.709."),
        Parameter("png_copies", str, "none", "Also write the maps as PNG.", choices=("none", "8", "16"), unit="bits"),
        Parameter("usdz", bool, True, "Also pack everything into head.usdz."),
        Parameter("report_frames", int, 12, "Frames that the report compares.", unit="frames", minimum=1, maximum=60),
    ),
)

SMALLEST_HEAD_MM, LARGEST_HEAD_MM = 100.0, 800.0


def read_maps(folder: Path) -> dict:
    """{name: array} of inverse_render's maps; confidence clipped to [0, 1]."""
    import numpy as np

    from shared.io.export_maps import MAPS
    from shared.io.images import read_exr

    maps = {name: read_exr(folder / f"{name}.exr") for name in MAPS}
    maps["confidence"] = np.clip(maps["confidence"], 0.0, 1.0)
    return maps


def write_images(job: Job, writer, maps: dict, envmap, frames, render_frames: list[int]) -> None:
    """maps/, envmap.exr and renders/ in the chosen precision and colour space."""
    from shared.io.export_maps import paste_crop, write_png_copies
    from shared.io.images import read_exr
    from shared.io.usd_material import modulated_ior

    writer.write_maps(job.out / "maps", maps)
    ior = modulated_ior(maps["specular_intensity"])
    writer.write_data(job.out / "maps" / "specular_ior.exr", ior, "index of refraction, for UsdPreviewSurface")
    writer.write_colour(job.out / "envmap.exr", envmap, "radiance, clip maximum 1", latlong=True)
    if job.params.png_copies != "none":
        write_png_copies(job.out / "maps" / "png", maps, int(job.params.png_copies))
    (job.out / "renders").mkdir()
    for frame_index in job.progress(render_frames, "renders"):
        crop = read_exr(job.input("inverse_render") / "renders" / f"{frame_index:06d}.exr")
        full = paste_crop(crop, frames.crop, frames.source_size)
        writer.write_colour(job.out / "renders" / f"{frame_index:04d}.exr", full, "radiance, clip maximum 1")


def write_geometry(job: Job, mesh, poses: dict, frames, colour_space: str) -> None:
    """mesh.obj, poses.npz, head.usda and, when wished, head.usdz."""
    from shared.io.arrays import save_arrays
    from shared.io.export_maps import MAPS
    from shared.io.meshes import write_obj
    from shared.io.usd import HeadAsset, write_head_usda
    from shared.io.usd_capture import DEFAULT_FILM_WIDTH_MM, Capture
    from shared.io.usdz import write_usdz

    write_obj(job.out / "mesh.obj", mesh)
    intrinsics = poses["intrinsics"]
    kept = {name: poses[name] for name in ("camera_from_head", "frame_index")}
    save_arrays(job.out / "poses.npz", intrinsics=intrinsics, **kept)
    width, height = frames.source_size
    film_width = job.subject.sensor_width_mm or DEFAULT_FILM_WIDTH_MM
    capture = Capture(**kept, fps=frames.fps, intrinsics=intrinsics, width=width, height=height, moves=frames.moves,
                      film_width_mm=film_width)
    maps = {name: f"./maps/{name}.exr" for name in (*MAPS, "specular_ior")}
    metadata = {
        "clip": {"name": frames.source_name, "width": width, "height": height, "fps": frames.fps},
        "moves": frames.moves,
        "focal_length_known": bool(frames.focal_known),
        "film_width_known": job.subject.sensor_width_mm is not None,
        "brdf": "albedo / pi + specular_intensity * GGX (Smith, Schlick F0 = 0.04, alpha = roughness^2)",
        "confidence_map": "maps/confidence.exr",
    }
    asset = HeadAsset(job.subject.name, mesh, maps, "./envmap.exr", capture, version=str(STAGE.version),
                      colour_space=colour_space, metadata=metadata)
    write_head_usda(job.out / "head.usda", asset)
    if job.params.usdz:
        write_usdz(job.out / "head.usdz", job.out / "head.usda")


def run_record(job: Job, mesh, solve: dict, own_seconds: float) -> dict:
    """The content of run.json: what each stage was told, what it took, what it found."""
    from shared.mesh_checks import mesh_warnings
    from shared.report.gather import own_record, stage_record, warnings_of

    records, warnings = {}, []
    for stage in STAGE.inputs:
        records[stage] = stage_record(job.manifest(stage), job.provenance(stage))
        warnings += warnings_of(stage, job.input(stage), records[stage])
    own = own_record(STAGE.version, job.params.as_dict(), own_seconds)
    for text in mesh_warnings(mesh):
        job.warn(text)
        own["warnings"].append(text)
        warnings.append((STAGE.name, text))
    records[STAGE.name] = own
    chosen = {key: solve[key] for key in ("model", "residuals", "albedo_scale", "held_out_frames") if key in solve}
    return {
        "subject": job.subject.name,
        "stages": records,
        "warnings": [{"stage": stage, "text": text} for stage, text in warnings],
        **chosen,
    }


def run(job: Job) -> None:
    """Writes the result's files, then the report about them."""
    from shared.io.arrays import load_arrays, read_json, write_json
    from shared.io.export_maps import MapWriter
    from shared.io.frames import FrameSet
    from shared.io.images import read_exr
    from shared.io.meshes import load_mesh
    from shared.report.build import Result, result_report

    start, solved = time.perf_counter(), job.input("inverse_render")
    frames = FrameSet.open(job.input("sample_frames"))
    mesh, poses = load_mesh(solved / "mesh.npz"), load_arrays(solved / "poses.npz")
    solve, maps, envmap = read_json(solved / "solve.json"), read_maps(solved / "maps"), read_exr(solved / "envmap.exr")
    source = {"stage": STAGE.name, "stage_version": STAGE.version, "source": "inverse_render"}
    writer = MapWriter(job.params.map_format == "half", job.params.acescg, source)
    write_images(job, writer, maps, envmap, frames, solve["render_frames"])
    write_geometry(job, mesh, poses, frames, writer.colour_space)
    record = run_record(job, mesh, solve, time.perf_counter() - start)
    write_json(job.out / "run.json", record)
    folders = {name: job.input(name) for name in STAGE.inputs}
    files = [(output.path, output.help) for output in STAGE.outputs]
    result = Result(job.subject.name, folders, frames, mesh, poses, maps, envmap, solve, record, files)
    page = result_report(result, job.params.report_frames)
    (job.out / "report.html").write_text(page, encoding="utf-8")


def check(job: Job) -> None:
    """Reads the files back as a stranger would; LimnError says all that is wrong."""
    import numpy as np

    from shared.io.arrays import load_arrays
    from shared.io.export_maps import MAPS
    from shared.io.images import read_exr
    from shared.io.meshes import read_obj
    from shared.io.usd_validate import usd_errors
    from shared.mesh_checks import mesh_errors

    mesh = read_obj(job.out / "mesh.obj")
    errors = [f"mesh.obj: {error}" for error in mesh_errors(mesh)]
    size = float(np.ptp(mesh.vertices, axis=0).max())
    if not SMALLEST_HEAD_MM < size < LARGEST_HEAD_MM:
        errors.append(f"mesh.obj: {size:.0f} mm is not the size of a head")
    for name in (*MAPS, "specular_ior"):
        errors += map_errors(name, read_exr(job.out / "maps" / f"{name}.exr"))
    rotations = load_arrays(job.out / "poses.npz")["camera_from_head"][:, :3, :3]
    if not np.allclose(rotations @ rotations.transpose(0, 2, 1), np.eye(3), atol=1e-6):
        errors.append("poses.npz: not all poses are rigid")
    errors += usd_errors(job.out / "head.usda")
    if job.params.usdz:
        errors += usd_errors(job.out / "head.usdz")
    if errors:
        raise LimnError("the result does not pass its checks: " + "; ".join(errors))


def map_errors(name: str, values) -> list[str]:
    """Sentences about a map's shape and range."""
    height, width = values.shape[:2]
    errors = []
    if height != width or width & (width - 1):
        errors.append(f"{name}: {width} x {height} is not a square power of two")
    if values.min() < -1e-3:
        errors.append(f"{name}: negative values down to {values.min():.4g}")
    if name in ("confidence", "normal", "roughness") and values.max() > 1.0 + 1e-3:
        errors.append(f"{name}: values up to {values.max():.4g}, expected at most 1")
    return errors


if __name__ == "__main__":
    raise SystemExit(main(STAGE, run, check))
