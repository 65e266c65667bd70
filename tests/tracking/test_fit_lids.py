"""Lids laid on contours that a known head shows."""

from dataclasses import replace

import numpy as np
import pytest
from shapes import nods

from shared.capture.iris import FACE_MESH_LIDS, LOWER_LID, UPPER_LID
from shared.geometry.eyeballs import eyeballs_of
from shared.geometry.raycast import RayScene
from shared.geometry.transforms import project
from shared.tracking.fit_eyeballs import eye_centres, set_eyeballs
from shared.tracking.fit_head import FitWeights, HeadFit, fit_codes
from shared.tracking.fit_lids import LidContours, LidMargins, lay_lids, lay_on_balls, lid_contours, lid_pins
from shared.tracking.fit_surface import ThinPlate
from shared.tracking.lids import Lids
from shared.tracking.tracked_clip import TrackedClip

LENS = np.array([[2700.0, 0, 400], [0, 2700.0, 400], [0, 0, 1]])
FRAMES = 60
POSES = nods(15.0 * np.sin(np.linspace(0, 2 * np.pi, FRAMES)))


@pytest.fixture(scope="module")
def head(model):
    fine = model.subdivided()
    return fine, LidMargins.of(fine)


def activated(model, activation: float, *actions: str) -> np.ndarray:
    """Expression codes in which these facial actions are active."""
    return np.where(np.isin(model.expression_names, actions), activation, 0.0)


def shown_by(margins, vertices, shut=(False, False)) -> LidContours:
    """Nine points of each margin, evenly along it."""
    points = np.array([[vertices[loop[np.linspace(0, len(loop) - 1, 9).round().astype(int)]] for loop in loops]
                       for loops in margins.loops])  # fmt: skip
    return LidContours(points, np.array(shut))


def off_mm(margins, vertices, contours) -> np.ndarray:
    """From each vertex of the margins to the nearest place of its contour, as seen from the front."""
    found = []
    for loops, shown in zip(margins.loops, contours.points, strict=True):
        for loop, curve in zip(loops, shown, strict=True):
            dense = np.stack([np.interp(np.linspace(0, 8, 400), np.arange(9), curve[:, k]) for k in (0, 1)], axis=1)
            found.append(np.linalg.norm(vertices[loop][:, None, :2] - dense, axis=2).min(1))
    return np.concatenate(found)


def test_margins_run_from_the_outer_to_the_inner_corner(head):
    model, margins = head
    for lower, upper in margins.loops:
        assert lower[0] == upper[0] and lower[-1] == upper[-1]
        assert abs(model.template[lower[0], 0]) > abs(model.template[lower[-1], 0]) + 20.0
        assert model.template[upper[len(upper) // 2], 1] > model.template[lower[len(lower) // 2], 1] + 5.0
    right, left = (model.template[np.concatenate(loops)] for loops in margins.loops)
    assert (right[:, 0] < 0).all() and np.allclose(sorted(right[:, 1]), sorted(left[:, 1]))
    assert LidMargins.of(replace(model, segment_names=tuple(f"part {k}" for k in range(16)))) is None


def test_margins_come_to_lie_on_the_contours_and_the_rest_of_the_face_stays(head):
    model, margins = head
    squint = activated(model, 0.6, "eye_squint_left", "eye_wide_right")
    contours = shown_by(margins, model.shape(None, squint) + [0.8, -1.5, 0.0])
    laid = lay_lids(ThinPlate(model), margins, model.template, contours)
    before, after = (off_mm(margins, vertices, contours) for vertices in (model.template, laid))
    assert np.median(before) > 0.8 and np.median(after) < 0.1 and after.max() < 0.6
    other = np.unique(model.faces[~model.segment("lids", "eye_sockets")])
    assert np.array_equal(laid[other], model.template[other])
    centres, radii = eye_centres(model, model.template), []
    for centre, loops in zip(centres, margins.loops, strict=True):
        own = np.concatenate(loops)
        radii += [np.linalg.norm(vertices[own] - centre, axis=1) for vertices in (model.template, laid)]
    assert np.allclose(radii[0], radii[1], atol=0.3) and np.allclose(radii[2], radii[3], atol=0.3)


def test_an_eye_that_nobody_saw_keeps_its_lids(head):
    model, margins = head
    contours = shown_by(margins, model.template + [0.0, -2.0, 0.0])
    contours.points[1] = np.nan
    laid = lay_lids(ThinPlate(model), margins, model.template, contours)
    moved = np.abs(laid - model.template).max(1) > 1e-6
    assert moved.any() and (model.template[moved, 0] < 0).all()
    assert len(lid_pins(margins, model.template, contours).points) == 18


def test_shut_lids_leave_no_eyeball_to_be_seen(head):
    model, margins = head
    vertices = model.shape(None, activated(model, 0.5, "eye_blink_left", "eye_blink_right"))
    line = shown_by(margins, model.template, (True, True))
    line.points[:, 1] = line.points[:, 0]
    shut = set_eyeballs(model, lay_lids(ThinPlate(model), margins, vertices, line))
    eyes = np.nonzero(model.segment("eyes"))[0]

    def eye_seen(vertices) -> int:
        x, y = np.meshgrid(np.arange(-50.0, 50.0, 0.25), np.arange(15.0, 50.0, 0.25))
        origins = np.stack([x.ravel(), y.ravel(), np.full(x.size, 300.0)], axis=1)
        return int(np.isin(RayScene(vertices, model.faces).first_faces(origins, np.tile([0, 0, -1.0], (x.size, 1))),
                           eyes).sum())  # fmt: skip

    assert eye_seen(model.template) > 4000 and eye_seen(shut) == 0


def test_pins_steer_the_codes(head):
    """A blink that no track point shows."""
    model, margins = head
    truth = model.shape(None, activated(model, 0.4, "eye_blink_left", "eye_blink_right"))
    skin = np.unique(model.faces[model.segment("cheek_left", "cheek_right", "nose", "forehead", "chin", "jaw")])
    landmarks = model.landmarks(model.template)
    pins = lid_pins(margins, model.template, shown_by(margins, truth))
    without = fit_codes(model, truth[skin], landmarks, FitWeights())
    fitted = fit_codes(model, truth[skin], landmarks, FitWeights(), pins=pins)
    chosen = model.expression_names.index("eye_blink_right")
    assert without.expression[chosen] < 0.15 < 0.25 < fitted.expression[chosen] < 0.55


@pytest.mark.parametrize("shut", [False, True])
def test_contours_lie_where_the_frames_show_them(head, shut):
    """Some frames blink, and count only where all do; of shut eyes the dark line is the contour."""
    model, margins = head
    contours = shown_by(margins, model.template)
    lids_px, landmarks_px = np.zeros((FRAMES, 2, 16, 2)), np.zeros((FRAMES, 468, 2))
    for eye, (lower, upper) in enumerate(contours.points):
        places = np.zeros((16, 3))
        places[list(UPPER_LID)], places[list(LOWER_LID)] = upper, lower
        drawn = project(places, POSES, LENS)[0]
        lids_px[:, eye] = landmarks_px[:, FACE_MESH_LIDS[eye]] = drawn
    blinks = np.zeros((FRAMES, 2), bool)
    blinks[20:26] = True
    lids_px[20:26] = lids_px[20:26].mean(2, keepdims=True)
    pictures = [np.full((800, 800), 128, np.uint8)] * FRAMES
    clip = TrackedClip(pictures, [], [], landmarks_px, np.arange(FRAMES) / 25.0, LENS, (800, 800), lids_px=lids_px)
    lids = Lids(np.where(blinks, 0.0, 1.0), blinks | shut, np.full(2, 8.0))
    skin = model.template[np.unique(model.faces[model.segment("lids", "nose", "cheek_left", "cheek_right")])]
    found = lid_contours(clip, lids, POSES, skin, np.array([0.0, -1.0, 0.0]))
    assert (found.shut == shut).all()
    if shut:  # nothing dark: where the line is expected, below the lower lid
        assert np.array_equal(found.points[:, 0], found.points[:, 1])
        return
    assert np.abs(found.points[..., :2] - contours.points[..., :2]).max() < 0.4
    moved = found.moved(HeadFit(2.0, np.eye(3), np.array([0.0, 1.0, 0.0]), None, None, None))
    assert np.allclose(moved.points, 2.0 * found.points + [0.0, 1.0, 0.0])


def test_lids_that_rest_on_the_balls_leave_open_what_they_are_told_to(head):
    """Ellipses, as seen from the front and, since inner edges lie on the balls, from twenty degrees below, too."""
    model, margins = head
    vertices = set_eyeballs(model, model.template)
    balls = eyeballs_of(model.surface(vertices))
    angle, half = np.linspace(0.0, np.pi, 17), np.array([9.0, 3.5, 4.5])
    points = np.empty((2, 2, 17, 3))
    for eye, (ball, outward) in enumerate(zip(balls, (-1.0, 1.0), strict=True)):
        for lid, height in enumerate((-half[1], half[2])):
            across = np.stack([outward * half[0] * np.cos(angle), height * np.sin(angle)], axis=1)
            front = np.sqrt(ball.radius**2 - (across**2).sum(1))
            points[eye, lid] = ball.centre + np.column_stack([across, front])
    laid = lay_on_balls(ThinPlate(model), margins, vertices, LidContours(points, np.zeros(2, bool)))
    other = np.unique(model.faces[~model.segment("lids", "eye_sockets")])
    assert np.array_equal(laid[other], vertices[other])
    scene, eyes = RayScene(laid, model.faces), np.nonzero(model.segment("eyes"))[0]
    step = 0.2
    for ball in balls:
        x, y = np.meshgrid(np.arange(-12.0, 12.0, step), np.arange(-8.0, 8.0, step))
        place = np.stack([x.ravel(), y.ravel(), np.sqrt(np.maximum(ball.radius**2 - x**2 - y**2, 0.0)).ravel()], 1)
        wanted = (x / half[0]) ** 2 + (y / np.where(y < 0, half[1], half[2])) ** 2 < 1.0
        for pitch in np.radians([0.0, -20.0]):
            towards = np.array([0.0, np.sin(pitch), np.cos(pitch)])
            start = ball.centre + place + 100.0 * towards
            open_there = np.isin(scene.first_faces(start, np.tile(-towards, (len(start), 1))), eyes).reshape(x.shape)
            border_mm = 2.0 * np.pi * np.sqrt(0.5 * (half[0] ** 2 + half[1:].mean() ** 2))
            assert step**2 * (wanted ^ open_there).sum() < 0.25 * border_mm
    unseen = LidContours(np.full_like(points, np.nan), np.zeros(2, bool))
    assert lay_on_balls(ThinPlate(model), margins, vertices, unseen) is vertices
