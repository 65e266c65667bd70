"""What a stage loads: each library takes time before the first frame, and is on record as what made the result."""

import json

import pytest

FREE_OF = {
    "sample_frames": {"scipy", "numba", "torch", "pycolmap", "usd-core"},
    "track_landmarks": {"torch", "usd-core"},
    "init_albedo": {"torch", "pycolmap", "usd-core"},
    "inverse_render": {"pycolmap", "usd-core"},
    "export": {"torch", "pycolmap"},
}


@pytest.mark.parametrize("stage", FREE_OF)
def test_a_stage_loads_no_library_that_it_does_not_use(tiny_run, stage):
    folder = tiny_run / stage if stage == "export" else tiny_run / "work" / stage
    packages = json.loads((folder / "provenance.json").read_text())["packages"]
    assert "numpy" in packages and FREE_OF[stage].isdisjoint(packages)
