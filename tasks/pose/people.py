"""People in the frames of a film: who is who from frame to frame, and who is seen best."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

# A person may be lost for this time [s]. Then the points may be this far from where they were, on average: at once
# [the person's size], and more with the time [sizes a second].
_LOST_SECONDS, _REACH_AT_ONCE, _REACH_PER_SECOND = 0.5, 0.25, 3.0


class Detection(NamedTuple):
    """Person in a frame: places [px] and confidence of points (N, 3), and a tracker's number if the file has one."""

    points: np.ndarray
    identity: float | None


Track = dict[int, Detection]  # one person's, by frame, in the order of the frames


def tracks_of(frames: list[list[Detection]], rate: float) -> list[Track]:
    """Return the people in order of appearance: by the file's own numbers, else by distance from frame to frame."""
    identities = [[detection.identity for detection in frame if detection.identity is not None] for frame in frames]
    # Without its tracker, AlphaPose gives everybody the same number.
    if not any(identities) or any(
        len(set(frame_identities)) < len(frame_identities) for frame_identities in identities
    ):
        return _by_distance(frames, rate)
    tracks: dict[float, Track] = {}
    for number, frame in enumerate(frames):
        for detection in frame:
            if detection.identity is not None:
                tracks.setdefault(detection.identity, {})[number] = detection
    return list(tracks.values())


def _by_distance(frames: list[list[Detection]], rate: float) -> list[Track]:
    tracks: list[Track] = []
    sizes: list[float] = []  # of each person, the largest so far [px]
    for number, frame in enumerate(frames):
        detected_sizes = [float(np.linalg.norm(np.ptp(_box(detection.points), axis=0))) for detection in frame]
        ages = [number - next(reversed(track_frames)) for track_frames in tracks]
        recent = [track for track, age in enumerate(ages) if age - 1 <= _LOST_SECONDS * rate]
        # Relative to the reach: a person who was lost for long must not take the place of one who is still there.
        costs = np.ones((len(recent), len(frame)))
        for row, track in enumerate(recent):
            last, reach = tracks[track][number - ages[track]], _REACH_AT_ONCE + _REACH_PER_SECOND * ages[track] / rate
            for column, detection in enumerate(frame):
                relative_distance = _distance(last.points, detection.points) / max(
                    sizes[track], detected_sizes[column], 1.0
                )
                costs[row, column] = min(relative_distance / reach, 1.0)
        pairs = zip(*linear_sum_assignment(costs), strict=True)
        track_of_column = {column: recent[row] for row, column in pairs if costs[row, column] < 1.0}
        for column, detection in enumerate(frame):
            track = track_of_column.get(column, len(tracks))
            if track == len(tracks):
                tracks.append({})
                sizes.append(0.0)
            tracks[track][number] = detection
            sizes[track] = max(sizes[track], detected_sizes[column])
    return tracks


def _distance(points: np.ndarray, others: np.ndarray) -> float:
    """Return the mean distance [px] of the points that both have, weighted by confidence; infinite without any."""
    weights = points[:, 2] * others[:, 2]
    in_both = weights > 0.0
    if not in_both.any():
        return np.inf
    return float(
        np.average(np.linalg.norm(points[in_both, :2] - others[in_both, :2], axis=-1), weights=weights[in_both])
    )


def _box(points: np.ndarray) -> np.ndarray:
    """Return the upper left and lower right corner (2, 2) [px] of the box around the detected points."""
    detected = points[points[:, 2] > 0.0, :2]
    return np.array([detected.min(axis=0), detected.max(axis=0)])


def prominence(track: Track) -> float:
    """Return the sum over the frames of mean confidence times height in the image [px]."""
    return sum(
        float(detection.points[:, 2].mean() * np.ptp(_box(detection.points)[:, 1])) for detection in track.values()
    )


def is_crossed(detection: Detection, frame: list[Detection]) -> bool:
    """Return whether another person's box in the frame and this one's share over half of the smaller of them."""
    own_box = _box(detection.points)
    for box in [_box(other.points) for other in frame if other is not detection]:
        overlap = (np.minimum(box[1], own_box[1]) - np.maximum(box[0], own_box[0])).clip(0.0)
        if np.prod(overlap) > 0.5 * min(np.prod(np.ptp(corners, axis=0)) for corners in (box, own_box)):
            return True
    return False
