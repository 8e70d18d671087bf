"""The controls of the page: play, speed, time; and what is to be read beside them."""

from __future__ import annotations

import math

import viser

SPEEDS = (0.05, 2.0)


class Panel:
    """Its time slider is the clock: the page draws what the slider says, whoever moved it."""

    def __init__(self, gui: viser.GuiApi) -> None:
        gui.configure_theme(show_share_button=False, show_logo=False)
        gui.set_panel_label("LARP-MPC")
        self._text = gui.add_markdown("Waiting for the first state ...")
        self._play = gui.add_button("Pause", visible=False)
        self._speed = gui.add_slider("Speed", *SPEEDS, 0.05, 1.0, visible=False)
        self._time = gui.add_slider("Time [s]", 0.0, 1.0, 0.01, 0.0, visible=False)
        self._duration = 0.0
        self._playing = True

        @self._play.on_click
        def _(_: viser.GuiEvent) -> None:
            self._playing = not self._playing
            self._play.label = "Pause" if self._playing else "Play"

    def write(self, text: str) -> None:
        """Show a text in Markdown."""
        self._text.content = text

    def watch(self) -> None:
        """Hide the controls: what is drawn comes from outside."""
        for control in (self._play, self._speed, self._time):
            control.visible = False

    def play(self, duration: float, step: float) -> None:
        """Offer the controls for a recording of that duration, with a state every `step` [s]."""
        self._duration = duration
        self._time.max, self._time.step = max(duration, step), step
        self._set_time(0.0)
        for control in (self._play, self._speed, self._time):
            control.visible = True

    def advance(self, elapsed: float) -> float:
        """The time in the recording [s], `elapsed` seconds after the last call; it starts over at the end."""
        time = within(self._time.value, 0.0, self._duration)
        if self._playing:
            time += elapsed * within(self._speed.value, *SPEEDS)
            self._set_time(time if time <= self._duration else 0.0)
        return min(time, self._duration)

    def _set_time(self, time: float) -> None:
        self._time.value = time  # type: ignore[misc]  # mypy overlooks its setter


def within(value: float, low: float, high: float) -> float:
    """A number of a browser brought between bounds, for the server checks nothing; `low` where it is none."""
    return min(max(value, low), high) if math.isfinite(value) else low
