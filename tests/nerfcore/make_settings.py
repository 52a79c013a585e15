"""Writes docs/settings.md from the settings' own descriptions: `python tests/nerfcore/make_settings.py`."""

from __future__ import annotations

import json
from pathlib import Path

from fieldwork.nerfcore.bench.suites import ABLATION
from fieldwork.nerfcore.config import PRESETS, RunConfig
from pydantic.fields import FieldInfo

TARGET = Path(__file__).resolve().parents[2] / "docs" / "settings.md"


BOUNDARIES = ("explicit", "implicit", "no semantics", "uniform pdf")


def limits(setting: FieldInfo) -> str:
    """The values that a number may have, as an interval: "[" includes the limit, "(" does not."""
    found = {name: getattr(m, name) for m in setting.metadata for name in ("ge", "gt", "le", "lt") if hasattr(m, name)}
    if not found:
        return ""
    low = f"[{found['ge']:g}" if "ge" in found else f"({found['gt']:g}"
    return f"{low}, {found['le']:g}]" if "le" in found else f"{low}, {found['lt']:g})"


def settings_page() -> str:
    lines = [
        "# Settings of a run",
        "",
        "`fieldwork train PROJECT --preset NAME --set stage.name=value …`. Presets change only what is listed for them.",
        "This page is made from `nerfcore/config.py` by `python tests/nerfcore/make_settings.py`.",
    ]
    for stage, info in RunConfig.model_fields.items():
        model = type(info.default)
        lines += [
            "",
            f"## {stage}",
            "",
            (model.__doc__ or "").strip().split("\n")[0],
            "",
            "| setting | default | what |",
            "| --- | --- | --- |",
        ]
        for name, setting in model.model_fields.items():
            kind = str(setting.annotation).replace("typing.Literal", "") if "Literal" in str(setting.annotation) else ""
            text = " ".join(part for part in (setting.description or "", kind, limits(setting)) if part)
            text = text.replace("|", "\\|").strip()
            lines.append(f"| `{stage}.{name}` | `{json.dumps(setting.default)}` | {text} |")
    lines += [
        "",
        "## Boundary cases",
        "",
        "Of the same pipeline, and variants of `fieldwork bench --suite ablation`:",
        "",
    ]
    for case in BOUNDARIES:
        lines.append(f"- **{case}**: {', '.join(f'`{name}={value}`' for name, value in ABLATION[case].items())}")
    lines += ["", "## Presets", ""]
    for path in sorted(PRESETS.glob("*.json")):
        values = json.loads(path.read_text(encoding="utf-8"))
        changes = [f"`{stage}.{k}={json.dumps(v)}`" for stage, part in values.items() for k, v in part.items()]
        lines.append(f"- **{path.stem}**: {', '.join(changes) or 'the defaults'}")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    TARGET.write_text(settings_page(), encoding="utf-8")
