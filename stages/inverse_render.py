"""Inverse rendering: light, shape, and the skin's albedo, specular intensity and roughness, from the whole clip.

Reads    sample_frames (frames, masks), track_landmarks (poses, mesh, segments, track points), and of several clips
         init_albedo (mean textures).
Writes   maps/*.exr, envmap.exr, mesh.npz, shape.png, poses.npz, renders/*.exr, solve.json.
Method   What no track reaches (ears, skull, jaw) moves until the mesh's outline meets the border of the person masks.
         In head space a surface point's view of the sphere never changes, so visibility and bounces are traced once
         and reused by all frames. Light by Gauss-Newton with albedo, specular intensity and roughness eliminated,
         stopping on held-out frames; a prior on how skin varies over a face keeps the colours of a room out of the
         albedo. Under that light the mesh is refined from parallax and shading by
         Gauss-Newton, coarse to fine, the light solved anew, and the refined mesh kept if held-out frames fit better.
         On it all frames are tracked again; where that turns the poses by what matters, mesh and light follow from the
         new ones. Light is summed along directions that lie close where a small lamp passes. Where there is one, it
         stands at the distance that held-out frames ask for, far away if they ask for none
         (shared/inverse/lamp_distance.py). Exposure that drifts is a gain of each frame (shared/inverse/exposure.py).
         How many numbers describe the light, and whether there are highlights, is chosen first, on few points
         (shared/selection/candidates.py), and how much of the clip tells that light (shared/selection/samples.py);
         with model=full all of it is solved. The tracked mesh, not one that is given, gets a smooth
         rim at the neck (shared/geometry/rim.py). Then albedo and specular intensity per texel in closed form,
         streaming over the frames; samples where a cast shadow ends, which the mesh tells to millimetres only, count
         less. The solver starts from a uniform light and the priors: of one clip it needs no start from init_albedo,
         which is an input for comparison only.
         Or (solver=reference) as published: shared/published/solver.py.
         Several clips of one head under different lights are solved as one (shared/inverse/joint_clips.py): one mesh
         and one set of maps, a light and poses of each. What lies at the top is the first clip's then, and clips/ holds
         the rest.
         Before the texels, each vertex gets probabilities of what it shows, skin, hair, cloth and others: a mixture
         model of how it looks beside typical skin (shared/appearance/material_mixture.py). What hides the skin, what
         has no highlights, and the hair follow from them.
Fails    poses that match no frame; too little of the face seen; results that are not finite.
"""

from __future__ import annotations

from pathlib import Path

from shared.contract import Job, Output, Parameter, ParameterGroup, Stage, main
from shared.contract.records import MESH, SELECTION_TIMES, SOLVE, SOLVED_POSES, TRIANGLES
from shared.errors import InputError, LimnError

SOLVERS = ("transfer", "reference")
MODELS = ("auto", "full")
SELECTION_SECONDS = "model_selection_seconds.json"
LIGHT_MODELS = ("cubemap", "harmonics_2", "harmonics_4", "sun_sky", "camera")

PUBLISHED = ParameterGroup(
    "published",
    "that count with solver=reference alone, the published solver",
    (
        Parameter("reference_iterations", int, 6000, "Iterations, one frame each.", "", 1, 1_000_000),
        Parameter("reference_pixels", int, 0, "Pixels per iteration, drawn at random; 0: all.", "px", 0, 10**8),
        Parameter("reference_light_samples", int, 256, "Samples of the diffuse integral by the light.", "", 1, 4096),
        Parameter("reference_cosine_samples", int, 256, "Samples of the diffuse integral by the cosine.", "", 1, 4096),
        Parameter("reference_lobe_samples", int, 64, "Samples of the highlights' visibility.", "", 1, 4096),
        Parameter("reference_light_resolution", int, 256, "Edge of the light's cubemap faces; mips go down to 8.",
                  "texels", choices=(8, 16, 32, 64, 128, 256, 512)),
        Parameter("reference_vertices", bool, True, "Let the vertices move."),
        Parameter("reference_vertex_rate", float, 0.1, "Adam's rate for vertices.", "mm", 0.0, 100.0),
        Parameter("reference_light_rate", float, 0.1, "Adam's rate for the light.", "", 0.0, 100.0),
        Parameter("reference_texture_rate", float, 0.001, "Adam's rate for textures.", "", 0.0, 1.0),
        Parameter("reference_smoothing", float, 19.0, "Lambda of the large steps in shape.", "", 0.0, 1e6),
        Parameter("reference_mask", float, 0.1, "Weight of the mask's loss.", "", 0.0, 1e6),
        Parameter("reference_laplacian", float, 10.0, "Weight of the vertices' Laplacian.", "", 0.0, 1e6),
        Parameter("reference_white_light", float, 0.1, "Weight of the light's deviation from grey.", "", 0.0, 1e6),
        Parameter("reference_roughness_variation", float, 0.1, "Weight of the roughness's variation.", "", 0.0, 1e6),
        Parameter("reference_diffuse", float, 0.01, "Weight of the squared diffuse albedo.", "", 0.0, 1e6),
        Parameter("reference_checkpoint_every", int, 100, "Iterations between checkpoints, from which a run that "
                  "was cut off goes on.", "", 1, 1_000_000),
        Parameter("reference_seed", int, 0, "Seed of its random choices.", "", 0, 2**31 - 1, former="seed"),
    ),
)

STAGE = Stage(
    name="inverse_render",
    version=50,
    help="Light, shape, albedo, specular intensity and roughness from the whole clip.",
    inputs=("sample_frames", "track_landmarks", "init_albedo"),
    joins=("sample_frames", "track_landmarks", "init_albedo"),
    outputs=(
        Output("maps/*.exr", "albedo, specular intensity, roughness, normal, confidence, material", space="uv",
               colour_space="in each file"),
        Output("envmap.exr", "incident radiance, lat-long", space="world", colour_space="lin_rec709_scene"),
        Output("envmap_far.exr", "the same without the main lamp, where that stands near", space="world",
               colour_space="lin_rec709_scene", optional=True),
        Output("hair.npz", "hair's surface, where it stands off the head, with UVs of maps/hair_*.exr", unit="mm",
               space="head", fields=TRIANGLES, optional=True),
        Output("mesh.npz", "the refined mesh, with its face segments", unit="mm", space="head", fields=MESH),
        Output("shape.png", "tracked and refined mesh, normals and difference, from three sides", colour_space="srgb"),
        Output("poses.npz", "the head's pose in each frame, and the lens", unit="mm", fields=SOLVED_POSES),
        Output("renders/*.exr", "re-renders of chosen crops, 0 outside the head", space="crop",
               colour_space="lin_rec709_scene"),
        Output("clips/*/envmap.exr", "the light of another clip", space="world", colour_space="lin_rec709_scene",
               optional=True),
        Output("clips/*/poses.npz", "the poses of another clip", unit="mm", optional=True, fields=SOLVED_POSES),
        Output("clips/*/renders/*.exr", "re-renders of another clip", space="crop", colour_space="lin_rec709_scene",
               optional=True),
        Output("solve.json", "model, residuals, steps, scale of the albedo, held-out frames, warnings", fields=SOLVE),
        Output(SELECTION_SECONDS, "what each candidate of solve.json's model selection took (model=auto)", unit="s",
               volatile=True, optional=True, fields=SELECTION_TIMES),
    ),
    parameters=(
        Parameter("map_size", int, 1024, "Edge of the maps, at most; a power of two.", "texels",
                  choices=(64, 128, 256, 512, 1024, 2048, 4096, 8192)),
        Parameter("light_resolution", int, 16, "Edge of the light's cubemap faces.", "texels", choices=(4, 8, 16, 32)),
        Parameter("light_model", str, "cubemap", "What is unknown of the light: every texel of a cubemap, spherical "
                  "harmonics of its logarithm, one sun and a sky, or a lamp at the camera.", choices=LIGHT_MODELS),
        Parameter("model", str, "auto", "Climb towards the model that the other parameters describe only as far as "
                  "held-out frames, and what is known of skin, ask for it, with no more samples than tell its light "
                  "and no finer maps than the pixels fill; or solve all of it. With solver=transfer.", choices=MODELS),
        Parameter("fixed_parts", str, "", "Parts of the model that model=auto leaves as the other parameters say, "
                  "separated by commas: light, specular, samples (light_frames, points, directions, bounce_nodes), "
                  "maps (map_size).", former="forced"),
        Parameter("lamp_distance", str, "auto", "How far the light's main lamp stands from the head: auto, as near as "
                  "the frames ask for, far, or so many mm."),
        Parameter("points", int, 4000, "Surface points that the light is solved from, at most.", "", 200, 40000),
        Parameter("coarse_points", int, 1000, "As many of them on which the light comes to rest, before a last step on "
                  "all; 0: all from the first step on.", "", 0, 40000),
        Parameter("directions", int, 768, "Directions over the sphere, at most.", "", 128, 8192),
        Parameter("bounce_nodes", int, 1000, "Surface nodes that exchange bounced light, at most.", "", 50, 6000),
        Parameter("light_frames", int, 48, "Frames that the light is solved from, at most, spread evenly.", "frames",
                  3, 1000),
        Parameter("light_steps", int, 20, "Largest number of steps per resolution of the light.", "", 1, 100),
        Parameter("hold_out_every", int, 8, "One frame in so many is held out to judge the fit.", "frames", 3, 1000),
        Parameter("visibility", bool, True, "Let parts of the head cover each other; off, nothing bounces either."),
        Parameter("bounce", bool, True, "Count light that bounces between parts of the head."),
        Parameter("specular", bool, True, "Model specular reflection."),
        Parameter("roughness", float, 0.45, "Roughness to start from.", "", 0.1, 0.7),
        Parameter("fit_roughness", bool, True, "Fit the roughness; else it stays at its start."),
        Parameter("local_roughness", bool, True, "Let roughness vary over the skin where held-out frames gain by it."),
        Parameter("specular_prior", float, 0.84, "Expected specular intensity of skin; index of refraction 1.4: 0.7, "
                  "1.45: 0.84, 1.5: 1.", "", 0.01, 2.0),
        Parameter("light_colour_sigma", float, 0.15, "Expected deviation of the light's log colour ratios from grey, "
                  "where `grey` in `subject.yaml` does not tell them.", "", 0.01, 2.0, former="white_light"),
        Parameter("skin_brightness_sigma", float, 0.2, "Expected deviation of the log albedo's brightness at large "
                  "scale over the skin of a face.", "", 0.01, 10.0, former="skin_brightness"),
        Parameter("skin_colour_sigma", float, 0.1, "The same of its colour, per channel about their mean.", "",
                  0.01, 10.0, former="skin_colour"),
        Parameter("light_smoothness", float, 1.0, "Weight of the light's smoothness; the last steps keep a tenth.", "",
                  0.0, 1000.0),
        Parameter("independent_samples", float, 5000.0, "How many independent samples the clip counts as.", "", 10.0,
                  1e7, former="evidence"),
        Parameter("chart", bool, True, "Take the light's scale from the colour chart that sample_frames found."),
        Parameter("shape", bool, True, "Refine the mesh from shading, parallax and tracks."),
        Parameter("silhouette", bool, True, "Move ears, skull and jaw so that the outline meets the person mask's "
                  "border, cheeks, chin and jaw so that it meets the face's edge in the pictures."),
        Parameter("shape_subdivisions", int, 1, "Times that the mesh is subdivided for that.", "", 0, 2),
        Parameter("shape_steps", int, 2, "Most steps of the shape before what it sees is traced again.", "", 1, 20,
                  former="shape_rounds"),
        Parameter("shape_frames", int, 32, "Frames that the shape is solved from, spread evenly.", "frames", 3, 1000),
        Parameter("shape_smoothness", float, 19.0, "Lambda of the large steps: over how many edges, squared, the "
                  "surface moves together.", "", 0.0, 10000.0),
        Parameter("shape_sigma", float, 8.0, "Expected distance of the tracked mesh from the truth where it is wrong "
                  "as a whole.", "mm", 0.01, 100.0, former="shape_spread"),
        Parameter("pose_rounds", int, 3, "Times, at most, that the frames are tracked again on the refined mesh; 0: "
                  "the tracked poses stay.", "", 0, 10),
        Parameter("normal_map", bool, True, "Solve relief finer than the mesh as a normal map; else it is flat."),
        Parameter("eyes", bool, True, "Let the eyeballs turn with the gaze that track_landmarks found, and have a "
                  "material of their own; off, they are parts of the skin that stay where they are."),
        Parameter("render_count", int, 8, "Frames to re-render, spread evenly.", "frames", 1, 2000),
        Parameter("mesh", str, "", "Mesh (.npz or .obj) to use instead of the tracked one; empty: tracked.",
                  file=True),
        Parameter("poses", str, "", "Poses (.npz: camera_from_head, perhaps frame_index) to use; empty: tracked.",
                  file=True),
        Parameter("fit_frames", int, 0, "Fit this many frames only, chosen to cover the face; 0: all but those held "
                  "out.", "frames", 0, 1000),
        Parameter("solver", str, "transfer", "How: precomputed transfer in closed form, or the published stochastic "
                  "descent, a yardstick with parameters of its own; it counts no bounces.", choices=SOLVERS),
    ),
    groups=(PUBLISHED,),
    retired=(("reference_device", "leave it out: the published solver computes on the processor"),),
)

CHECKPOINT = "inverse_render.checkpoint.npz"
LATLONG_HEIGHT = 128
FAR_PX = 1.5
"""Median distance of a clip's skin from where the shared mesh shows it, from which on the clips do not go together."""
FLAT_NORMALS = "flat: fine normals were not solved"


def write_maps(job: Job, result) -> None:
    """maps/*.exr."""
    from shared.io.images import write_exr

    (job.out / "maps").mkdir()
    for name, image in result.texels.maps.items():
        colour_space = "lin_rec709_scene" if name == "diffuse_albedo" else "data"
        attributes = {"content": FLAT_NORMALS} if name == "normal" and not result.record.get("relief") else {}
        write_exr(job.out / "maps" / f"{name}.exr", image, colour_space=colour_space, attributes=attributes)


def write_material_map(job: Job, result) -> None:
    """maps/material.exr."""
    from shared.inverse.material_map import material_image
    from shared.io.material_maps import write_material

    solved = result.texels
    probabilities = material_image(solved.mesh, solved.materials, len(solved.maps["confidence"]))
    write_material(job.out / "maps" / "material.exr", probabilities, half=True, attributes={"content": "material"})


def write_light(folder: Path, light, result) -> None:
    """envmap.exr of a light [6 n^2, 3], as the head's mean place sees it; where a lamp stands near, envmap_far.exr is
    the same without it."""
    from shared.geometry.transforms import places_in_world
    from shared.io.images import write_exr
    from shared.rendering.envmap import latlong_from_cube
    from shared.rendering.near_lamp import latlong_at, without_lamp

    lamp = result.solution.lamp
    if lamp is None:
        images = {"envmap": latlong_from_cube(light, LATLONG_HEIGHT)}
    else:
        place = places_in_world(result.views.camera_from_head, result.views.moves).mean(0)
        images = {"envmap": latlong_at(light, lamp, place, LATLONG_HEIGHT),
                  "envmap_far": latlong_from_cube(without_lamp(light, lamp), LATLONG_HEIGHT)}
    for name, image in images.items():
        write_exr(folder / f"{name}.exr", image, colour_space="lin_rec709_scene", latlong=True)


def write_clip(job: Job, folder: Path, clip, first: int, result, light) -> dict:
    """envmap.exr, poses.npz and renders/%06d.exr of a clip -> which frames of its source were re-rendered, which held
    out.

    clip: its ClipInputs; first: of its frames, among all that were solved; light [6 n^2, 3].
    """
    import numpy as np

    from shared.hair.joined import joined_maps
    from shared.inverse.frame_choice import shown_frames
    from shared.io.arrays import save_arrays
    from shared.io.images import write_exr
    from shared.rendering.render import LookingEyes, SurfaceMaps, render_frame

    (folder / "renders").mkdir(parents=True)
    write_light(folder, light, result)
    frames, index = clip.frames, clip.frame_index
    poses = result.views.camera_from_head[first : first + len(index)]
    covariance = {} if result.covariance is None else {"covariance": result.covariance}
    texels = result.texels
    turning = texels.eyes is not None
    turn = result.views.gaze[first : first + len(index)] if turning else None
    gaze = np.full_like(turn, np.nan) if turning and clip.gaze is None else clip.gaze
    gain = None if result.views.gain is None else result.views.gain[first : first + len(index)]
    save_arrays(
        folder / "poses.npz",
        camera_from_head=poses,
        **covariance,
        frame_index=index,
        intrinsics=frames.intrinsics_source,
        intrinsics_crop=frames.intrinsics,
        **({"gaze": gaze, "eye_turn": turn} if turning else {}),
        **({} if gain is None else {"gain": gain}),
    )
    seen = texels.maps if texels.hair is None else joined_maps(texels.maps, texels.hair)
    maps = SurfaceMaps(seen["diffuse_albedo"], seen["specular_intensity"], seen.get("alpha"))
    chosen = shown_frames(len(index), job.params.render_count, clip.gaze)
    for f in job.progress(chosen, "re-rendering"):
        eyes = LookingEyes(texels.eyes, turn[f]) if turning else None
        image, _ = render_frame(texels.viewer, texels.shading, maps, first + f, poses[f], clip.lens, clip.views.size,
                                eyes=eyes)
        image = image if gain is None else image * gain[f]
        write_exr(folder / "renders" / f"{index[f]:06d}.exr", image, colour_space="lin_rec709_scene")
    held_out = index[~result.views.fitted[first : first + len(index)]]
    return {"render_frames": index[chosen].tolist(), "held_out_frames": held_out.tolist()}


def read_clips(job: Job) -> tuple:
    """The clip's inputs, or those of all clips."""
    from dataclasses import replace

    from shared.inverse.clip_inputs import read_inputs

    params = job.params
    given = {"mesh": bool(params.mesh), "poses": bool(params.poses), "fit_frames": params.fit_frames > 0,
             "solver": params.solver == "reference", "lamp_distance": params.lamp_distance not in ("auto", "far")}
    for name in (name for name, is_given in given.items() if is_given and job.clips):
        raise InputError("works on one clip only", where=f"--set inverse_render.{name}", got=f"{len(job.clips)} clips",
                         hint="leave it out, or make a subject of one clip")
    folders = [(job.input("sample_frames", clip), job.input("track_landmarks", clip)) for clip in job.clips or ("",)]
    clips = tuple(read_inputs(*pair, params.mesh, params.poses) for pair in folders)
    return clips if params.eyes else tuple(replace(clip, views=replace(clip.views, gaze=None)) for clip in clips)


def write_shape(job: Job, tracked, mesh) -> None:
    """mesh.npz with its face segments, and shape.png; tracked: the Surface before."""
    from shared.inverse.problem import FACE_SKIN
    from shared.io.images import write_png
    from shared.io.meshes import save_mesh
    from shared.report.shape_pictures import shape_sheet
    from shared.shape.refine import subdivided_to

    solved = tracked.with_mesh(mesh)
    segment = solved.face_segment
    save_mesh(job.out / "mesh.npz", mesh, **({} if segment is None else {"face_segment": segment}))
    face = None if segment is None else solved.faces_of(FACE_SKIN)
    write_png(job.out / "shape.png", shape_sheet(subdivided_to(tracked.mesh, mesh), mesh, face))


def run(job: Job) -> None:
    """Solve the light, then the texels; write and re-render."""
    import numpy as np

    from shared.compute.processor import use_baseline_opencv
    from shared.compute.run_context import RunContext
    from shared.hair.hair_files import write_hair
    from shared.inverse.clip_inputs import read_mean_texture
    from shared.inverse.joint_clips import join_clips
    from shared.inverse.parameters import read_settings
    from shared.inverse.solve import in_words, solve_clip, summarise
    from shared.io.arrays import write_json

    use_baseline_opencv()
    clips = read_clips(job)
    inputs, placed = clips[0], []
    if job.clips:
        textures = [read_mean_texture(job.input("init_albedo", name), clip.surface.mesh)
                    for name, clip in zip(job.clips, clips, strict=True)]
        inputs = join_clips(clips, textures)
        placed = [{"name": name, **facts} for name, facts in zip(job.clips, inputs.describe(), strict=True)]
        job.note(f"clips in one head space: {placed}")
    observations = inputs.chart_observations() if job.params.chart else ()
    settings = read_settings(job.params, job.out.parent / CHECKPOINT, inputs.light_tints())
    views, surface = inputs.views, inputs.surface
    tracked = None if job.clips else inputs.tracked
    result = solve_clip(views, surface, settings, RunContext(job.progress, job.note), observations, tracked)
    record = summarise(result, views.moves)
    record["warnings"] += [f"clip {clip['name']} lies {clip['match_px']:.1f} px beside the shared mesh: other lens, "
                           "another expression?" for clip in placed if clip.get("match_px", 0.0) > FAR_PX]
    job.note(f"solved: {in_words(record)}")
    for text in record["warnings"]:
        job.warn(text)
    write_maps(job, result)
    write_material_map(job, result)
    write_shape(job, surface, result.texels.mesh)
    if result.texels.hair is not None:
        write_hair(job.out, result.texels.hair)
    lights, own = np.split(result.solution.state.light, len(clips)), []
    for k, (clip, rows) in enumerate(zip(clips, views.frames_of_lights, strict=True)):
        folder = job.out / "clips" / job.clips[k] if k else job.out
        own.append(write_clip(job, folder, clip, rows[0], result, lights[k]))
    record |= own[0]
    if job.clips:
        record["clips"] = [clip | frames for clip, frames in zip(placed, own, strict=True)]
    if candidates := record.get("model_selection"):
        write_json(job.out / SELECTION_SECONDS, [candidate.pop("seconds") for candidate in candidates])
    write_json(job.out / "solve.json", record)


def check(job: Job) -> None:
    """Maps in range, light positive, part of the map determined, re-renders that are not black."""
    from shared.appearance.projection import SPECULAR_RANGE
    from shared.inverse.solve import LEAST_SEEN_SHARE
    from shared.io.arrays import read_json
    from shared.io.export_maps import SOLVED_MAPS, read_map
    from shared.io.images import read_exr

    for name in (*SOLVED_MAPS, "material"):
        image = read_map(job.out / "maps" / f"{name}.exr", name)
        highest = SPECULAR_RANGE[1] if name == "specular_intensity" else 1.0
        if not (image.min() >= 0.0 and image.max() <= highest):
            raise LimnError(f"{name} leaves [0, {highest:g}]: {image.min():.3f} .. {image.max():.3f}")
    record = read_json(job.out / "solve.json")
    if not record["seen_share_of_texels"] > LEAST_SEEN_SHARE:
        raise InputError("the clip shows less than a hundredth of the map", where=str(job.subject.folder),
                         hint="film with more light, sharper, with a wider turn, or with exposure and lamps that stay: "
                              "frames that contradict each other show little")
    others = {job.out / "clips" / clip["name"]: clip for clip in record.get("clips", ())[1:]}
    for folder, clip in ({job.out: record} | others).items():
        light = read_exr(folder / "envmap.exr")
        if light.min() < 0.0 or light.max() <= 0.0:
            raise LimnError("the light is not positive")
        for frame in clip["render_frames"]:
            if read_exr(folder / "renders" / f"{frame:06d}.exr").max() <= 0.0:
                raise LimnError(f"the re-render of frame {frame} is black")


if __name__ == "__main__":
    raise SystemExit(main(STAGE, run, check))
