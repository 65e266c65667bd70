"""Keeps the tables of the README and of docs/ in step with the stages' declarations and with measured figures.

    python -m tools.documents.readme     rewrites them between their marks
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import median

from shared.contract.declare import Field, Output, Stage, parameter_table
from shared.contract.models import FACE_NETWORKS, IRIS_NETWORK
from shared.contract.pipeline import Pipeline, load_pipeline
from shared.contract.records import MANIFEST, PROVENANCE
from shared.io.arrays import read_json
from shared.report.references import REFERENCES
from tools.bench.chart.cases import ABLATION
from tools.bench.chart.rows import summarise

README = Path(__file__).resolve().parents[2] / "README.md"
DOCS = README.parent / "docs"
CHART = DOCS / "chart.json"
SCORES = {
    "albedo, dE2000": ("albedo.aligned.delta_e2000_median", ".2f"),
    "albedo, PSNR": ("albedo.aligned.psnr_linear", ".1f"),
    "normals, deg": ("normal_deg.median", ".1f"),
    "light, 25 deg lobe": ("envmap.lobe25_rel_rmse", ".1%"),
    "relit, dB": ("relight.mean.psnr_gain", ".1f"),
}


def documents() -> dict[Path, str]:
    """{document: its text with all tables as they should be now}. ValueError when a mark is missing."""
    pipeline = load_pipeline(None)
    stages = list(pipeline.stages.values())
    tables = {
        README: {"costs: make chart OUT=docs": cost_table(read_json(CHART)["rows"])},
        DOCS / "parameters.md": {"presets": preset_table(pipeline), "parameters": parameter_sections(stages)},
        DOCS / "bibliography.md": {"entries": bibliography()},
        DOCS / "files.md": {"files": file_sections(stages), "records": record_sections()},
    }
    return {path: _with_tables(path.read_text(encoding="utf-8"), own) for path, own in tables.items()}


def _with_tables(text: str, tables: Mapping[str, str]) -> str:
    for name, content in tables.items():
        start, end = f"<!-- {name} -->\n", f"<!-- end of {name.partition(':')[0]} -->\n"
        before, rest = text.split(start)
        _, after = rest.split(end)
        text = before + start + content + end + after
    return text


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|", *(f"| {' | '.join(row)} |" for row in rows)]
    return "\n".join(lines) + "\n"


# ---------------------------------------------------------------------- parameters


def preset_table(pipeline: Pipeline) -> str:
    """What each preset sets, beside the default."""
    presets = {name: values for name, values in pipeline.presets.items() if values}
    names = dict.fromkeys((stage, key) for values in presets.values() for stage, own in values.items() for key in own)
    rows = []
    for stage, key in names:
        values = [own.get(stage, {}).get(key) for own in presets.values()]
        cells = ["" if value is None else f"`{_shown(value)}`" for value in values]
        rows.append([f"`{stage}.{key}`", f"`{_shown(pipeline.stages[stage].defaults()[key])}`", *cells])
    return _table(["parameter", "default", *(f"`{name}`" for name in presets)], rows)


def _shown(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def parameter_sections(stages: Sequence[Stage]) -> str:
    """Every stage's parameters, as `limn parameters` lists them; groups that count in one case only at the end."""
    sections = [f"## {stage.name}\n\n{stage.help}\n\n{parameter_table({stage.name: stage.common})}" for stage in stages]
    sections += [f"## {stage.name}: {group.name}\n\nParameters {group.case}.\n\n"
                 f"{parameter_table({stage.name: group.parameters})}" for stage in stages for group in stage.groups]
    return "\n".join(sections)


# ---------------------------------------------------------------------- files


def file_sections(stages: Sequence[Stage]) -> str:
    """What every stage reads and writes: each file, and each field of those that hold fields."""
    return "\n".join("\n".join(_file_section(stage)) for stage in stages)


def _file_section(stage: Stage) -> Iterator[str]:
    yield f"## `{stage.folder}/`\n"
    yield f"{stage.help}\n"
    yield f"Reads {_sources(stage)}.\n"
    rows = [[f"`{output.path}`", _help_of(output), output.unit, output.space, output.colour_space]
            for output in stage.outputs]
    yield _table(["file", "content", "unit", "space", "colour space"], rows)
    for fields, names in _alike(stage.outputs).items():
        yield f"Fields of {' and '.join(f'`{name}`' for name in names)}:\n"
        yield field_table(fields)


def _alike(outputs: Sequence[Output]) -> dict[tuple[Field, ...], list[str]]:
    """{fields: the files that hold them}."""
    found: dict[tuple[Field, ...], list[str]] = {}
    for output in outputs:
        if output.fields:
            found.setdefault(output.fields, []).append(output.path)
    return found


def _help_of(output: Output) -> str:
    marks = [text for text, holds in (("optional", output.optional), ("volatile", output.volatile)) if holds]
    return output.help + f" ({'; '.join(marks)})" * bool(marks)


def _sources(stage: Stage) -> str:
    read = ["the subject's video"] * stage.reads_source
    read += [f"`{name}`" + " (of every clip)" * (name in stage.joins) for name in stage.inputs]
    read += [f"the subject's own {name}, where `subject.yaml` names them" for name in stage.given]
    networks = {"the face networks": FACE_NETWORKS, "the iris network": (IRIS_NETWORK,)}
    read += [name for name, files in networks.items() if set(files) <= set(stage.models)]
    listed = {file for files in networks.values() for file in files}
    read += [f"the model `{name}`" for name in stage.models if name not in listed]
    return ", ".join(read)


def field_table(fields: Sequence[Field]) -> str:
    """Each field with its kind, shape and unit."""
    rows = []
    for field in fields:
        kind = f"{field.kind} [{field.shape}]" if field.shape else field.kind
        marked = ", ".join(part for part in (kind, "optional" * field.optional) if part)
        rows.append([f"`{field.path}`", marked, field.unit, field.help])
    return _table(["field", "type", "unit", "content"], rows)


def record_sections() -> str:
    """The records that lie beside every stage's files."""
    return f"`manifest.json`:\n\n{field_table(MANIFEST)}\n`provenance.json`:\n\n{field_table(PROVENANCE)}"


# ---------------------------------------------------------------------- bibliography


def bibliography() -> str:
    """Every publication with the key by which the code cites it."""
    return _table(["key", "publication"], [[f"[{key}]", text] for key, text in sorted(REFERENCES.items())])


# ---------------------------------------------------------------------- costs


def cost_table(rows: Sequence[Mapping]) -> str:
    """What each preset and each other solver costs and reaches, by rising cost; see tools.bench.chart.rows."""
    points = sorted(summarise(rows), key=lambda point: point["cpu_seconds"])
    lines = []
    for point in (point for point in points if point["group"] != ABLATION):
        whole = f"{point['seconds_with_export']:.0f}" if "seconds_with_export" in point else ""
        costs = [f"{point['seconds']:.0f}", f"{point['cpu_seconds']:.0f}", whole, f"{point['peak_mb']:.0f} MB"]
        scores = [format(point["scores"][name], style) for name, style in SCORES.values()]
        lines.append([point["name"], *costs, *scores])
    head = ["", "seconds", "processor seconds", "with export", "peak memory", *SCORES]
    return f"{_table(head, lines)}\n{_circumstances(rows, points)}\n"


def _circumstances(rows: Sequence[Mapping], points: Sequence[Mapping]) -> str:
    cores = " or ".join(str(count) for count in sorted({row["threads"] for row in rows}))
    repeats = max(point["repeats"] for point in points)
    busy = median(point["others"] for point in points)
    return (
        f"Medians of {repeats}, from the clip to the maps, on {cores} core{'s' * (cores != '1')}; other work kept "
        f"{busy:.1f} cores of the machine busy meanwhile."
    )


def main() -> int:
    """Rewrites README.md and docs/."""
    for path, text in documents().items():
        path.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
