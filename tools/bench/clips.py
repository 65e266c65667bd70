"""What the benches of inverse_render share: a tracked clip of a subject whose truth is known, and the stage's settings.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

from shared.contract.job import Parameters
from shared.inverse.clip_inputs import ClipInputs, read_inputs
from shared.inverse.parameters import read_settings
from shared.inverse.problem import InverseSettings
from stages.inverse_render import STAGE
from tools.bench.runner import Bench


def settings_of(changes: Mapping[str, Any]) -> InverseSettings:
    """The solver's settings with some of the stage's parameters changed; InputError for unknown ones."""
    return read_settings(Parameters({**STAGE.defaults(), **STAGE.parse(dict(changes), "tools.bench")}))


def open_clip(subject: Path, run: Path, tracked: bool) -> ClipInputs:
    """A run's clip with its tracked mesh and poses, or with the true ones."""
    truth = ("", "") if tracked else (str(subject / "gt" / "mesh.obj"), str(subject / "gt" / "poses.npz"))
    return read_inputs(run / "work" / "sample_frames", run / "work" / "track_landmarks", *truth)


class SettingsBench(Bench):
    """A bench of inverse_render with --set: parameters for every case."""

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="parameters for every case")

    @property
    def given(self) -> dict[str, str]:
        """The parameters of --set."""
        return dict(setting.split("=", 1) for setting in self.options.set)

    def facts(self) -> dict[str, Any]:
        return {"inverse_render": STAGE.version, "set": self.given}


class ClipBench(SettingsBench):
    """A bench on one clip: SUBJECT, a folder with gt/, and RUN, a run's folder whose work/ holds sample_frames and
    track_landmarks."""

    always_tracked = False

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        super().add_arguments(parser)
        parser.add_argument("subject", type=Path, help="folder with gt/")
        parser.add_argument("run", type=Path, help="a run's folder, with work/")
        if not cls.always_tracked:
            parser.add_argument("--tracked", action="store_true", help="tracked mesh and poses, not the true ones")

    @property
    def tracked(self) -> bool:
        """Whether mesh and poses are the tracked ones."""
        return self.always_tracked or self.options.tracked

    @cached_property
    def clip(self) -> ClipInputs:
        """The clip's inputs."""
        return open_clip(self.options.subject, self.options.run, self.tracked)

    def facts(self) -> dict[str, Any]:
        folders = {"subject": self.options.subject.resolve().name, "run": self.options.run.resolve().name}
        return super().facts() | folders | {"tracked": self.tracked}
