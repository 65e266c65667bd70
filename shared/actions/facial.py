"""The facial actions of a solved head, as blend shapes with ARKit's names.

They come from the head model: carried over to the solved head (transfer), lids kept about the eyeballs (eyelids), skin
kept from folding over (folds) and lips from passing through each other (lips). Lids that follow the gaze, which the
model does not have, are made of its eyeballs and margins (eyelids). The head at rest is the solved one, whatever its
expression is: eyes that are half shut in it need half of a blink. Eyeballs do not move; they turn as parts of their
own.
"""

from __future__ import annotations

from collections.abc import Container
from dataclasses import replace

import numpy as np

from shared.actions.eyelids import HALF, Eyelids
from shared.actions.folds import SkinFolds
from shared.actions.lips import LipContact
from shared.actions.names import in_order, named_actions
from shared.actions.transfer import carried, local_similarities
from shared.geometry.blend_shapes import BLINKS, LOOK_RAD, LOOKS_DOWN, LOOKS_UP, BlendShape
from shared.tracking.head_model import HeadModel

LOOKS = {name: (eye, sign * LOOK_RAD) for sign, names in ((-1.0, LOOKS_DOWN), (1.0, LOOKS_UP))
         for eye, name in enumerate(names)}  # fmt: skip
"""Of each of these: which eye, and how far up its lids follow the gaze."""
LEAST_MM = 0.05
"""A vertex moves if it does so by more than this: a quarter of a pixel where a face is 1000 pixels wide."""
HIDDEN = ("eyes", "eye_sockets", "inner_mouth")
"""Nobody sees how these lie in a solved head: they do not count where it is compared with the model."""
TOUCHING = ("lids", "eyes", "eye_sockets", "lips", "inner_mouth")
"""Segments in which skin touches skin, or an eyeball. The rims of a fitted head's lids, deeper than real ones, reach
into the ball at rest."""


def levels_of(model: HeadModel, faces: np.ndarray) -> list[HeadModel]:
    """The head model subdivided once, twice and so on until it has these faces [F, 3]; empty where it never has.

    model: at its coarsest level. Of the identities one is left, to save time and memory.
    """
    levels = [replace(model, identity_basis=model.identity_basis[:1])]
    while len(levels[-1].faces) < len(faces):
        levels.append(levels[-1].subdivided())
    return levels[1:] if np.array_equal(levels[-1].faces, faces) else []


def facial_actions(
    model: HeadModel, vertices: np.ndarray, faces: np.ndarray, only: Container[str] | None = None
) -> tuple[BlendShape, ...]:
    """Of the head with vertices [V, 3] mm and faces [F, 3]; none where these are not the model's, subdivided.

    model: the head model at its coarsest level; only: names of those that are wanted, None: all.
    """
    levels = levels_of(model, faces)
    if not levels:
        return ()
    finer, vertices = levels[-1], np.asarray(vertices, np.float64)
    maps, lids = _maps(model, levels, vertices), Eyelids.of(finer, vertices, splits=len(levels) - 1)
    lips, surface = LipContact.of(finer, vertices), finer.surface(vertices)
    still, skin = surface.vertices_of(("eyes",)), SkinFolds.of(vertices, faces, ~surface.vertices_of(TOUCHING))
    shapes, known = [], named_actions(finer)
    for name in in_order((*known, *LOOKS)) if lids is not None else known:
        if only is not None and name not in only:
            continue
        between = ()
        if name in LOOKS:
            moved = skin.smoothed(lids.following(*LOOKS[name]))
        else:
            moved = np.where(still[:, None], 0.0, carried(known[name], maps))
            if lids is not None and name in BLINKS:
                moved, half = lids.blink(BLINKS.index(name), known[name], moved)
                between = ((HALF, half),)
            elif lids is not None:
                moved = skin.smoothed(lids.clear_of_balls(moved))
        if lips is not None and lips.moved_by(moved):
            moved = lips.parted(vertices + moved) - vertices
        shapes.append(BlendShape.of(name, moved, LEAST_MM, between))
    return tuple(shape for shape in shapes if len(shape.vertices))


def _maps(model: HeadModel, levels: list[HeadModel], vertices: np.ndarray) -> np.ndarray:
    """[V, 3, 3] from displacements of the model to those of the head, found at the coarsest level's vertices:
    subdivision keeps them as the first ones."""
    count = len(model.template)
    seen = model.surface(model.template)
    seen = seen.vertices_of([name for name in model.segment_names if name not in HIDDEN])
    maps = local_similarities(levels[-1].template[:count], vertices[:count], seen).reshape(count, 9)
    for level in levels:
        maps = level.from_coarser @ maps
    return maps.reshape(-1, 3, 3)
