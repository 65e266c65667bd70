"""The reference solver on a small clip whose truth is known: it descends, resumes, takes its settings."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from field_check import field_faults, written_fields
from toy_clip import FRAMES, MAP, toy_clip, true_maps

from shared.compute.run_context import SILENT, RunContext
from shared.contract.job import Parameters
from shared.contract.records import SOLVE
from shared.imaging.image_sampling import SurfaceViewer
from shared.inverse.frame_choice import covering_frames
from shared.inverse.parameters import read_settings
from shared.inverse.problem import InverseSettings, frames_to_fit
from shared.inverse.published_clip import Checkpoint, solve_by_reference
from shared.inverse.solve import solve_clip, summarise
from shared.published.settings import ReferenceSettings
from shared.published.shading import Sampling, Shader
from shared.published.shape import LargeSteps
from shared.published.solver import ReferenceSolver
from shared.rendering.precomputed_transfer import Sizes
from stages.inverse_render import STAGE

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def clip():
    return toy_clip()


def settings_of(clip, **changes):
    reference = ReferenceSettings(
        iterations=60,
        pixels=500,
        sampling=Sampling(24, 24, 8),
        resolution=8,
        vertices=False,
        texture_rate=0.01,
        light_rate=0.03,
    )
    sizes = Sizes(points=300, directions=256, nodes=60)
    return InverseSettings(sizes=sizes, map_size=MAP, hold_out_every=4, reference=replace(reference, **changes))


def nothing(*arguments):
    return arguments[0] if arguments else None


def albedo_error(maps, seen):
    """Median relative error after the best factor per channel."""
    ratio = maps[seen] / true_maps()["diffuse_albedo"][seen]
    return float(np.median(np.abs(ratio / np.median(ratio, axis=0) - 1.0)))


def test_it_finds_the_albedo(clip):
    """From the mean texture, with the shading in it, towards the truth; the record is complete and finite."""
    states = {}

    def note(text):
        states.setdefault("notes", []).append(text)

    first = solve_clip(clip.views, clip.surface, settings_of(clip, iterations=1), RunContext(nothing, note))
    seen = first.texels.maps["confidence"] > 0.9
    assert 0.1 < seen.mean() < 0.8
    result = solve_clip(clip.views, clip.surface, settings_of(clip, iterations=160), RunContext(nothing, note))
    before, after = (albedo_error(r.texels.maps["diffuse_albedo"], seen) for r in (first, result))
    assert after < 0.6 * before and after < 0.11
    assert result.solution.fitted < 0.6 * first.solution.fitted
    record = summarise(result, "head")
    assert np.nonzero(~result.views.fitted)[0].tolist() == [2, 6]
    assert np.isfinite([record["residuals"]["fitted"], record["residuals"]["held_out"]]).all()
    assert any("iteration 160" in line for line in states["notes"])
    assert result.texels.shading.irradiance(0).shape == (len(clip.mesh.vertices), 3)


def test_a_run_that_was_cut_off_goes_on_as_if_it_had_not_been(clip, tmp_path):
    """Ten iterations, a checkpoint, ten more: the very numbers of twenty in one go. Other settings start anew."""
    path = tmp_path / "checkpoint.npz"
    notes = []
    whole = solve_clip(clip.views, clip.surface, settings_of(clip, iterations=20), RunContext(nothing, notes.append))

    class CutOff(Exception):
        pass

    def cut(items, label=""):
        for i, item in enumerate(items):
            if label == "reference iterations" and i == 13:
                raise CutOff
            yield item

    options = {"iterations": 20, "checkpoint": path, "checkpoint_every": 10}
    with pytest.raises(CutOff):
        solve_clip(clip.views, clip.surface, settings_of(clip, **options), RunContext(cut, notes.append))
    assert path.is_file()
    other = settings_of(clip, **options, light_rate=0.05)
    solve_clip(clip.views, clip.surface, other, RunContext(nothing, notes.append))
    assert any("starts anew" in text for text in notes)
    with pytest.raises(CutOff):
        solve_clip(clip.views, clip.surface, settings_of(clip, **options), RunContext(cut, notes.append))
    parts = solve_clip(clip.views, clip.surface, settings_of(clip, **options), RunContext(nothing, notes.append))
    assert any("goes on from iteration 10" in text for text in notes)
    assert np.array_equal(parts.texels.maps["diffuse_albedo"], whole.texels.maps["diffuse_albedo"])
    assert np.array_equal(parts.solution.state.light, whole.solution.state.light)
    assert not path.exists()


def test_a_damaged_checkpoint_is_passed_over(clip, tmp_path):
    path = tmp_path / "checkpoint.npz"
    path.write_bytes(b"PK\x03\x04 nonsense")
    notes = []
    settings = settings_of(clip, iterations=1, checkpoint=path)
    solve_clip(clip.views, clip.surface, settings, RunContext(nothing, notes.append))
    assert any("starts anew" in text for text in notes) and not path.exists()


def test_vertices_move_towards_the_outline(clip):
    """The egg 3 % too small: mask and image losses pull its outline outwards."""
    small = replace(clip, surface=clip.surface.with_mesh(clip.mesh.replace(vertices=clip.mesh.vertices * 0.97)))
    changes = {"vertices": True, "iterations": 40, "pixels": 300, "vertex_rate": 0.3, "sampling": Sampling(8, 8, 4)}
    result = solve_clip(small.views, small.surface, settings_of(small, **changes))
    record = summarise(result, "head") | {"render_frames": [], "held_out_frames": []}
    assert field_faults(record, SOLVE) == []
    assert {f"iterations[].{name}" for name in ("iteration", "image", "mask", "laplacian", "white_light", "diffuse",
                                                "roughness_variation")} <= written_fields(record, SOLVE)
    moved = result.texels.mesh.vertices
    rim = np.abs(clip.mesh.vertices[:, 0]) > 60.0
    before = np.linalg.norm(small.mesh.vertices[rim] - clip.mesh.vertices[rim], axis=1).mean()
    after = np.linalg.norm(moved[rim] - clip.mesh.vertices[rim], axis=1).mean()
    assert after < 0.7 * before
    assert np.isfinite(moved).all()


@pytest.mark.parametrize("model", ["harmonics_2", "sun_sky", "camera"])
def test_light_models_are_those_of_the_transfer_solver(clip, model):
    """Few parameters drawn into a cubemap; the residual falls through them, least where a lamp is misplaced.
    """
    sampling = Sampling(16, 16, 8, visibility=model == "sun_sky")
    first, last = (
        solve_clip(clip.views, clip.surface, settings_of(clip, light_model=model, iterations=count, sampling=sampling))
        for count in (1, 45)
    )
    assert last.solution.fitted < (0.95 if model == "camera" else 0.85) * first.solution.fitted
    assert last.solution.state.light.min() > 0.0 and np.ptp(last.solution.state.light) > 0.05


def test_the_other_methods_models_are_followed(clip, monkeypatch):
    """Matte skin has no highlight; of three frames it sees no other; without visibility none of
    its rays seeks the light."""
    changes = {"iterations": 3, "pixels": 100}
    matte = settings_of(clip, **changes, sampling=Sampling(8, 8, 4, specular=False))
    assert (solve_clip(clip.views, clip.surface, matte).texels.maps["specular_intensity"] == 0.0).all()
    poses, three = [], replace(settings_of(clip, **changes), fit_frames=3)
    fitted = frames_to_fit(clip.views, clip.surface, three, SurfaceViewer.of(clip.mesh))
    solve_by_reference(clip.views.with_fitted(fitted), clip.surface, three, three.reference, SILENT,
                       lambda solver, losses: poses.append(solver.views.camera_from_head))
    assert len(poses) == 3 and all(np.array_equal(seen, clip.views.camera_from_head[fitted]) for seen in poses)
    monkeypatch.setattr(Shader, "_open", None)
    unshadowed = settings_of(clip, **changes, sampling=Sampling(visibility=False))
    assert np.isfinite(solve_clip(clip.views, clip.surface, unshadowed).texels.maps["diffuse_albedo"]).all()
    with pytest.raises(TypeError):
        solve_clip(clip.views, clip.surface, settings_of(clip, **changes))


def test_large_steps_are_a_change_of_variables(clip):
    mesh = clip.mesh
    steps = LargeSteps(mesh.faces, len(mesh.vertices), 19.0)
    parameters = torch.from_numpy(steps.parameters(mesh.vertices))
    assert np.allclose(steps.vertices(parameters).numpy(), mesh.vertices)
    spike = torch.zeros_like(parameters)
    spike[100, 0] = 1.0
    smooth = steps.vertices(spike).numpy()[:, 0]
    assert smooth.sum() == pytest.approx(1.0, rel=1e-6) and smooth.max() < 0.05 and smooth.argmax() == 100


def test_few_frames_cover_the_face(clip):
    """Three of nine: one from either side and one between; they alone are fitted, the others judge."""
    viewer = SurfaceViewer.of(clip.mesh)
    front = clip.mesh.vertices[:, 2] > 10.0
    chosen = covering_frames(viewer, front, clip.views, 3)
    assert len(set(chosen.tolist())) == 3 and chosen[0] <= 1 and chosen[-1] >= FRAMES - 2
    fitted = frames_to_fit(clip.views, clip.surface, InverseSettings(fit_frames=3), viewer)
    assert fitted.sum() == 3 and len(fitted) == FRAMES


def told(**changes):
    """A stage's parameters with some changed."""
    return Parameters({**STAGE.defaults(), **STAGE.parse(changes, "test")})


def test_the_stage_hands_its_parameters_on():
    """The declaration's defaults are the published numbers; other values arrive where they belong."""
    published = read_settings(told(solver="reference", roughness=0.45)).reference
    assert replace(published, roughness=0.45) == ReferenceSettings()
    changed = read_settings(
        told(
            solver="reference",
            reference_light_samples=32,
            reference_mask=0.5,
            visibility=False,
            specular=False,
            light_model="sun_sky",
            reference_pixels=100,
            reference_seed=3,
        )
    ).reference
    assert changed.sampling == Sampling(32, 256, 64, visibility=False, specular=False)
    assert (changed.weights.mask, changed.light_model, changed.pixels, changed.seed) == (0.5, "sun_sky", 100, 3)
    assert read_settings(told()).reference is None


def test_checkpoints_know_what_they_belong_to(clip):
    solver_settings = settings_of(clip).reference
    from shared.published.solver import Start

    maps = true_maps()
    start = Start(np.ones(3), maps["diffuse_albedo"], maps["specular_intensity"])
    views = clip.views
    key = Checkpoint(solver_settings, start, views).key
    assert np.array_equal(key, Checkpoint(replace(solver_settings, iterations=999), start, views).key)
    assert not np.array_equal(key, Checkpoint(replace(solver_settings, seed=1), start, views).key)
    assert not np.array_equal(key, Checkpoint(solver_settings, replace(start, radiance=2 * np.ones(3)), views).key)
    solver = ReferenceSolver(clip.mesh, views, start, solver_settings)
    solver.step()
    again = ReferenceSolver(clip.mesh, views, start, solver_settings)
    again.restore(solver.arrays())
    assert solver.step() == again.step()
