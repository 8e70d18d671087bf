"""Views of a person from files: keypoints of one film or several and their cameras, or points in space."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from larp_model.errors import InputError
from tasks.pose import calibration, formats, joint_files
from tasks.pose import camera as cameras
from tasks.pose.camera import Lens, LoadedCamera
from tasks.pose.formats import LoadedPeople
from tasks.pose.points import Keypoints, require_inside
from tasks.pose.space import Space
from tasks.pose.synchronisation import match, synchronised
from tasks.pose.triangulation import triangulated
from tasks.pose.views import MIN_FRAMES, Views

# Misfit of two films beyond which their cameras, or the people in them, are not what they are taken for.
MAX_MISFIT = 0.15
# A film is told of that shows the person in a smaller share of the frames.
FEW_FRAMES = 0.9
# People of another film who are compared with the first one's person, those seen best.
MAX_PEOPLE = 20


class FilmedPerson(NamedTuple):
    """Person in films, and how these were read.

    position_known: whether the cameras' positions are known. people, crossed: of the first film, see
    `formats.LoadedKeypoints`. notes: what was found in the files, where they do not say it themselves.
    """

    views: Views
    position_known: bool
    people: int
    crossed: int
    notes: tuple[str, ...]


def load(
    keypoints: Sequence[Path],
    rates: Sequence[float] = (),
    size: tuple[float, float] | None = None,
    person: int | None = None,
    points: str | None = None,
    camera_files: Sequence[Path] = (),
    turned: int = 0,
) -> FilmedPerson:
    """Read a person's films; an InputError of one line names what is missing, or does not fit together.

    keypoints: of each film, see `formats.load_people`, or one file of points in space, see `joint_files.load`. rates:
    frames per second, of each film or of all. size, points: see there. person: in the first film, see `formats.load`.
    camera_files: of each film, or one that has all cameras; see `calibration.fields_of`. turned: see
    `LoadedCamera.turned`.
    """
    if not keypoints:
        raise InputError("keypoints is empty, but needs a file or a folder of a film")
    if any(map(joint_files.is_joint_file, keypoints)):
        return _in_space(keypoints, rates, camera_files)
    crowds = [
        formats.load_people(path, rate, size, points)
        for path, rate in zip(keypoints, _rates_of_films(rates, len(keypoints)), strict=True)
    ]
    files, notes = _files_of_films(camera_files, keypoints)
    lenses = [_camera_of(file, turned, crowd) for file, crowd in zip(files, crowds, strict=True)]
    first = crowds[0].keypoints(crowds[0].most_prominent if person is None else person)
    notes = [note for crowd in crowds for note in crowd.notes] + notes
    views = Views((_straightened(first.keypoints, lenses[0], crowds[0].name),), (lenses[0].camera,))
    if len(crowds) > 1:
        views, further_notes = _together(views.films[0], crowds, lenses)
        notes += further_notes
    return FilmedPerson(views, lenses[0].position_known, first.people, first.crossed, tuple(notes))


def _in_space(paths: Sequence[Path], rates: Sequence[float], camera_files: Sequence[Path]) -> FilmedPerson:
    """Return a person whose points are known in space."""
    if len(paths) > 1 or camera_files:
        argument, found = ("cameras", "is set") if camera_files else ("keypoints", f"are {len(paths)} files")
        raise InputError(f"{argument} {found}, but points in space are one file, and need no camera")
    (rate,) = _rates_of_films(rates, 1)
    joints = joint_files.load(paths[0], rate)
    return FilmedPerson(Views((joints.keypoints,), (Space(),)), True, 1, 0, joints.notes)


def _rates_of_films(rates: Sequence[float], films: int) -> Sequence[float | None]:
    """Return the frames per second of each film, None where they are in the files."""
    if len(rates) not in (0, 1, films):
        raise InputError(f"rate has {len(rates)} numbers, but needs one, or one for each of {films} films")
    return rates if len(rates) == films else [rates[0] if rates else None] * films


def _files_of_films(files: Sequence[Path], films: Sequence[Path]) -> tuple[Sequence[Path | None], list[str]]:
    """Return the camera file of each film, None for a film without one, and notes of which camera is which."""
    if not files and len(films) == 1:
        return [None], []
    if not files:
        raise InputError(f"cameras is empty, but {len(films)} films need a calibration with each one's camera")
    if len(files) == len(films):
        return files, []
    if len(files) > 1:
        raise InputError(f"cameras has {len(files)} files, but needs one, or one for each of {len(films)} films")
    calibration_file, names = files[0], calibration.names_of(files[0])
    in_films = [_name_in(film, names) for film in films]
    if None in in_films or len(set(in_films)) < len(films):
        if len(names) != len(films):
            raise InputError(
                f"cameras: {calibration_file.name} has {len(names)} ({', '.join(names)}), but films are {len(films)}, "
                f"whose names do not say which: give {calibration_file.name}:NAME for each"
            )
        in_films = [*names]
    notes = [f"{film.absolute().name}: camera {name}" for film, name in zip(films, in_films, strict=True)]
    return [Path(f"{calibration_file}:{name}") for name in in_films], notes


def _name_in(film: Path, names: Sequence[str]) -> str | None:
    """Return the longest of the cameras' names that a film's file or folder has in its own, if any."""
    key = _key("/".join(film.absolute().parts[-2:]))
    return max((name for name in names if len(_key(name)) > 2 and _key(name) in key), key=len, default=None)


def _key(name: str) -> str:
    return re.sub("[^a-z0-9]", "", name.lower())


def _camera_of(file: Path | None, turned: int, crowd: LoadedPeople) -> LoadedCamera:
    """Return a film's camera, one held by hand where it has no file."""
    if file is None:
        if crowd.size is None:
            raise InputError(
                "size is not known, but the images' width and height are needed, or a camera file with them"
            )
        camera = cameras.handheld(cameras.focal_length(cameras.FIELD_OF_VIEW, crowd.size[0]), crowd.size)
        return LoadedCamera(camera, Lens(np.full(2, camera.focal), camera.centre, np.zeros(5)), crowd.size, False)
    own_size = crowd.size if crowd.size is None or turned % 180 == 0 else (crowd.size[1], crowd.size[0])
    loaded = cameras.load(file, own_size).turned(turned)
    if crowd.size == (loaded.size[1], loaded.size[0]) != loaded.size:
        (width, height), needed = crowd.size, "0 or 180" if turned % 180 else "90 or 270"
        raise InputError(f"turned is {turned}, but images of {width:g} x {height:g} px need {needed} for {file.name}")
    return loaded


def _straightened(film: Keypoints, loaded: LoadedCamera, name: str) -> Keypoints:
    """Return a film without its lens' distortion."""
    require_inside(film, loaded.size, name)
    return loaded.lens.straightened(film)


def _together(
    film: Keypoints, crowds: Sequence[LoadedPeople], lenses: Sequence[LoadedCamera]
) -> tuple[Views, list[str]]:
    """Return the views of the first film's person, whom the other films show too, and notes of how they were found."""
    for crowd, loaded in zip(crowds, lenses, strict=True):
        if not loaded.position_known:
            raise InputError(f"cameras: that of {crowd.name} has no position, but several films need all cameras'")
    films, delays, notes = [film], [0.0], []
    for crowd, loaded in zip(crowds[1:], lenses[1:], strict=True):
        people = _people_of(crowd, loaded)
        try:
            found = match(film, lenses[0].camera, [other for _, other in people], loaded.camera)
        except InputError as error:
            raise InputError(f"{crowd.name} {error}") from None
        if found.misfit > MAX_MISFIT:
            raise InputError(
                f"cameras: half of the points in {crowd.name} are over {found.distance:.0f} px from where "
                f"{crowds[0].name} sees them: is it another camera, or another person?"
            )
        person, other = people[found.person]
        films.append(other)
        delays.append(found.delay)
        when = "later" if found.delay > 0.0 else "earlier"
        notes.append(f"{crowd.name}: person {person}, began {abs(found.delay):.3f} s {when}")
    views = synchronised(films, [loaded.camera for loaded in lenses], delays)
    points, distances = triangulated([loaded.camera for loaded in lenses], views.places, views.confidence, views.sigma)
    _require_standing(points)
    notes += [
        f"{crowd.name}: half of its points are within {np.median(known):.1f} px of where the cameras together see them"
        for crowd, of_film in zip(crowds, np.moveaxis(distances, 1, 0), strict=True)
        if (known := of_film[np.isfinite(of_film)]).size
    ]
    shown = ((views.confidence > 0.0).sum(axis=-1) >= 6).mean(axis=0)
    notes += [
        f"{crowd.name}: shows the person in {100.0 * share:.0f} % of the first film's frames"
        for crowd, share in zip(crowds, shown, strict=True)
        if share < FEW_FRAMES
    ]
    return views, notes


def _require_standing(points: np.ndarray) -> None:
    """Raise InputError where the cameras' world is not in metres, or z is not up, by the person in it (T, P, 3)."""
    shortest, longest = joint_files.LEGS
    if (length := joint_files.leg_length(points)) < shortest or length > longest:
        raise InputError(f"cameras: the person they see has legs of {length:.2g} m: their positions need metres")
    if (along := joint_files.axis_along(joint_files.upwards(points))) not in (None, "z"):
        raise InputError(f"cameras: the person they see stands along {along}: their world needs z up")


def _people_of(crowd: LoadedPeople, loaded: LoadedCamera) -> list[tuple[int, Keypoints]]:
    """Return the people of a film who are seen long enough, with their indices."""
    people: list[tuple[int, Keypoints]] = []
    refusal: InputError | None = None
    for person in [person for person in crowd.by_prominence if len(crowd.tracks[person]) >= MIN_FRAMES][:MAX_PEOPLE]:
        try:
            people.append((person, _straightened(crowd.keypoints(person).keypoints, loaded, crowd.name)))
        except InputError as error:  # somebody at the edge of the image is not the person who is searched
            refusal = refusal or error
    if refusal is not None and not people:
        raise refusal
    return people
