"""Variant sets of the asset's default prim, written layer by layer: what a variant says may lie in several of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from pxr import Usd


def define_variants(root: Usd.Prim, name: str, variants: Iterable[str], chosen: str) -> None:
    """The variant set of that name with these variants, of which one is chosen."""
    found = root.GetVariantSets().AddVariantSet(name)
    for variant in variants:
        found.AddVariant(variant)
    found.SetVariantSelection(chosen)


@contextmanager
def in_variant(root: Usd.Prim, name: str, variant: str, chosen: str) -> Iterator[None]:
    """What is written to the stage meanwhile goes into a variant of the set of that name; then `chosen` is chosen."""
    define_variants(root, name, (chosen, variant), variant)
    found = root.GetVariantSet(name)
    with found.GetVariantEditContext():
        yield
    found.SetVariantSelection(chosen)
