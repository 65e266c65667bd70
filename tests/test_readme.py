"""The README says what the code says."""

import re
from pathlib import Path

from tools.readme import README, with_parameters


def test_parameter_table_is_up_to_date():
    text = README.read_text(encoding="utf-8")
    assert text == with_parameters(text), "run: python -m tools.readme"


def test_every_local_link_leads_somewhere():
    links = re.findall(r"\]\((?!https?:)([^)#]+)\)", README.read_text(encoding="utf-8"))
    assert links
    for link in links:
        assert (Path(README).parent / link).exists(), link
