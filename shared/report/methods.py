"""What was done, as sentences to paste into a paper: by stage, with figures, versions of the tools and references.

Only what the records of the run say is told; what they leave out is left out. References are numbered in the order in
which the text needs them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from shared.contract.subject import is_sequence
from shared.report.references import REFERENCES

_KEY = re.compile(r"\{([A-Z][a-z]+[0-9]{4})\}")
_LIGHTS = {
    "cubemap": "a cubemap of which every texel is unknown",
    "harmonics_2": "the exponential of spherical harmonics of order 2 {Ramamoorthi2001} {Ren2006}",
    "harmonics_4": "the exponential of spherical harmonics of order 4 {Ren2006}",
    "sun_sky": "one sun and a sky of spherical harmonics {Ren2006}",
    "camera": "one lamp at the camera in a uniform light",
}
_CLOSING = ("This text was written by Limn from the records of the run. It is dedicated to the public domain (CC0): "
            "use it unchanged or changed.")


@dataclass(frozen=True)
class ClipRecords:
    """What sample_frames and track_landmarks left of one clip: frames.json, tracking.json, names of given inputs."""

    name: str
    frames: Mapping[str, object]
    tracking: Mapping[str, object]
    given: frozenset[str] = frozenset()


@dataclass(frozen=True)
class RunRecords:
    """A run: run.json, solve.json, each clip, and {package: version} of all that its stages loaded."""

    run: Mapping[str, object]
    solve: Mapping[str, object]
    clips: Sequence[ClipRecords]
    packages: Mapping[str, str] = field(default_factory=dict)

    def parameters(self, stage: str) -> Mapping[str, object]:
        """Of the stage; of several clips, which share them, of the first."""
        stages = self.run["stages"]
        return next(stages[name]["parameters"] for name in stages if name.rpartition("/")[2] == stage)

    def tool(self, name: str, package: str) -> str:
        """The tool with its version, where it is known."""
        version = self.packages.get(package)
        return f"{name} {version}" if version else name


class _Citations:
    """Numbers references as they are needed."""

    def __init__(self) -> None:
        self.keys: list[str] = []

    def numbered(self, text: str) -> str:
        """The text with each {key} as its number in brackets, neighbours as one: [1, 2]."""
        return _KEY.sub(lambda match: f"[{self._number(match.group(1))}]", text).replace("] [", ", ")

    def _number(self, key: str) -> int:
        if key not in REFERENCES:
            raise ValueError(f"no such reference: {key}")
        if key not in self.keys:
            self.keys.append(key)
        return self.keys.index(key) + 1


def methods_paragraphs(records: RunRecords) -> tuple[list[str], list[str]]:
    """Paragraphs, one a stage, and the references, numbered from 1."""
    citations = _Citations()
    stages = (_opening(records), _sampling(records), _tracking(records), _averaging(records), _solving(records),
              _scale(records), _export(records))
    paragraphs = [citations.numbered(" ".join(sentences)) for sentences in map(list, stages)]
    return [*paragraphs, _CLOSING], [REFERENCES[key] for key in citations.keys]


def methods_text(records: RunRecords) -> str:
    """The same as plain text, a line a paragraph."""
    paragraphs, references = methods_paragraphs(records)
    listed = [f"[{number}] {text}" for number, text in enumerate(references, 1)]
    return "\n\n".join([*paragraphs, "\n".join(["References", *listed])]) + "\n"


def _opening(records: RunRecords) -> Iterable[str]:
    versions = ", ".join(f"{name.rpartition('/')[2]} {stage['version']}" for name, stage in _one_clip(records).items())
    limn = records.tool("Limn", "limn")
    yield (f"Mesh, reflectance and light were recovered from video by {limn} (stages {versions}), which "
           "goes on from the method of {Xu2025}, in a workflow of Snakemake {Molder2021}.")
    tools = [records.tool(name, package) + f" {{{key}}}" for name, package, key in (
        ("NumPy", "numpy", "Harris2020"), ("SciPy", "scipy", "Virtanen2020"), ("PyTorch", "torch", "Paszke2019"),
        ("Numba", "numba", "Lam2015")) if package in records.packages]
    if tools:
        yield f"Computations used {_listed(tools)}."


def _one_clip(records: RunRecords) -> dict[str, Mapping]:
    """The stages' records; of several clips the first one's."""
    stages = records.run["stages"]
    first = next((name.partition("/")[0] for name in stages if "/" in name), "")
    return {name: stage for name, stage in stages.items() if "/" not in name or name.startswith(f"{first}/")}


def _sampling(records: RunRecords) -> Iterable[str]:
    names = [str((clip.frames.get("source") or {}).get("name", "")) for clip in records.clips]
    if not all(map(is_sequence, names)):
        yield f"Video was decoded with {records.tool('FFmpeg through PyAV', 'av')}."
    yield ("Faces were found by BlazeFace {Bazarevsky2019} and 468 landmarks by Face Mesh {Kartynnik2019} (MediaPipe's "
           f"networks, run by {records.tool('OpenCV', 'opencv-contrib-python-headless')} {{Bradski2000}}).")
    for clip in records.clips:
        source, kept, dropped = (clip.frames.get(name) for name in ("source", "frames", "dropped"))
        if not source or kept is None:
            continue
        lens = clip.frames.get("intrinsics_source")
        known = "given" if clip.frames.get("focal_known") else "estimated"
        focal = f"; focal length {lens[0][0]:.0f} px, {known}" if lens else ""
        left_out = f"; {len(dropped)} were left out as blurred, repeated, damaged or faceless." if dropped else "."
        yield (f"{_of(clip)} ({source['width']} x {source['height']} px, {source['fps']:.4g} frames/s, read as "
               f"{clip.frames.get('transfer')}{focal}) {len(kept)} frames evenly spread in time were kept{left_out}")


def _of(clip: ClipRecords) -> str:
    return f"Of the clip {clip.name}" if clip.name else "Of the clip"


def _tracking(records: RunRecords) -> Iterable[str]:
    given = sorted(frozenset().union(*(clip.given for clip in records.clips)))
    if given:
        yield f"The tracking used {' and '.join(given)} that another tracker gave."
    yield ("The head was tracked as one rigid body: from the landmarks, skin was followed by dense inverse search flow "
           "{Kroeger2016} with a forward-backward check {Kalal2010}, then matched against the clip's own mean texture "
           "{Baker2004}, and poses and points were adjusted together {Triggs2000}.")
    yield ("A linear head model {Blanz1999} built from MakeHuman's data (CC0) was fitted to the points {Chen1992} and "
           "then bent towards them {Botsch2008}.")
    for clip in records.clips:
        if scale := clip.tracking.get("scale"):
            yield (f"{_of(clip)}, {scale['method']} set the scale (known to {100 * scale['log_deviation']:.1f} %).")
        error, turn = clip.tracking.get("reprojection_px"), clip.tracking.get("rotation_range_deg")
        if error and turn is not None:
            tracks, frames = clip.tracking.get("tracks"), clip.tracking.get("frames")
            yield (f"{_of(clip)} {tracks} points in {frames} frames fit with a median reprojection error of "
                   f"{error['median']:.2f} px (95 %: {error['p95']:.2f} px) over a turn of {turn:.0f} degrees.")


def _averaging(records: RunRecords) -> Iterable[str]:
    use = "to place the clips on one mesh" if len(records.clips) > 1 else "for comparison"
    yield f"The frames' colours were averaged on the surface, {use}."


def _solving(records: RunRecords) -> Iterable[str]:
    parameters = records.parameters("inverse_render")
    yield ("Reflectance is Lambertian plus a specular intensity times a GGX lobe {Walter2007} with Schlick's Fresnel "
           "term for a base of 4 % {Schlick1994} and alpha the square of the roughness {Burley2012}.")
    if parameters.get("solver") == "reference":
        yield ("Mesh, textures and light were solved by stochastic gradient descent through a deferred renderer as "
               "published {Xu2025} {Nicolet2021} {Karis2013}.")
    else:
        yield from _transfer(parameters)
        yield from _lamp(records.solve.get("lamp") or {})
        yield from _exposure(records.solve.get("exposure") or {})
        yield from _catchlights(records.solve.get("catchlights") or {})
    yield from _shape(parameters, records.solve.get("shape") or {})
    yield from _hair(records.solve.get("hair") or {})
    residuals, held_out = records.solve.get("residuals", {}), records.solve.get("held_out_frames", ())
    if isinstance(residuals.get("held_out"), float) and isinstance(residuals.get("fitted"), float):
        yield (f"Re-renders differ from fitted frames by {residuals['fitted']:.4f} and from {_counted(len(held_out))} "
               f"held out of the solve by {residuals['held_out']:.4f} (mean absolute difference; 1: the clip's white).")


def _counted(count: int) -> str:
    return f"{count} frame{'s' * (count != 1)}"


def _transfer(parameters: Mapping[str, object]) -> Iterable[str]:
    if parameters.get("visibility"):
        traced = "Visibility, traced with Embree {Wald2014},"
        known = f"{traced} and all diffuse bounces {{Goral1984}} were" if parameters.get("bounce") else f"{traced} was"
        yield f"{known} computed once in head space and reused by all frames {{Sloan2002}}."
    light = _LIGHTS.get(str(parameters.get("light_model")))
    if parameters.get("model") == "auto":
        yield ("The model of light and highlights was chosen step by step, where the error on held-out frames, joined "
               "with what the prior on skin says against the albedo, fell; what its standard error left open "
               "{Breiman1984} was solved in the fuller model. It was solved from as many frames and points as lights "
               "of half of them {Efron1982} showed to be enough.")
    if light:
        chosen = parameters.get("model") == "auto" and parameters.get("light_model") == "cubemap"
        yield (f"The light was {'' if chosen else f'modelled as {light}, and '}solved by Gauss-Newton steps with the "
               "albedo eliminated {Golub1973} {Kaufman1975}.")
    if parameters.get("specular"):
        yield "Albedo and specular intensity were then solved in closed form for each texel."
    elif parameters.get("specular") is False:
        yield "Albedo was then solved in closed form for each texel, without highlights."


def _lamp(lamp: Mapping[str, object]) -> Iterable[str]:
    tried = [f"{one['distance_mm'] / 1000:.2f} m" for one in lamp.get("tried", ()) if one["distance_mm"] is not None]
    if "distance_mm" in lamp:
        place = (f"{lamp['distance_mm'] / 1000:.2f} m from the head, with parallax and the inverse square of the "
                 "distance")
        yield (f"Its main lamp stands {place}: of far away and {_listed(tried)} it fits held-out frames best, by more "
               "than the standard error {Breiman1984}." if tried else f"Its main lamp was said to stand {place}.")
    elif tried:
        yield (f"Its main lamp is far away: at {_listed(tried)} it fits held-out frames no better by more than the "
               "standard error {Breiman1984}.")


def _exposure(exposure: Mapping[str, float]) -> Iterable[str]:
    if exposure:
        yield (f"Exposure, which wandered by {exposure['brightness']:.0%}, and white balance, by "
               f"{exposure['tint']:.0%}, were solved as a gain of each frame and channel beside the still light "
               "{Irons1969}.")


def _catchlights(found: Mapping[str, object]) -> Iterable[str]:
    if not found:
        return
    of = f"{found['with_catchlight']} of {found['irises']} irises"
    if "apart_deg" in found:
        yield (f"As a check, catchlights {{Nishino2004}}: {of} show one; where the solved light gives one, too, they "
               f"come from directions {found['apart_deg']['median']:.0f} degrees apart (median), and the clip's hold "
               f"{found['light_over_solved']:.2f} times as much light.")
    elif found["with_catchlight"]:
        yield f"As a check, catchlights {{Nishino2004}}: {of} show one, where the solved light gives none."
    else:
        yield f"No catchlight stands out on any of {found['irises']} irises, so that none checks the light."


def _shape(parameters: Mapping[str, object], shape: Mapping[str, object]) -> Iterable[str]:
    if parameters.get("mesh"):
        yield "The mesh was given."
    if parameters.get("poses"):
        yield "The poses were given."
    if parameters.get("silhouette") and "outline" in shape:
        yield ("Ears, skull and jaw were moved so that the outline meets the person masks {Cipolla2000}, cheeks, "
               "chin and jaw so that it meets the face's edges in the pictures {Tabatabai1984}.")
    if shape.get("refined"):
        yield "The mesh was refined from shading, parallax and tracks in large smooth steps {Nicolet2021}."
    elif "refined" in shape:
        yield "A mesh refined from shading fitted held-out frames no better and was not used."


def _hair(hair: Mapping[str, float]) -> Iterable[str]:
    if hair:
        yield ("Hair that stands off the head has a surface and an albedo of its own: the visual hull "
               f"{{Laurentini1994}} of the person in all frames, {hair['thickness_mm']:.0f} mm (median) off the head. "
               "How much of a place is hair was told from the frames' pixels by their colours, smoothed by a guided "
               "filter {He2013}.")


def _scale(records: RunRecords) -> Iterable[str]:
    scale = records.solve.get("albedo_scale") or {}
    if "chart" in scale:
        yield ("The scale between light and albedo, which no clip tells by itself, was set by a 24-patch colour chart "
               "in view {Mccamy1976}.")
    elif "method" in scale:
        yield (f"The scale between light and albedo, which no clip tells by itself, was set by {scale['method']}.")
    if "grey" in scale:
        yield ("The light's tint was read where a person named a place in the picture as grey, whose brightness was "
               "not used.")
    if "log_sigma" in scale:
        deviation = scale["log_sigma"]["luminance"]
        yield (f"By these the skin's luminance is known to {deviation:.0%} (standard deviation of the logarithm), "
               f"{scale['prior_share']:.0%} of which is known without the clip.")


def _export(records: RunRecords) -> Iterable[str]:
    usd, materials = records.tool("OpenUSD", "usd-core"), records.tool("MaterialX", "MaterialX")
    yield (f"Results were written as USD ({usd}) with UsdPreviewSurface and OpenPBR ({materials}) materials and as EXR "
           f"({records.tool('OpenEXR', 'OpenEXR')}) in {_colours(records)}.")


def _colours(records: RunRecords) -> str:
    return "ACEScg" if records.parameters("export_usd").get("acescg") else "scene-linear Rec.709"


def _listed(items: Sequence[str]) -> str:
    return ", ".join(items[:-1]) + (" and " if len(items) > 1 else "") + items[-1]
