"""The viewer: draws scenes, states and plans in the browser, in a file and in a picture; knows no task."""

from viewer.app import LivePage, show
from viewer.film import check_film, write_film
from viewer.picture import kick_picture
from viewer.recording import Approach, Recording, nearest_approach
from viewer.replay import framed, write_html
from viewer.scene_view import SceneView

__all__ = [
    "Approach",
    "LivePage",
    "Recording",
    "SceneView",
    "check_film",
    "framed",
    "kick_picture",
    "nearest_approach",
    "show",
    "write_film",
    "write_html",
]
