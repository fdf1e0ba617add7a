"""The artefacts of the pipeline, a file each. `lunargr schema NAME`, the writers, the checks and the docs all read these."""

from __future__ import annotations

# isort: off
# in the order of the pipeline, in which they are listed
from schemas.artefacts.common import SPLITS, UNITS
from schemas.artefacts.scene import CROPS, SCENE
from schemas.artefacts.pairs import PAIRS
from schemas.artefacts.checkpoint import CHECKPOINT
from schemas.artefacts.svbrdf import SVBRDF
from schemas.artefacts.normalized import NORMALIZED
from schemas.artefacts.results import DIAGNOSIS, EVALUATION
from schemas.artefacts.truth import TRUTH

__all__ = [
    "CHECKPOINT",
    "CROPS",
    "DIAGNOSIS",
    "EVALUATION",
    "NORMALIZED",
    "PAIRS",
    "SCENE",
    "SPLITS",
    "SVBRDF",
    "TRUTH",
    "UNITS",
]
