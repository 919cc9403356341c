"""The report's histograms: where all seeds are, at the moments that its slider stops at.

The last of them is the end: each seed's last evaluation, which tables are of. The grid ends where
the first seed did, when some may not have solved the task that do.
"""

import numpy as np

from mjx_reinforce.reports.experiment import Result
from mjx_reinforce.reports.findings import Findings
from mjx_reinforce.reports.page.columns import Table, short

#: Bars of a histogram, and moments, at most.
_BARS = 36
_MOMENTS = 30


def slider_stops(findings: Findings) -> list[int]:
    """Returns the points of the grid that the slider stops at."""
    last = len(findings.grid) - 1
    return np.unique(np.linspace(0, last, min(_MOMENTS, last + 1)).round().astype(int)).tolist()


def edges(findings: Findings) -> np.ndarray:
    """Returns the edges of the histograms' bars; what is beyond counts in the outer ones."""
    values = np.concatenate([each.seeds.ravel() for each in findings.results])
    values = values[np.isfinite(values)]
    low, high = np.quantile(values, [0.001, 0.999]) if values.size else (0.0, 1.0)
    if low == high:
        low, high = low - 0.5, high + 0.5
    return np.linspace(low, high, _BARS + 1)


def distributions(findings: Findings) -> dict[str, Table]:
    """Returns the histograms of all configurations at all moments, and what is said of each."""
    borders, stops = edges(findings), slider_stops(findings)
    bars: Table = {n: [] for n in ("configuration", "moment", "low", "high", "share", "height")}
    said: Table = {n: [] for n in ("configuration", "moment", "said")}
    starts, ends = short(borders[:-1]), short(borders[1:])
    for place, result in enumerate(findings.results):
        end = result.configuration.env_steps[-1].min()
        for moment, k in enumerate(stops):
            ended = bool(findings.grid[k] > end)
            values = result.final if ended or k == stops[-1] else result.seeds[k]
            finite = np.clip(values[np.isfinite(values)], borders[0], borders[-1])
            counts, _ = np.histogram(finite, borders)
            share, tallest = counts / len(values), max(counts.max(), 1)
            filled = np.flatnonzero(counts)
            bars["configuration"] += [place] * len(filled)
            bars["moment"] += [moment] * len(filled)
            bars["low"] += [starts[b] for b in filled]
            bars["high"] += [ends[b] for b in filled]
            bars["share"] += short(share[filled], 3)
            bars["height"] += short(counts[filled] / tallest, 3)
            said["configuration"].append(place)
            said["moment"].append(moment)
            said["said"].append(_said(findings, result, values, ended))
    return {"histogram": bars, "moments": said}


def _said(findings: Findings, result: Result, values: np.ndarray, ended: bool) -> str:
    """Returns a configuration's label and what its seeds return, which may be its last returns."""
    label, finite = result.configuration.label, values[np.isfinite(values)]
    failed = len(values) - len(finite)
    if not len(finite):
        return f"{label}\nno seed is finite"
    text = f"{label}\n{'its end: ' if ended else ''}median {np.median(finite):,.4g}"
    text += f", worst {finite.min():,.4g}"
    if findings.experiment.threshold is not None:
        solved = int(np.sum(finite >= findings.experiment.threshold))
        text += f", {solved:,} of {len(values):,} solved"
    return text + (f", {failed:,} not finite" if failed else "")
