"""Film of a kick, mp4 or gif: human, ball and both paths in perspective, slow up to the target, then in real time."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from larp_model.errors import InputError
from larp_model.files import write_whole
from larp_model.scene import Link, Scene
from larp_model.state import ORIENTATION, POSITION
from viewer.camera import PictureCamera, around
from viewer.recording import Approach, Recording, nearest_approach
from viewer.scene_view import (
    BALL_PATCHES,
    GROUND_TRUTH,
    MARKINGS,
    PITCH,
    PREDICTION,
    TARGET,
    Colour,
    football_meshes,
    link_colour,
    sky,
)

SUFFIXES = (".mp4", ".gif")
SLOW_SPEED = 0.25  # playback speed up to the target, as a fraction of real time
SLOW_AFTER = 0.1  # s after the closest approach during which playback stays slow
DOTS = 100  # per inch
NEAR, FAR = 0.5, 20.0  # m, between which the ground is drawn
LIGHT = np.array([0.25, -0.45, -1.0])  # direction in which light falls
INK, QUIET, SHADOW = "#22262c", "#434b57", 0.7  # the shadow dims the pitch to this share
CIRCLE = np.stack([np.cos(np.linspace(0, 2 * np.pi, 40)), np.sin(np.linspace(0, 2 * np.pi, 40))], axis=-1)


def check_film(path: str | Path) -> None:
    """Raise InputError if no film can be written to a path: wrong suffix, or mp4 without an encoder."""
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"video is {str(path)!r}, but its name must end in {' or '.join(SUFFIXES)}")
    if suffix == ".mp4":
        try:
            import imageio_ffmpeg  # noqa: F401
        except ImportError:
            raise InputError("video: mp4 needs an encoder: pip install 'larp-mpc[video]', or ask for a .gif") from None


def write_film(recording: Recording, path: str | Path, size: tuple[int, int] = (1280, 720), rate: float = 30.0) -> None:
    """Write a film to a path. size: (width, height) [pixels]. rate: frames per second. Raises as `check_film` does."""
    check_film(path)
    pictures = frames(recording, size, rate)
    if Path(path).suffix.lower() == ".gif":
        # All players keep only delays of whole hundredths of a second.
        delay, stack = 10 * round(100.0 / rate), np.stack(list(pictures))
        write_whole(path, imageio.imwrite("<bytes>", stack, extension=".gif", duration=delay, loop=0))
        return
    from imageio_ffmpeg import get_ffmpeg_exe

    # Started here, since the encoder's own start forks, which JAX's threads do not survive.
    with tempfile.TemporaryDirectory() as folder:
        film = Path(folder) / "film.mp4"
        raw_format = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}", "-r", str(rate), "-i", "-"]
        command = [
            get_ffmpeg_exe(),
            "-loglevel",
            "error",
            *raw_format,
            "-pix_fmt",
            "yuv420p",
            "-movflags",
            "+faststart",
            str(film),
        ]
        subprocess.run(command, input=b"".join(picture.tobytes() for picture in pictures), check=True)
        write_whole(path, film.read_bytes())


def frames(recording: Recording, size: tuple[int, int] = (1280, 720), rate: float = 30.0) -> Iterator[np.ndarray]:
    """Yield the frames (height, width, 3) of a film, with values from 0 to 255."""
    approach = nearest_approach(recording.path, recording.target)
    camera = PictureCamera.of(_points_in_view(recording, approach), size[1] / size[0])
    across = size[1] / size[0]
    figure = Figure((size[0] / DOTS, size[1] / DOTS), DOTS)
    canvas: Any = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(-1.0, 1.0), ylim=(-across, across))
    axes.set_axis_off()
    _draw_ground(axes, camera)
    canvas.draw()
    ground = canvas.copy_from_bbox(figure.bbox)
    _clear(axes)
    for time in _frame_times(recording, approach, rate):
        canvas.restore_region(ground)
        _draw_scene(axes, camera, recording, approach, time)
        axes.draw(canvas.get_renderer())
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()
        _clear(axes)


def _clear(axes: Axes) -> None:
    """Remove everything drawn but keep the axes, which take longer to create than a frame."""
    for artist in (*axes.images, *axes.collections, *axes.lines, *axes.patches, *axes.texts):
        artist.remove()


def _frame_times(recording: Recording, approach: Approach, rate: float) -> Iterator[float]:
    """Yield the times [s] in the recording of the film's frames."""
    slow = min(approach.row * recording.scene.dt + SLOW_AFTER, recording.duration)
    yield from np.arange(0.0, slow, SLOW_SPEED / rate)
    yield from np.arange(slow, recording.duration, 1.0 / rate)


def _points_in_view(recording: Recording, approach: Approach) -> np.ndarray:
    """Return points (P, 3) [m] that the camera must see: those of the human, and of the ball up to the target."""
    ball = recording.traced % len(recording.scene.links)
    links = np.delete(recording.states[::5], ball, axis=1)[..., POSITION].reshape(-1, 3)
    ball_path = recording.path[: approach.row + 2]
    return around(links, ball_path, np.asarray(recording.target, float))


def _draw_ground(axes: Axes, camera: PictureCamera) -> None:
    """Draw the sky and the ground, a metre grid that fades with distance; it never moves and is drawn only once."""
    horizon = float(camera(camera.position + 1e4 * (camera.axes[2] * (1.0, 1.0, 0.0)))[1])
    axes.axhspan(-1.0, horizon, color=_rgb(PITCH), zorder=0)
    limits = axes.get_xlim(), axes.get_ylim()
    axes.imshow(sky(), extent=(-1.0, 1.0, horizon, max(horizon + 0.01, limits[1][1])), aspect="auto", zorder=0)
    axes.set(xlim=limits[0], ylim=limits[1])
    middle = np.round(camera.position + 0.5 * FAR * camera.axes[2])
    for along, across in ((0, 1), (1, 0)):
        for shift in np.arange(-FAR, FAR + 1.0):
            line = np.zeros((8 * int(FAR), 3))
            line[:, along] = middle[along] + np.linspace(-FAR, FAR, len(line))
            line[:, across] = middle[across] + shift
            line = line[camera.depth(line) > NEAR]
            if len(line) > 1:
                fade = np.clip(1.0 - camera.depth(line[1:]) / FAR, 0.0, 1.0)
                colours = [(*_rgb(MARKINGS), share) for share in fade]
                segments = np.stack([camera(line[:-1]), camera(line[1:])], axis=1)
                axes.add_collection(LineCollection(list(segments), colors=colours, lw=0.8, zorder=0.1))


def _draw_scene(axes: Axes, camera: PictureCamera, recording: Recording, approach: Approach, time: float) -> None:
    """Draw everything that changes between frames, at a time [s] of the recording."""
    target, ball = np.asarray(recording.target, float), recording.traced % len(recording.scene.links)
    row = min(int(time / recording.scene.dt), len(recording.states) - 1)
    state = recording.states[row]
    _draw_shadows(axes, camera, recording.scene, state)
    goal, size = camera.sphere(target, recording.radius)
    _draw_disc(axes, goal, size, fc=_rgb(TARGET), alpha=0.6, ec=_rgb(TARGET), lw=1.5, zorder=1)
    _draw_paths(axes, camera, recording, row)
    _draw_links(axes, camera, recording.scene, state, ball)
    _draw_ball(axes, camera, state[ball], recording.radius)
    predicted = recording.predicted_at(row)
    if predicted is not None:
        middle, size = camera.sphere(predicted[ball, POSITION], recording.radius)
        _draw_disc(axes, middle, size, fill=False, ec=_rgb(PREDICTION), lw=1.6, ls=(0, (4, 3)), zorder=3.9)
    if row > approach.row:
        _draw_miss(axes, camera, approach, target)
    slow = time < approach.row * recording.scene.dt + SLOW_AFTER
    _draw_captions(
        axes, recording.title or "Kick", f"{time:.2f} s" + (f", at {SLOW_SPEED:g} of its speed" if slow else "")
    )


def _capsule_ends(link: Link, state: np.ndarray) -> np.ndarray:
    """Return the ends (2, 3) [m] of a link's axis in its state (13,)."""
    half_axis = 0.5 * link.length * Rotation.from_quat(state[ORIENTATION], scalar_first=True).apply(link.axis)
    return np.asarray(state[POSITION] + np.stack([half_axis, -half_axis]))


def _draw_shadows(axes: Axes, camera: PictureCamera, scene: Scene, state: np.ndarray) -> None:
    """Draw the shadows that all links cast on the ground in a state (L, 13)."""
    outlines = [
        _shadow(camera, _capsule_ends(link, row), link.radius) for link, row in zip(scene.links, state, strict=True)
    ]
    axes.add_collection(
        PolyCollection(
            outlines, facecolors=[tuple(SHADOW * part for part in _rgb(PITCH))], edgecolors="none", zorder=0.2
        )
    )


def _draw_paths(axes: Axes, camera: PictureCamera, recording: Recording, row: int) -> None:
    """Draw the path of the ball up to a row of the recording, and all of its predicted path."""
    paths: list[tuple[np.ndarray, Colour, Any, float]] = [(recording.path[: row + 1], GROUND_TRUTH, "-", 2.5)]
    if recording.predicted_path is not None:
        paths.append((recording.predicted_path, PREDICTION, (0, (4, 3)), 1.6))
    for path, colour, style, width in paths:
        visible = path[camera.depth(path) > NEAR]
        axes.plot(*camera(visible).T, color=_rgb(colour), ls=style, lw=width, zorder=2, solid_capstyle="round")


def _draw_links(axes: Axes, camera: PictureCamera, scene: Scene, state: np.ndarray, ball: int) -> None:
    """Draw all links but the ball in a state (L, 13), far ones first, each with a lighter area towards the light.

    Links that are nearer to the camera than the ball are drawn over it.
    """
    towards_light = np.array([0.0, 0.0, 0.3]) - 0.15 * camera.axes[0]
    capsules = []
    for index, link in enumerate(scene.links):
        if index != ball:
            ends = _capsule_ends(link, state[index])
            lit = _capsule_outline(camera, ends + link.radius * towards_light, 0.55 * link.radius)
            outline, colour = _capsule_outline(camera, ends, link.radius), _rgb(link_colour(link))
            capsules.append((float(camera.depth(ends).mean()), outline, colour, lit))
    ball_depth = camera.depth(state[ball, POSITION])
    capsules.sort(key=lambda capsule: -capsule[0])
    for layer, (depth, outline, colour, lit) in enumerate(capsules):
        zorder = 3.0 + 0.01 * layer + (1.0 if depth < ball_depth else 0.0)
        polygons = PolyCollection([outline], facecolors=[colour], edgecolors="white", lw=0.8, zorder=zorder)
        axes.add_collection(polygons)
        shine = tuple(1.0 - 0.78 * (1.0 - part) for part in colour)
        axes.add_collection(PolyCollection([lit], facecolors=[shine], edgecolors="none", zorder=zorder))


def _draw_miss(axes: Axes, camera: PictureCamera, approach: Approach, target: np.ndarray) -> None:
    """Draw the distance between the target (3,) [m] and the closest point of the ball's path, and write it above."""
    ends = camera(np.stack([approach.point, target]))
    axes.plot(*ends.T, color=INK, lw=1.5, zorder=5)
    axes.annotate(
        f"{100.0 * approach.distance:.1f} cm from the target",
        (float(ends[1, 0]), float(ends[1, 1])),
        (0.0, 26.0),
        textcoords="offset points",
        ha="center",
        fontsize=13,
        color=INK,
        zorder=6,
    )


def _draw_captions(axes: Axes, title: str, clock: str) -> None:
    """Write the title and the time in one corner, and the meaning of the colours in another."""
    style: dict[str, Any] = {"transform": axes.transAxes, "va": "top"}
    axes.text(0.025, 0.95, title, fontsize=17, weight="bold", **style)
    axes.text(0.025, 0.885, clock, fontsize=12, color=QUIET, **style)
    legend = (("truth (MuJoCo)", GROUND_TRUTH), ("prediction", PREDICTION), ("target", TARGET))
    behind = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.8}
    for line, (label, colour) in enumerate(legend):
        axes.text(0.975, 0.95 - 0.05 * line, label, fontsize=12, ha="right", color=_rgb(colour), bbox=behind, **style)


def _draw_ball(axes: Axes, camera: PictureCamera, state: np.ndarray, radius: float) -> None:
    """Draw the ball as a white disc with those of its dark patches that face the camera."""
    centre = state[POSITION]
    middle, size = camera.sphere(centre, radius)
    _draw_disc(axes, middle, size, fc=_rgb(BALL_PATCHES[0]), ec=INK, lw=1.2, zorder=3.8)
    vertices, faces = football_meshes(radius, subdivisions=1)[1]
    rotated = Rotation.from_quat(state[ORIENTATION], scalar_first=True).apply(vertices)
    towards = camera.position - centre
    facing = (rotated[faces].mean(axis=1) @ towards) > 0.15 * radius * np.linalg.norm(towards)
    patches = camera(centre + rotated)[faces[facing]]
    dark = _rgb(BALL_PATCHES[1])
    axes.add_collection(PolyCollection(patches, facecolors=[dark], edgecolors=[dark], lw=0.3, zorder=3.81))


def _capsule_outline(camera: PictureCamera, ends: np.ndarray, radius: float) -> np.ndarray:
    """Return the outline (P, 2), in the picture, of a capsule between ends (2, 3) [m]."""
    discs = [camera.sphere(end, radius) for end in ends]
    return _convex_outline(np.concatenate([middle + size * CIRCLE for middle, size in discs]))


def _shadow(camera: PictureCamera, ends: np.ndarray, radius: float) -> np.ndarray:
    """Return the outline (P, 2), in the picture, of the shadow that a capsule casts on the ground."""
    on_ground = ends + np.maximum(ends[:, 2:], 0.0) * LIGHT
    discs = np.concatenate([end[:2] + radius * CIRCLE for end in on_ground])
    return _convex_outline(camera(np.pad(discs, ((0, 0), (0, 1)))))


def _convex_outline(points: np.ndarray) -> np.ndarray:
    outline: np.ndarray = points[ConvexHull(points).vertices]
    return outline


def _draw_disc(axes: Axes, middle: np.ndarray, size: float, **style: Any) -> None:
    axes.add_patch(Circle((float(middle[0]), float(middle[1])), size, **style))


def _rgb(colour: Colour) -> tuple[float, float, float]:
    return colour[0] / 255.0, colour[1] / 255.0, colour[2] / 255.0
