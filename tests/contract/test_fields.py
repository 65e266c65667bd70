"""What JSON and NPZ files hold: the rule itself, and the files of a run against the declarations."""

import json

import numpy as np
import pytest
from field_check import below, field_faults, written_fields

from shared.contract.declare import Field
from shared.contract.pipeline import load_pipeline
from shared.contract.records import MANIFEST, PROVENANCE
from tools.documents.readme import README

FIELDS = (
    Field("name", "Name.", "text"),
    Field("crop.x0", "Edge.", "int"),
    Field("frames", "Frames.", ""),
    Field("frames[].time", "Time."),
    Field("frames[].box", "Box.", shape="4", optional=True),
    Field("chart", "Chart.", "", optional=True),
    Field("chart.white", "White.", shape="3"),
    Field("parts.<part>.good", "Good.", "bool"),
    Field("rest.**", "All else.", ""),
)
CONTENT = {"name": "a", "crop": {"x0": 3}, "frames": [{"time": 0.5, "box": [1, 2, 3, 4]}, {"time": 1}],
           "parts": {"lips": {"good": True}}, "rest": {"any": [{"thing": None}]}}


def test_what_is_declared_is_well():
    assert field_faults(CONTENT, FIELDS) == []
    assert field_faults(CONTENT | {"chart": {"white": [1, 1, 1.5]}, "frames": []}, FIELDS) == []


@pytest.mark.parametrize("change, fault", [
    ({"extra": 1}, "extra: not declared"),
    ({"crop": {}}, "crop.x0: not written"),
    ({"crop": {"x0": 1.5}}, "crop.x0: is not int"),
    ({"crop": {"x0": True}}, "crop.x0: is not int"),
    ({"crop": 3}, "crop: holds no entries by name"),
    ({"name": None}, "name: is not text"),
    ({"name": {"first": "a"}}, "name: is not text"),
    ({"frames": [{"time": 1, "mask": "a"}]}, "frames[0].mask: not declared"),
    ({"frames": [{"box": [1, 2, 3, 4]}]}, "frames[0].time: not written"),
    ({"frames": {"time": 1}}, "frames: not a list"),
    ({"frames": [{"time": 1, "box": [1, 2, 3]}]}, "frames[0].box: has shape [3], declared is [4]"),
    ({"chart": {}}, "chart.white: not written"),
    ({"parts": {"lips": {}}}, "parts.lips.good: not written"),
])
def test_what_differs_is_named(change, fault):
    assert field_faults(CONTENT | change, FIELDS) == [fault]


def test_arrays_have_their_type_and_sizes_that_agree():
    fields = Field("poses", "Poses.", "float64", "F, 4, 4"), Field("frame_index", "Frames.", "int64", "F")
    arrays = {"poses": np.zeros((5, 4, 4)), "frame_index": np.arange(5)}
    assert field_faults(arrays, fields) == []
    assert field_faults(arrays | {"frame_index": np.arange(6)}, fields) == [
        "frame_index: has shape [6], declared is [F]"]
    assert field_faults(arrays | {"poses": np.zeros((5, 3, 4))}, fields) == [
        "poses: has shape [5, 3, 4], declared is [F, 4, 4]"]
    assert field_faults(arrays | {"poses": np.zeros((5, 4, 4), np.float32)}, fields) == [
        "poses: is float32, declared is float64"]


def test_written_fields_are_those_that_hold_a_value():
    written = written_fields(CONTENT, FIELDS)
    assert {field.path for field in FIELDS} - written == {"chart", "chart.white"}
    assert written_fields(CONTENT | {"frames": []}, FIELDS).isdisjoint({"frames[].time", "frames[].box"})


def test_fields_below_a_path_and_fields_declared_twice():
    assert [field.path for field in below(FIELDS, "frames[]")] == ["time", "box"]
    with pytest.raises(ValueError, match="no field"):
        below(FIELDS, "frame")
    with pytest.raises(ValueError, match="twice"):
        field_faults({}, FIELDS[:1] * 2)


ELSEWHERE = {
    "test_sample_frames": {"frames.json: dropped[].frame_index", "frames.json: dropped[].reason"},
    "test_track_quality": {"tracking.json: excluded[].frame_index", "tracking.json: excluded[].reason"},
    "test_chart": {"frames.json: chart[]."},
    "test_chart_scale": {"albedo_scale.chart"},
    "test_grey_watch": {"frames.json: grey"},
    "test_light_tint": {"albedo_scale.grey"},
    "test_exposure": {"solve.json: exposure", "poses.npz: gain"},
    "test_eye_whites": {"albedo_scale.whites"},
    "test_joint_clips": {"solve.json: clips", "run.json: clips", "clips/*/poses.npz: ", "iterations[].light_weights"},
    "test_model_selection": {"solve.json: model_selection", "run.json: model_selection",
                             "model_selection_seconds.json: []"},
    "test_published": {f"solve.json: iterations[].{name}" for name in (
        "iteration", "image", "mask", "laplacian", "white_light", "diffuse", "roughness_variation")},
    "test_fit_appearance": {"iterations[].undone"},
    "test_refine_shape": {"solve.json: shape.fitted"},
    "test_lamp_distance": {"solve.json: lamp", "run.json: lamp"},
    "test_joined": {"hair.npz: "},
    "test_hair_surface": {"solve.json: hair", "run.json: hair"},
    "test_export_eyes": {"poses.npz: gaze", "poses.npz: eye_turn"},
}
"""Tests that compare what the tiny run has no occasion to write."""


def test_the_tests_named_here_compare_fields():
    files = {path.stem: path for path in (README.parent / "tests").rglob("test_*.py")}
    assert [name for name in ELSEWHERE if "field_faults(" not in files[name].read_text(encoding="utf-8")] == []


def read(path):
    if path.suffix == ".json":
        return json.loads(path.read_text(encoding="utf-8"))
    with np.load(path) as arrays:
        return dict(arrays)


@pytest.fixture(scope="module")
def compared(tiny_run):
    """[(file, fault)] of the run, and {file: field} of all that is declared and not written."""
    faults, missing = [], set()
    for stage in load_pipeline().stages.values():
        folder = tiny_run / stage.folder
        files = [path for path in sorted(folder.rglob("*")) if path.suffix in (".json", ".npz")]
        files = {path.relative_to(folder).as_posix(): path for path in files}
        for name, fields in (("manifest.json", MANIFEST), ("provenance.json", PROVENANCE)):
            faults += [(f"{stage.folder}/{name}", fault) for fault in field_faults(read(files.pop(name)), fields)]
        written = {}
        for name, path in files.items():
            output = stage.output_of(name)
            faults += [(f"{stage.folder}/{name}", fault) for fault in field_faults(read(path), output.fields)]
            written[output.path] = written_fields(read(path), output.fields)
        for output in stage.outputs:
            absent = {field.path for field in output.fields} - written.get(output.path, set())
            missing |= {f"{output.path}: {path}" for path in absent}
    return faults, missing


def test_the_files_of_a_run_hold_what_is_declared(compared):
    assert compared[0] == []


def test_what_is_declared_is_written_somewhere(compared):
    expected = [part for parts in ELSEWHERE.values() for part in parts]
    assert sorted(name for name in compared[1] if not any(part in name for part in expected)) == []
    assert [part for part in expected if not any(part in name for name in compared[1])] == [], "written after all"
