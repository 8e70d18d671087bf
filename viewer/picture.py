"""Picture of a kick: its motion in a few frames, the paths of the ball from above and from the side, the costs."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
from matplotlib.ticker import MaxNLocator
from scipy.spatial.transform import Rotation

from larp_model.files import write_whole
from larp_model.scene import Scene
from larp_model.state import ORIENTATION, POSITION, VELOCITY
from viewer.recording import Recording, nearest_approach
from viewer.scene_view import GROUND_TRUTH, PREDICTION, TARGET, Colour, link_colour

WIDTH, HEIGHT, DOTS = 18.0, 10.0, 100  # inches, inches, dots per inch
TILE = 2.1  # m, width of a frame in the strip
# Seconds from contact to each frame but the first.
FRAMES = {"backswing": -0.14, "contact": 0.0, "launch": 0.04, "follow-through": 0.25, "recovery": 0.7}
STRUCK = 0.5  # m/s, speed from which the traced link counts as struck
FACTS = 4  # entries of the summary per line below the title
DECADES = 6  # that the axis of costs reaches below the greatest
# After Okabe and Ito, safe for all eyes.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
QUIET = "#5b6470"


def kick_picture(recording: Recording, costs: Mapping[str, Sequence[float]] | None, path: str | Path) -> None:
    """Write a PNG of 1800 x 1000 pixels. costs: by name of a cost term, its part of the plan's cost at each replan."""
    terms = {
        name: values
        for name, raw_values in (costs or {}).items()
        if not np.isnan(values := _positive(raw_values)).all()
    }
    figure = Figure((WIDTH, HEIGHT), DOTS, facecolor="white")
    canvas: Any = FigureCanvasAgg(figure)
    miss = nearest_approach(recording.path, recording.target).distance
    facts = {"nearest to the target": f"{100.0 * miss:.1f} cm", **recording.summary}
    figure.text(0.02, 0.955, recording.title or "Kick", fontsize=20, fontweight="bold")
    entries = [f"{name}  {text}" for name, text in facts.items()]
    for line, begin in enumerate(range(0, len(entries), FACTS)):
        figure.text(0.02, 0.925 - 0.025 * line, "     ".join(entries[begin : begin + FACTS]), fontsize=12, color=QUIET)
    _draw_strip(figure.add_axes((0.02, 0.56, 0.96, 0.35)), recording)
    width = 0.56 if terms else 0.92
    _draw_paths(figure.add_axes((0.05, 0.31, width, 0.2)), figure.add_axes((0.05, 0.06, width, 0.2)), recording)
    if terms:
        _draw_costs(figure.add_axes((0.68, 0.06, 0.3, 0.45 - 0.025 * ((len(terms) + 1) // 2))), terms)
    buffer = io.BytesIO()
    canvas.print_png(buffer)
    write_whole(path, buffer.getvalue())


def _draw_strip(axes: Axes, recording: Recording) -> None:
    """Draw the scene from its right-hand side at a few times, each frame centred on the root of its first body."""
    rows = _drawn_rows(recording)
    for tile, (row, name) in enumerate(rows.items()):
        state = recording.states[row]
        shift = np.array([TILE * tile - state[0, 0], 0.0])
        predicted, reference = recording.predicted_at(row), recording.reference_at(row)
        outline = predicted if recording.reference is None else reference
        if outline is not None:
            _draw_outline(axes, recording.scene, outline, shift, "#8a93a0")
        _draw_bodies(axes, recording.scene, state, shift, tile)
        if predicted is not None:
            centre = predicted[recording.traced, POSITION][[0, 2]] + shift
            if abs(centre[0] - TILE * tile) < 0.5 * TILE:
                style = {"fill": False, "ec": _hex(PREDICTION), "lw": 1.5, "ls": "--", "zorder": 4}
                _draw_disc(axes, centre, recording.radius, **style)
        label = f"{name}  {row * recording.scene.dt:.2f} s".strip()
        axes.text(TILE * tile, -0.12, label, ha="center", va="top", fontsize=12)
    axes.axhline(0.0, color=QUIET, lw=1.0, zorder=0)
    centre_x = 0.5 * TILE * (len(rows) - 1)
    width = max(6, len(rows)) * TILE
    axes.set_xlim(centre_x - 0.5 * width, centre_x + 0.5 * width)
    axes.set_ylim(-0.35, 2.0)
    axes.set_aspect("equal")
    axes.set_axis_off()
    outline_names = [name for name in ("reference", "predicted") if getattr(recording, name) is not None]
    if outline_names:
        label = f"filled: truth   outline: {outline_names[0]}"
        axes.text(1.0, 1.0, label, transform=axes.transAxes, ha="right", color=QUIET)


def _drawn_rows(recording: Recording) -> dict[int, str]:
    """Return rows to draw, with their names: around contact, or evenly spread and unnamed if there is none."""
    last = len(recording.states) - 1
    speed = np.linalg.norm(recording.states[:, recording.traced, VELOCITY], axis=-1)
    contact = int(np.argmax(speed > STRUCK))
    if contact == 0:
        return {int(row): "" for row in np.linspace(0, last, 6)}
    rows = {contact + round(offset / recording.scene.dt): name for name, offset in FRAMES.items()}
    return {0: "start", **{row: name for row, name in rows.items() if 0 < row <= last}}


def _draw_bodies(axes: Axes, scene: Scene, state: np.ndarray, shift: np.ndarray, tile_index: int) -> None:
    ball_rows = _ball_rows(scene)
    for row in np.argsort(-state[:, 1]):  # far links first: the eye is at y = -infinity
        centre = state[row, 0] + shift[0]
        if abs(centre - TILE * tile_index) > 0.55 * TILE:
            continue
        colour = (1.0, 1.0, 1.0) if row in ball_rows else _hex(link_colour(scene.links[row]))
        edge = "#26282e" if row in ball_rows else "white"
        outline = _capsule_contour(scene, state, int(row)) + shift
        axes.add_patch(Polygon(outline, facecolor=colour, edgecolor=edge, lw=1.0, zorder=3))


def _draw_outline(axes: Axes, scene: Scene, state: np.ndarray, shift: np.ndarray, colour: str) -> None:
    """Draw the contour of all bodies but balls: thick edges, then white areas over the edges that lie inside."""
    for row in set(range(len(scene.links))) - _ball_rows(scene):
        contour = _capsule_contour(scene, state, row) + shift
        axes.add_patch(Polygon(contour, facecolor="none", edgecolor=colour, lw=3.0, zorder=1))
        axes.add_patch(Polygon(contour, facecolor="white", edgecolor="none", zorder=2))


def _ball_rows(scene: Scene) -> set[int]:
    return {scene.rows(body.name).start for body in scene.bodies if body.is_ball}


def _capsule_contour(scene: Scene, state: np.ndarray, row: int, points: int = 24) -> np.ndarray:
    """Return the contour (P, 2) [m] of a link in the x-z plane."""
    link = scene.links[row]
    along = Rotation.from_quat(state[row, ORIENTATION], scalar_first=True).apply(link.axis)[[0, 2]]
    turn = np.arctan2(along[1], along[0]) + np.linspace(-0.5 * np.pi, 0.5 * np.pi, points)
    cap = link.radius * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    reach = 0.5 * link.length * along
    contour: np.ndarray = state[row, POSITION][[0, 2]] + np.concatenate([reach + cap, -reach - cap])
    return contour


def _draw_paths(above: Axes, beside: Axes, recording: Recording) -> None:
    """Draw both paths over the distance towards the target, to one scale.

    above, beside: axes for the sideways offset and for the height.
    """
    start, target = recording.path[0], np.asarray(recording.target, float)
    direction = (target - start)[:2]
    distance = float(np.linalg.norm(direction))
    direction = direction / distance if distance > 0.0 else np.array([1.0, 0.0])
    rotation = np.array([[direction[0], direction[1], 0.0], [-direction[1], direction[0], 0.0], [0.0, 0.0, 1.0]])

    def view(points: np.ndarray) -> np.ndarray:
        turned: np.ndarray = (points - [start[0], start[1], 0.0]) @ rotation.T
        return turned

    approach = nearest_approach(recording.path, target)
    path, nearest, goal = view(recording.path), view(approach.point), view(target)
    drawn = path[: approach.row + 2]
    predicted = None if recording.predicted_path is None else view(recording.predicted_path)
    low = np.min([drawn.min(axis=0), goal, [0.0, -0.3, 0.0]], axis=0) - np.array([0.5, 0.1, 0.15])
    high = np.max([drawn.max(axis=0), goal, [0.0, 0.3, 0.4]], axis=0) + np.array([0.8, 0.1, 0.25])
    width, height = above.get_position().width * WIDTH, above.get_position().height * HEIGHT
    scale = max((high[0] - low[0]) / width, (high[1:] - low[1:]).max() / height)  # m per inch
    for axes, row in ((above, 1), (beside, 2)):
        planes = [0, row]
        axes.plot(*path[:, planes].T, color=_hex(GROUND_TRUTH), lw=2.5, label="truth")
        if predicted is not None:
            axes.plot(*predicted[:, planes].T, color=_hex(PREDICTION), lw=2.0, ls="--", label="prediction")
        _draw_disc(axes, goal[planes], recording.radius, color=_hex(TARGET), alpha=0.5, lw=0, label="target")
        for point in (path[0], nearest):
            _draw_disc(axes, point[planes], recording.radius, fill=False, ec=_hex(GROUND_TRUTH), lw=1.2)
        axes.plot(*np.stack([nearest, goal])[:, planes].T, color="black", lw=1.2)
        bottom = low[2] if row == 2 else 0.5 * (low[1] + high[1] - scale * height)
        # Away from the path, and from the title above.
        label_below = nearest[row] >= goal[row] or goal[row] > bottom + 0.7 * scale * height
        axes.annotate(
            f"misses by {100.0 * approach.distance:.1f} cm",
            (goal[0], goal[row]),
            xytext=(18.0, -34.0 if label_below else 26.0),
            textcoords="offset points",
            fontsize=12,
            arrowprops={"arrowstyle": "-", "color": QUIET, "lw": 0.8},
            bbox={"boxstyle": "round,pad=0.2", "fc": "white", "ec": "none", "alpha": 0.85},
        )
        axes.set_xlim(low[0], low[0] + scale * width)
        axes.set_ylim(bottom, bottom + scale * height)
        _set_plain_style(axes)
    above.set_title("Ball from above", loc="left", fontsize=13)
    above.set_ylabel("to the left [m]")
    beside.axhline(0.0, color=QUIET, lw=1.0)
    beside.set_title("Ball from the side", loc="left", fontsize=13)
    beside.set_ylabel("height [m]")
    beside.set_xlabel("from the ball's spot towards the target [m]")
    above.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False, fontsize=11)


def _positive(values: Sequence[float]) -> np.ndarray:
    """Return costs, with NaN for those not positive or not finite, which a logarithmic axis cannot show."""
    costs = np.asarray(values, float)
    return np.where((costs > 0.0) & np.isfinite(costs), costs, np.nan)


def _draw_costs(axes: Axes, terms: Mapping[str, np.ndarray]) -> None:
    """Plot the cost terms, as `_positive` returns them, over the replans."""
    for (name, values), colour, marker in zip(terms.items(), cycle(PALETTE), cycle("osD^vP"), strict=False):
        axes.plot(np.arange(1, len(values) + 1), values, color=colour, marker=marker, ms=4, lw=1.5, label=name)
    greatest = max(float(np.nanmax(values)) for values in terms.values())
    axes.set_yscale("log")
    axes.set_ylim(max(axes.get_ylim()[0], greatest * 10.0**-DECADES), None)
    axes.set_xlim(0.5, max(map(len, terms.values())) + 0.5)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    axes.set_xlabel("replan")
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, frameon=False, fontsize=11)
    axes.figure.text(0.68, 0.525, "Cost of the plan, by term", fontsize=13)
    _set_plain_style(axes)


def _draw_disc(axes: Axes, centre: np.ndarray, radius: float, **style: Any) -> None:
    axes.add_patch(Circle((float(centre[0]), float(centre[1])), radius, **style))


def _set_plain_style(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, color="#e3e6ea", lw=0.8)
    axes.set_axisbelow(True)


def _hex(colour: Colour) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colour)
