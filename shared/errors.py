"""Errors that a person reads: one line that says what, where, got, expected and how to mend it."""

from __future__ import annotations


class LimnError(Exception):
    """A failure of Limn's own (exit code 1)."""


class InputError(LimnError):
    """The input is at fault, not the program (exit code 2).

    what: the fault in a few words. where: stage, file, frame or key. got, expected: values. mend: what to do.
    """

    def __init__(self, what: str, *, where: str = "", got: object = "", expected: object = "", mend: str = ""):
        self.what, self.where, self.got, self.expected, self.mend = what, where, got, expected, mend
        super().__init__(self._line())

    def _line(self) -> str:
        parts = [f"{self.where}: {self.what}" if self.where else self.what]
        if self.got != "":
            parts.append(f"got {self.got}")
        if self.expected != "":
            parts.append(f"expected {self.expected}")
        if self.mend:
            parts.append(self.mend)
        return " ".join("; ".join(parts).split())

    def __reduce__(self):
        fields = {"where": self.where, "got": self.got, "expected": self.expected, "mend": self.mend}
        return _rebuild_input_error, (self.what, fields)


def _rebuild_input_error(what: str, fields: dict) -> InputError:
    return InputError(what, **fields)
