"""Lips that meet, on the head model with a slit between its lips, and with its jaw down."""

import numpy as np
import pytest

from shared.geometry.mouth import inside_of_open_mouth, shut_lips
from shared.geometry.raycast import RayScene
from shared.geometry.surface import Surface
from shared.geometry.transforms import rotation_from_vector
from shared.tracking.models import load_head_model


@pytest.fixture(scope="module")
def model():
    return load_head_model()


def inside_mm2(surface: Surface, pitch_deg: float) -> float:
    """How much of the inside of the mouth one sees from the front, of a head that nods so far."""
    vertices = surface.mesh.vertices @ rotation_from_vector(np.radians([pitch_deg, 0.0, 0.0])).T
    lips = vertices[surface.vertices_of(("lips",))]
    across, up = (np.arange(lips[:, axis].min(), lips[:, axis].max(), 0.1) for axis in (0, 1))
    origins = np.stack(np.broadcast_arrays(across[:, None], up, lips[:, 2].max() + 50.0), axis=-1).reshape(-1, 3)
    face = RayScene(vertices, surface.mesh.faces).first_faces(origins, np.tile([0.0, 0.0, -1.0], (len(origins), 1)))
    return 0.01 * float(surface.faces_of(("inner_mouth",))[face].sum())


def with_jaw(model, down: float) -> Surface:
    """The mean head, whose own lips part in the corners, with the jaw so far down."""
    expression = np.zeros(len(model.expression_names))
    expression[list(model.expression_names).index("jaw_open")] = down
    return model.surface(model.shape(np.zeros(len(model.identity_basis)), expression))


@pytest.mark.parametrize(("down", "seen_mm2"), [(0.0, 1.5), (0.03, 5.0), (0.06, 20.0)])
def test_no_inside_is_seen_from_before_above_and_below(model, down, seen_mm2):
    surface = with_jaw(model, down)
    shut = shut_lips(surface)
    found = model.surface(shut)
    assert inside_mm2(surface, 0.0) > seen_mm2
    assert [inside_mm2(found, pitch) for pitch in (-20.0, 0.0, 20.0)] == pytest.approx([0.0] * 3, abs=0.05)
    moved = np.linalg.norm(shut - surface.mesh.vertices, axis=1)
    others = ~surface.vertices_of(("lips", "inner_mouth", "upper_lip_skin", "chin"))
    assert moved[others].max() == 0.0 and moved.max() < 2.0


def test_both_lips_give_way_alike(model):
    """The upper comes down and the lower up."""
    surface = with_jaw(model, 0.06)
    up = (shut_lips(surface) - surface.mesh.vertices)[:, 1]
    assert up.max() > 0.3 and up.min() < -0.3 and 0.6 < -up.min() / up.max() < 1.6


def test_an_open_mouth_and_a_mesh_without_lips_stay(model):
    opened = with_jaw(model, 1.0)
    assert np.array_equal(shut_lips(opened), opened.mesh.vertices)
    bare = Surface(with_jaw(model, 0.06).mesh)
    assert np.array_equal(shut_lips(bare), bare.mesh.vertices)


def test_only_an_open_mouth_has_an_inside(model):
    opened, slit = with_jaw(model, 1.0), with_jaw(model, 0.06)
    assert np.array_equal(inside_of_open_mouth(opened), opened.vertices_of(("inner_mouth",)))
    assert inside_of_open_mouth(opened).sum() > 20
    for shut in (slit, Surface(opened.mesh)):
        assert not inside_of_open_mouth(shut).any()
