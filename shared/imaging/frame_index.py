"""Which of a clip's frames: those of each light, some spread evenly, those held out."""

from __future__ import annotations

import numpy as np


def frames_of_lights(light_index: np.ndarray | None, count: int) -> list[np.ndarray]:
    """Of each light, the indices of its frames out of count; light_index [count]: each frame's light, None: one."""
    index = np.zeros(count, int) if light_index is None else light_index
    return [np.nonzero(index == light)[0] for light in range(int(index.max(initial=0)) + 1)]


def spread_frames(count: int, wanted: int, light_index: np.ndarray | None = None) -> np.ndarray:
    """At most wanted indices, evenly over range(count); of several lights, as many of each."""
    frames = frames_of_lights(light_index, count)
    spread = [own[np.unique(np.round(np.linspace(0, len(own) - 1, min(wanted, len(own)))).astype(int))]
              for own in frames]
    return np.concatenate(spread)


def hold_out(count: int, every: int, light_index: np.ndarray | None = None) -> np.ndarray:
    """[count] bool, True for fitted frames: every every-th frame is held out, starting in the middle of a period; of
    several lights, among the frames of each."""
    fitted = np.ones(count, bool)
    for own in frames_of_lights(light_index, count):
        if len(own) > every:
            fitted[own[every // 2 :: every]] = False
    return fitted


def halves(fitted: np.ndarray, light_index: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Two masks [F] bool that share out the frames fitted [F] bool by turns; of several lights, those of each."""
    found = np.zeros((2, len(fitted)), bool)
    for own in frames_of_lights(light_index, len(fitted)):
        rows = own[fitted[own]]
        for k, half in enumerate(found):
            half[rows[k::2]] = True
    return found[0], found[1]
