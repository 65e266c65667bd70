"""Exports of toy heads opened by USD, and where their parts are."""

from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom


def opened_root(path: Path):
    """Yields the root prim of a layer or package, its stage kept open meanwhile."""
    stage = Usd.Stage.Open(str(path))
    yield stage.GetDefaultPrim()
    del stage


def placed(root: Usd.Prim, name: str, time: float | Usd.TimeCode) -> np.ndarray:
    """[4, 4] from a part's own axes to the asset's world."""
    return np.array(UsdGeom.Imageable(root.GetPrimAtPath(f"geo/{name}")).ComputeLocalToWorldTransform(time)).T
