"""The corpus of bad inputs, as far as it is refused: one clear line, exit code 2, nothing written.

`python tests/robustness/bad_inputs/measure.py` runs all of it to the end, those that give a result too, and takes the
time.
"""

import re
from pathlib import Path

import numpy as np
import pytest
from bad_inputs import CASES
from bad_inputs.measure import contents
from bad_inputs.settings import CANARY

from shared.contract import main as stage_main
from shared.contract.confine import TRUST, trust
from shared.contract.subject import load_subject
from shared.errors import InputError
from shared.tracking.given_tracking import read_given_landmarks, read_given_poses
from shared.tracking.models import load_face_networks
from tools.limn import main


def refused(at):
    """Names of the cases that this part refuses."""
    return [name for name, case in CASES.items() if case.words and case.at == at]


@pytest.fixture(scope="module")
def networks():
    try:
        return load_face_networks()
    except InputError as error:
        pytest.skip(f"the face networks are not set up: {error}")


def told(capsys, words):
    """The line on stderr that says it; without a traceback beside it."""
    error = capsys.readouterr().err
    assert "Traceback" not in error
    found = [line for line in error.splitlines() if re.search(words, line)]
    assert found, error
    return found[0]


def test_the_corpus_is_large_and_mixed():
    assert len(CASES) >= 60 and sum(not case.words for case in CASES.values()) >= 15


@pytest.mark.parametrize("name", refused("limn"))
def test_refused_before_anything_starts(tmp_path, capsys, name):
    arguments = CASES[name].build(tmp_path / "subject")
    folder = tmp_path / "subject"
    if "--subject" in arguments:
        folder, arguments = arguments[arguments.index("--subject") + 1], []
    out = [] if "--in-place" in arguments else ["--out", str(tmp_path / "out")]
    before = contents(tmp_path)
    code = main(["run", str(folder), *out, *(word for word in arguments if word != "--in-place")])
    assert code == 2
    line = told(capsys, CASES[name].words)
    assert line.isprintable() and len(line) < 2000
    assert contents(tmp_path) == before and not (tmp_path / CANARY).exists() and not Path(CANARY).exists()


@pytest.mark.parametrize("name", refused("sample_frames"))
def test_refused_by_sample_frames(tmp_path, capsys, networks, name):
    from stages import sample_frames

    CASES[name].build(tmp_path / "subject")
    before = contents(tmp_path)
    arguments = ["--subject", str(tmp_path / "subject"), "--out", str(tmp_path / "out"), "--threads", "1"]
    code = stage_main(sample_frames.STAGE, sample_frames.run, sample_frames.check, arguments)
    assert code == 2
    told(capsys, CASES[name].words)
    assert contents(tmp_path) == before


@pytest.mark.parametrize("name", refused("track_landmarks"))
def test_imports_that_are_refused(tmp_path, name):
    CASES[name].build(tmp_path / "subject")
    subject, index = load_subject(tmp_path / "subject"), np.arange(12)
    with pytest.raises(InputError, match=CASES[name].words) as caught:
        if subject.poses:
            read_given_poses(subject.poses, index)
        else:
            read_given_landmarks(subject.landmarks, index, (0.0, 0.0, 1.0))
    assert "\n" not in str(caught.value)
    assert not Path(CANARY).exists()


def test_links_into_a_trusted_folder_are_followed(tmp_path, monkeypatch):
    monkeypatch.setenv(TRUST, "")
    CASES["a link to a file elsewhere"].build(tmp_path / "subject")
    with pytest.raises(InputError, match="vouch for its folder"):
        load_subject(tmp_path / "subject")
    trust([tmp_path / "subject_beside"])
    assert load_subject(tmp_path / "subject").video.is_file()
