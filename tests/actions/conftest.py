"""A head that the model can make, with its blend shapes."""

from dataclasses import dataclass

import numpy as np
import pytest

from shared.actions.facial import facial_actions, levels_of
from shared.geometry.blend_shapes import BlendShape
from shared.geometry.surface import Surface
from shared.tracking.fit_eyeballs import set_eyeballs
from shared.tracking.head_model import HeadModel
from shared.tracking.models import load_head_model


@dataclass(frozen=True)
class SolvedHead:
    """model: at the level of the surface; shapes: by name."""

    model: HeadModel
    surface: Surface
    shapes: dict[str, BlendShape]


@pytest.fixture(scope="session")
def model():
    return load_head_model()


@pytest.fixture(scope="session")
def solved(model):
    """Not the mean head, the eyeballs of anatomical size."""
    finer = model.subdivided()
    vertices = set_eyeballs(finer, finer.shape(np.random.default_rng(3).standard_normal(20) * 0.7))
    shapes = facial_actions(model, vertices, finer.faces)
    return SolvedHead(levels_of(model, finer.faces)[-1], finer.surface(vertices), {each.name: each for each in shapes})
