"""The page over many subjects: what it shows, that nothing in it is taken for markup, that it asks for nothing."""

import json
import re
import shutil
from html import unescape
from urllib.parse import unquote

import numpy as np
import pytest
from browser import needs_browser, visit
from toy_result import FRAMES, RENDERED, ToyJob, write_toy_work
from toy_runs import copy_pipeline, limn, make_subject, tree

from shared.contract.folders import RunFolder
from shared.contract.manifest import write_record
from shared.contract.pipeline import load_pipeline
from shared.io.images import write_exr
from stages import export_usd
from tools.cli.gates import RECORD, Flag, read_flags
from tools.cli.outcome import Outcome
from tools.cli.overview import overview_page, page_beside, values_of, write_overview
from tools.cli.thumbnails import crop_pictures, result_pictures
from tools.limn import main

NAME = '<script>alert("1")</script> & co'


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """The folder of a toy subject with work/ and export/."""
    root = tmp_path_factory.mktemp("results") / "anna"
    export_usd.run(ToyJob(write_toy_work(root / "work"), root / "export"))
    values = {"reprojection_px": 0.1, "held_out_residual": 0.5, "coverage": 0.9, "confidence": 0.8}
    write_record(root / "work" / RECORD, {"values": values, "flags": []})
    return root


def outcomes(result):
    """A good one, one to look at, one that failed, one without results."""
    missed = Flag("held_out_residual", 0.5, "0.035 or less")
    return [
        Outcome("anna", "in", "done", "export_usd", results=str(result), minutes=12.0, memory_mb=800.0, bytes=5_000_000,
                warnings=("a <b>bold</b> warning", "another")),
        Outcome("bert", "in", "review", "export_usd", str(missed), minutes=3.0, memory_mb=900.0, flags=(missed,),
                picture=str(result / "work" / "review.png"), results=str(result)),
        Outcome("carl", "in", "failed", "inverse_render", "the abacus broke", str(result / "work" / "a log.txt"),
                results=str(result)),
        Outcome(NAME, "in", "input error", reason="no such video"),
    ]


@pytest.fixture(scope="module")
def page(result):
    path = result.parent / "summary.html"
    write_overview(path, outcomes(result), load_pipeline())
    return path


def rows_of(text):
    """{class of the row: its cells}"""
    body = re.search(r'<tbody id="rows">(.*)</tbody>', text, re.S).group(1)
    return {kind: re.findall(r"<td[^>]*>(.*?)</td>", row, re.S)
            for kind, row in re.findall(r'<tr class="([\w-]+)">(.*?)</tr>', body, re.S)}


def test_rows_say_what_became_of_each_subject_the_worst_first(page):
    text = page.read_text(encoding="utf-8")
    rows = rows_of(text)
    assert list(rows) == ["failed", "input-error", "review", "done"] and "4 subjects" in text
    assert "1 done, 1 review, 1 input error, 1 failed" in text
    gates = list(load_pipeline().gates)
    measured = {"reprojection_px": "0.1", "held_out_residual": "0.5", "coverage": "0.9", "confidence": "0.8"}
    assert rows["failed"][3] == "inverse_render: the abacus broke"
    assert rows["failed"][4 : 4 + len(gates)] == ["-"] * len(gates)
    assert rows["review"][4 : 4 + len(gates)] == [measured.get(name, "-") for name in gates]
    assert rows["done"][7 + len(gates)] == "5.0 MB"
    assert 'class="missed" data-key="0.5"' in text and text.count('class="missed"') == 1
    assert "<small>0.035 or less</small>" in text


def test_links_are_relative_and_lead_there(page):
    links = [unquote(unescape(link)) for link in re.findall(r'href="([^"]*)"', page.read_text(encoding="utf-8"))]
    assert len(links) == 4 and all(link.startswith("./anna/") for link in links)
    assert (page.parent / "anna" / "export" / "report.html").is_file() and "./anna/export/report.html" in links
    assert "./anna/work/a log.txt" in links


def test_names_and_warnings_are_no_markup_and_nothing_is_asked_for(page):
    text = page.read_text(encoding="utf-8")
    assert NAME not in text and "&lt;script&gt;" in text and "a &lt;b&gt;bold&lt;/b&gt; warning" in text
    sources = re.findall(r'(?:src|srcset|action)="([^"]*)"', text)
    assert sources and all(source.startswith("data:image/jpeg;base64,") for source in sources)
    assert "default-src 'none'" in text and "http://" not in text and "https://" not in text


def test_pictures_of_a_result_and_of_a_beginning(result, tmp_path):
    run = RunFolder(result)
    names = [name for name, _ in result_pictures(run)]
    middle = RENDERED[len(RENDERED) // 2]
    assert names == [f"frame {middle}", f"re-render of frame {middle}", "another view"] and middle in FRAMES
    assert [name for name, _ in crop_pictures(run)] == ["crop"]
    assert result_pictures(RunFolder(tmp_path)) == crop_pictures(RunFolder(tmp_path)) == []


def test_a_damaged_picture_is_said_and_the_page_is_written(result, tmp_path):
    copy = shutil.copytree(result, tmp_path / "anna")
    render = copy / "export" / "renders" / f"{RENDERED[1]:04d}.exr"
    render.write_bytes(render.read_bytes()[:200])
    one = [Outcome("anna", "in", "done", "export_usd", results=str(copy))]
    assert "cannot be read: " in overview_page(one, load_pipeline(), tmp_path)
    write_exr(render, np.ones((32, 32), np.float32), colour_space="data")
    assert "not a picture in colour" in overview_page(one, load_pipeline(), tmp_path)
    plate = copy / "export" / "plates" / f"{RENDERED[1]:04d}.jpg"
    plate.write_bytes(b"\xff\xd8\xff no picture")
    assert "a picture that cannot be read" in overview_page(one, load_pipeline(), tmp_path)


def test_pictures_are_read_once_while_the_files_stay_the_same(result, tmp_path, monkeypatch):
    copy = shutil.copytree(result, tmp_path / "anna")
    (copy / "work").mkdir(exist_ok=True)
    one = [Outcome("anna", "in", "done", "export_usd", results=str(copy))]
    page = overview_page(one, load_pipeline(), tmp_path)
    with monkeypatch.context() as patched:
        patched.setattr("tools.cli.thumbnails.result_pictures", pytest.fail)
        assert overview_page(one, load_pipeline(), tmp_path) == page and "data:image/jpeg" in page
    kept = copy / "work" / "thumbnails.json"
    for damaged in ('{"sources": 1}', "[]", kept.read_text().replace("data:image/jpeg", "data:text/html")):
        kept.write_text(damaged)
        assert overview_page(one, load_pipeline(), tmp_path) == page
    render = copy / "export" / "renders" / f"{RENDERED[1]:04d}.exr"
    render.write_bytes(render.read_bytes()[:200])
    assert "cannot be read: " in overview_page(one, load_pipeline(), tmp_path)


@pytest.mark.parametrize("place", ["export/plates", "export/views/novel_left.exr", "work/sample_frames"])
def test_no_picture_comes_from_elsewhere(result, tmp_path, place):
    copy = shutil.copytree(result, tmp_path / "anna")
    shutil.move(copy / place, tmp_path / "victim")
    (copy / place).symlink_to(tmp_path / "victim")
    state = "failed" if place.startswith("work") else "done"
    page = overview_page([Outcome("anna", "in", state, "export_usd", results=str(copy))], load_pipeline(), tmp_path)
    assert "a link that leads elsewhere" in page and "data:image" not in page.partition("<tbody")[2]


@pytest.mark.parametrize("record", [
    "[]", "{", '{"values": [1], "flags": {"a": 1}}', '{"values": {"coverage": "x"}, "flags": [3, {"gate": 1}]}',
    '{"values": {"coverage": null}, "flags": [{"gate": "coverage", "value": "much", "limit": "1"}]}',
    '{"values": {"coverage": true, "confidence": 1e999}}'])
def test_damaged_records_are_as_good_as_none(tmp_path, record):
    run = RunFolder(tmp_path)
    run.work.mkdir()
    (run.work / RECORD).write_text(record)
    assert values_of(run) == {} and read_flags(run) == []


def test_page_of_a_run_and_of_what_lies_there(tmp_path, capsys):
    pipeline, batch = copy_pipeline(tmp_path / "toy"), tmp_path / "batch"
    make_subject(batch / "anna")
    make_subject(batch / "faceless", "no face in here\n")
    code, output = limn("run", batch, "--pipeline", pipeline, "--out", tmp_path / "out")
    page = tmp_path / "out" / "summary.html"
    assert code == 2 and f"overview: {page}\n" in output and output.endswith("summary.json\n")
    rows = rows_of(page.read_text(encoding="utf-8"))
    assert set(rows) == {"done", "input-error"} and './anna/export/report.html' in rows["done"][0]
    make_subject(batch / "new")
    (batch / "gone").mkdir()
    (batch / "gone" / "subject.yaml").write_text("video: gone.mp4\n")
    before, own = tree(tmp_path / "out"), tmp_path / "own.html"
    arguments = ["overview", str(batch), "--pipeline", str(pipeline), "--out", str(tmp_path / "out")]
    assert main([*arguments, "--page", str(own)]) == 2
    out, err = capsys.readouterr()
    assert out == f"{own}\n" and "no such video" in err and tree(tmp_path / "out") == before
    text = own.read_text(encoding="utf-8")
    assert "4 subjects" in text and "read_text: never ran" in text
    assert set(rows_of(text)) == {"done", "not-run", "input-error"}


def test_a_place_that_cannot_be_written_loses_no_summary(pipeline, tmp_path):
    subject = make_subject(tmp_path / "anna")
    (tmp_path / "all.html").mkdir()
    code, output = limn("run", subject, "--pipeline", pipeline, "--summary", tmp_path / "all.json")
    assert code == 2 and "the overview cannot be written" in output
    assert json.loads((tmp_path / "all.json").read_text())["subjects"][0]["state"] == "done"


def test_page_never_takes_the_summary_s_name(tmp_path):
    assert [page_beside(tmp_path / name).name for name in ("summary.json", "a.html", "a")] == [
        "summary.html", "a.html.html", "a.html"]


@needs_browser
def test_headings_sort_and_the_field_filters(page):
    with visit(page) as visited:
        browser = visited.page
        names = "[...document.querySelectorAll('#rows tr:not([hidden])')].map(row => row.className)"
        browser.wait_for_function("document.querySelectorAll('th button').length > 5")
        click = "[...document.querySelectorAll('th button')].find(b => b.textContent.startsWith('{}')).click()"
        browser.evaluate(click.format("minutes"))
        assert browser.evaluate(names)[-2:] == ["review", "done"]
        browser.evaluate(click.format("minutes"))
        assert browser.evaluate(names)[:2] == ["done", "review"]
        browser.evaluate(click.format("coverage"))
        assert set(browser.evaluate(names)[:2]) == {"done", "review"}
        browser.fill("#filter", "BOLD")
        assert browser.evaluate(names) == ["done"] and visited.problems == []
        assert browser.evaluate("[...document.images].every(image => image.naturalWidth > 0)")
