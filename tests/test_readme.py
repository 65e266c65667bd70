"""The README says what the code says."""

import importlib
import re
from pathlib import Path

import pytest

from shared.contract.pipeline import load_pipeline
from tools.readme import README, SCORES, cost_table, with_tables


def test_tables_are_up_to_date():
    text = README.read_text(encoding="utf-8")
    assert text == with_tables(text), "run: python -m tools.readme"


def test_costs_are_listed_by_rising_cost_without_ablations():
    scores = {name: 1.0 for name, _ in SCORES.values()}
    cost = {"wall_s": 10.0, "cpu_s": 20.0, "peak_mb": 300.0, "others": 0.0}
    rows = [
        {"case": name, "group": group, "settings": [], "repeat": 0, "threads": 2, "scores": scores,
         "stages": {"inverse_render": cost | {"cpu_s": seconds}}}
        for name, group, seconds in (("slow", "preset", 90.0), ("quick", "peer", 9.0), ("matte", "ablation", 5.0))
    ]  # fmt: skip
    rows[0]["stages"]["export_usd"] = cost
    table = cost_table(rows).splitlines()
    assert len(table) == 6 and table[2].startswith("| quick | 10 | 9 |  | 300 MB | 1.00 | 1.0 |")
    assert table[3].startswith("| slow | 10 | 90 | 20 | 300 MB")
    assert table[5].startswith("Medians of 1, from the clip to the maps, on 2 cores; other work kept 0.0 cores")


@pytest.mark.parametrize("stage", load_pipeline().steps)
def test_every_file_of_every_stage_is_explained(stage):
    text = (Path(README).parent / "docs" / "files.md").read_text(encoding="utf-8")
    for output in importlib.import_module(f"stages.{stage}").STAGE.outputs:
        assert any(f"`{output.path.replace('*', number)}`" in text for number in ("*", "%06d", "%04d")), output.path


def test_every_local_link_leads_somewhere():
    links = re.findall(r"\]\((?!https?:)([^)#]+)\)", README.read_text(encoding="utf-8"))
    assert links
    for link in links:
        assert (Path(README).parent / link).exists(), link
