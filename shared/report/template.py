"""Jinja2 templates of pages for people: every value is escaped, and a name that is not given is an error."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup


def filled(folder: Path, name: str, values: dict[str, object]) -> Markup:
    """The template `name` of the folder with its values. Deterministic: the same values give the same text.

    Besides Jinja2's own, templates have verbatim(name), the text of another file of the folder (a script, a style), and
    the filter tojson, whose text cannot end the script element in which it stands.
    """
    return Markup(_environment(folder).get_template(name).render(values))


@cache
def _environment(folder: Path) -> Environment:
    """Reads files of the folder only."""
    environment = Environment(loader=FileSystemLoader(folder), autoescape=True, undefined=StrictUndefined,
                              trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True)
    environment.policies["json.dumps_kwargs"] = {"sort_keys": True, "separators": (",", ":"), "allow_nan": False}
    environment.globals["verbatim"] = lambda name: Markup(environment.loader.get_source(environment, name)[0])
    return environment
