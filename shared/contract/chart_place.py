"""`chart:` of subject.yaml: whether a colour chart is looked for, or where it is."""

from __future__ import annotations

from dataclasses import dataclass

from shared.contract.wording import check_keys, check_pixels
from shared.errors import InputError, shown

_EXPECTED = "auto | off | {frame: 12, corners: [[x, y], [x, y], [x, y], [x, y]]}"
_CORNERS = "the grid's four corners in pixels of the source frame, in order around it"


@dataclass(frozen=True)
class ChartPlace:
    """look: whether to look for a chart at all; frame, corners: where a person found one (frame_index of the source,
    four (x, y) px in order around the grid), or None."""

    look: bool = True
    frame: int | None = None
    corners: tuple[tuple[float, float], ...] | None = None


AUTO = ChartPlace()


def parse_chart(given: object, where: str) -> ChartPlace:
    """The value of `chart:`; InputError when it is none of auto, off and a place."""
    if given is None or given is True or given == "auto":
        return AUTO
    if given is False or given == "off":  # YAML reads a bare off as false
        return ChartPlace(look=False)
    if not isinstance(given, dict):
        raise InputError("value not known", where=where, got=shown(given), expected=_EXPECTED)
    place = check_keys(given, ("frame", "corners"), where)
    frame = place.get("frame")
    if isinstance(frame, bool) or not isinstance(frame, int) or frame < 0:
        raise InputError("no frame of the clip", where=f"{where}.frame", got=shown(frame),
                         expected="a whole number, counted from 0")
    return ChartPlace(True, frame, _corners(place.get("corners"), f"{where}.corners"))


def _corners(given: object, where: str) -> tuple[tuple[float, float], ...]:
    points = given if isinstance(given, list) else []
    if len(points) != 4 or not all(isinstance(point, list) and len(point) == 2 for point in points):
        raise InputError("not four corners", where=where, got=shown(given), expected=_EXPECTED)
    check_pixels([value for point in points for value in point], where, _CORNERS)
    corners = tuple((float(x), float(y)) for x, y in points)
    if not _around(corners):
        raise InputError("the corners do not go around the chart", where=where, got=shown(given), expected=_CORNERS)
    return corners


def _around(corners: tuple[tuple[float, float], ...]) -> bool:
    """Whether the four are the corners of a convex shape, in order either way around."""
    turns = []
    for i in range(4):
        (ax, ay), (bx, by), (cx, cy) = (corners[(i + k) % 4] for k in range(3))
        turns.append((bx - ax) * (cy - by) - (by - ay) * (cx - bx))
    return all(turn > 0 for turn in turns) or all(turn < 0 for turn in turns)
