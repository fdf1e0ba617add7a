"""The user's own text files, read in one place."""

from __future__ import annotations

import pytest

from schemas.command_line import count_processes
from schemas.errors import ConfigError, InputError
from schemas.files.user_files import check_columns, check_keys, parse_csv, parse_number
from stages.physics.images.table import read_frames
from stages.render.trajectory import read_trajectory
from stages.train.processes import join_group


@pytest.mark.parametrize("read", [read_frames, read_trajectory])
def test_a_cell_beyond_what_csv_allows_is_one_line(read, tmp_path):
    table = tmp_path / "table.csv"
    table.write_text(f"longitude_deg,latitude_deg,altitude_m,image_id\n1,2,3,{'x' * 131_073}\n")
    with pytest.raises(InputError, match=r"table\.csv: expected .* found no CSV that can be read .*; mend the file"):
        read(table)


def test_a_cell_in_quotes_may_hold_lines(tmp_path):
    names, rows = parse_csv(tmp_path, ' a ,b\r\n"x\r\ny",2\r\n', "a table")
    assert (names, rows) == (["a", "b"], [{"a": "x\r\ny", "b": "2"}])
    assert parse_csv(tmp_path, "", "a table") == ([], [])
    assert len(parse_csv(tmp_path, "a,b\n1,2,,\n", "a table")[1]) == 1
    with pytest.raises(InputError, match="expected 2 cells in row 2, as in the header, found more"):
        parse_csv(tmp_path, "a,b\n1,2\n1,2,3\n", "a table")


@pytest.mark.parametrize("text", ["1_0", "\u0661\u0662", ""])
def test_a_table_s_number_is_one_in_any_language(text):
    with pytest.raises(ValueError):
        parse_number(text)
    assert parse_number("-1.5e3") == -1500


@pytest.mark.parametrize("text", ["abc", "", "0", "-1", "1.5", "9" * 40])
def test_a_count_of_processes_that_is_none_is_one_line(text, monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", text)
    for count in (count_processes, join_group):
        with pytest.raises(ConfigError, match="WORLD_SIZE: expected a count of processes"):
            count()


def test_processes_that_torchrun_did_not_start_are_one_line(monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.delenv("RANK", raising=False)
    with pytest.raises(ConfigError, match="WORLD_SIZE: expected 2 processes that torchrun started"):
        join_group()


def test_misspelt_keys_and_columns_are_refused():
    with pytest.raises(InputError, match=r"c\.json: unknown key 'focal_lenght', did you mean 'focal_length'"):
        check_keys(["focal_lenght"], ("focal_length", "size"), "c.json")
    check_columns(["image_id", "notes", None], ("image_id", "subsolar_longitude_deg"), "t.csv")
    with pytest.raises(InputError, match="unknown column 'subsolar_longitude', did you mean 'subsolar_longitude_deg'"):
        check_columns(["image_id", "subsolar_longitude"], ("image_id", "subsolar_longitude_deg"), "t.csv")
