"""First look at the skin: the clip projected onto the head and averaged, and one colour per face segment.

Reads    sample_frames (frames, masks), track_landmarks (poses, mesh, segments).
Writes   mean_texture.exr, segment_albedo.exr, weight.exr, segments.png, init.json.
Method   Each frame is sampled at every texel that its camera sees; samples are averaged with the square of the view's
         cosine and the distance to the mask's border as weight. One frame is in memory at a time. A segment's colour
         is the median over its texels, which ignores hair and highlights; unseen segments take the skin's median.
Fails    poses that match no frame; a head that no frame shows.
"""

from __future__ import annotations

from shared.contract import Job, Output, Parameter, Stage, main
from shared.contract.records import INIT
from shared.errors import LimnError

STAGE = Stage(
    name="init_albedo",
    version=2,
    help="The clip averaged on the head's texture map, and one colour per face segment.",
    inputs=("sample_frames", "track_landmarks"),
    outputs=(
        Output("mean_texture.exr", "mean radiance on the map", space="uv", colour_space="lin_rec709_scene"),
        Output("segment_albedo.exr", "one colour per segment", space="uv", colour_space="lin_rec709_scene"),
        Output("weight.exr", "sum of the samples' weights, in frames seen head-on", space="uv", colour_space="data"),
        Output("segments.png", "the mean texture with the segments' borders", space="uv", colour_space="srgb"),
        Output("init.json", "colour and seen texels of each segment", fields=INIT),
    ),
    parameters=(
        Parameter("size", int, 1024, "Edge of the maps.", "texels", choices=(64, 128, 256, 512, 1024, 2048, 4096)),
        Parameter("frames", int, 40, "Frames to average at most, spread evenly.", "frames", 1, 2000),
    ),
)

SEEN_WEIGHT = 0.5
"""Texels with less total weight (frames seen head-on) do not count towards their segment's colour."""


def average_frames(job: Job, views, texels, viewer) -> tuple:
    """Weighted mean radiance [T, 3] and total weight [T] of the texels over the chosen views."""
    import numpy as np

    from shared.compute.read_ahead import work_ahead
    from shared.compute.threads import share_out
    from shared.imaging.frame_index import spread_frames

    total, weight = np.zeros((len(texels), 3), np.float32), np.zeros(len(texels), np.float32)
    chosen = spread_frames(len(views), job.params.frames)

    def look(f: int):
        view = viewer.view(views.camera_from_head[f], views.intrinsics[f], views.size)
        return texels.frame_view(view, views.picture(f), views.intrinsics[f])

    def add(view, rows) -> None:
        samples, _ = texels.samples(view, rows)
        total[rows] += samples.weight[:, None] * samples.colours
        weight[rows] += samples.weight

    for view in work_ahead(look, job.progress(chosen, "projecting frames", total=len(chosen))):
        blocks = view.blocks()
        share_out(len(blocks), lambda k, view=view, blocks=blocks: add(view, blocks[k]))
    return total / np.maximum(weight, 1e-6)[:, None], weight


def segment_colours(mean, weight, texel_segment, names) -> dict[str, dict]:
    """Median colour of each segment over its well-seen texels; segments that are not seen take the overall median."""
    import numpy as np

    seen = weight > SEEN_WEIGHT
    if not seen.any():
        raise LimnError("no texel of the head is seen by any frame")
    everywhere, colours = np.median(mean[seen], axis=0), {}
    for i, name in enumerate(names):
        inside = seen & (texel_segment == i)
        colour = np.median(mean[inside], axis=0) if inside.any() else everywhere
        colours[name] = {"albedo": [round(float(value), 5) for value in colour], "texels_seen": int(inside.sum())}
    return colours


def borders_picture(mean_image, segment_image):
    """uint8 sRGB: the mean texture with the segments' borders in yellow."""
    import numpy as np

    from shared.imaging.color import encode_srgb

    picture = np.round(encode_srgb(mean_image) * 255).astype(np.uint8)
    border = np.zeros(segment_image.shape, bool)
    border[1:] |= segment_image[1:] != segment_image[:-1]
    border[:, 1:] |= segment_image[:, 1:] != segment_image[:, :-1]
    picture[border] = (255, 220, 0)
    return picture


def run(job: Job) -> None:
    """Average, colour the segments, write."""
    import numpy as np

    from shared.compute.processor import use_baseline_opencv
    from shared.imaging.image_sampling import SurfaceViewer
    from shared.imaging.texels import TexelSurface
    from shared.inverse.clip_inputs import read_inputs
    from shared.io.arrays import write_json
    from shared.io.images import write_exr, write_png

    use_baseline_opencv()
    inputs = read_inputs(job.input("sample_frames"), job.input("track_landmarks"))
    surface = inputs.surface
    texels, viewer = TexelSurface(surface.mesh, job.params.size), SurfaceViewer.of(surface.mesh)
    mean, weight = average_frames(job, inputs.views, texels, viewer)
    names, face_segment = surface.segment_names, surface.face_segment
    if face_segment is None:
        names, face_segment = ("head",), np.zeros(len(surface.mesh.faces), np.uint8)
    texel_segment = face_segment[texels.face]
    colours = segment_colours(mean, weight, texel_segment, names)
    palette = np.array([colours[name]["albedo"] for name in names], np.float32)
    filled = np.where((weight > 0)[:, None], mean, palette[texel_segment])
    mean_image = texels.dilated(texels.to_image(filled))
    segment_image = texels.dilated(texels.to_image(palette[texel_segment]))
    write_exr(job.out / "mean_texture.exr", mean_image, colour_space="lin_rec709_scene")
    write_exr(job.out / "segment_albedo.exr", segment_image, colour_space="lin_rec709_scene")
    write_exr(job.out / "weight.exr", texels.to_image(weight), colour_space="data")
    write_png(job.out / "segments.png", borders_picture(mean_image, texels.to_image(texel_segment, 255)))
    frames_used = min(len(inputs.frame_index), job.params.frames)
    seen_share = round(float((weight > SEEN_WEIGHT).mean()), 4)
    write_json(job.out / "init.json", {"segments": colours, "frames": frames_used, "seen_share": seen_share})


def check(job: Job) -> None:
    """A part of the map is seen and its colours lie in the picture's range."""
    from shared.io.images import read_exr

    mean, weight = read_exr(job.out / "mean_texture.exr"), read_exr(job.out / "weight.exr")
    if (weight > 0).mean() < 0.02:
        raise LimnError(f"only {(weight > 0).mean():.1%} of the map is seen")
    if mean.min() < 0.0 or mean.max() > 1.5:
        raise LimnError(f"mean texture leaves the picture's range: {mean.min():.3f} .. {mean.max():.3f}")


if __name__ == "__main__":
    raise SystemExit(main(STAGE, run, check))
