"""The settings reference: every setting of every config, with what it may be and what presets make of it."""

from collections.abc import Iterable
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from etsplat.tasks.export_config import ExportConfig
from etsplat.tasks.reconstruct_config import ReconstructConfig
from etsplat.tasks.render_config import RenderConfig
from etsplat.tasks.settings import Setting, Settings, docs_of, get, settings_of
from etsplat.tasks.train_config import TrainConfig

TASKS: dict[str, tuple[type[Settings], str]] = {
    "reconstruct": (ReconstructConfig, "photos of an object, or a mesh to photograph, to a closed mesh"),
    "train": (TrainConfig, "photos of a scene to a triangle soup and an opaque mesh"),
    "render": (RenderConfig, "pictures and videos of a result"),
    "export": (ExportConfig, "files for other programs"),
}
"""By command: its config, and what it does."""

_KINDS = {bool: "true or false", int: "whole number", float: "number", str: "word", Path: "path"}


def settings_pages() -> dict[str, str]:
    """A page for each command, and one that lists them."""
    pages = {f"settings/{task}.md": settings_page(task) for task in TASKS}
    lines = [f"- [etsplat {task}]({task}.md): {what}." for task, (_, what) in TASKS.items()]
    toc = ["```{toctree}", ":hidden:", "", *TASKS, "```"]
    return pages | {"settings/index.md": "\n".join([f"# Settings\n\n{_ABOUT}\n", *lines, "", *toc, ""])}


_ABOUT = """Each is a field of a config, an option of the command line (`--optimizer.lr-vertices 1e-3`), and an entry of
`config.json` and of `--config FILE`. From Python:
`etsplat.ReconstructConfig.of("quick").changed({"optimizer.lr_vertices": 1e-3})`. A value out of its range, or of a
setting that would have no effect, is refused."""


def settings_page(task: str) -> str:
    """Every setting of a command, by its groups in their order."""
    config, what = TASKS[task]
    lines = [f"# Settings of etsplat {task}", "", f"`{config.__name__}`: {what}.", ""]
    presets = _presets(config)
    if presets:
        lines += [f"The default preset is `{next(iter(presets))}`; where others differ, the table says so.", ""]
    known = settings_of(config)
    lines += _table(config, "", [name for name in known if "." not in name], presets)
    for field in fields(config):
        group = getattr(config(), field.name)
        if is_dataclass(group):
            lines += [f"## {field.name}", "", (type(group).__doc__ or "").strip(), ""]
            names = [name for name in known if name.startswith(f"{field.name}.")]
            lines += _table(config, field.name, names, presets)
    return "\n".join(lines)


def _presets(config: type[Settings]) -> dict[str, Settings]:
    """The presets, the default one first; with what else a config starts from (`scene_type`) as it is by default."""
    if not config.LABELS:
        return {}
    label = config.LABELS[0]
    default = getattr(config(), label)
    names = [default, *(name for name in settings_of(config)[label].choices if name != default)]
    return {name: config.of(name) for name in names}


def _table(config: type[Settings], group: str, names: Iterable[str], presets: dict[str, Settings]) -> list[str]:
    owner = type(get(config(), group)) if group else config
    docs = docs_of(owner)
    rows = ["| setting | what it may be | default | what it does |", "|---|---|---|---|"]
    for name in names:
        setting = settings_of(config)[name]
        cells = (
            f"`{name}`",
            values_of(setting),
            _default(name, setting, presets),
            " ".join(docs[name.rpartition(".")[2]].split()),
        )
        only = f" Only {setting.only.text}." if setting.only else ""
        rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + f"{only} |")
    return [*rows, ""]


def values_of(setting: Setting) -> str:
    """What a setting may be, in words."""
    if setting.choices:
        text = ", ".join(f"`{choice}`" for choice in setting.choices)
        text += f", or a file in `{setting.suffix}`" if setting.suffix else ""
    else:
        text = _KINDS[setting.kind] + (f", {setting.range.text}" if setting.range else "")
    return text + (", or `none`" if setting.optional else "")


def _default(name: str, setting: Setting, presets: dict[str, Settings]) -> str:
    """The default preset's value, then where others have another one."""
    if not presets:
        return _shown(setting.default)
    values = {preset: _shown(get(config, name)) for preset, config in presets.items()}
    first, *others = values.items()
    if name == "preset":
        return first[1]
    by_value: dict[str, list[str]] = {}
    for preset, value in others:
        if value != first[1]:
            by_value.setdefault(value, []).append(preset)
    return "; ".join([first[1], *(f"{', '.join(presets)}: {value}" for value, presets in by_value.items())])


def _shown(value: Any) -> str:
    if value is None:
        return "`none`"
    if isinstance(value, bool):
        return f"`{value}`".lower()
    return f"`{value:g}`" if isinstance(value, float) else f"`{value}`"
