"""What a person can do about a warning: a table from words in the warning to a remedy."""

from __future__ import annotations

import re

_ADVICE = (
    (r"focal|lens|sensor", "Give the lens in subject.yaml (camera: focal_length_mm and sensor_width_mm)."),
    (r"clipp|overexpos|saturat", "Film darker by a stop or two: clipped skin tells only that it is bright."),
    (r"underexpos|too dark|crushed", "Film brighter, or add light; noise in the dark parts ends up in the maps."),
    (r"behind|not determined|no highlight|confidence",
     "Nothing in the clip shows this. Film a wider turn, or treat maps and light there as a guess."),
    (r"turn|rotat|yaw|parallax|view change",
     "Film a turn of at least 30 degrees to each side; depth and highlights come from it."),
    (r"blur|sharpness|focus|jump", "Turn more slowly, with a shorter exposure, and keep the face in focus."),
    (r"duplicat|dropped frame|cut", "Give the untouched camera file, without edits or changes of frame rate."),
    (r"expression|smil|mouth|blink", "Film again with a relaxed, closed mouth and a steady gaze."),
    (r"short|few frames|only \d+ frames", "Film for 5 to 20 seconds."),
    (r"small|resolution|pixels wide|px wide", "Fill more of the frame with the head: 600 pixels or more are good."),
    (r"scale|prior|reflectance|chart", "Show a grey card or colour chart in the clip to fix the scale."),
    (r"edge|face[s]? have no area|winding|degenerate", "Clean the mesh in a modelling program if it matters there."),
)
_OTHERWISE = "Compare clip and re-render: where they agree, the result can be used."


def advice(warning: str) -> str:
    """One sentence of advice for a warning of any stage."""
    for pattern, sentence in _ADVICE:
        if re.search(pattern, warning, re.IGNORECASE):
            return sentence
    return _OTHERWISE
