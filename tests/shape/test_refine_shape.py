"""Shape from shading, parallax and outline on an egg with a dent that the start does not have, and its parts."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse as sparse
from field_check import below, field_faults
from shapes import sphere
from toy_head import toy_head
from toy_shape import FRAMES, LENS, ROUGHNESS, SIZE, SIZES, SPECULAR, shade, swinging, true_albedo, true_light

from shared.appearance.problem import AppearanceSettings
from shared.contract.records import SOLVE
from shared.geometry.mesh import Mesh, interpolate, normalised, subdivide, tangent_frames, vertex_normals
from shared.geometry.raycast import RayScene, camera_hits
from shared.geometry.surface import TrackPoints
from shared.geometry.transforms import projection_slope
from shared.imaging.image_sampling import prepare_picture
from shared.imaging.views import Views
from shared.inverse.shaping import judge_shape
from shared.rendering.envmap import cube_directions
from shared.rendering.normal_derivatives import Reflections, shading_terms
from shared.shape.equations import EquationSettings, variance_inflation
from shared.shape.gauss_newton import Reflectance, ShapedSurface, ShapeSettings, ShapeSolver
from shared.shape.step import large_step_metric, normal_turns, solve_offsets


@dataclass
class Toy:
    start: Mesh
    truth: Mesh
    views: Views
    tracks: TrackPoints
    reflectance: Reflectance


@pytest.fixture(scope="module")
def toy():
    """The dent is 2.5 mm deep and some 30 mm wide, on the cheek; there are track points around but not in it."""
    start = toy_head(5).mesh(np.zeros(2), np.zeros(1))
    normals = vertex_normals(start.vertices, start.faces)
    place = np.array([35.0, -15.0, 80.0])
    depth = 2.5 * np.exp(-0.5 * (np.linalg.norm(start.vertices - place, axis=1) / 14.0) ** 2)
    truth = start.replace(vertices=start.vertices - depth[:, None] * normals)
    poses, light = swinging(), true_light(cube_directions(16))
    shading, precomputed, material = shade(truth, poses, light)
    albedo, scene = true_albedo(truth.vertices), RayScene(truth.vertices, truth.faces)
    pictures = []
    for f, pose in enumerate(poses):
        radiance = albedo * shading.irradiance(f) + SPECULAR * shading.reflection(f)
        total = np.zeros((SIZE, SIZE, 3))
        for offset in ((0.25, 0.25), (0.25, 0.75), (0.75, 0.25), (0.75, 0.75)):
            face, bary, _ = camera_hits(scene, pose, LENS, SIZE, SIZE, offset)
            total[face >= 0] += 0.25 * interpolate(radiance, truth.faces, face[face >= 0], bary[face >= 0])
        codes = np.clip(np.round(total * 65535 / 2.0), 0, 65535).astype(np.uint16)
        mask = np.where(camera_hits(scene, pose, LENS, SIZE, SIZE)[0] >= 0, 255, 0).astype(np.uint8)
        pictures.append(prepare_picture(codes, (codes / 65535.0 * 2.0).astype(np.float32), mask))
    fitted = np.arange(FRAMES) % 5 != 2
    known = np.nonzero((depth < 0.01) & (start.vertices[:, 2] > 20.0))[0][::3]
    tracks = TrackPoints(start.vertices[known], np.full(len(known), 0.15))
    views = Views.in_one_light(poses, LENS, (SIZE, SIZE), "head", pictures.__getitem__, None, fitted)
    known = Reflectance(light, SPECULAR, ROUGHNESS, precomputed.nodes, material.node_albedo, precomputed.directions)
    return Toy(start, truth, views, tracks, known)


def solver_of(toy, **changes):
    return ShapeSolver(toy.views, toy.tracks, toy.reflectance, AppearanceSettings(), SIZES, ShapeSettings(**changes))


def test_projection_slope_is_the_derivative_of_the_projection():
    from shared.geometry.transforms import project

    points, pose = np.array([[10.0, -20.0, 60.0], [-40.0, 30.0, 20.0]]), swinging()[3]
    slope = projection_slope(points, pose, LENS)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-4
        changed = project(points + step, pose, LENS)[0] - project(points - step, pose, LENS)[0]
        np.testing.assert_allclose(slope[:, :, axis], changed / 2e-4, atol=1e-6)


def test_normals_turn_as_the_vertices_say():
    ball = sphere(50.0, 3)
    normals = vertex_normals(ball.vertices, ball.faces)
    offsets = 1e-3 * np.random.default_rng(0).normal(size=len(normals))
    index = np.arange(0, len(normals), 3)
    tangents = tangent_frames(normals[index])
    turns = normal_turns(ball.vertices, ball.faces, normals, index, tangents)
    moved = vertex_normals(ball.vertices + offsets[:, None] * normals, ball.faces)
    true = np.einsum("px,pkx->kp", (moved - normals)[index], tangents)
    for k in range(2):
        np.testing.assert_allclose(turns[k] @ offsets, true[k], atol=0.03 * np.abs(true).max())


def test_metric_is_the_squared_large_step():
    ball = sphere(1.0, 2)
    values = np.random.default_rng(1).normal(size=len(ball.vertices))
    neighbours = [set() for _ in values]
    for a, b, c in ball.faces:
        for v, others in ((a, (b, c)), (b, (a, c)), (c, (a, b))):
            neighbours[v].update(others)
    laplacian = np.array([len(near) * values[v] - values[list(near)].sum() for v, near in enumerate(neighbours)])
    expected = np.square(values + 19.0 * laplacian).sum() / 4.0
    metric = large_step_metric(ball.faces, len(values), 19.0, 2.0)
    assert values @ metric @ values == pytest.approx(expected)


def dented_ball(slope_at_top=-5.0):
    """What solve_offsets is given for a ball one of whose vertices is pulled outwards, and its cost of offsets [V]."""
    ball = sphere(1.0, 3)
    count = len(ball.vertices)
    normals = normalised(ball.vertices)
    slope = np.zeros(count)
    slope[0] = slope_at_top
    hessian = sparse.identity(count, format="csr")
    metric = large_step_metric(ball.faces, count, 19.0, 0.5)
    given = ball.vertices, ball.vertices, normals, metric, np.ones(count, bool), [(hessian, slope)]

    def cost(offsets):
        moved = offsets[:, None] * normals
        return 0.5 * offsets @ offsets + slope @ offsets + 0.5 * (moved * (metric @ moved)).sum()

    return given, cost


def test_offsets_are_the_minimum():
    given, cost = dented_ball()
    notes, rng = [], np.random.default_rng(0)
    found = solve_offsets(*given, notes.append)
    assert not notes and cost(found) < 0.0 and np.ptp(found) > 0.0
    for _ in range(20):
        assert cost(found + 1e-3 * rng.normal(size=len(found))) > cost(found)


@pytest.mark.parametrize("broken", ["no number", "singular", "uphill"])
def test_a_step_that_cannot_be_solved_is_left_out(broken):
    vertices, start, normals, metric, free, (term,) = dented_ball(np.nan if broken == "no number" else -5.0)[0]
    if broken == "singular":
        metric, term = 0.0 * metric, (0.0 * term[0], term[1])
    if broken == "uphill":
        metric, term = -1.0 * metric, (-1.0 * term[0], term[1])
    notes = []
    refused = solve_offsets(vertices, start, normals, metric, free, [term], notes.append)
    assert len(notes) == 1 and "left out" in notes[0]
    assert not refused.any()


def test_irradiance_turns_with_the_normal(toy):
    """Shading of a point whose normal alone is turned, against the linear prediction."""
    poses = swinging(4)
    mesh = toy.truth
    shading, _, _ = shade(mesh, poses, toy.reflectance.light)
    rows = np.nonzero((mesh.vertices[:, 2] > 70.0) & (shading.transfer.blocked < 0.01))[0][::40]
    terms = shading_terms(shading, rows, Reflections(shading, np.arange(len(shading.points))))
    turned = normalised(shading.points.normals[rows] + 0.05 * terms.tangents[:, 0])
    weight = np.maximum(turned @ shading.directions.T, 0.0) * (4.0 / len(shading.directions))
    direct = np.einsum("pj,jfc->pfc", weight * shading.transfer.visibility(rows), shading.light_along)
    upright = np.maximum(shading.points.normals[rows] @ shading.directions.T, 0.0) * (4.0 / len(shading.directions))
    before = np.einsum("pj,jfc->pfc", upright * shading.transfer.visibility(rows), shading.light_along)
    change = (direct - before) / 0.05
    np.testing.assert_allclose(terms.irradiance_turn[..., 0], change, atol=0.06 * np.abs(change).max())


def test_variance_inflation_is_one_for_independent_noise_and_grows_with_what_neighbours_share():
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-80.0, 80.0, (6000, 2)), np.zeros(6000)])
    power = rng.uniform(0.5, 2.0, len(points))
    independent = np.sqrt(power) * rng.normal(size=len(points))
    assert 1.0 <= variance_inflation(points, independent, power) < 1.15
    cell = np.unique(np.floor(points / 8.0), axis=0, return_inverse=True)[1].ravel()
    shared = 0.5 * np.sqrt(power) * rng.normal(size=cell.max() + 1)[cell]
    in_cell = len(points) / (cell.max() + 1)
    found = variance_inflation(points, independent + shared, power)
    assert 0.3 * in_cell * 0.25 < found - 1.0 < 1.2 * in_cell * 0.25


def test_dent_is_found(toy):
    # The dent is as wide as what is otherwise laid to light and pose.
    solver = solver_of(toy, subdivisions=0, rounds=4, smoothness=3.0, equations=EquationSettings(smooth_mm=0.0))
    depth = toy.start.vertices[toy.start.faces].mean(1)[:, 2]
    _, refined = solver.refine(toy.start, depth > 20.0, depth < -40.0)
    normals = vertex_normals(toy.start.vertices, toy.start.faces)
    wrong = ((toy.start.vertices - toy.truth.vertices) * normals).sum(1)
    left = ((refined.vertices - toy.truth.vertices) * normals).sum(1)
    dented = wrong > 0.5
    assert np.sqrt(np.mean(left[dented] ** 2)) < 0.3 * np.sqrt(np.mean(wrong[dented] ** 2))
    elsewhere = (wrong < 0.01) & (toy.start.vertices[:, 2] > 40.0)
    assert np.median(np.abs(left[elsewhere])) < 0.1
    np.testing.assert_array_equal(refined.faces, toy.start.faces)


@pytest.mark.parametrize("judged, looks_back, kept", [
    ((1.00, 1.01, 0.80), True, 2),
    ((1.00, 1.01, 0.80), False, 2),
    ((1.00, 0.90, 1.20, 1.10), True, 1),
    ((1.00, 1.20, 1.10, 0.50), True, 0),
    ((1.00, 1.01, 1.02), False, 0),
    ((1.00, 0.90, 0.50), False, 2),
])
def test_the_shape_goes_on_past_one_worse_step_and_keeps_the_best(toy, monkeypatch, judged, looks_back, kept):
    """Every step raises the mesh by 1 mm; held-out frames judge it as the list says."""
    solver = solver_of(toy, subdivisions=0, rounds=len(judged) - 1, looks_back=looks_back)
    faces = np.ones(len(toy.start.faces), bool)

    def height(mesh):
        return int(np.rint(((mesh.vertices - toy.start.vertices) * normals).sum(1).mean()))

    def examine(mesh, traced):
        return judged_surface(mesh, judged[height(mesh)])

    normals = vertex_normals(toy.start.vertices, toy.start.faces)
    monkeypatch.setattr(solver, "examine", examine)
    monkeypatch.setattr(solver, "step", lambda surface, *_: np.ones(len(surface.mesh.vertices)))
    first = judged_surface(toy.start, judged[0])
    assert height(solver._stepped(first, toy.start.vertices, faces, ~faces, None)) == kept


def judged_surface(mesh, value):
    """A surface whose held-out residual has this value."""
    equations = SimpleNamespace(judged=value, fitted=value, held_out=value)
    return ShapedSurface(mesh, np.arange(3), np.zeros((3, 2, 3)), equations)


@pytest.mark.parametrize("judged, traced, stepped", [
    ((1.0, 0.9, 0.8), 3, 3),
    ((1.0, 0.995, 0.5), 2, 1),
    ((1.0, 1.2, 0.5), 2, 1),
])
def test_the_given_mesh_is_traced_again_while_that_helps(toy, monkeypatch, judged, traced, stepped):
    """Held-out frames judge the mesh, once traced anew, as the list says."""
    solver, traces, steps = solver_of(toy, subdivisions=1, traces=3), [], []
    monkeypatch.setattr(solver, "trace", lambda mesh, shaped: traces.append(len(mesh.faces)))
    monkeypatch.setattr(solver, "examine", lambda mesh, *_: judged_surface(
        mesh, judged[len(traces) - 1] if len(mesh.faces) == len(toy.start.faces) else 1.0))
    monkeypatch.setattr(solver, "_stepped", lambda surface, *_: steps.append(1) or surface.mesh)
    faces = np.ones(len(toy.start.faces), bool)
    solver.refine(toy.start, faces, ~faces)
    assert traces == [len(faces)] * traced + [4 * len(faces)] and len(steps) == stepped + 1


@pytest.mark.parametrize("subdivisions, begun, levels", [(0, 0, [0]), (1, 0, [1]), (1, 1, [1]), (2, 1, [2])])
def test_a_refined_mesh_goes_on_from_the_next_level_or_on_the_finest(toy, monkeypatch, subdivisions, begun, levels):
    solver, asked, mesh = solver_of(toy, subdivisions=subdivisions), [], toy.start
    for _ in range(begun):
        mesh = subdivide(mesh)
    raised = mesh.replace(vertices=mesh.vertices + 1.0)
    monkeypatch.setattr(solver, "_refine_level", lambda mesh, start, *rest: asked.append(
        (rest[2], float((mesh.vertices - start).mean()))) or mesh)
    faces = np.ones(len(toy.start.faces), bool)
    start, refined = solver.refine(toy.start, faces, ~faces, raised)
    assert [level for level, _ in asked] == levels and asked[0][1] == pytest.approx(1.0, abs=0.01)
    assert len(start.faces) == len(refined.faces) == len(faces) * 4**subdivisions


def test_a_few_points_that_fit_worse_do_not_decide_about_a_mesh():
    before, after, worse = (SimpleNamespace(fitted=0.01, held_out=held_out, frame_errors=np.full(4, error))
                            for held_out, error in ((0.010, 0.006), (0.012, 0.0061), (0.012, 0.0072)))
    assert judge_shape(before, after)["refined"] and not judge_shape(before, worse)["refined"]


@pytest.mark.parametrize("name, before, after", [("held_out", (0.03, 0.02), (0.01, 0.03)),
                                                 ("fitted", (0.03, 0.0), (0.01, 0.0))])
def test_a_mesh_is_judged_by_held_out_frames_where_there_are_any(name, before, after):
    solutions = [SimpleNamespace(fitted=fitted, held_out=held_out, frame_errors=np.full(4, 0.5 * (held_out or fitted)))
                 for fitted, held_out in (before, after)]
    record = judge_shape(*solutions)
    assert record["refined"] is (name == "fitted")
    assert list(record[name]) == ["before", "after"]
    assert field_faults(record | {"outline": {}}, below(SOLVE, "shape")) == []
