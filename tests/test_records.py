"""pairs.h5 in every layout that other programs write reads alike, and what our own keeps of each number."""

from __future__ import annotations

import contextlib
from pathlib import Path

import h5py
import numpy as np
import pytest

from schemas import PAIRS, ArtefactError, ArtefactWriter
from schemas.files.hdf5 import UNKNOWN
from schemas.reading import unpack
from stages.pairs.reader import PairReader
from stages.pairs.records import Mapping, Records

N, SIZE = 150, 128
FIELDS = ("elevation", "image", "valid", "sun_horizon_deg")
DECIMALS = {"elevation": 2, "image": 5, "sun_horizon_deg": 1}


@pytest.fixture(scope="module")
def data():
    """Smooth terrain with holes in some pairs; numbers on the steps that are kept, so that nothing is lost."""
    rng = np.random.default_rng(8)
    z = rng.normal(size=(N, SIZE, SIZE)).cumsum(1).cumsum(2) * 0.02 - 1500
    image = 0.05 + 0.01 * np.sin(z / 9) + rng.normal(0, 3e-4, z.shape)
    horizon = 20 * np.sin(z / 31)
    valid = np.ones(z.shape, np.uint8)
    valid[3, 10:30, 40:90] = valid[7] = valid[9, 5, 5] = 0
    z, image, horizon = (np.round(v, d).astype(np.float32) for v, d in ((z, 2), (image, 5), (horizon, 1)))
    image[valid == 0] = np.nan
    z[9, 5, 5] = z[11, :64, :64] = np.nan
    horizon[12] = 3.5  # one value: a chunk of no bits
    return {"elevation": z, "image": image, "valid": valid, "sun_horizon_deg": horizon}


def write(path, data, create):
    rng = np.random.default_rng(9)
    sun = rng.normal(size=(N, 3)) * 0.3 + [0, 0, 1]
    with h5py.File(path, "w") as file:
        for name in FIELDS:
            create(file, name, data[name])
        file["image"].attrs["units"] = "1"
        file["sun_direction_enu"] = sun / np.linalg.norm(sun, axis=1, keepdims=True)
        file["camera_position_enu"] = np.tile([0.0, 0.0, 5e4], (N, 1))
        for name in ("longitude_deg", "latitude_deg", "image_index", "split"):
            file[name] = np.zeros(N)
        file["site"] = np.arange(N)
        file["image_id"] = np.array(["A"], dtype=h5py.string_dtype())
        file.attrs.update({"gsd_m": 5.0, "body_radius_m": 1737400.0})


def contiguous(file, name, values):
    file[name] = values


def chunked(file, name, values):
    file.create_dataset(name, data=values, chunks=(1, SIZE, SIZE))


def zipped(file, name, values):
    file.create_dataset(name, data=values, chunks=(4, 32, SIZE), compression="gzip", shuffle=True)


def big_endian(file, name, values):
    file.create_dataset(name, data=values.astype(">f8"), chunks=(1, 64, SIZE))


def scale_offset(file, name, values):
    if name == "valid":
        file.create_dataset(name, data=values, chunks=(1, SIZE, SIZE), compression="gzip", shuffle=True)
        return
    stored = np.where(np.isfinite(values), values, UNKNOWN)
    options = {"chunks": (1, 64, 32), "scaleoffset": DECIMALS[name], "fillvalue": UNKNOWN}
    file.create_dataset(name, data=stored, **options).attrs["_FillValue"] = UNKNOWN


def packed_integers(file, name, values):
    if name == "valid":
        file.create_dataset(name, data=values.astype(np.int16), chunks=(1, SIZE, SIZE))
        return
    step = 10.0 ** -DECIMALS[name]
    stored = np.where(np.isfinite(values), np.round(np.nan_to_num(values).astype(float) / step) + 7, -(2**30))
    file.create_dataset(name, data=stored.astype(np.int32), chunks=(1, SIZE, SIZE), scaleoffset=0)
    file[name].attrs.update({"scale_factor": step, "add_offset": -7 * step, "_FillValue": np.int32(-(2**30))})


def a_view(file, name, values):
    source = Path(f"{file.filename}.{name}")
    with h5py.File(source, "w") as other:
        other[name] = values
    layout = h5py.VirtualLayout(values.shape, values.dtype)
    layout[...] = h5py.VirtualSource(source.name, name, values.shape)
    file.create_virtual_dataset(name, layout)


def missing_values(file, name, values):
    """Unknown values in two spellings, neither of them the fill value."""
    stored = np.where(np.isfinite(values), values, np.float32(-9999))
    stored[:5][~np.isfinite(values[:5])] = -8888
    data = file.create_dataset(name, data=stored, chunks=(1, SIZE, SIZE))
    if name != "valid":
        data.attrs["missing_value"] = np.array([-9999, -8888], np.float32)


LAYOUTS = [missing_values, contiguous, chunked, zipped, big_endian, scale_offset, packed_integers, a_view]


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda f: f.__name__)
def test_every_layout_reads_alike(layout, data, tmp_path):
    """Few pairs (through HDF5), many (through our own reader), one thread and several: h5py's numbers."""
    write(tmp_path / "p.h5", data, layout)
    for threads, count in ((1, 5), (1, N), (3, N)):
        order = np.random.default_rng(count).permutation(N)[:count] if count == N else np.array([3, 7, 9, 11, 12])
        with PairReader(tmp_path / "p.h5", threads=threads) as reader:
            batch = reader.batch(order)
        sure = (data["valid"] == 1) & np.isfinite(data["elevation"]) & np.isfinite(data["image"])
        np.testing.assert_array_equal(batch.valid.numpy(), sure[order])
        z, known = batch.observation.elevation.numpy(), np.isfinite(data["elevation"][order])
        np.testing.assert_allclose(z[known], data["elevation"][order][known], rtol=1.5e-7)
        assert np.isfinite(z).all()
        image = np.nan_to_num(data["image"][order])
        np.testing.assert_allclose(batch.image.numpy(), image, rtol=1e-6, atol=1e-9)
        horizon = np.radians(data["sun_horizon_deg"][order])
        np.testing.assert_allclose(batch.observation.sun_horizon.numpy(), horizon, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("decimals", [0, 2, 5])
@pytest.mark.parametrize("fill", [None, UNKNOWN, np.float32(0)])
def test_scale_offset_is_decoded_bit_for_bit_as_hdf5_does(decimals, fill, rng, tmp_path):
    """Any numbers, not only round ones: wide ranges, which HDF5 stores whole, and constants, with and without a fill value."""
    spread = 10.0 ** rng.uniform(-4, 9, N)
    values = (rng.normal(size=(N, SIZE, SIZE)) * spread[:, None, None]).astype(np.float32)
    values[5] = 2.5
    values[6, ::3] = values[8] = 0 if fill is None else fill
    with h5py.File(tmp_path / "p.h5", "w") as file:
        options = {} if fill is None else {"fillvalue": fill}
        file.create_dataset("a", data=values, chunks=(1, 32, SIZE), scaleoffset=decimals, **options)
    with h5py.File(tmp_path / "p.h5") as file, contextlib.closing(Mapping(tmp_path / "p.h5")) as mapping:
        records = Records(file["a"], mapping)
        records.prepare(N)
        out = records.empty(N)
        records.read_into(out, np.arange(N))
        assert records.packed
        np.testing.assert_array_equal(out.view(np.uint32), file["a"][...].view(np.uint32))


def test_a_truncated_file_says_so(data, tmp_path):
    path = tmp_path / "p.h5"
    write(path, data, scale_offset)
    with PairReader(path) as reader:
        reader.batch(np.arange(N))
        with open(path, "r+b") as file:
            file.truncate(path.stat().st_size // 2)
        with pytest.raises(ArtefactError, match="ends early"):
            reader.batch(np.arange(N))


def test_decimals_are_kept_and_unknown_stays_unknown(data, tmp_path):
    """The writer's error is half a step; what it does not know is NaN to CF readers, in shards and in one piece."""
    sizes = {"pair": N, "y": SIZE, "x": SIZE, "enu": 3, "frame": 1}
    rng = np.random.default_rng(2)
    z = data["elevation"] + rng.uniform(-0.005, 0.005, data["elevation"].shape).astype(np.float32)
    with (
        pytest.raises(RuntimeError, match="written without"),
        ArtefactWriter(tmp_path / "a.h5", PAIRS, sizes) as writer,
    ):
        target = writer.dataset("elevation", decimals=2)
        for k in range(N):
            target[k] = np.where(np.isfinite(z[k]), z[k], target.fillvalue)
        found = unpack(target, target[...])
        np.testing.assert_array_equal(np.isnan(found), np.isnan(z))
        known = np.isfinite(z)
        assert np.abs(found[known] - z[known]).max() < 0.0052
        assert target.id.get_storage_size() < 0.5 * z.nbytes
