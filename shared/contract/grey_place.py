"""`grey:` of subject.yaml: a place in the picture that is grey, in the light of the face."""

from __future__ import annotations

from shared.contract.wording import check_pixels
from shared.errors import InputError, shown

_EXPECTED = "[x, y] in pixels of the source frame"


def parse_grey(given: object, moves: str, where: str) -> tuple[float, float] | None:
    """The value of `grey:`, (x, y) px, None where it is not given; moves: "head" or "camera".

    InputError when it is no place, or where the camera moves: there one place in the picture shows many things.
    """
    if given is None:
        return None
    if not isinstance(given, list) or len(given) != 2:
        raise InputError("not a place in the picture", where=where, got=shown(given), expected=_EXPECTED)
    check_pixels(given, where, _EXPECTED)
    if moves == "camera":
        raise InputError("a grey place before a camera that moves", where=where, got=shown(given),
                         hint="leave grey out: only a camera that stands still shows one thing in one place")
    return float(given[0]), float(given[1])
