"""Panel beside the picture: controls of the kick, weights of its costs, figures, and the clock of the replay.

All values that come from a browser are validated here before they are used elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import viser
from viser import uplot

from viewer.camera import VIEWS
from viewer.checked import flag, option, within
from viewer.settings import Offer

SPEEDS = (0.05, 2.0)
# Actions with a key: name, label of the button, key.
ACTIONS = (("kick", "Kick", "K"), ("reset", "Reset", "R"), ("play", "Play / pause", "space"), ("step", "Step", "S"))
GHOSTS = ("prediction", "reference", "estimate", "fan")
FILES = ("html", "png", "gif")
# Upper bound of a cost's weight, as a multiple of its initial one.
HEAVIEST = 5.0
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#333333")
LEAST = 1e-3  # lower bound of values on a logarithmic axis, whose labels have three decimals
WHOLE_STEPS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)  # between the labels of a horizontal axis
ABOUT = """Drag the magenta target, then **Kick** (key K). The model plans, MuJoCo carries out.

The ball has two handles: the white ring, where it lies, and the yellow pin, how it rolls.

Thin lines are other candidates, bright ones cheap."""

HINTS = {
    "sensors": "What the planner gets to see; of anything but perfect sensors a filter estimates the state",
    "delay": "When plans are executed: in real time they are made beside the world, which goes on by the clock",
}

OnRequest = Callable[[str, "viser.ClientHandle | None"], None]


class Panel:
    """Controls beside the picture.

    The time slider is the clock of a replay: the page draws the time that it shows, whoever moved it.
    """

    def __init__(
        self, gui: viser.GuiApi, on_request: OnRequest, on_change: Callable[[], None], offer: Offer | None = None
    ) -> None:
        """Add the controls to a page.

        on_request: called with the name of the action that a client requests, and the client. on_change: called when a
        setting has changed.
        """
        self._gui, self._on_request, self._on_change, self._offer = gui, on_request, on_change, offer
        gui.configure_theme(show_share_button=False, show_logo=False)
        gui.set_panel_label("LARP-MPC")
        gui.main_panel.dock_right()
        self._text = gui.add_markdown("Waiting for the first state ...")
        self._controls: dict[str, Any] = {}
        self._terms: dict[str, Any] = {}
        self._plots: dict[str, viser.GuiUplotHandle] = {}
        self._duration, self._playing = 0.0, True
        if offer:
            self._add_button("Kick", "kick")
        self._add_buttons("", {label: name for name, label, _ in ACTIONS[1 if offer else 2 :]})
        for name, label, key in ACTIONS[0 if offer else 2 :]:
            self._add_shortcut(label, name, key)
        self._speed = gui.add_slider("Speed", *SPEEDS, 0.05, 1.0)
        self._time = gui.add_slider("Time [s]", 0.0, 1.0, 0.01, 0.0)
        if offer:
            tabs = gui.add_tab_group()
            with tabs.add_tab("Kick"):
                self._add_settings(offer)
            with tabs.add_tab("Costs"):
                self._add_weights(offer)
            with tabs.add_tab("Kept"):
                self._add_saved()
        self._add_view()
        if offer:
            # Not in a tab: a plot that is created while hidden has no width.
            self._folder = gui.add_folder("Figures")
            with self._folder:
                self._figures = gui.add_markdown("What kicks come to.")
        self.hide_clock()

    def _add_button(self, label: str, name: str) -> None:
        """Add a button that requests an action by name."""

        @self._gui.add_button(label).on_click
        async def _(event: viser.GuiEvent[Any]) -> None:
            self._on_request(name, event.client)

    def _add_buttons(self, label: str, names: Mapping[str, str]) -> None:
        """Add a row of buttons that request actions. names: from the text on a button to the name of its action."""
        group = self._gui.add_button_group(label, tuple(names))

        @group.on_click
        async def _(event: viser.GuiEvent[Any]) -> None:
            self._on_request(names[option(group.value, tuple(names))], event.client)

    def _add_shortcut(self, label: str, name: str, key: str) -> None:
        """Add a keyboard shortcut that requests an action by name."""

        @self._gui.add_command(label, hotkey=key).on_trigger  # type: ignore[arg-type]
        async def _(event: viser.CommandEvent) -> None:
            self._on_request(name, event.client)

    def _add_setting(self, name: str, handle: viser.GuiInputHandle[Any]) -> None:
        """Register a control by name; whenever it changes, `on_change` is called."""
        self._controls[name] = handle

        @handle.on_update
        async def _(event: viser.GuiEvent[Any]) -> None:
            self._on_change()

    def _add_settings(self, offer: Offer) -> None:
        gui = self._gui
        gui.add_markdown(ABOUT)
        for name, label, names in (
            ("preset", "Preset", offer.presets),
            ("dynamics", "Model", offer.dynamics),
            ("weights", "Its weights", offer.weights),
            ("reference", "Reference", offer.references),
            ("sensors", "Sensors", offer.sensors),
            ("delay", "Delay", offer.delays),
        ):
            self._add_setting(name, gui.add_dropdown(label, names, visible=len(names) > 1, hint=HINTS.get(name)))
        hint = "Seconds that a plan may take; 0: as long as the preset takes"
        self._add_setting("budget", gui.add_slider("Budget [s]", 0.0, offer.longest, 0.05, 0.0, hint=hint))
        with gui.add_folder("Push", expand_by_default=False):
            gui.add_markdown("While it kicks: a change of velocity [m/s], forwards, to the left, up.")
            self._push = [
                gui.add_slider(axis, -offer.push, offer.push, 0.1, value)
                for axis, value in (("forwards", 0.0), ("left", 1.0), ("up", 0.0))
            ]
            self._add_buttons("Push", {"the human": "push human", "the ball": "push ball"})
        self._add_shortcut("Push the human", "push human", "H")
        self._add_shortcut("Push the ball", "push ball", "B")

    def _add_weights(self, offer: Offer) -> None:
        """Add a slider for the weight of each named cost, with a range relative to its initial weight."""
        self._gui.add_markdown("Weights of the named costs; they count from the next plan on.")
        for name, weight in offer.terms:
            handle = self._gui.add_slider(name, 0.0, HEAVIEST * weight, HEAVIEST * weight / 100.0, weight)
            self._terms[name] = handle

            @handle.on_update
            async def _(event: viser.GuiEvent[Any]) -> None:
                self._on_change()

        self._add_button("As they were", "weights")

    def _add_saved(self) -> None:
        gui = self._gui
        self._add_button("Keep this kick", "keep")
        self._saved = gui.add_dropdown("Kept kicks", ("none yet",))
        self._add_button("Open", "open")
        self._add_button("Show beside", "beside")
        self._add_button("Take away what is beside", "alone")

    def _add_view(self) -> None:
        gui = self._gui
        with gui.add_folder("View", expand_by_default=self._offer is None):
            self._add_buttons("Camera", {name: f"view {name}" for name in (*VIEWS, "follow")})
            ghosts = GHOSTS if self._offer else GHOSTS[:3]
            self._ghosts = {name: gui.add_checkbox(f"show {name}", True) for name in ghosts}
            for handle in self._ghosts.values():

                @handle.on_update
                async def _(event: viser.GuiEvent[Any]) -> None:
                    self._on_request("look", event.client)

            if self._offer:
                self._add_buttons("Download", {name: f"download {name}" for name in FILES})

    @property
    def playing(self) -> bool:
        """Return whether time runs, that is, whether it is not paused."""
        return self._playing

    @playing.setter
    def playing(self, playing: bool) -> None:
        self._playing = playing

    @property
    def speed(self) -> float:
        """Return the playback speed, as a fraction of real time."""
        return within(self._speed.value, *SPEEDS)

    @property
    def ghosts(self) -> set[str]:
        """Return the names out of `GHOSTS` that are to be drawn."""
        return {name for name, handle in self._ghosts.items() if flag(handle.value)}

    def chosen_settings(self) -> dict[str, Any]:
        """Return the fields of `Settings` that are set on the panel, all within the offer."""
        offer = self._offer
        assert offer is not None
        offered = {"preset": offer.presets, "dynamics": offer.dynamics}
        offered |= {"weights": offer.weights, "reference": offer.references}
        offered |= {"sensors": offer.sensors, "delay": offer.delays}
        chosen: dict[str, Any] = {
            name: option(self._controls[name].value, options) for name, options in offered.items()
        }
        chosen["budget"] = within(self._controls["budget"].value, 0.0, offer.longest)
        chosen["terms"] = {
            name: within(self._terms[name].value, 0.0, HEAVIEST * weight) for name, weight in offer.terms
        }
        return chosen

    def reset_weights(self) -> None:
        """Reset the weights of the costs to their initial values."""
        assert self._offer is not None
        for name, weight in self._offer.terms:
            self._terms[name].value = weight

    def push(self) -> tuple[float, ...]:
        """Return the change of velocity (3,) [m/s] set for a push."""
        assert self._offer is not None
        return tuple(within(slider.value, -self._offer.push, self._offer.push) for slider in self._push)

    def list_saved(self, names: Sequence[str]) -> None:
        """Set the names of saved kicks that can be opened, latest first."""
        self._saved.options = tuple(names) or ("none yet",)

    def chosen_name(self, names: Sequence[str]) -> str | None:
        """Return the name of the saved kick that is chosen, or None if there are none."""
        return option(self._saved.value, names) if names else None

    def write(self, text: str) -> None:
        """Show a Markdown text above the controls."""
        if self._text.content != text:
            self._text.content = text

    def figures(self, text: str) -> None:
        """Show a Markdown text in the folder of figures."""
        self._figures.content = text

    def plot(self, name: str, series: Mapping[str, Sequence[float]], across: str) -> None:
        """Plot named series of values (T,) on a logarithmic axis, over 1 ... T, in the folder of figures.

        name: title of the plot; a plot that exists is updated. across: label of the horizontal axis.
        """
        count = max((len(values) for values in series.values()), default=0)
        if count < 2:
            return
        # Values that are not finite leave a gap, for they are not small.
        rows = [
            np.where(np.isfinite(values), np.maximum(values, LEAST), np.nan)
            for values in map(np.asarray, series.values())
        ]
        data = (np.arange(1.0, count + 1.0), *rows)
        if name in self._plots:
            self._plots[name].data = data
            return
        columns = [uplot.Series(label=across)]
        columns += [
            uplot.Series(label=label, stroke=PALETTE[row % len(PALETTE)], width=2) for row, label in enumerate(series)
        ]
        no_ticks: uplot.Axis_Ticks = {"show": False}
        with self._folder:
            self._plots[name] = self._gui.add_uplot(
                data,
                tuple(columns),
                title=name,
                scales={"x": uplot.Scale(time=False), "y": uplot.Scale(distr=3)},
                axes=(uplot.Axis(incrs=WHOLE_STEPS, ticks=no_ticks), uplot.Axis(ticks=no_ticks)),
                padding=(14, 12, 0, 0),
                height=220,
            )

    def hide_clock(self) -> None:
        """Hide the clock of the replay, which live states do not use."""
        self._time.visible = False

    def play(self, duration: float, step: float) -> None:
        """Show the clock for a recording of this duration [s] with a state every `step` [s], and start at 0."""
        self._duration = duration
        self._time.max, self._time.step = max(duration, step), step
        self._set_time(0.0)
        self._time.visible, self.playing = True, True

    @property
    def time(self) -> float:
        """Return the time in the recording [s] that the slider shows."""
        return within(self._time.value, 0.0, self._duration)

    def move(self, elapsed: float) -> None:
        """Move the clock by `elapsed` seconds, clipped to the recording."""
        self._set_time(min(max(self.time + elapsed, 0.0), self._duration))

    def advance(self, elapsed: float) -> float:
        """Return the time in the recording [s], `elapsed` seconds after the last call; it starts over at the end."""
        time = self.time
        if self._playing:
            time += elapsed * self.speed
            self._set_time(time if time <= self._duration else 0.0)
        return min(time, self._duration)

    def _set_time(self, time: float) -> None:
        self._time.value = time  # type: ignore[misc]  # mypy overlooks its setter
