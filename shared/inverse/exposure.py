"""Exposure and white balance that drift: by how much each frame is brighter than one still light makes it.

What the solved light leaves over of a frame as a whole is a gain of three numbers. Such gains are solved only where the
clip asks for them: where they are as large as people are warned of, and where what does not go with the head's turn is
half of that at least, since the rest may be the light's own error. On skin that no rigid model fits exactly, smaller
ones would trade tints between light and albedo. Light and gains are solved in turn. A light that took gains for shading
lets go of them, since shading also changes from one side of the face to the other within a frame; but only by and by,
so each change is extrapolated from the last two (Aitken's process for vectors, [Irons1969]).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from shared.appearance.diagnostics import WANDERING_GAIN, WANDERING_TINT, frame_gains
from shared.appearance.fit import Solution, fit_appearance
from shared.appearance.observations import Capture, build_capture
from shared.appearance.problem import AppearanceProblem, AppearanceSettings
from shared.compute.run_context import RunContext
from shared.geometry.transforms import turns_from_mean
from shared.imaging.frame_index import frames_of_lights
from shared.imaging.views import Views
from shared.inverse.lit_surface import LitSurface
from shared.inverse.problem import FACE_SKIN, InverseSettings
from shared.rendering.near_lamp import SeenLamp

LEAST_DEVIATIONS = {"brightness": WANDERING_GAIN, "tint": WANDERING_TINT}
BESIDE_TURN = 0.5
"""Share of these by which gains that do not go with the head's turn deviate: a locked camera's do by 0.0025 in all."""
LEAST_FRAMES = 20
"""Of fewer nearly all can go with the head's turn."""
POINTS, STEPS = 400, 3
"""Surface points that gains are solved from, and steps of the light between two changes of them."""
ROUNDS, AT_REST, LONGEST = 10, 0.002, 4.0
"""Changes at most, the deviation of the last, and how far one is extrapolated."""
ALBEDO_ROUNDS = 3
"""Albedo and gains in turn under a light that is known: most frames show most points, so they soon agree."""


@dataclass(frozen=True, eq=False)
class Exposure:
    """gain [F, 3]: how much brighter each frame is than the still light makes it, its geometric mean 1 over the frames
    of a light; solution: of the light without them; record: what is worth saying of the gains."""

    gain: np.ndarray
    solution: Solution
    record: dict


def solve_exposure(
    views: Views, lit: LitSurface, solution: Solution, settings: InverseSettings, context: RunContext
) -> Exposure | None:
    """The gains of all views; None where nothing asks for them. lit: what the light was solved on, from some views.

    The head is brighter where it comes nearer to a near lamp, so that its lamp is known before.
    """
    left = centred(left_over(lit.coarse, solution, settings.appearance), lit.coarse)
    wandering = deviations(beside_turn(left, lit.coarse))
    if not asks_for_gains(deviations(left), wandering):
        return None
    _, steady = solve_gains(lit.coarse.some_points(POINTS), solution, settings.appearance, context)
    log_gain = gains_under(steady, capture_of_all(views, lit, solution, settings, context), settings.appearance)
    record = {**deviations(log_gain), "beside_turn": wandering}
    context.note(f"exposure that wanders: {record}")
    return Exposure(np.exp(log_gain), steady, record)


def asks_for_gains(left: Mapping[str, float], beside: Mapping[str, float]) -> bool:
    """Whether what a still light leaves over, and what of that does not go with the head's turn, are large enough."""
    return any(left[kind] > least and beside[kind] > BESIDE_TURN * least for kind, least in LEAST_DEVIATIONS.items())


def capture_of_all(
    views: Views, lit: LitSurface, solution: Solution, settings: InverseSettings, context: RunContext
) -> Capture:
    """What all views show of a few points, under the solution's lamp."""
    moves, skin = settings.appearance.light_moves(views.moves), lit.surface.vertices_of(FACE_SKIN)
    found = build_capture(lit.viewer, lit.precomputed, views, moves, skin, POINTS, context)
    if solution.lamp is None:
        return found
    return found.under_lamp(SeenLamp.of(solution.lamp, views.camera_from_head, moves))


def exposure_warnings(exposure: Exposure | None) -> list[str]:
    """What a person should know of gains that were solved."""
    if exposure is None:
        return []
    brightness, tint = exposure.record["brightness"], exposure.record["tint"]
    return [f"the exposure wanders by {brightness:.0%} and the white balance by {tint:.0%} from frame to frame, which "
            "was solved and taken out: lock both and keep the light still"]


def solve_gains(
    capture: Capture, solution: Solution, settings: AppearanceSettings, context: RunContext
) -> tuple[np.ndarray, Solution]:
    """[F, 3] logarithm of the gains of a capture's frames, and the light without them; solution: of the light as it is
    where there are none."""
    log_gain, brief = np.zeros((len(capture.fitted), 3)), replace(settings, steps=STEPS)
    last, reach = None, 1.0
    for _ in context.progress(range(ROUNDS), "solving exposure"):
        solution = fit_appearance(at_gain(capture, log_gain), brief, start=solution, least=STEPS - 1)
        left = centred(left_over(at_gain(capture, log_gain), solution, settings), capture)
        if last is not None:
            reach = extrapolated(reach, last, left)
        log_gain += reach * left
        last = left
        if max(deviations(reach * left).values()) < AT_REST:
            break
    return log_gain, solution


def gains_under(steady: Solution, capture: Capture, settings: AppearanceSettings) -> np.ndarray:
    """[F, 3] logarithm of the gains of a capture's frames under a light that is known without them."""
    log_gain, once = np.zeros((len(capture.fitted), 3)), replace(settings, steps=1)
    for _ in range(ALBEDO_ROUNDS):
        seen = at_gain(capture, log_gain)
        albedo = fit_appearance(seen, once, start=steady, keep_start=True)
        log_gain += centred(left_over(seen, albedo, settings), capture)
    return log_gain


def extrapolated(reach: float, before: np.ndarray, after: np.ndarray) -> float:
    """By how much to multiply the change after [...], which follows on reach times the change before [...], so that
    nothing is left if changes shrink by one factor [Irons1969]."""
    fall = before - after
    return float(np.clip(reach * (before * fall).sum() / max((fall * fall).sum(), 1e-12), 1.0, LONGEST))


def at_gain(capture: Capture, log_gain: np.ndarray) -> Capture:
    """What a capture shows once gains of logarithm log_gain [F, 3] are taken out."""
    colours = capture.samples.colours / np.exp(log_gain).astype(np.float32)
    return replace(capture, samples=replace(capture.samples, colours=colours))


def left_over(capture: Capture, solution: Solution, settings: AppearanceSettings) -> np.ndarray:
    """[F, 3]: logarithm of the frames over the model."""
    problem, state = AppearanceProblem.of(capture, settings), solution.state
    return frame_gains(problem.errors, state.radiance(*problem.transport(state).forward(state.light)))


def centred(log_gain: np.ndarray, capture: Capture) -> np.ndarray:
    """log_gain [F, 3] with a mean of 0 over the frames of each light, whose brightness is the light's own."""
    found = log_gain.copy()
    for frames in frames_of_lights(capture.light_index, len(found)):
        found[frames] -= found[frames].mean(0)
    return found


def beside_turn(log_gain: np.ndarray, capture: Capture) -> np.ndarray:
    """What no quadratic of yaw and pitch explains of log_gain [F, 3], light by light; 0 for lights of few frames."""
    found = np.zeros_like(log_gain)
    for frames in frames_of_lights(capture.light_index, len(found)):
        if len(frames) < LEAST_FRAMES:
            continue
        pitch, yaw, _ = turns_from_mean(capture.world_from_head[frames]).T
        design = np.stack([np.ones_like(yaw), yaw, pitch, yaw * yaw, yaw * pitch, pitch * pitch], axis=1)
        found[frames] = log_gain[frames] - design @ np.linalg.lstsq(design, log_gain[frames], rcond=None)[0]
    return found


def deviations(log_gain: np.ndarray) -> dict[str, float]:
    """Standard deviations over the frames of log_gain [F, 3]: of its mean, and of red against blue."""
    return {"brightness": round(float(log_gain.mean(1).std()), 4),
            "tint": round(float((log_gain[:, 0] - log_gain[:, 2]).std()), 4)}
