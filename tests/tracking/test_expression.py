"""Frames that show the clip's most common expression, told by landmarks that are known to move or to slide."""

import re

import numpy as np
import pytest
from shapes import nods

from shared.geometry.transforms import project, rotation_from_vector
from shared.tracking.expression import FEATURES, common_expression, largest_cluster, turn_basis

LENS = np.array([[2700.0, 0, 400], [0, 2700.0, 400], [0, 0, 1]])
FRAMES = 60
TURN_DEG = 30.0 * np.sin(np.linspace(0, 2 * np.pi, FRAMES))


def seen(model, poses, activations, slide=0.0, noise_px=0.5):
    """Landmarks [F, 468, 2] px of a head that acts by activations {name: [F]}; slide: share of the turn that they
    stay behind."""
    rng, pixels = np.random.default_rng(0), np.empty((len(poses), 468, 2))
    for f, pose in enumerate(poses):
        codes = np.zeros(len(model.expression_names))
        for name, value in activations.items():
            codes[model.expression_names.index(name)] = value[f]
        places = model.landmarks(model.shape(expression=codes))
        behind = rotation_from_vector(np.radians([0.0, -slide * TURN_DEG[f], 0.0]))
        pixels[f] = project(places @ behind.T, pose[None], LENS)[0][0]
    return pixels + rng.normal(0, noise_px, pixels.shape)


def found_in(model, poses, pixels, counts=None):
    counts = np.ones(len(poses), bool) if counts is None else counts
    return common_expression(model, model.shape(), poses, LENS, pixels, counts)


ACTS = (np.arange(FRAMES) >= 20) & (np.arange(FRAMES) < 38)


@pytest.mark.parametrize("names, what", [
    (("brow_inner_up", "brow_outer_up_left", "brow_outer_up_right"), "brow .* mm higher"),
    (("mouth_smile_left", "mouth_smile_right"), "mouth"),
    (("jaw_open",), "lips .* mm farther apart|chin .* mm lower"),
])  # fmt: skip
def test_frames_of_another_expression_are_told_from_the_rest(model, names, what):
    poses = nods(TURN_DEG)
    found = found_in(model, poses, seen(model, poses, {name: 0.9 * ACTS for name in names}))
    assert np.array_equal(found.shown, ~ACTS)
    assert re.search(f"another expression than most frames: .*({what})", found.reason(25)) and not found.reason(5)
    assert found.warning().startswith(f"{ACTS.sum()} of {FRAMES} frames show another expression")


def test_the_more_common_expression_stays_though_it_is_not_the_neutral_one(model):
    poses, smiles = nods(TURN_DEG), np.arange(FRAMES) % 30 >= 12
    smile = {name: 0.8 * smiles for name in ("mouth_smile_left", "mouth_smile_right")}
    assert np.array_equal(found_in(model, poses, seen(model, poses, smile)).shown, smiles)


def test_landmarks_that_stay_behind_the_turn_show_no_expression(model):
    """Networks' landmarks slide over the skin by some per cent of the turn."""
    poses = nods(TURN_DEG)
    found = found_in(model, poses, seen(model, poses, {}, slide=0.04))
    assert found.shown.all() and not found.warning() and found.alike == found.compared == FRAMES


def test_a_face_that_the_network_missed_says_nothing_of_the_expression(model):
    """Landmarks 10 mm off, all of them: not an expression, however far brows and mouth are away."""
    poses = nods(TURN_DEG)
    pixels = seen(model, poses, {})
    pixels[7] += [0.0, 30.0]
    found = found_in(model, poses, pixels)
    assert found.shown.all() and found.compared == FRAMES - 1


def test_a_brow_that_a_lamp_s_shadow_takes_along_shows_no_expression(model):
    """Its landmarks jitter by 1 mm from frame to frame, and in some frames they lie 5 mm higher."""
    poses, rng = nods(TURN_DEG), np.random.default_rng(4)
    pixels = seen(model, poses, {})
    dark = (model.landmark_segments == "brows") & (model.landmarks(model.template)[:, 0] < 0)
    mm = poses[0, 2, 3] / LENS[0, 0]
    higher = rng.normal(0.0, 1.0, FRAMES) + 5.0 * ACTS
    pixels[:, dark, 1] -= higher[:, None] / mm
    found = found_in(model, poses, pixels)
    assert found.shown.all() and not found.warning()
    assert np.abs(found.away_mm).max() > 3.0
    pixels[ACTS] = seen(model, poses, {"jaw_open": 0.9 * ACTS})[ACTS]
    assert np.array_equal(found_in(model, poses, pixels).shown, ~ACTS), "a mouth that opens is one all the same"


def test_a_clip_without_a_common_expression_keeps_all_frames_and_says_so(model):
    """Talk all the time: any choice would leave a few frames of chance."""
    poses, rng = nods(TURN_DEG), np.random.default_rng(3)
    talk = {name: rng.uniform(0.0, 1.2, FRAMES) for name in ("jaw_open", "mouth_smile_left", "mouth_smile_right",
                                                             "brow_inner_up", "mouth_stretch")}  # fmt: skip
    found = found_in(model, poses, seen(model, poses, talk))
    assert found.shown.all() and found.alike < 0.5 * FRAMES
    assert "frames show one expression" in found.warning() and "as one rigid face" in found.warning()


def test_frames_that_are_out_already_are_not_compared(model):
    poses = nods(TURN_DEG)
    counts = np.arange(FRAMES) % 2 == 0
    found = found_in(model, poses, seen(model, poses, {"jaw_open": 0.9 * ACTS}), counts)
    assert found.compared == counts.sum() and np.array_equal(found.shown, ~(ACTS & counts))
    few = found_in(model, poses, seen(model, poses, {"jaw_open": 0.9 * ACTS}), np.arange(FRAMES) < 10)
    assert few.shown.all() and few.compared == 0 and not few.warning()


def test_cluster_is_the_largest_not_the_middle_of_two():
    """Two states 8 mm apart, 60 and 40 %: the median's own limits would hold neither."""
    rng, poses = np.random.default_rng(1), nods(TURN_DEG)
    other = np.arange(FRAMES) % 5 >= 3
    values = rng.normal(0, 0.3, (FRAMES, len(FEATURES))) + 8.0 * other[:, None]
    inside, away = largest_cluster(values, turn_basis(poses), np.full(len(FEATURES), 3.0))
    assert np.array_equal(inside, ~other) and abs(np.median(away[inside])) < 0.3
