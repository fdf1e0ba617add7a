"""Arrays for a page: quantised, predicted, deflated.

A map becomes whole numbers; each is predicted from its neighbours and from maps packed before, as coefficients often
go together. What remains is small: up to three pixels share a byte of a deflate stream, which browsers inflate.
"""

from __future__ import annotations

import base64
import zlib
from dataclasses import asdict, dataclass, field

import numpy as np
from numpy.typing import NDArray

LARGEST = 1 << 21  # code, so that a browser's sums are exact
BASES = {1: 256, 2: 16, 3: 6}  # pixels that share a byte: values that each can take, the last one or more
ONE = 1 << 12  # of weights, which are whole numbers, so that a browser finds the same sums
HELPERS = 4  # earlier maps that a map is predicted from, at most
SAMPLE = 20_000  # pixels that weights are fitted to
OUTLIER = 50  # times the median
OWN = ((1, 0), (0, 1), (0, 0), (0, 2))  # row, column of a frame's 2 x 3 window whose (1, 1) is predicted
THEIRS = ((1, 1), (1, 0), (0, 1), (0, 0))


@dataclass(frozen=True)
class Packed:
    """A map as a page holds it: value = offset + step x code.

    share : pixels to a byte; helpers : numbers of earlier maps; weights : in units of 1 / ONE, of OWN, of THEIRS of each helper, and 1
    """

    data: bytes
    shape: tuple[int, int]
    offset: float
    step: float
    share: int
    helpers: list[int]
    weights: list[int]


@dataclass
class Packer:
    """Packs maps one after another; those of one shape help each other."""

    frames: list[NDArray[np.int64]] = field(default_factory=list)
    surprises: list[NDArray[np.float64]] = field(default_factory=list)  # at a sample of the pixels, 0 at outliers

    def pack(self, values: NDArray, known: NDArray[np.bool_], step: float) -> Packed:
        """Values (H, W), kept to half a ``step``; where not ``known`` (H, W) the page gets something smooth, to be ignored."""
        filled = fill_along_rows(values, known)
        offset = float(filled.min())
        step = max(step, (float(filled.max()) - offset) / LARGEST, 1e-30)
        frame = _framed(np.rint((filled - offset) / step).astype(np.int64))
        helpers, weights = self._fit(frame)
        terms = [_part(frame, at) for at in OWN]
        terms += [_part(self.frames[k], at) for k in helpers for at in THEIRS]
        total = np.full(values.shape, weights[-1] + ONE // 2)
        for weight, term in zip(weights, terms, strict=False):
            total += weight * term
        residual = _part(frame, (1, 1)) - (total >> 12)
        self.frames.append(frame)
        folded = np.where(residual >= 0, 2 * residual, -2 * residual - 1)
        data, share = min(((_deflated(folded.ravel(), k), k) for k in BASES), key=lambda found: len(found[0]))
        return Packed(data, (values.shape[0], values.shape[1]), offset, step, share, helpers, weights)

    def _fit(self, frame: NDArray[np.int64]) -> tuple[list[int], list[int]]:
        """Helpers and weights that leave little, from a sample of the pixels."""
        shape = frame.shape[0] - 1, frame.shape[1] - 2
        some = np.random.default_rng(0).choice(shape[0] * shape[1], min(SAMPLE, shape[0] * shape[1]), replace=False)

        def sample(whole: NDArray[np.int64], places: tuple[tuple[int, int], ...]) -> NDArray[np.float64]:
            return np.stack([_part(whole, at).ravel()[some] for at in places], axis=1).astype(float)

        wanted, own = sample(frame, ((1, 1),))[:, 0], sample(frame, OWN)
        bend = np.abs(wanted - own @ (1, 1, -1, 0))  # from the plane through three neighbours
        calm = bend <= OUTLIER * (np.median(bend) + 1)
        columns, helpers = [own, np.ones((len(own), 1))], []
        rest = calm * (wanted - np.hstack(columns) @ _robust(np.hstack(columns), wanted, calm))
        self.surprises.append(rest)
        for _ in range(HELPERS):
            able = [k for k, f in enumerate(self.frames) if f.shape == frame.shape and k not in helpers]
            alike = [abs(_correlation(rest, self.surprises[k])) for k in able]
            if not able or max(alike) < 0.1:
                break
            helpers.append(able[int(np.argmax(alike))])
            calm &= self.surprises[helpers[-1]] != 0
            columns.insert(-1, sample(self.frames[helpers[-1]], THEIRS))
            rest = calm * (wanted - np.hstack(columns) @ _robust(np.hstack(columns), wanted, calm))
        weights = _robust(np.hstack(columns), wanted, calm)
        return helpers, [int(w) for w in np.rint(ONE * np.clip(weights, -(1 << 18), 1 << 18))]


def _deflated(folded: NDArray[np.int64], share: int) -> bytes:
    """Numbers from 0 on (N,), ``share`` of them to a byte; by how much some are larger than that holds follows, four bytes each, plane by plane."""
    top = BASES[share] - 1
    digits = np.pad(np.minimum(folded, top), (0, -len(folded) % share)).reshape(-1, share)
    first = digits @ (top + 1) ** np.arange(share)
    more = (folded[folded >= top] - top).astype("<u4").view(np.uint8).reshape(-1, 4).T
    deflate = zlib.compressobj(6, memLevel=9, strategy=zlib.Z_FILTERED)
    return deflate.compress(first.astype(np.uint8).tobytes() + more.tobytes()) + deflate.flush()


def _framed(codes: NDArray[np.int64]) -> NDArray[np.int64]:
    """(H + 1, W + 2): a row of zeros before the first, at each row's begin what is above its first pixel, at its end its last again."""
    frame = np.zeros((codes.shape[0] + 1, codes.shape[1] + 2), np.int64)
    frame[1:, 1:-1] = codes
    frame[1:, 0] = frame[:-1, 1]
    frame[1:, -1] = codes[:, -1]
    return frame


def _part(frame: NDArray[np.int64], at: tuple[int, int]) -> NDArray[np.int64]:
    height, width = frame.shape[0] - 1, frame.shape[1] - 2
    return frame[at[0] : at[0] + height, at[1] : at[1] + width]


def _robust(columns: NDArray[np.float64], wanted: NDArray[np.float64], calm: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Weights of the columns (n, k) whose sum leaves little of ``wanted`` (n,) in the ``calm`` rows: of least sum of what is left, nearly."""
    scale, found = calm.astype(float), np.zeros(columns.shape[1])
    for _ in range(3):
        found = np.linalg.lstsq(columns * scale[:, None], wanted * scale, rcond=1e-9)[0]
        scale = calm / np.sqrt(np.maximum(np.abs(wanted - columns @ found), 0.7))
    return found


def _correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(a @ b) / max(float(np.sqrt((a @ a) * (b @ b))), 1e-30)


def spread_step(values: NDArray, known: NDArray[np.bool_], levels: int) -> float:
    """The step that divides the range between the 1st and 99th percentiles of the known values (H, W) into ``levels``."""
    sample = values[known]
    if sample.size == 0:
        return 1.0
    low, high = np.percentile(sample[:: max(1, sample.size // 500_000)], (1, 99))
    return float(high - low) / levels or max(abs(float(high)), 1e-6) * 1e-4


def fill_along_rows(values: NDArray, known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(H, W) in which unknown pixels take the last known value before them in reading order (the first known at the start)."""
    flat, mask = np.asarray(values, np.float64).ravel(), known.ravel()
    if not mask.any():
        return np.zeros(values.shape)
    last = np.maximum.accumulate(np.where(mask, np.arange(flat.size), -1))
    last[last < 0] = int(np.argmax(mask))
    return flat[last].reshape(values.shape)


class Blob:
    """Streams one after another, as one base64 text; each is found again by (start, length)."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self.size = 0

    def add(self, data: bytes) -> list[int]:
        """Append bytes; their place as [first, count]."""
        place = [self.size, len(data)]
        self._parts.append(data)
        self.size += len(data)
        return place

    def add_map(self, packed: Packed) -> dict[str, object]:
        """What the page needs to unpack a map."""
        return {**asdict(packed), "data": self.add(packed.data)}

    def add_mask(self, mask: NDArray[np.bool_]) -> dict[str, object]:
        """A mask (H, W) as a map of 0 and 1."""
        return self.add_map(Packer().pack(mask, np.ones_like(mask), 1.0))

    def text(self) -> str:
        """All of it in base64."""
        return base64.b64encode(b"".join(self._parts)).decode("ascii")
