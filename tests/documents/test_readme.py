"""The README and docs/ say what the code says, and every link leads somewhere."""

import ast
import importlib.util
import re
import tomllib

import pytest
import yaml

from shared.contract.pipeline import load_pipeline
from tools.documents.readme import DOCS, README, SCORES, cost_table, documents

TEXTS = sorted([*README.parent.glob("*.md"), *DOCS.glob("*.md")])
_FENCED = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"\]\((?!https?:|mailto:)([^)\s]+)\)")
_HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)



@pytest.mark.parametrize("path", documents(), ids=lambda path: path.name)
def test_tables_are_up_to_date(path):
    assert path.read_text(encoding="utf-8") == documents()[path], "run: python -m tools.documents.readme"


def test_every_parameter_and_every_file_is_listed():
    stages = load_pipeline().stages.values()
    parameters, files = ((DOCS / name).read_text(encoding="utf-8") for name in ("parameters.md", "files.md"))
    for stage in stages:
        missing = [p.name for p in stage.parameters if f"| {stage.name} | `{p.name}` |" not in parameters]
        assert not missing and f"## `{stage.folder}/`" in files, (stage.name, missing)
        assert [o.path for o in stage.outputs if f"| `{o.path}` | {o.help}" not in files] == []
        assert [f.path for o in stage.outputs for f in o.fields if f"| `{f.path}` |" not in files] == []


def test_costs_are_listed_by_rising_cost_without_ablations():
    scores = {name: 1.0 for name, _ in SCORES.values()}
    cost = {"wall_s": 10.0, "cpu_s": 20.0, "peak_mb": 300.0, "others": 0.0}
    rows = [
        {"case": name, "group": group, "settings": [], "repeat": 0, "threads": 2, "scores": scores,
         "stages": {"inverse_render": cost | {"cpu_s": seconds}}}
        for name, group, seconds in (("slow", "preset", 90.0), ("quick", "peer", 9.0), ("matte", "ablation", 5.0))
    ]  # fmt: skip
    rows[0]["stages"]["export_usd"] = cost
    table = cost_table(rows).splitlines()
    assert len(table) == 6 and table[2].startswith("| quick | 10 | 9 |  | 300 MB | 1.00 | 1.0 |")
    assert table[3].startswith("| slow | 10 | 90 | 20 | 300 MB")
    assert table[5].startswith("Medians of 1, from the clip to the maps, on 2 cores; other work kept 0.0 cores")


def links_of(path):
    return _LINK.findall(_FENCED.sub("", path.read_text(encoding="utf-8")))


def anchors_of(path):
    """As code hosts make them of headings: lower case, spaces to hyphens, no other punctuation."""
    headings = _HEADING.findall(_FENCED.sub("", path.read_text(encoding="utf-8")))
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.name)
def test_every_local_link_leads_somewhere(path):
    for link in links_of(path):
        name, _, anchor = link.partition("#")
        target = (path.parent / name).resolve() if name else path
        assert target.exists(), f"{path.name}: {link}"
        assert not anchor or anchor in anchors_of(target), f"{path.name}: {link}"


def test_the_readme_links_to_every_document():
    linked = {link.partition("#")[0] for link in links_of(README)}
    assert [path.name for path in sorted(DOCS.glob("*.md")) if f"docs/{path.name}" not in linked] == []


@pytest.mark.parametrize("path", [path for path in TEXTS if path.name != "CHANGELOG.md"], ids=lambda path: path.name)
def test_what_the_documents_name_is_there(path):
    """Modules that are run, commands of limn, parameters, presets, files of the repository."""
    text, pipeline = path.read_text(encoding="utf-8"), load_pipeline()
    modules = set(re.findall(r"python -m ((?:tools|stages)(?:\.[a-z_]+)+)", text))
    assert [name for name in modules if importlib.util.find_spec(name) is None] == []
    commands = set(re.findall(r"^    limn ([a-z]+)", text, re.MULTILINE)) | set(re.findall(r"`limn ([a-z]+)", text))
    assert commands <= set(limn_commands()), commands - set(limn_commands())
    parameters = {f"{stage.name}.{p.name}" for stage in pipeline.stages.values() for p in stage.parameters}
    assert set(re.findall(rf"\b((?:{'|'.join(pipeline.stages)})\.[a-z][a-z_]+)=", text)) <= parameters
    named = {name for name in re.findall(r"`([a-z][a-z_]+)=[^`]*`", text) if path.name != "reproducibility.md"}
    assert named <= {name.partition(".")[2] for name in parameters}  # there it is the code that is changed
    assert set(re.findall(r"--preset ([a-z]+)", text)) <= set(pipeline.presets)
    files = re.findall(r"`((?:shared|stages|tools|tests|profiles|container|docs)/[\w/.]*)`", text)
    assert [name for name in files if not (README.parent / name).exists()] == []


def defined_names(path):
    """Functions, classes and their methods (Class.method) of a module."""
    names = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            names |= {node.name} | {f"{node.name}.{own.name}" for own in node.body if isinstance(own, ast.FunctionDef)}
    return names


@pytest.mark.parametrize("path", [path for path in TEXTS if path.name != "CHANGELOG.md"], ids=lambda path: path.name)
def test_functions_that_the_documents_name_are_there(path):
    """`shared/room/module.py:function`, `shared/room/module.py:Class.method`."""
    named = re.findall(r"`([\w/]+\.py):([\w.]+)`", path.read_text(encoding="utf-8"))
    assert len(named) > 20 or path.name != "architecture.md"
    assert [pair for pair in named if pair[1] not in defined_names(README.parent / pair[0])] == []


def limn_commands():
    from tools.limn import make_parser

    actions = make_parser()._actions
    return next(action.choices for action in actions if isinstance(action.choices, dict))


def test_the_readme_is_short_and_names_what_a_newcomer_types():
    text = README.read_text(encoding="utf-8")
    assert 8_000 <= len(text.encode()) <= 10_000
    for command in ("make demo", "make test ", "make test-all", "limn new", "limn run", "limn report"):
        assert command in text, command


def test_the_citation_is_of_this_version():
    citation = yaml.safe_load((README.parent / "CITATION.cff").read_text(encoding="utf-8"))
    project = tomllib.loads((README.parent / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert (citation["version"], citation["license"]) == (project["version"], project["license"])
    assert {"cff-version", "message", "title", "authors"} <= citation.keys()
