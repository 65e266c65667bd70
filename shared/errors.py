"""Errors that a person reads: one line that says what, where, got, expected and how to mend it."""

from __future__ import annotations

import reprlib

_LONGEST_PART = 400
_brief = reprlib.Repr()
_brief.maxstring = _brief.maxother = _brief.maxlong = 80
_brief.maxlevel = 2


class LimnError(Exception):
    """A failure of Limn's own (exit code 1)."""


class InputError(LimnError):
    """The input is at fault, not the program (exit code 2).

    what: the fault in a few words. where: stage, file, frame or key. got, expected: values. hint: what to do.
    """

    def __init__(self, what: str, *, where: str = "", got: object = "", expected: object = "", hint: str = ""):
        self.what, self.where, self.got, self.expected, self.hint = what, where, got, expected, hint
        super().__init__(self._line())

    def _line(self) -> str:
        parts = [f"{_plain(self.where, 5000)}: {self.what}" if self.where else self.what]
        if self.got != "":
            parts.append(f"got {_plain(self.got)}")
        if self.expected != "":
            parts.append(f"expected {_plain(self.expected)}")
        if self.hint:
            parts.append(self.hint)
        return _plain(" ".join("; ".join(parts).split()), 10_000)

    def __reduce__(self):
        fields = {"where": self.where, "got": self.got, "expected": self.expected, "hint": self.hint}
        return _rebuild_input_error, (self.what, fields)


def _rebuild_input_error(what: str, fields: dict) -> InputError:
    return InputError(what, **fields)


def refused(error: OSError, where: object = "", hint: str = "") -> InputError:
    """What to say of a file or folder that the system refuses; where: what was wanted, if the error does not say."""
    return InputError("cannot be read or written", where=str(error.filename or where), got=error.strerror or error,
                      hint=hint)


def shown(value: object) -> str:
    """`value` as Python writes it, cut short: what stands in a hostile file must not fill the line, or hours."""
    try:
        return _brief.repr(value)
    except ValueError:  # an integer of thousands of digits
        return f"{type(value).__name__} of very many digits"


def _plain(value: object, longest: int = _LONGEST_PART) -> str:
    """Text without control characters, which a terminal would obey, and no longer than that."""
    try:
        text = str(value)
    except ValueError:
        text = shown(value)
    text = text if len(text) <= longest else text[:longest] + " ..."
    return "".join(c if c.isprintable() or c.isspace() else ascii(c)[1:-1] for c in text)
