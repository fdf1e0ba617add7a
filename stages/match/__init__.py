"""`lunargr match`: do features of rendered images lie where those of the measured image lie?"""

from __future__ import annotations

from stages.match.run import Config, run

__all__ = ["Config", "run"]
