"""The page in a real browser: it plans what is set there, kicks, plays, keeps; whoever looks does not hold it up."""

from __future__ import annotations

import http.server
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import psutil
import pytest
import viser
from matplotlib.image import imread

from mpc import CEM
from tasks.kick import Kick
from tasks.live import Live
from tasks.live_choices import Choices
from tasks.presets import Preset
from viewer import LivePage, Settings, write_html
from viewer.camera import VIEWS

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page

playwright = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")]

FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
FEW = (CEM(samples=8, rounds=1, elites=2),)
QUICK, OTHER = Preset(FEW, FEW, interval=50, recovery=FEW), Preset(FEW, FEW, interval=25, recovery=FEW)
TARGET = np.array([3.0, 0.2, 0.4])
# A browser without a GPU draws so many pixels in time, and so few pictures that planner and other tests have the cores.
SMALL = (640, 400)
FEWER_FRAMES = """
    const draw = window.requestAnimationFrame.bind(window)
    window.requestAnimationFrame = callback => draw(() => setTimeout(() => callback(performance.now()), 400))
"""


@dataclass
class Served:
    """A page that is served, and the thread that plans for it."""

    page: LivePage
    live: Live
    thread: threading.Thread


def until(what: Callable[[], object], seconds: float = 120.0) -> None:
    """Wait until something is so; a browser that shares two cores with other tests may draw seconds later."""
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, "it took too long"
        time.sleep(0.05)


def planned_for(served: Served) -> Settings:
    """Return the settings of the last plan that waits to be executed."""
    assert served.live.planned_for is not None
    return served.live.planned_for


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    task = Kick.standard(substeps=4)
    tasks = {"embedded": lambda: task, "another": lambda: Kick.standard(substeps=4)}
    weights = {"none": None, "others": Path("others.json")}
    choices = Choices(tasks, {"quick": QUICK, "other": OTHER}, ("mujoco", "larp"), weights)
    with LivePage(port=0, offer=choices.offer(task)) as page:
        live = Live(page, choices, TARGET, tmp_path_factory.mktemp("kept"))
        thread = threading.Thread(target=live.serve)
        thread.start()
        until(lambda: page.mode == "planned", 120.0)
        page.panel._speed.value = 2.0  # type: ignore[misc]
        yield Served(page, live, thread)
        page.close()
        thread.join(30.0)
        assert not thread.is_alive(), "closing the page ends its planning"


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with playwright.sync_playwright() as begun:
        browser = begun.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


def give_way() -> None:
    """Lower the priority of the browser: as root, it raises that of its drawing process above the planner's."""
    for process in psutil.Process().children(recursive=True):
        with suppress(psutil.Error):
            if "chrom" in process.name():
                process.nice(10)


def opened(browser: Browser, served: Served, size: tuple[int, int] = SMALL) -> Page:
    seen = browser.new_page(viewport={"width": size[0], "height": size[1]})
    seen.add_init_script(FEWER_FRAMES)
    before = len(served.page._clients.views)
    seen.goto(served.page.address)
    seen.get_by_text("LARP-MPC").first.wait_for()
    until(lambda: len(served.page._clients.views) > before)
    give_way()
    return seen


@pytest.fixture(scope="module")
def seen(browser: Browser, served: Served) -> Iterator[Page]:
    """One page for all tests, for opening one takes seconds where there is no GPU."""
    page = opened(browser, served)
    page.get_by_role("tab", name="Kick").wait_for()
    yield page
    page.close()


def again(seen: Page) -> None:
    """Load the page anew, which the browser refuses for as long as it still changes from the page before."""

    def loads() -> bool:
        try:
            seen.reload(wait_until="commit")
        except playwright.Error as refused:
            assert "Not attached to an active page" in refused.message, refused
            return False
        return True

    until(loads)


def kick_button(seen: Page) -> Locator:
    """The button that kicks; its key does not while a control has the keyboard."""
    return seen.get_by_role("button", name="Kick", exact=True)


@pytest.fixture(autouse=True)
def settings_are_left_as_found(served: Served) -> Iterator[None]:
    """Set the controls back where a test failed half-way, and say what the page said: others go on from there."""
    page, controls = served.page, served.page.panel._controls.values()
    before = [control.value for control in controls]
    yield
    print(page.settings, page.panel._text.content, sep="\n")
    for control, value in zip(controls, before, strict=True):
        if control.value != value:
            control.value = value


@pytest.fixture
def played(seen: Page, served: Served) -> Page:
    """The page, on which a kick is played."""
    if served.page.recording is None:
        kicks(served, kick_button(seen).click)
    return seen


def pixels(seen: Page) -> np.ndarray:
    return np.asarray(imread(BytesIO(seen.screenshot())))[..., :3]


def changed_share(before: np.ndarray, after: np.ndarray) -> float:
    """Return the share of a picture's pixels whose colour differs."""
    return float((np.abs(after - before).max(axis=-1) > 0.1).mean())


def placed(seen: Page, served: Served, point: np.ndarray) -> tuple[float, float]:
    """Return the position of a point (3,) [m] on the page, in pixels."""
    stage, (view, aspect) = served.page._stage, [*served.page._clients.views.values()][-1]
    assert stage is not None
    camera = stage.camera(next(each for each in VIEWS if each == view), aspect)
    box = seen.locator("canvas").first.bounding_box()
    assert box is not None
    across, up = camera(point)
    middle = box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"]
    return middle[0] + 0.5 * box["width"] * across, middle[1] - 0.5 * box["width"] * up


def drag(seen: Page, place: tuple[float, float], right: int = 0, up: int = 0) -> None:
    """Drag what is there by so many pixels, as slowly as the page can follow."""
    x, y = place
    seen.mouse.move(x, y)
    time.sleep(0.5)
    seen.mouse.down()
    for share in range(9):
        seen.mouse.move(x + right * share / 8, y - up * share / 8)
        time.sleep(0.1)
    seen.mouse.up()


def reset(seen: Page, served: Served) -> None:
    """Go back to the plan, and wait until the page has drawn it: two pictures in succession are the same."""
    if served.page.mode != "planned":
        seen.get_by_text("Reset", exact=True).click()
        until(lambda: served.page.mode == "planned")
    time.sleep(2.0)
    until(lambda: changed_share(pixels(seen), pixels(seen)) < 0.001)


def kicks(served: Served, ask: Callable[[], object]) -> None:
    """Ask for a kick, and wait until it is played."""
    before = served.live.run
    ask()
    until(lambda: served.live.run is not before and served.page.mode == "replay")


@pytest.mark.parametrize("size", [(1400, 900), (480, 800)], ids=["wide", "narrow"])
def test_the_page_is_not_blank_and_has_human_and_target_in_its_picture(
    size: tuple[int, int], browser: Browser, served: Served
) -> None:
    page = opened(browser, served, size)

    def is_drawn() -> bool:
        picture = pixels(page)
        red, green, blue = np.moveaxis(picture, -1, 0)
        magenta, blue = (red > green + 0.3) & (blue > green + 0.12), (blue > red + 0.15) & (blue > green + 0.05)
        return bool((np.ptp(picture, axis=-1) > 0.3).mean() > 0.002 and magenta.any() and blue.any())

    until(is_drawn)
    page.close()


def test_replay_runs_from_its_file_alone(played: Page, browser: Browser, served: Served, tmp_path: Path) -> None:
    assert served.page.recording is not None
    write_html(served.page.recording, tmp_path / "kick.html")
    page = browser.new_page(viewport={"width": SMALL[0], "height": SMALL[1]})
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto((tmp_path / "kick.html").as_uri())
    until(lambda: (np.ptp(pixels(page), axis=-1) > 0.3).mean() > 0.001)  # coloured, not blank
    page.close()
    assert not errors


def test_a_key_kicks_and_the_ball_moves(seen: Page, served: Served) -> None:
    kicks(served, lambda: seen.keyboard.press("k"))
    assert served.live.run is not None
    assert served.live.run.summary["touched"]
    path = served.live.run.recording.path
    assert np.linalg.norm(np.ptp(path, axis=0)) > 0.5
    column, row = map(round, placed(seen, served, path[0]))

    def start_at(time_s: float) -> np.ndarray:
        """Return the picture of the ball's place at the start, at another time of the replay."""
        served.page.panel.move(time_s - served.page.panel.time)
        time.sleep(1.0)
        return pixels(seen)[row - 10 : row + 10, column - 10 : column + 10]

    served.page.panel.playing = False
    until(lambda: changed_share(start_at(0.0), start_at(1.0)) > 0.1)  # it has left the place where it lay
    served.page.panel.playing = True


def test_what_is_dragged_changes_the_plan(seen: Page, served: Served) -> None:
    reset(seen, served)
    before, plans = served.page.settings.target, served.live.plans
    # The arrow that points up is one of few things whose place in the picture is known: above the target.
    drag(seen, placed(seen, served, np.add(before, (0.0, 0.0, 0.25))), up=40)
    until(lambda: served.page.settings.target != before)
    assert served.page.settings.target[2] > before[2]
    until(lambda: served.live.plans > plans and planned_for(served).target == served.page.settings.target)


def test_a_slider_changes_the_weight_of_its_cost_and_the_plan(seen: Page, served: Served) -> None:
    before = served.page.settings.terms["effort"]
    seen.get_by_role("tab", name="Costs").click()
    enter(seen, "effort", "2.5")
    until(lambda: served.page.settings.terms["effort"] == 2.5)
    until(lambda: planned_for(served).terms["effort"] == 2.5)
    seen.get_by_role("button", name="As they were").click()
    until(lambda: served.page.settings.terms["effort"] == before)


def beside(seen: Page, label: str) -> Locator:
    """Return the input beside a label."""
    return seen.locator("div", has=seen.get_by_text(label, exact=True)).last.locator("xpath=..").locator("input")


def enter(seen: Page, label: str, value: str) -> None:
    """Type a number beside a slider, anew where one that the page drew late came between selecting and typing."""
    number = beside(seen, label).last

    def typed() -> bool:
        number.fill(value)
        number.press("Enter")
        return float(number.input_value() or "nan") == float(value)

    until(typed)


@pytest.mark.parametrize(("setting", "arrow"), [("spot", (0.28, 0.0, 0.0)), ("roll", (0.2, 0.0, 0.35))])
def test_the_ball_is_dragged_to_where_it_lies_and_by_how_it_rolls(
    setting: str, arrow: tuple[float, ...], seen: Page, served: Served
) -> None:
    handles = served.page._handles
    assert handles is not None
    reset(seen, served)
    before = getattr(served.page.settings, setting)
    drag(seen, placed(seen, served, np.add(handles.ball_position, arrow)), right=20)
    until(lambda: getattr(served.page.settings, setting) != before)
    until(lambda: getattr(planned_for(served), setting) == getattr(served.page.settings, setting))


@pytest.mark.parametrize(
    ("label", "field", "value"),
    [
        ("Preset", "preset", "other"),
        ("Model", "dynamics", "larp"),
        ("Its weights", "weights", "others"),
        ("Reference", "reference", "another"),
        ("Sensors", "sensors", "lab"),
        ("Delay", "delay", "25 ms"),
    ],
    ids=["preset", "model", "weights", "reference", "sensors", "delay"],
)
def test_the_next_plan_is_by_what_is_chosen_from_a_list(
    label: str, field: str, value: str, seen: Page, served: Served
) -> None:
    seen.get_by_role("tab", name="Kick").click()
    before = getattr(served.page.settings, field)
    for chosen in (value, before):
        choose(seen, label, chosen)
        until(lambda: getattr(planned_for(served), field) == chosen, 120.0)  # noqa: B023


def test_the_next_plan_tries_as_much_as_fits_into_the_seconds_that_are_set(seen: Page, served: Served) -> None:
    seen.get_by_role("tab", name="Kick").click()
    usual = served.live.planners(planned_for(served))
    enter(seen, "Budget [s]", "5")
    until(lambda: planned_for(served).budget == 5.0, 240.0)
    (search,), (few,) = served.live.planners(planned_for(served)).first.optimizers, usual.first.optimizers
    assert (
        isinstance(search, CEM) and isinstance(few, CEM) and search.samples * search.rounds > few.samples * few.rounds
    )
    enter(seen, "Budget [s]", "0")
    until(lambda: planned_for(served).budget == 0.0)


def choose(seen: Page, label: str, value: str) -> None:
    """Choose from a list, again and again: the page closes it, or loses the choice, where settings arrive late."""
    control, option = beside(seen, label).first, seen.get_by_role("option", name=value, exact=True)

    def chosen() -> bool:
        if control.input_value() != value:
            if not option.is_visible():
                control.click()
            with suppress(playwright.TimeoutError):
                option.click(timeout=5_000)
        return control.input_value() == value

    until(chosen)


def test_time_stands_still_goes_step_by_step_and_goes_on(played: Page, served: Served) -> None:
    seen = played
    seen.keyboard.press("Space")
    until(lambda: not served.page.playing)
    panel = served.page.panel
    stood = panel.time
    time.sleep(0.3)
    assert panel.time == stood
    seen.get_by_text("Step", exact=True).click()
    until(lambda: panel.time == pytest.approx(stood + 0.01))
    seen.keyboard.press("Space")
    until(lambda: panel.time > stood + 0.1)


def test_a_kick_is_kept_opened_again_and_shown_beside_another(played: Page, served: Served) -> None:
    seen = played
    seen.get_by_role("tab", name="Kept").click()
    seen.get_by_role("button", name="Keep this kick").click()
    until(lambda: served.live.saved)
    (folder,) = served.live.saved.values()
    assert {path.name for path in folder.iterdir()} == {"summary.json", "kick.npz", "kick.png", "kick.html"}
    last = served.page.recording
    seen.get_by_role("button", name="Open", exact=True).click()
    until(lambda: served.page.recording is not None and served.page.recording is not last)
    found = served.page.recording
    assert found is not None and last is not None
    np.testing.assert_allclose(found.path, last.path, atol=1e-5)
    assert found.summary == last.summary
    seen.get_by_role("button", name="Show beside").click()
    until(lambda: served.page._beside is not None)
    seen.get_by_role("button", name="Take away what is beside").click()
    until(lambda: served.page._beside is None)


def test_the_clock_is_set_and_goes_at_the_speed_that_is_set(played: Page, served: Served) -> None:
    panel = served.page.panel
    panel.playing = False
    enter(played, "Time [s]", "0.5")
    until(lambda: panel.time == 0.5)
    enter(played, "Speed", "0.25")
    until(lambda: served.page.speed == 0.25)
    enter(played, "Speed", "2")
    until(lambda: served.page.speed == 2.0)
    panel.playing = True


@pytest.mark.parametrize(("key", "name", "row"), [("b", "the ball", -1), ("h", "the human", 0)])
@pytest.mark.parametrize("by", ["key", "button"])
def test_a_push_moves_the_body_that_it_is_for(
    by: str, key: str, name: str, row: int, seen: Page, served: Served
) -> None:
    seen.get_by_role("tab", name="Kick").click()
    button = seen.get_by_text(name, exact=True)
    if not button.is_visible():
        seen.get_by_text("Push", exact=True).first.click()
        button.wait_for()
    enter(seen, "left", "2.5")
    until(lambda: served.page.push("ball").change[1] == 2.5)
    before = served.live.run
    kick_button(seen).click()
    until(lambda: served.page.mode == "running")
    seen.keyboard.press(key) if by == "key" else button.click()
    until(lambda: served.live.run is not before)
    assert served.live.run is not None
    change = np.diff(served.live.run.states[:, row, 8])  # of the velocity to the left
    assert change.max() > 1.5, "2.5 m/s is set"


def unfolded(seen: Page, label: str) -> Locator:
    """Return a control under "View", which is folded up at first, by its label."""
    found = seen.get_by_text(label, exact=True)
    if not found.is_visible():
        seen.get_by_text("View", exact=True).click()
        found.wait_for()
        time.sleep(1.0)  # it unfolds
    return found


@pytest.mark.parametrize("view", [*VIEWS, "follow"])
def test_each_client_looks_from_where_it_likes(view: str, played: Page, served: Served) -> None:
    unfolded(played, view).click()
    until(lambda: [each for each, _ in served.page._clients.views.values()] == [view])
    ((_, client),) = served.page._server.get_clients().items()
    stage = served.page._stage
    assert stage is not None
    if view in VIEWS:
        until(lambda: np.allclose(client.camera.position, stage.camera(view, client.camera.aspect).position, atol=0.05))


@pytest.mark.parametrize("ghost", ["prediction", "reference", "estimate", "fan"])
def test_ghosts_are_seen_only_if_wished_for(ghost: str, played: Page, served: Served) -> None:
    unfolded(played, f"show {ghost}")
    for shown in (False, True):
        beside(played, f"show {ghost}").last.click(force=True)
        until(lambda: (ghost in served.page.panel.ghosts) == shown)  # noqa: B023


@pytest.mark.parametrize(("kind", "begins"), [("html", b"<!do"), ("png", b"\x89PNG"), ("gif", b"GIF8")])
def test_what_is_played_can_be_downloaded(kind: str, begins: bytes, played: Page, tmp_path: Path) -> None:
    button = unfolded(played, kind)
    with played.expect_download(timeout=300_000) as begun:
        button.click()
    begun.value.save_as(tmp_path / "file")
    assert (tmp_path / "file").read_bytes()[:4] == begins


def test_what_sensors_show_is_played_beside_the_truth(seen: Page, served: Served) -> None:
    seen.get_by_role("tab", name="Kick").click()
    choose(seen, "Sensors", "noisy")
    until(lambda: planned_for(served).sensors == "noisy")
    kicks(served, kick_button(seen).click)
    recording = served.page.recording
    assert recording is not None and recording.estimated is not None
    choose(seen, "Sensors", "perfect")
    until(lambda: planned_for(served).sensors == "perfect")
    error = np.linalg.norm((recording.estimated - recording.states[:-1])[..., :3], axis=-1)
    assert 0.0 < np.median(error) < 0.05


def test_an_interrupted_kick_leaves_no_thread_that_plans(seen: Page, served: Served) -> None:
    seen.get_by_role("tab", name="Kick").click()
    choose(seen, "Model", "larp")  # whose plans are quick enough for real time
    until(lambda: planned_for(served).dynamics == "larp")
    kick_button(seen).click()
    until(lambda: served.page.mode == "running" and any("planning" in thread.name for thread in threading.enumerate()))
    seen.get_by_text("Reset", exact=True).click()
    until(lambda: served.page.mode == "planned")
    assert not any("planning" in thread.name for thread in threading.enumerate())
    choose(seen, "Model", "mujoco")
    until(lambda: planned_for(served).dynamics == "mujoco")


def test_a_page_of_elsewhere_cannot_connect(browser: Browser, served: Served, tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text("<title>elsewhere</title>")
    handler = partial(http.server.SimpleHTTPRequestHandler, directory=str(tmp_path))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as foreign:
        threading.Thread(target=foreign.serve_forever, daemon=True).start()
        page = browser.new_page()
        page.goto(f"http://127.0.0.1:{foreign.server_port}")
        asked = """address => new Promise(done => {
            const socket = new WebSocket(address, "viser-v%s");
            socket.onopen = () => done("let in");
            socket.onerror = () => done("refused");
        })"""
        said = page.evaluate(asked % viser.__version__, served.page.address.replace("http", "ws"))
        page.close()
        foreign.shutdown()
    assert said == "refused"


def test_reloads_do_not_hold_up_who_plans(played: Page, served: Served) -> None:
    seen = played
    before = served.live.run
    kick_button(seen).click()
    for _ in range(4):
        again(seen)
    until(lambda: served.live.run is not before)
    assert served.live.run is not None and served.live.run.truth_error_m < np.inf
    until(lambda: len(served.page._clients.views) == 1)
