"""The benchmark of both solvers: its cases, and what it says of the times."""

import pytest

from tools.bench.clips import settings_of
from tools.bench.drawing import line_chart
from tools.bench.published import (
    COMPARED,
    COMPARED_CASES,
    FIELDS,
    PUBLISHED_CASES,
    TRANSFER_SIZES,
    head_start,
    last_rows,
)


def row(label, solver, seconds, error, iteration=10):
    values = (label, solver, "", seconds, iteration, error, 2 * error, 30.0 - error)
    return dict(zip(FIELDS, values, strict=True))


def test_it_is_said_how_much_sooner():
    """The reference ends at 2.0 after 400 s; the transfer solver is below that after 8 s: 50 times."""
    rows = [row("published", "reference", *point) for point in ((10.0, 5.0), (100.0, 3.0), (400.0, 2.0))]
    assert head_start(rows) == []
    rows += [row("ours", "transfer", *point) for point in ((60.0, 1.0), (4.0, 2.5), (8.0, 1.5))]
    (found,) = head_start(rows)
    assert (found["label"], found["best_error"], found["best_s"]) == ("published", 2.0, 400.0)
    assert (found["half_error"], found["last_s"]) == (3.0, 400.0)
    assert (found["error"], found["seconds"], found["ratio"]) == (1.5, 8.0, 50.0)
    assert "ratio" not in head_start(rows[:3] + [row("ours", "transfer", 4.0, 2.5)])[0]


def test_the_table_has_the_last_row_of_each_model_and_solver():
    """In the models' order."""
    rows = [row("matte", "reference", 60.0, 5.0), row("matte", "reference", 120.0, 4.0)]
    rows += [row("full model", "transfer", 9.0, 2.0) | {"size": size} for size in ("draft", "small")]
    found = last_rows(rows)
    assert [(own["case"], own["solver"]) for own in found] == [
        ("full model", "transfer, draft"), ("full model", "transfer, small"), ("matte", "reference")]
    assert (found[-1]["seconds"], found[-1]["psnr_linear"]) == (120.0, 26.0)


def test_cases_are_every_size_and_the_reference_where_it_has_the_model():
    assert list(PUBLISHED_CASES) == [*(f"transfer, {size}" for size in TRANSFER_SIZES), "reference"]
    assert "no bounce; reference" not in COMPARED_CASES and "matte; reference" in COMPARED_CASES
    true = {case.label for case in COMPARED_CASES.values() if case.true_shape}
    assert true == {name for name in COMPARED if "true mesh" in name} and len(true) == 2
    assert len(COMPARED_CASES) == len(COMPARED) * (len(TRANSFER_SIZES) + 1) - 1


@pytest.mark.parametrize("changes", [*TRANSFER_SIZES.values(), *COMPARED.values()])
def test_its_settings_are_the_stages(changes):
    settings = settings_of(changes)
    assert settings.map_size == changes.get("map_size", 1024) and settings.fit_frames == changes.get("fit_frames", 0)


def test_a_chart_has_a_curve_for_each_name_and_gaps_where_nothing_is_known():
    curves = {"a & b": [(1.0, 2.0), (10.0, float("nan")), (100.0, 1.0), (200.0, 1.5)], "c": [(2.0, 1.0)]}
    chart = line_chart(curves, "seconds", "error", logarithmic=True)
    paths = [part.split('"')[0] for part in chart.split(' d="')[1:]]
    drawn = [path for path, kind in zip(paths, chart.split("<path class=")[1:], strict=True) if "curve" in kind[:8]]
    assert [(path.count("M"), path.count("L")) for path in drawn] == [(2, 1), (1, 0)]
    assert ">a &amp; b</text>" in chart and ">100</text>" in chart
