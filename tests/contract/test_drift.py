"""What makes a result current: models are inputs; code and packages are recorded, and what they differ in is said."""

import ast
import json
import os
import platform
import shutil
import sys
from importlib import import_module
from pathlib import Path

import pytest
from toy_runs import READ_TEXT, REPOSITORY, copy_pipeline, limn, make_subject, outputs_of

from shared.contract import Stage, main, models
from shared.contract import drift as drift_module
from shared.contract.drift import drift
from shared.contract.manifest import read_manifest
from shared.contract.source import loaded_code, loaded_sources
from tools.limn import main as limn_main

OLD_NUMPY = "1.0.0"


@pytest.fixture
def case(toy_run, tmp_path):
    """A copy of its own: the pipeline and the subject."""
    pipeline = copy_pipeline(tmp_path / "toy")
    shutil.copytree(toy_run[0], tmp_path / "anna")
    return pipeline, tmp_path / "anna"


def edit(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def damage(path, left):
    """Leaves so many bytes of the file, or nothing."""
    data = path.read_bytes()
    path.unlink() if left is None else path.write_bytes(data[:left])


def pretend_old_package(folder):
    """As if an older numpy had computed the stage's result."""
    record = json.loads((folder / "provenance.json").read_text())
    record["packages"]["numpy"] = OLD_NUMPY
    (folder / "provenance.json").write_text(json.dumps(record))


def test_a_template_is_code_of_the_module_that_fills_it(tmp_path, monkeypatch):
    (tmp_path / "templates").mkdir()
    page = tmp_path / "templates" / "page.html.j2"
    page.write_text("<p>{{ text }}</p>")
    (tmp_path / "made_up_pages.py").write_text("from pathlib import Path\n"
                                               "TEMPLATES = Path(__file__).with_name('templates')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "made_up_pages", raising=False)
    import_module("made_up_pages")
    roots = (tmp_path,)
    code = loaded_code(roots)
    monkeypatch.delitem(sys.modules, "made_up_pages")
    assert code.keys() == {"made_up_pages.py", "templates/page.html.j2"}
    (tmp_path / "provenance.json").write_text(json.dumps({"code": code, "packages": {},
                                                          "python": platform.python_version()}))
    assert drift(tmp_path, roots) == []
    page.write_text("<b>{{ text }}</b>")
    drift_module._fingerprint_of.cache_clear()
    assert drift(tmp_path, roots) == ["code has changed: templates/page.html.j2"]


def test_a_file_whose_bytes_are_those_of_before_is_not_compiled(tmp_path, monkeypatch):
    (tmp_path / "made_up_code.py").write_text("ONE = 1\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    import_module("made_up_code")
    roots, compiled, fingerprint = (tmp_path,), [], drift_module.fingerprint
    monkeypatch.setattr(drift_module, "fingerprint", lambda path: compiled.append(path.name) or fingerprint(path))
    record = {"code": loaded_code(roots), "sources": loaded_sources(roots), "packages": {},
              "python": platform.python_version()}
    monkeypatch.delitem(sys.modules, "made_up_code")

    def remarks(**changed):
        (tmp_path / "provenance.json").write_text(json.dumps(record | changed))
        for known in (drift_module._fingerprint_of, drift_module._source_of):
            known.cache_clear()
        return drift(tmp_path, roots)

    assert remarks() == [] and not compiled
    assert remarks(sources={}) == [] and remarks(sources={"made_up_code.py": "0"}) == []
    assert remarks(sources=["made_up_code.py"]) == [] and len(compiled) == 3
    assert len(remarks(python="3.0.0", code={"made_up_code.py": "that Python's"})) == 2
    (tmp_path / "made_up_code.py").write_text("ONE = 2\n")
    assert remarks() == ["code has changed: made_up_code.py"]
    (tmp_path / "made_up_code.py").unlink()
    assert remarks() == remarks(sources={"made_up_code.py": ""}) == ["code has changed: made_up_code.py"]


def test_run_says_what_it_keeps_although_the_code_changed_and_renews_it(case):
    pipeline, subject = case
    edit(pipeline.parent / "toy" / "count_words.py", ".split()", ".split(None)")
    edit(pipeline.parent / "toy" / "read_text.py", "def run", "# A remark.\ndef run")
    before = outputs_of(subject)
    code, output = limn("run", subject, "--pipeline", pipeline, "--summary", subject.parent / "summary.json")
    kept = "count_words: kept although code has changed: toy/count_words.py"
    assert code == 0 and "nothing to do" in output and f"anna  {kept}\n" in output
    assert "anew: limn run --renew" in output and "read_text" not in output
    assert outputs_of(subject) == before
    assert json.loads((subject.parent / "summary.json").read_text())["subjects"][0]["kept"] == [kept]

    code, output = limn("run", subject, "--pipeline", pipeline, "--renew")
    lines = {line.split()[1]: line.split(None, 2)[2] for line in output.splitlines() if line.startswith("anna ")}
    assert code == 0 and lines["count_words"].startswith("done") and "read_text" not in lines
    assert lines["draw_bars"] == lines["export_page"] == "current"
    assert outputs_of(subject) == before
    code, output = limn("run", subject, "--pipeline", pipeline, "--renew")
    assert code == 0 and "nothing to do" in output and "kept" not in output


def test_run_says_what_it_keeps_although_packages_changed(case, capsys):
    pipeline, subject = case
    pretend_old_package(subject / "work" / "draw_bars")
    arguments = [str(subject), "--pipeline", str(pipeline)]
    assert limn_main(["plan", *arguments]) == 0
    assert f"kept although packages have changed: numpy {OLD_NUMPY} -> " in capsys.readouterr().out
    assert limn_main(["plan", *arguments, "--renew"]) == 0
    rows = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()[1:]}
    assert f"will run  packages have changed: numpy {OLD_NUMPY} -> " in rows["draw_bars"]
    assert "may run" in rows["export_page"] and "current" in rows["count_words"]
    code, output = limn("run", *arguments)
    assert code == 0 and f"draw_bars: kept although packages have changed: numpy {OLD_NUMPY} -> " in output


def test_a_renewal_that_fails_is_not_called_done(case):
    pipeline, subject = case
    edit(pipeline.parent / "toy" / "count_words.py", ".split()", ".split(None)")
    before = outputs_of(subject)
    code, output = limn("run", subject, "--pipeline", pipeline, "--renew", TOY_FAIL="1")
    assert code == 1 and "the abacus broke" in output and "anna: done" not in output
    assert outputs_of(subject) == before


VOLATILE = ("export/report.html", "work/count_words/when.json", "work/read_text/provenance.json")


@pytest.mark.parametrize("name", VOLATILE)
@pytest.mark.parametrize("left", [0, 3, None], ids=["emptied", "cut", "gone"])
def test_damage_to_what_the_manifest_does_not_hash_is_seen(case, capsys, name, left):
    pipeline, subject = case
    damage(subject / name, left)
    assert limn_main(["plan", str(subject), "--pipeline", str(pipeline)]) == 0
    rows = capsys.readouterr().out.splitlines()[1:]
    assert [row.partition("will run")[2].strip() for row in rows if "will run" in row] in (
        [f"file {Path(name).name} is damaged"], [f"file {Path(name).name} is missing"],
        [f"file {Path(name).name} is missing or damaged"])


def test_damage_to_what_the_manifest_does_not_hash_is_mended(case):
    pipeline, subject = case
    before = outputs_of(subject)
    for name in VOLATILE:
        damage(subject / name, 3)
    code, output = limn("run", subject, "--pipeline", pipeline)
    assert code == 0 and output.count(" done in ") == 4, output
    assert outputs_of(subject) == before and all(len((subject / name).read_bytes()) > 3 for name in VOLATILE)
    assert json.loads((subject / "work" / "read_text" / "provenance.json").read_text())["wall_s"] > 0


def test_a_flipped_bit_in_a_volatile_file_is_seen_when_everything_is_read(case, capsys):
    pipeline, subject = case
    path = subject / "export" / "report.html"
    times, data = path.stat(), bytearray(path.read_bytes())
    data[0] ^= 1
    path.write_bytes(data)
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert limn_main(["plan", str(subject), "--pipeline", str(pipeline), "--verify"]) == 0
    assert "file report.html is damaged" in capsys.readouterr().out


@pytest.mark.parametrize("record", [
    {}, {"code": 3, "packages": {}}, {"code": {"a.py": 3}, "packages": {}}, {"code": {}, "packages": ["numpy"]},
    {"code": {"/dev/zero": "x"}, "packages": {}}, {"code": {"../../../../dev/zero": "x"}, "packages": {"": "1"}},
    {"code": {"a\x00.py": "x"}, "packages": {"a\nb": "1"}}, {"code": {}, "packages": {}, "python": [3]}])
def test_a_foreign_record_of_what_made_a_result_is_only_looked_at(tmp_path, record):
    (tmp_path / "provenance.json").write_text(json.dumps(record))
    remarks = drift(tmp_path, (REPOSITORY,))
    assert remarks and all(remark.isprintable() and len(remark) < 400 for remark in remarks)


def test_models_are_inputs(tmp_path, monkeypatch, capsys):
    stage = Stage("read_text", 1, "Reads.", (), READ_TEXT.outputs, READ_TEXT.parameters, models=("face.tflite",))
    subject, folder, runs = make_subject(tmp_path / "anna"), tmp_path / "models", []
    pipeline = tmp_path / "pipeline.yaml"
    pipeline.write_text("stages:\n  read_text: {}\n")
    folder.mkdir()
    (folder / "face.tflite").write_text("one network")
    monkeypatch.setenv("LIMN_MODELS", str(folder))

    def call():
        def run(job):
            runs.append(job)
            (job.out / "text.txt").write_text("text")

        return main(stage, run, None, ["--subject", str(subject), "--pipeline", str(pipeline)])

    assert call() == 0 and call() == 0 and len(runs) == 1
    inputs = read_manifest(subject / "work" / "read_text")["inputs"]
    assert set(inputs) == {"subject.yaml", "video", "model face.tflite"}
    (tmp_path / "elsewhere").mkdir()
    shutil.copy(folder / "face.tflite", tmp_path / "elsewhere")
    monkeypatch.setenv("LIMN_MODELS", str(tmp_path / "elsewhere"))
    assert call() == 0 and len(runs) == 1
    (tmp_path / "elsewhere" / "face.tflite").write_text("other weights")
    assert call() == 0 and len(runs) == 2
    monkeypatch.setenv("LIMN_MODELS", str(tmp_path / "nowhere"))
    capsys.readouterr()
    assert call() == 2 and capsys.readouterr().err.count("\n") == 1


def test_a_stage_by_hand_says_what_it_keeps_and_renews_it(tmp_path, capsys):
    subject, pipeline, runs = make_subject(tmp_path / "anna"), tmp_path / "pipeline.yaml", []
    pipeline.write_text("stages:\n  read_text: {}\n")

    def call(*arguments):
        def run(job):
            runs.append(job)
            (job.out / "text.txt").write_text("text")

        code = main(READ_TEXT, run, None, ["--subject", str(subject), "--pipeline", str(pipeline), *arguments])
        return code, capsys.readouterr().err

    assert call()[0] == 0
    assert call("--renew")[0] == 0 and len(runs) == 1
    pretend_old_package(subject / "work" / "read_text")
    code, said = call()
    assert code == 0 and len(runs) == 1
    assert f"read_text: kept although packages have changed: numpy {OLD_NUMPY} -> " in said and "anew: --renew" in said
    assert call("--renew")[0] == 0 and len(runs) == 2
    assert "kept" not in call()[1] and len(runs) == 2


def test_plan_and_run_see_other_models(case, monkeypatch, capsys):
    pipeline, subject = case
    edit(pipeline.parent / "toy" / "draw_bars.py", 'inputs=("count_words",),', 'inputs=("count_words",),\n    '
         'models=("face.tflite",),')
    folder = subject.parent / "models"
    folder.mkdir()
    (folder / "face.tflite").write_text("one network")
    monkeypatch.setenv("LIMN_MODELS", str(folder))
    arguments = [str(subject), "--pipeline", str(pipeline)]
    assert limn("run", *arguments)[0] == 0
    assert limn_main(["plan", *arguments]) == 0 and "run" not in capsys.readouterr().out.partition("\n")[2]
    (folder / "face.tflite").write_text("other weights")
    assert limn_main(["plan", *arguments]) == 0
    assert "draw_bars    will run  input model face.tflite changed\n" in capsys.readouterr().out
    (folder / "face.tflite").unlink()
    assert limn_main(["plan", *arguments]) == 2
    assert "face.tflite: the models are not set up; got no such file; run make setup" in capsys.readouterr().err
    code, output = limn("run", *arguments)
    assert code == 2 and output.count("\n") == 1 and "the models are not set up" in output


def test_stages_declare_the_models_that_they_load():
    """Only stages load models, and each names in its declaration all that its loaders read."""
    loaders = {"load_face_networks": set(models.FACE_NETWORKS), "own_face_networks": set(models.FACE_NETWORKS),
               "own_iris_network": {models.IRIS_NETWORK}, "load_head_model": {models.HEAD_MODEL_FILE}}
    from shared.contract.pipeline import load_pipeline

    seen = set()
    for path in [*Path(REPOSITORY, "shared").rglob("*.py"), *Path(REPOSITORY, "stages").glob("*.py")]:
        imported = {alias.name for node in ast.walk(ast.parse(path.read_bytes()))
                    if isinstance(node, ast.ImportFrom) and node.module == "shared.tracking.models"
                    for alias in node.names}
        assert imported <= set(loaders), f"{path}: {imported}"
        if path.parent.name == "stages":
            if path.stem == "__init__":
                continue
            needed = set().union(*(loaders[name] for name in imported))
            assert set(load_pipeline().stages[path.stem].models) == needed, path
            seen |= needed
        else:
            assert not imported, f"{path} loads models, which no declaration would show"
    assert seen == {*models.FACE_NETWORKS, models.IRIS_NETWORK, models.HEAD_MODEL_FILE}
