"""Lips that are pressed on each other."""

from dataclasses import replace

import numpy as np
import pytest

from shared.actions.lips import MOST_MM, LipContact
from shared.actions.names import named_actions
from shared.geometry.intersections import crossing_edges


@pytest.fixture(scope="module")
def contact(solved):
    return LipContact.of(solved.model, solved.surface.mesh.vertices)


def crossing(solved, vertices) -> int:
    faces = solved.model.faces[solved.model.segment("lips", "inner_mouth")]
    return len(crossing_edges(vertices, faces))


@pytest.mark.parametrize("name", ["mouthSmileLeft", "mouthPressRight", "cheekPuff"])
def test_lips_that_are_pressed_together_do_not_pass_through_each_other(solved, contact, name):
    """The model's own displacements press them, by tenths of a millimetre too far."""
    rest = solved.surface.mesh.vertices
    wanted = rest + named_actions(solved.model)[name]
    parted = contact.parted(wanted)
    assert contact.moved_by(wanted - rest)
    assert crossing(solved, wanted) > 80 and crossing(solved, parted) < 20
    assert np.linalg.norm(parted - wanted, axis=1).max() < MOST_MM
    untouched = ~solved.surface.vertices_of(("lips", "inner_mouth"))
    np.testing.assert_array_equal(parted[untouched], wanted[untouched])


def test_lips_that_part_are_left_alone(solved, contact):
    wanted = solved.surface.mesh.vertices + named_actions(solved.model)["jawOpen"]
    np.testing.assert_array_equal(contact.parted(wanted), wanted)
    assert not contact.moved_by(named_actions(solved.model)["browInnerUp"])


def test_no_lips_no_contact(solved):
    other = replace(solved.model, segment_names=tuple(f"part {k}" for k in range(16)))
    assert LipContact.of(other, solved.surface.mesh.vertices) is None
