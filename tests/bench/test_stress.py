"""The stress test: its camera, its rule for the verdict, what it keeps and what it writes."""

import csv

import numpy as np
import pytest
from shapes import sphere

from shared.geometry.mesh import vertex_normals
from shared.geometry.transforms import project, rigid, vector_from_rotation
from shared.imaging.color import decode_srgb
from shared.io.arrays import load_arrays, read_json, save_arrays
from shared.io.images import read_exr, read_png, write_exr, write_png
from shared.io.meshes import read_obj, write_obj
from shared.rendering.envmap import latlong_lookup
from tools.bench.runner import Table, run
from tools.bench.stress.bench import StressBench, missing_cases, verdicts
from tools.bench.stress.camera import Sensor, compressed, defocused, drift, photograph, shaken, smeared
from tools.bench.stress.perturbations import PERTURBATIONS, Perturbation, StressCase
from tools.bench.stress.scenes import SETTINGS, StressScene, expressions_of, living_plan, smile_of
from tools.bench.stress.subject import mirror_truth, sliding_landmarks, wrong_poses
from tools.bench.stress.verdict import FAILED, LIMITS, RIGHT, SAID, SILENT, WARNED, judge
from tools.synthesis.head import head_turn

NO_NOISE = {"shot_noise": 0.0, "read_noise": 0.0}
GREY = np.full((2, 24, 32, 3), 0.2, np.float16)
STILL = np.zeros((2, 2))


def light_of(codes):
    return decode_srgb(codes / 255.0)


def test_exposure_gamma_and_noise_are_as_stated():
    codes = next(photograph(GREY, STILL, Sensor(exposure=2.0, **NO_NOISE)))
    assert np.abs(light_of(codes) - 0.4).max() < 0.004
    codes = next(photograph(GREY, STILL, Sensor(gamma=2.0, **NO_NOISE)))
    assert np.abs(light_of(codes) - 0.04).max() < 0.002
    noisy = light_of(next(photograph(np.full((1, 200, 200, 3), 0.25), STILL[:1], Sensor(shot_noise=0.02))))
    assert noisy.std() == pytest.approx(0.01, rel=0.1)
    assert (next(photograph(GREY, STILL, Sensor(exposure=8.0))) == 255).all()


def test_blur_keeps_the_light_and_spreads_it():
    dot = np.zeros((31, 31, 3), np.float32)
    dot[15, 15] = 1.0
    disc, line = defocused(dot, 3.0)[..., 0], smeared(dot, np.array([6.0, 0.0]))[..., 0]
    assert disc.sum() == pytest.approx(1.0, abs=1e-5) and line.sum() == pytest.approx(1.0, abs=1e-5)
    y, x = np.mgrid[-15:16, -15:16]
    assert (disc * (x**2 + y**2)).sum() == pytest.approx(3.0**2 / 2, rel=0.2)
    assert (line * x**2).sum() == pytest.approx(6.0**2 / 12, rel=0.1) and (line * y**2).sum() < 0.3
    assert defocused(dot, 0.0) is dot and smeared(dot, np.zeros(2)) is dot


def test_drifts_are_as_wide_as_stated():
    gains = np.stack([np.log(drift(Sensor(exposure_drift=0.3), i, 40, 8))[0, 0] for i in range(40)])
    assert np.abs(gains).max() == pytest.approx(0.3, rel=0.02) and np.ptp(gains, axis=1).max() < 1e-6
    white = np.stack([np.log(drift(Sensor(white_drift=0.1), i, 40, 8))[0, 0] for i in range(40)])
    assert np.abs(white[:, 1]).max() == 0.0 and np.allclose(white[:, 0], -white[:, 2], atol=1e-6)
    bands = np.log(drift(Sensor(bands=0.2), 3, 40, 200))[:, 0]
    assert np.ptp(bands, axis=0).max() == pytest.approx(0.4, rel=0.05)


def test_flicker_changes_whole_frames_from_one_to_the_next():
    gains = np.stack([np.log(drift(Sensor(flicker=0.15), i, 40, 8)) for i in range(40)])[:, :, 0]
    assert np.abs(gains).max() == pytest.approx(0.15, rel=0.02) and np.ptp(gains, axis=(1, 2)).max() < 1e-6
    assert np.abs(np.diff(gains[:, 0, 0])).mean() > 0.1


def test_log_curve_lifts_the_dark():
    half, whole = (next(photograph(GREY, STILL, Sensor(log_curve=s, **NO_NOISE)))[0, 0, 0] for s in (0.5, 1.0))
    plain = next(photograph(GREY, STILL, Sensor(**NO_NOISE)))[0, 0, 0]
    assert plain < half < whole == round(255 * np.log(41.0) / np.log(201.0))
    for light in (0.0, 1.0):
        codes = next(photograph(GREY * 0 + np.float16(light), STILL, Sensor(log_curve=1.0, **NO_NOISE)))
        assert (codes == round(255 * light)).all()


def test_a_shaking_camera_moves_pictures_as_its_poses_say():
    """A spot on the head is found where the turned pose projects it; frames with truth stay."""
    lens, point = np.array([[300.0, 0, 40], [0, 300.0, 40], [0, 0, 1]]), np.array([[6.0, -3.0, 0.0]])
    poses = rigid(np.tile(np.eye(3), (6, 1, 1)), np.tile([0.0, 0, 600.0], (6, 1)))
    rows, columns = np.mgrid[0:80, 0:80] + 0.5

    def spot(pose):
        place = project(point, pose, lens)[0].ravel()
        return np.exp(-((columns - place[0]) ** 2 + (rows - place[1]) ** 2) / 18.0)[..., None].repeat(3, axis=2)

    pictures = np.stack([spot(pose) for pose in poses]).astype(np.float32)
    moved, turned = shaken(pictures, poses, lens, 4.0, np.array([0, 3]))
    assert np.array_equal(turned[[0, 3]], poses[[0, 3]]) and np.allclose(moved[[0, 3]], pictures[[0, 3]], atol=1e-4)
    expected = np.stack([spot(pose) for pose in turned])
    assert np.abs(moved - expected).max() < 0.03 < np.abs(pictures - expected)[[1, 2, 4, 5]].max()


def test_the_truth_of_mirrored_pictures_is_mirrored(tmp_path):
    """Points of the mirrored head appear where the mirrored picture shows them, normals point outwards still, and twice
    mirrored is as before; what the files link to stays."""
    kept, folder = tmp_path / "scene", tmp_path / "gt"
    (kept / "frames").mkdir(parents=True)
    (folder / "frames").mkdir(parents=True)
    lens, size = np.array([[300.0, 0, 40], [0, 300.0, 40], [0, 0, 1]]), 80
    ball, poses, rng = sphere(50.0, 2), head_turn(5, 600.0, -20.0, 0), np.random.default_rng(0)
    normals = rng.normal(size=(size, size, 3)).astype(np.float32)
    write_obj(kept / "mesh.obj", ball)
    write_exr(kept / "frames" / "0000_normal.exr", normals, colour_space="data")
    write_png(kept / "frames" / "0000_mask.png", np.uint8(255 * (normals[..., 0] > 0)))
    for file in (kept / "mesh.obj", *sorted((kept / "frames").iterdir())):
        (folder / file.relative_to(kept)).symlink_to(file)
    save_arrays(folder / "poses.npz", camera_from_head=poses, K=lens)
    light = rng.uniform(size=(8, 16, 3)).astype(np.float32)
    write_exr(folder / "envmap.exr", light, colour_space="lin_rec709_scene", latlong=True)
    mirror_truth(folder)
    mesh, turned = read_obj(folder / "mesh.obj"), load_arrays(folder / "poses.npz")["camera_from_head"]
    assert np.linalg.det(turned[:, :3, :3]) == pytest.approx(1.0)
    pixels = project(mesh.vertices, turned[3], lens)[0]
    assert np.allclose([size, 0] + [-1, 1] * pixels, project(ball.vertices, poses[3], lens)[0], atol=1e-2)
    assert ((vertex_normals(mesh.vertices, mesh.faces) * mesh.vertices).sum(1) > 0).all()
    expected = normals[:, ::-1] * [-1, 1, 1]
    assert np.array_equal(read_exr(folder / "frames" / "0000_normal.exr"), expected.astype(np.float32))
    sky = latlong_lookup(read_exr(folder / "envmap.exr"), ball.vertices / 50.0)
    assert np.allclose(sky, latlong_lookup(light, ball.vertices / 50.0 * [-1, 1, 1]), atol=1e-2)
    mirror_truth(folder)
    assert np.array_equal(read_obj(folder / "mesh.obj").faces, read_obj(kept / "mesh.obj").faces)
    assert np.allclose(load_arrays(folder / "poses.npz")["camera_from_head"], poses)
    assert np.array_equal(read_png(folder / "frames" / "0000_mask.png"), read_png(kept / "frames" / "0000_mask.png"))
    assert np.array_equal(read_exr(kept / "frames" / "0000_normal.exr"), normals)


def test_compression_is_worse_the_lower_its_quality():
    codes = np.random.default_rng(0).integers(60, 200, (64, 64, 3)).astype(np.uint8)
    errors = [np.abs(compressed(codes, quality).astype(int) - codes).mean() for quality in (90, 30, 8)]
    assert errors[0] < errors[1] < errors[2] and compressed(codes, 0) is codes


def test_poses_and_landmarks_are_off_by_what_the_perturbation_says():
    poses = head_turn(40, 950.0, -20.0, 0)
    apart = vector_from_rotation(wrong_poses(poses, 2.0)[:, :3, :3].transpose(0, 2, 1) @ poses[:, :3, :3])
    assert np.degrees(np.sqrt((apart**2).sum(1).mean())) == pytest.approx(2.0)
    points = np.random.default_rng(0).normal(0, 40, (468, 3))
    moved = sliding_landmarks(poses, points, 0.05) - sliding_landmarks(poses, points, 0.0)
    width = np.ptp(sliding_landmarks(poses, points, 0.0)[..., 0], axis=1).mean()
    assert np.abs(moved[..., 0]).max() == pytest.approx(0.05 * width) and np.abs(moved[..., 1]).max() == 0.0


def test_the_smile_comes_and_goes():
    amount = smile_of(50)
    assert amount[0] == amount[-1] == 0.0 and amount.max() == 1.0 and 0.2 < (amount > 0).mean() < 0.4
    _, amount = expressions_of(StressScene(long_smile=0.8, frames=50))
    assert amount[0] == amount[-1] == 0.0 and amount.max() == 0.8 and 0.4 < (amount > 0).mean() < 0.5


def test_speech_goes_on_and_comes_back_to_closed_lips():
    actions, amount = expressions_of(StressScene(speech=0.5, frames=48))
    assert actions["jaw_open"] > 0 and amount.max() == 0.5
    assert np.diff(np.nonzero(amount == 0)[0]).max() < 8 and (amount == 0).sum() >= 5
    assert len(set(amount)) <= 5, "each opening is a head of its own"


def test_eyes_hold_the_camera_by_the_share_of_the_turn_and_blink_as_often_as_said():
    half, whole = (living_plan(StressScene(gaze=share, frames=8)) for share in (0.5, 1.0))
    assert np.abs(whole.eyes["gaze"][..., 0]).max() > np.radians(20.0)
    assert np.allclose(half.eyes["gaze"], 0.5 * whole.eyes["gaze"]) and len(half.truth) == SETTINGS.truth_frames
    blinking = living_plan(StressScene(blink=1.0, frames=48))
    shut = np.isnan(blinking.eyes["gaze"][:, 0, 0])
    assert (np.diff(shut.astype(int)) == 1).sum() == 2 and not shut[blinking.truth].any()
    assert np.array_equal(blinking.eyes["gaze"][~shut], np.zeros(((~shut).sum(), 2, 2)))


def test_scenes_rendered_before_there_were_moving_eyes_are_still_known():
    assert "gaze" not in StressScene().content and StressScene(gaze=0.5).content["gaze"] == 0.5
    assert len({StressScene().name, StressScene(gaze=0.5).name, StressScene(blink=1.0).name}) == 3
    assert StressScene().settings.eyes == "open" and StressScene(blink=1.0).settings.eyes == "living"


def row(exit_code=0, warnings=(), missed=(), **worse):
    scores = {name: 0.5 * limit.most for name, limit in LIMITS.items()} | {"confident_albedo": 1.0}
    scores |= {"confident_albedo_p90": 2.0} | worse
    return {"exit": exit_code, "message": "no face", "scores": scores, "warnings": list(warnings),
            "missed_gates": list(missed)}


@pytest.mark.parametrize(("case", "word", "wrong"), [
    (row(), RIGHT, ()),
    (row(warnings=["the focus is off by 3 px"]), WARNED, ()),
    (row(normals=99.0), SILENT, ("normals",)),
    (row(normals=None), SILENT, ("normals",)),
    (row(normals=99.0, warnings=["the focus is off by 3 px"]), SAID, ("normals",)),
    (row(normals=99.0, warnings=["only 7 usable frames"]), SILENT, ("normals",)),
    (row(normals=99.0, warnings=["out of focus in 31 of 32 frames"]), SILENT, ("normals",)),
    (row(normals=99.0, missed=["confidence 0.3 (expected >= 0.7)"]), SAID, ("normals",)),
    (row(normals=99.0, missed=["coverage 0.4 (expected >= 0.6)"]), SILENT, ("normals",)),
    (row(albedo=99.0), SAID, ("albedo",)),
    (row(albedo=99.0, confident_albedo=98.0), SILENT, ("albedo",)),
    (row(albedo=99.0, normals=99.0), SILENT, ("albedo", "normals")),
    (row(2), SAID, ()),
    (row(1), FAILED, ()),
])
def test_the_verdict_follows_the_stated_rule(case, word, wrong):
    """The perturbation at 0 gives one warning about the focus, too, and misses a gate: neither counts any more."""
    zero = row(warnings=["out of focus in 2 of 32 frames"], missed=["coverage 0.5 (expected >= 0.6)"])
    verdict = judge("focus", case, zero)
    assert (verdict.word, verdict.wrong) == (word, wrong)
    assert bool(verdict.said) == (word in (SAID, WARNED))


def test_what_is_bad_at_zero_already_may_grow_by_its_factor():
    zero = row(normals=50.0)
    limit = LIMITS["normals"].growth * 50.0
    assert judge("focus", row(normals=limit - 0.1), zero).word == RIGHT
    assert judge("focus", row(normals=limit + 0.1), zero).word == SILENT


def test_the_perturbations_are_told_apart_and_grow():
    assert len({perturbation.name for perturbation in PERTURBATIONS}) == len(PERTURBATIONS)
    for perturbation in PERTURBATIONS:
        assert list(perturbation.severities) == sorted(perturbation.severities) and perturbation.severities[0] > 0
        digests = {perturbation.make(severity).digest for severity in perturbation.severities} | {StressCase().digest}
        assert len(digests) == len(perturbation.severities) + 1, perturbation.name


def test_a_case_is_known_by_all_that_decides_it():
    assert StressCase().digest == StressCase(mix=((StressScene(), 1.0),), sensor=Sensor()).digest
    assert len({StressCase().digest, StressCase(focal_gain=1.1).digest, StressCase(sensor=Sensor(jpeg=50)).digest,
                StressCase(mix=((StressScene(seed=1), 1.0),)).digest,
                StressCase(mix=((StressScene(), 0.5),)).digest}) == 5


TOY = (Perturbation("toy", "a toy", "units", (1.0, 2.0), lambda s: StressCase(focal_gain=1.0 + s), "toy"),
       Perturbation("other", "another", "units", (1.0,), lambda s: StressCase(keep=5), "other"))


class ToyStress(StressBench):
    """Cases that need no rendering; ran: their names in the order in which they were run."""

    perturbations, ran, version = TOY, [], "this code"

    @property
    def code(self):
        return self.version

    def measure(self, case, entry):
        self.ran.append(entry.name)
        own = {"toy_1": row(warnings=["a toy"]), "toy_2": row(normals=99.0, albedo=float("nan"))}
        entry.table.drop(entry.name, entry.repeat)
        entry.add({"digest": case.digest, "code": self.code, "making_s": 1.0, "seconds": 1.0,
                   **own.get(entry.name, row())})


@pytest.fixture
def toy(tmp_path):
    ToyStress.ran.clear()
    return lambda *words: run(ToyStress, "stress", ["--out", str(tmp_path), "--work", str(tmp_path), *words])


def test_rows_are_kept_and_only_what_is_missing_runs(toy, tmp_path, monkeypatch):
    assert toy() == 1 and ToyStress.ran == ["unspoilt", "toy_2", "other_1", "toy_1"]
    assert toy() == 1 and len(ToyStress.ran) == 4
    table = Table.open(tmp_path / "stress.json", {})
    table.drop("other_1", 0)
    table.save()
    assert missing_cases(table.rows, TOY) == ["another (1)"]
    toy()
    assert ToyStress.ran[4:] == ["other_1"]
    monkeypatch.setattr(ToyStress, "version", "other code")
    assert toy("--keep-old") == 1 and len(ToyStress.ran) == 5
    assert "an earlier version of a stage" in (tmp_path / "stress.md").read_text()
    assert toy("--only", "other") == 1 and ToyStress.ran[5:] == ["unspoilt", "other_1"]


def test_without_the_unchanged_case_there_is_no_verdict(toy, tmp_path, capsys):
    assert toy("--minutes", "-1") == 2 and ToyStress.ran == [] and "no result" in capsys.readouterr().err
    assert verdicts([{"digest": TOY[0].make(1.0).digest, **row()}], TOY) == []


def test_verdicts_stand_in_the_table_the_page_and_the_picture(toy, tmp_path):
    toy()
    with open(tmp_path / "stress.csv", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [(r["perturbation"], r["severity"], r["verdict"]) for r in rows] == [
        ("toy", "0", RIGHT), ("toy", "1", WARNED), ("toy", "2", SILENT), ("other", "0", RIGHT), ("other", "1", RIGHT)]
    assert rows[2]["wrong"] == "albedo normals" and rows[2]["albedo"] == ""
    page = (tmp_path / "stress.md").read_text()
    assert "| a toy | 2 units |" in page and "**99**" in page
    assert "3 cases, wrong and silent or failed: 1" in page and "Not run yet" not in page
    chart = (tmp_path / "stress.svg").read_text()
    assert chart.count("<polyline") == 2 * len(LIMITS) and chart.count("<title>") == 5


def test_an_unknown_perturbation_is_refused(toy, tmp_path):
    assert toy("--only", "rain") == 2 and not (tmp_path / "stress.json").exists()


def test_a_row_tells_what_was_run(tmp_path, monkeypatch):
    """StressBench itself, with a subject that cannot be read: refused, and kept as such."""
    def refused(case, folder, scenes):
        folder.mkdir(parents=True)
        (folder / "subject.yaml").write_text("video: absent.mp4\n")
        return folder

    monkeypatch.setattr("tools.bench.stress.bench.make_subject", refused)
    words = ["--out", str(tmp_path), "--work", str(tmp_path), "--only", "unspoilt"]
    assert run(StressBench, "stress", words) == 2  # nothing to compare with
    (kept,) = read_json(tmp_path / "stress.json")["rows"]
    assert kept["exit"] == 2 and "absent.mp4" in kept["message"] and kept["code"].startswith("1.")
