"""The cameras of a trajectory, with the motion that its own rows give."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, cast

from schemas.errors import ConfigError, LunargrError
from stages.physics.cameras.pinhole import Pinhole
from stages.render.config import SUN, Config
from stages.render.files import SIDES
from stages.render.motion import rates, set_in_motion
from stages.render.renderer import Renderer
from stages.render.setup import find_camera
from stages.render.sight import ground_height
from stages.render.trajectory import ViewRow, read_trajectory


class Shot(NamedTuple):
    """One view of a trajectory. config : its own settings"""

    view_id: str
    camera: Pinhole
    config: Config


def find_flight(renderer: Renderer, config: Config, table: Path) -> list[Shot]:
    """The frames of a table's rows. Raises LunargrError."""
    rows = read_trajectory(table)
    frames = []
    for row in rows:
        with named_row(table, row.view_id):
            row_config = _with_row(renderer, config, row)
            frames.append(Shot(row.view_id, cast(Pinhole, find_camera(renderer.surface, row_config)), row_config))
    cameras = _in_motion(renderer, [frame.camera for frame in frames], rows, table)
    moving = [frame._replace(camera=camera) for frame, camera in zip(frames, cameras, strict=True)]
    return moving if config.rig is None else [shot for frame in moving for shot in _both_sides(frame, config.rig)]


def _both_sides(shot: Shot, baseline: float) -> list[Shot]:
    """A camera and the one ``baseline`` m to its right."""
    view_id, camera, config = shot
    right = replace(camera, centre=camera.centre + baseline * camera.rotation[:, 0])
    return [Shot(f"{view_id}_{side}", each, config) for side, each in zip(SIDES, (camera, right), strict=True)]


@contextlib.contextmanager
def named_row(table: Path, view_id: str) -> Iterator[None]:
    """Errors name the table and its row."""
    try:
        yield
    except LunargrError as error:
        raise type(error)(f"{table.name}, {view_id}: {error}") from None


def _with_row(renderer: Renderer, config: Config, row: ViewRow) -> Config:
    """The configuration of one row: what the row leaves empty stays as it is; a row's Sun replaces the whole Sun."""
    if config.camera and row.fov_deg is not None:
        raise ConfigError("expected no 'fov_deg' with `camera`, which has its own; empty the column.")
    longitude, latitude, altitude = row.position
    if row.height is not None:
        altitude = ground_height(renderer.surface, longitude, latitude, float("nan")) + row.height
        if altitude != altitude:
            raise ConfigError("'height_m': expected known ground below the camera, found none; give 'altitude_m'.")
    config = replace(
        config,
        position=(longitude, latitude, altitude),
        look_at=row.look_at if row.look_at is not None or row.quaternion is not None else config.look_at,
        quaternion=row.quaternion,
        roll_deg=row.roll_deg,
        fov_deg=row.fov_deg if row.fov_deg is not None else config.fov_deg,
    )
    return replace(config, **{**dict.fromkeys(SUN), **row.sun}) if row.sun else config  # type: ignore[arg-type]


def _in_motion(renderer: Renderer, cameras: list[Pinhole], rows: Sequence[ViewRow], table: Path) -> list[Pinhole]:
    """The cameras with the mean rates from each row's neighbour before to the one after; as they are where rows have no times."""
    sensor = renderer.sensor
    times = [row.seconds for row in rows]
    if sensor is None or not (sensor.exposure_s or sensor.line_time_s):
        return cameras
    if len(rows) < 2 or all(time is None for time in times):
        if sensor.line_time_s:
            raise ConfigError(f"{table}: expected two rows with 'time_s' or 'time' for the sensor's 'line_time_s'.")
        return cameras
    moving = []
    for k, camera in enumerate(cameras):
        before, after = max(0, k - 1), min(len(rows) - 1, k + 1)
        start, end = times[before], times[after]
        if start is None or end is None or start == end:
            raise ConfigError(
                f"{table.name}, {rows[k].view_id}: expected different times of neighbouring rows, found none."
            )
        moving.append(set_in_motion(camera, *rates(cameras[before], cameras[after], end - start), sensor))
    return moving
