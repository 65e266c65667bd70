"""Measures inverse_render on a subject whose truth is known: accuracy by case, and cost over sizes.

    python -m tools.bench.appearance SUBJECT RUN [--with SUBJECT RUN] [--tracked] [--cases full no_bounce ...]
        [--set key=value] [--out DIR]
    python -m tools.bench.appearance SUBJECT RUN --cost
        times over 4 numbers of frames and 4 sizes of the maps, with the crops enlarged to 1K and frames repeated

SUBJECT: a folder with gt/; RUN: a run's folder whose work/ holds sample_frames and track_landmarks. True mesh and poses
are used unless --tracked. --with: another clip of the same head in another light, solved together with the first one,
each of them measured on its own truth. Each case solves the clip anew with some models switched off, and is compared
with the truth: albedo (dE2000 after one gain per channel, and raw), specular intensity and roughness where confidence
is over one half, light through a 25 degree lobe, and re-renders against the video on the face skin, on fitted and on
held-out frames.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from shared.contract.job import Parameters
from shared.imaging.color import decode_transfer
from shared.imaging.image_sampling import Picture, prepare_picture
from shared.inverse.clip_inputs import ClipInputs, read_inputs, read_mean_texture
from shared.inverse.joint_clips import join_clips
from shared.inverse.parameters import read_settings
from shared.inverse.problem import InverseResult, InverseSettings
from shared.inverse.solve import solve_clip
from shared.inverse.texture_match import ClipTexture
from shared.rendering.envmap import latlong_from_cube
from stages.inverse_render import STAGE
from tools.scoring.appearance_errors import light_errors, map_errors, render_errors
from tools.scoring.relighting import relight_errors

CASES: dict[str, dict] = {
    "full": {},
    "no_visibility": {"visibility": False},
    "no_bounce": {"bounce": False},
    "no_specular": {"specular": False},
    "harmonics_2": {"light_model": "harmonics_2"},
    "harmonics_4": {"light_model": "harmonics_4"},
    "sun_sky": {"light_model": "sun_sky"},
    "camera_light": {"light_model": "camera"},
    "three_frames": {"fit_frames": 3},
    "no_chart": {"chart": False},
}
COST_FRAMES, COST_MAPS, LARGE_CROP = (60, 120, 250, 500), (256, 512, 1024, 2048), 1024


def silent(items: Iterable, label: str = "", total: int | None = None) -> Iterable:
    """Progress that shows nothing."""
    return items


def parameters_of(changes: dict) -> Parameters:
    """The stage's defaults with some parameters changed; InputError for unknown ones."""
    return Parameters({**STAGE.defaults(), **STAGE.parse(changes, "tools.bench.appearance")})


def settings_of(changes: dict) -> InverseSettings:
    """The solver's settings with some of the stage's parameters changed."""
    return read_settings(parameters_of(changes))


def open_clip(subject: Path, run: Path, tracked: bool) -> tuple[ClipInputs, np.ndarray]:
    """Inputs and the frames' numbers in the source."""
    truth = ("", "") if tracked else (str(subject / "gt" / "mesh.obj"), str(subject / "gt" / "poses.npz"))
    inputs = read_inputs(run / "work" / "sample_frames", run / "work" / "track_landmarks", *truth)
    return inputs, inputs.frame_index


def measure(
    subjects: Sequence[Path],
    clips: Sequence[ClipInputs],
    changes: dict,
    note: Callable,
    textures: Sequence[ClipTexture] = (),
) -> tuple[dict, object]:
    """Solves one case and compares it with the truth of each clip's subject -> scores and the result."""
    start = time.perf_counter()
    params = parameters_of(changes)
    inputs = join_clips(clips, textures) if len(clips) > 1 else clips[0]
    if len(clips) > 1:
        note(f"clips in one head space: {inputs.describe()}")
    observations = inputs.chart_observations() if params.chart else ()
    result = solve_clip(inputs, read_settings(params), silent, note, observations)
    scores = {"seconds": time.perf_counter() - start}
    scores["peak_gb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    placed = [replace(clip, camera_from_head=inputs.camera_from_head[inputs.light_index == k])
              for k, clip in enumerate(clips)]
    lights = np.split(result.solution.state.light, len(clips))
    each = [map_errors(subject, clip, clip.frame_index, result.viewer.mesh, result.maps)
            | light_errors(subject, latlong_from_cube(light, 128))
            for subject, clip, light in zip(subjects, placed, lights, strict=True)]
    scores |= each[0] | ({"other": each[1]} if len(clips) > 1 else {})
    first, clip = subjects[0], placed[0]
    if (first / "relight").is_dir():
        poses, settings = clip.camera_from_head, settings_of(changes)
        relit = relight_errors(first, result, settings, poses, clip.frame_index)
        scores |= {f"relight_{name}": [errors["psnr"], errors["psnr_gain"]] for name, errors in relit.items()}
    return scores | render_errors(first, clip, result), result


class LargeClip:
    """A clip's inputs with crops of LARGE_CROP pixels' height and any number of frames, repeated as needed."""

    def __init__(self, inputs: ClipInputs, count: int):
        self._inputs = inputs
        # Back and forth, so that the turn stays continuous.
        forth = np.arange(len(inputs.camera_from_head))
        self._frame = np.resize(np.concatenate([forth, forth[::-1]]), count)
        self.factor = LARGE_CROP / inputs.size[1]
        self.size = (round(inputs.size[0] * self.factor), LARGE_CROP)
        self.intrinsics = np.diag([self.factor, self.factor, 1.0]) @ inputs.intrinsics
        self.camera_from_head = inputs.camera_from_head[self._frame]
        self.mesh, self.moves, self.light_index = inputs.mesh, inputs.moves, inputs.light_index[self._frame]
        self.face_segment, self.segment_names, self.tracks = inputs.face_segment, inputs.segment_names, inputs.tracks

    def picture(self, f: int) -> Picture:
        """Frame f, enlarged."""
        frames, i = self._inputs.frames, int(self._inputs.place[self._frame[f]])
        codes = cv2.resize(frames.read_codes(i), self.size, interpolation=cv2.INTER_LINEAR)
        steps = np.iinfo(codes.dtype).max
        table = decode_transfer(np.arange(steps + 1) / steps, frames.transfer)
        return prepare_picture(codes, table[codes], self.mask(f))

    def mask(self, f: int) -> np.ndarray:
        """Its mask, enlarged."""
        return cv2.resize(self._inputs.mask(int(self._frame[f])), self.size, interpolation=cv2.INTER_NEAREST)


def cost_table(inputs: ClipInputs, changes: dict) -> None:
    """Prints processor seconds of the light's and of the texture's part, all seconds, and the peak memory so far, over
    sizes. Seconds of the processor grow alike on a busy machine and on an idle one."""
    print("frames  map  light_cpu_s  texture_cpu_s  seconds  peak_gb")
    cases = [(COST_FRAMES[2], size) for size in COST_MAPS] + [(count, COST_MAPS[2]) for count in COST_FRAMES]
    for count, size in dict.fromkeys(cases):
        marks: list[tuple[str, float]] = []

        def progress(items, label="", total=None, marks=marks):
            marks.append((label, time.process_time()))
            return items

        start, begun = time.process_time(), time.perf_counter()
        solve_clip(LargeClip(inputs, count), settings_of({**changes, "map_size": size}), progress, lambda text: None)
        end, first, whole = time.process_time(), dict(marks)["tracing the surface"], time.perf_counter() - begun
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        print(f"{count:6d} {size:4d} {first - start:12.1f} {end - first:14.1f} {whole:8.1f} {peak:8.2f}", flush=True)


def main(arguments: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("subject", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("--with", dest="other", nargs=2, type=Path, metavar=("SUBJECT", "RUN"), help="a second clip")
    parser.add_argument("--tracked", action="store_true", help="tracked mesh and poses instead of the true ones")
    parser.add_argument("--cases", nargs="*", default=["full"], choices=CASES)
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="parameters for every case")
    parser.add_argument("--out", type=Path, help="folder for the maps of each case")
    parser.add_argument("--cost", action="store_true", help="times over sizes instead of accuracy")
    options = parser.parse_args(arguments)
    pairs = [(options.subject, options.run), *([options.other] if options.other else [])]
    clips, textures = [open_clip(*pair, options.tracked)[0] for pair in pairs], []
    if options.other and options.tracked:
        textures = [read_mean_texture(run / "work" / "init_albedo", clip.mesh)
                    for (_, run), clip in zip(pairs, clips, strict=True)]
    subjects, given = [subject for subject, _ in pairs], dict(setting.split("=", 1) for setting in options.set)
    if options.cost:
        cost_table(clips[0], given)
        return 0
    for case in options.cases:
        scores, result = measure(subjects, clips, {**given, **CASES[case]}, print, textures)
        rounded = {key: round(value, 4) if isinstance(value, float) else value for key, value in scores.items()}
        print(case, json.dumps(rounded))
        if options.out:
            save(options.out / case, result)
    return 0


def save(folder: Path, result: InverseResult) -> None:
    """Maps as arrays, for looking at."""
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(folder / "maps.npz", light=result.solution.state.light, **result.maps)


if __name__ == "__main__":
    raise SystemExit(main())
