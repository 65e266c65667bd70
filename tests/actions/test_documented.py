"""docs/blender.md says which of ARKit's names a head has."""

import re
from pathlib import Path

from shared.actions.facial import LOOKS
from shared.actions.names import ARKIT_NAMES, lacking_names, named_actions

PAGE = Path(__file__).resolve().parents[2] / "docs" / "blender.md"


def test_the_page_lists_what_a_head_has_and_lacks(model):
    table = PAGE.read_text(encoding="utf-8").partition("| has | lacks |")[2].partition("\n\n")[0]
    columns = [row.split("|")[1:3] for row in table.splitlines() if "`" in row]
    has, lacks = ([name for row in columns for name in re.findall(r"`(\w+)`", row[k])] for k in (0, 1))
    names = (*named_actions(model), *LOOKS)
    assert sorted(has) == sorted(names) and sorted(lacks) == sorted(lacking_names(names))
    assert sorted(has + lacks) == sorted(ARKIT_NAMES)
