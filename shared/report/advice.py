"""What a person can do about a warning: a table from words in the warning to a remedy.

The first pattern that is found decides, so those of single warnings stand before those of whole families.
"""

from __future__ import annotations

import re

_ADVICE = (
    (r"are converted|values do not lie|data window",
     "Nothing to do if the contact sheet looks right; else correct what the files say of their colours and windows."),
    (r"negative values", "Nothing to do if they are noise; else export without grading."),
    (r"holds \d+ videos", "Look at the contact sheet; if it shows the wrong one, cut the other out of the file."),
    (r"capture\.moves",
     "Correct capture.moves in subject.yaml and run again; if both moved, film again with one of them still: light "
     "solved under the wrong one turns along with the head."),
    (r"colour chart",
     "Look at work/sample_frames/chart.png. The chart should face the camera in the light of the face, without "
     "overexposed patches or the head's shadow; or give its corners by `chart:` in subject.yaml."),
    (r"grey place",
     "Name by `grey:` in subject.yaml a place of plain grey or white in the light of the face that is well exposed and "
     "that nobody walks before, or leave it out."),
    (r"tracks ask for a focal length",
     "Correct the lens in subject.yaml; cropping and stabilisation in the camera lengthen it too."),
    (r"beside the shared mesh",
     "Give each clip its own lens in subject.yaml, and clips with one neutral expression; else solve them one by one."),
    (r"rotation is known",
     "Give the camera's own file, and film sharper, brighter and larger: light and shape can be no better than the "
     "poses."),
    (r"person masks miss",
     "Look at the head's outline in layers/; film before a plain background that differs from hair and skin."),
    (r"poses given",
     "Check frame numbers, axes and the direction of the transforms (docs/files.md); poses that are only roughly right "
     "serve as a start with hold_poses: false."),
    (r"focal|lens|sensor", "Give the lens in subject.yaml (camera: focal_length_mm and sensor_width_mm)."),
    (r"faces in the clip",
     "Look at the contact sheet; if it shows the wrong person, crop the clip or film one person."),
    (r"beyond the picture's edge", "Film again with room around the head: what leaves the picture has no texture."),
    (r"exposure wanders",
     "Lock exposure and white balance, and keep the light still: gains that go with the head's turn pass for shading."),
    (r"brightness wanders|flicker",
     "Lock the exposure and keep the light still; maps from this clip average over its changes."),
    (r"colour wanders", "Lock the white balance; maps from this clip average over its changes."),
    (r"follows the surface's orientation",
     "Film with lights that stand still, none on the head or in the hand, and a wider turn; a lamp that moves along "
     "ends up in the albedo as if it were skin."),
    (r"in front of it",
     "Take off glasses, tie hair back, and film again; in these maps what stood before the skin is part of it."),
    (r"unlikely colour",
     "Check colour: transfer in subject.yaml, switch filters off, or show a colour chart; the albedo's tint is a "
     "guess."),
    (r"held out fit worse",
     "Look at Motion and at the error maps for frames that stand out; film with a still light, or leave such frames "
     "out by a higher sample_frames.min_sharpness."),
    (r"explains the clip poorly",
     "Look at the error maps: large even areas mean that the light changed or moved along, edges that the shape is "
     "off. Film again if the face itself is red or blue."),
    (r"hardly any of the maps",
     "Rely on no map where the confidence map is dark. Check colour: transfer in subject.yaml. Film with more light, "
     "sharper, with exposure, white balance and lamps that stay."),
    (r"no colour", "Give the original in colour: only brightness can be solved from this one."),
    (r"are linear|transfer", "Set colour: transfer in subject.yaml to what the camera wrote."),
    (r"colour matrix", "Nothing to do if skin looks right here; else convert the clip with its matrix stated."),
    (r"interlaced", "Film progressive, or de-interlace first: ffmpeg -i IN -vf bwdif -c:v libx264 -crf 12 OUT.mp4."),
    (r"alpha", "Nothing to do if the pictures are meant to be opaque."),
    (r"numbers are missing", "Give all frames of the shot: gaps count as dropped frames."),
    (r"clipp|overexpos|saturat", "Film darker by a stop or two: clipped skin tells only that it is bright."),
    (r"underexpos|too dark|crushed|noise is",
     "Film brighter, or add light; noise in the dark parts ends up in the maps."),
    (r"behind|not determined|no highlight|confidence",
     "Nothing in the clip shows this. Film a wider turn, or treat maps and light there as a guess."),
    (r"around the mouth|expression|smil|blink",
     "Film again with a relaxed, closed mouth and a steady gaze, without talking."),
    (r"(is|are) blurred", "Turn more slowly, with a shorter exposure, and keep the face in focus."),
    (r"view of the head|turn|rotat|yaw|parallax",
     "Film a turn of at least 30 degrees to each side; depth and highlights come from it."),
    (r"px high|resolution|pixels wide|px wide", "Fill more of the frame with the head: 600 pixels or more are good."),
    (r"few frames|usable frames", "Film for 5 to 20 seconds; sample_frames.min_sharpness=0 keeps blurred frames."),
    (r"do not fit|left out", "See the list of frames left out: the reasons say whether to film more slowly, or without "
     "hands and hair before the face."),
    (r"duplicat|dropped|cut", "Give the untouched camera file, without edits or changes of frame rate."),
    (r"blur|sharpness|focus|jump", "Turn more slowly, with a shorter exposure, and keep the face in focus."),
    (r"scale|prior|reflectance", "Show a 24-patch colour chart in the clip to fix the scale."),
    (r"edges (are shared|join)|faces have no area|winding|degenerate",
     "Clean the mesh in a modelling program if it matters there."),
)
_OTHERWISE = "Compare clip and re-render: where they agree, the result can be used."


def advice(warning: str) -> str:
    """One sentence of advice for a warning of any stage."""
    for pattern, sentence in _ADVICE:
        if re.search(pattern, warning, re.IGNORECASE):
            return sentence
    return _OTHERWISE
