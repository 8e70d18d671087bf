"""What is beside the picture: controls of the kick, weights of its costs, figures, and the replay's clock.

Everything that comes from a browser is checked here, before anyone else sees it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import viser
from viser import uplot

from viewer.camera import VIEWS
from viewer.checked import flag, option, within
from viewer.wishes import Offer

SPEEDS = (0.05, 2.0)
# What a key asks for: its name, what the button says, the key.
ACTIONS = (("kick", "Kick", "K"), ("reset", "Reset", "R"), ("play", "Play / pause", "space"), ("step", "Step", "S"))
GHOSTS = ("prediction", "reference", "fan")
FILES = ("html", "png", "gif")
# A cost's weight goes up to so many times what it is at first.
HEAVIEST = 5.0
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#333333")
LEAST = 1e-6  # a cost below has no place on a logarithmic axis
ABOUT = """Drag the green target, then **Kick** (key K). The model plans, MuJoCo carries out.

The ball has two handles: where it lies and, above it, how it rolls.

Thin lines are other candidates, dark ones cheap; grey is the reference."""

Asked = Callable[[str, "viser.ClientHandle | None"], None]


class Panel:
    """Its time slider is the clock of a replay: the page draws what the slider says, whoever moved it."""

    def __init__(
        self, gui: viser.GuiApi, asked: Asked, changed: Callable[[], None], offer: Offer | None = None
    ) -> None:
        """asked: called with the name of what a client asks for. changed: called when a setting has."""
        self._gui, self._asked, self._changed, self._offer = gui, asked, changed, offer
        gui.configure_theme(show_share_button=False, show_logo=False)
        gui.set_panel_label("LARP-MPC")
        gui.main_panel.dock_right()
        self._text = gui.add_markdown("Waiting for the first state ...")
        self._settings: dict[str, Any] = {}
        self._terms: dict[str, Any] = {}
        self._plots: dict[str, viser.GuiUplotHandle] = {}
        self._duration, self._playing = 0.0, True
        if offer:
            self._button("Kick", "kick")
        self._group("", {label: name for name, label, _ in ACTIONS[1 if offer else 2 :]})
        for name, label, key in ACTIONS[0 if offer else 2 :]:
            self._key(label, name, key)
        self._speed = gui.add_slider("Speed", *SPEEDS, 0.05, 1.0)
        self._time = gui.add_slider("Time [s]", 0.0, 1.0, 0.01, 0.0)
        if offer:
            tabs = gui.add_tab_group()
            with tabs.add_tab("Kick"):
                self._choices(offer)
            with tabs.add_tab("Costs"):
                self._weights(offer)
            with tabs.add_tab("Kept"):
                self._kept()
        self._looks()
        if offer:
            # A plot that is made where it cannot be seen has no width: so no tab.
            self._folder = gui.add_folder("Figures")
            with self._folder:
                self._figures = gui.add_markdown("What kicks come to.")
        self.watch()

    def _button(self, label: str, name: str) -> None:
        """A button that asks for something by name."""

        @self._gui.add_button(label).on_click
        async def _(event: viser.GuiEvent) -> None:
            self._asked(name, event.client)

    def _group(self, label: str, names: Mapping[str, str]) -> None:
        """Buttons in a row, each of which asks for something, by what is written on it."""
        group = self._gui.add_button_group(label, tuple(names))

        @group.on_click
        async def _(event: viser.GuiEvent) -> None:
            self._asked(names[option(group.value, tuple(names))], event.client)

    def _key(self, label: str, name: str, key: str) -> None:
        """A key that asks for something by name."""

        @self._gui.add_command(label, hotkey=key).on_trigger  # type: ignore[arg-type]
        async def _(event: viser.CommandEvent) -> None:
            self._asked(name, event.client)

    def _setting(self, name: str, handle: Any) -> None:
        """Keep a control by name; whenever it changes, the settings have."""
        self._settings[name] = handle

        @handle.on_update
        async def _(event: viser.GuiEvent) -> None:
            self._changed()

    def _choices(self, offer: Offer) -> None:
        gui = self._gui
        gui.add_markdown(ABOUT)
        for name, label, names in (
            ("preset", "Preset", offer.presets),
            ("dynamics", "Model", offer.dynamics),
            ("weights", "Its weights", offer.weights),
            ("reference", "Reference", offer.references),
        ):
            self._setting(name, gui.add_dropdown(label, names, visible=len(names) > 1))
        hint = "Seconds that a plan may take; 0: as long as the preset takes"
        self._setting("budget", gui.add_slider("Budget [s]", 0.0, offer.longest, 0.05, 0.0, hint=hint))
        with gui.add_folder("Push", expand_by_default=False):
            gui.add_markdown("While it kicks: a change of velocity [m/s], forwards, to the left, up.")
            self._push = [
                gui.add_slider(axis, -offer.push, offer.push, 0.1, value)
                for axis, value in (("forwards", 0.0), ("left", 1.0), ("up", 0.0))
            ]
            self._group("Push", {"the human": "push human", "the ball": "push ball"})
        self._key("Push the human", "push human", "H")
        self._key("Push the ball", "push ball", "B")

    def _weights(self, offer: Offer) -> None:
        """A slider for each named cost, built from the cost's own weight."""
        self._gui.add_markdown("Weights of the named costs; they count from the next plan on.")
        for name, weight in offer.terms:
            handle = self._gui.add_slider(name, 0.0, HEAVIEST * weight, HEAVIEST * weight / 100.0, weight)
            self._terms[name] = handle

            @handle.on_update
            async def _(event: viser.GuiEvent) -> None:
                self._changed()

        self._button("As they were", "weights")

    def _kept(self) -> None:
        gui = self._gui
        self._button("Keep this kick", "keep")
        self._saved = gui.add_dropdown("Kept kicks", ("none yet",))
        self._button("Open", "open")
        self._button("Show beside", "beside")
        self._button("Take away what is beside", "alone")

    def _looks(self) -> None:
        gui = self._gui
        with gui.add_folder("View", expand_by_default=self._offer is None):
            self._group("Camera", {name: f"view {name}" for name in (*VIEWS, "follow")})
            shown = GHOSTS if self._offer else GHOSTS[:2]
            self._ghosts = {name: gui.add_checkbox(f"show {name}", True) for name in shown}
            for handle in self._ghosts.values():

                @handle.on_update
                async def _(event: viser.GuiEvent) -> None:
                    self._asked("look", event.client)

            if self._offer:
                self._group("Download", {name: f"download {name}" for name in FILES})

    @property
    def playing(self) -> bool:
        """Whether time goes on."""
        return self._playing

    @playing.setter
    def playing(self, goes_on: bool) -> None:
        self._playing = goes_on

    @property
    def speed(self) -> float:
        """Of the motion, as a share of its own."""
        return within(self._speed.value, *SPEEDS)

    @property
    def ghosts(self) -> set[str]:
        """Which of `GHOSTS` are to be seen."""
        return {name for name, handle in self._ghosts.items() if flag(handle.value)}

    def asked_for(self) -> dict[str, Any]:
        """Those of `Wishes` that are set here, all within what is offered."""
        offer = self._offer
        assert offer is not None
        names = {"preset": offer.presets, "dynamics": offer.dynamics}
        names |= {"weights": offer.weights, "reference": offer.references}
        found: dict[str, Any] = {name: option(self._settings[name].value, known) for name, known in names.items()}
        found["budget"] = within(self._settings["budget"].value, 0.0, offer.longest)
        found["terms"] = {name: within(self._terms[name].value, 0.0, HEAVIEST * weight) for name, weight in offer.terms}
        return found

    def as_at_first(self) -> None:
        """Give the costs their own weights again."""
        assert self._offer is not None
        for name, weight in self._offer.terms:
            self._terms[name].value = weight

    def push(self) -> tuple[float, ...]:
        """The change of velocity (3,) [m/s] that is set."""
        assert self._offer is not None
        return tuple(within(each.value, -self._offer.push, self._offer.push) for each in self._push)

    def kept(self, names: Sequence[str]) -> None:
        """Offer kept kicks to be opened, the last one first."""
        self._saved.options = tuple(names) or ("none yet",)

    def chosen(self, names: Sequence[str]) -> str | None:
        """The kept kick that is chosen; None where there is none."""
        return option(self._saved.value, names) if names else None

    def write(self, text: str) -> None:
        """Show a text in Markdown."""
        if self._text.content != text:
            self._text.content = text

    def figures(self, text: str) -> None:
        """Show figures in Markdown."""
        self._figures.content = text

    def plot(self, name: str, series: Mapping[str, Sequence[float]], across: str) -> None:
        """Draw values (T,) by name on a logarithmic axis, over 1 ... T, in the figures."""
        count = max((len(values) for values in series.values()), default=0)
        if count < 2:
            return
        # What is not finite leaves a gap: it is no small value.
        rows = [
            np.where(np.isfinite(each), np.maximum(each, LEAST), np.nan) for each in map(np.asarray, series.values())
        ]
        data = (np.arange(1.0, count + 1.0), *rows)
        if name in self._plots:
            self._plots[name].data = data
            return
        said = [uplot.Series(label=across)]
        said += [
            uplot.Series(label=label, stroke=PALETTE[row % len(PALETTE)], width=2) for row, label in enumerate(series)
        ]
        with self._folder:
            self._plots[name] = self._gui.add_uplot(
                data,
                tuple(said),
                title=name,
                scales={"x": uplot.Scale(time=False), "y": uplot.Scale(distr=3)},
                height=220,
            )

    def watch(self) -> None:
        """Hide the clock: what is drawn comes from outside."""
        self._time.visible = False

    def play(self, duration: float, step: float) -> None:
        """Offer the controls for a recording of that duration, with a state every `step` [s]."""
        self._duration = duration
        self._time.max, self._time.step = max(duration, step), step
        self._set_time(0.0)
        self._time.visible, self.playing = True, True

    @property
    def time(self) -> float:
        """Of the recording [s]."""
        return within(self._time.value, 0.0, self._duration)

    def move(self, elapsed: float) -> None:
        """Move the clock by so many seconds, within the recording."""
        self._set_time(min(max(self.time + elapsed, 0.0), self._duration))

    def advance(self, elapsed: float) -> float:
        """The time in the recording [s], `elapsed` seconds after the last call; it starts over at the end."""
        time = self.time
        if self._playing:
            time += elapsed * self.speed
            self._set_time(time if time <= self._duration else 0.0)
        return min(time, self._duration)

    def _set_time(self, time: float) -> None:
        self._time.value = time  # type: ignore[misc]  # mypy overlooks its setter
