"""docs/failures.md, with its pictures."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from experiments.kit.markdown import percent, table
from experiments.studies.failures import figures
from experiments.studies.failures.answers import Arm, Contrast, arms, contrasts, fails, quarters
from experiments.studies.failures.arms import MENDED, MENDED_FLAGS, WORDS
from experiments.studies.failures.measures import COMPARED, Kept
from experiments.studies.failures.runs import ENV_STEPS, MAX_UPDATES
from mjx_reinforce.policies.normalize import CLIP
from mjx_reinforce.reports.statistics import Estimate

#: The text around the numbers.
_TEMPLATE = Path(__file__).with_suffix(".md")
#: Updates of the table of differences.
_TABLE_LOOKS = (2, 4, 8)


def write(kept: Kept, docs: Path) -> None:
    """Writes failures.md and failures-*.png.

    Args:
      kept: what was measured.
      docs: the folder.
    """
    found = arms(kept)
    figures.draw_all(kept, quarters(kept), found, WORDS, docs)
    (docs / "failures.md").write_text(page(kept, found), encoding="utf-8")


def page(kept: Kept, found: list[Arm]) -> str:
    """Returns the page's text."""
    base, falls = found[0], kept.falls["base"]
    texts = {
        "env_steps": f"{ENV_STEPS:,}",
        "max_updates": f"{MAX_UPDATES}",
        "differences_table": _differences(contrasts(kept, _TABLE_LOOKS)),
        "arms_table": _arms(found),
        "low_scale": f"{100 * quarters(kept)[0].low:.0f} to {100 * quarters(kept)[0].high:.0f} cm",
        "high_scale": f"{100 * quarters(kept)[-1].low:.0f} cm",
        "clipped_beyond": f"{CLIP * quarters(kept)[0].high:.1f} m",
        "early_kl": f"{np.nanmedian(kept.base['kl_2']):.2f}",
        "mended_env_steps": f"{MENDED.env_steps:,}",
        "mended_flags": MENDED_FLAGS,
        "never": f"{base.never}",
        "fell": f"{base.failures - base.never}",
        "scale_failing": _centimetres(kept, failing=True),
        "scale_others": _centimetres(kept, failing=False),
        "quiet_kl": percent(falls["kl_without_gradient"] / falls["kl_after"], 0),
        "quiet_updates": percent(falls["quiet_updates"] / falls["updates_after"], 0),
        "quiet_began": percent(falls["began_without_gradient"] / falls["began"], 0),
        "began": f"{falls['began']}",
    }
    for arm in found:
        moved = kept.falls[arm.name]
        texts |= {
            f"{arm.name}_never": f"{arm.never}",
            f"{arm.name}_stand": f"{arm.stand}",
            f"{arm.name}_kl": f"{moved['kl_after'] / moved['updates_after']:.2g}",
            f"{arm.name}_rail": percent(moved["falls_next_at_rail_end"] / moved["falls_next"], 0),
            f"{arm.name}_saturated": percent(moved["saturated"], 0),
            f"{arm.name}_quiet": f"{moved['began_without_gradient']}",
            f"{arm.name}_began": f"{moved['began']}",
            f"{arm.name}_p_failing": _p_value(arm.p_failing),
            f"{arm.name}_p_fallen": _p_value(arm.p_fallen),
            f"{arm.name}_count": f"{arm.num_seeds}",
            f"{arm.name}_failures": f"{arm.failures}",
            f"{arm.name}_failing": _share(arm.failing),
            f"{arm.name}_fallen": percent(arm.fallen.value, 0),
            f"{arm.name}_median": _thousands(arm.median),
        }
    texts = {name.replace("-", "_"): text for name, text in texts.items()}
    return _TEMPLATE.read_text("utf-8").format(**texts)


def _centimetres(kept: Kept, *, failing: bool) -> str:
    """Returns the median scale of the cart's position after the fifth update."""
    chosen = fails(kept.seeds["base"]) == failing
    return f"{100 * np.nanmedian(kept.base['scale_position_6'][chosen]):.1f}"


def _share(x: Estimate) -> str:
    return f"{percent(x.value, 1)} ({percent(x.low, 1)} to {percent(x.high, 1)})"


def _thousands(steps: float) -> str:
    return f"{steps / 1000:.0f}k" if np.isfinite(steps) else "never"


def _p_value(p: float) -> str:
    return "" if np.isnan(p) else "below 0.001" if p < 0.001 else f"{p:.2g}"


def _arms(found: Iterable[Arm]) -> str:
    """Returns the table of the arms."""
    header = ("change", "seeds", "failing (95 %)", "p", "fell again", "p", "median", "99 %")
    rows = [
        (
            WORDS[arm.name],
            f"{arm.num_seeds}",
            _share(arm.failing),
            _p_value(arm.p_failing),
            percent(arm.fallen.value, 1),
            _p_value(arm.p_fallen),
            _thousands(arm.median),
            _thousands(arm.slowest),
        )
        for arm in found
    ]
    return table(header, rows)


def _differences(found: Iterable[Contrast]) -> str:
    """Returns the table of what differs between failing and other seeds."""
    cells = {(c.measure, c.update): c for c in found}
    rows = []
    for measure, words in COMPARED.items():
        row = [words]
        for look in _TABLE_LOOKS:
            c = cells[measure, look]
            sure = "**" if c.chance.low > 0.5 or c.chance.high < 0.5 else ""
            chance = f"{sure}{percent(c.chance.value, 0)}{sure}"
            row.append(f"{c.failing:.3g} / {c.others:.3g}: {chance}")
        rows.append(row)
    return table(("failing / other seeds", *(f"update {look}" for look in _TABLE_LOOKS)), rows)
