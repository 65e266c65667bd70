"""Model selection: the rule by which a candidate is accepted, and where it ends on captures whose truth is known."""

import json
from dataclasses import replace

import numpy as np
import pytest
from field_check import below, field_faults
from toy_capture import NOISE, even_light, hard_light, make_truth

from shared.appearance.light_models import make_light_model
from shared.appearance.problem import AppearanceSettings
from shared.compute.run_context import RunContext
from shared.contract.job import Parameters
from shared.contract.records import RUN, SELECTION_TIMES, SOLVE
from shared.errors import InputError
from shared.inverse import model_selection
from shared.inverse.lit_surface import LitSurface
from shared.inverse.model_selection import judged_capture, select
from shared.inverse.parameters import read_forced, read_settings
from shared.inverse.problem import InverseSettings
from shared.rendering.envmap import cube_directions
from shared.report.content import selection_record
from shared.report.page import selection_rows
from shared.selection.candidates import (
    EXISTING,
    FINE_LIGHTS,
    LIGHTS,
    WORTHWHILE,
    Decision,
    Model,
    ModelSelection,
    Trial,
    allowed_candidates,
    gain,
    joint_errors,
    judge,
)
from shared.shape.gauss_newton import ShapeSettings
from stages.inverse_render import STAGE

CAREFUL = AppearanceSettings(resolutions=(8, 16), noise=(0.003, 0.01))


def selected(capture, settings=CAREFUL):
    """Model selection and the record of its candidates."""
    records = []
    selection = ModelSelection(capture, settings, allowed_candidates(settings), records.append)
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
        there = record["part"] in EXISTING or record["candidate"] == "cubemap_16"  # the lamp is narrow
        worthwhile = 0.0 if there else WORTHWHILE[record["part"]]
        beyond, uncertain = record["fall"] - worthwhile * held_out, record["standard_error"]
        assert record["open"] == (abs(beyond) <= uncertain and (record["fall"] > 0.0 or there))
        assert record["accepted"] == (beyond > uncertain or record["open"])
        assert record["seconds"] > 0.0
        held_out = record["held_out"] if record["accepted"] else held_out
    assert held_out == pytest.approx(float(selection.present.errors.mean()))
    assert len(selection.tried) == len(records)  # no model twice


def tried_candidates(monkeypatch, error_of, lamp=True, unresolved=False, uneven=0.0):
    """What is tried, in order, where a model's error is as given for all frames, but for what is uneven about those of
    a fine light; lamp: whether lights have one, and unresolved: one that is too narrow for their texels."""
    monkeypatch.setattr(ModelSelection, "_shows_lamp", lambda self: lamp)
    monkeypatch.setattr(ModelSelection, "_leaves_lamp_unresolved", lambda self: unresolved)
    records, frames = [], np.linspace(0.99, 1.01, 9)
    there = uneven * np.where(np.arange(9) % 2, 1.0, -0.7)
    monkeypatch.setattr(ModelSelection, "_try", lambda self, model, start: Trial(
        model, None, error_of(model) * (frames + there * (model.light in FINE_LIGHTS)), 0.1))
    ModelSelection(None, CAREFUL, allowed_candidates(CAREFUL), records.append).select()
    return [(record["candidate"], record["accepted"]) for record in records[1:]]


def test_harmonics_are_passed_over_once_a_sun_serves(monkeypatch):
    error = {"harmonics_2": 1.0, "sun_sky": 0.8, "harmonics_4": 0.1, "cubemap_8": 0.9, "cubemap_16": 0.9}
    found = tried_candidates(monkeypatch, lambda model: error[model.light])
    assert ("sun_sky", True) in found and "harmonics_4" not in dict(found)
    assert found[1:3] == [("cubemap_8", False), ("cubemap_16", False)]


def test_a_finer_cubemap_is_tried_only_for_the_shape_of_a_lamp(monkeypatch, matte, glossy):
    error = {"harmonics_2": 1.0, "sun_sky": 0.9, "harmonics_4": 0.9, "cubemap_8": 0.8, "cubemap_16": 0.1}
    for lamp in (True, False):
        assert ("cubemap_16" in dict(tried_candidates(monkeypatch, lambda model: error[model.light], lamp))) == lamp
    monkeypatch.undo()
    assert glossy[0]._shows_lamp() and not matte[0]._shows_lamp()
    assert "cubemap_16" in {model.light for model in glossy[0].tried} - {model.light for model in matte[0].tried}


@pytest.mark.parametrize("unresolved", [True, False])
def test_a_lamp_narrower_than_a_cubemap_shows_takes_the_finer_one_where_frames_leave_it_open(monkeypatch, unresolved):
    """A tracked mesh's errors hide by how much the shape of a lamp would serve: here the mean error rises by chance."""
    def error(model):
        return {"harmonics_2": 1.0, "sun_sky": 1.0, "harmonics_4": 0.9}.get(model.light, 0.5)

    found = tried_candidates(monkeypatch, error, unresolved=unresolved, uneven=0.1)
    assert ("cubemap_8", True) in found and ("cubemap_16", unresolved) in found
    worse = tried_candidates(monkeypatch, lambda model: error(model) + 0.1 * (model.light in FINE_LIGHTS),
                             unresolved=unresolved, uneven=0.1)
    assert ("cubemap_16", False) in worse  # for certain


def test_which_lamp_a_cubemap_leaves_unresolved(glossy):
    """A point of light and one that is as wide as a soft box, the same whichever of two lights has it."""
    def leaves(*widths):
        directions, lights = cube_directions(8), []
        for width in widths:
            lamp = np.exp((directions @ directions[100] - 1.0) / width**2)
            lights.append(np.repeat((0.1 + 20.0 * lamp / lamp.max())[:, None], 3, axis=1))
        params, capture = np.log(np.concatenate(lights)), glossy[0].capture
        index = np.arange(len(capture.fitted)) % len(widths)
        model = make_light_model("cubemap", 8, len(widths))
        selection = ModelSelection(replace(capture, light_index=index), CAREFUL, {})
        state = replace(glossy[0].present.solution.state, params=params, light_model=model)
        solution = replace(glossy[0].present.solution, state=state)
        selection.present = Trial(Model("cubemap_8", "none"), solution, np.ones(9), 0.0)
        return selection._leaves_lamp_unresolved()

    assert leaves(0.08) and not leaves(0.4)
    assert leaves(0.4, 0.08) and leaves(0.08, 0.4) and not leaves(0.4, 0.4)


@pytest.mark.parametrize("saved", [-0.001, 0.001])
def test_highlights_need_not_be_worth_more_than_nothing(monkeypatch, saved):
    found = tried_candidates(monkeypatch, lambda model: 1.0 - saved * (model.specular == "one_value"))
    assert ("one_value", saved > 0.0) in found


def test_the_fall_is_paired_by_frame():
    """Frames differ by far more than the models do: only the differences count."""
    rng = np.random.default_rng(0)
    frames = rng.uniform(0.01, 0.05, 12)
    better = frames - 0.001 + 0.0004 * rng.normal(size=12)
    fall, standard_error = gain(frames, better)
    assert fall == pytest.approx(0.001, abs=0.0003) and standard_error < 0.0003 < frames.std()
    assert judge(frames, better, 0.0) is Decision.SERVES
    assert judge(better, frames, 0.0) is Decision.DOES_NOT


def test_what_the_standard_error_leaves_open_takes_the_fuller_model():
    frames = np.full(9, 0.02)
    after = frames - 0.001
    after[0] += 0.012  # one frame loses what the others gain, and more
    assert abs(gain(frames, after)[0]) < gain(frames, after)[1]
    assert judge(after, frames, 0.005) is Decision.OPEN
    assert judge(frames, after, 0.005) is Decision.DOES_NOT  # as uncertain, but if anything worse
    assert judge(frames, after, 0.0, exists=True) is Decision.OPEN
    assert judge(frames, frames + 0.001, 0.0, exists=True) is Decision.DOES_NOT  # worse for certain
    assert Decision.OPEN.accepted and not Decision.DOES_NOT.accepted
    assert judge(frames, frames - 0.00002, 0.005) is Decision.DOES_NOT  # all frames gain, but next to nothing


def test_frames_that_tell_nothing_leave_it_to_the_prior_on_skin(glossy):
    """As where the camera moves about a still head: shading fits as well as albedo."""
    selection, _ = glossy
    capture, solution = selection.capture, selection.present.solution

    def errors_with(skin_prior):
        last = solution.iterations[-1] | {"skin_prior": skin_prior}
        changed = replace(solution, iterations=(last,), fitted=last["fitted"], held_out=last["held_out"])
        return joint_errors(capture, changed, CAREFUL.independent)

    plain, count = solution.frame_errors[~capture.fitted], (~capture.fitted).mean() * CAREFUL.independent
    assert errors_with(100.0) == pytest.approx(plain * (1.0 + 200.0 / count) ** 0.5)
    assert judge(errors_with(100.0), errors_with(50.0), WORTHWHILE["specular"]) is Decision.SERVES
    assert judge(errors_with(50.0), errors_with(100.0), WORTHWHILE["specular"]) is Decision.DOES_NOT


def test_settings_bound_model_selection_and_force_its_candidates():
    free = allowed_candidates(AppearanceSettings())
    assert free["specular"] == ("none", "one_value")
    assert free["light"][0] == "harmonics_2" and free["light"][-1] == "cubemap_16"
    assert allowed_candidates(AppearanceSettings(specular=False))["specular"] == ("none",)
    assert allowed_candidates(AppearanceSettings(resolutions=(4,)))["light"][-2:] == ("harmonics_4", "cubemap")
    assert allowed_candidates(AppearanceSettings(light_model="sun_sky"))["light"] == ("sun_sky",)
    assert allowed_candidates(AppearanceSettings(), frozenset({"light", "specular"})) == free | {
        "light": ("cubemap_16",), "specular": ("one_value",)}


def test_a_model_becomes_the_solvers_settings():
    settings = Model("harmonics_4", "none").applied(AppearanceSettings(bounce=False))
    assert settings.visibility and not settings.bounce and not settings.specular
    assert (settings.light_model, settings.resolutions) == ("harmonics_4", (8,))
    camera = Model("camera", "one_value").applied(AppearanceSettings(light_model="camera"))
    assert (camera.light_model, camera.resolutions) == ("camera", (16,)) and camera.specular
    coarse = Model("cubemap", "none").applied(AppearanceSettings(resolutions=(4,)))
    assert (coarse.light_model, coarse.resolutions) == ("cubemap", (4,))


@pytest.fixture
def select_on(monkeypatch):
    """select_on(capture, note, **settings): what is chosen on a capture, and the settings that it is chosen from."""

    def selected_on(capture, note=lambda text: None, **changes):
        def lit_of(surface, views, settings, chart, context):
            few = capture.some_points(settings.sizes.points)
            return LitSurface(None, None, None, few, few.some_points(settings.appearance.coarse_points))

        monkeypatch.setattr(model_selection.LitSurface, "of", lit_of)
        monkeypatch.setattr(model_selection, "some_views", lambda views, settings, wanted: views)
        monkeypatch.setattr(model_selection, "fitting_map_size", lambda surface, views, most: most // 2)
        appearance = AppearanceSettings(resolutions=(8,), specular=False, noise=(0.003, 0.01))
        whole = InverseSettings(appearance=appearance, selection=frozenset(), shape=ShapeSettings(subdivisions=1))
        whole = replace(whole, **changes)
        return select(None, None, whole, None, RunContext(note=note)), whole

    return selected_on


def test_mesh_and_poses_are_left_to_the_same_steps_as_under_the_full_model(one_thread, select_on):
    notes = []
    chosen, whole = select_on(make_truth(specular=0.0, lights=(even_light,))[0], notes.append)
    kept = {name: getattr(whole, name) for name in ("appearance", "light_frames", "sizes", "map_size")}
    assert replace(chosen.settings, **kept) == whole
    assert chosen.settings.appearance.light_model == "harmonics_2" and 0.0 < chosen.solution.held_out < 1.5 * NOISE
    assert chosen.settings.light_frames < whole.light_frames and chosen.settings.map_size == whole.map_size // 2
    assert chosen.settings.sizes.directions < whole.sizes.directions
    assert "not accepted" in notes[len(chosen.candidates) - 1]
    enough = f"{chosen.settings.light_frames} frames, {chosen.settings.sizes.points} points, "
    assert notes[len(chosen.candidates)].startswith("model selection: " + enough)


def test_parts_that_are_fixed_stay_as_the_settings_say(one_thread, select_on):
    fixed = frozenset({"light", "samples", "maps"})
    chosen, whole = select_on(make_truth(specular=0.0, lights=(even_light,))[0], selection=fixed)
    assert chosen.settings == whole and len(chosen.candidates) == 1


def test_a_decision_that_stays_open_says_so(one_thread, monkeypatch, select_on):
    notes, frames = [], np.full(9, 0.02)
    uneven = np.where(np.arange(9) % 2, 0.0205, 0.019)
    monkeypatch.setattr(ModelSelection, "_try", lambda self, model, start: Trial(
        model, start, frames if model.light == "harmonics_2" else uneven, 0.1))
    monkeypatch.setattr(model_selection, "fit_appearance", lambda *_, start: start)
    chosen, _ = select_on(make_truth(specular=0.0)[0], notes.append, selection=frozenset({"samples"}))
    assert chosen.candidates[1]["open"] and chosen.candidates[1]["accepted"]
    assert "accepted, where held-out frames leave it open" in notes[1]


def test_too_few_held_out_frames_choose_no_model(select_on):
    """Where those that are fitted are few, they are not held out to judge."""
    notes, capture = [], make_truth(specular=0.0)[0]
    assert select_on(replace(capture, fitted=np.arange(14) > 1), notes.append, fit_frames=12)[0] is None
    assert "2 frames are too few" in notes[0]


def test_more_frames_judge_than_are_held_out_of_the_solve():
    capture = make_truth(specular=0.0)[0]
    judged = judged_capture(capture, InverseSettings())
    assert judged.points is capture.points and not judged.fitted[~capture.fitted].any()
    assert (~judged.fitted).sum() > (~capture.fitted).sum()
    assert (judged_capture(capture, InverseSettings(fit_frames=12)).fitted == capture.fitted).all()


def told(**changes):
    """A stage's parameters with some changed."""
    return Parameters({**STAGE.defaults(), **STAGE.parse(changes, "test")})


def test_the_stage_selects_unless_told_not_to():
    assert read_settings(told()).selection == frozenset()
    assert read_settings(told(model="full")).selection is None
    assert read_settings(told(fixed_parts="light, maps")).selection == {"light", "maps"}


def test_forcing_what_there_is_not_is_one_clear_line():
    with pytest.raises(InputError, match="unknown part of the model 'ligth'.*did you mean light"):
        read_forced("ligth")


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
