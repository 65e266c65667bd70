"""Levels of detail in USD: the variant set `detail` of the default prim.

The variant `base` holds the head as few quads under subdivision, and gives its material the displacement that makes the
full head of it.

Each variant holds the points, faces, texture coordinates, normals and blend shapes of the meshes; their prims, their
motion and their materials stand outside of it and are the same for all. Whoever puts the head far away, or many heads
into one scene, chooses a variant there; nobody has to change anything else.

The meshes have no purpose, so that every program draws them. Purposes `render` and `proxy` would show a coarse mesh in
viewports beside the full one in renders, both loaded, and nothing at all in readers that draw the purpose `default`
only. They pay for scenes that a viewport cannot hold; one head of some 100,000 triangles is not one.

Reference: UsdGeomImageable (purpose); USD Working Group, Guidelines for structuring USD assets (variants above the
payload, so that they can be chosen before it is loaded).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from pxr import Usd

from shared.io.usd_variants import define_variants, in_variant

DETAIL_SET, FULL, BASE = "detail", "full", "base"
REDUCED_FACES = {"20k": 20_000, "5k": 5_000}
"""Variant -> how many faces head and eyes have together."""


def define_details(root: Usd.Prim, levels: Sequence[str]) -> None:
    """Variants of these names, of which the first is chosen; none where there is one alone."""
    if len(levels) > 1:
        define_variants(root, DETAIL_SET, levels, levels[0])


def each_detail(root: Usd.Prim, levels: Sequence[str]) -> Iterator[str]:
    """Each of the levels, while what is written to the stage goes into the variant of that name; one alone goes into no
    variant."""
    define_details(root, levels)
    if len(levels) == 1:
        yield levels[0]
        return
    for name in (*levels[1:], levels[0]):
        with in_variant(root, DETAIL_SET, name, levels[0]):
            yield name
