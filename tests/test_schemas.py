"""Artefacts: valid netCDF-4, checked on opening, whole or absent."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import textwrap

import h5py
import numpy as np
import pytest

from schemas import PAIRS, SCHEMAS, ArtefactError, ArtefactWriter, ConfigError, open_artefact, read_kind
from schemas.checks import parse_json
from schemas.files.inputs import Inputs
from schemas.files.outputs import Target, check_apart, protect
from schemas.packing import unpack
from schemas.provenance import chain
from schemas.reading import read_config

PLACE = {"gsd_m": 5.0, "body_radius_m": 1737400.0}


def write_pairs(path, place=PLACE, **change):
    sizes = {"pair": 2, "y": 4, "x": 4, "enu": 3, "frame": 1}
    with ArtefactWriter(path, PAIRS, sizes, attributes=place, **change) as writer:
        for v in PAIRS.variables:
            if v.required:
                shape = [sizes[d] for d in v.dims]
                values = np.arange(np.prod(shape)).reshape(shape)
                if v.name == "sun_direction_enu":
                    values = np.tile([0.0, 0.6, 0.8], (sizes["pair"], 1))
                elif v.name == "image_index":
                    values = np.zeros(shape)
                elif v.dtype == "u1":
                    values = values % 2
                writer.write(v.name, ["A"] if v.dtype == "string" else values)
    return path


@pytest.mark.parametrize("engine", ["h5netcdf"])
def test_pairs_open_in_xarray_with_names_units_and_flags(tmp_path, engine):
    xarray = pytest.importorskip("xarray")
    with xarray.open_dataset(write_pairs(tmp_path / "pairs.h5"), engine=engine) as data:
        assert data["elevation"].dims == ("pair", "y", "x")
        assert data["elevation"].attrs["units"] == "m"
        assert data["split"].attrs["flag_meanings"] == "train validation test"
        assert list(data["image_id"].values) == ["A"]
        assert data.attrs["Conventions"].startswith("CF")
        np.testing.assert_array_equal(data["elevation"].values.ravel(), np.arange(32))


def test_every_dimension_has_a_scale(tmp_path):
    with h5py.File(write_pairs(tmp_path / "pairs.h5")) as file:
        for v in PAIRS.variables:
            if v.name in file and v.name not in PAIRS.dims:
                for axis, dim in enumerate(v.dims):
                    assert file[v.name].dims[axis][0].name == f"/{dim}"


def test_declared_schemas_are_consistent():
    for schema in SCHEMAS.values():
        for v in schema.variables:
            assert set(v.dims) <= set(schema.dims), (schema.name, v.name)
            assert v.dtype == "string" or v.unit, (schema.name, v.name)
            assert v.dtype not in ("f2", "float16")


def test_a_failed_stage_leaves_nothing(tmp_path):
    path = tmp_path / "pairs.h5"
    with (
        pytest.raises(ValueError, match="in the middle"),
        ArtefactWriter(path, PAIRS, {"pair": 1, "y": 2, "x": 2, "enu": 3, "frame": 1}) as w,
    ):
        w.dataset("elevation")
        raise ValueError("in the middle")
    assert list(tmp_path.iterdir()) == []


def test_an_incomplete_artefact_is_a_bug_and_leaves_nothing(tmp_path):
    with (
        pytest.raises(RuntimeError, match="written without"),
        ArtefactWriter(tmp_path / "p.h5", PAIRS, {"pair": 1, "y": 2, "x": 2, "enu": 3, "frame": 1}),
    ):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name, value", [("gsd_m", np.inf), ("body_radius_m", -1.0)])
def test_an_artefact_that_cannot_be_read_again_gets_no_name(tmp_path, name, value):
    place = {"gsd_m": 5.0, "body_radius_m": 1737400.0, name: value}
    with pytest.raises(ArtefactError, match=rf"pairs\.h5: root attribute '{name}'.*; nothing was written") as caught:
        write_pairs(tmp_path / "pairs.h5", place)
    assert "partial" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_stage_leaves_nothing(tmp_path):
    code = textwrap.dedent(
        """
        import signal, sys, time
        signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where the tests run in the background
        from pathlib import Path
        from schemas import PAIRS, ArtefactWriter
        with ArtefactWriter(Path(sys.argv[1]), PAIRS, {"pair": 1, "y": 2, "x": 2, "enu": 3, "frame": 1}) as w:
            print("open", flush=True)
            time.sleep(60)
        """
    )
    child = subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path / "p.h5")],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert child.stdout is not None
    assert child.stdout.readline() == "open\n"
    child.send_signal(signal.SIGINT)
    assert child.wait(20) != 0
    child.stdout.close()
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_one_clear_line_and_leaves_nothing(tmp_path):
    resource = pytest.importorskip("resource")
    code = textwrap.dedent(
        f"""
        import os, resource, signal, sys
        from pathlib import Path
        import numpy as np
        from schemas import PAIRS, ArtefactWriter, InputError
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (200000, {resource.RLIM_INFINITY}))
        try:
            with ArtefactWriter(Path(sys.argv[1]), PAIRS, {{"pair": 8, "y": 256, "x": 256, "enu": 3, "frame": 1}}) as w:
                w.write("elevation", np.random.rand(8, 256, 256))
                w.file.flush()
        except InputError as error:
            print(error, flush=True)
            os._exit(3)  # as the command line does
        """
    )
    out = subprocess.run([sys.executable, "-c", code, str(tmp_path / "p.h5")], capture_output=True, text=True)
    assert "disk is full" in out.stdout, out
    assert (out.returncode, out.stderr) == (3, "")
    assert list(tmp_path.iterdir()) == []


def test_an_output_never_replaces_an_input_nor_an_existing_file(tmp_path):
    path = write_pairs(tmp_path / "pairs.h5")
    before = path.read_bytes()
    with protect(Inputs()), pytest.raises(ConfigError, match="`overwrite`"):
        write_pairs(path)
    with protect(Inputs([path]), [Target(path)], overwrite=True), pytest.raises(ConfigError, match="replace the input"):
        write_pairs(path)
    assert path.read_bytes() == before


def test_wrong_unit_missing_variable_and_wrong_size_are_named(tmp_path):
    path = write_pairs(tmp_path / "pairs.h5")
    with h5py.File(path, "r+") as file:
        file["elevation"].attrs["units"] = "km"
    with pytest.raises(ArtefactError, match=r"/elevation: expected units 'm', found 'km'; write it again"):
        open_artefact(path, PAIRS)
    with h5py.File(path, "r+") as file:
        file["elevation"].attrs["units"] = "m"
        del file["valid"]
    with pytest.raises(ArtefactError, match="/valid"):
        open_artefact(path, PAIRS)
    with h5py.File(path, "r+") as file:
        file["valid"] = np.zeros((3, 4, 4), "u1")
    with pytest.raises(ArtefactError, match="expected 2 along 'pair'"):
        open_artefact(path, PAIRS)


def test_another_stage_version_or_kind_of_file_is_refused(tmp_path):
    path = write_pairs(tmp_path / "pairs.h5")
    with pytest.raises(ArtefactError, match="expected a 'scene'"):
        open_artefact(path, SCHEMAS["scene"])
    with h5py.File(path, "r+") as file:
        file.attrs["schema_version"] = 99
    with pytest.raises(ArtefactError, match="expected version 2"):
        open_artefact(path, PAIRS)
    text = tmp_path / "text.h5"
    text.write_text("not HDF5")
    with pytest.raises(ArtefactError, match="another kind of file"):
        read_kind(text)
    os.truncate(path, path.stat().st_size // 2)
    with pytest.raises(ArtefactError, match="truncated"):
        open_artefact(path, PAIRS)
    with pytest.raises(ArtefactError, match="no such file"):
        open_artefact(tmp_path / "absent.h5", PAIRS)


def test_pairs_of_other_programs_need_no_lunargr_attributes(tmp_path):
    path = write_pairs(tmp_path / "pairs.h5")
    with h5py.File(path, "r+") as file:
        for name in ("lunargr_schema", "schema_version", "lunargr_version"):
            del file.attrs[name]
    with open_artefact(path, PAIRS) as file:
        assert "lunargr_schema" not in file.attrs and file["image"].shape[0] > 0


def write_foreign(path, **root):
    """pairs.h5 as another program may write it. root : its attributes, beside those that lunargr needs"""
    with h5py.File(write_pairs(path), "r+") as file:
        for name in set(file.attrs) - {"gsd_m", "body_radius_m"}:
            del file.attrs[name]
        for name, value in root.items():
            file.attrs[name] = value
    return path


@pytest.mark.parametrize(
    ("variable", "unit"),
    [
        ("longitude_deg", "degrees_east"),
        ("latitude_deg", "degree_north"),
        ("sun_horizon_deg", "degrees"),
        ("solar_distance_au", "AU"),
        ("elevation", "meters"),
        ("image", b"DN"),
        ("image", np.array(["1"], "S1")),
        ("image", h5py.Empty("S1")),
    ],
)
def test_units_that_cf_calls_equal_are_equal(tmp_path, variable, unit):
    path = write_foreign(tmp_path / "pairs.h5")
    with h5py.File(path, "r+") as file:
        if variable not in file:
            file[variable] = np.ones(1)
        file[variable].attrs["units"] = unit
    with open_artefact(path, PAIRS) as file:
        assert variable in file


@pytest.mark.parametrize("unit", ["degrees_west", "radian", b"\xff\xfe", 5])
def test_other_units_are_not(tmp_path, unit):
    path = write_foreign(tmp_path / "pairs.h5")
    with h5py.File(path, "r+") as file:
        file["longitude_deg"].attrs["units"] = unit
    with pytest.raises(ArtefactError, match=r"/longitude_deg: expected units 'degree', found .*; mend the program"):
        open_artefact(path, PAIRS)


@pytest.mark.parametrize(
    "root",
    [
        {"schema_version": "2", "lunargr_schema": "pairs"},
        {"schema_version": "1", "lunargr_schema": "pairs"},
        {"schema_version": np.float64(1)},
        {"inputs": "{}", "provenance": "[]", "config": "no JSON", "seed": "none", "history": b"\xff"},
    ],
)
def test_what_another_program_says_of_its_making_is_its_own_matter(tmp_path, root):
    path = write_foreign(tmp_path / "pairs.h5", **root)
    with open_artefact(path, PAIRS) as file:
        assert read_config(file) == {}
    assert chain(path)[-1].record is None


def test_another_programs_version_is_refused_in_words(tmp_path):
    path = write_foreign(tmp_path / "pairs.h5", lunargr_schema="pairs", schema_version="two")
    with pytest.raises(ArtefactError, match="expected version 2 of 'pairs', found 'two'; mend the program"):
        open_artefact(path, PAIRS)


@pytest.mark.parametrize("name", ["command", "history", "folder", "lunargr_version", "title", "Conventions"])
def test_text_that_is_no_utf_8_is_read(tmp_path, name):
    path = write_pairs(tmp_path / "pairs.h5")
    with h5py.File(path, "r+") as file:
        file.attrs[name] = b"made in K\xf6ln"
    open_artefact(path, PAIRS).close()
    record = chain(path)[-1].record
    assert record is not None
    assert "made in K" in str({"title": "made in K", "Conventions": "made in K"} | record)
    json.dumps(record, ensure_ascii=False).encode()


@pytest.mark.parametrize("deep", ["[" * 65 + "]" * 65, '{"a":' * 500 + "1" + "}" * 500, "[" * 100_000])
def test_json_is_of_few_levels(deep):
    with pytest.raises(ArtefactError, match="expected JSON of at most 64 levels"):
        parse_json(deep, "a.json")
    assert parse_json("[" * 64 + "]" * 64, "a.json")


def test_directions_have_length_1(tmp_path):
    path = write_pairs(tmp_path / "pairs.h5")
    with h5py.File(path, "r+") as file:
        file["sun_direction_enu"][0] = [0.0, 0.6, 0.9]
    with pytest.raises(ArtefactError, match=r"sun_direction_enu: expected vectors of length 1"):
        open_artefact(path, PAIRS)


def test_packed_numbers_are_scaled_and_moved(tmp_path):
    """As CF means them: value = stored x scale_factor + add_offset, fill values unknown."""
    with h5py.File(tmp_path / "packed.h5", "w") as file:
        data = file.create_dataset("height", data=np.array([0, 10, -32768], np.int16))
        data.attrs["scale_factor"], data.attrs["add_offset"], data.attrs["_FillValue"] = 0.5, 100.0, np.int16(-32768)
        np.testing.assert_array_equal(unpack(data, data[...]), [100.0, 105.0, np.nan])


def test_each_of_several_missing_values_is_unknown(tmp_path):
    with h5py.File(tmp_path / "packed.h5", "w") as file:
        data = file.create_dataset("height", data=np.array([1, -1, 5, -2], np.float32))
        data.attrs["missing_value"] = np.array([-1, -2], np.float32)
        np.testing.assert_array_equal(unpack(data, data[...]), [1, np.nan, 5, np.nan])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("scale_factor", "x"),
        ("scale_factor", 0.0),
        ("add_offset", np.nan),
        ("missing_value", "none"),
        ("_FillValue", h5py.Empty("f4")),
    ],
)
def test_maps_that_cannot_be_unpacked_are_refused(tmp_path, name, value):
    path = write_pairs(tmp_path / "pairs.h5")
    with h5py.File(path, "r+") as file:
        file["image"].attrs[name] = value
    with pytest.raises(ArtefactError, match=f"/image: expected a number in '{name}', found"):
        open_artefact(path, PAIRS)


def test_an_output_that_is_a_hard_link_to_an_input_is_refused(tmp_path):
    (tmp_path / "input.h5").write_bytes(b"measured")
    (tmp_path / "other.h5").hardlink_to(tmp_path / "input.h5")
    (tmp_path / "equal.h5").write_bytes(b"measured")
    with pytest.raises(ConfigError, match="would replace the input"):
        check_apart([Target(tmp_path / "other.h5")], Inputs([tmp_path / "input.h5"]))
    check_apart([Target(tmp_path / "equal.h5")], Inputs([tmp_path / "input.h5"]))  # another file, if of the same bytes


def test_names_that_are_no_utf_8_are_refused(tmp_path):
    path = write_pairs(tmp_path / "pairs.h5")
    with h5py.File(path, "r+") as file:
        file.create_group("inner").create_group(b"\xff")
    with pytest.raises(ArtefactError, match="expected names in UTF-8, found other bytes"):
        open_artefact(path, PAIRS)
