"""What tools/bench/chart/bench.py measures: presets, ablations of one preset, the other solver, and a peer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from shared.contract.pipeline import Pipeline, split_settings

PRESET, ABLATION, REFERENCE, PEER = "preset", "ablation", "reference", "peer"
GROUPS = {
    PRESET: "Limn's presets",
    ABLATION: "one setting of {base} changed",
    REFERENCE: "published solver, lightened",
    PEER: "Mitsuba 3, gradient descent",
}
SETS = ("quick", "all")
FRAMES, IMAGE = "sample_frames.frame_count", "sample_frames.max_size"
SAMPLES, MAPS = {"inverse_render.fixed_parts": "samples"}, {"inverse_render.fixed_parts": "maps"}
ABLATIONS: dict[str, dict[str, object]] = {
    **{f"{n} frames": {FRAMES: n} for n in (12, 24, 48, 96, 150, 250)},
    **{f"{n} px": {IMAGE: n} for n in (256, 512, 720, 1024)},
    **{f"{n} directions": {"inverse_render.directions": n, **SAMPLES} for n in (128, 256, 512, 768, 2048)},
    **{f"{n} points": {"inverse_render.points": n, **SAMPLES} for n in (500, 1000, 2000, 8000)},
    **{f"map {n}": {"inverse_render.map_size": n, **MAPS} for n in (256, 512, 1024, 2048)},
    **{f"light {n}": {"inverse_render.light_resolution": n, "inverse_render.model": "full"} for n in (8, 16, 32)},
    "mesh held": {"inverse_render.shape": False},
    "mesh refined": {"inverse_render.shape": True},
    "mesh not split": {"inverse_render.shape": True, "inverse_render.shape_subdivisions": 0},
    "mesh split twice": {"inverse_render.shape": True, "inverse_render.shape_subdivisions": 2},
    "one roughness": {"inverse_render.local_roughness": False},
    "no bounce": {"inverse_render.bounce": False},
    "no visibility": {"inverse_render.visibility": False},
    "matte": {"inverse_render.specular": False},
    "harmonics 4": {"inverse_render.light_model": "harmonics_4"},
    "sun and sky": {"inverse_render.light_model": "sun_sky"},
    "model full": {"inverse_render.model": "full"},
}
"""Name -> parameters; each is measured as a change of one preset."""
QUICK = ("12 frames", "256 px", "128 directions", "2048 directions", "map 256", "mesh held", "mesh refined",
         "no bounce", "no visibility", "matte", "model full")  # fmt: skip
LIGHTENED = {
    "solver": "reference", "map_size": 256, "reference_pixels": 3000, "reference_light_samples": 48,
    "reference_cosine_samples": 48, "reference_lobe_samples": 16, "reference_light_resolution": 64,
    "reference_vertices": False, "reference_light_rate": 0.03, "reference_texture_rate": 0.005,
}  # fmt: skip
"""The published algorithm, five to seven times cheaper per iteration and faster in its textures; mesh held still."""
ITERATIONS = {"quick": (150, 450), "all": (150, 450, 1350, 4050)}
PEER_SECONDS = {"quick": (30.0, 90.0), "all": (60.0, 120.0, 240.0, 480.0)}


@dataclass(frozen=True)
class ChartCase:
    """settings: parameters that differ from the preset's, as "stage.key=value". seconds: for a peer, when its result is
    looked at."""

    name: str
    group: str
    preset: str
    settings: tuple[str, ...] = ()
    seconds: tuple[float, ...] = ()

    @property
    def whole(self) -> bool:
        """Whether the export is measured as well."""
        return self.group == PRESET


def all_cases(pipeline: Pipeline, base: str, which: str, clip: Mapping[str, float]) -> list[ChartCase]:
    """The cases of a set, ablations as changes of the preset base; clip: frames and height of the subject.

    Left out is what the clip cannot tell from base: more frames or pixels than it has, parameters that base has anyway.
    InputError where base is no preset.
    """
    presets = ["draft", "standard"] if which == "quick" else ["draft", "standard", "fine"]
    cases = [ChartCase(name, PRESET, name) for name in presets]
    names = QUICK if which == "quick" else tuple(ABLATIONS)
    own = _effective(pipeline, base, {}, clip)
    for name in names:
        if _effective(pipeline, base, ABLATIONS[name], clip) != own:
            cases.append(ChartCase(f"{base}, {name}", ABLATION, base, _settings(ABLATIONS[name])))
    light = {f"inverse_render.{key}": value for key, value in LIGHTENED.items()}
    for count in ITERATIONS[which]:
        settings = _settings(light | {"inverse_render.reference_iterations": count})
        cases.append(ChartCase(f"reference, {count} iterations", REFERENCE, base, settings))
    cases.append(ChartCase("Mitsuba", PEER, base, seconds=PEER_SECONDS[which]))
    return cases


def _settings(changes: Mapping[str, object]) -> tuple[str, ...]:
    return tuple(f"{key}={str(value).lower() if isinstance(value, bool) else value}" for key, value in changes.items())


def _effective(
    pipeline: Pipeline, preset: str, changes: Mapping[str, object], clip: Mapping[str, float]
) -> dict[str, dict[str, object]]:
    """All parameters, those that the clip bounds cut down to it."""
    given = split_settings(_settings(changes), pipeline.stages)
    found = {name: pipeline.parameters(stage, preset, given.get(name, {})) for name, stage in pipeline.stages.items()}
    sampled = found["sample_frames"]
    sampled["frame_count"] = min(sampled["frame_count"], clip["frames"])
    sampled["max_size"] = min(sampled["max_size"], clip["height"])
    return found
