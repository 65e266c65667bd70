"""What the headers of exported EXR files have to say of them, so that nobody has to guess: channels, colours, unit.

Read from the headers alone, no pixel decoded. What a header gets wrong is told apart from what it leaves open, since
files of older versions leave more open.
"""

from __future__ import annotations

from shared.io.export_maps import MAPS
from shared.io.exr_header import ExrPart
from shared.io.images import CHROMATICITIES, COLOUR_SPACES
from shared.io.material_maps import CHANNELS

UNIT, CONTENT, SPACE, PRIMARIES = "limn:unit", "limn:content", "colorInteropID", "chromaticities"
_ENVMAP, _LATLONG = "envmap", 0
_FLOATS = (1, 2)
_TOLERANCE = 1e-4


def header_errors(part: ExrPart, map_name: str = "", latlong: bool = False, layer: bool = False) -> list[str]:
    """Sentences about what the header of an exported EXR gets wrong; empty when it is sound.

    map_name: which of export_maps.MAPS it should be, "" for pictures; latlong: whether it is a light; layer: whether it
    is a picture with an alpha.
    """
    errors = _channel_errors(part, map_name, layer) + _colour_errors(part, map_name)
    content = part.values.get(CONTENT, map_name)
    if map_name and content != map_name:
        errors.append(f"states {content} as its content ({CONTENT}), expected {map_name}")
    width, height = part.size
    if latlong and (width != 2 * height or part.values.get(_ENVMAP, _LATLONG) != _LATLONG):
        errors.append(f"{width} x {height} of {_ENVMAP} {part.values.get(_ENVMAP)} is no lat-long light")
    return errors


def header_gaps(part: ExrPart, map_name: str = "", latlong: bool = False) -> list[str]:
    """Names of the attributes that the header of an exported EXR should have and has not. map_name, latlong: as for
    header_errors."""
    wanted = [SPACE, UNIT] + [CONTENT] * (map_name in MAPS) + [_ENVMAP] * latlong
    wanted += [PRIMARIES] * (part.values.get(SPACE) in CHROMATICITIES)
    return [name for name in wanted if part.values.get(name, "") == ""]


def _channel_errors(part: ExrPart, map_name: str, layer: bool) -> list[str]:
    names = {channel.name for channel in part.channels}
    kind = MAPS[map_name][0] if map_name in MAPS else ""
    colours = "RGBA" if layer else "RGB"
    expected = CHANNELS if kind == "materials" else "Y" if kind == "data" and map_name != "normal" else colours
    errors = []
    if names != set(expected):
        errors.append(f"channels {', '.join(sorted(names))}, expected {', '.join(expected)}")
    if any(channel.kind not in _FLOATS or channel.step != (1, 1) for channel in part.channels):
        errors.append("not all channels are floats of full size")
    return errors


def _colour_errors(part: ExrPart, map_name: str) -> list[str]:
    if SPACE not in part.values:
        return []
    space, primaries = part.values[SPACE], part.values.get(PRIMARIES)
    if space not in COLOUR_SPACES:
        return [f"states the colour space {space} ({SPACE}), expected one of {', '.join(COLOUR_SPACES)}"]
    is_data = map_name in MAPS and MAPS[map_name][0] != "colour"
    if (space == "data") != is_data:
        return [f"states the colour space {space} ({SPACE}), but holds {'data' if is_data else 'colours'}"]
    expected = CHROMATICITIES.get(space, ())
    if primaries is not None and not _near(primaries, expected):
        return [f"its {PRIMARIES} are not those of {space}"]
    return []


def _near(numbers: tuple, expected: tuple) -> bool:
    return len(numbers) == len(expected) and all(abs(a - b) <= _TOLERANCE for a, b in zip(numbers, expected,
                                                                                       strict=True))
