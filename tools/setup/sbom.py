"""A software bill of materials: CycloneDX 1.6 as JSON, of the installed packages and the models of set-up.

The same installation gives the same bytes: no time stamp, no random serial number.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path

from packaging.utils import canonicalize_name

from shared.contract.models import models_folder
from shared.tracking.models import LIST_FILE
from tools.setup.packages import ROOT, Package

_EXPRESSION = re.compile(r"[A-Za-z0-9.-]+(\s+(AND|OR|WITH)\s+[A-Za-z0-9.-]+)*\Z")
_SCOPES = {"run": "required"}


def write_sbom(path: Path, packages: Sequence[Package]) -> None:
    """Writes the bill."""
    path.write_text(json.dumps(bill(packages), indent=1, sort_keys=True) + "\n", encoding="utf-8")


def bill(packages: Sequence[Package]) -> dict[str, object]:
    """The bill as JSON values."""
    refs = {canonicalize_name(package.name): _purl(package) for package in packages}
    root = next(package for package in packages if canonicalize_name(package.name) == ROOT)
    others = [package for package in packages if package is not root]
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {"component": _component(root, "application")},
        "components": [*(_component(package, "library") for package in others), *_models()],
        "dependencies": [{"ref": _purl(package), "dependsOn": sorted(refs[name] for name in package.needs)}
                         for package in packages],
    }


def _purl(package: Package) -> str:
    return f"pkg:pypi/{canonicalize_name(package.name)}@{package.version.replace('+', '%2B')}"


def _component(package: Package, kind: str) -> dict[str, object]:
    is_expression = _EXPRESSION.match(package.licence) and package.licence != "unknown"
    licence = [{"expression": package.licence}] if is_expression and _is_spdx(package.licence) else [
        {"license": {"name": package.licence}}]
    return {"type": kind, "bom-ref": _purl(package), "purl": _purl(package), "name": package.name,
            "version": package.version, "licenses": licence, "scope": _SCOPES.get(package.scope, "optional"),
            "properties": [{"name": "limn:scope", "value": package.scope}]}


def _is_spdx(text: str) -> bool:
    """Whether every part has the look of an SPDX identifier: with a version, or one of the short ones."""
    return all(re.search(r"\d|^(MIT|Zlib|0BSD|AND|OR|WITH|LLVM-exception)\Z", part) for part in text.split())


def _models() -> list[dict[str, object]]:
    """The networks and the head model, by their hashes; none where set-up has not run."""
    path = models_folder() / LIST_FILE
    if not path.is_file():
        return []
    models = json.loads(path.read_text(encoding="utf-8"))["models"]
    return [{"type": "machine-learning-model" if model["file"].endswith(".tflite") else "data",
             "bom-ref": f"model:{model['file']}", "name": model["file"], "description": model["source"],
             "hashes": [{"alg": "SHA-256", "content": model["sha256"]}],
             "licenses": [{"license": {"name": model["licence"]}}]} for model in models]
