"""inverse_render's parameters as the solver's settings."""

from shared.appearance.problem import AppearanceSettings
from shared.contract.job import Parameters
from shared.inverse.parameters import read_settings
from stages.inverse_render import STAGE


def test_defaults_of_the_stage_are_those_of_the_appearance_fit():
    """Numbers with a source of their own (measured skin) stand in the stage's declaration a second time."""
    assert read_settings(Parameters(STAGE.defaults())).appearance == AppearanceSettings()
