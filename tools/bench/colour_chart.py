"""Measures what a colour chart says of the light's scale, over places and tilts beside a synthetic head.

    python -m tools.bench colour_chart --out DIR [--only room sky ...] [--places 8] [--seed 0]

A chart is drawn beside a random head in the given light, found in the picture as sample_frames finds it, and asked for
the factor that the true light lacks: none, so that what it says is its error. A row per light: how many charts were
used, the error of the log factor (median of its size, root mean square), the same over the deviation that it states
(about 1 if that is honest), and the error of the ratios between channels.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from shared.appearance.chart_scale import state_chart
from shared.capture.chart import ChartObservation
from shared.capture.chart_watch import ChartWatch
from shared.contract.chart_place import AUTO
from shared.geometry.transforms import rigid, rotation_from_vector
from shared.rendering.envmap import cube_from_latlong
from shared.tracking.models import load_head_model
from tools.bench.runner import Bench, Entry
from tools.synthesis.camera import PinholeCamera
from tools.synthesis.chart import PlacedChart, add_chart
from tools.synthesis.head import Head, random_head
from tools.synthesis.light import ENVIRONMENTS, EnvironmentLight
from tools.synthesis.output import sensor_codes
from tools.synthesis.subject import PRESETS, SENSOR_MM, SynthesisSettings, camera_place, light_of, plan_shots
from tools.synthesis.surface import Materials, SyntheticSurface

SIZE, LIGHT_RESOLUTION, EXPOSURE = (960, 480), 16, 0.8
SKIN, SKIN_IRRADIANCE = np.array([0.3, 0.2, 0.15], np.float32), 0.5
BESIDE_MM, ABOVE_MM, BEHIND_MM = (175.0, 235.0), (-50.0, 70.0), (-130.0, 60.0)
LARGEST_TILT_DEG = np.array([25.0, 35.0, 40.0])


def random_chart(distance_mm: float, height_mm: float, rng: np.random.Generator) -> PlacedChart:
    """A chart somewhere to the left or right of the head, turned away from the camera by up to LARGEST_TILT_DEG."""
    beside = rng.choice([-1.0, 1.0]) * rng.uniform(*BESIDE_MM)
    place = np.array([beside, height_mm - rng.uniform(*ABOVE_MM), distance_mm + rng.uniform(*BEHIND_MM)])
    nod, turn, roll = np.diag(np.radians(rng.uniform(-1.0, 1.0, 3) * LARGEST_TILT_DEG))
    facing = np.array([0.0, np.arctan2(place[0], place[2]), 0.0])
    turns = [rotation_from_vector(angle) for angle in (facing + turn, nod, roll)]
    return PlacedChart(rigid(turns[0] @ turns[1] @ turns[2], place))


def head_of(seed: int) -> tuple[Head, SynthesisSettings]:
    """A random head and the settings that place it before the camera."""
    return random_head(load_head_model(), seed, False), replace(PRESETS["demo"], size=SIZE[1], seed=seed, chart=True)


def measure(light: str, places: int, seed: int) -> np.ndarray:
    """[N, 2, 3] error of the log factor and the deviation that it states, of the N charts that were used."""
    head, settings = head_of(seed)
    one = np.ones((4, 4), np.float32)
    surface = SyntheticSurface(head.mesh, Materials(one[..., None] * SKIN, one, one, one))
    environment = light_of(light, settings)
    truth, shots = EXPOSURE * cube_from_latlong(environment, LIGHT_RESOLUTION), plan_shots(head.mesh, settings)
    camera = PinholeCamera(*SIZE, settings.focal_mm / SENSOR_MM * settings.size)
    rng = np.random.default_rng([seed, *light.encode()])
    said = []
    for k in range(places):
        shot, chart = shots[rng.integers(settings.frames)], random_chart(*camera_place(head.mesh, settings), rng)
        picture = np.full((SIZE[1], SIZE[0], 3), 0.3)
        even = np.full((8, 8, 3), SKIN_IRRADIANCE * np.pi, np.float32)
        add_chart(picture, chart, surface, EnvironmentLight(environment), even, shot, camera.intrinsics, 3)
        watch = ChartWatch(AUTO, "srgb")
        watch.expect(1)
        watch.look(0, 0, sensor_codes(EXPOSURE * picture, settings.noise, k))
        observations = [ChartObservation.from_record(record, (0.0, 0.0, 1.0), np.zeros(1)) for record in watch.record()]
        statement, _ = state_chart(observations, surface.scene, shot.camera_from_head[None], camera.intrinsics, "head")
        if statement is not None:
            factor, covariance = statement.log_factor(truth, EXPOSURE * SKIN_IRRADIANCE * SKIN)
            said.append(np.stack([factor, np.sqrt(np.diag(covariance))]))
    return np.array(said).reshape(-1, 2, 3)


def summary(found: np.ndarray) -> dict[str, float]:
    """The row of a light from measure's errors and stated deviations."""
    error, stated = found[:, 0], found[:, 1]
    return {"used": len(found), "median": np.median(np.abs(error)) if len(found) else np.nan, "rms": _rms(error),
            "rms_over_stated": _rms(error / stated), "ratios": _rms(error - error.mean(1, keepdims=True))}


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


class ColourChartBench(Bench):
    """Charts in each light."""

    name, columns = "colour_chart", ("case", "used", "median", "rms", "rms_over_stated", "ratios")

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--places", type=int, default=8, help="charts in each light (8)")
        parser.add_argument("--seed", type=int, default=0)

    def facts(self) -> dict[str, int]:
        return {"places": self.options.places, "seed": self.options.seed}

    def cases(self) -> dict[str, str]:
        return {light: light for light in ENVIRONMENTS}

    def measure(self, case: str, entry: Entry) -> None:
        entry.add(summary(measure(case, self.options.places, self.options.seed)))
