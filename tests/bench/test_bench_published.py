"""The benchmark of both solvers: its log, its clock over several calls, and what it says of the times."""

import pytest

from tools.bench.appearance import settings_of
from tools.bench.published import COMPARED, FIELDS, TRANSFER_SIZES, Log, chart, compared_table


def row(label, solver, seconds, error, iteration=10):
    values = (label, solver, "", seconds, iteration, error, 2 * error, 30.0 - error)
    return dict(zip(FIELDS, values, strict=True))


def test_rows_come_back_as_numbers(tmp_path):
    log = Log(tmp_path / "out" / "accuracy.csv")
    log.add(row("a", "reference", 12.5, 3.0) | {"unknown": 1})
    assert log.rows()[0]["seconds"] == 12.5 and log.rows()[0]["label"] == "a"


def test_the_chart_says_how_much_sooner(tmp_path, capsys):
    """The reference ends at 2.0 after 400 s; the transfer solver is below that after 8 s: 50 times."""
    log = Log(tmp_path / "accuracy.csv")
    for seconds, error in ((10.0, 5.0), (100.0, 3.0), (400.0, 2.0)):
        log.add(row("published", "reference", seconds, error))
    for seconds, error in ((4.0, 2.5), (8.0, 1.5), (60.0, 1.0)):
        log.add(row("ours", "transfer", seconds, error))
    capsys.readouterr()
    chart(log, tmp_path / "accuracy.svg")
    assert "published: best 2.000 after 400 s" in (said := capsys.readouterr().out) and said.strip().endswith("50 x")
    assert "3.000 in the first half of 400 s, 2.000 in all" in said
    picture = (tmp_path / "accuracy.svg").read_text()
    assert picture.count('class="curve"') == 2 and "published" in picture


def test_the_table_has_the_last_row_of_each_model_and_solver():
    """In the models' order."""
    rows = [row("matte", "reference", 60.0, 5.0), row("matte", "reference", 120.0, 4.0)]
    rows += [row("full model", "transfer", 9.0, 2.0) | {"size": size} for size in ("draft", "small")]
    lines = compared_table(rows).splitlines()
    assert [line.split(" | ")[:2] for line in lines[2:]] == [
        ["| full model", "transfer, draft"], ["| full model", "transfer, small"], ["| matte", "reference"]
    ]
    assert lines[-1].endswith("| 120 | 10 | 4.00 | 26.0 dB |")


@pytest.mark.parametrize("changes", [*TRANSFER_SIZES.values(), *COMPARED.values()])
def test_its_settings_are_the_stages(changes):
    settings = settings_of(changes)
    assert settings.map_size == changes.get("map_size", 1024) and settings.fit_frames == changes.get("fit_frames", 0)
