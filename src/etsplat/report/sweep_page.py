"""`sweep.html`: a sweep on one self-contained page: how settings matter, all combinations, and what they look like."""

import base64
import io
import json
import math
from collections.abc import Callable, Sequence
from html import escape
from importlib.metadata import version
from pathlib import Path
from typing import Any

from etsplat.io.atomic import atomic_write
from etsplat.io.images import load_rgb
from etsplat.io.overview import find_test_views, spread
from etsplat.report.curves import linear_ticks, log_ticks, short_number, tick_labels
from etsplat.report.scene import own_asset
from etsplat.report.sweep_rows import Found, Line, Measure, setting_text, summary
from etsplat.tasks.sweeps.sweep import short_names, shown
from etsplat.web.pages import asset, filled

PICTURES, PICTURE_WIDTH = 12, 320
"""So many combinations of an input are shown, the best first, in pictures of this width."""

_COLORS = ("#2f7fd0", "#d2693c", "#3f9e6b", "#a25bb5", "#b9962b", "#5a6f85")
WIDTH, HEIGHT = 360, 190
LEFT, RIGHT, TOP, BOTTOM = 50, 14, 10, 24


def write_sweep_page(found: Found, out: Path) -> Path:
    """Writes sweep.html, or search.html, into the folder of a sweep or search; returns its path.

    Raises:
        InputError: the folder cannot be written to.
    """
    done = len(found.rows)
    page = filled(
        own_asset("sweep.html"),
        version=version("etsplat"),
        title=escape(f"{found.kind.capitalize()} of {', '.join(found.inputs)}"),
        subtitle=f"{done} of {found.total} runs are done.",
        style="\n".join([asset("base.css"), own_asset("page.css"), own_asset("sweep.css")]),
        verdict=f'<p class="verdict good">{escape(said)}</p>' if (said := summary(found)) else "",
        failed="".join(
            f'<p class="verdict poor">{escape(text)}<br>{escape(str(log))}</p>' for text, log in found.failures
        ),
        about=escape(f"{found.goal.title}: a dot for each run, a line through the means over all runs of a value."),
        charts="".join(_chart(found, name) for name in found.varied) or '<p class="note">Nothing was varied.</p>',
        tables="".join(_table(found, name) for name in found.inputs),
        pictures="".join(_pictures(found, name) for name in found.inputs),
        kind=found.kind,
        command=escape(found.command),
    )
    path = out / f"{found.kind}.html"
    with atomic_write(path) as temporary:
        temporary.write_text(page, encoding="utf-8", errors="replace")
    return path


def _chart(found: Found, setting: str) -> str:
    """The goal by a setting: numbers on an axis, words beside each other."""
    goal = found.goal
    values = list(dict.fromkeys(line.chosen[setting] for line in found.lines))
    numbers = all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)
    values = sorted(values) if numbers else values
    across, marks = _axis(values) if numbers else _slots(values)
    series = {
        name: [
            (
                value,
                [
                    goal.factor * v
                    for line in found.lines
                    if (line.input, line.chosen[setting]) == (name, value)
                    for v in line.values(goal)
                ],
            )
            for value in values
        ]
        for name in found.inputs
    }
    all_values = [v for points in series.values() for _, group in points for v in group]
    if not all_values or len(values) < 2:
        return ""
    ticks = linear_ticks(min(all_values), max(all_values))
    bottom, top = min(ticks), max(ticks)

    def up(value: float) -> float:
        return TOP + (HEIGHT - TOP - BOTTOM) * (1 - (value - bottom) / ((top - bottom) or 1))

    parts = []
    for tick, text in zip(ticks, tick_labels(ticks), strict=True):
        y = up(tick)
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{escape(text)}</text>')
    for x, text in marks:
        parts.append(f'<text x="{x:.1f}" y="{HEIGHT - 6}" text-anchor="middle">{escape(text)}</text>')
    for index, points in enumerate(series.values()):
        color = _COLORS[index % len(_COLORS)]
        means = [(across(value), up(sum(group) / len(group))) for value, group in points if group]
        path = "M" + "L".join(f"{x:.1f},{y:.1f}" for x, y in means)
        parts.append(f'<path class="line" stroke="{color}" d="{path}"/>')
        dots = [(across(value), up(v)) for value, group in points for v in group]
        parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{color}" fill-opacity="0.55"/>' for x, y in dots]
    keys = "".join(
        f'<span><b style="color:{_COLORS[index % len(_COLORS)]}">●</b> {escape(name)}</span>'
        for index, name in enumerate(series)
    )
    label = escape(f"{goal.title} by {setting}")
    return (
        f'<div class="card chart"><h3>{escape(setting)}</h3><svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" '
        f'aria-label="{label}">{"".join(parts)}</svg><p class="key">{keys}</p></div>'
    )


def _axis(values: Sequence[float]) -> tuple[Callable[[Any], float], list[tuple[float, str]]]:
    """Places of numbers, from the left, logarithmic where they span a factor of ten; and what is written below."""
    logarithmic = values[0] > 0 and values[-1] >= 10 * values[0]
    warp = math.log10 if logarithmic else float
    low, high = warp(values[0]), warp(values[-1])

    def across(value: float) -> float:
        return LEFT + 10 + (WIDTH - LEFT - RIGHT - 20) * (warp(value) - low) / ((high - low) or 1)

    ticks = (
        list(values)
        if len(values) <= 6
        else log_ticks(values[0], values[-1])
        if logarithmic
        else linear_ticks(low, high)
    )
    return across, [(across(tick), short_number(tick)) for tick in ticks if values[0] <= tick <= values[-1]]


def _slots(values: Sequence[Any]) -> tuple[Callable[[Any], float], list[tuple[float, str]]]:
    """Places of words, and the words."""
    step = (WIDTH - LEFT - RIGHT) / len(values)

    def across(value: Any) -> float:
        return LEFT + step * (values.index(value) + 0.5)

    return across, [(across(value), str(value)[:14]) for value in values]


def _table(found: Found, name: str) -> str:
    lines = _ordered(found, name)
    best = {measure.key: found.best(name, measure) for measure in found.measures}
    heads = ["runs"] if any(len(line.rows) > 1 for line in lines) else []
    head = "".join(
        f"<th>{escape(title)}</th>"
        for title in [*short_names(found.varied).values(), *heads, *(measure.title for measure in found.measures)]
    )
    body = []
    for line in lines:
        cells = [
            f'<td data-value="{escape(_plain(line.chosen[key]))}">{escape(shown(line.chosen[key]))}</td>'
            for key in found.varied
        ]
        cells += [f"<td>{len(line.rows)}</td>"] * len(heads)
        cells += [_number(line, measure, lines, best[measure.key] is line) for measure in found.measures]
        body.append(f"<tr>{''.join(cells)}</tr>")
    title = f"<h3>{escape(name)}</h3>" if len(found.inputs) > 1 else ""
    return (
        f'{title}<div class="card wide"><table class="lines"><thead><tr>{head}</tr></thead>'
        f"<tbody>{''.join(body)}</tbody></table></div>"
    )


def _number(line: Line, measure: Measure, lines: Sequence[Line], best: bool) -> str:
    mean = line.mean(measure)
    all_means = [value for other in lines if (value := other.mean(measure)) is not None]
    part = ""
    if mean is not None and measure.better and len(all_means) > 1 and max(all_means) > min(all_means):
        place = (mean - min(all_means)) / (max(all_means) - min(all_means))
        part = f' style="--part:{100 * (place if measure.better > 0 else 1 - place):.0f}%"'
    value = "" if mean is None else f' data-value="{mean!r}"'
    return f'<td class="number{" best" * best}"{part}{value}>{escape(line.text(measure))}</td>'


def _pictures(found: Found, name: str) -> str:
    """A test view of the best combinations, beside the photo."""
    lines = _ordered(found, name)
    figures = []
    for line in lines[:PICTURES]:
        folder = line.rows[0].folder
        views = find_test_views(folder / "test", "mesh") or find_test_views(folder / "test", "opaque")
        if not views:
            continue
        view = spread(views, 2)[-1]
        if not figures:
            figures.append(_figure(view.truth, "the photo"))
        said = setting_text(found, line)
        figures.append(_figure(view.render, f"{said}: {found.goal.title} {line.text(found.goal)}"))
    if not figures:
        return ""
    shown = "" if len(lines) <= PICTURES else f" The best {PICTURES} of {len(lines)}."
    return (
        f'<section><h2>{escape(name)}</h2><p class="note">A test view of the first seed, the best first.{shown}</p>'
        f'<div class="pictures">{"".join(figures)}</div></section>'
    )


def _ordered(found: Found, name: str) -> list[Line]:
    """The lines of an input, the best first; those that were not measured come last."""
    goal = found.goal

    def place(line: Line) -> float:
        mean = line.mean(goal)
        return math.inf if mean is None else -(goal.better or 1) * mean

    return sorted((line for line in found.lines if line.input == name), key=place)


def _figure(path: Path, title: str) -> str:
    picture = load_rgb(path)
    picture.thumbnail((PICTURE_WIDTH, PICTURE_WIDTH))
    buffer = io.BytesIO()
    picture.save(buffer, "JPEG", quality=88)
    content = base64.b64encode(buffer.getvalue()).decode("ascii")
    return (
        f'<figure class="card"><img src="data:image/jpeg;base64,{content}" alt="{escape(title)}">'
        f"<figcaption>{escape(title)}</figcaption></figure>"
    )


def _plain(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, default=str)
