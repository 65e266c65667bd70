"""Blend shapes of a whole head."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from toy_result import toy_eyed_surface

from shared.actions.facial import LEAST_MM, LOOKS, TOUCHING, facial_actions, levels_of
from shared.actions.names import in_order, named_actions
from shared.geometry.blend_shapes import BLINKS, BlendShape
from shared.geometry.intersections import crossing_edges, edges_beside
from shared.geometry.surface import Surface
from shared.tracking.head_model import HeadModel

FAR_FROM_CONTACT = ("forehead", "nose", "brows", "cheek_left", "cheek_right", "chin", "jaw")


def with_actions(model: HeadModel, *names: str) -> HeadModel:
    """The model with only these of its own actions."""
    chosen = [model.expression_names.index(name) for name in names]
    return replace(model, expression_basis=model.expression_basis[chosen], expression_names=names)


def new_crossings(surface: Surface, shape: BlendShape, weight: float = 1.0) -> dict[str, int]:
    """{segment: edges that pass through a face with the action at a weight and do not at rest}; an edge counts for the
    segment of its first vertex, and where one of both lies outside of TOUCHING, for that one's."""
    vertices, faces = surface.mesh.vertices, surface.mesh.faces
    edges = crossing_edges(shape.applied(vertices, weight), faces)
    edges = edges_beside(edges, crossing_edges(vertices, faces, edges))
    of_vertex = np.zeros(len(vertices), int)
    of_vertex[faces] = surface.face_segment[:, None]
    ends = np.array(surface.segment_names)[of_vertex[edges]]
    chosen = np.where(np.isin(ends[:, 0], TOUCHING), ends[:, 1], ends[:, 0])
    chosen = np.where(np.isin(chosen, TOUCHING), ends[:, 0], chosen)
    return {str(name): int(count) for name, count in zip(*np.unique(chosen, return_counts=True), strict=True)}


def test_a_head_has_all_of_the_models_actions(solved, model):
    assert list(solved.shapes) == in_order((*named_actions(model), *LOOKS)) and len(solved.shapes) == 33
    for shape in solved.shapes.values():
        assert (np.diff(shape.vertices) > 0).all() and np.isfinite(shape.offsets).all()
        assert bool(shape.between) == (shape.name in BLINKS)


def test_the_models_own_head_moves_as_the_model_does(model):
    """But for lids and lips, which are kept from passing through what they touch; turned and larger likewise. Of
    actions that fold no skin."""
    few = with_actions(model, "jaw_left", "brow_down_left", "cheek_puff", "nose_sneer", "eye_wide_right")
    (finer,) = levels_of(few, model.subdivided().faces)
    skin = finer.surface(finer.template).vertices_of(FAR_FROM_CONTACT)
    touching = finer.surface(finer.template).vertices_of(TOUCHING)
    turn = 1.1 * Rotation.from_rotvec([0.0, 0.2, 0.0]).as_matrix()
    for motion in (np.eye(3), turn):
        shapes = facial_actions(few, finer.template @ motion.T, finer.faces)
        for shape in (shape for shape in shapes if shape.name not in LOOKS):
            moved = np.zeros_like(finer.template)
            moved[shape.vertices] = shape.offsets
            expected = named_actions(finer)[shape.name] @ motion.T
            np.testing.assert_allclose(moved[skin & ~touching], expected[skin & ~touching], atol=LEAST_MM + 1e-4)


def test_eyeballs_do_not_move(solved):
    eyes = solved.surface.vertices_of(("eyes",))
    assert not any(eyes[shape.vertices].any() for shape in solved.shapes.values())


def test_the_same_at_every_level(model, solved):
    """A finer mesh of the same head: the same actions."""
    finer = solved.model.subdivided()
    assert len(levels_of(model, solved.model.faces)) == 1 and len(levels_of(model, finer.faces)) == 2
    vertices = finer.from_coarser @ solved.surface.mesh.vertices
    few = with_actions(model, "jaw_left", "brow_inner_up", "eye_blink_left")
    shapes = {shape.name: shape for shape in facial_actions(few, vertices, finer.faces)}
    count = len(solved.model.template)
    for name in ("jawLeft", "browInnerUp", "eyeBlinkLeft"):
        coarse, fine = np.zeros((count, 3)), np.zeros((len(vertices), 3))
        coarse[solved.shapes[name].vertices] = solved.shapes[name].offsets
        fine[shapes[name].vertices] = shapes[name].offsets
        skin = solved.surface.vertices_of(FAR_FROM_CONTACT) & ~solved.surface.vertices_of(TOUCHING)
        off = np.linalg.norm(coarse - fine[:count], axis=1)
        assert off[skin].max() < 1.0 and np.median(off[skin]) < 0.05


def test_a_mesh_of_another_topology_has_none(model, solved):
    surface = toy_eyed_surface()
    assert facial_actions(model, surface.mesh.vertices, surface.mesh.faces) == ()
    turned = solved.model.faces[:, [1, 2, 0]]
    assert facial_actions(model, solved.surface.mesh.vertices, turned) == ()
    assert levels_of(model, model.faces) == []


def test_skin_passes_through_itself_only_where_it_touches(solved):
    """Each action in full: edges that cross faces beyond those at rest, by the segment of the skin."""
    for name, shape in solved.shapes.items():
        assert set(new_crossings(solved.surface, shape)) <= set(TOUCHING), name
    assert new_crossings(solved.surface, solved.shapes["jawOpen"]).get("lips", 0) == 0
    folded = solved.shapes["jawOpen"]
    assert set(new_crossings(solved.surface, folded, weight=-1.0)) - {"eyes", "eye_sockets", "lids"}
