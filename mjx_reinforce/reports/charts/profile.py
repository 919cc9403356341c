"""Performance profiles: the share of seeds whose final return is above each return."""

from collections.abc import Iterator

import numpy as np

from mjx_reinforce.reports import charts
from mjx_reinforce.reports.charts import short, stacked
from mjx_reinforce.reports.findings import Findings
from mjx_reinforce.statistics.aggregates import performance_profile

#: Points of a profile, at most.
_MOST_POINTS = 80


def draw(findings: Findings) -> Iterator[charts.Chart]:
    """Yields the chart; none where no seed ended with a finite return."""
    finals = np.concatenate([each.final for each in findings.results])
    finals = finals[np.isfinite(finals)]
    if not finals.size:
        return
    returns = np.linspace(finals.min(), finals.max(), _MOST_POINTS)
    shares = [performance_profile(each.final, returns) for each in findings.results]
    x = charts.quantity("threshold", title="final return", scale={"nice": False})
    said = {"threshold": ("return", ",.1f"), "share": ("seeds above", ".1%")}
    lines = charts.share_layers(findings, "profile", x, "seeds above it", said)
    yield charts.make_chart(
        findings,
        [lines, *charts.threshold_line(findings, "x", finals)],
        320,
        name="profile",
        title="Performance profiles",
        caption=(
            "The share of seeds that end above each return, with Wilson's 95 % interval. A "
            "curve above another everywhere is better whatever return one asks for."
        ),
        alt="Share of seeds over the final return, a falling line for each configuration.",
        data={
            "profile": stacked(
                {
                    "configuration": place,
                    "threshold": short(returns),
                    "share": short(share.value, 4),
                    "low": short(share.low, 4),
                    "high": short(share.high, 4),
                }
                for place, share in enumerate(shares)
            )
        },
        listed="profile",
    )
