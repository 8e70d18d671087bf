"""Draggable handles in the picture: for the target, the spot of the ball, and its rolling velocity."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import viser

from viewer.checked import vector
from viewer.settings import Offer

SIZE = 0.45  # m, of a handle's arrows
ARROW_TIME = 0.3  # s: an arrow ends where the ball would be after this time
# Offset [m] of the handle of the rolling velocity from the end of the arrow, clear of the handle of the spot.
ROLL_HANDLE_OFFSET = np.array([0.0, 0.0, 0.35])
ROLLING, RING, REACH = (240, 228, 66), (255, 255, 255), (166, 196, 154)
RING_RADIUS, PIN_RADIUS = 0.2, 0.05  # m


class Handles:
    """Handles of one page, shared by all its clients; every value is clipped to the box that is offered."""

    def __init__(
        self,
        server: viser.ViserServer,
        offer: Offer,
        target: Sequence[float],
        ball: np.ndarray,
        on_change: Callable[[], None],
    ) -> None:
        """Add the handles to the scene.

        target: (3,) [m], its initial position. ball: (3,) [m], usual position of the ball. on_change: see `Panel`.
        """
        self._server, self._offer, self._ball, self._on_change = server, offer, np.asarray(ball, float), on_change
        self.target: tuple[float, ...] = tuple(map(float, target))
        self.spot: tuple[float, ...] = (0.0, 0.0)
        self.roll: tuple[float, ...] = (0.0, 0.0)
        self._drawing = threading.Lock()
        flat_style: dict[str, Any] = {"disable_rotations": True, "active_axes": (True, True, False)}
        self._target = self._handle("target", {"disable_rotations": True, "disable_sliders": True}, SIZE)
        self._spot = self._handle("spot", {"disable_sliders": True, **flat_style}, 0.7 * SIZE)
        self._roll = self._handle("roll", flat_style, 0.5 * SIZE)
        self._draw_marks()
        self._draw_reach()
        self._place_handles()

    def _handle(self, name: str, style: dict[str, Any], size: float) -> viser.TransformControlsHandle:
        handle = self._server.scene.add_transform_controls(f"/handles/{name}", size, depth_test=False, **style)

        @handle.on_update
        async def _(event: viser.TransformControlsEvent) -> None:
            old_values = self.target, self.spot, self.roll
            self._set_value(name, handle.position)
            if event.phase == "end":
                self._place_handles()
            if old_values != (self.target, self.spot, self.roll):
                self._on_change()

        return handle

    def _set_value(self, name: str, position: np.ndarray) -> None:
        """Set the value that belongs to a handle from the position (3,) [m] to which it was dragged."""
        offer = self._offer
        if name == "target":
            self.target = tuple(map(float, vector(position, *offer.target)))
        elif name == "spot":
            self.spot = self._clip_flat(np.asarray(position) - self._ball, offer.spot)
        else:
            self.roll = self._clip_flat((np.asarray(position) - self.ball_position) / ARROW_TIME, offer.roll)
        self._draw_arrow()

    @staticmethod
    def _clip_flat(value: np.ndarray, box: tuple[tuple[float, ...], tuple[float, ...]]) -> tuple[float, ...]:
        return tuple(map(float, vector(value, (*box[0], 0.0), (*box[1], 0.0))[:2]))

    def _place_handles(self) -> None:
        """Move the handles to their values: those dragged out of the box that is offered return to its edge."""
        ball_position = self.ball_position
        with self._server.atomic():
            self._target.position = np.array(self.target)
            self._spot.position = ball_position
            self._roll.position = ball_position + ARROW_TIME * np.array((*self.roll, 0.0)) + ROLL_HANDLE_OFFSET
        self._draw_arrow()

    def _draw_arrow(self, visible: bool = True) -> None:
        """Draw the rolling velocity of the ball as an arrow, or none below 0.1 m/s or where it is not visible."""
        begin = self.ball_position
        end = begin + ARROW_TIME * np.array((*self.roll, 0.0))
        with self._drawing:  # a client drags while a plan is shown, and the server cannot replace a node twice at once
            if not visible or np.linalg.norm(self.roll) < 0.1:
                self._server.scene.remove_by_name("/handles/rolling")
            else:
                points = np.array([[begin, end]], np.float32)
                self._server.scene.add_arrows("/handles/rolling", points, ROLLING)

    def _draw_marks(self) -> None:
        """Draw what moves with the handles of the ball: a ring around its spot and, for its roll, the head of a pin."""
        scene = self._server.scene
        angles = np.linspace(0.0, 2.0 * np.pi, 49)
        below = np.full_like(angles, 0.01 - self._ball[2])
        circle = np.stack([RING_RADIUS * np.cos(angles), RING_RADIUS * np.sin(angles), below], axis=1)
        segments = np.stack([circle[:-1], circle[1:]], axis=1).astype(np.float32)
        scene.add_line_segments("/handles/spot/ring", segments, RING, thickness=0.025)
        scene.add_label("/handles/spot/label", "ball", position=(0.0, -0.5, below[0]), font_screen_scale=0.8)
        scene.add_icosphere("/handles/roll/head", PIN_RADIUS, ROLLING, cast_shadow=False)
        needle = np.array([[(0.0, 0.0, 0.0), -ROLL_HANDLE_OFFSET]], np.float32)
        scene.add_line_segments("/handles/roll/needle", needle, ROLLING, thickness=0.02)
        scene.add_label(
            "/handles/roll/label", "roll", anchor="bottom-center", position=(0.0, 0.0, 0.08), font_screen_scale=0.8
        )

    def _draw_reach(self) -> None:
        """Draw on the ground the outline of the box that is offered for the target."""
        (low_x, low_y, _), (high_x, high_y, _) = self._offer.target
        corners = np.array([(low_x, low_y), (high_x, low_y), (high_x, high_y), (low_x, high_y)])
        ring = np.concatenate([corners, np.full((4, 1), 0.01)], axis=1)
        segments = np.stack([ring, np.roll(ring, -1, axis=0)], axis=1).astype(np.float32)
        self._server.scene.add_line_segments("/handles/reach", segments, REACH, thickness=0.015)

    @property
    def ball_position(self) -> np.ndarray:
        """Return the initial position (3,) [m] of the ball as it is set by its handle."""
        position: np.ndarray = self._ball + np.array((*self.spot, 0.0))
        return position

    def aim(self, target: Sequence[float] | np.ndarray) -> None:
        """Move the target to (3,) [m], clipped to the box that is offered, as if it had been dragged."""
        self._set_value("target", np.asarray(target, float))
        self._place_handles()

    def show_all(self, visible: bool) -> None:
        """Show all handles, or only that of the target."""
        for handle in (self._spot, self._roll):
            handle.visible = visible
        self._draw_arrow(visible)
