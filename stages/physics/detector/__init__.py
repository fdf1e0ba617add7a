"""The one detector model: from I/F on the focal plane to digital numbers, for `simulate` and `render`.

`stages.effects` and `simulate`'s hidden effects describe what a detector does beyond it; waves over the columns and noise are shared.
"""

from __future__ import annotations

from stages.physics.detector.sensor import Exposure, Sensor, preset_names, read_sensor, sensor_file

__all__ = ["Exposure", "Sensor", "preset_names", "read_sensor", "sensor_file"]
