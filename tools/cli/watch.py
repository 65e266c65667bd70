"""Shows what running stages tell: reads their event files, keeps one bar per stage on a terminal, lines elsewhere."""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from shared.contract.progress import terminal_bar

_LINE_S = 10.0
_FIELDS: dict[str, dict[str, tuple]] = {
    "started": {"time": (int, float)}, "current": {}, "done": {"seconds": (int, float)}, "warning": {"text": (str,)},
    "progress": {"label": (str,), "done": (int,), "total": (int, type(None))}, "input_error": {"message": (str,)},
    "failed": {"message": (str,), "log": (str,), "last": (list,)},
}
_ENDS = {"current": "current", "done": "done", "input_error": "input error", "failed": "failed"}


@dataclass
class Track:
    """One stage of one subject, as far as its events tell."""

    subject: str
    stage: str
    path: Path
    read_to: int = 0
    state: str = "waiting"
    seconds: float = 0.0
    message: str = ""
    log: str = ""
    label: str = ""
    done: int = 0
    total: int | None = None
    since: float = 0.0
    bar: object = None
    bar_label: str = ""
    last_line: float = field(default_factory=time.monotonic)

    def new_events(self) -> list[dict]:
        """Events since the last call; a line that is not complete yet is left for the next."""
        try:
            with open(self.path, "rb") as file:
                file.seek(self.read_to)
                data = file.read()
        except FileNotFoundError:
            return []
        whole = data[: data.rfind(b"\n") + 1]
        self.read_to += len(whole)
        events = []
        for line in whole.splitlines():
            with contextlib.suppress(ValueError, RecursionError):  # a line that a full disk cut
                events.append(json.loads(line))
        return [event for event in events if isinstance(event, dict) and is_event(event)]

    def apply(self, event: dict) -> None:
        """Takes over what an event says. A stage that starts again (a retry) leaves its earlier end behind."""
        kind = event["kind"]
        if kind == "started":
            self.state, self.message, self.log, self.since = "running", "", "", event["time"]
            self.label, self.done, self.total = "", 0, None
        elif kind == "progress":
            self.label, self.done, self.total = event["label"], event["done"], event["total"]
        elif kind in _ENDS:
            self.state, self.message, self.log = _ENDS[kind], event.get("message", ""), event.get("log", "")
            self.seconds = event.get("seconds", 0.0)

    @property
    def progress(self) -> str:
        """How far the running stage is, in words."""
        whole = f"/{self.total}" if self.total is not None else ""
        return f"{self.label} {self.done}{whole}" if self.label else "started"


def is_event(event: dict) -> bool:
    """Whether a record has all that its kind of event needs: the files lie in folders that strangers may hand over."""
    kind = event.get("kind")
    fields = _FIELDS.get(kind) if isinstance(kind, str) else None
    return fields is not None and all(isinstance(event.get(name, ...), types) for name, types in fields.items())


class Watch:
    """Follows the event files of a run."""

    def __init__(self, tracks: Sequence[Track]) -> None:
        self.tracks = list(tracks)
        self._terminal = sys.stderr.isatty()
        self._width = max((len(f"{t.subject}  {t.stage}") for t in self.tracks), default=0)

    @property
    def has_begun(self) -> bool:
        """Whether any stage has told anything."""
        return any(track.state != "waiting" for track in self.tracks)

    def poll(self) -> None:
        """Shows what is new."""
        for track in self.tracks:
            for event in track.new_events():
                track.apply(event)
                getattr(self, f"_on_{event['kind']}")(track, event)

    def close(self) -> None:
        """Removes the bars."""
        for track in self.tracks:
            self._end_bar(track)

    def _say(self, track: Track, text: str) -> None:
        line = f"{track.subject + '  ' + track.stage:{self._width}}  {text}"
        if self._terminal:
            from tqdm import tqdm

            tqdm.write(line, file=sys.stderr)
        else:
            print(line, file=sys.stderr, flush=True)

    def _on_started(self, track: Track, _event: dict) -> None:
        self._say(track, "started")

    def _on_progress(self, track: Track, event: dict) -> None:
        if self._terminal:
            self._update_bar(track, event["label"], event["done"], event["total"])
        elif time.monotonic() - track.last_line >= _LINE_S:
            track.last_line = time.monotonic()
            self._say(track, track.progress)

    def _on_warning(self, track: Track, event: dict) -> None:
        self._say(track, f"warning: {event['text']}")

    def _on_current(self, track: Track, _event: dict) -> None:
        self._say(track, "current")

    def _on_done(self, track: Track, event: dict) -> None:
        self._end_bar(track)
        self._say(track, f"done in {track.seconds:.1f} s")

    def _on_input_error(self, track: Track, event: dict) -> None:
        self._end_bar(track)
        self._say(track, event["message"])

    def _on_failed(self, track: Track, event: dict) -> None:
        self._end_bar(track)
        self._say(track, f"failed: {event['message']}")
        for line in event["last"]:
            self._say(track, f"| {line}")
        self._say(track, f"the whole log: {event['log']}")

    def _update_bar(self, track: Track, label: str, done: int, total: int | None) -> None:
        if track.bar is not None and (track.bar_label != label or done < track.bar.n):
            self._end_bar(track)
        if track.bar is None:
            track.bar_label = label
            track.bar = terminal_bar(None, f"{track.subject}  {track.stage}: {label}", total)
        track.bar.update(done - track.bar.n)

    @staticmethod
    def _end_bar(track: Track) -> None:
        if track.bar is not None:
            track.bar.close()
            track.bar = None
