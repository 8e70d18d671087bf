"""Picture of the training so far: losses over updates, stage after stage."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from larp_model.files import write_whole
from larp_model.training import history

DRAWN = ("loss", "position", "norm")
COLOURS = ("#000000", "#0072B2", "#9aa3ad")


def curve_picture(stages: Sequence[Path], path: Path) -> None:
    """Write a PNG of the stages' losses, each from its folder; one that has not begun is left out."""
    logged = {folder.name: rows for folder in stages if (rows := history(folder))}
    if not logged:
        return
    figure = Figure(figsize=(12, 5), layout="constrained")
    axes, begin = figure.subplots(), 0.0
    for stage, rows in logged.items():
        updates = begin + np.array([row["update"] for row in rows])
        for name, colour in zip(DRAWN, COLOURS, strict=True):
            if name in rows[0]:
                axes.plot(updates, [row[name] for row in rows], color=colour, lw=1.5, label=None if begin else name)
        axes.axvline(begin, color="#d5dae0", lw=1.0, zorder=0)
        axes.text(begin, 0.98, f" {stage}", va="top", transform=axes.get_xaxis_transform(), color="#5b6470")
        begin = float(updates[-1])
    axes.set(yscale="log", xlim=(0.0, begin), xlabel="updates", title="Training")
    axes.grid(True, color="#e9ecef", lw=0.8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, ncols=len(DRAWN), loc="lower left", bbox_to_anchor=(0.0, 1.0))
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=100)
    write_whole(path, buffer.getvalue())
