"""The benchmark of model selection: what it compares, and that an interrupted table goes on."""

import pytest

from tools.bench import model_selection
from tools.bench.model_selection import compare, main, read_rows, write_rows


def row(clip, candidate, mesh, error, seconds):
    return {"clip": clip, "candidate": candidate, "mesh": mesh, "held_out": 1.2 * error, "held_out_abs": error,
            "cpu_s": seconds,
            "light": "cubemap 8", "visibility": "bounces", "specular": True, "chosen": ""}


TABLE = [row("a", "auto", "tracked", 0.0103, 12.0), row("a", "least", "tracked", 0.02, 5.0),
         row("a", "cubemap_16", "tracked", 0.011, 30.0), row("a", "cubemap_16", "refined", 0.010, 60.0)]


def test_model_selection_is_compared_with_the_best_fixed_candidate():
    (found,) = compare(TABLE)
    assert found["best_fixed"] == "cubemap_16, refined"
    assert found["error_ratio"] == pytest.approx(1.03) and found["square_ratio"] == pytest.approx(1.03)
    assert found["time_ratio"] == pytest.approx(0.2)
    assert compare(TABLE[:1]) == []  # nothing to compare with


def test_rows_survive_the_table_and_are_not_measured_again(tmp_path, monkeypatch, capsys):
    table = tmp_path / "candidates.csv"
    write_rows(table, TABLE[:2])
    assert [float(old["held_out_abs"]) for old in read_rows(table)] == [0.0103, 0.02]
    measured = []

    def measure(inputs, clip, candidate, given):
        measured.append((clip, candidate, given))
        return [row(clip, candidate, mesh, 0.01, 60.0) for mesh in ("tracked", "refined")]

    monkeypatch.setattr(model_selection, "measure", measure)
    monkeypatch.setattr(model_selection, "compile_loops", lambda: None)
    monkeypatch.setattr(model_selection, "read_inputs", lambda *folders: None)
    arguments = ["--candidates", "auto", "least", "cubemap_16", "--set", "points=500", "--out", str(table)]
    assert main([str(tmp_path / "a"), *arguments]) == 0
    assert measured == [("a", "cubemap_16", {"points": "500"})]
    assert len(read_rows(table)) == 4
    assert "a: error 1.030 (mean squares 1.030), time 0.20 of cubemap_16, tracked" in capsys.readouterr().out
