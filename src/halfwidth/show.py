"""Text, notebook and matplotlib views of records and estimates. Nothing here is needed to estimate."""

import html
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from halfwidth.array import Array
from halfwidth.errors import BadShape, BadValue, Missing

if TYPE_CHECKING:
    from halfwidth.record import Record
    from halfwidth.result import Estimate

_SHOWN = 8


def summary(estimate: "Estimate", level: float) -> str:
    """Return a few lines of text on an estimate."""
    lines = [f"{estimate.method}: {estimate.message}"]
    span = f"{estimate.t[0]:g} to {estimate.t[-1]:g} s" if len(estimate.t) else "no rows"
    kind = "guaranteed" if estimate.guaranteed else f"{100 * level:g} %"
    lines.append(
        f"{len(estimate.t)} rows, {span}"
        + ("" if estimate.loglik is None else f", log-likelihood {estimate.loglik:.6g}")
    )
    names = _names(estimate)
    wide = max(len(n) for n in names[:_SHOWN])
    has = estimate.spread is not None
    lines.append(f"{'':{wide}}  {'lowest':>10}  {'highest':>10}" + (f"  {'half-width, ' + kind:>20}" if has else ""))
    half = _half(estimate, level)
    for i, name in enumerate(names[:_SHOWN]):
        x = estimate.x[:, i]
        text = f"{name:{wide}}  {np.min(x):>10.4g}  {np.max(x):>10.4g}"
        lines.append(text + (f"  {np.median(half[:, i]):>20.3g}" if half is not None else ""))
    if len(names) > _SHOWN:
        lines.append(f"... and {len(names) - _SHOWN} more states")
    for symbol in ("q", "r", "Q", "R", "theta"):
        value = getattr(estimate, symbol)
        if value is not None and np.size(value):
            lines.append(f"{symbol} = {np.array2string(np.asarray(value), precision=4)}")
    return "\n".join(lines)


def estimate_html(estimate: "Estimate") -> str:
    """Return a small table with a sparkline for each state, for notebooks."""
    rows = []
    half = _half(estimate, 0.9)
    for i, name in enumerate(_names(estimate)[:_SHOWN]):
        x = estimate.x[:, i]
        cells = [html.escape(name), f"{np.min(x):.4g}", f"{np.max(x):.4g}"]
        cells.append("-" if half is None else f"{np.median(half[:, i]):.3g}")
        rows.append("<tr>" + "".join(f"<td>{c}</td>" for c in cells) + f"<td>{_spark(x)}</td></tr>")
    head = "".join(f"<th>{c}</th>" for c in ("state", "lowest", "highest", "half-width 90 %", ""))
    return (
        f"<div><b>{html.escape(estimate.method)}</b>: {html.escape(estimate.message)}"
        f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
    )


def record_html(record: "Record") -> str:
    """Return a small table of the outputs of a record, for notebooks."""
    names = record.labels.outputs or tuple(f"y{j}" for j in range(record.ny))
    rows = []
    for j, name in enumerate(names[:_SHOWN]):
        y = record.y[:, j]
        lost = 100 * np.mean(np.isnan(y))
        rows.append(f"<tr><td>{html.escape(str(name))}</td><td>{lost:.3g} %</td><td>{_spark(y)}</td></tr>")
    return (
        f"<div><b>Record</b>: {html.escape(repr(record))}<table><thead><tr><th>output</th><th>missing</th>"
        f"<th></th></tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
    )


def pyplot() -> Any:
    """Return matplotlib's pyplot.

    Raises
    ------
    Missing
        If matplotlib is not installed.
    """
    try:
        import matplotlib.pyplot as plt
    except ImportError:
        raise Missing("`plot` needs matplotlib, which is not installed", hint="pip install 'halfwidth[plot]'") from None
    return plt


def plot(estimate: "Estimate", truth: Any, *, states: Any, level: float, ax: Any) -> Any:
    """Draw states with bands against time; return the axes, one or an array of them."""
    names = _names(estimate)
    chosen = _chosen(names, states)
    if ax is None:
        size = (8, 1 + 1.8 * len(chosen))
        _, made = pyplot().subplots(len(chosen), 1, sharex=True, figsize=size, layout="constrained")
        axes = np.atleast_1d(made)
    else:
        axes = np.atleast_1d(np.asarray(ax, dtype=object))
    if len(axes) != len(chosen):
        raise BadShape(f"`ax` has {len(axes)} axes, {len(chosen)} were expected, one a state")
    true = None if truth is None else np.asarray(truth)
    if true is not None and true.shape != estimate.x.shape:
        raise BadShape(f"`truth` has shape {true.shape}, {estimate.x.shape} was expected")
    band = None if estimate.spread is None else estimate.interval(level)
    label = "guaranteed" if estimate.guaranteed else f"{100 * level:g} %"
    for one, i in zip(axes, chosen, strict=True):
        if band is not None:
            one.fill_between(estimate.t, band[0][:, i], band[1][:, i], color="#9ecae1", lw=0, label=label)
        one.plot(estimate.t, estimate.x[:, i], color="#08519c", lw=1.5, label=estimate.method)
        if true is not None:
            one.plot(estimate.t, true[:, i], color="#222222", lw=1, ls="--", label="truth")
        one.set_ylabel(names[i])
    axes[0].legend(loc="best", fontsize="small")
    axes[-1].set_xlabel("t [s]")
    return axes[0] if len(axes) == 1 else axes


def _chosen(names: tuple[str, ...], states: Any) -> list[int]:
    if states is None:
        return list(range(min(4, len(names))))
    found = []
    for s in [states] if isinstance(states, str | int) else states:
        if isinstance(s, str) and s in names:
            found.append(names.index(s))
        elif isinstance(s, int) and 0 <= s < len(names):
            found.append(s)
        else:
            raise BadValue(f"`states` names {s!r}, but the states are {names}")
    return found


def _names(estimate: "Estimate") -> tuple[str, ...]:
    return estimate.names or tuple(f"x{i}" for i in range(estimate.x.shape[1]))


def _half(estimate: "Estimate", level: float) -> Array | None:
    if estimate.spread is None:
        return None
    lo, hi = estimate.interval(level)
    return np.asarray(0.5 * (hi - lo))


def _spark(values: Array, width: int = 160, height: int = 24) -> str:
    """Return a line of `values` as inline SVG; missing entries break it."""
    if len(values) > width:
        edges = np.linspace(0, len(values) - 1, width).astype(int)
        values = values[edges]
    there = np.isfinite(values)
    if not there.any():
        return ""
    lo, hi = np.min(values[there]), np.max(values[there])
    x = np.linspace(1, width - 1, len(values))
    y = height - 2 - (height - 4) * (values - lo) / (hi - lo if hi > lo else 1.0)
    parts: list[str] = []
    runs: Sequence[Any] = np.split(np.arange(len(values)), np.flatnonzero(np.diff(there.astype(int))) + 1)
    for run in runs:
        if there[run[0]]:
            points = " ".join(f"{x[k]:.1f},{y[k]:.1f}" for k in run)
            parts.append(f'<polyline points="{points}" fill="none" stroke="#08519c"/>')
    return f'<svg width="{width}" height="{height}">{"".join(parts)}</svg>'
