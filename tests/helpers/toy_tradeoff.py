"""Points of a chart of speed against accuracy."""

from tools.bench.chart.cases import PEER, PRESET

ERROR, LIKENESS = "albedo.aligned.delta_e2000_median", "albedo.aligned.psnr_linear"


def point(name, seconds, error, group="ablation", **more):
    ranges = {"seconds": [0.9 * seconds, 1.1 * seconds], "peak_mb": [500.0, 500.0]}
    return {
        "name": name, "group": group, "settings": [name], "repeats": 2, "seconds": seconds, "cpu_seconds": 2 * seconds,
        "peak_mb": 500.0, "others": 0.0, "ranges": ranges,
        "stages": {"inverse_render": seconds}, "scores": {ERROR: error, LIKENESS: 40.0 - error}, **more,
    }  # fmt: skip


POINTS = [
    point("draft", 60.0, 2.0, PRESET), point("standard", 300.0, 1.0, PRESET), point("fine", 900.0, 1.1, PRESET),
    point("draft, matte", 40.0, 2.5), point("draft, no bounce", 70.0, 2.2), point("Mitsuba, 120 s", 160.0, 3.0, PEER),
]  # fmt: skip
