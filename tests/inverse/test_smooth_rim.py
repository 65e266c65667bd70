"""The tracked mesh ends on a smooth curve when its texels are solved, and a given one where it did."""

import numpy as np
import pytest

from shared.contract.job import Parameters
from shared.geometry.mesh import boundary_loop, normalised
from shared.geometry.rim import REACH_MM
from shared.imaging.image_sampling import SurfaceViewer
from shared.inverse.lit_surface import LitSurface
from shared.inverse.parameters import read_settings
from shared.inverse.problem import InverseSettings
from shared.io.meshes import load_mesh
from shared.rendering.precomputed_transfer import Sizes, precompute_transfer
from shared.tracking.models import load_head_model
from stages.inverse_render import STAGE

SETTINGS = InverseSettings(sizes=Sizes(directions=64, nodes=300))


def whole_turn_deg(mesh) -> float:
    """By how much the rim turns in all: 360 where it is flat and convex."""
    rim = mesh.vertices[boundary_loop(mesh.faces)]
    along = normalised(np.roll(rim, -1, axis=0) - rim)
    return float(np.degrees(np.arccos(np.clip((along * np.roll(along, 1, axis=0)).sum(1), -1.0, 1.0))).sum())


@pytest.fixture(scope="module")
def lit():
    """The mean head; its points' samples are of no account."""
    model = load_head_model()
    surface = model.surface(model.shape())
    viewer = SurfaceViewer.of(surface.mesh)
    return LitSurface(surface, viewer, precompute_transfer(viewer, SETTINGS.sizes), object(), object())


def test_a_lit_surface_keeps_its_samples_and_the_vertices_that_bounce_light(lit):
    smooth = lit.with_smooth_rim(SETTINGS)
    assert smooth.capture is lit.capture and smooth.coarse is lit.coarse
    rim = lit.surface.mesh.vertices[boundary_loop(lit.surface.mesh.faces)]
    before, after = lit.precomputed.nodes.points.positions, smooth.precomputed.nodes.points.positions
    near = np.linalg.norm(before[:, None] - rim, axis=2).min(1) < REACH_MM
    assert np.array_equal(before[~near], after[~near]) and near.any()
    assert 0.0 < np.linalg.norm(after - before, axis=1)[near].max() < 10.0


def test_all_of_it_is_of_the_mesh_with_the_smooth_rim(lit):
    smooth = lit.with_smooth_rim(SETTINGS)
    mesh = smooth.surface.mesh
    assert whole_turn_deg(lit.surface.mesh) > 600.0 and whole_turn_deg(mesh) < 400.0
    assert smooth.viewer.mesh is mesh and smooth.precomputed.scene is smooth.viewer.scene
    assert np.array_equal(smooth.surface.face_segment, lit.surface.face_segment)
    assert np.isin(smooth.precomputed.nodes.points.positions, mesh.vertices).all()


@pytest.mark.parametrize(("mesh", "smooth"), [("", True), ("other.npz", False)])
def test_a_given_mesh_keeps_its_own_rim(mesh, smooth):
    assert read_settings(Parameters({**STAGE.defaults(), "mesh": mesh})).smooth_rim is smooth


def test_a_tracked_mesh_has_a_smooth_rim_at_the_end_of_a_run(tiny_run):
    stages = "track_landmarks", "inverse_render"
    tracked, solved = (load_mesh(tiny_run / "work" / stage / "mesh.npz") for stage in stages)
    assert whole_turn_deg(tracked) > 600.0 and whole_turn_deg(solved) < 400.0
