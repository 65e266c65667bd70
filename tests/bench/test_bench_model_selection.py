"""The benchmark of model selection: what it compares."""

import numpy as np
import pytest

from shared.imaging.frame_index import hold_out
from shared.imaging.views import Views
from tools.bench.clips import settings_of
from tools.bench.model_selection import CANDIDATES, compare, held_out_errors


def row(clip, candidate, mesh, error, seconds, more=0.0):
    """more: error of a frame that the choice did not take, above the others'."""
    frames = {"7": error - 0.001, "15": error + 0.001} | ({} if candidate == "auto" else {"23": error + more})
    return {"clip": clip, "candidate": candidate, "mesh": mesh, "held_out_frames": frames, "cpu_s": seconds,
            "light": "cubemap 8", "chosen": ""}


TABLE = [row("a", "auto", "tracked", 0.0103, 12.0), row("a", "least", "tracked", 0.02, 5.0),
         row("a", "cubemap_16", "tracked", 0.011, 30.0), row("a", "cubemap_16", "refined", 0.010, 60.0, more=0.1)]


def test_model_selection_is_compared_with_the_best_fixed_candidate():
    (found,) = compare(TABLE)
    assert found["best_fixed"] == "cubemap_16, refined"
    assert found["error_ratio"] == pytest.approx(1.03)
    assert found["time_ratio"] == pytest.approx(0.2)
    assert compare(TABLE[:1]) == []  # nothing to compare with


def test_a_clip_of_which_each_candidate_was_judged_by_other_frames_is_not_compared(capsys):
    other = TABLE[3] | {"held_out_frames": {"8": 0.01}}
    assert compare([TABLE[0], other]) == [] and capsys.readouterr().out.startswith("a: no frame was held out from all")


@pytest.mark.parametrize("count", [40, 24])
def test_errors_are_those_of_the_frames_that_were_held_out(count):
    """Of all forty views, or of as many as a choice left."""
    views = Views.in_one_light(np.tile(np.eye(4), (40, 1, 1)), np.eye(3), (8, 8), "head", None, None)
    views = views.with_fitted(hold_out(40, 8, views.light_index))
    found = held_out_errors(views, np.arange(count) / 100.0, settings_of({}))
    held_out = {str(frame) for frame in np.nonzero(~views.fitted)[0]}
    assert len(found) >= 2 and set(found) <= held_out
    if count == len(views):
        assert found == {frame: int(frame) / 100.0 for frame in held_out}


@pytest.mark.parametrize("candidate", CANDIDATES)
def test_its_settings_are_the_stages(candidate):
    assert settings_of(CANDIDATES[candidate]).appearance.light_model == CANDIDATES[candidate].get(
        "light_model", "cubemap")
