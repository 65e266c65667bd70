"""limn on the toy pipeline: what runs again and what does not, kills, failures, plan, clean, new."""

import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from toy_runs import REPOSITORY, copy_pipeline, limn, limn_process, make_subject, outputs_of, tree, wait_for

from tools.cli.engine import interrupted_later
from tools.limn import main


@pytest.fixture
def subject(tmp_path):
    return make_subject(tmp_path / "anna")


@pytest.fixture
def states(pipeline, subject, capsys):
    """states(*arguments) -> {stage: (state, reasons)} as limn plan prints them."""
    def ask(*arguments):
        assert main(["plan", str(subject), "--pipeline", str(pipeline), *arguments]) == 0
        lines = capsys.readouterr().out.splitlines()[1:]
        rows = [line.split(None, 1) for line in lines]
        kinds = ("current", "will run", "may run")
        return {name: next((kind, rest[len(kind):].strip()) for kind in kinds if rest.startswith(kind))
                for name, rest in rows}

    return ask


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """{file: bytes} that an undisturbed run publishes, computed stage by stage without the workflow."""
    folder = tmp_path_factory.mktemp("reference")
    pipeline, subject = copy_pipeline(folder / "toy"), make_subject(folder / "anna")
    for name in ("read_text", "count_words", "draw_bars", "export_page"):
        command = [sys.executable, "-m", f"toy.{name}", "--subject", subject, "--pipeline", pipeline]
        path = os.pathsep.join([str(pipeline.parent), str(REPOSITORY)])
        subprocess.run(command, env={**os.environ, "PYTHONPATH": path}, check=True, capture_output=True)
    return outputs_of(subject)


def is_alive(pid):
    try:
        return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except FileNotFoundError:
        return False


def edit(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_only_what_changed_runs_again(pipeline, subject, states, toy_run):
    assert states() == {name: ("will run", "never ran")
                        for name in ("read_text", "count_words", "draw_bars", "export_page")}
    made, code, output = toy_run
    assert code == 0 and output.count(" done in ") == 5 and str(made / "export" / "report.html") in output
    shutil.copytree(made, subject, dirs_exist_ok=True, copy_function=shutil.copyfile)
    first = outputs_of(subject)

    code, output = limn("run", subject, "--pipeline", pipeline, TOY_PID=str(subject.parent / "pid"))
    assert code == 0 and "nothing to do" in output and " done in " not in output
    assert not (subject.parent / "pid").exists()  # count_words was not started to find that out

    for name in ("clip.txt", "subject.yaml", "work/read_text/text.txt"):
        (subject / name).touch()
    edit(pipeline.parent / "toy" / "draw_bars.py", "def run", "# A remark.\ndef run")
    edit(pipeline.parent / "toy" / "count_words.py", "for word, count in words", "for word, count in  words")
    assert {state for state, _ in states().values()} == {"current"}
    planned = states("--set", "export_page.title=Roses")
    assert planned.pop("export_page") == ("will run", 'parameter title: "Words" -> "Roses"')
    assert [state for state, _ in planned.values()] == ["current"] * 3

    # A changed stage runs; what follows might have changed, and turns out current.
    edit(pipeline.parent / "toy" / "count_words.py", "version=1", "version=2")
    planned = states()
    assert planned["count_words"] == ("will run", "stage version 1 -> 2") and planned["read_text"][0] == "current"
    assert planned["draw_bars"] == ("may run", "if the outputs of count_words change")
    code, output = limn("run", subject, "--pipeline", pipeline)
    lines = {line.split()[1]: line.split(None, 2)[2] for line in output.splitlines() if line.startswith("anna ")}
    assert code == 0 and lines["draw_bars"] == lines["export_page"] == "current" and "read_text" not in lines
    assert lines["count_words"].startswith("done")
    changed = {name for name, data in outputs_of(subject).items() if first[name] != data}
    assert changed == {"work/count_words/manifest.json"}


def test_damage_is_seen_and_mended(pipeline, subject, states, toy_run):
    shutil.copytree(toy_run[0], subject, dirs_exist_ok=True)
    first = outputs_of(subject)
    (subject / "export" / "page.txt").unlink()
    edit(subject / "work" / "count_words" / "words.json", "rose", "nose")
    (subject / "work" / "read_text" / "manifest.json").write_text("{")
    planned = states()
    assert planned["read_text"] == ("will run", "its manifest is missing or damaged")
    assert planned["count_words"] == ("will run", "file words.json is damaged")
    assert planned["draw_bars"][0] == "may run" and planned["export_page"] == ("will run", "file page.txt is missing")
    (subject / "clip.txt").write_text((subject / "clip.txt").read_text())
    assert limn("run", subject, "--pipeline", pipeline)[0] == 0
    assert outputs_of(subject) == first
    (subject / "clip.txt").write_text("another text\n")
    assert states()["read_text"] == ("will run", "input video changed")


@pytest.mark.parametrize("victim", ["limn", "stage"])
def test_killed_in_the_middle(pipeline, subject, tmp_path, reference, victim):
    """Killed while half a result lies in count_words' folder, in a pause that outlasts the test."""
    pid_file = tmp_path / "pid"
    arguments = ("run", subject, "--pipeline", pipeline, "--cores", "1")
    process = limn_process(*arguments, TOY_PID=str(pid_file), TOY_PAUSE_S="300")
    wait_for(lambda: pid_file.is_file() and pid_file.read_text())
    stage = int(pid_file.read_text())
    os.kill(process.pid if victim == "limn" else stage, signal.SIGKILL)
    output, _ = process.communicate(timeout=120)
    wait_for(lambda: not is_alive(stage))
    assert not (subject / "work" / "count_words").exists()
    if victim == "stage":
        assert process.returncode == 1 and "count_words was killed without a message" in output
        assert (subject / "work" / "count_words.failed" / "log.txt").is_file()
    code, output = limn(*arguments)
    assert code == 0 and outputs_of(subject) == reference
    assert not [name for name in tree(subject) if ".tmp-" in name or ".workflow-" in name or name.endswith(".lock")]
    assert not (subject / "work" / "count_words.failed").exists()


def test_interrupted_run_leaves_no_process(pipeline, subject, tmp_path):
    pid_file = tmp_path / "pid"
    process = limn_process("run", subject, "--pipeline", pipeline, "--set", "count_words.pause_s=300",
                           TOY_PID=str(pid_file))
    wait_for(lambda: pid_file.is_file() and pid_file.read_text())
    code, output = limn("run", subject, "--pipeline", pipeline)
    assert code == 2 and "another process works here" in output
    process.send_signal(signal.SIGTERM)
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 1 and "interrupted; limn run again goes on with count_words" in output
    wait_for(lambda: not is_alive(int(pid_file.read_text())))
    assert not [name for name in tree(subject) if ".tmp-" in name or ".workflow-" in name or name.endswith(".lock")]


def test_one_failing_subject_does_not_stop_the_others(pipeline, subject, tmp_path):
    faceless = make_subject(tmp_path / "faceless", "no face in here\n")
    before = tree(faceless)
    code, output = limn("run", faceless, subject, "--pipeline", pipeline, "--set", "count_words.least=2")
    assert code == 2 and (subject / "export" / "page.txt").is_file() and tree(faceless) == before
    lines = [line for line in output.splitlines() if "no face" in line]
    assert len(lines) == 2 and lines[0].endswith("clip.txt: no face in the clip; film a face")
    assert re.match(r"faceless  read_text +input error +0.0 +0 MB  ", lines[1])
    assert re.search(r"anna +export_page +done +0\.\d +\d+ MB$", output, re.M)
    assert output.endswith("2 subjects: 1 done, 1 input error\n")
    assert "faceless: not done; not run: count_words, draw_bars, export_page" in output
    code, output = limn("run", faceless, subject, "--pipeline", pipeline, TOY_FAIL="1")
    assert code == 1 and re.search(r"count_words +failed: ValueError: the abacus broke", output)
    log = subject / "work" / "count_words.failed" / "log.txt"
    assert str(log) in output and "the abacus broke" in log.read_text()
    assert (subject / "work" / "workflow.log").is_file() and tree(faceless) == before


def test_faults_are_told_before_anything_starts(pipeline, subject, tmp_path, capsys):
    other = make_subject(tmp_path / "otto", settings="video: gone.mp4\n")
    (tmp_path / "bare").mkdir()
    before = tree(tmp_path)
    assert main(["run", str(other), str(tmp_path / "bare"), "--pipeline", str(pipeline)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2 and "gone.mp4: no such video" in lines[0] and "no subject.yaml" in lines[1]
    for settings, hint in ((["--set", "draw_bars.widht=3"], "draw_bars.width?"),
                           (["--set", "draw.width=3"], "draw_bars?"),
                           (["--set", "draw_bars.width=99"], "1 .. 80"), (["--preset", "drafd"], "draft?"),
                           (["--cores", "0"], ">= 1"), (["--coers", "1"], "--help")):
        assert main(["run", str(subject), "--pipeline", str(pipeline), *settings]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and hint in error
    assert main(["run", str(subject), str(subject), "--pipeline", str(pipeline)]) == 2
    assert tree(tmp_path) == before


def test_read_only_subject_with_out_then_status_report_clean(pipeline, subject, tmp_path, capsys):
    out, before = tmp_path / "out put", tree(subject)
    code, _ = limn("run", subject, "--pipeline", pipeline, "--out", out, "--preset", "draft")
    assert code == 0 and tree(subject) == before
    common = [str(subject), "--pipeline", str(pipeline), "--out", str(out)]
    assert main(["report", *common, "--preset", "draft"]) == 0
    assert capsys.readouterr().out == f"{out / 'anna' / 'export' / 'report.html'}\n"
    assert main(["report", *common]) == 0 and "not up to date: draw_bars, export_page" in capsys.readouterr().err
    assert main(["status", *common, "--preset", "draft", "--verify"]) == 0
    rows = capsys.readouterr().out.splitlines()
    assert len(rows) == 6 and all("current" in row and " MB " in row for row in rows[2:])
    (out / "anna" / "work" / "notes.txt").write_text("mine")
    assert main(["clean", *common, "--dry-run"]) == 0 and (out / "anna" / "work" / "read_text").is_dir()
    assert main(["clean", *common]) == 0 and "export/ is kept" in capsys.readouterr().out
    assert tree(out / "anna" / "work") == ["notes.txt"] and (out / "anna" / "export" / "page.txt").is_file()
    assert main(["report", str(subject), "--pipeline", str(pipeline)]) == 2


def test_parameters_table(pipeline, capsys):
    assert main(["parameters", "draw_bars", "--pipeline", str(pipeline)]) == 0
    assert "| draw_bars | `width` | `10` | 1 .. 80 | letters | Longest bar. |" in capsys.readouterr().out
    assert main(["parameters", "draw_bar", "--pipeline", str(pipeline)]) == 2


def test_new_subject(tmp_path, capsys):
    import numpy as np

    from shared.contract import load_subject
    from shared.io.images import write_png

    (tmp_path / "shot 1").mkdir()
    for i in (3, 4, 5):
        write_png(tmp_path / "shot 1" / f"a.{i:04d}.png", np.full((48, 64, 3), 40 * i, np.uint8))
    clip = str(tmp_path / "shot 1" / "a.%04d.png")
    lens = ["--focal-length-mm", "60", "--sensor-width-mm", "22.3", "--moves", "camera", "--transfer", "bt709"]
    assert main(["new", clip, "--dest", str(tmp_path / "subjects"), "--link", *lens]) == 0
    made = load_subject(tmp_path / "subjects" / "shot_1")
    assert (made.focal_length_mm, made.sensor_width_mm, made.moves, made.transfer) == (60.0, 22.3, "camera", "bt709")
    assert [path.name for path in made.video_files()] == ["a.0003.png", "a.0004.png", "a.0005.png"]
    assert "64 x 48" in capsys.readouterr().out
    before = tree(tmp_path)
    for arguments, hint in (([clip], "exists already"),
                            ([clip, "--name", "b", "--focal-length-mm", "60"], "sensor_width_mm"),
                            ([str(tmp_path / "gone.mp4")], "gone.mp4")):
        assert main(["new", *arguments, "--dest", str(tmp_path / "subjects")]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and hint in error and ".tmp-" not in error
    assert tree(tmp_path) == before


@pytest.fixture
def handled_sigterm():
    """A handler of SIGTERM that ends what runs; SIGINT would depend on how the tests were started."""

    def end(_number, _frame):
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, end)
    yield end
    signal.signal(signal.SIGTERM, before)


def test_an_interrupt_waits_until_what_it_would_break_is_through(handled_sigterm):
    went = []
    with pytest.raises(KeyboardInterrupt):
        with interrupted_later():
            os.kill(os.getpid(), signal.SIGTERM)
            went.append("on")
        went.append("farther")
    assert went == ["on"] and signal.getsignal(signal.SIGTERM) is handled_sigterm


def test_what_is_ignored_does_not_interrupt_later_either(handled_sigterm):
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    with interrupted_later():
        os.kill(os.getpid(), signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
