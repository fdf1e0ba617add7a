"""What the brightness of maps and renderings is called, by the units of the images that they were learned from."""

from __future__ import annotations

# 'iof' or 'dn' -> short name, and the sentence for files
NAMES = {"iof": "I/F", "dn": "relative I/F"}
QUANTITIES = {
    "iof": "radiance factor I/F = pi r, including cos(incidence)",
    "dn": "relative I/F: pi r, including cos(incidence), times an unknown factor, as of images in DN",
}
