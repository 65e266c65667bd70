"""Model selection: the rule by which a candidate is accepted, and where it ends on captures whose truth is
known."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from field_check import below, field_faults
from toy_capture import (
    NOISE,
    ROUGHNESS,
    even_light,
    glossy_forehead,
    hard_light,
    make_truth,
    under_true_light,
)
from toy_head import toy_head

from shared.appearance.fit import Solution
from shared.appearance.problem import AppearanceSettings
from shared.compute.run_context import SILENT, RunContext
from shared.contract.job import Parameters
from shared.contract.records import RUN, SELECTION_TIMES, SOLVE
from shared.errors import InputError
from shared.geometry.mesh import segments_at
from shared.inverse import model_selection
from shared.inverse.model_selection import select
from shared.inverse.parameters import read_forced, read_settings
from shared.inverse.problem import InverseSettings
from shared.report.content import selection_record
from shared.report.page import selection_rows
from shared.selection.candidates import LIGHTS, Model, ModelSelection, Trial, allowed_candidates, gain, serves
from shared.selection.specular import VARIATIONS, SpecularSelection, SpecularVariation
from shared.shape.gauss_newton import ShapeSettings
from stages.inverse_render import STAGE

CAREFUL = AppearanceSettings(resolutions=(8, 16), noise=(0.003, 0.01))


def selected(capture, settings=CAREFUL, **candidates):
    """Model selection and the record of its candidates; visibility off would need a transfer of its own."""
    records = []
    allowed = allowed_candidates(settings) | {"visibility": ("on", "bounces")} | candidates
    selection = ModelSelection({True: capture}, settings, allowed, records.append)
    selection.select()
    return selection, records


@pytest.fixture(scope="module")
def matte(one_thread):
    return selected(make_truth(specular=0.0, lights=(even_light,))[0])


@pytest.fixture(scope="module")
def glossy(one_thread):
    """Glossy enough that highlights save three of their standard errors: a gain of one hangs on roundings."""
    return selected(make_truth(specular=1.0, lights=(hard_light,))[0])


def test_a_matte_evenly_lit_head_ends_low(matte):
    selection, records = matte
    assert selection.present.model.specular == "none"
    assert selection.present.model.light == "harmonics_2"
    refused = {record["candidate"] for record in records if not record["accepted"]}
    assert {"one_value", "sun_sky", "harmonics_4"} <= refused
    assert selection.present.errors.mean() < 1.5 * NOISE


def test_a_glossy_hard_lit_head_needs_more(glossy):
    selection, records = glossy
    assert selection.present.model.specular == "one_value"
    assert list(LIGHTS).index(selection.present.model.light) > list(LIGHTS).index("harmonics_2")
    assert selection.present.errors.mean() < 0.5 * records[0]["held_out"]


def test_every_candidate_is_on_the_record_with_its_error_and_seconds(glossy):
    selection, records = glossy
    assert records[0]["part"] == "start" and records[0]["fall"] is None
    held_out = records[0]["held_out"]
    for record in records[1:]:
        assert record["fall"] == pytest.approx(held_out - record["held_out"], abs=1e-12)
        worthwhile = 0.0 if record["part"] == "visibility" else 0.005 * held_out
        assert record["accepted"] == (record["fall"] > max(record["standard_error"], worthwhile))
        assert record["seconds"] > 0.0
        held_out = record["held_out"] if record["accepted"] else held_out
    assert held_out == pytest.approx(float(selection.present.errors.mean()))
    assert len(selection.tried) == len(records)  # no model twice


def variation_of(capture, segment, **candidates):
    """The variation of specular terms that is selected under the true light, and the record."""
    model, records = Model("bounces", "one_value", "cubemap_16"), []
    settings = model.applied(AppearanceSettings(noise=(0.003, 0.01), roughness=ROUGHNESS))
    state = under_true_light(capture)[1]
    trial = Trial(model, Solution(state, (), 0.0, 0.0), np.zeros(0), 0.0)
    allowed = {"specular": VARIATIONS, "roughness": VARIATIONS} | candidates
    return SpecularSelection(capture, settings, trial, segment, allowed, records.append).select(), records


def test_specular_that_differs_by_segment_is_found_and_used(one_thread):
    capture = make_truth(roughness_at=glossy_forehead)[0]
    height = capture.points.positions[:, 1]
    forehead = (height > np.median(height)).astype(int)
    variation, records = variation_of(capture, forehead, specular=("one_value",))
    assert variation.roughness == "by_segment" and variation.specular == "one_value"
    assert [record["candidate"] for record in records] == ["by_segment", "local"]
    solution = Solution(under_true_light(capture)[1], (), 0.0, 0.0)
    worn = variation.worn_by(replace(solution, state=replace(solution.state, roughness=1.1 * ROUGHNESS)))
    found = worn.local_roughness_fit.roughness(capture.points.positions)
    assert len(np.unique(found.round(9))) == 2 and worn.local_specular is None
    assert found[forehead == 1].mean() < 0.93 * 1.1 * ROUGHNESS < 1.05 * 1.1 * ROUGHNESS < found[forehead == 0].mean()


def test_one_specular_everywhere_stays_one(one_thread):
    capture = make_truth()[0]
    segment = (capture.points.positions[:, 0] > 0.0).astype(int)
    variation, records = variation_of(capture, segment)
    assert variation == SpecularVariation() and len(records) == 4
    assert variation.worn_by(Solution(None, (), 0.0, 0.0)).local_roughness_fit is None


def test_points_take_the_segment_of_the_surface_next_to_them():
    mesh = toy_head(3).mesh(np.zeros(2), np.zeros(1))
    right = (mesh.vertices[mesh.faces].mean(1)[:, 0] > 0.0).astype(np.uint8)
    far = np.abs(mesh.vertices[:, 0]) > 30.0
    assert (segments_at(mesh, right, mesh.vertices[far]) == (mesh.vertices[far, 0] > 0.0)).all()
    assert segments_at(mesh, None, mesh.vertices) is None


def test_a_selection_goes_on_where_it_stands(glossy):
    selection, records = glossy
    before, count = selection.present, len(records)
    assert selection.select() is before and len(records) == count


@pytest.mark.parametrize("alone", [False, True])
def test_where_shadows_do_not_serve_all_parts_are_tried_at_once(monkeypatch, alone):
    """alone: shadows serve by themselves, so that there is nothing to leap for."""
    frames, records = np.random.default_rng(0).uniform(0.9, 1.1, 9), []
    whole = Model("bounces", "one_value", "cubemap_8")

    def tried(self, model, start):
        error = 0.5 if model == whole else 0.7 if alone and model.visibility == "bounces" else 1.0
        return Trial(model, None, error * frames, 0.1)

    monkeypatch.setattr(ModelSelection, "_try", lambda self, model,
                        start: replace(tried(self, model, start), solution=start))
    found = ModelSelection({}, CAREFUL, allowed_candidates(CAREFUL), records.append).select()
    leaps = [record for record in records if record["part"] == "leap"]
    assert len(leaps) == (not alone) and (alone or found.model == whole)
    if not alone:
        assert leaps[0]["candidate"] == "bounces, one_value, cubemap_8" and leaps[0]["accepted"]
        assert records[-1]["candidate"] == "cubemap_16"  # and the climb goes on from there


def tried_candidates(monkeypatch, error_of):
    """What is tried, in order, where a model's error is as given for all frames."""
    records, frames = [], np.linspace(0.99, 1.01, 9)
    monkeypatch.setattr(ModelSelection, "_try", lambda self, model,
                        start: Trial(model, None, error_of(model) * frames, 0.1))
    monkeypatch.setattr(ModelSelection, "_at_bottom", lambda self: False)
    ModelSelection({}, CAREFUL, allowed_candidates(CAREFUL), records.append).select()
    return [(record["candidate"], record["accepted"]) for record in records if record["part"] in ("light", "specular")]


def test_harmonics_are_passed_over_once_a_sun_serves(monkeypatch):
    error = {"harmonics_2": 1.0, "sun_sky": 0.8, "harmonics_4": 0.1, "cubemap_8": 0.9, "cubemap_16": 0.9}
    found = tried_candidates(monkeypatch, lambda model: error[model.light])
    assert ("sun_sky", True) in found and "harmonics_4" not in dict(found)
    assert found[1:3] == [("cubemap_8", False), ("cubemap_16", False)]


@pytest.mark.parametrize(("saved", "worth"), [(0.01, False), (0.03, True)])
def test_highlights_must_save_more_than_other_candidates(monkeypatch, saved, worth):
    found = tried_candidates(monkeypatch, lambda model: 1.0 - saved * (model.specular == "one_value"))
    assert ("one_value", worth) in found


def test_the_fall_is_paired_by_frame():
    """Frames differ by far more than the models do: only the differences count."""
    rng = np.random.default_rng(0)
    frames = rng.uniform(0.01, 0.05, 12)
    better = frames - 0.001 + 0.0004 * rng.normal(size=12)
    fall, standard_error = gain(frames, better)
    assert fall == pytest.approx(0.001, abs=0.0003) and standard_error < 0.0003 < frames.std()
    assert serves(frames, better)
    assert not serves(better, frames)


def test_a_fall_within_its_standard_error_does_not_serve():
    frames = np.full(9, 0.02)
    after = frames - 0.001
    after[0] += 0.012  # one frame loses what the others gain, and more
    assert gain(frames, after)[0] < gain(frames, after)[1]
    assert not serves(frames, after)
    assert not serves(frames, frames - 0.00002)  # all frames gain, but next to nothing


def test_settings_bound_model_selection_and_force_its_candidates():
    free = allowed_candidates(AppearanceSettings())
    assert free["visibility"] == ("off", "on", "bounces") and free["specular"] == ("none", "one_value")
    assert free["light"][0] == "harmonics_2" and free["light"][-1] == "cubemap_16"
    assert allowed_candidates(AppearanceSettings(bounce=False))["visibility"] == ("off", "on")
    assert allowed_candidates(AppearanceSettings(visibility=False))["visibility"] == ("off",)
    assert allowed_candidates(AppearanceSettings(specular=False))["specular"] == ("none",)
    assert allowed_candidates(AppearanceSettings(resolutions=(4,)))["light"][-2:] == ("harmonics_4", "cubemap")
    assert allowed_candidates(AppearanceSettings(light_model="sun_sky"))["light"] == ("sun_sky",)
    assert allowed_candidates(AppearanceSettings(), frozenset({"light", "specular"})) == free | {
        "light": ("cubemap_16",), "specular": ("one_value",)}


def test_a_model_becomes_the_solvers_settings():
    settings = Model("on", "none", "harmonics_4").applied(AppearanceSettings())
    assert settings.visibility and not settings.bounce and not settings.specular
    assert (settings.light_model, settings.resolutions) == ("harmonics_4", (8,))
    camera = Model("bounces", "one_value", "camera").applied(AppearanceSettings(light_model="camera"))
    assert (camera.light_model, camera.resolutions) == ("camera", (16,))
    coarse = Model("off", "none", "cubemap").applied(AppearanceSettings(resolutions=(4,)))
    assert (coarse.light_model, coarse.resolutions) == ("cubemap", (4,))


class Seen:
    """A clip's small captures as they are given, in the place of model_selection.SmallClip."""

    def __init__(self, views, surface, settings, chart, context, refined=None):
        self.surface, self.refined, self.sizes = surface, refined, None
        self.captures = {visible: surface.capture for visible in (False, True)}
        self.precomputed = dict.fromkeys(self.captures, SimpleNamespace(nodes=None, directions=None))


def noisy(capture, sigma):
    colours = capture.samples.colours + sigma * np.random.default_rng(1).normal(size=capture.samples.colours.shape)
    return replace(capture, samples=replace(capture.samples, colours=colours.astype(np.float32)))


MATTE = AppearanceSettings(resolutions=(8,), light_model="harmonics_2", specular=False, noise=(0.003, 0.01))


def seen_surface(capture, mesh=None):
    return SimpleNamespace(capture=capture, mesh=mesh, face_segment=np.zeros(1))


def select_meshes(monkeypatch, qualities, **settings):
    """What the clip's model selection leads to if a mesh of each number of subdivisions leaves so much noise."""
    capture, asked = make_truth(specular=0.0)[0], []

    def refine_shape(views, tracked, *, begun, **named):
        level = named["settings"].subdivisions
        asked.append((level, begun))
        surface = seen_surface(noisy(capture, qualities[1 + level]), f"level {level}")
        return SimpleNamespace(surface=surface, stopped=3 + level)

    monkeypatch.setattr(model_selection, "SmallClip", Seen)
    monkeypatch.setattr(model_selection, "refine_shape", refine_shape)
    monkeypatch.setattr(model_selection, "some_views", lambda *_: None)
    whole = InverseSettings(appearance=MATTE, selection=frozenset(), shape=ShapeSettings(subdivisions=1), **settings)
    return select(None, seen_surface(noisy(capture, qualities[0])), whole, None, SILENT), asked


def test_the_mesh_is_refined_as_far_as_it_serves(one_thread, monkeypatch):
    selected, asked = select_meshes(monkeypatch, (0.02, 0.005, 0.02))
    assert selected.surface.mesh == "level 0" and selected.settings.shape is None
    assert asked == [(0, None), (1, "level 0")]  # the second goes on where the first ended
    assert selected.shape_record["refined"] and selected.shape_record["stopped_vertices"] == 3
    assert selected.shape_record["held_out"]["after"] < 0.5 * selected.shape_record["held_out"]["before"]
    meshes = [(candidate["candidate"],
               candidate["accepted"]) for candidate in selected.candidates if candidate["part"] == "geometry"]
    assert meshes == [("refined", True), ("subdivided_1", False)]
    assert selected.settings.appearance.specular is False and selected.start.held_out > 0.0


def test_a_tracked_mesh_that_no_refinement_improves_stays(one_thread, monkeypatch):
    selected, asked = select_meshes(monkeypatch, (0.01, 0.01, 0.005))
    assert selected.surface.mesh is None and selected.shape_record == {"refined": False}
    assert asked == [(0, None)]


def test_too_few_held_out_frames_choose_no_model(one_thread, monkeypatch):
    capture = make_truth(specular=0.0)[0]
    monkeypatch.setattr(model_selection, "SmallClip", Seen)
    notes, whole = [], InverseSettings(appearance=MATTE, selection=frozenset())
    two = seen_surface(replace(capture, fitted=np.arange(14) > 1))
    selected = select(None, two, whole, None, RunContext(note=notes.append))
    assert selected.start is None and selected.candidates == () and selected.settings == replace(whole, selection=None)
    assert "2 frames are too few" in notes[0]


def told(**changes):
    """A stage's parameters with some changed."""
    return Parameters({**STAGE.defaults(), **STAGE.parse(changes, "test")})


def test_the_stage_selects_only_when_told_to():
    assert read_settings(told()).selection is None
    assert read_settings(told(model="auto")).selection == frozenset()
    assert read_settings(told(model="auto", fixed_parts="light, geometry")).selection == {"light", "geometry"}


def test_forcing_what_there_is_not_is_one_clear_line():
    with pytest.raises(InputError, match="unknown part of the model 'ligth'.*did you mean light"):
        read_forced("ligth")
    with pytest.raises(InputError, match="model=auto belongs to solver=transfer"):
        read_settings(told(model="auto", solver="reference"))


def test_model_selection_reaches_run_json_and_the_report(glossy, tmp_path):
    _, records = glossy
    candidates = [dict(record) for record in records]
    seconds = [candidate.pop("seconds") for candidate in candidates]
    (tmp_path / "model_selection_seconds.json").write_text(json.dumps(seconds))
    merged = selection_record(tmp_path, {"model_selection": candidates})
    assert field_faults(seconds, SELECTION_TIMES) == []
    for declared, written in ((SOLVE, candidates), (RUN, merged)):
        fields = below(declared, "model_selection[]")
        assert [field_faults(candidate, fields) for candidate in written] == [[]] * len(candidates)
    assert merged == [dict(record) for record in records]
    rows = selection_rows(merged)
    assert len(rows) == len(records) and any("harmonics 2" in cell for row in rows for cell in row)
