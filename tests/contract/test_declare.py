"""What is declared and read: values of parameters, stage files, pipeline.yaml, subject.yaml."""

import pytest
from toy_runs import READ_TEXT, copy_pipeline, make_subject

from shared.contract import Output, Parameter, Stage, load_subject
from shared.contract.chart_place import AUTO
from shared.contract.cli import make_parser
from shared.contract.declare import parameter_table
from shared.contract.folders import RunFolder
from shared.contract.hashing import HashMemory
from shared.contract.manifest import source_inputs
from shared.contract.pipeline import load_pipeline, split_settings
from shared.contract.source import fingerprint, read_declaration
from shared.errors import InputError, LimnError
from stages import inverse_render
from tools.limn import main


@pytest.mark.parametrize("name, value, parsed", [
    ("size", "20", 20), ("size", 20.0, 20), ("size", "2e1", 20), ("limit", "1e-3", 1e-3), ("limit", 2, 2.0),
    ("limit", "none", None), ("limit", None, None), ("fast", "yes", True), ("fast", False, False)])
def test_values_are_typed(name, value, parsed):
    result = READ_TEXT.parse({name: value}, "here")[name]
    assert result == parsed and type(result) is type(parsed)


@pytest.mark.parametrize("name, value, hint", [
    ("size", 0, "1 .. 100 texels"), ("size", 101, "1 .. 100"), ("size", "1.5", "whole number"), ("size", True, "whole"),
    ("size", None, "whole number"), ("size", "nan", "whole"), ("limit", "inf", "a number >= 0 mm"),
    ("limit", [1], "number"), ("letters", "loud", "one of lower, upper"), ("fast", "perhaps", "true or false"), 
    ("sise", 1, "read_text.size?"), ("seed", 1, "leave it out")])
def test_bad_values_say_what_is_allowed(name, value, hint):
    with pytest.raises(InputError, match=name) as error:
        READ_TEXT.parse({name: value}, "here")
    assert hint in str(error.value) and "\n" not in str(error.value)


def test_a_former_name_is_refused_with_the_new_one(tmp_path, capsys):
    """Nobody's settings change their meaning in silence: neither on a command line nor in pipeline.yaml."""
    with pytest.raises(InputError) as error:
        inverse_render.STAGE.parse({"evidence": "5000"}, "--set")
    assert str(error.value) == ("--set: parameter inverse_render.evidence has another name now; "
                                "write inverse_render.independent_samples")
    assert inverse_render.STAGE.parse({"independent_samples": "5000"}, "--set") == {"independent_samples": 5000.0}
    assert main(["run", str(tmp_path), "--set", "sample_frames.blurred_below=0"]) == 2
    line = capsys.readouterr().err
    assert "write sample_frames.min_sharpness" in line and line.count("\n") == 1


@pytest.mark.parametrize("name, line", [
    ("seed", "parameter inverse_render.seed has another name now; write inverse_render.reference_seed"),
    ("reference_device", "parameter inverse_render.reference_device is no more; leave it out: the published solver "
     "computes on the processor")])
def test_a_parameter_that_is_no_more_is_refused_with_what_to_do(name, line):
    with pytest.raises(InputError) as error:
        inverse_render.STAGE.parse({name: "1"}, "--set")
    assert str(error.value) == f"--set: {line}"


def test_a_former_name_is_no_other_parameter_s():
    size = Parameter("size", int, 1, "Size.")
    output = Output("words.txt", "Words.")
    with pytest.raises(ValueError, match="unique parameters"):
        Stage("read_text", 1, "Reads.", (), (output,), (size, Parameter("edge", int, 1, "Edge.", former="size")))


def test_bad_default_is_refused():
    with pytest.raises(InputError):
        Parameter("size", int, 0, "Size.", minimum=1)


def test_table_lists_every_parameter():
    rows = parameter_table({"read_text": READ_TEXT.parameters}).splitlines()
    assert len(rows) == 2 + len(READ_TEXT.parameters)
    assert "| read_text | `size` | `10` | 1 .. 100 | texels | Size. |" in rows


def test_groups_are_listed_when_they_are_asked_for(capsys):
    """The default's lists end with one line that says how; each parameter stands in one list."""
    stage, (group,) = inverse_render.STAGE, inverse_render.STAGE.groups
    assert (*stage.common, *group.parameters) == stage.parameters and len(group.parameters) == 18
    assert stage.parse({"reference_pixels": 9}, "--set") == {"reference_pixels": 9}
    assert main(["parameters"]) == 0
    listed = capsys.readouterr().out
    assert "| inverse_render | `map_size` |" in listed and "reference_" not in listed
    assert listed.endswith("limn parameters --group published\n")
    assert main(["parameters", "--group", "published"]) == 0
    rows = capsys.readouterr().out.splitlines()
    assert len(rows) == 2 + 18 and all("| inverse_render | `reference_" in row for row in rows[2:])
    assert main(["parameters", "--group", "publishd"]) == 2 and "did you mean published?" in capsys.readouterr().err
    for option, inside, outside in (("", "map_size", "reference_"), ("-published", "reference_", "map_size")):
        with pytest.raises(SystemExit) as done:
            make_parser(stage).parse_args([f"--help{option}"])
        told = capsys.readouterr().out
        assert done.value.code == 0 and f"\n  {inside}" in told and f"\n  {outside}" not in told
    assert "--help-published" in make_parser(stage).format_help()


def test_subject_facts(tmp_path):
    folder = make_subject(tmp_path / "eve", settings="video: f/%03d.png\ncamera: {focal_length_mm: 60, "
                          "sensor_width_mm: 22.3}\ncolour: {transfer: bt709}\ncapture: {moves: camera}\n")
    (folder / "f").mkdir()
    for name in ("010.png", "009.png", "cover.png", "011.jpg"):
        (folder / "f" / name).write_bytes(b"x")
    subject = load_subject(folder)
    assert [path.name for path in subject.video_files()] == ["009.png", "010.png"]
    assert (subject.name, subject.focal_length_mm, subject.sensor_width_mm) == ("eve", 60.0, 22.3)
    assert (subject.focal_length_px, subject.transfer, subject.moves) == (None, "bt709", "camera")


def test_a_pupil_distance_is_a_fact_of_the_subject_and_of_each_of_its_clips(tmp_path):
    bare = load_subject(make_subject(tmp_path / "eve"))
    known = load_subject(make_subject(tmp_path / "ada", settings="video: clip.txt\nhead: {pupil_distance_mm: 63}\n"))
    assert bare.pupil_distance_mm is None and "pupil_distance_mm" not in bare.content()
    assert known.content() == bare.content() | {"pupil_distance_mm": 63.0}


def test_subject_names_files_of_another_tracker(tmp_path):
    folder = make_subject(tmp_path / "eve")
    bare = load_subject(folder)
    assert (bare.landmarks, bare.poses, bare.hold_poses) == (None, None, False)
    (folder / "mine").mkdir()
    (folder / "mine" / "poses.npz").write_bytes(b"x")
    (folder / "subject.yaml").write_text("video: clip.txt\ntracking: {poses: mine/poses.npz, hold_poses: true}\n")
    given = load_subject(folder)
    assert (given.landmarks, given.poses, given.hold_poses) == (None, folder / "mine/poses.npz", True)
    assert given.content() == bare.content()


def test_files_of_another_tracker_are_inputs_of_the_stage_that_reads_them(tmp_path):
    folder = make_subject(tmp_path / "eve", settings="video: clip.txt\n")
    outputs = (Output("text.txt", "the text"),)
    reads = Stage("track", 1, "Tracks.", ("read_text",), outputs, given=("landmarks", "poses"))
    other = Stage("draw", 1, "Draws.", ("read_text",), outputs)

    def inputs(stage, poses=b"poses", tracking="poses: p.npz"):
        (folder / "p.npz").write_bytes(poses)
        (folder / "q.npz").write_bytes(b"poses")
        (folder / "subject.yaml").write_text(f"video: clip.txt\ntracking: {{{tracking}}}\n")
        return source_inputs(stage, load_subject(folder), HashMemory(tmp_path / "hashes.json"))

    assert set(inputs(reads)) == {"subject.yaml", "poses"}
    assert set(inputs(reads, tracking="poses: p.npz, landmarks: q.npz")) == {"subject.yaml", "poses", "landmarks"}
    assert set(inputs(reads, tracking="")) == {"subject.yaml"}
    assert inputs(reads) == inputs(reads, tracking="poses: q.npz")  # content, not name
    held = "poses: p.npz, hold_poses: true"
    keys = [inputs(reads)["poses"], inputs(reads, b"others")["poses"], inputs(reads, tracking=held)["poses"]]
    assert len(set(keys)) == 3
    for tracking in ("", "landmarks: q.npz", held):
        assert inputs(other, b"others", tracking) == inputs(other)


def test_where_a_chart_is_matters_to_the_stage_that_reads_the_clip_alone(tmp_path):
    folder = make_subject(tmp_path / "eve", settings="video: clip.txt\n")
    outputs = (Output("text.txt", "the text"),)
    first, later = Stage("sample", 1, "Samples.", (), outputs), Stage("track", 1, "Tracks.", ("sample",), outputs)

    def inputs(stage, chart):
        (folder / "subject.yaml").write_text(f"video: clip.txt\nchart: {chart}\n")
        return source_inputs(stage, load_subject(folder), HashMemory(tmp_path / "hashes.json"))

    place = "{frame: 3, corners: [[0, 0], [9, 0], [9, 6], [0, 6]]}"
    assert load_subject(folder).chart == AUTO
    assert set(inputs(first, "auto")) == {"subject.yaml", "video"} == set(inputs(first, "true"))
    assert set(inputs(first, "off")) == {"subject.yaml", "video", "chart"}
    assert inputs(first, place)["chart"] not in (inputs(first, "off")["chart"], inputs(first, place.replace("3", "4")))
    assert load_subject(folder).chart.corners == ((0.0, 0.0), (9.0, 0.0), (9.0, 6.0), (0.0, 6.0))
    assert inputs(later, place) == inputs(later, "auto")


def test_where_a_grey_place_is_matters_to_the_stage_that_reads_the_clip_alone(tmp_path):
    folder = make_subject(tmp_path / "eve", settings="video: clip.txt\n")
    outputs = (Output("text.txt", "the text"),)
    first, later = Stage("sample", 1, "Samples.", (), outputs), Stage("track", 1, "Tracks.", ("sample",), outputs)

    def inputs(stage, line):
        (folder / "subject.yaml").write_text(f"video: clip.txt\n{line}\n")
        return source_inputs(stage, load_subject(folder), HashMemory(tmp_path / "hashes.json"))

    assert load_subject(folder).grey is None and set(inputs(first, "")) == {"subject.yaml", "video"}
    named = inputs(first, "grey: [9, 6.5]")
    assert load_subject(folder).grey == (9.0, 6.5)
    assert set(named) == {"subject.yaml", "video", "grey"} and named.items() > inputs(first, "").items()
    assert named["grey"] != inputs(first, "grey: [9, 6]")["grey"]
    assert inputs(first, "grey: [9, 6]") == inputs(first, "grey: [9.0, 6.0]")
    assert inputs(later, "grey: [9, 6.5]") == inputs(later, "")


def test_declaration_is_read_without_the_stage_s_imports(tmp_path):
    source = ("import no_such_package\nfrom shared.contract import Stage, Output\nSIZES = (1, 2)\nLAST = SIZES[-1]\n"
              "STAGE = Stage('draw', LAST, 'Draws.', (), (Output('a', 'b'),))\nX = no_such_package.thing()\n")
    path = tmp_path / "draw.py"
    path.write_text(source)
    assert read_declaration(path).version == 2
    path.write_text(source.replace("LAST,", "no_such_package.n,"))
    with pytest.raises(LimnError, match="no_such_package"):
        read_declaration(path)
    with pytest.raises(InputError, match="no such stage"):
        read_declaration(tmp_path / "gone.py")


def test_fingerprint_ignores_what_does_not_run(tmp_path):
    first, second, third = (tmp_path / f"{name}.py" for name in "abc")
    first.write_text('"""Doc."""\ndef f(x):\n    """Old."""\n    return x + 1\n')
    second.write_text('"""Other."""\n\n\ndef f(x):\n    # why\n    """New."""\n    return (x + 1)\n')
    third.write_text("def f(x):\n    return x + 2\n")
    assert fingerprint(first) == fingerprint(second) != fingerprint(third)


@pytest.mark.parametrize("old, new, hint", [
    ("stages:", "stagse:", "did you mean stages?"),
    ("needs: [read_text]}", "need: [read_text]}", "did you mean needs?"),
    ("[count_words]", "[count_word]", "did you mean count_words?"),
    ("draw_bars: {width", "draw_bar: {width", "did you mean draw_bars?"),
    ("width: 4", "widht: 4", "did you mean draw_bars.width?"), ("width: 4", "width: 900", "1 .. 80 letters"),
    ("needs: []", "needs: [export_page]", "in a circle"), ("needs: [read_text]", "needs: []", "needs differ"),
    ("default_preset: standard", "default_preset: draught", "did you mean draft?"),
    ("threads: 1", "threads: 0", "cores"),
    ("package: toy", "package: toys", "no such stage")])
def test_bad_pipeline_is_one_line(tmp_path, old, new, hint):
    path = copy_pipeline(tmp_path / "toy")
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(InputError) as error:
        load_pipeline(path).check()
    assert hint in str(error.value) and "pipeline.yaml" in str(error.value) or "toys" in str(error.value)


def test_parameters_come_from_defaults_step_preset_and_call(tmp_path):
    path = copy_pipeline(tmp_path / "toy")
    path.write_text(path.read_text().replace("{needs: [read_text]}", "{needs: [read_text], parameters: {least: 2}}"))
    pipeline = load_pipeline(path)
    stage, bars = pipeline.stages["count_words"], pipeline.stages["draw_bars"]
    assert pipeline.parameters(stage, None, {})["least"] == 2
    assert pipeline.parameters(stage, None, {"least": "3"})["least"] == 3
    assert [pipeline.parameters(bars, preset, {})["width"] for preset in (None, "draft")] == [10, 4]


def test_the_real_pipeline_is_sound():
    pipeline = load_pipeline()
    pipeline.check()
    assert set(pipeline.presets) == {"draft", "standard", "fine", "reference"}
    assert pipeline.default_preset == "standard"


@pytest.mark.parametrize("text", ["a", "a=1", "b.x=1", "a.=1"])
def test_settings_need_a_stage_and_a_key(text):
    with pytest.raises(InputError):
        split_settings([text], ["a"])
    assert split_settings(["a.x=y=z", "a.v= 1 "], ["a"]) == {"a": {"x": "y=z", "v": "1"}}


def test_run_folder_with_out(tmp_path):
    assert RunFolder.of(tmp_path / "anna", "anna", None).root == tmp_path / "anna"
    assert RunFolder.of(tmp_path / "anna", "anna", tmp_path / "o").published("export_usd") == tmp_path / "o/anna/export"
