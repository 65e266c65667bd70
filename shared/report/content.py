"""What the report is made from: plain values and arrays, gathered by the stage that publishes the result."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from shared.geometry.mesh import Mesh
from shared.rendering.view_set import ViewSet


@dataclass(frozen=True)
class Frame:
    """A frame of the clip beside its re-render, both [H, W, 3] linear, cropped alike; 0 where nothing was rendered.

    clipped [H, W] bool: pixels whose code value is the maximum.
    """

    frame_index: int
    time_s: float
    clip: np.ndarray
    render: np.ndarray
    clipped: np.ndarray
    held_out: bool


@dataclass(frozen=True)
class StageCost:
    """What a stage took; None where that is not known."""

    stage: str
    wall_s: float | None
    cpu_s: float | None
    peak_memory_mb: float | None


@dataclass(frozen=True)
class ClipContent:
    """Another clip that the head was solved from, in a light of its own; fields as in ReportContent."""

    name: str
    facts: Sequence[tuple[str, str]]
    frames: Iterable[Frame]
    envmap: np.ndarray
    frame_index: np.ndarray
    angles_deg: np.ndarray
    position_mm: np.ndarray
    excluded: Sequence[tuple[int, str, str]] = ()


@dataclass(frozen=True)
class ReportContent:
    """One subject's result.

    facts, numbers, files: (label, value) pairs. maps {name: [S, S] or [S, S, 3]}, envmap [H, W, 3] linear.
    angles_deg [F, 3] yaw, pitch, roll and position_mm [F, 3] at frame_index [F]. excluded: (frame, stage, reason).
    views: None when they were not wished. selection: the models tried, one dictionary each, in order. residuals: nested
    dictionaries of numbers. iterations: one dictionary of numbers each. warnings: (stage, text). parameters: (stage,
    name, value). clips: all but the first, where there are several. methods: paragraphs and references.
    """

    name: str
    facts: Sequence[tuple[str, str]]
    numbers: Sequence[tuple[str, str]]
    frames: Iterable[Frame]
    maps: Mapping[str, np.ndarray]
    envmap: np.ndarray
    mesh: Mesh
    frame_index: np.ndarray
    angles_deg: np.ndarray
    position_mm: np.ndarray
    views: ViewSet | None = None
    overlay: np.ndarray | None = None
    shape: np.ndarray | None = None
    chart: np.ndarray | None = None
    excluded: Sequence[tuple[int, str, str]] = ()
    selection: Sequence[Mapping[str, object]] = ()
    model: Mapping[str, object] = field(default_factory=dict)
    residuals: Mapping[str, object] = field(default_factory=dict)
    iterations: Sequence[Mapping[str, float]] = ()
    costs: Sequence[StageCost] = ()
    warnings: Sequence[tuple[str, str]] = ()
    parameters: Sequence[tuple[str, str, object]] = ()
    files: Sequence[tuple[str, str]] = ()
    clips: Sequence[ClipContent] = ()
    methods: tuple[Sequence[str], Sequence[str]] = ((), ())
