"""Comparison of the embedded kick with captured kicks: joint angles and toe speed around the strike."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table
from scipy.spatial.transform import Rotation

from larp_model import state as packed
from larp_model.bodies import human_and_ball
from larp_model.errors import InputError
from larp_model.scene import Body, Scene
from tasks.benchmarks import report
from tasks.command import run
from tasks.motions import bvh, skeleton
from tasks.motions.references import Reference, embedded

# Time before and after the strike that is compared [s].
BEFORE, AFTER = 0.6, 0.4
# Joints whose flexion is compared: title, link, and the sign that makes flexion positive (the ankle's is plantar).
CURVES = (
    ("hip flexion", "right_thigh", -1.0),
    ("knee flexion", "right_shin", 1.0),
    ("ankle plantar flexion", "right_foot", 1.0),
    ("plant knee flexion", "left_shin", 1.0),
)
COLUMNS = {
    "toe_peak_m_s": "toe [m/s]",
    "hip_backswing_deg": "hip back",
    "knee_backswing_deg": "knee back",
    "hip_strike_deg": "hip",
    "knee_strike_deg": "knee",
    "ankle_strike_deg": "ankle",
    "plant_knee_strike_deg": "plant knee",
}
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")


@dataclass(frozen=True, eq=False)
class ReferenceKick:
    """A kick by the right foot over `time` (T,) [s] from its strike: flexions (T,) [deg], speed of the toe (T,) [m/s].

    A flexion is the pitch of the joint's rotation vector.
    """

    name: str
    time: np.ndarray
    flexion: dict[str, np.ndarray]
    toe: np.ndarray

    @property
    def kind(self) -> str:
        """Return "kick" if the toe reaches the speed of the slowest kick, else "walk"."""
        return "kick" if self.toe.max() >= skeleton.SLOWEST_KICK else "walk"

    def figures(self) -> dict[str, float]:
        """Return the figures of the table by column.

        Backswing: least hip flexion and greatest knee flexion until the strike.
        """
        swing, strike = self.time <= 0.0, int(abs(self.time).argmin())
        hip, knee, ankle, plant = (self.flexion[title] for title, _, _ in CURVES)
        values = (self.toe.max(), hip[swing].min(), knee[swing].max(), hip[strike], knee[strike], ankle[strike])
        return dict(zip(COLUMNS, map(float, (*values, plant[strike])), strict=True))


def _kick(name: str, body: Body, angles: np.ndarray, toe: np.ndarray, strike: int, dt: float) -> ReferenceKick:
    """Return the kick of joint rotation vectors (T, J, 3) [rad] and toe speeds (T,) [m/s], `dt` [s] apart."""
    joints = [body.links[child].name for child, _, _ in body.motors]
    time = (np.arange(len(toe)) - strike) * dt
    shown = (time >= -BEFORE) & (time <= AFTER)
    flexion = {title: sign * np.degrees(angles[shown, joints.index(link), 1]) for title, link, sign in CURVES}
    return ReferenceKick(name, time[shown], flexion, toe[shown])


def performed(name: str, scene: Scene, reference: Reference) -> ReferenceKick:
    """Return a reference's kick from its ground-truth states; the toe is the front end of the foot's axis."""
    human = scene.human
    states = reference.states[:, scene.rows(human.name)]
    angles = human.angles(states[..., packed.ORIENTATION])
    row = human.link("right_foot")
    foot = human.links[row]
    rotation = Rotation.from_quat(states[:, row, packed.ORIENTATION], scalar_first=True)
    arm = rotation.apply(0.5 * foot.length * np.array(foot.axis))
    toe = states[:, row, packed.VELOCITY] + np.cross(states[:, row, packed.ANGULAR_VELOCITY], arm)
    return _kick(name, human, angles, np.linalg.norm(toe, axis=-1), reference.strike, scene.dt)


def recorded(path: Path, scene: Scene) -> ReferenceKick:
    """Return the fastest swing of a captured clip; the toe is the base of the toes.

    Kicks by the left foot are mirrored.
    """
    motion = bvh.load(path)
    if skeleton.kicking_side(motion) == "Left":
        motion = skeleton.mirrored(motion)
    strike = skeleton.strike(motion)
    clip = motion.cut(strike - round((BEFORE + 0.1) * motion.rate), strike + round((AFTER + 0.1) * motion.rate))
    _, angles = skeleton.retarget(clip, scene.human, scene.dt)
    times = np.arange(len(angles)) * scene.dt
    speed = skeleton.toe_speed(clip)
    toe = np.interp(times, np.arange(len(speed)) / clip.rate, speed)
    return _kick(path.stem, scene.human, angles, toe, round(skeleton.strike(clip) / clip.rate / scene.dt), scene.dt)


def table(kicks: list[ReferenceKick]) -> Table:
    """Return a table with one row per kick, the embedded one first, and the range over the captured kicks."""
    rows = Table("kick", "kind", *COLUMNS.values(), title="Flexions at the strike and in the backswing [deg]")

    def text(column: str, value: float) -> str:
        return f"{value:.1f}" if column == "toe_peak_m_s" else f"{value:.0f}"

    for kick in kicks:
        rows.add_row(kick.name, kick.kind, *(text(column, value) for column, value in kick.figures().items()))
    if others := [kick.figures() for kick in kicks[1:] if kick.kind == "kick"]:
        captured = {column: [figures[column] for figures in others] for column in COLUMNS}
        ranges = (f"{text(column, min(values))} to {text(column, max(values))}" for column, values in captured.items())
        rows.add_row("captured", "kicks", *ranges)
    return rows


def picture(kicks: list[ReferenceKick]) -> Figure:
    """Plot flexions and toe speed over the time from the strike; walks are dashed."""
    figure = Figure(figsize=(14, 8), layout="constrained")
    figure.suptitle("The embedded kick and captured ones", fontsize=16)
    panels = figure.subplots(2, 3).ravel()

    def draw(axes: Axes, title: str, unit: str, curves: list[np.ndarray]) -> None:
        for index, (kick, curve) in enumerate(zip(kicks, curves, strict=True)):
            colour = "black" if index == 0 else COLOURS[(index - 1) % len(COLOURS)]
            style: dict[str, Any] = {"color": colour, "linewidth": 3.0 if index == 0 else 1.5, "label": kick.name}
            if kick.kind == "walk":
                style |= {"linestyle": "--", "label": f"{kick.name} (walk)"}
            axes.plot(kick.time, curve, **style)
        axes.axvline(0.0, color="0.7", linewidth=1.0, zorder=0)
        axes.set(title=title, xlabel="time from the strike [s]", ylabel=unit)
        axes.grid(alpha=0.3)

    for axes, (title, _, _) in zip(panels, CURVES, strict=False):
        draw(axes, title, "deg", [kick.flexion[title] for kick in kicks])
    draw(panels[4], "toe speed", "m/s", [kick.toe for kick in kicks])
    panels[5].axis("off")
    panels[5].legend(*panels[4].get_legend_handles_labels(), loc="center", frameon=False, fontsize=12)
    return figure


def main(clips: Path | None = None, json: Path = Path("runs/benchmarks/reference.json"), publish: bool = False) -> None:
    """Compare the embedded kick with captured ones.

    Args:
        clips: folder of captured kicks (BVH).
        json: where the figures go; the picture goes beside them.
        publish: put the table into RESULTS.md.
    """
    paths = sorted(clips.glob("*.bvh")) if clips else []
    if clips and not paths:
        raise InputError(f"clips is {str(clips)!r}, but must be a folder that holds .bvh files")
    if publish and not clips:
        raise InputError("publish is set, but there are no clips to compare with: clips must be a folder of .bvh files")
    report.ready(json, publish)
    scene = human_and_ball()
    kicks = [performed("embedded", scene, embedded(scene)), *(recorded(path, scene) for path in paths)]
    command = "python -m tasks.benchmarks.reference" + (" --clips DIR" if clips else "")
    rows: list[dict[str, Any]] = [{"name": kick.name, "kind": kick.kind, **kick.figures()} for kick in kicks]
    report.write_json(json, {"command": command, "hardware": report.hardware(), "rows": rows})
    report.write_picture(json.with_suffix(".png"), picture(kicks))
    report.show(table(kicks))
    if publish:
        report.publish("reference", "Reference: the embedded kick and captured ones", command, table(kicks))
    if not clips:
        print("No clips to compare with: --clips names a folder of BVH files.")


if __name__ == "__main__":
    run(main)
