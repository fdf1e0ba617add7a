"""A PDS index in place of the image table: cumulative indices of several archives, and where their images are found."""

from __future__ import annotations

import numpy as np
import pytest
import small_scene
from rasterio.transform import Affine
from small_scene import write_raster

from schemas.errors import InputError
from stages.physics.images.labels import index_images
from stages.physics.images.table import read_frames

COLUMNS = (
    ("FILE_SPECIFICATION_NAME", 40, "{:<38}"), ("PRODUCT_ID", 16, "{:<14}"), ("START_TIME", 26, "{:<24}"),
    ("SUB_SOLAR_LATITUDE", 10, "{:>10}"), ("SUB_SOLAR_LONGITUDE", 10, "{:>10}"), ("SOLAR_DISTANCE", 14, "{:>14}"),
    ("SUB_SPACECRAFT_LATITUDE", 10, "{:>10}"), ("SUB_SPACECRAFT_LONGITUDE", 10, "{:>10}"), ("SPACECRAFT_ALTITUDE", 10, "{:>10}"),
)  # fmt: skip


def write_index(folder, rows, columns=COLUMNS):
    label, start = (
        ["PDS_VERSION_ID = PDS3", '^INDEX_TABLE = "CUMINDEX.TAB"', "OBJECT = INDEX_TABLE", f"  ROWS = {len(rows)}"],
        1,
    )
    for name, width, _ in columns:
        quoted = int("<" in _)
        label += [
            "  OBJECT = COLUMN",
            f"    NAME = {name}",
            f"    START_BYTE = {start + quoted}",
            f"    BYTES = {width - 2 * quoted}",
            "  END_OBJECT = COLUMN",
        ]
        start += width + 1
    (folder / "CUMINDEX.LBL").write_text("\n".join([*label, "END_OBJECT = INDEX_TABLE", "END", ""]))
    lines = []
    for row in rows:
        cells = [
            f'"{form.format(v)}"' if "<" in form else form.format(v)
            for (_, _, form), v in zip(columns, row, strict=True)
        ]
        lines.append(",".join(cells))
    (folder / "CUMINDEX.TAB").write_text("\r\n".join(lines) + "\r\n")
    return folder / "CUMINDEX.TAB"


def test_a_cumulative_index_replaces_the_table(tmp_path):
    rows = [
        ("DATA/MAP/2010313/NAC/M143947267LE.IMG", "M143947267LE", "2010-11-09 13:06:40.356", -1.12, 143.61, 147900798.0, 35.9, 102.6, 54.47),
        ("DATA/MAP/2010313/NAC/M143947267RE.IMG", "M143947267RE", "2010-11-09 13:06:40.356", -1.12, 143.61, 147900798.0, 35.9, 102.5, 54.47),
    ]  # fmt: skip
    index = write_index(tmp_path, rows)
    write_raster(
        tmp_path / "m143947267le.cal.tif",
        np.ones((20, 20), np.float32),
        small_scene.local_crs(),
        Affine(20, 0, 0, 0, -20, 0),
    )
    for given in (index, index.with_suffix(".LBL")):
        frames = read_frames(given)
        assert [f.image_id for f in frames] == ["M143947267LE"]  # the other product's image is not there
        frame = frames[0]
        assert frame.path.name == "m143947267le.cal.tif" and frame.units == "iof"
        assert frame.spacecraft_altitude_m == pytest.approx(54470)
        assert frame.solar_distance_au == pytest.approx(0.98866, abs=1e-5)
        assert (frame.subsolar_latitude_deg, frame.subsolar_longitude_deg) == (-1.12, 143.61)


def one_pixel(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_raster(path, np.ones((4, 4), np.float32), small_scene.local_crs(), Affine(20, 0, 0, 0, -20, 0))


def test_an_index_finds_images_in_the_archives_own_tree(tmp_path):
    """LROC's paths begin at the server's root; what is not known is -9999 or N/A."""
    place = "/LRO-L-LROC-2-EDR-V1.0/LROLRC_0001/DATA/MAP/M1.tif"
    rows = [(place, "M1", "2010-11-09 13:06:40.356", -1.12, -9999.0, 147900798.0, "N/A", 102.6, 54.47)]
    for kept in ("LRO-L-LROC-2-EDR-V1.0/LROLRC_0001", "LROLRC_0001", "."):
        top = tmp_path / kept.replace("/", "_").replace(".", "here")
        volume = top / kept
        one_pixel(volume / "DATA/MAP/M1.tif")
        (volume / "INDEX").mkdir()
        columns = [("FILE_SPECIFICATION_NAME", 60, "{:<58}"), *COLUMNS[1:]]
        row = index_images(write_index(volume / "INDEX", rows, columns))[0]
        assert (volume / "INDEX" / row["path"]).resolve() == (volume / "DATA/MAP/M1.tif").resolve()
        assert float(row["subsolar_latitude_deg"]) == -1.12 and float(row["spacecraft_altitude_m"]) == 54470
        assert not {"subsolar_longitude_deg", "spacecraft_latitude_deg"} & set(row)


def test_indices_of_messenger_and_hirise_name_their_files_otherwise(tmp_path):
    """MDIS: PATH_NAME and FILE_NAME (msgrmds_2001/INDEX/CUMINDEX.LBL); HiRISE: FILE_NAME_SPECIFICATION; CTX: IMAGE_TIME."""
    one_pixel(tmp_path / "2011088/EN0209877468M.tif")
    times = ("IMAGE_TIME", 26, "{:<24}")
    split = [("PATH_NAME", 12, "{:<10}"), ("FILE_NAME", 24, "{:<22}"), ("PRODUCT_ID", 18, "{:<16}"), times]
    row = index_images(
        write_index(tmp_path, [("2011088", "EN0209877468M.tif", "EN0209877468M", "2011-03-29T09:20:03")], split)
    )[0]
    assert row["path"] == "2011088/EN0209877468M.tif" and row["start_time"] == "2011-03-29T09:20:03"
    whole = [("FILE_NAME_SPECIFICATION", 40, "{:<38}"), ("PRODUCT_ID", 18, "{:<16}")]
    row = index_images(write_index(tmp_path, [("2011088/EN0209877468M.tif", "EN0209877468M")], whole))[0]
    assert row["path"] == "2011088/EN0209877468M.tif" and row["start_time"] == ""


def test_bad_indices_get_one_clear_line(tmp_path):
    index = write_index(tmp_path, [("X.IMG", "X", "2010-01-01 00:00:00", 0, 0, 1.5e8, 0, 0, 50)])
    with pytest.raises(InputError, match="expected an image of at least one of its 1 products near it"):
        read_frames(index)
    (tmp_path / "CUMINDEX.LBL").unlink()
    with pytest.raises(InputError, match=r"expected its label 'CUMINDEX\.LBL' beside it"):
        read_frames(index)
