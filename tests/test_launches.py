"""Launches are told apart by how the ball is struck."""

import numpy as np

from larp_model.launches import Launches


def test_kinds_of_launches_are_what_they_are_called() -> None:
    by = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, 0, 0]], bool)
    found = Launches(
        error=np.array([0.01, 0.02, 0.03, 0.04, np.inf]),
        angle=np.array([1.0, 2.0, 3.0, 4.0, 180.0]),
        speed=np.array([1.6, 5.0, 8.9, 9.0, 20.0]),
        lying=np.array([True, True, False, False, False]),
        steps=np.array([1, 1, 3, 2, 2]),
        by=by,
        links=("left_foot", "right_foot", "right_shin"),
    )
    rows = {name: np.flatnonzero(which).tolist() for name, which in found.kinds.items()}
    assert rows == {
        "ball on the ground": [0, 1],
        "ball in the air": [2, 3, 4],
        "below 2 m/s": [0],
        "2 to 9 m/s": [1, 2],
        "9 to 14 m/s": [3],
        "above 14 m/s": [4],
        "one step": [0, 1],
        "two steps": [3, 4],
        "three steps and more": [2],
        "by the foot": [0, 1, 4],
        "by the shin": [2],
        "by several links": [3],
        "pushes": [2],
    }
    summary = found.summary
    assert summary["count"] == 5 and summary["relative_error"]["median"] == 0.03
    assert summary["kinds"]["pushes"] == {
        "count": 1,
        "relative_error": {"median": 0.03, "p75": 0.03, "p90": 0.03},
        "angle_deg": {"median": 3.0, "p75": 3.0, "p90": 3.0},
    }
    nothing = found._replace(**{name: value[:0] for name, value in found._asdict().items() if name != "links"})
    assert nothing.summary == {"count": 0, "kinds": {}}
