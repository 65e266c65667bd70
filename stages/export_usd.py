"""The result as files that other programs open, and a page on which a person judges it.

Reads    sample_frames: frames.json, the frames and masks (for plates, alpha and the report). track_landmarks:
         tracking.json and overlay.png. init_albedo: its record. inverse_render: maps, envmap.exr, mesh.npz, hair.npz,
         poses.npz, renders, solve.json. Of all of them manifest.json and provenance.json. Of several clips the first is
         exported, and the light of each.
Writes   head.usda with its payload, head.usdz, head.glb, mesh.obj, hair.obj, maps/*.exr, envmap.exr, envmaps/*.exr,
         poses.npz, plates/*.jpg, renders/*.exr, layers/*.exr, patches/*.exr, views/*.exr, run.json, methods.txt,
         report.html.
Method   The head model's facial actions are carried over to the solved head, where the mesh is the model's, and written
         as blend shapes. Edges of the full mesh are collapsed to meshes of fewer faces; the head model's quads are laid
         under it as a subdivision surface, and what it has beyond that becomes a displacement map. Units, axes, colour
         spaces and sources are stated on everything that is written; then the asset is validated as a stranger would
         find it on disk.
Fails    values that are not finite, a mesh with broken indices or UVs, a map that is not a square power of two,
         anything that usd-core's validators or the MaterialX definitions object to.
"""

from __future__ import annotations

import time
from pathlib import Path

from shared.contract import Job, Output, Parameter, Stage, main
from shared.contract.models import HEAD_MODEL_FILE
from shared.contract.records import EXPORTED_POSES, RUN
from shared.errors import LimnError

STAGE = Stage(
    name="export_usd",
    version=18,
    help="The head as USD, glTF, OBJ and EXR, with a report to judge it by.",
    inputs=("sample_frames", "track_landmarks", "init_albedo", "inverse_render"),
    joins=("sample_frames", "track_landmarks", "init_albedo"),
    models=(HEAD_MODEL_FILE,),
    outputs=(
        Output("head.usda", "light, camera and motion; loads the next three", unit="mm", space="world"),
        Output("head_payload.usda", "payload of head.usda: joins the next two"),
        Output("head_geo.usdc", "the mesh and its blend shapes, in full and reduced; head and eyes where the gaze is "
               "known", unit="mm", space="head"),
        Output("head_mtl.usda", "the materials"),
        Output("head.usdz", "head.usda and its textures in one file, with fewer faces; absent when usdz is off",
               optional=True),
        Output("head.glb", "the same as binary glTF: mesh, morph targets, textures, lens, motion; absent when glb is "
               "off", unit="m", optional=True),
        Output("mesh.obj", "the mesh with its UVs; groups for head and eyes", unit="mm", space="head"),
        Output("hair.obj", "hair that stands off the head, with UVs of maps/hair_*.exr; absent where hair has no "
               "surface of its own", unit="mm", space="head", optional=True),
        Output("maps/*.exr", "texture maps, v up", space="uv", colour_space="in each file"),
        Output("maps/png/*.png", "integer copies of the maps; absent unless png_copies", space="uv", optional=True),
        Output("envmap.exr", "the light, lat-long", space="world", colour_space="in the file"),
        Output("envmaps/*.exr", "the light of each clip, where there are several", space="world",
               colour_space="in the file", optional=True),
        Output("envmap_far.exr", "the light without the main lamp, where that stands near", space="world",
               colour_space="in the file", optional=True),
        Output("poses.npz", "the head's pose in each frame, the lens, and where the eyes look", "mm",
               fields=EXPORTED_POSES),
        Output("plates/*.jpg", "the clip's crops, sRGB; absent when plates is off", space="crop", optional=True),
        Output("renders/*.exr", "re-renders in full source frames", colour_space="in each file"),
        Output("layers/*.exr", "the same with an alpha and premultiplied by it, to lay over the clip's frames",
               colour_space="in each file"),
        Output("patches/*.exr", "what covers the old head's fringe: between the clip's frame and its layer",
               colour_space="in each file"),
        Output("views/*.exr", "novel and relit views, and the lights of the latter; absent when views is off",
               colour_space="in each file", optional=True),
        Output("run.json", "parameters, model, costs, residuals and warnings of all stages", volatile=True,
               fields=RUN),
        Output("report.html", "the page for people", volatile=True),
        Output("methods.txt", "what was done, to paste into a paper, with versions and references", volatile=True),
    ),
    parameters=(
        Parameter("map_format", str, "half", "Precision of the EXR files.", choices=("half", "float")),
        Parameter("map_layout", str, "scanline", "How the maps' EXR files are laid out; mipmap includes tiles.",
                  choices=("scanline", "tiled", "mipmap")),
        Parameter("udim", bool, False, "Name the maps as tile 1001 of a UDIM set."),
        Parameter("acescg", bool, False, "Write colours as ACEScg instead of linear Rec.709."),
        Parameter("png_copies", str, "none", "Also write the maps as PNG.", choices=("none", "8", "16"), unit="bits"),
        Parameter("usdz", bool, True, "Also pack everything into head.usdz."),
        Parameter("glb", bool, True, "Also write binary glTF."),
        Parameter("actions", bool, True, "Also write facial actions as blend shapes, if the mesh is the head model's."),
        Parameter("detail", bool, True, "Also write meshes of 20,000 and 5,000 faces, variants of the asset, and quads "
                  "with a displacement map if the mesh is the head model's."),
        Parameter("viewer_detail", str, "20k", "Faces of the mesh in head.glb, and of the finest one in head.usdz.",
                  choices=("full", "20k", "5k")),
        Parameter("plates", bool, True, "Also write the clip's frames, shown behind the head in USD as a guide."),
        Parameter("views", bool, True, "Also render the head from the side and under other lights."),
        Parameter("view_size", int, 512, "Edge of those pictures.", "px", 64, 4096),
        Parameter("report_frames", int, 12, "Frames that the report compares.", unit="frames", minimum=1, maximum=60),
    ),
)

PAGE_DETAIL = "20k"
"""What the report's 3D view shows; nobody sees a difference at its size."""


def read_maps(folder: Path) -> dict:
    """{name: array} of inverse_render's maps and of what follows from them; confidence clipped to [0, 1]."""
    import numpy as np

    from shared.io.export_maps import SOLVED_MAPS
    from shared.io.images import read_exr
    from shared.io.material_maps import read_material
    from shared.io.usd_material import modulated_ior

    maps = {name: read_exr(folder / f"{name}.exr") for name in SOLVED_MAPS}
    maps["confidence"] = np.clip(maps["confidence"], 0.0, 1.0)
    maps["material"] = read_material(folder / "material.exr")
    return maps | {"specular_ior": modulated_ior(maps["specular_intensity"])}


def read_surface(job: Job, mesh):
    """The mesh with its segments, where it has any."""
    from shared.geometry.surface import Surface
    from shared.io.arrays import load_arrays, read_json

    segment = load_arrays(job.input("inverse_render") / "mesh.npz").get("face_segment")
    if segment is None:
        return Surface(mesh)
    return Surface(mesh, segment, tuple(read_json(job.input("track_landmarks") / "tracking.json")["segments"]))


def read_poses(job: Job) -> dict:
    """inverse_render's poses.npz, and the lids of its frames where they were seen."""
    from shared.io.arrays import load_arrays, read_json
    from shared.tracking.eyes import lids_in_frames

    poses, tracked = load_arrays(job.input("inverse_render") / "poses.npz"), job.input("track_landmarks")
    record = read_json(tracked / "tracking.json")
    lids = lids_in_frames(load_arrays(tracked / "landmarks.npz"), record, poses["frame_index"])
    return poses if lids is None else poses | {"lids": lids}


def find_actions(job: Job, surface) -> tuple[tuple, dict]:
    """The facial actions as blend shapes of the mesh, and what run.json says of them; nothing when switched off."""
    from shared.actions.facial import facial_actions
    from shared.actions.names import lacking_names
    from shared.geometry.blend_shapes import with_normals
    from shared.tracking.models import load_head_model

    if not job.params.actions:
        return (), {}
    shapes = ()
    if surface.face_segment is not None:
        shapes = facial_actions(load_head_model(), surface.mesh.vertices, surface.mesh.faces)
        shapes = with_normals(shapes, surface.mesh)
    names = [shape.name for shape in shapes]
    note = "" if names else "the mesh is not the head model's: it has no facial actions"
    return shapes, {"names": names, "lacking": lacking_names(tuple(names)), "note": note}


def find_base(job: Job, surface, writer):
    """The head as quads, with maps/displacement.exr; None when switched off, or where the mesh is not the head
    model's."""
    from shared.geometry.mesh import is_subdivision
    from shared.imaging.displacement import displaced_base
    from shared.io.export_maps import DISPLACEMENT
    from shared.io.usd import BaseHead
    from shared.io.usd_material import TextureFile
    from shared.tracking.models import load_head_model

    if not job.params.detail or surface.face_segment is None:
        return None
    model = load_head_model()
    if not is_subdivision(surface.mesh, model.faces, model.face_uvs):
        return None
    displaced = displaced_base(surface.mesh, model.faces, model.face_uvs)
    writer.write_map(job.out / "maps", DISPLACEMENT, displaced.heights)
    return BaseHead(displaced, TextureFile(f"./maps/{writer.file_name(DISPLACEMENT)}"))


def write_images(job: Job, writer, maps: dict, envmap) -> None:
    """maps/ and envmap.exr in the chosen precision and colour space."""
    from shared.io.export_maps import HAIR_MAPS, SOLVED_MAPS, write_png_copies

    writer.write_maps(job.out / "maps", maps)
    writer.write_colour(job.out / "envmap.exr", envmap, "radiance, clip maximum 1", latlong=True)
    if job.params.png_copies != "none":
        solved = {name: maps[name] for name in (*SOLVED_MAPS, *HAIR_MAPS) if name in maps}
        write_png_copies(job.out / "maps" / "png", solved, int(job.params.png_copies))


def write_renders(job: Job, writer, mesh, alpha, poses: dict, frames, solve: dict) -> tuple[dict, list[str]]:
    """renders/, layers/ and patches/ -> {frame: [H, W, 3], a few of the crops with the re-render in the old head's
    place}, and sentences about alpha. mesh: the head's with what stands off it, alpha [S, T] how much of it is there,
    None: all."""
    import numpy as np

    from shared.imaging.image_sampling import SurfaceViewer
    from shared.io.export_maps import paste_crop
    from shared.io.images import read_exr
    from shared.rendering.compositing import LEAST_AGREED, head_layers
    from shared.rendering.render import head_coverage
    from shared.report.content import FRAMES_COMPOSED, chosen_frames

    shown = chosen_frames(solve["render_frames"], solve.get("held_out_frames", ()), FRAMES_COMPOSED)
    viewer, lens = SurfaceViewer.of(mesh), poses.get("intrinsics_crop", frames.intrinsics)
    place = {int(frame): f for f, frame in enumerate(poses["frame_index"])}
    composites, apart = {}, []
    for name in ("renders", "layers", "patches"):
        (job.out / name).mkdir()
    for frame in job.progress(solve["render_frames"], "renders"):
        render = read_exr(job.input("inverse_render") / "renders" / f"{frame:06d}.exr")
        coverage = head_coverage(viewer, alpha, poses["camera_from_head"][place[frame]], lens, frames.size)
        position = frames.position(frame)
        layers = head_layers(frames.read_linear(position), frames.read_mask(position) > 0,
                             np.where((render > 0.0).any(-1), coverage, 0.0))
        apart += [frame] if layers.agreed < LEAST_AGREED else []
        if frame in shown:
            composites[frame] = layers.composite(render)
        pictures = {"renders": render, "layers": layers.premultiplied(render), "patches": layers.patch}
        for name, picture in pictures.items():
            full = paste_crop(picture, frames.crop, frames.source_size)
            writer.write_colour(job.out / name / f"{frame:04d}.exr", full, "radiance, clip maximum 1")
    told = f"person masks miss much of the head in {len(apart)} of {len(solve['render_frames'])} re-rendered frames: "
    return composites, [told + "the alpha of these is the mesh's alone"] if apart else []


def describe_capture(job: Job, poses: dict, frames, actions):
    """Lens, film back and motion of the clip, and of the lids among the facial actions."""
    from shared.geometry.blend_shapes import LidActions
    from shared.geometry.eyeballs import pitch_from_rest
    from shared.io.usd_capture import DEFAULT_FILM_WIDTH_MM, UsdCapture

    width, height = frames.source_size
    weights = {}
    if "lids" in poses and LidActions.of(actions) is not None:
        pitch = pitch_from_rest(poses["gaze"]) if "gaze" in poses else 0.0 * poses["lids"]
        weights = LidActions.weights(poses["lids"], pitch)
    intrinsics, film_width = poses["intrinsics"], job.subject.sensor_width_mm or DEFAULT_FILM_WIDTH_MM
    if job.subject.sensor_width_mm is not None and job.subject.focal_length_mm is not None:
        film_width = job.subject.focal_length_mm * width / float(intrinsics[0, 0])  # right for turned clips too
    return UsdCapture(poses["camera_from_head"], poses["frame_index"], fps=frames.fps, intrinsics=intrinsics,
                      width=width,
                      height=height, moves=frames.moves, film_width_mm=film_width,
                      light_with_camera=light_moves(job, frames.moves) != frames.moves, eye_turn=poses.get("eye_turn"),
                      action_weights=weights)


def near_lamp(solve: dict):
    """The main lamp that solve.json puts near, as a ball; None where it is far."""
    from shared.io.usd_capture import BallLamp

    lamp = solve.get("lamp") or {}
    if "position_mm" not in lamp:
        return None
    return BallLamp(tuple(lamp["position_mm"]), lamp["radius_mm"], tuple(lamp["radiance"]))


def describe_asset(job: Job, mesh, eyes, actions, details, base, hair, capture, frames, writer, lamp):
    """The asset that head.usda holds; writes the plates. actions: its blend shapes; details: {level: the mesh with
    fewer faces}; base: the mesh as displaced quads, or None; hair: what stands off the head, a mesh, or None; lamp:
    what stands near of the light, or None."""
    from shared.io.plates import crop_rectangle, write_plates
    from shared.io.usd import HeadAsset
    from shared.io.usd_capture import Plate
    from shared.io.usd_detail import BASE, FULL
    from shared.io.usd_material import HAIR_INPUTS, SHADER_INPUTS, TextureFile

    plate = None
    if job.params.plates:
        shown = write_plates(job.out / "plates", frames, capture.frame_index, job.progress)
        plate = Plate({frame: f"./plates/{name}" for frame, name in shown.items()}, crop_rectangle(frames))
    spaces = {"diffuse_albedo": writer.colour_space, "hair_albedo": writer.colour_space}
    read = (*SHADER_INPUTS, *(() if hair is None else HAIR_INPUTS))
    maps = {name: TextureFile(f"./maps/{writer.file_name(name)}", spaces.get(name, "data")) for name in read}
    metadata = {
        "clip": {"name": frames.source_name, "width": capture.width, "height": capture.height, "fps": frames.fps},
        "moves": frames.moves,
        "focal_length_known": bool(frames.focal_known),
        "film_width_known": job.subject.sensor_width_mm is not None,
        "brdf": "albedo / pi + specular_intensity * GGX (Smith, Schlick F0 = 0.04, alpha = roughness^2)",
        "confidence_map": f"maps/{writer.file_name('confidence')}",
    }
    light = TextureFile("./envmap.exr" if lamp is None else "./envmap_far.exr", writer.colour_space)
    levels = (FULL, *details, *([BASE] if base else ())) if job.params.detail else (FULL,)
    return HeadAsset(job.subject.name, mesh, maps, light, capture, plate, lamp, eyes, actions, details, base, hair,
                     levels, version=str(STAGE.version), metadata=metadata)


def write_assets(job: Job, asset, eyeballs, poses: dict, maps: dict, envmap) -> None:
    """mesh.obj, hair.obj, poses.npz, head.usda and its layers; when wished, head.usdz and head.glb, with as many faces
    as viewer_detail says. eyeballs: the groups of mesh.obj beside the head's; envmap [H, 2 H, 3]: what the asset's dome
    shows, linear Rec.709."""
    from shared.io.arrays import save_arrays
    from shared.io.gltf import write_glb
    from shared.io.meshes import write_obj
    from shared.io.usd import write_head_usda
    from shared.io.usd_detail import FULL
    from shared.io.usdz import write_head_usdz

    write_obj(job.out / "mesh.obj", asset.mesh, eyeballs)
    if asset.hair is not None:
        write_obj(job.out / "hair.obj", asset.hair)
    kept = ("camera_from_head", "frame_index", "intrinsics", "gaze", "eye_turn", "lids", "gain")
    save_arrays(job.out / "poses.npz", **{name: poses[name] for name in kept if name in poses})
    write_head_usda(job.out, asset)
    finest = job.params.viewer_detail
    if job.params.usdz:
        levels = (FULL, *asset.details)
        coarser = levels[levels.index(finest):] if job.params.detail else (finest,)
        write_head_usdz(job.out / "head.usdz", asset, coarser, maps, envmap)
    if job.params.glb:
        write_glb(job.out / "head.glb", asset.name, asset.parts(finest), maps, asset.capture, asset.actions,
                  asset.hair)


def light_moves(job: Job, moves: str) -> str:
    """What moves against the light: a lamp at the camera goes with it, in whatever capture."""
    return "head" if job.manifest("inverse_render")["parameters"].get("light_model") == "camera" else moves


def render_views(job: Job, writer, mesh, maps: dict, eyes, actions, envmap, poses: dict, frames, solve: dict,
                 head_faces: int | None):
    """Writes views/novel_*.exr, views/relit_*.exr and the lights -> the ViewSet; None when switched off. mesh, maps:
    the head's, joined with those of its hair where that stands off it; eyes, actions: of the head, whose vertices and
    faces come first; head_faces: how many these are then, None: all."""
    from shared.geometry.blend_shapes import LidActions
    from shared.imaging.turning_eyes import TurningEyes
    from shared.rendering.near_lamp import NearLamp
    from shared.rendering.studio_lights import STUDIO_LIGHTS, studio_light
    from shared.rendering.views import held_out_cameras, make_views

    if not job.params.views:
        return None
    cameras, moves = held_out_cameras(poses, frames.intrinsics, frames.size, solve), light_moves(job, frames.moves)
    views = make_views(
        mesh, maps, envmap, camera_from_head=poses["camera_from_head"], moves=moves, pixels=job.params.view_size,
        held_out=cameras, progress=job.progress, lamp=NearLamp.of_record(solve.get("lamp") or {}),
        eyes=TurningEyes(mesh, eyes) if eyes else None, lids=LidActions.of(actions), head_faces=head_faces,
    )
    (job.out / "views").mkdir()
    pictures = {f"novel_{name}": picture for name, picture in views.novel.items()}
    pictures |= {f"relit_{name}": picture for name, picture in views.relit.items()}
    for name, picture in pictures.items():
        writer.write_colour(job.out / "views" / f"{name}.exr", picture, "radiance")
    for name in STUDIO_LIGHTS:
        writer.write_colour(job.out / "views" / f"relit_{name}_light.exr", studio_light(name), "radiance", latlong=True)
    return views


def other_clips(job: Job, solve: dict) -> list:
    """ClipResult of all clips but the first."""
    from shared.io.arrays import load_arrays
    from shared.io.frames import FrameSet
    from shared.io.images import read_exr
    from shared.report.content import ClipResult

    results = []
    for clip in solve.get("clips", ())[1:]:
        name = clip["name"]
        solved = job.input("inverse_render") / "clips" / name
        folders = {stage: job.input(stage, name) for stage in STAGE.joins}
        poses, frames = load_arrays(solved / "poses.npz"), FrameSet.open(folders["sample_frames"])
        results.append(ClipResult(name, folders, solved, frames, poses, read_exr(solved / "envmap.exr"), clip))
    return results


def write_lights(job: Job, writer, envmap, clips: list) -> None:
    """envmaps/: the light of each clip, where there are several."""
    if clips:
        (job.out / "envmaps").mkdir()
        lights = zip(job.clips, [envmap, *(clip.envmap for clip in clips)], strict=True)
        for name, light in lights:
            writer.write_colour(job.out / "envmaps" / f"{name}.exr", light, "radiance, clip maximum 1", latlong=True)


def run_record(job: Job, mesh, actions: dict, solve: dict, own_seconds: float, own_warnings: list[str]) -> dict:
    """The content of run.json: what each stage was told, what it took, what it found. actions: what find_actions says
    of them; own_seconds: what this stage took so far; own_warnings: of it, beside those of the mesh."""
    from shared.geometry.mesh_checks import mesh_warnings
    from shared.report.content import own_record, selection_record, stage_record, warnings_of

    records, warnings = {}, []
    for name in job.input_names:
        clip, _, stage = name.rpartition("/")
        records[name] = stage_record(job.manifest(stage, clip), job.provenance(stage, clip))
        warnings += [(name, text) for _, text in warnings_of(stage, job.input(stage, clip), records[name])]
    own = own_record(STAGE.version, job.params.as_dict(), own_seconds)
    for text in (*mesh_warnings(mesh), *own_warnings):
        job.warn(text)
        own["warnings"].append(text)
        warnings.append((STAGE.name, text))
    records[STAGE.name] = own
    kept = ("model", "residuals", "lamp", "hair", "albedo_scale", "held_out_frames", "clips")
    chosen = {key: solve[key] for key in kept if key in solve}
    chosen |= head_scale_record(job, solve) | ({"actions": actions} if actions else {})
    if selection := selection_record(job.input("inverse_render"), solve):
        chosen["model_selection"] = selection
    return {
        "subject": job.subject.name,
        "stages": records,
        "warnings": [{"stage": stage, "text": text} for stage, text in warnings],
        **chosen,
    }


def head_scale_record(job: Job, solve: dict) -> dict:
    """What tracking said of the head's size, of the clip whose mesh it is; nothing where that had none to say."""
    from shared.io.arrays import read_json

    own = next((clip["name"] for clip in solve.get("clips", ()) if clip["mesh"]), "")
    tracking = read_json(job.input("track_landmarks", own) / "tracking.json")
    return {"head_scale": tracking["scale"]} if "scale" in tracking else {}


def method_records(job: Job, record: dict, solve: dict):
    """RunRecords for the methods text: what each stage left, and the versions of what it loaded."""
    from shared.contract.provenance import environment
    from shared.io.arrays import read_json
    from shared.report.methods import ClipRecords, RunRecords

    packages: dict[str, str] = {}
    for name in job.input_names:
        clip, _, stage = name.rpartition("/")
        packages |= job.provenance(stage, clip).get("packages", {})
    clips = []
    for clip in job.clips or ("",):
        frames = read_json(job.input("sample_frames", clip) / "frames.json")
        tracking = read_json(job.input("track_landmarks", clip) / "tracking.json")
        read = job.manifest("track_landmarks", clip).get("inputs", {})
        clips.append(ClipRecords(clip, frames, tracking, frozenset({"landmarks", "poses"} & read.keys())))
    return RunRecords(record, solve, clips, packages | environment()["packages"])


def run(job: Job) -> None:
    """Writes the result's files, then the report about them."""
    from shared.compute.processor import use_baseline_opencv
    from shared.compute.threads import share_out
    from shared.geometry.eyeballs import eyeballs_of
    from shared.geometry.mesh import shading_normals
    from shared.geometry.reduction import reduced
    from shared.hair.hair_files import read_hair
    from shared.hair.joined import joined_maps, joined_mesh
    from shared.io.arrays import read_json, write_json
    from shared.io.export_maps import HAIR_MAPS, MapWriter
    from shared.io.frames import FrameSet
    from shared.io.images import read_exr
    from shared.io.meshes import load_mesh
    from shared.io.usd_detail import REDUCED_FACES
    from shared.report.content import ReportInputs, result_content
    from shared.report.methods import methods_paragraphs, methods_text
    from shared.report.page import report_html

    use_baseline_opencv()
    start, solved = time.perf_counter(), job.input("inverse_render")
    frames = FrameSet.open(job.input("sample_frames"))
    mesh, poses = load_mesh(solved / "mesh.npz"), read_poses(job)
    solve, maps, envmap = read_json(solved / "solve.json"), read_maps(solved / "maps"), read_exr(solved / "envmap.exr")
    hair = read_hair(solved)
    strands = None if hair is None else hair.mesh
    if hair is not None:
        maps |= dict(zip(HAIR_MAPS, (hair.albedo, hair.alpha), strict=True))
    source = {"stage": STAGE.name, "stage_version": STAGE.version, "source": "inverse_render"}
    params = job.params
    writer = MapWriter(params.map_format == "half", params.acescg, source, params.map_layout, params.udim)
    write_images(job, writer, maps, envmap)
    seen_mesh, seen_maps, head_faces = mesh, maps, None
    if hair is not None:
        seen_mesh, seen_maps, head_faces = joined_mesh(mesh, hair.mesh), joined_maps(maps, hair), len(mesh.faces)
    composites, outline_warnings = write_renders(job, writer, seen_mesh, seen_maps.get("alpha"), poses, frames, solve)
    clips = other_clips(job, solve)
    write_lights(job, writer, envmap, clips)
    lamp, far = near_lamp(solve), envmap
    if lamp is not None:
        far = read_exr(solved / "envmap_far.exr")
        writer.write_colour(job.out / "envmap_far.exr", far, "radiance, clip maximum 1", latlong=True)
    surface = read_surface(job, mesh)
    eyeballs = eyeballs_of(surface) or ()
    eyes = eyeballs if "eye_turn" in poses else ()
    work = (lambda: find_actions(job, surface), lambda: reduced(surface, tuple(REDUCED_FACES.values())),
            lambda: find_base(job, surface, writer))
    (actions, said_of_them), few, base = share_out(len(work), lambda k: work[k]())
    details = dict(zip(REDUCED_FACES, few, strict=True))
    capture = describe_capture(job, poses, frames, actions)
    asset = describe_asset(job, mesh, eyes, actions, details, base, strands, capture, frames, writer, lamp)
    write_assets(job, asset, eyeballs, poses, maps, far)
    views = render_views(job, writer, seen_mesh, seen_maps, eyes, actions, envmap, poses, frames, solve, head_faces)
    record = run_record(job, mesh, said_of_them, solve, time.perf_counter() - start, outline_warnings)
    write_json(job.out / "run.json", record)
    methods = method_records(job, record, solve)
    (job.out / "methods.txt").write_text(methods_text(methods), encoding="utf-8")
    folders = {name: job.input(name) for name in STAGE.inputs}
    files = [(output.path, output.help) for output in STAGE.outputs]
    result = ReportInputs(job.subject.name, folders, frames, details[PAGE_DETAIL].mesh, shading_normals(mesh), poses,
                          maps, envmap, solve, record, files, views, clips, methods_paragraphs(methods), eyes, actions,
                          strands, composites)
    page = report_html(result_content(result, job.params.report_frames))
    (job.out / "report.html").write_text(page, encoding="utf-8")


def check(job: Job) -> None:
    """Reads the files back as a stranger would; LimnError says all that is wrong."""
    from shared.io.export_checks import check_export

    expected = [f"head.{kind}" for kind, wanted in (("usdz", job.params.usdz), ("glb", job.params.glb)) if wanted]
    found = check_export(job.out, expected=expected)
    if errors := [str(fault) for fault in found.faults if fault.fatal]:
        raise LimnError("the result does not pass its checks: " + "; ".join(errors))
    for fault in found.faults:
        job.note(f"{fault}; {fault.hint}")


if __name__ == "__main__":
    raise SystemExit(main(STAGE, run, check))
