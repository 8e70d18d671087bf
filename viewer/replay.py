"""Replay of a recording as one HTML file that plays without a server and without a network."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from pathlib import Path

import viser

from larp_model.files import write_whole
from viewer.recording import Recording
from viewer.server import close_server, open_server
from viewer.stage import LEGEND, Stage, points_in_view

FRAME = 0.02  # s of recorded time between two frames

# The style undoes a fade of the picture, which ends after a few frames: late, in a slow browser.
_CAPTION = """<style>canvas{{opacity:1!important}}</style>
<div style="position:fixed;z-index:1;right:1em;top:1em;max-width:28em;padding:.6em .9em;
font:14px/1.5 system-ui,sans-serif;color:#222;background:#fffc;pointer-events:none">{}</div>"""


def write_html(recording: Recording, path: str | Path) -> None:
    """Write the page: ground truth, prediction as a ghost, both paths, target, and the summary in a corner."""
    write_whole(path, page_of(recording).encode())


def framed(recording: Recording, height: int = 480) -> str:
    """Return the page as an HTML frame to embed in another page, for instance a notebook. height [pixels]."""
    return f'<iframe srcdoc="{escape(page_of(recording))}" width="100%" height="{height}" frameborder="0"></iframe>'


def page_of(recording: Recording) -> str:
    """Return the page as HTML."""
    server = open_server(port=0)
    try:
        stage = Stage(server, recording.scene, recording.target, recording.traced)
        stage.frame(points_in_view(recording))
        miss = stage.lane.trace(recording.path, recording.predicted_path)

        def show(row: int) -> None:
            stage.lane.show(
                recording.states[row],
                prediction=recording.predicted_at(row),
                reference=recording.reference_at(row),
                estimate=recording.estimate_at(row),
            )

        page = animation_html(server, len(recording.states), recording.scene.dt, show)
    finally:
        close_server(server)
    facts = {"nearest to the target": f"{100.0 * miss:.1f} cm", **recording.summary}
    return with_caption(
        page, recording.title or "Replay", [*(f"{name}: {text}" for name, text in facts.items()), LEGEND]
    )


def animation_html(server: viser.ViserServer, rows: int, dt: float, show: Callable[[int], None]) -> str:
    """Return HTML that plays a server's scene, set by `show` for every n-th row of a motion with a row per `dt` [s].

    n is such that frames are about `FRAME` apart.
    """
    # Without any map, Viser's player shows its own one at first, anew in each round.
    server.scene.configure_environment_map("studio", environment_intensity=0.0)
    serializer, stride = server.get_scene_serializer(), max(1, round(FRAME / dt))
    for row in range(0, rows, stride):
        show(row)
        serializer.insert_sleep(stride * dt)
    return serializer.as_html()


def with_caption(page: str, title: str, lines: list[str]) -> str:
    """Return the page with a title, and with the title and these lines in a corner."""
    title = escape(title)
    caption = "<br>".join([f"<b>{title}</b>", *map(escape, lines)])
    head, _, rest = page.partition("<title>")
    page = f"{head}<title>{title}{rest[rest.index('</title>') :]}"
    body = page.rindex("</body>")
    return page[:body] + _CAPTION.format(caption) + page[body:]
