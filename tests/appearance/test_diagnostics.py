"""Signs of causes that the model cannot follow, on the egg whose light and albedo are known."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from toy_capture import FRAMES, make_truth
from toy_head import toy_head

from shared.appearance.diagnostics import (
    by_orientation,
    diagnostic_warnings,
    diagnostics_of,
    face_regions,
    unlikely_colour,
)
from shared.appearance.fit import fit_appearance
from shared.appearance.problem import AppearanceProblem, AppearanceSettings
from shared.errors import InputError
from shared.io.images import write_exr
from shared.io.material_maps import write_material
from stages.inverse_render import check

MATTE = AppearanceSettings(resolutions=(6,), steps=5, specular=False, noise=(0.003, 0.01))


@pytest.fixture(scope="module")
def capture(one_thread):
    return make_truth(specular=0.0)[0]


def diagnostics(capture, colours=None, regions=None):
    if colours is not None:
        capture = replace(capture, samples=replace(capture.samples, colours=colours.astype(np.float32)))
    return diagnostics_of(AppearanceProblem.of(capture, MATTE), fit_appearance(capture, MATTE).state, regions)


@pytest.fixture(scope="module")
def calm(capture):
    return diagnostics(capture)


def test_a_good_clip_shows_none(calm):
    assert calm["frame_gain"] < 0.012 and calm["frame_tint"] < 0.012 and calm["unlikely_colour"] < 2.0
    assert diagnostic_warnings(calm) == []


def test_wandering_exposure_and_white_balance_are_told_apart(capture, calm):
    # Half of it can pass for light: no two of the few frames look the same way.
    wave = 0.1 * np.where(np.arange(FRAMES) % 2, 1.0, -1.0)
    brighter = diagnostics(capture, capture.samples.colours * np.exp(wave)[None, :, None])
    assert 0.045 < brighter["frame_gain"] < 0.12 and brighter["frame_tint"] < 0.02
    redder = diagnostics(capture, capture.samples.colours * np.exp(wave[:, None] * [0.5, 0.0, -0.5]))
    assert 0.045 < redder["frame_tint"] < 0.12 and redder["frame_gain"] < 0.02
    assert "brightness wanders" in diagnostic_warnings(brighter)[0] and len(diagnostic_warnings(brighter)) == 1
    assert "colour wanders" in diagnostic_warnings(redder)[0] and len(diagnostic_warnings(redder)) == 1


def test_light_that_turns_along_is_seen_in_the_albedo(capture, calm):
    """A lamp before the forehead, much stronger than the room, shades each point alike in all frames."""
    lit = np.clip(capture.points.normals @ [0.0, 0.64, 0.77], 0.0, None)
    colours = 0.1 * capture.samples.colours + 0.9 * lit[:, None, None] * capture.samples.colours.mean(1, keepdims=True)
    found = diagnostics(capture, colours)
    assert found["albedo_by_orientation"] > calm["albedo_by_orientation"] + 0.2


def test_only_what_follows_the_normals_counts():
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(2000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    pattern = np.exp(0.15 * rng.normal(size=2000))[:, None] * [0.3, 0.2, 0.15]
    assert by_orientation(pattern, normals) < 0.05
    shaded = pattern * np.exp(0.4 * normals[:, 2:])
    assert by_orientation(shaded, normals) == pytest.approx(0.4 / np.sqrt(3), rel=0.15)


def test_hair_that_looks_up_or_down_is_no_light():
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(2000, 3)) + [0.0, 0.0, 1.0]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    brightness = 0.1 * rng.normal(size=2000) - 2.0 * (normals[:, 1] > 0.55)
    haired = np.exp(brightness)[:, None] * [0.3, 0.2, 0.15]
    assert (normals[:, 1] > 0.55).mean() > 0.15 and by_orientation(haired, normals) < 0.05
    lit = haired * np.exp(0.6 * normals[:, 2:])
    assert by_orientation(lit, normals) > 0.25


def test_what_stands_before_the_skin_is_told_with_its_place(capture, calm):
    """Rims that hide half of the points around the eyes in every other frame."""
    regions = {"eyes": capture.points.positions[:, 1] > np.median(capture.points.positions[:, 1])}
    hidden = regions["eyes"] & (np.arange(len(regions["eyes"])) % 2 == 0)
    colours = np.array(capture.samples.colours)
    colours[np.ix_(hidden, np.arange(FRAMES) % 2 == 0)] *= 0.1
    found = [diagnostics(capture, given, regions) for given in (None, colours)]
    assert found[0]["covered_eyes"] < 0.1 and found[1]["covered_eyes"] == pytest.approx(0.5, abs=0.1)
    assert "covered_eyes" not in calm
    assert diagnostic_warnings(found[0]) == []
    assert any("around the eyes" in text and "glasses" in text for text in diagnostic_warnings(found[1]))


def test_regions_of_a_face_are_where_its_segments_are():
    mesh = toy_head(3).mesh(np.zeros(2), np.zeros(1))
    centre = mesh.vertices[mesh.faces].mean(1)
    names = ("cheek_left", "eyes", "forehead")
    high = np.percentile(centre[:, 1], 80)
    segment = np.where(centre[:, 1] > high, 2, 0)
    segment[np.argmax(centre[:, 2])] = 1
    regions = face_regions(mesh, segment, names, mesh.vertices)
    eye = mesh.vertices[mesh.faces[segment == 1].ravel()].mean(0)
    near = np.linalg.norm(mesh.vertices - eye, axis=1) < 20.0
    assert regions["forehead"].any() and not (regions["forehead"] & regions["eyes"]).any()
    assert regions["eyes"][near & ~regions["forehead"]].all() and near.any() and not regions["eyes"].all()
    assert face_regions(mesh, None, names, mesh.vertices) == {}


def test_an_unlikely_colour_is_one_that_neither_skin_nor_light_has():
    skin = np.array([0.45, 0.28, 0.21])
    assert unlikely_colour(0.7 * skin, 0.15) < 1.0
    assert unlikely_colour(0.01 * skin, 0.15) < 1.5  # dim light is as likely as any
    assert unlikely_colour(skin * [0.3, 1.0, 2.0], 0.15) > 3.0
    assert unlikely_colour(skin * [0.3, 1.0, 2.0], 0.6) < unlikely_colour(skin * [0.3, 1.0, 2.0], 0.15)


def test_a_clip_that_shows_nothing_is_refused(tmp_path):
    """As of a face in the dark: the clip's fault, not a failure of ours."""
    (tmp_path / "maps").mkdir()
    for name in ("diffuse_albedo", "specular_intensity", "roughness", "normal", "confidence"):
        image = np.full((16, 16, 3) if name in ("diffuse_albedo", "normal") else (16, 16), 0.5, np.float32)
        write_exr(tmp_path / "maps" / f"{name}.exr", image, colour_space="data")
    write_material(tmp_path / "maps" / "material.exr", np.full((16, 16, 7), 1.0 / 7.0), half=True, attributes={})
    (tmp_path / "solve.json").write_text(json.dumps({"seen_share_of_texels": 0.004}), encoding="utf-8")
    with pytest.raises(InputError, match="shows less than a hundredth.*film with more light"):
        check(SimpleNamespace(out=tmp_path, subject=SimpleNamespace(folder=tmp_path)))
