"""`limn run --until STAGE`: that stage and what it needs, nothing else, and the rest later."""

import json

import pytest
from toy_runs import limn, make_subject, outputs_of, tree

from tools.limn import main

CLIPS = "clips:\n  sun: {video: clip.txt}\n  lamp: {video: lamp.txt}\n"


def stages_of(folder):
    """The stages that have published a result."""
    return {path.parent.name for path in folder.rglob("manifest.json")}


def test_stops_after_the_stage_and_goes_on_later(pipeline, tmp_path):
    subject, whole = make_subject(tmp_path / "anna"), make_subject(tmp_path / "bert")
    code, output = limn("run", subject, "--pipeline", pipeline, "--until", "count_words")
    assert code == 0 and stages_of(subject) == {"read_text", "count_words"}
    assert output.rstrip().endswith(str(subject / "work" / "count_words"))
    assert "nothing to do" in limn("run", subject, "--pipeline", pipeline, "--until", "count_words")[1]
    code, output = limn("run", subject, "--pipeline", pipeline)
    assert code == 0 and "count_words   done" not in output and stages_of(subject) >= {"draw_bars", "export"}
    assert limn("run", whole, "--pipeline", pipeline)[0] == 0
    kept = [name for name in outputs_of(whole) if not name.endswith("manifest.json")]
    assert {name: outputs_of(subject)[name] for name in kept} == {name: outputs_of(whole)[name] for name in kept}


def test_only_what_the_stage_needs(pipeline, tmp_path, capsys):
    text = pipeline.read_text().replace("draw_bars: {needs: [count_words]", "draw_bars: {needs: [read_text]")
    pipeline.write_text(text)
    bars = pipeline.parent / "toy" / "draw_bars.py"
    bars.write_text(bars.read_text().replace('inputs=("count_words",)', 'inputs=("read_text",)'))
    subject = make_subject(tmp_path / "anna")
    assert main(["plan", str(subject), "--pipeline", str(pipeline), "--until", "draw_bars"]) == 0
    planned = capsys.readouterr().out
    assert "read_text" in planned and "draw_bars" in planned
    assert "count_words" not in planned and "export_page" not in planned


def test_each_clip_stops_there(pipeline, tmp_path):
    subject = make_subject(tmp_path / "anna", settings=CLIPS)
    (subject / "lamp.txt").write_text("a lamp\n")
    code, output = limn("run", subject, "--pipeline", pipeline, "--until", "read_text")
    clips = subject / "work" / "clips"
    assert code == 0 and output.rstrip().endswith(str(subject)) and stages_of(subject) == {"read_text"}
    assert stages_of(clips / "sun") == stages_of(clips / "lamp") == {"read_text"}
    assert limn("run", subject, "--pipeline", pipeline)[0] == 0 and (subject / "export" / "page.txt").is_file()


def test_gates_judge_whole_results_only(pipeline, tmp_path, monkeypatch):
    from tools.cli import gates

    subject, summary = make_subject(tmp_path / "anna"), tmp_path / "all.json"
    pipeline.write_text(pipeline.read_text() + "gates: {coverage: {least: 0.6}}\n")
    monkeypatch.setitem(gates.MEASURES, "coverage", lambda run: 0.25)
    monkeypatch.setattr("tools.cli.review_picture.write_review", lambda *arguments: None)
    arguments = ["run", str(subject), "--pipeline", str(pipeline), "--summary", str(summary)]
    assert main([*arguments, "--until", "draw_bars"]) == 0
    record = json.loads(summary.read_text())["subjects"][0]
    assert (record["state"], record["stage"], record["flags"]) == ("done", "draw_bars", [])
    assert main(arguments) == 3


@pytest.mark.parametrize("command", ["run", "plan"])
def test_unknown_stage_is_one_line(pipeline, tmp_path, capsys, command):
    subject = make_subject(tmp_path / "anna")
    assert main([command, str(subject), "--pipeline", str(pipeline), "--until", "count_wrods"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "--until" in error and "did you mean count_words?" in error
    assert tree(subject) == ["clip.txt", "subject.yaml"]


def test_a_failure_before_it_is_told_as_ever(pipeline, tmp_path):
    subject = make_subject(tmp_path / "anna", "no face in here\n")
    code, output = limn("run", subject, "--pipeline", pipeline, "--until", "draw_bars")
    assert code == 2 and "no face in the clip" in output and "not run: count_words, draw_bars" in output
    assert "export_page" not in output
