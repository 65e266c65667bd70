"""What stands in every JSON and NPZ file that the stages write; stages declare their outputs with these.

docs/files.md is written from here (`python -m tools.documents.readme`), and tests compare a run's files with it.
"""

from __future__ import annotations

from dataclasses import replace

from shared.contract.declare import Field

FRAME_INDEX = Field("frame_index", "The frames, counted from 0 in the source.", "int64", "F")
POSES = Field("camera_from_head", "The head's pose in each frame: a rigid motion.", "float64", "F, 4, 4", "mm")
GAZE = Field("gaze", "Where the right and the left eye look: yaw to +x, pitch to +y in head space, 0 straight ahead; "
             "NaN while an eye is shut. Absent where the gaze was not solved.", "float64", "F, 2, 2", "rad",
             optional=True)
EYE_TURN = Field("eye_turn", "The same with which the mesh's eyeballs, turned about their own centres, show the irises "
                 "where the clip does: a fitted head's are some millimetres off.", "float64", "F, 2, 2", "rad",
                 optional=True)
LIDS = Field("lids", "How far the right and the left eye are shut: 0 as the mesh has them, 1 shut; weights of "
             "`eyeBlinkRight` and `eyeBlinkLeft`. Absent where the lids were not seen.", "float64", "F, 2",
             optional=True)
GAIN = Field("gain", "By how much the frame's red, green and blue are brighter than the still light makes them: "
             "exposure and white balance. Absent where they stay.", "float64", "F, 3", optional=True)
SOURCE_LENS = Field("intrinsics", "The camera matrix of the full source frame.", "float64", "3, 3", "px")
CROP_LENS = Field("intrinsics_crop", "The camera matrix of the crop.", "float64", "3, 3", "px")

FRAMES = (
    Field("source", "The clip.", ""),
    Field("source.name", "Its file, or the pattern of numbered images.", "text"),
    Field("source.width", "Of the picture as it is shown.", "int", unit="px"),
    Field("source.height", "The same.", "int", unit="px"),
    Field("source.fps", "Frames per second, as the file states them."),
    Field("source.frame_count", "Frames in the clip.", "int"),
    Field("source.codec", "How the clip is coded.", "text"),
    Field("source.rotation_deg", "By how much the file says it is to be turned; the frames are turned.", "int",
          unit="deg"),
    Field("transfer", "The transfer function of the frames' code values.", "text"),
    Field("moves", "What moved: `head` or `camera`.", "text"),
    Field("crop", "The crop: u_crop = (u_source - x0) scale, pixel centres at integer + 0.5.", ""),
    Field("crop.x0", "Its left edge in the source.", "int", unit="px"),
    Field("crop.y0", "Its upper edge in the source.", "int", unit="px"),
    Field("crop.width", "Its width in the source.", "int", unit="px"),
    Field("crop.height", "Its height in the source.", "int", unit="px"),
    Field("crop.scale", "Crop pixels per source pixel, at most 1."),
    Field("size", "Width and height of the crop as it is stored.", "int", "2", "px"),
    Field("intrinsics", "The camera matrix of the crop.", shape="3, 3", unit="px"),
    Field("intrinsics_source", "The camera matrix of the full source frame.", shape="3, 3", unit="px"),
    Field("focal_known", "Whether `subject.yaml` gives the focal length; otherwise it is a guess.", "bool"),
    Field("frames", "One entry for each frame that was kept, in order.", ""),
    Field("frames[].frame_index", "Its number in the source, from 0.", "int"),
    Field("frames[].time_s", "Time since the first frame, as the file states it.", unit="s"),
    Field("frames[].file", "The crop, relative to this folder.", "text"),
    Field("frames[].mask", "Its mask, relative to this folder.", "text"),
    Field("frames[].sharpness", "Fine detail compared with the neighbouring frames; 1: the same."),
    Field("frames[].face_box", "Left, upper, right and lower edge of the landmarks in the crop.", shape="4", unit="px"),
    Field("dropped", "One entry for each frame that was looked at and not kept for a fault.", ""),
    Field("dropped[].frame_index", "Its number in the source, from 0.", "int"),
    Field("dropped[].reason", "Why it was dropped.", "text"),
    Field("chart", "One entry for each frame in which a colour chart can be used.", ""),
    Field("chart[].frame_index", "Its number in the source, from 0.", "int"),
    Field("chart[].corners", "Corners of the grid of patches in the source, beginning beside dark skin, then bluish "
          "green, black, white.", shape="4, 2", unit="px"),
    Field("chart[].pitch_px", "Distance between neighbouring patches.", unit="px"),
    Field("chart[].patches", "Linear value of each patch.", shape="24, 3"),
    Field("chart[].clipped", "1 where the value is only a lower bound, since the picture is clipped there; else 0.",
          "int", "24, 3"),
    Field("chart[].white", "Irradiance over pi on the chart.", shape="3"),
    Field("chart[].log_sigma", "Standard deviation of its logarithm.", shape="3"),
    Field("chart[].glare", "Linear value that a reflection adds to every patch.", shape="3"),
    Field("chart[].weight", "Weight of each patch, 0 to 1.", shape="24"),
    Field("chart[].relative_error", "Relative error of the grey patches and of the coloured ones.", shape="2"),
    Field("grey", "What the place shows that `subject.yaml` names as grey; absent where none is named, or it is "
          "not used.", "", optional=True),
    Field("grey.place", "The place in the source.", shape="2", unit="px"),
    Field("grey.colour", "Its linear colour: the median over the frames.", shape="3"),
    Field("grey.log_sigma", "Standard deviation over the frames of log red/green and log blue/green, by the median "
          "absolute deviation.", shape="2"),
    Field("grey.frames", "The frames that count: neither overexposed nor too dark there, and of one colour.", "int",
          "F"),
    Field("warnings", "What is wrong with the clip, one sentence each.", "text", "N"),
)

COVARIANCE = Field("covariance", "Covariance of each pose: rotation (radians), then translation (mm).", "float64",
                   "F, 6, 6")
TRACKED_POSES = (
    POSES,
    COVARIANCE,
    FRAME_INDEX,
    SOURCE_LENS,
    CROP_LENS,
    GAZE,
    Field("gaze_sigma", "Its standard deviation.", "float64", "F, 2, 2", "rad", optional=True),
)
TRIANGLES = (
    Field("vertices", "Positions in head space.", "float64", "V, 3", "mm"),
    Field("faces", "Triangles, as rows of `vertices`.", "int32", "faces, 3"),
    Field("uvs", "Texture coordinates, v up.", "float64", "T, 2"),
    Field("face_uvs", "Triangles, as rows of `uvs`.", "int32", "faces, 3"),
)
MESH = (
    *TRIANGLES,
    Field("face_segment", "Segment of each triangle: a position in `segments` of tracking.json. Absent where a mesh "
          "without segments was given.", "uint8", "faces", optional=True),
)
LANDMARKS = (
    Field("landmarks_px", "Landmarks in the crop, in the order of MediaPipe's face mesh.", "float64", "F, 468, 2",
          "px"),
    Field("presence", "The network's confidence that a face is there, 0 to 1.", "float64", "F"),
    FRAME_INDEX,
    Field("iris_px", "Irises of the right and the left eye in the crop: centre, then the rim towards the inner corner, "
          "above, towards the outer corner and below; NaN where not seen. Absent with `eyes=false`.", "float64",
          "F, 2, 5, 2", "px", optional=True),
    Field("lids_px", "Margins of their lids: 0 to 8 the lower one from the outer to the inner corner, 9 to 15 the "
          "upper one between them.", "float64", "F, 2, 16, 2", "px", optional=True),
    Field("eye_openness", "Distance between the lids over that of the clip's open eyes.", "float64", "F, 2",
          optional=True),
)
TRACKS = (
    Field("points_head", "Tracked points of the skin in head space.", "float64", "N, 3", "mm"),
    Field("residual_px", "Median distance over the frames between a point as tracked and as the poses show it.",
          "float64", "N", "px"),
    Field("sigma_mm", "Standard deviation of each point in depth. Errors that neighbours share are included, so the "
          "points count as independent.", "float64", "N", "mm"),
)
_HEAD_SCALE = (
    Field("scale", "The overall size, and what fixes it.", ""),
    Field("scale.method", "In words.", "text"),
    Field("scale.factor", "By how much the head is larger than the head model alone would have it."),
    Field("scale.log_deviation", "Standard deviation of the logarithm of the size."),
)
TRACKING = (
    Field("segments", "Names of the face segments.", "text", "S"),
    Field("frames", "Frames with a pose.", "int"),
    Field("tracks", "Tracked points.", "int"),
    Field("reprojection_px", "Distances between points as tracked and as the poses show them.", ""),
    Field("reprojection_px.median", "Their median.", unit="px"),
    Field("reprojection_px.p95", "What 95 % of them stay below.", unit="px"),
    Field("held_out_px", "Median distance of tracks that were kept aside, under the poses before and after the "
          "last fine pass.", ""),
    Field("held_out_px.before", "Before.", unit="px"),
    Field("held_out_px.after", "After.", unit="px"),
    Field("rotation_range_deg", "Largest angle between two views of the head.", unit="deg"),
    Field("rotation_deviation_deg", "Standard deviation of the rotations.", ""),
    Field("rotation_deviation_deg.median", "Median over the frames.", unit="deg"),
    Field("rotation_deviation_deg.max", "In the worst frame.", unit="deg"),
    Field("noise_factor", "By which factor the variance of the poses exceeds what independent tracks would give; at "
          "least 1."),
    Field("focal", "What the tracks say about the focal length.", ""),
    Field("focal.solved", "Whether the result uses the tracks' focal length (it was not given).", "bool"),
    Field("focal.gain", "The focal length that the tracks ask for, relative to the one of `frames.json`."),
    Field("focal.log_deviation", "Standard deviation of the logarithm of that."),
    Field("held", "Whether the poses were given and stay as they are.", "bool"),
    *_HEAD_SCALE,
    Field("identity", "The head model's identity coefficients.", shape="N"),
    Field("expression", "Its expression coefficients.", shape="M"),
    Field("eyes", "What the frames show of the eyes, the right one first; absent with `eyes=false`.", "",
          optional=True),
    Field("eyes.blinks", "Frames in which the lids of both eyes are more than half closed.", "int", "B"),
    Field("eyes.shut_right", "The same of the right eye.", "int", "R"),
    Field("eyes.shut_left", "The same of the left eye.", "int", "L"),
    Field("eyes.open_mm", "Distance between the lids of open eyes; null where an eye is not seen.", "number or null",
          "2", "mm"),
    Field("eyes.gaze", "What the gaze rests on: `camera`, `place` (one beside the camera), `head` (one that turns with "
          "it) or `wandering`. This and all that follows are absent where too few frames show open eyes.", "text",
          optional=True),
    Field("eyes.gaze_deviation_deg", "Median standard deviation of the gaze.", unit="deg", optional=True),
    Field("eyes.gaze_deviation_of_frame_deg", "What of it is each frame's own; the rest all frames share.", unit="deg",
          optional=True),
    Field("eyes.centres_mm", "Centres about which the eyes turn, in head space: those of the mesh's eyeballs, "
          "corrected by the clip.", shape="2, 3", unit="mm",
          optional=True),
    Field("eyes.centres_deviation_mm", "Their standard deviations.", shape="2, 3", unit="mm", optional=True),
    Field("eyes.iris_distance_mm", "From there to the iris' plane.", unit="mm", optional=True),
    Field("eyes.iris_radius_mm", "Radius of the irises under the head's scale.", unit="mm", optional=True),
    Field("eyes.iris_radius_deviation_mm", "Its standard deviation.", unit="mm", optional=True),
    Field("eyes.iris_error_px", "Distances between an iris' centre as seen and as gaze and pose show it.", "",
          optional=True),
    Field("eyes.iris_error_px.median", "Their median.", unit="px", optional=True),
    Field("eyes.iris_error_px.p95", "What 95 % of them stay below.", unit="px", optional=True),
    Field("excluded", "One entry for each frame without a pose.", ""),
    Field("excluded[].frame_index", "Its number in the source, from 0.", "int"),
    Field("excluded[].reason", "Why it was left out.", "text"),
    Field("warnings", "What is wrong with the clip, one sentence each.", "text", "W"),
)

INIT = (
    Field("segments", "One entry for each face segment.", ""),
    Field("segments.<segment>.albedo", "Its colour, linear Rec.709.", shape="3"),
    Field("segments.<segment>.texels_seen", "Texels that the colour comes from; 0: it is that of all skin.", "int"),
    Field("frames", "Frames that were averaged.", "int"),
    Field("seen_share", "Share of the head's texels that the frames show."),
)

SOLVED_POSES = (POSES, replace(COVARIANCE, optional=True), FRAME_INDEX, SOURCE_LENS, CROP_LENS, GAZE, EYE_TURN,
                GAIN)
_REFERENCE = "solver=reference only:"
_CANDIDATES = (
    Field("part", "Part of the model: `light` or `specular`; `start` for the simplest model.", "text"),
    Field("candidate", "The choice that was tried for it.", "text"),
    Field("held_out", "Error on the held-out frames, raised by what the prior on skin says against the albedo."),
    Field("fall", "By how much that is less than before.", "number or null"),
    Field("standard_error", "Standard error of the fall.", "number or null"),
    Field("accepted", "Whether the choice was kept.", "bool"),
    Field("open", "Whether the held-out frames left it open: then the fuller choice is kept.", "bool"),
)


def _under(path: str, fields: tuple[Field, ...]) -> tuple[Field, ...]:
    return tuple(replace(field, path=f"{path}.{field.path}") for field in fields)


_MODEL = (
    Field("model", "The model that was solved.", ""),
    Field("model.light", "The light's model in words.", "text"),
    Field("model.moves", "What moved against the light: `head` or `camera`.", "text"),
    Field("model.specular_intensity", "The typical specular intensity."),
    Field("model.specular_variation", "How far texels share one specular intensity.", "text"),
    Field("model.contradicted_texels", "What skin that frames contradict each other about, or that shows little but "
          "highlights, looks like: `as the skin around`, or `as their mean` where held-out frames ask for it; empty "
          "with solver=reference.", "text"),
    Field("model.roughness", "The typical roughness."),
    Field("model.roughness_variation", "Whether the roughness varies over the skin, and why; empty where it was not "
          "tried.", ""),
    Field("model.roughness_variation.chosen", "`one` value or `local`.", "text", optional=True),
    Field("model.roughness_variation.found_range", "5th and 95th percentile of the local roughness.", shape="2",
          optional=True),
    Field("model.roughness_variation.held_out", "Error on the held-out frames.", "", optional=True),
    Field("model.roughness_variation.held_out.one", "With one value."),
    Field("model.roughness_variation.held_out.local", "With local roughness."),
    Field("model.solved_from", "What the light was solved from; absent with solver=reference.", "", optional=True),
    Field("model.solved_from.frames", "Frames, those held out among them.", "int"),
    Field("model.solved_from.points", "Surface points.", "int"),
    Field("model.solved_from.directions", "Directions that light was summed along.", "int"),
    Field("model.solved_from.bounce_nodes", "Surface nodes that exchanged bounced light.", "int"),
    Field("model.map_size", "Edge of the maps.", "int", unit="texels"),
)
_HAIR = (
    Field("hair", "Hair that stands off the head and has a surface of its own; absent where the head's own surface "
          "meets the outline.", "", optional=True),
    Field("hair.thickness_mm", "Median distance from the head, where outlines tell it.", unit="mm"),
    Field("hair.skull_covered", "Share of the skull that it covers."),
    Field("hair.seen_share", "Share of its map that some frame looks at."),
    Field("hair.lowest_mm", "Its lower end over the chin; negative below it.", unit="mm"),
)
_LAMP = (
    Field("lamp", "How far the light's main lamp stands; absent where no lamp is in the light, it was said to be "
          "far, or there are several clips.", "", optional=True),
    Field("lamp.near", "Whether it stands near; absent where its distance was given.", "bool", optional=True),
    Field("lamp.distance_mm", "Its distance from the mean place of the head's origin; absent where it is far.",
          unit="mm", optional=True),
    Field("lamp.position_mm", "Where it stands in world space, whose origin is the camera, or the head where the "
          "camera moves; absent where it is far.", shape="3", unit="mm", optional=True),
    Field("lamp.centre_mm", "The place in world space from which the light, its lamp included, is seen as envmap.exr "
          "has it; absent where it is far.", shape="3", unit="mm", optional=True),
    Field("lamp.reach", "So far around its middle, seen from there, the light belongs to the lamp; absent where it is "
          "far.", unit="radians", optional=True),
    Field("lamp.radius_mm", "Of a ball that is about as large as the lamp is seen; absent where it is far.", unit="mm",
          optional=True),
    Field("lamp.radiance", "Of that ball, so that as much light arrives; absent where it is far.", shape="3",
          optional=True),
    Field("lamp.tried", "The distances that were tried; absent where it was given.", "", optional=True),
    Field("lamp.tried[].distance_mm", "The distance from the face's mean place; null: far away.", "number or null",
          unit="mm"),
    Field("lamp.tried[].held_out", "Error on the held-out frames."),
    Field("lamp.fall", "By how much the mean absolute error of the frames fell from far away to the best distance.",
          optional=True),
    Field("lamp.standard_error", "The standard error of that over the frames.", optional=True),
)
_SCALE = (
    Field("albedo_scale", "What fixed the scale between light and albedo.", ""),
    Field("albedo_scale.method", "In words.", "text"),
    Field("albedo_scale.skin_albedo", "The skin's median albedo under it.", shape="3"),
    Field("albedo_scale.skin_luminance", "Its luminance."),
    Field("albedo_scale.log_sigma", "Standard deviations of logarithms, by all statements about the scale together. "
          "Absent where the scale did not come to rest, and with solver=reference.", "", optional=True),
    Field("albedo_scale.log_sigma.luminance", "Of the skin's luminance."),
    Field("albedo_scale.log_sigma.red_over_green", "Of its tint."),
    Field("albedo_scale.log_sigma.blue_over_green", "The same."),
    Field("albedo_scale.skin_albedo_90", "The interval that holds the skin's albedo nine times of ten: lower and upper "
          "end of each channel.", shape="2, 3", optional=True),
    Field("albedo_scale.prior_share", "How much of what is known of the luminance is known without the clip: precision "
          "of the priors on skin and light over that of everything.", optional=True),
    Field("albedo_scale.whites", "What the whites of the eyes said; absent where the clip hardly shows them.", "",
          optional=True),
    Field("albedo_scale.whites.places", "The places on them that are seen often enough.", "int"),
    Field("albedo_scale.whites.albedo", "Their albedo.", shape="3"),
    Field("albedo_scale.whites.usual", "What it is in people, as it is measured here."),
    Field("albedo_scale.whites.log_sigma", "Standard deviation of its logarithm, as it was counted."),
    Field("albedo_scale.grey", "What a grey place said of its light's tint, one entry for each light in which one is "
          "named; absent without any.", "", optional=True),
    Field("albedo_scale.grey[].light", "Which of several lights, from 0: the clips in their order.", "int"),
    Field("albedo_scale.grey[].log_ratios", "Log red/green and log blue/green of the light.", shape="2"),
    Field("albedo_scale.grey[].log_sigma", "Their standard deviations, as they were counted.", shape="2"),
    Field("albedo_scale.chart", "What a colour chart said; absent without one.", "", optional=True),
    Field("albedo_scale.chart.frames", "The frames in which it was read.", "int", "N"),
    Field("albedo_scale.chart.irradiance_over_pi", "Light on the chart.", shape="3"),
    Field("albedo_scale.chart.log_sigma", "Standard deviation of its logarithm.", shape="3"),
    Field("albedo_scale.chart.priors_alone_factor", "By which factor the albedo would differ without the chart.",
          shape="3"),
)
_CLIPS = (
    Field("clips", "Of several clips, one entry each; absent for a single clip.", "", optional=True),
    Field("clips[].name", "Its name in `subject.yaml`.", "text"),
    Field("clips[].mesh", "Whether the mesh comes from this clip.", "bool"),
    Field("clips[].matched_texels", "Texels by which the clip was placed on the mesh; absent where the mesh is its "
          "own.", "int", optional=True),
    Field("clips[].match_px", "Median distance between the clip's skin and the mesh, as its camera sees them; absent "
          "where the mesh is its own.", unit="px", optional=True),
    Field("clips[].render_frames", "Its frames that were re-rendered.", "int", "R"),
    Field("clips[].held_out_frames", "Its frames that were not fitted.", "int", "H"),
)
SOLVE = (
    *_MODEL,
    Field("residuals", "Root mean square error of the re-rendered samples; 1 is the clip's white.", ""),
    Field("residuals.fitted", "On the frames that were fitted."),
    Field("residuals.held_out", "On the frames that were not."),
    Field("residuals.texture_held_out", "On the latter after the texture pass, by how far texels share one specular "
          "intensity.", ""),
    Field("residuals.texture_held_out.<width>", "The error."),
    Field("residuals.contradicted_held_out", "The same by what such skin looks like (model.contradicted_texels); "
          "empty with solver=reference.", ""),
    Field("residuals.contradicted_held_out.<way>", "The error.", optional=True),
    Field("shape", "What the refinement of the mesh did; absent with solver=reference.", "", optional=True),
    Field("shape.refined", "Whether the refined mesh was kept.", "bool"),
    Field("shape.held_out", "Error on the held-out frames; absent where nothing was refined.", "", optional=True),
    Field("shape.held_out.before", "With the tracked mesh."),
    Field("shape.held_out.after", "With the refined mesh."),
    Field("shape.fitted", "The same on fitted frames, where no frame could be held out.", "", optional=True),
    Field("shape.fitted.before", "With the tracked mesh."),
    Field("shape.fitted.after", "With the refined mesh."),
    Field("shape.stopped_vertices", "Vertices that moved less than wanted, since the surface would have cut itself.",
          "int", optional=True),
    Field("shape.outline", "How the outline met the person masks; empty where it was not tried.", ""),
    Field("shape.outline.met", "Share of the outline near a mask's border.", optional=True),
    Field("shape.outline.fitted_px", "Mean distance in fitted frames.", "", optional=True),
    Field("shape.outline.fitted_px.before", "Before.", unit="px"),
    Field("shape.outline.fitted_px.after", "After.", unit="px"),
    Field("shape.outline.held_out_px", "Mean distance in held-out frames.", "", optional=True),
    Field("shape.outline.held_out_px.before", "Before.", unit="px"),
    Field("shape.outline.held_out_px.after", "After.", unit="px"),
    Field("poses", "The poses tracked again on the refined mesh; empty where that was not tried, absent with "
          "solver=reference.", "", optional=True),
    Field("poses.kept", "Whether the new poses were kept: they differ by what matters, and tracks kept aside fit them "
          "better.", "bool", optional=True),
    Field("poses.held_out_px", "Median distance of tracks that were kept aside.", "", optional=True),
    Field("poses.held_out_px.before", "Before.", unit="px"),
    Field("poses.held_out_px.after", "After.", unit="px"),
    Field("poses.rounds_deg", "How far the poses turned each time that the frames were tracked, rms.", shape="N",
          unit="deg", optional=True),
    Field("poses.turned_deg", "How far they turned in all, rms.", unit="deg", optional=True),
    *_LAMP,
    *_HAIR,
    Field("catchlights", "The brightest spots on the irises beside those of the solved light; absent where no open eye "
          "is seen.", "", optional=True),
    Field("catchlights.irises", "Irises that were looked at: of both eyes, in so many frames.", "int"),
    Field("catchlights.with_catchlight", "Of these, how many show one.", "int"),
    Field("catchlights.compared", "Of these, how many show one under the solved light, too.", "int"),
    Field("catchlights.apart_deg", "Between the directions that the light comes from in the clip and by the solved "
          "light; absent where none was compared.", "", optional=True),
    Field("catchlights.apart_deg.median", "The median.", unit="deg"),
    Field("catchlights.apart_deg.p95", "The 95th percentile.", unit="deg"),
    Field("catchlights.light_over_solved", "Median ratio of their light; the clip's is too small where it burns out. "
          "Absent where none was compared.", optional=True),
    Field("exposure", "Gains of the frames; absent where exposure and white balance stay.", "", optional=True),
    Field("exposure.brightness", "Standard deviation of their logarithm."),
    Field("exposure.tint", "The same of red against blue."),
    Field("exposure.beside_turn", "What a light without gains left over beside what goes with the head's turn.", ""),
    Field("exposure.beside_turn.brightness", "Standard deviation of its logarithm."),
    Field("exposure.beside_turn.tint", "The same of red against blue."),
    Field("relief", "The normal map; empty with normal_map=false, absent with solver=reference.", "", optional=True),
    Field("relief.prior_radians", "Expected size of the turns.", unit="rad", optional=True),
    Field("relief.confirmed_share", "Share of the turns that held-out frames confirm.", optional=True),
    Field("relief.pooled_texels", "Standard width over which texels count together.", unit="texels", optional=True),
    Field("relief.median_deg", "Median turn.", unit="deg", optional=True),
    Field("relief.p95_deg", "What 95 % of the turns stay below.", unit="deg", optional=True),
    Field("diagnostics", "What the model cannot follow, measured; absent with solver=reference.", "", optional=True),
    Field("diagnostics.frame_gain", "Standard deviation of the brightness from frame to frame."),
    Field("diagnostics.frame_tint", "The same of the colour, red against blue."),
    Field("diagnostics.albedo_by_orientation", "Standard deviation of the log albedo that follows the surface's "
          "orientation."),
    Field("diagnostics.unlikely_colour", "How unlikely the colour of skin and light is, in standard deviations."),
    Field("diagnostics.covered_eyes", "Share of the skin around the eyes that fits far worse than the face; absent "
          "for a mesh without segments.", optional=True),
    Field("diagnostics.covered_forehead", "The same of the forehead.", optional=True),
    Field("model_selection", "With model=auto: one entry for each choice that was tried, in order.", "", optional=True),
    *_under("model_selection[]", _CANDIDATES),
    Field("iterations", "One entry for each step of the light; with solver=reference, for some of the iterations.", ""),
    Field("iterations[].light", "The light's model.", "text", optional=True),
    Field("iterations[].resolution", "Edge of its cubemap faces.", "int", unit="texels", optional=True),
    Field("iterations[].step", "Number of the step at this resolution, from 0.", "int", optional=True),
    Field("iterations[].points", "Surface points that it looked at.", "int", optional=True),
    Field("iterations[].shaping", "Whether highlights did not take part yet.", "bool", optional=True),
    Field("iterations[].undone", "Present where the step was undone.", "bool", optional=True),
    Field("iterations[].fitted", "Error on the fitted frames.", optional=True),
    Field("iterations[].held_out", "Error on the held-out frames.", optional=True),
    Field("iterations[].cost", "What the step minimised, before it.", optional=True),
    Field("iterations[].rescaled", "By how much the step changed the scale between light and albedo, as a "
          "logarithm.", optional=True),
    Field("iterations[].skin_prior", "The albedo's part of the cost.", optional=True),
    Field("iterations[].specular_intensity", "The typical specular intensity after it.", optional=True),
    Field("iterations[].roughness", "The typical roughness after it.", optional=True),
    Field("iterations[].light_weights", "Of several clips: the weight of each clip's samples.", shape="C",
          optional=True),
    Field("iterations[].iteration", f"{_REFERENCE} number of the iteration, from 1.", "int", optional=True),
    *(Field(f"iterations[].{name}", f"{_REFERENCE} loss of {what}.", optional=True) for name, what in (
        ("image", "the picture"), ("mask", "the mask"), ("laplacian", "the vertices' Laplacian"),
        ("white_light", "the light's deviation from grey"), ("diffuse", "the squared diffuse albedo"),
        ("roughness_variation", "the roughness's variation"))),
    *_SCALE,
    Field("seen_share_of_texels", "Share of the map's texels that the clip determines."),
    Field("held_out_frames", "Frames of the (first) clip that were not fitted.", "int", "H"),
    Field("render_frames", "Frames of the (first) clip that were re-rendered.", "int", "R"),
    *_CLIPS,
    Field("warnings", "What is wrong with the clip or the result, one sentence each.", "text", "W"),
)

SELECTION_TIMES = (Field("[]", "Seconds of each entry of `model_selection` in solve.json, in order.", unit="s"),)

EXPORTED_POSES = (POSES, FRAME_INDEX, SOURCE_LENS, GAZE, EYE_TURN, LIDS, GAIN)
_STAGE_RECORD = (
    Field("version", "The stage's version.", "int"),
    Field("parameters.**", "Its parameters as used.", ""),
    Field("wall_s", "Seconds that it took.", unit="s"),
    Field("cpu_s", "Processor seconds.", unit="s"),
    Field("peak_memory_mb", "Largest memory.", unit="MB"),
    Field("warnings", "Its warnings.", "text", "W"),
)
RUN = (
    Field("subject", "The subject's name.", "text"),
    Field("stages", "One entry for each stage; of several clips `<clip>/<stage>` where it ran for each.", ""),
    *_under("stages.<stage>", _STAGE_RECORD),
    *_MODEL,
    Field("residuals.**", "As in solve.json.", ""),
    *_LAMP,
    *_HAIR,
    *_SCALE,
    *(replace(field, path=f"head_{field.path}", optional=True) for field in _HEAD_SCALE),
    Field("held_out_frames", "Frames of the (first) clip that were not fitted.", "int", "H"),
    *_CLIPS,
    Field("model_selection", "With model=auto: as in solve.json, and with the seconds of each.", "", optional=True),
    *_under("model_selection[]", _CANDIDATES),
    Field("model_selection[].seconds", "Seconds that the choice took.", "number or null", unit="s"),
    Field("actions", "The facial actions in the assets. Absent when actions is off.", "", optional=True),
    Field("actions.names", "Names of the blend shapes: those of ARKit.", "text", "A"),
    Field("actions.lacking", "Names of ARKit's that the head has no blend shape for.", "text", "B"),
    Field("actions.note", "Why there are none; empty where there are.", "text"),
    Field("warnings", "All warnings.", ""),
    Field("warnings[].stage", "The stage that gave it; of several clips `<clip>/<stage>`.", "text"),
    Field("warnings[].text", "The warning.", "text"),
)

MANIFEST = (
    Field("schema", "Version of this form.", "int"),
    Field("stage", "The stage's name.", "text"),
    Field("version", "Its version.", "int"),
    Field("parameters.**", "Its parameters as used.", ""),
    Field("inputs", "SHA-256 of all that it read, by name.", ""),
    Field("inputs.<name>", "Of a stage, over all of its files.", "text"),
    Field("key", "SHA-256 of all of the above: equal keys, equal results.", "text"),
    Field("outputs", "The files that it wrote, by name.", ""),
    Field("outputs.<file>.volatile", "Present where the file's bytes differ from run to run; then nothing more is said "
          "of its content.", "bool", optional=True),
    Field("outputs.<file>.sha256", "Its hash.", "text", optional=True),
    Field("outputs.<file>.bytes", "Its size.", "int", unit="bytes", optional=True),
    Field("outputs.<file>.kind", "image, arrays, json, mesh, usd ...", "text", optional=True),
    Field("outputs.<file>.shape.**", "Of a picture its height, width and channels; of arrays the shape of each.", "",
          optional=True),
    Field("outputs.<file>.unit", "Unit of length of what it holds.", "text", optional=True),
    Field("outputs.<file>.space", "The space that positions or pixels belong to.", "text", optional=True),
    Field("outputs.<file>.colour_space", "How colours are coded.", "text", optional=True),
)
PROVENANCE = (
    Field("started", "When, in UTC.", "text"),
    Field("wall_s", "Seconds that it took.", unit="s"),
    Field("cpu_s", "Processor seconds.", unit="s"),
    Field("peak_memory_mb", "Largest memory.", unit="MB"),
    Field("host", "The machine's name.", "text"),
    Field("platform", "Its operating system.", "text"),
    Field("python", "Version of Python.", "text"),
    Field("cores", "Its processor cores.", "int"),
    Field("threads", "Threads that the stage was given.", "int"),
    Field("cpu.machine", "The processor's architecture.", "text"),
    Field("cpu.model", "Its name.", "text"),
    Field("cpu.flags", "Its features.", "text"),
    Field("kernels.**", "For which processor each library chose its loops, and the variables that decided on it.", ""),
    Field("packages.<package>", "Version of each package that was loaded.", "text"),
    Field("code.<file>", "Hash of each of Limn's files that was loaded, comments and layout apart.", "text"),
    Field("sources.<file>", "Hash of each of these files as it lies there.", "text"),
    Field("command", "The command line.", "text", "N"),
    Field("warnings", "Warnings of the stage.", "text", "W"),
    Field("bytes", "Size of all its files.", "int", unit="bytes"),
    Field("volatile", "Files whose bytes differ from run to run.", ""),
    Field("volatile.<file>.sha256", "The hash.", "text"),
    Field("volatile.<file>.bytes", "The size.", "int", unit="bytes"),
)
