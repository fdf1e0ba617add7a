"""pairs.h5 in every layout that other programs write reads alike, and what our own keeps of each number."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from schemas import ArtefactError, InputError
from schemas.packing import Packing, pack, read
from stages.pairs.reader import PairReader

N, SIZE = 20, 128
FILL = np.float32(9.969209968386869e36)  # netCDF's default
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
    stored = np.where(np.isfinite(values), values, FILL)
    options = {"chunks": (1, 64, 32), "scaleoffset": DECIMALS[name], "fillvalue": FILL}
    file.create_dataset(name, data=stored, **options).attrs["_FillValue"] = FILL


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
    write(tmp_path / "p.h5", data, layout)
    order = np.random.default_rng(7).permutation(N)
    with PairReader(tmp_path / "p.h5") as reader:
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


def test_a_file_truncated_behind_the_readers_back_says_so(data, tmp_path):
    path = tmp_path / "p.h5"
    write(path, data, scale_offset)
    with PairReader(path) as reader:
        with open(path, "r+b") as file:
            file.truncate(path.stat().st_size // 2)
        with pytest.raises(ArtefactError, match="cannot be read to the end"):
            reader.batch(np.arange(N))


@pytest.mark.parametrize("low, high", [(-30.0, 30.0), (-2134.56, -1821.4), (0.0, 0.0), (8e7, 8e7 + 3.0), (-1e-6, 1e-6)])
def test_packed_numbers_are_off_by_half_a_step_at_most(low, high, rng, tmp_path):
    """The finest power of two that reaches the whole range; single precision decodes it exactly; unknown stays unknown."""
    packing = Packing.over(low, high)
    values = rng.uniform(low, high, (40, 40)).astype(np.float32)
    values[0, :2], values[3, 4] = (low, high), np.nan
    with h5py.File(tmp_path / "a.h5", "w") as file:
        data = file.create_dataset("a", (40, 40), "i2")
        data.attrs.update({"scale_factor": packing.step, "add_offset": packing.offset, "_FillValue": np.int16(-32768)})
        data[...] = pack(data, values)
        found, codes = read(data, ...), data[...].astype(float)
    known = np.isfinite(values)
    np.testing.assert_array_equal(np.isfinite(found), known)
    np.testing.assert_array_equal(found[known], (codes * packing.step + packing.offset)[known])
    assert np.abs(found.astype(float) - values)[known].max() <= packing.step / 2 * (1 + 1e-6)
    assert packing.step <= max(2 * (high - low) / 65533, 2.0**-21 * max(abs(low), abs(high), 1e-30))


def test_values_that_16_bits_do_not_hold_are_refused(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        data = file.create_dataset("image", (2,), "i2")
        data.attrs.update({"scale_factor": 2.0**-15, "add_offset": 0.9375, "_FillValue": np.int16(-32768)})
        np.testing.assert_array_equal(pack(data, np.array([0.0, np.nan])), [-30720, -32768])
        with pytest.raises(InputError, match=r"image 'A': image: expected values of -0.06.* found 2; .*`exact`"):
            pack(data, np.array([0.1, 2.0]), "image 'A'")
