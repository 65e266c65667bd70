"""Clips of one head brought into one head space; and the tiny subject under two lights, from subject.yaml to report."""

import json
from dataclasses import dataclass, replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from field_check import field_faults
from quick import QUICK, TINY
from shapes import grid_plane, turned
from toy_head import toy_head

from shared.appearance.light_tint import LightTint
from shared.contract.records import RUN, SOLVE, SOLVED_POSES
from shared.errors import InputError
from shared.geometry.mesh import interpolate, vertex_normals
from shared.geometry.surface import Surface, TrackPoints
from shared.geometry.transforms import Similarity, project, rigid, rotation_from_vector
from shared.imaging.color import decode_transfer, encode_srgb
from shared.imaging.views import Views
from shared.inverse import joint_clips
from shared.inverse.joint_clips import join_clips
from shared.inverse.texture_match import ClipTexture, Matches, match_textures

LENS = np.array([[900.0, 0, 128], [0, 900.0, 128], [0, 0, 1]])
HEAD = toy_head(4).mesh(np.zeros(2), np.zeros(1))
MOVED = Similarity(1.07, rotation_from_vector(np.array([0.03, -0.05, 0.02])), np.array([3.0, -2.0, 4.0]))
"""Takes the second clip's head space to the first one's."""


def swing(frames, widest):
    nod, turn = 0.1 * np.cos(np.arange(frames)), np.linspace(-widest, widest, frames)
    vectors = np.stack([nod, turn, np.zeros(frames)], axis=1)
    return turned(vectors, (5.0, 3.0, 700.0))


def toy_clip(frames, widest, error_px, seed, second=False):
    """A clip whose track points lie on the head; second: in a head space of another place and size."""
    rng = np.random.default_rng(seed)
    front = np.nonzero(HEAD.vertices[HEAD.faces].mean(1)[:, 2] > 10.0)[0]
    face, bary = rng.choice(front, 400), rng.dirichlet(np.ones(3), 400)
    points = interpolate(HEAD.vertices, HEAD.faces, face, bary) + rng.normal(0.0, 0.05, (400, 3))
    poses, mesh = swing(frames, widest), HEAD
    if second:
        # The same pictures, seen by a camera whose space shrank with the head.
        turn = poses[:, :3, :3] @ MOVED.rotation
        poses = rigid(turn, (poses[:, :3, :3] @ MOVED.translation + poses[:, :3, 3]) / MOVED.scale)
        bent = MOVED.inverse_points(HEAD.vertices) + rng.normal(0.0, 0.3, HEAD.vertices.shape)
        points, mesh = MOVED.inverse_points(points), HEAD.replace(vertices=bent)
    views = Views.in_one_light(poses, LENS, (256, 256), "head", lambda f: (seed, f), None)
    surface = Surface(mesh, tracks=TrackPoints.tracked(points, np.full(400, error_px)))
    return ToyInputs(views, surface)


@dataclass(frozen=True)
class ToyInputs:
    """A clip as it lies on disk, as far as joining reads it."""

    views: Views
    surface: Surface
    charts: tuple = ()
    tints: tuple = ()
    frames = SimpleNamespace(source_name="clip.avi")

    def chart_observations(self):
        return self.charts

    def light_tints(self):
        return self.tints

    def without_tracks(self):
        return replace(self, surface=replace(self.surface, tracks=None))


def test_poses_come_into_the_head_space_of_the_clip_that_knows_depth_best(monkeypatch):
    """Depth that the second clip got wrong does not enter, nor do some matches of other skin."""
    first, second = toy_clip(6, 0.5, 0.1, 0), toy_clip(4, 0.3, 0.2, 1, second=True)
    front = np.nonzero(HEAD.vertices[:, 2] > 20.0)[0]
    there = second.surface.mesh.vertices[front].copy()
    there[::10] += 8.0
    normals = vertex_normals(second.surface.mesh.vertices, second.surface.mesh.faces)[front]
    matches = Matches(HEAD.vertices[front], there, normals)
    monkeypatch.setattr(joint_clips, "match_textures", lambda one, two: matches)
    for clips in ((first, second), (second, first)):
        joint = join_clips(clips, (None, None))
        assert clips[joint.main] is first and joint.surface is first.surface and joint.surface.mesh is HEAD
        start = 0 if clips[0] is second else 6
        truth = project(HEAD.vertices, swing(4, 0.3), LENS)[0]
        found = project(HEAD.vertices, joint.views.camera_from_head[start : start + 4], LENS)[0]
        assert np.abs(found - truth)[:, front].max() < 0.3
        assert np.linalg.norm(found - truth, axis=-1)[:, front].mean() < 0.1
        assert joint.views.light_index.tolist() == [0] * len(clips[0].views) + [1] * len(clips[1].views)
        pictures = [joint.views.picture(f) for f in range(10)]
        assert pictures == [clip.views.picture(f) for clip in clips for f in range(len(clip.views))]
        part = joint.views.take(np.array([1, 7, 9]))
        assert [part.picture(k) for k in range(3)] == [pictures[f] for f in (1, 7, 9)]
        assert np.array_equal(part.camera_from_head, joint.views.camera_from_head[[1, 7, 9]])
        said = joint.describe()
        assert [clip["mesh"] for clip in said] == [clip is first for clip in clips]
        assert said[start != 0]["matched_texels"] == len(front) and 0.0 < said[start != 0]["match_px"] < 0.8


def test_clips_without_common_skin_are_refused(monkeypatch):
    clips = toy_clip(6, 0.5, 0.1, 0), toy_clip(4, 0.3, 0.2, 1, second=True)
    none = Matches(*(np.zeros((5, 3)) for _ in range(3)))
    monkeypatch.setattr(joint_clips, "match_textures", lambda one, two: none)
    with pytest.raises(InputError, match="do not show the same skin"):
        join_clips(clips, (None, None))


def test_mean_textures_show_the_same_skin_where_they_are_shifted():
    """A pattern 2.5 texels further to the right, brighter on one side: pairs lie that far apart, and off it none."""
    plane, size = grid_plane(9, 100.0), 192
    noise = cv2.GaussianBlur(np.random.default_rng(4).normal(size=(size, size)), (0, 0), 2.0)
    skin = 0.3 * np.exp(1.5 * noise)
    moved = cv2.warpAffine(skin, np.array([[1.0, 0.0, 2.5], [0.0, 1.0, 0.0]]), (size, size), borderMode=cv2.BORDER_WRAP)
    lit = moved * np.linspace(0.3, 1.2, size)[:, None]
    weight = np.full((size, size), 5.0)
    weight[:, 150:] = 0.0
    textures = [ClipTexture(plane, np.repeat(image[..., None], 3, 2), weight) for image in (skin, lit)]
    found = match_textures(*textures)
    here, there = found.first, found.second
    assert 0.5 * size * 150 < len(here) <= size * 150
    texel = np.ptp(plane.vertices, axis=0).max() / size
    assert np.median(np.linalg.norm(there - here, axis=1)) == pytest.approx(2.5 * texel, rel=0.1)
    blind = ClipTexture(plane, textures[1].mean, np.zeros((size, size)))
    assert len(match_textures(textures[0], blind)) == 0
    other = cv2.GaussianBlur(np.random.default_rng(5).normal(size=(size, size)), (0, 0), 2.0)
    stranger = ClipTexture(plane, np.repeat(0.3 * np.exp(1.5 * other)[..., None], 3, 2), weight)
    assert len(match_textures(textures[0], stranger)) < 0.1 * len(here)


def test_given_meshes_share_a_head_space_already():
    clips = [toy_clip(4, 0.3, 0.1, seed).without_tracks() for seed in range(2)]
    joint = join_clips(clips, ())
    assert joint.main == 0 and joint.surface.tracks is None
    assert np.array_equal(joint.views.camera_from_head, np.concatenate([clip.views.camera_from_head for clip in clips]))


def test_each_clip_says_what_its_own_grey_place_shows():
    clips = [toy_clip(4, 0.3, 0.2, seed).without_tracks() for seed in range(3)]
    assert join_clips(clips, ()).light_tints() == ()
    tint = LightTint((0.3, -0.4), (0.06, 0.07))
    clips[1] = replace(clips[1], tints=(tint,))
    assert join_clips(clips, ()).light_tints() == (None, tint, None)


def test_the_chart_of_the_first_clip_that_shows_one_counts():
    from shared.capture.chart import ChartObservation

    clips = [toy_clip(4, 0.3, 0.1, seed).without_tracks() for seed in range(3)]
    observation = ChartObservation(*(np.zeros(1) for _ in range(5)), frame=2, frame_index=7)
    clips[1:] = [replace(clip, charts=(observation,)) for clip in clips[1:]]
    (found,) = join_clips(clips, ()).chart_observations()
    assert (found.frame, found.frame_index) == (6, 7)


# ---------------------------------------------------------------------- from end to end

GAIN = np.array([0.55, 0.7, 0.9])
SHARPER = tuple(word for setting in (
    "track_landmarks.tracks=600", "track_landmarks.flow_tracks=300", "track_landmarks.texel_px=1",
    "track_landmarks.warp_width=200", "init_albedo.size=256", "init_albedo.frames=12", "inverse_render.light_steps=12",
    "inverse_render.light_frames=12", "inverse_render.points=500", "export_usd.usdz=false", "export_usd.glb=false",
) for word in ("--set", setting))


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """The tiny clip, and the same in a dimmer, colder light and backwards; its run."""
    from tools.limn import main

    subject = tmp_path_factory.mktemp("pair") / "both"
    (subject / "day").mkdir(parents=True)
    (subject / "dusk").mkdir()
    pictures = [cv2.imread(str(path)) for path in sorted((TINY / "frames").glob("*.png"))]
    for i, codes in enumerate(pictures):
        cv2.imwrite(str(subject / "day" / f"{i:04d}.png"), codes)
        dimmed = encode_srgb(decode_transfer(codes / 255.0, "srgb") * GAIN[::-1])
        place = subject / "dusk" / f"{len(pictures) - 1 - i:04d}.png"
        cv2.imwrite(str(place), np.round(dimmed * 255).astype(np.uint8))
    lens = next(line for line in (TINY / "subject.yaml").read_text().splitlines() if line.startswith("camera"))
    clips = "clips:\n" + "".join(f"  {name}: {{video: {name}/%04d.png}}\n" for name in ("day", "dusk"))
    (subject / "subject.yaml").write_text(clips + lens + "\n")
    assert main(["run", str(subject), *QUICK, *SHARPER, "--cores", "1"]) in (0, 3)
    return subject


def test_each_clip_gets_a_light_of_its_own(pair):
    from shared.io.images import read_exr

    day, dusk = (read_exr(pair / "export" / "envmaps" / f"{name}.exr") for name in ("day", "dusk"))
    assert np.array_equal(day, read_exr(pair / "export" / "envmap.exr"))
    solid_angle = np.sin(np.pi * (np.arange(len(day)) + 0.5) / len(day))
    day, dusk = (np.einsum("ywc,y->c", light, solid_angle) for light in (day, dusk))
    assert np.allclose(dusk / day, GAIN, rtol=0.03)


def test_poses_of_both_clips_are_those_of_one_head(pair):
    from shared.io.arrays import load_arrays

    solved = pair / "work" / "inverse_render"
    day, dusk = (load_arrays(folder / "poses.npz") for folder in (solved, solved / "clips" / "dusk"))
    last = max(day["frame_index"].max(), dusk["frame_index"].max())
    place = {int(last - frame): k for k, frame in enumerate(dusk["frame_index"])}
    shared = [(k, place[int(frame)]) for k, frame in enumerate(day["frame_index"]) if int(frame) in place]
    assert len(shared) >= 8
    for k, other in shared:
        turn = day["camera_from_head"][k, :3, :3] @ dusk["camera_from_head"][other, :3, :3].T
        assert np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))) < 1.5
    assert np.array_equal(load_arrays(pair / "export" / "poses.npz")["camera_from_head"], day["camera_from_head"])


def test_record_and_report_show_both_clips(pair):
    record = json.loads((pair / "export" / "run.json").read_text())
    assert [clip["name"] for clip in record["clips"]] == ["day", "dusk"]
    assert sum(clip["mesh"] for clip in record["clips"]) == 1
    assert set(record["stages"]) == {"inverse_render", "export_usd", *(
        f"{clip}/{stage}" for clip in ("day", "dusk") for stage in ("sample_frames", "track_landmarks", "init_albedo"))}
    assert record["model"]["light"].startswith("2 lights, each a cubemap")
    page = (pair / "export" / "report.html").read_text()
    assert "<h3>dusk</h3>" in page and "day/track_landmarks" in page
    renders = list((pair / "work" / "inverse_render" / "clips" / "dusk" / "renders").glob("*.exr"))
    assert len(renders) == 1


def test_files_of_both_clips_hold_what_is_declared(pair):
    from shared.io.arrays import load_arrays

    solved = pair / "work" / "inverse_render"
    assert field_faults(json.loads((solved / "solve.json").read_text()), SOLVE) == []
    assert field_faults(json.loads((pair / "export" / "run.json").read_text()), RUN) == []
    assert field_faults(load_arrays(solved / "clips" / "dusk" / "poses.npz"), SOLVED_POSES) == []


def test_what_takes_one_clip_says_so(pair, capsys):
    from tools.limn import main

    assert main(["run", str(pair), *QUICK, *SHARPER, "--set", "inverse_render.fit_frames=4"]) == 2
    assert "inverse_render.fit_frames: works on one clip only" in capsys.readouterr().err
