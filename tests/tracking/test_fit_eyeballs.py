"""Eyeballs set behind the lids of the head model."""

import numpy as np

from shared.geometry.eyeballs import EYE_RADIUS_MM, eyeballs_of, fit_sphere
from shared.tracking.fit_eyeballs import eye_centres, set_eyeballs


def test_eyeballs_are_spheres_of_their_size_where_the_model_has_them(model):
    placed = set_eyeballs(model, model.template)
    eyes = [ball.vertices for ball in eyeballs_of(model.surface(model.template))]
    for side, own in enumerate(eyes):
        centre, radius = fit_sphere(placed[own])
        assert abs(radius - EYE_RADIUS_MM) < 1e-6
        assert np.allclose(np.linalg.norm(placed[own] - centre, axis=1), EYE_RADIUS_MM)
        assert np.allclose(centre[:2], eye_centres(model, model.template)[side, :2])
    other = np.setdiff1d(np.arange(len(model.template)), np.concatenate(eyes))
    assert np.array_equal(placed[other], model.template[other])


def test_lids_rest_on_them_and_they_follow_lids(model):
    placed, lids = set_eyeballs(model, model.template), np.unique(model.faces[model.segment("lids")])
    moved = model.template.copy()
    moved[lids, 2] += 2.0
    for before, after in zip(eye_centres(model, placed), eye_centres(model, set_eyeballs(model, moved)), strict=True):
        own = model.template[lids][np.hypot(*(model.template[lids] - before)[:, :2].T) < 9.0]
        away = np.linalg.norm(own - before, axis=1)
        assert 0.7 < (away > EYE_RADIUS_MM).mean() < 0.9
        assert abs((after - before)[2] - 2.0) < 0.1


def test_setting_them_again_changes_nothing(model):
    once = set_eyeballs(model, model.template)
    assert np.allclose(set_eyeballs(model, once), once, atol=1e-3)
