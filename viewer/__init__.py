"""The viewer: draws scenes, states and plans in the browser, in a file and in a picture; knows no task."""

from viewer.app import LivePage, PageClosedError, show
from viewer.film import check_film, write_film
from viewer.overlay import Overlay, write_overlay
from viewer.picture import kick_picture
from viewer.recording import Approach, Recording, nearest_approach
from viewer.replay import framed, page_of, write_html
from viewer.scene_view import SceneView
from viewer.server import require_address
from viewer.settings import Offer, Push, Settings

__all__ = [
    "Approach",
    "LivePage",
    "Offer",
    "Overlay",
    "PageClosedError",
    "Push",
    "Recording",
    "SceneView",
    "Settings",
    "check_film",
    "framed",
    "kick_picture",
    "nearest_approach",
    "page_of",
    "require_address",
    "show",
    "write_film",
    "write_html",
    "write_overlay",
]
