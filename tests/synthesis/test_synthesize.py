"""The procedural subject: light transport against closed forms and brute force, files, determinism, looks."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from brute_force import reference_radiance
from quadrature import hemisphere_quadrature
from quick import TINY

from shared.capture.chart import CORNERS, reflectances
from shared.capture.chart_finder import read_chart
from shared.errors import InputError
from shared.geometry.mesh import Mesh
from shared.geometry.transforms import (
    WORLD_FROM_CAMERA,
    project,
    rigid,
    rotation_from_vector,
    vector_from_rotation,
    world_from_head,
)
from shared.imaging.texture import sample_bilinear
from shared.io.images import read_exr, read_png
from shared.io.meshes import read_obj
from shared.rendering import brdf
from shared.rendering.envmap import latlong_directions
from shared.tracking.models import load_face_networks
from tools.synthesis.camera import PictureQuality, PinholeCamera, take_picture
from tools.synthesis.chart import PlacedChart, add_chart, chart_irradiance
from tools.synthesis.head import DRIFT_DEG, YAW_DEG, head_turn
from tools.synthesis.highlights import LobeSamples, sample_lobe, specular_radiance
from tools.synthesis.irradiance import (
    IrradianceQuality,
    SyntheticShot,
    assemble_atlas,
    covered_texels,
    group_irradiance,
)
from tools.synthesis.light import ENVIRONMENTS, EnvironmentLight, LampSphere, procedural_environment
from tools.synthesis.output import ClipWriter, rounded, sensor_codes, write_scene_truth
from tools.synthesis.render import RenderQuality, Scene, render
from tools.synthesis.sampling import shifted_hammersley
from tools.synthesis.subject import PRESETS, light_of, main, procedural, synthesize
from tools.synthesis.surface import Materials, SyntheticSurface

FRONT = rigid(WORLD_FROM_CAMERA, np.array([0.0, 0.0, 950.0]))
ALBEDO = (0.6, 0.4, 0.3)


def round_mesh(radius, polar_end: float, inward: bool, count: int = 48) -> Mesh:
    """A globe (or its lower part, down from polar angle pi - polar_end), welded; uv by longitude and latitude."""
    polar = np.pi - np.linspace(0, polar_end, count + 1)[1:]
    azimuth = 2 * np.pi * np.arange(2 * count) / (2 * count)
    p, a = np.meshgrid(polar, azimuth, indexing="ij")
    unit = np.stack([np.sin(p) * np.sin(a), np.cos(p), np.sin(p) * np.cos(a)], -1)
    vertices = np.concatenate([[[0.0, -1.0, 0.0]], unit.reshape(-1, 3)])
    row = 1 + np.arange(count)[:, None] * 2 * count
    ring = np.concatenate([np.zeros((1, 2 * count), int), row + np.arange(2 * count)])
    ring = np.concatenate([ring, ring[:, :1]], 1)
    u, v = np.meshgrid(np.linspace(0, 1, 2 * count + 1), np.linspace(0, 1, count + 1))
    uv_index = np.arange((count + 1) * (2 * count + 1)).reshape(count + 1, -1)

    def quads(index: np.ndarray) -> np.ndarray:
        a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
        faces = np.stack([np.stack([a, b, d], -1), np.stack([a, d, c], -1)], 2).reshape(-1, 3)
        return faces[:, ::-1] if inward else faces

    faces, face_uvs = quads(ring), quads(uv_index)
    solid = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])
    shape = vertices * (radius(vertices)[:, None] if callable(radius) else radius)
    uvs = np.stack([u, v], -1).reshape(-1, 2)
    return Mesh(shape, faces[solid].astype(np.int32), uvs, face_uvs[solid].astype(np.int32))


def plain(specular: float = 1.0, roughness: float = 0.4, albedo: tuple = ALBEDO) -> Materials:
    one = np.ones((4, 4), np.float32)
    return Materials(one[..., None] * np.float32(albedo), specular * one, roughness * one, one)


def constant_light(radiance: tuple = (1.0, 2.0, 3.0)) -> EnvironmentLight:
    return EnvironmentLight(np.ones((16, 32, 1)) * np.float32(radiance))


def irradiance_of(surface: SyntheticSurface, lights: list, shots: list[SyntheticShot],
                  quality: IrradianceQuality) -> np.ndarray:
    groups = [group_irradiance(surface, lights, shots, group, quality, 0) for group in range(quality.groups)]
    return assemble_atlas(surface, groups, quality.size, quality.bounces)


FRONT_SHOT = SyntheticShot(FRONT, np.eye(3), 0, 1)
COARSE = IrradianceQuality(size=48, directions=1024, lamp_samples=16, groups=4)


def test_a_globe_in_a_white_furnace_reflects_its_albedo_and_the_lobe():
    surface = SyntheticSurface(round_mesh(80.0, np.pi, inward=False), plain())
    light = constant_light()
    irradiance = irradiance_of(surface, [light], [FRONT_SHOT], COARSE)[:, :, 0]
    np.testing.assert_allclose(irradiance.mean((0, 1)), np.pi * np.array([1, 2, 3]), rtol=0.01)
    images = take_picture(surface, light, irradiance, FRONT_SHOT, PinholeCamera(64, 64, 300.0),
                          PictureQuality(2, 16, 4))
    whole = images["head"] == 1
    y, x = np.nonzero(whole)
    position = np.stack([(x - 31.5) / 300.0, (31.5 - y) / 300.0, -np.ones(len(x))], 1)
    cosine = (images["normal"][whole] * -position).sum(1) / np.linalg.norm(position, axis=1)
    expected = np.array(ALBEDO) + brdf.directional_albedo(cosine, 0.4)[:, None]
    middle = cosine > 0.5
    found = images["radiance"][whole] / [1, 2, 3]
    np.testing.assert_allclose(found[middle].mean(0), expected[middle].mean(0), rtol=0.01)
    assert np.abs(found - expected)[middle].mean() < 0.01


@pytest.mark.parametrize("bounces", [0, 1, IrradianceQuality.bounces])
def test_a_half_sphere_bowl_under_a_white_sky_has_its_known_irradiance(bounces):
    """Between two points of a sphere the form factor is constant, dA / (4 pi R^2): from anywhere inside a half sphere
    half of the light is blocked, and each bounce returns albedo / 2 of what arrived, all of them together
    E = pi L / 2 / (1 - albedo / 2)."""
    surface = SyntheticSurface(round_mesh(80.0, np.pi / 2, inward=True), plain())
    quality = replace(COARSE, bounces=bounces)
    irradiance = irradiance_of(surface, [constant_light((1, 1, 1))], [FRONT_SHOT], quality)[4:-4, :, 0]
    share = 0.5 * np.array(ALBEDO)
    expected = 0.5 * np.pi * (1 - share ** (bounces + 1)) / (1 - share)
    np.testing.assert_allclose(irradiance.mean((0, 1)), expected, rtol=0.015)


def test_lobe_samples_integrate_to_the_directional_albedo():
    points = shifted_hammersley(4096, 1, np.random.default_rng(0))
    for cosine in (1.0, 0.6, 0.2):
        outgoing = np.array([[np.sqrt(1 - cosine**2), 0.0, cosine]])
        _, weight = sample_lobe(np.array([[0.0, 0.0, 1.0]]), outgoing, np.array([0.4]), points)
        assert weight.mean() == pytest.approx(float(brdf.directional_albedo(np.array([cosine]), 0.4)[0]), rel=0.01)


def test_specular_of_a_lit_globe_matches_a_numeric_integral():
    light = EnvironmentLight(procedural_environment("studio", 3))
    surface = SyntheticSurface(round_mesh(80.0, np.pi, inward=False), plain())
    directions, solid_angle = hemisphere_quadrature(96, 192)
    rng = np.random.default_rng(0)
    samples = LobeSamples.draw(light, np.eye(3), 256, 256, rng)
    face = rng.integers(len(surface.mesh.faces), size=40)
    points = surface.points(face, np.full((40, 3), 1 / 3))
    outgoing = points.normal + 0.3 * rng.normal(size=(40, 3))
    outgoing = (outgoing / np.linalg.norm(outgoing, axis=1, keepdims=True)).astype(np.float32)
    found = specular_radiance(surface, light, np.zeros((8, 8, 3), np.float32), np.eye(3), points, outgoing,
                            np.full(40, 0.4, np.float32), samples, np.arange(40))
    expected = []
    for normal, towards in zip(points.normal, outgoing, strict=True):
        first = np.cross(normal, [0.3, 0.5, 0.8])
        first /= np.linalg.norm(first)
        world = directions @ np.stack([first, np.cross(normal, first), normal])
        lobe = brdf.specular_cosine(normal @ towards, directions[:, 2], world @ towards, 0.4)
        expected.append((light.radiance(world) * (lobe * solid_angle)[:, None]).sum(0))
    np.testing.assert_allclose(found, expected, rtol=0.06, atol=6e-4)
    np.testing.assert_allclose(found.mean(0), np.mean(expected, 0), rtol=0.01)


def test_the_fast_renderer_agrees_with_brute_force():
    """On a knobbly globe with shadows and interreflection, under a window and a lamp."""
    def radius(unit: np.ndarray) -> np.ndarray:
        return 80 * (1 + 0.18 * np.sin(5 * unit[:, 0]) * np.cos(6 * unit[:, 1]) * np.cos(4 * unit[:, 2] + 1))

    surface = SyntheticSurface(round_mesh(radius, np.pi, inward=False, count=32), plain(specular=0.8, roughness=0.45))
    light = EnvironmentLight(0.5 * procedural_environment("room", 1))
    turn = world_from_head(FRONT[None], "head")[0]
    quality = IrradianceQuality(size=96, directions=2048, lamp_samples=32, groups=8)
    irradiance = irradiance_of(surface, [light], [SyntheticShot(FRONT, turn, 0, 1)], quality)[:, :, 0]
    rng = np.random.default_rng(2)
    faces = np.nonzero(surface.mesh.vertices[surface.mesh.faces].mean(1)[:, 2] > 30)[0]
    points = surface.points(rng.choice(faces, 150), np.full((150, 3), 1 / 3))
    outgoing = np.array([0, 0, 950.0]) - points.position
    outgoing = (outgoing / np.linalg.norm(outgoing, axis=1, keepdims=True)).astype(np.float32)
    specular, roughness = np.full(150, 0.8, np.float32), np.full(150, 0.45, np.float32)
    reflected = specular_radiance(surface, light, irradiance, turn, points, outgoing, roughness,
                                  LobeSamples.draw(light, turn, 128, 128, rng), np.arange(150) % 64)
    fast = np.array(ALBEDO) / np.pi * sample_bilinear(irradiance, points.uv) + 0.8 * reflected
    slow, error = reference_radiance(surface, light, turn, points, outgoing, specular, roughness, 1500, seed=4)
    assert np.abs(fast.mean(0) / slow.mean(0) - 1).max() < 0.01
    tolerance = 4 * error + 0.03 * slow.mean()
    assert (np.abs(fast - slow) < tolerance).mean() > 0.98


def test_a_near_lamp_gives_what_the_inverse_square_says():
    """Intensity over squared distance times the cosine, wherever the head stands and however it is turned; at the
    lamps' centre what a far lamp gives."""
    image = procedural_environment("lamp", 0)
    far, centre = EnvironmentLight(image), np.array([30.0, -20.0, -900.0])
    near = EnvironmentLight(image, LampSphere(centre, 400.0))
    surface = SyntheticSurface(round_mesh(80.0, np.pi, inward=False), plain())
    turn = rotation_from_vector(np.array([0.1, 0.5, -0.2]))
    shot = SyntheticShot(rigid(WORLD_FROM_CAMERA @ turn, np.array([10.0, 5.0, 1000.0])), turn, 0, 1)
    quality = replace(COARSE, lamp_samples=64)
    direct, under_far = (group_irradiance(surface, [light], [shot], 0, quality, 0).direct[:, 0]
                         for light in (near, far))
    _, face, bary = covered_texels(surface, COARSE.size)
    points = surface.points(face, bary)
    chosen = np.random.default_rng(0).integers(COARSE.groups, size=len(face)) == 0
    world = points.position[chosen] @ turn.T + WORLD_FROM_CAMERA @ shot.camera_from_head[:3, 3]
    normal = points.normal[chosen] @ turn.T
    lamp = centre + 400.0 * near.main_lamp()
    towards = lamp - world
    distance = np.linalg.norm(towards, axis=1)
    cosine = (towards * normal).sum(1) / distance
    expected = far.lamp_irradiance(near.main_lamp()) * (cosine * 400.0**2 / distance**2)[:, None]
    found = direct - under_far + far.lamp_irradiance(normal)  # without the smooth rest, which is the same in both
    lit = (cosine > 0.3) & (normal @ near.main_lamp() > 0.1)
    assert lit.sum() > 30 and np.ptp(distance[lit]) > 40.0
    np.testing.assert_allclose(found[lit], expected[lit], rtol=0.02)
    assert np.abs(found[cosine < -0.2]).max() < 0.01 * expected.max()


def test_highlights_of_a_near_lamp_are_those_of_a_far_one_where_it_is_seen():
    """At one point, a near lamp is a far one in another direction and of another strength."""
    image, centre = procedural_environment("lamp", 0), np.zeros(3)
    light = EnvironmentLight(image, LampSphere(centre, 500.0))
    surface = SyntheticSurface(round_mesh(80.0, np.pi, inward=False), plain())
    samples = LobeSamples.draw(light, np.eye(3), 16, 64, np.random.default_rng(0), light.lamps_at)
    points = surface.points(np.arange(0, len(surface.mesh.faces), 97), np.full((95, 3), 1 / 3))
    outgoing = points.normal
    choice, black = np.arange(len(points.position)) % 64, np.zeros((8, 8, 3), np.float32)
    roughness = np.full(len(choice), 0.4, np.float32)
    found = specular_radiance(surface, light, black, np.eye(3), points, outgoing, roughness, samples, choice)
    for p in range(0, len(choice), 7):
        towards = 500.0 * samples.lamp_directions[choice[p]] - points.position[p]
        distance = np.linalg.norm(towards, axis=1, keepdims=True)
        moved = replace(samples, lamps_at=None, lamp_directions=samples.lamp_directions.copy(),
                        lamp_weights=samples.lamp_weights.copy())
        moved.lamp_directions[choice[p]] = towards / distance
        moved.lamp_weights[choice[p]] *= (500.0 / distance) ** 2
        one = points.select(slice(p, p + 1))
        expected = specular_radiance(surface, light, black, np.eye(3), one, outgoing[p:p + 1], roughness[:1], moved,
                                     choice[p:p + 1])
        np.testing.assert_allclose(found[p], expected[0], rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_lamps_and_smooth_light_add_up_to_the_environment(name):
    light = EnvironmentLight(procedural_environment(name, 0))
    directions, weights = light.sample_lamps(shifted_hammersley(4096, 1, np.random.default_rng(0))[0])
    grid = latlong_directions(256).reshape(-1, 3)
    solid_angle = np.sin(np.arccos(grid[:, 1])) * (np.pi / 256) ** 2
    lamps = light.radiance(grid) - light.smooth_radiance(grid)
    assert lamps.min() >= -1e-6
    for normal in np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, 1.0, 0.0]]):
        expected = (lamps * (np.clip(grid @ normal, 0, 1) * solid_angle)[:, None]).sum(0)
        sampled = (weights * np.clip(directions @ normal, 0, 1)[:, None]).mean(0)
        np.testing.assert_allclose(sampled, expected, rtol=0.02, atol=1e-3)
        np.testing.assert_allclose(light.lamp_irradiance(normal), expected, rtol=0.03, atol=2e-3)


def test_a_chart_in_a_white_furnace_shows_its_reflectances():
    """Far from the head; close to a black globe each point loses what it covers of the sky: centred on the horizon
    with angular radius a, it projects to a circular segment of area a - sin a cos a of the unit disc."""
    light = constant_light()
    surface = SyntheticSurface(round_mesh(80.0, np.pi, inward=False, count=16), plain(albedo=(0.0, 0.0, 0.0)))
    camera, dark = PinholeCamera(240, 160, 1000.0), np.zeros((8, 8, 3), np.float32)
    shot = SyntheticShot(rigid(WORLD_FROM_CAMERA, np.array([-600.0, 0.0, 900.0])), np.eye(3), 0, 1)
    picture = np.full((160, 240, 3), 0.5)
    chart = PlacedChart(rigid(np.eye(3), np.array([0.0, 0.0, 1000.0])))
    add_chart(picture, chart, surface, light, dark, shot, camera.intrinsics, 2)
    corners, _ = project(chart.points(CORNERS), np.eye(4), camera.intrinsics)
    view = read_chart(picture.astype(np.float32), 99.0, corners)
    np.testing.assert_allclose(view.corners, corners, atol=0.3)
    expected = np.maximum(reflectances(), 0.0) * [1, 2, 3]
    np.testing.assert_allclose(view.patches, expected, rtol=0.02, atol=0.004)
    assert (picture[:8] == 0.5).all()
    near = SyntheticShot(rigid(WORLD_FROM_CAMERA, np.array([-170.0, 0.0, 1000.0])), np.eye(3), 0, 1)
    shaded = chart_irradiance(chart, surface, light, dark, near)[2, :, 0] / np.pi
    angle = np.arcsin(80.0 / (170.0 + 25.0 * np.linspace(-3, 3, 7)))
    np.testing.assert_allclose(shaded, 1.0 - (angle - np.sin(angle) * np.cos(angle)) / np.pi, atol=0.015)


def test_the_result_does_not_depend_on_the_number_of_processes():
    mesh = round_mesh(80.0, np.pi, inward=False, count=12)
    scene = Scene(mesh, plain(), (procedural_environment("room", 0, 16),))
    shots = [SyntheticShot(FRONT, np.eye(3), 0, seed) for seed in range(3)]
    quality = RenderQuality(IrradianceQuality(32, 64, 4, 3), PictureQuality(1, 2, 2), 0)
    first, second = (list(render(scene, shots, PinholeCamera(32, 32, 150.0), quality, [True, False, False], processes))
                     for processes in (1, 2))
    assert set(first[0]) > {"radiance", "albedo", "normal", "depth", "mask", "head"} and set(first[1]) == {"radiance"}
    for a, b in zip(first, second, strict=True):
        for name in a:
            np.testing.assert_array_equal(a[name], b[name])


def test_the_head_turns_smoothly_as_one_rigid_body_to_both_sides():
    poses = head_turn(48, 950.0, -20.0, seed=0)
    turns = world_from_head(poses, "head")
    np.testing.assert_allclose(turns @ turns.transpose(0, 2, 1), np.broadcast_to(np.eye(3), turns.shape), atol=1e-12)
    yaw = np.degrees(np.arctan2(turns[:, 0, 2], turns[:, 2, 2]))
    assert yaw.min() < -YAW_DEG + 3 * DRIFT_DEG and yaw.max() > YAW_DEG - 3 * DRIFT_DEG
    step = np.degrees(np.linalg.norm(vector_from_rotation(turns[1:] @ turns[:-1].transpose(0, 2, 1)), axis=1))
    assert step.max() < 9


def test_the_clip_returns_every_code_value(tmp_path):
    frames = np.random.default_rng(0).integers(0, 256, (3, 48, 64, 3), np.uint8)
    clip = ClipWriter(tmp_path / "clip.avi", (64, 48), 25.0)
    for frame in frames:
        clip.add(frame)
    clip.close()
    capture = cv2.VideoCapture(str(tmp_path / "clip.avi"))
    for frame in frames:
        np.testing.assert_array_equal(capture.read()[1][..., ::-1], frame)
    assert not capture.read()[0]


def test_sensor_codes_follow_srgb_and_the_stated_noise():
    grey = np.full((200, 200, 3), 0.25)
    assert (sensor_codes(grey, 0.0, 0) == 137).all()
    linear = ((sensor_codes(grey, 0.02, 0) / 255 + 0.055) / 1.055) ** 2.4
    assert linear.std() == pytest.approx(0.01, rel=0.05)
    assert (sensor_codes(grey * 8, 0.0, 0) == 255).all()


def test_rounding_keeps_the_stated_precision():
    values = np.random.default_rng(0).normal(size=1000)
    assert np.abs(rounded(values, 4) / values - 1).max() <= 2.0**-5
    assert rounded(np.array([0.0, 1.0, -0.5]), 4).tolist() == [0.0, 1.0, -0.5]


@pytest.fixture(scope="module")
def networks():
    try:
        return load_face_networks()
    except InputError as error:
        pytest.skip(f"the face networks are missing: {error}")


def test_every_frame_of_the_tiny_subject_shows_a_face(networks):
    for path in sorted((TINY / "frames").glob("*.png")):
        frame = read_png(path)
        found = networks.detect(frame)
        assert found and found[0].score > 0.7, path.name
        assert networks.landmarks(frame, found[0])[0] > 0.9, path.name


def test_the_tiny_subject_is_what_the_tool_makes(networks, tmp_path):
    assert main([str(tmp_path / "tiny"), "--preset", "tiny"]) == 0
    kept = {path.relative_to(TINY) for path in TINY.rglob("*") if path.is_file()}
    assert {path.relative_to(tmp_path / "tiny") for path in (tmp_path / "tiny").rglob("*") if path.is_file()} == kept
    assert sum((TINY / path).stat().st_size for path in kept) < 600_000
    for path in sorted((TINY / "frames").glob("*.png")):
        difference = read_png(path).astype(int) - read_png(tmp_path / "tiny" / "frames" / path.name)
        assert np.abs(difference).mean() < 0.05, path.name


def test_a_scan_takes_the_procedural_heads_place_and_burns_out_as_asked(tmp_path, networks):
    head = procedural_subject(tmp_path / "head")
    settings = replace(PRESETS["demo"], size=96, frames=8, seed=3, lights=("lamp",), clipped=0.3, scan=str(head),
                       irradiance=IrradianceQuality(size=96, directions=256))
    synthesize(tmp_path / "burnt", settings, 1)
    truth, scanned = head / "gt", tmp_path / "burnt" / "gt"
    assert np.allclose(read_obj(truth / "mesh.obj").vertices, read_obj(scanned / "mesh.obj").vertices, atol=1e-3)
    assert np.allclose(read_exr(truth / "albedo.exr"), read_exr(scanned / "albedo.exr"), atol=1e-3)
    stems = sorted(path.with_suffix("") for path in (scanned / "frames").glob("*_mask.png"))
    assert len(stems) == 8
    brightest = [read_exr(str(stem).replace("_mask", "_radiance") + ".exr").max(-1)[read_png(f"{stem}.png") > 127]
                 for stem in stems]
    assert 0.25 < (np.concatenate(brightest) >= 1.0).mean() < 0.35


def procedural_subject(folder):
    """The truth alone of a small procedural head."""
    settings = replace(PRESETS["tiny"], texture=64)
    mesh, _, materials = procedural(settings)
    write_scene_truth(folder / "gt", Scene(mesh, materials, (light_of("lamp", settings),)), mesh, 10)
    return folder


def test_a_folder_without_a_scan_is_named(tmp_path, capsys):
    assert main([str(tmp_path / "new"), "--scan", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert "holds no scan" in error and "mesh.obj" in error and not (tmp_path / "new").exists()


def test_bad_arguments_are_one_line_and_exit_code_two(tmp_path, capsys):
    assert main([str(tmp_path / "new"), "--size", "8"]) == 2
    assert capsys.readouterr().err == "error: --size: out of range; got 8; expected 64 to 2048\n"
    (tmp_path / "subject.yaml").write_text("video: x\n")
    assert main([str(tmp_path)]) == 2
    assert "holds a subject already" in capsys.readouterr().err
    assert main([str(tmp_path / "new"), "--lamp-distance", "50"]) == 2
    assert "inside the head's reach" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
