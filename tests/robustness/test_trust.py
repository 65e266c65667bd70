"""Nobody else's files, no subject in the way of others: links out of work/, planted records, other users."""

import json
import os
import random
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from slow import SLOW
from toy_runs import REPOSITORY, copy_pipeline, limn, make_subject

from shared.contract.cli import parse_request
from shared.contract.folders import RunFolder
from shared.contract.hashing import HashMemory, hash_file
from shared.contract.needs import WorkSize, measured_scale
from shared.contract.source import read_declaration
from shared.contract.wording import read_yaml
from shared.errors import InputError
from tools.cli.measures import clips_of
from tools.cli.plan import plan_case
from tools.limn import main

NOBODY = 65534
COMMANDS = ("run", "plan", "status", "report", "overview", "clean", "validate")
READERS = ("plan", "status", "report", "overview", "clean --dry-run", "plan --until count_words", "plan --renew")
PLANTED = (None, True, -1, 1e200, 1e999, "x", "\x1b[2J", [], [[]], {}, {"a": []}, "0" * 5000, 10**400)


@pytest.fixture
def pipeline(tmp_path):
    return copy_pipeline(tmp_path / "toy")


def contents(folder):
    """{path: bytes or link} of all that lies below."""
    return {path: os.readlink(path) if path.is_symlink() else path.read_bytes() if path.is_file() else None
            for path in sorted(folder.rglob("*"))}


def plant(evil, link, target):
    """A link in the evil subject, at this place, to what lies there."""
    (evil / link).parent.mkdir(parents=True, exist_ok=True)
    (evil / link).symlink_to(target)


LINKS = {"clip": ("work/clips/x", "victim"), "clips": ("work/clips", ""),
         "work of clip": ("work/clips/x/work", "victim/work"),
         "stage of clip": ("work/clips/x/work/read_text", "victim/work/read_text"),
         "stage": ("work/read_text", "victim/work/read_text"), "export": ("export", "victim/export")}


@pytest.mark.parametrize("name", LINKS)
def test_no_command_reaches_through_links(tmp_path, tmp_path_factory, pipeline, capsys, monkeypatch, name):
    monkeypatch.setenv("LIMN_TRUST", str(tmp_path / "toy"))
    victim = make_subject(tmp_path / "victim")
    for stage in ("read_text", "count_words"):
        (victim / "work" / stage).mkdir(parents=True)
        (victim / "work" / stage / "precious").write_text("keep me")
    (victim / "export").mkdir()
    evil = make_subject(tmp_path / "evil")
    link, target = LINKS[name]
    plant(evil, link, tmp_path / target)
    page = tmp_path_factory.mktemp("pages") / "overview.html"
    before = contents(tmp_path)
    for command in COMMANDS:
        options = [] if command == "validate" else ["--pipeline", str(pipeline)]
        options += ["--page", str(page)] if command == "overview" else []
        for more in ([], ["--until", "count_words"]) if command in ("run", "plan") else ([],):
            assert main([command, str(evil), *options, *more]) == 2, command
            error = capsys.readouterr().err
            assert "a symbolic link in place of results" in error and error.count("\n") == 1
    assert contents(tmp_path) == before


def test_planted_sizes_are_no_sizes(tmp_path):
    folder = tmp_path / "work" / "clips" / "x" / "work" / "sample_frames"
    folder.mkdir(parents=True)
    expected = WorkSize(10, 20, 30)
    for size in ([1e200, 1e200], [1e999, 1], [-1, -1], [0, 5], [10**400, 1], "ab", {}, None, [[], []]):
        (folder / "frames.json").write_text(json.dumps({"size": size, "frames": []}))
        assert measured_scale(tmp_path, expected) == expected, size
    (folder / "frames.json").write_text("[" * 100_000)
    assert measured_scale(tmp_path, expected) == expected


def damaged(record, rng):
    """The record as JSON with one of its values, at any depth, replaced, or cut, or of another kind."""
    record = json.loads(json.dumps(record))
    kind = rng.randrange(8)
    if kind == 0:
        text = json.dumps(record)
        return text[:rng.randrange(len(text))].encode()
    if kind == 1:
        return rng.choice([b"", b"\xff\xfe", b"[" * 50_000, b"7", b"NaN"])
    place = record
    while True:
        keys = list(place) if isinstance(place, dict) else list(range(len(place)))
        key = rng.choice(keys)
        if not (isinstance(place[key], dict | list) and place[key]) or rng.random() < 0.3:
            break
        place = place[key]
    place[key] = rng.choice(PLANTED)
    return json.dumps(record).encode()


def test_damaged_records_stop_no_command(tmp_path, pipeline, capsys, monkeypatch, toy_run):
    """In full: fifty times as many."""
    subject = shutil.copytree(toy_run[0], tmp_path / "anna")
    flags = [{"gate": "coverage", "value": 0.1, "limit": "0.5 or more"}]
    (subject / "work" / "quality.json").write_text(json.dumps({"gates": {}, "results": {}, "flags": flags}))
    sound = {path: path.read_bytes() for path in subject.rglob("*.json")}
    assert len(sound) >= 10
    rng = random.Random(7)
    for i in range(40 * (50 if SLOW else 1)):
        for path, data in sound.items():
            path.write_bytes(data)
        path = rng.choice(sorted(sound))
        path.write_bytes(damaged(json.loads(sound[path]), rng))
        data = path.read_bytes()
        for command in READERS:
            options = ["--page", str(tmp_path / "page.html")] if command == "overview" else []
            code = main([*command.split(), str(subject), "--pipeline", str(pipeline), *options])
            assert code == 0, (i, command, path, data[:300])
        shown = capsys.readouterr()
        assert "\x1b" not in shown.out + shown.err + (tmp_path / "page.html").read_text()
        if SLOW and i % 20 == 0:
            path.write_bytes(data)
            code, output = limn("run", subject, "--pipeline", pipeline, LIMN_TRUST=str(tmp_path / "toy"))
            assert code == 0 and "\x1b" not in output, (i, path, data[:300], output)
            left = {path: data} if path.read_bytes() == data else {}  # what the run reads past stays damaged
            now = {file: file.read_bytes() for file in subject.rglob("*.json")}
            sound = now | {file: sound[file] for file in left}


def test_hostile_subjects_stop_no_sound_one(tmp_path, pipeline, toy_run):
    batch = tmp_path / "batch"
    make_subject(batch / "sound")
    shutil.copytree(toy_run[0], batch / "costly")
    make_subject(batch / "summary.json")
    arguments = ("run", batch, "--pipeline", pipeline)
    trusted = {"LIMN_TRUST": str(tmp_path / "toy")}
    for path in (batch / "costly").rglob("provenance.json"):
        path.write_text('{"wall_s": "x", "warnings": 3, "bytes": null, "peak_memory_mb": []}')
    (batch / "costly" / "work" / "quality.json").write_text('{"flags": [{"x": 1}]}')
    planted = make_subject(batch / "planted") / "work" / "clips" / "x" / "work" / "sample_frames"
    planted.mkdir(parents=True)
    (planted / "frames.json").write_text('{"size": [1e200, 1e200], "frames": []}')
    plant(make_subject(batch / "linked"), "work/clips/x", batch / "sound")
    code, output = limn(*arguments, **trusted)
    assert code == 2 and "Traceback" not in output and "5 subjects: 4 done, 1 input error" in output, output
    assert (batch / "sound" / "export" / "page.txt").is_file()
    assert json.loads((batch / "summary-2.json").read_text())["exit_code"] == 2


class Unprivileged:
    """limn without root's right to read everything: as a user that owns nothing or, where that one cannot reach this
    Python, as root without the capabilities."""

    def __init__(self, changes_user):
        self.changes_user = changes_user
        self.command = () if changes_user else ("setpriv", "--bounding-set", "-dac_override,-dac_read_search")

    def own(self, folder):
        if self.changes_user:
            shutil.chown(folder, NOBODY, NOBODY)

    def _drop(self):
        if self.changes_user:
            os.setgroups([])
            os.setgid(NOBODY)
            os.setuid(NOBODY)

    def limn(self, *arguments, **environment):
        """(exit code, output)"""
        command = [*self.command, sys.executable, "-m", "tools.limn", *map(str, arguments)]
        done = subprocess.run(command, text=True, timeout=300, cwd="/", preexec_fn=self._drop,
                              env={**os.environ, "PYTHONPATH": str(REPOSITORY), "PYTHONDONTWRITEBYTECODE": "1",
                                   **environment},
                              stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        return done.returncode, done.stdout


@pytest.fixture
def unprivileged(tmp_path):
    """One who runs limn in tmp_path; skipped where rights cannot be given up."""
    if os.geteuid() != 0:
        pytest.skip("only root can run as another user")
    folder = tmp_path
    while not folder.stat().st_mode & stat.S_IXOTH or folder == tmp_path:
        folder.chmod(folder.stat().st_mode | 0o055)
        folder = folder.parent
    reached = all(parent.stat().st_mode & stat.S_IXOTH for parent in Path(sys.executable).resolve().parents)
    if not reached and not shutil.which("setpriv"):
        pytest.skip("another user cannot reach this Python, and setpriv is not there")
    return Unprivileged(changes_user=reached)


def test_another_user_without_a_home(tmp_path, unprivileged, pipeline):
    """Closed siblings and clips are these subjects' faults; the sound one runs, HOME or Snakemake's settings or not."""
    batch, out = tmp_path / "batch", tmp_path / "out"
    for name in ("sound", "closed", "clip", "work"):
        make_subject(batch / name)
    (batch / "lost+found").mkdir()
    (batch / "work" / "work").mkdir()
    for path in (batch / "closed", batch / "lost+found", batch / "work" / "work", batch / "clip" / "clip.txt"):
        path.chmod(0)
    out.mkdir()
    unprivileged.own(out)
    code, output = unprivileged.limn("run", batch, "--pipeline", pipeline, "--out", out, HOME="/nonexistent/home",
                                     SNAKEMAKE_PROFILE="nothing-of-that-name", LIMN_TRUST=str(tmp_path / "toy"))
    assert code == 2 and "Traceback" not in output, output
    assert (out / "sound" / "export" / "page.txt").is_file(), output
    assert (out / "work" / "export" / "page.txt").is_file()
    assert "clip.txt: cannot be read" in output or "cannot be read" in output
    assert "3 subjects: 2 done, 1 input error" in output, output
    code, output = unprivileged.limn("status", batch, "--pipeline", pipeline, LIMN_TRUST=str(tmp_path / "toy"))
    assert code == 2 and "Traceback" not in output and str(batch / "work" / "work") in output, output


def test_out_where_no_folder_can_be(tmp_path, pipeline):
    subject = make_subject(tmp_path / "anna")
    code, output = limn("run", subject, "--pipeline", pipeline, "--out", "/proc/limn", LIMN_TRUST=str(tmp_path / "toy"))
    assert code == 2 and "cannot write here" in output and output.count("\n") == 1, output


@pytest.mark.parametrize("text, value", [("060", 60), ("-010", -10), ("08.5", 8.5), ("0x10", 16), ("1_000", 1000),
                                         ("1:30", "1:30"), ("1:30.5", "1:30.5"), ("60", 60), ("off", False)])
def test_numbers_of_settings_are_what_they_look_like(tmp_path, text, value):
    (tmp_path / "a.yaml").write_text(f"x: {text}\n")
    read = read_yaml(tmp_path / "a.yaml")["x"]
    assert read == value and type(read) is type(value)


def test_disk_follows_settings(tmp_path, pipeline):
    from shared.contract.confine import trust

    trust([tmp_path / "toy"])
    subject = make_subject(tmp_path / "anna")
    pipeline.write_text("sizes: {frames: draw_bars.width}\n" + pipeline.read_text().replace(
        "threads: 1}", "threads: 1, resources: {disk_mb: {frame: 10}}}"))
    stage = read_declaration(tmp_path / "toy" / "toy" / "draw_bars.py")
    needed = [parse_request(stage, ["--subject", str(subject), "--pipeline", str(pipeline), *given]).disk_mb
              for given in ([], ["--set", "width=40"])]
    assert needed[1] == pytest.approx(440) and needed[0] != needed[1]


def test_summary_is_never_a_folder(tmp_path):
    from tools.cli.workflow import default_summary

    with pytest.raises(InputError, match="a folder, not a file"):
        default_summary([], None, tmp_path)
    assert default_summary([], tmp_path, None) == tmp_path / "summary.json"
    assert default_summary([], tmp_path, None, [tmp_path / "summary.json"]) == tmp_path / "summary-2.json"
    taken = [tmp_path / "summary.html", tmp_path / "summary-2.json"]
    assert default_summary([], tmp_path, None, taken) == tmp_path / "summary-3.json"
    (tmp_path / "summary-3.html").mkdir()
    assert default_summary([], tmp_path, None, taken) == tmp_path / "summary-4.json"


def test_no_home_and_a_profile_in_the_environment(tmp_path, pipeline):
    subject = make_subject(tmp_path / "anna")
    code, output = limn("run", subject, "--pipeline", pipeline, HOME="/proc/none", LIMN_TRUST=str(tmp_path / "toy"),
                        XDG_CACHE_HOME="/proc/none", SNAKEMAKE_PROFILE="nothing-of-that-name")
    assert code == 0, output


def test_one_linked_subject_keeps_no_other_from_being_cleaned(tmp_path, pipeline, capsys):
    for name in ("anna", "carl"):
        (make_subject(tmp_path / "batch" / name) / "work" / "read_text").mkdir(parents=True)
    victim = tmp_path / "batch" / "anna" / "work" / "read_text"
    plant(make_subject(tmp_path / "batch" / "bert"), "work/read_text", victim)
    assert main(["clean", str(tmp_path / "batch"), "--pipeline", str(pipeline)]) == 2
    assert "a symbolic link in place of results" in capsys.readouterr().err
    assert not (tmp_path / "batch" / "anna" / "work").exists() and not (tmp_path / "batch" / "carl" / "work").exists()


@pytest.mark.parametrize("command", ["plan", "status", "overview", "run"])
def test_our_own_failure_on_one_subject_is_told_and_stops_no_other(tmp_path, pipeline, capsys, monkeypatch, command):
    """As a planted record would do that gets past all checks."""
    monkeypatch.setenv("LIMN_TRUST", str(tmp_path / "toy"))
    for name in ("anna", "bert"):
        make_subject(tmp_path / "batch" / name)
    for module in ("tools.limn", "tools.cli.workflow"):
        monkeypatch.setattr(f"{module}.plan_case", failing_for("anna"))
    options = ["--page", str(tmp_path / "page.html")] if command == "overview" else []
    assert main([command, str(tmp_path / "batch"), "--pipeline", str(pipeline), *options]) == 1
    out, err = capsys.readouterr()
    assert "the abacus broke" in err and "bert" in out + err + "".join(
        path.read_text() for path in tmp_path.glob("page.html"))
    if command == "run":
        log = tmp_path / "batch" / "anna" / "work" / "workflow.log"
        assert "Traceback" in log.read_text() and str(log) in err and "Traceback" not in err
        assert (tmp_path / "batch" / "bert" / "export" / "page.txt").is_file()
        states = {one["subject"]: one["state"] for one in
                  json.loads((tmp_path / "batch" / "summary.json").read_text())["subjects"]}
        assert states == {"anna": "failed", "bert": "done"}
    else:
        assert "Traceback" in err


def failing_for(name):
    """plan_case that fails on the subject of that name."""
    def plan(pipeline, case, *arguments, **options):
        if case.name == name:
            raise ZeroDivisionError("the abacus broke")
        return plan_case(pipeline, case, *arguments, **options)

    return plan


@pytest.mark.parametrize("known", ["[" * 100_000, '{"a": [1e999, 0, 0, 7]}', '{"a": 3, "b": [1, 2, 3]}', "NaN"])
def test_remembered_hashes_are_checked(tmp_path, known):
    (tmp_path / "hashes").write_text(known)
    (tmp_path / "a").write_text("a")
    memory = HashMemory(tmp_path / "hashes")
    assert memory.hash(tmp_path / "a") == hash_file(tmp_path / "a")
    memory.save()
    assert list(json.loads((tmp_path / "hashes").read_text())) == ["a"]


def test_clips_of_a_planted_record_are_those_of_the_subject(tmp_path):
    run = RunFolder(tmp_path / "anna")
    (run.work / "clips" / "sun").mkdir(parents=True)
    (run.work / "inverse_render").mkdir()
    for clips, names in (([{"name": "../../../victim"}, {"name": "sun"}, 3, {"name": []}], ["sun"]), (7, ["anna"])):
        (run.work / "inverse_render" / "solve.json").write_text(json.dumps({"clips": clips}))
        assert [clip.root.name for clip in clips_of(run)] == names


def test_check_shows_no_control_codes_and_no_traces(tmp_path, capsys):
    (tmp_path / "export").mkdir()
    (tmp_path / "export" / "SHA256SUMS").write_text("0" * 64 + "  a\n")
    (tmp_path / "export" / "\x1b[2J").write_text("x")
    assert main(["check", str(tmp_path)]) == 2
    shown = capsys.readouterr()
    assert "\x1b" not in shown.out + shown.err and "not checked" in shown.out
